"""Memory of a run, and code that reads and writes it: robots in lanes, or places along the rod in lanes.

A lane of a vector is a robot of a batch. For a single robot it is a place along the rod; in the recursion
along the rod it is a row of a matrix, or one of many tangents. The code is the same: arrays know their layout
(`Array`), and values are `wide` where all places are independent, else `plain`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from knode_cosserat.engine.codegen import Function, Index, Module, StackVariable, Stores, Value, vector_lanes
from knode_cosserat.engine.counts import Counts, GridCounts


@dataclasses.dataclass(frozen=True)
class Array:
    """Numbers of `size` components at `count` places, or (count 0) of no place, in the memory of a run."""

    offset: int
    size: int
    count: int
    #: distance between components and between places, in doubles
    component: int
    place: int
    #: number of the function's argument that is its memory
    memory: int = 0
    #: true if tangents are in lanes
    is_tangent: bool = False
    #: name of the number of places that are used (`Counts`); empty if it is `count`
    where: str = ""

    def at(self, i: int, j: int) -> int:
        """Return the offset of component i at place j."""
        return self.offset + j * self.place + i * self.component


def aligned_zeros(size: int) -> np.ndarray:
    """Return zeros, aligned to 64 bytes."""
    raw = np.zeros(size + 8)
    return raw[(-raw.ctypes.data // 8) % 8 :][:size]


class Memory:
    """Arrays of a run, and the function that is being written."""

    #: counts of the grid that runs, and this code with those of other grids
    counts: GridCounts
    on_grids: dict[GridCounts, Any]

    def __init__(self, robots: bool, room: Counts):
        self.batch, self.L, self.room, self.on_grids = robots, vector_lanes(), room, {}
        #: lanes of a plain value
        self.P = self.L if robots else 1
        #: distance between components of a single robot's arrays
        # an odd number of vectors: components spread over all sets of the cache
        self.stride = (-(-(room["count"] + 1) // self.L) + 1 | 1) * self.L
        self.module = Module()
        #: counts in memory, as whole numbers
        self._size, self._count_places = (
            -(-len(room.numbers) // self.L) * self.L,
            {name: k for k, name in enumerate(room.numbers)},
        )

    def _compiled(self) -> Any:
        """Return the functions of this computer; other computers take the text of the module."""
        return self.module.compile()

    def _room(self, count: int | str) -> tuple[int, str]:
        """Return the largest number of places, and the name of that of a grid, if it has one."""
        return (self.room[count], count) if isinstance(count, str) else (count, "")

    def _array(self, size: int, where: int | str = 0, memory: int = 0) -> Array:
        """Reserve an array: robots in lanes, or places in lanes."""
        count, name = self._room(where)
        place, component = (size * self.L, self.L) if self.batch else (1, self.stride if count else 1)
        found = Array(self._size, size, count, component, place, memory, where=name)
        length = size * max(count, 1) * self.L if self.batch else size * component
        self._size += -(-length // self.L) * self.L
        return found

    def _by_rows(self, rows: int, columns: int, where: int | str) -> Array:
        """Reserve matrices by columns: a vector has a row of all robots, or as many rows as lanes."""
        size = columns * self._padded(rows)
        if self.batch:
            return self._array(size, where)
        count, name = self._room(where)
        found = Array(self._size, size, count, 1, size, where=name)
        # a transpose writes as many columns as there are lanes
        self._size += size * -(-count // self.L) * self.L
        return found

    def _tangent_array(self, size: int, count: int, memory: int = 0) -> Array:
        """Reserve an array with as many tangents in lanes as there are lanes."""
        found = Array(self._size, size, count, self.L, size * self.L, memory, is_tangent=True)
        self._size += size * count * self.L
        return found

    def _padded(self, rows: int) -> int:
        """Return the number of rows that a column takes in memory."""
        return rows if self.batch else -(-rows // self.L) * self.L

    def _blocks(self, rows: int) -> range:
        """Return the first row of each vector of a column."""
        return range(0, rows, self._rows_at_once)

    @property
    def _rows_at_once(self) -> int:
        """Rows of a matrix in one vector."""
        return 1 if self.batch else self.L

    # counts of the grid that runs

    def _count(self, name: str) -> Value:
        """Return a count in the function that is being written."""
        return self._now.constant(self._now.arguments[0], self._count_places[name])

    def _place(self, name: str) -> Index:
        """Return a place that has a name."""
        return self._now.constant_index(self._count(name))

    def _used_places(self, array: Array) -> Any:
        """Return the number of an array's places that are used."""
        return self._count(array.where) if array.where else array.count

    def _each_packed_vector(self, arrays: Sequence[Array], outside: Value) -> Iterator[tuple[Value, Value]]:
        """Write loops over vectors of arrays, and yield their addresses in memory and outside (`_packed`)."""
        f = self._now
        for array in arrays:
            inside, rows, width = f.pointer(f.arguments[0], array.offset), 1, f.value(array.size, "i64")
            if self.batch:
                width = width * self.L * (self._used_places(array) or 1)
            elif array.where:
                rows, width = array.size, self._count(array.where)
            # whole vectors
            width = f.result(f"and i64 {(width + (self.L - 1)).name}, {-self.L}", "i64")
            with f.loop(rows) as i:
                source = f.pointer(inside, i.value * array.component)
                target = f.pointer(outside, i.value * width)
                with f.loop(width, 0, self.L) as k:
                    yield f.pointer(source, k.value), f.pointer(target, k.value)
            outside = f.pointer(outside, width * rows)

    # numbers from outside

    def _numbers(self, memory: np.ndarray, array: Array, first: int = 0) -> np.ndarray:
        """Return an array's numbers (m, lanes, places, size): a view of memories (m, n) from `first` on."""
        shape, axes = (array.size, self.stride if array.count else 1, 1), (0, 3, 2, 1)
        if self.batch or array.is_tangent:
            shape, axes = (max(array.count, 1), array.size, self.L), (0, 3, 1, 2)
        at = array.offset - first
        return (
            memory[:, at : at + shape[0] * shape[1] * shape[2]].reshape(len(memory), *shape).transpose(axes)
        )

    def _put_in(self, memory: np.ndarray, array: Array, values: np.ndarray, first: int = 0) -> None:
        """Write values (m, lanes, places, size); the last place is repeated in the lanes beyond it."""
        target = self._numbers(memory, array, first)
        count = values.shape[-2]
        target[:, :, :count] = values
        if not self.batch:
            target[:, :, count:] = values[:, :, -1:]

    def _pack(self, arrays: Sequence[Array]) -> list[Array]:
        """Return arrays one after the other outside of the memory, of the places that are used."""
        found, at = list[Array](), 0
        for array in arrays:
            count = self.counts[array.where] if array.where else array.count
            component = -(-count // self.L) * self.L if count and not self.batch else array.component
            own = dataclasses.replace(array, offset=at, count=count, component=component)
            found.append(own)
            at += self._size_of(own)
        return found

    def _size_of(self, packed: Array) -> int:
        """Return the numbers of an array outside of the memory, in whole vectors."""
        if self.batch:
            return packed.size * max(packed.count, 1) * self.L
        return -(-packed.size * packed.component // self.L) * self.L

    # code that reads and writes

    def _function(self, name: str, *arguments: str) -> Function:
        f = self.module.function(name, ["memory", *arguments])
        self._now = f
        return f

    def _at(self, array: Array, i: int | Index, j: int | Index) -> tuple[Value, int]:
        """Return an address and an offset from it."""
        address, numbers = self._now.arguments[array.memory], []
        for at, distance in ((j, array.place), (i, array.component)):
            address = address if isinstance(at, int) else at.address(address, distance)
            numbers.append(at if isinstance(at, int) else at.delta)
        return address, array.at(numbers[1], numbers[0])

    def _pointer(self, array: Array, j: int | Index) -> Value:
        """Return the address of component 0 at a place."""
        return self._now.pointer(*self._at(array, 0, j))

    def _get(self, array: Array, i: int, j: int | Index = 0, lanes: int = 0) -> Value:
        return self._now.load(*self._at(array, i, j), lanes or self.P)

    def _put(self, value: Any, array: Array, i: int, j: int | Index = 0, lanes: int = 0) -> None:
        self._now.store(value, *self._at(array, i, j), lanes or self.P)

    def _lanes(self, array: Array) -> int:
        """Return the lanes of a wide value; 1 for a number that is the same at all places."""
        return self.L if self.batch or array.count else 1

    def _wide(self, array: Array, i: Any, j: Any = 0) -> Value:
        return self._get(array, i, j, self._lanes(array))

    def _write_wide(self, value: Any, array: Array, i: Any, j: Any) -> None:
        self._put(value, array, i, j, self.L)

    def _stores(self, results: Iterable[tuple[Array, Iterable[tuple[int, int]]]], j: Any) -> Stores:
        """Return functions that write nodes to their components of arrays at a place."""
        places: dict[int, list[tuple[Array, int]]] = {}
        for array, nodes in results:
            for i, node in nodes:
                places.setdefault(int(node), []).append((array, i))

        def store(at: list[tuple[Array, int]], value: Value) -> Callable[[], Value]:
            for array, i in at:
                self._write_wide(value, array, i, j)
            return functools.partial(self._wide, *at[0], j)

        return {node: functools.partial(store, at) for node, at in places.items()}

    def _column(self, array: Array, rows: int, column: int = 0, j: int | Index = 0) -> list[Value]:
        """Return the vectors of a column of a matrix."""
        first = column * self._padded(rows)
        return [self._get(array, first + row, j, self.L) for row in self._blocks(rows)]

    def _set_column(self, values: list[Value], array: Array, rows: int, column: int = 0, j: Any = 0) -> None:
        first = column * self._padded(rows)
        for row, value in zip(self._blocks(rows), values, strict=True):
            self._put(value, array, first + row, j, self.L)

    def _entry(self, column: list[Value], row: int) -> Value:
        """Return the number in a row of a column, in all lanes."""
        if self._rows_at_once == 1:
            return column[row]
        f = self._now
        return f.splat(f.lane(column[row // self.L], row % self.L), self.L)

    @contextlib.contextmanager
    def _places(self, count: Any, first: int = 0) -> Iterator[Index]:
        """Write a loop over places, all independent: one by one, or as many as there are lanes.

        The last lanes of a single robot may lie beyond the last place. They hold numbers that nobody reads.
        """
        with self._now.loop(first + count, first, 1 if self.batch else self.L) as j:
            yield j

    def _each(self, size: int) -> Iterator[Any]:
        """Yield each component of a place: in a loop for a single robot, which compiles faster."""
        if self.batch:
            yield from range(size)
        else:
            with self._now.loop(size) as i:
                yield i

    def _components(self, size: int, count: Any) -> Iterator[tuple[Any, Index]]:
        """Write a loop over places, and yield each component with the place."""
        with self._places(count) as j:
            for i in self._each(size):
                yield i, j

    def _transpose(
        self, rows: int, places: Any, wide: tuple[Value, int], by_rows: tuple[Value, int], back: bool = False
    ) -> None:
        """Copy numbers with places in lanes to columns with rows in lanes, or back.

        Both have the address of the first number, and the distance between components or between columns.
        """
        f, L = self._now, self.L
        zero = f.splat(f.value(0.0), L)
        with f.loop(places, 0, L) as j:
            source, target = f.pointer(wide[0], j.value), f.pointer(by_rows[0], j.value * by_rows[1])
            for row in range(0, rows, L):
                inside = [(source, (row + k) * wide[1]) for k in range(min(L, rows - row))]
                columns = [(target, k * by_rows[1] + row) for k in range(L)]
                first, then = (columns, inside) if back else (inside, columns)
                values = [f.load(*at, L) for at in first]
                values += [zero] * (L - len(values))
                for value, at in zip(f.transpose(values), then, strict=False):
                    f.store(value, *at)

    def _variable(self, value: Any) -> StackVariable:
        """Return a plain variable."""
        return StackVariable(self._now, self._now.splat(self._now.value(value), self.P))

    def _wide_variable(self, value: Any) -> StackVariable:
        return StackVariable(self._now, self._now.splat(self._now.value(value), self.L))

    def _write_each(self, target: Array, where: str, formula: Callable[..., Any], *sources: Array) -> None:
        """Write a formula of arrays, number by number, to an array at the places of a count."""
        for i, j in self._components(target.size, self._count(where)):
            self._write_wide(formula(*(self._wide(each, i, j) for each in sources)), target, i, j)

    def _copy_wide(self, source: Array, target: Array, count: Any, shift: int = 0) -> None:
        """Copy values at places, to places that are earlier by a shift."""
        for i, j in self._components(source.size, count):
            self._write_wide(self._wide(source, i, j + shift), target, i, j)

    def _write_shift(self, states: list[Array], count: Any) -> None:
        """Shift earlier states by one step."""
        for newer, older in reversed(list(itertools.pairwise(states))):
            self._copy_wide(newer, older, count)

    def _before(self, end: Any, j: Index, value: Value) -> Value:
        """Return a value, but zero in the lanes from a place on."""
        return value if self.batch else self._now.select(self._inside(j, end), value, 0.0)

    def _inside(self, j: Index, end: Any) -> Any:
        """Return true for the lanes before a place."""
        if self.batch:
            return True
        f = self._now
        numbers = f.join([f.value(float(k)) for k in range(self.L)])
        here, stop = (
            f.result(f"sitofp i64 {each.name} to double") for each in (j.value, f.value(end, "i64"))
        )
        return numbers + here < stop

    def _largest(self, value: Value) -> Value:
        """Return the largest of a wide value for each robot."""
        return value if self.batch else self._now.largest(value)

    def _spread(self, value: Value) -> Value:
        """Return a plain value in all lanes of a wide one."""
        return self._now.splat(value, self.L)
