"""Machine code of arrays in programs (`program.Program`): loops over their entries, and sums.

An array takes memory where it is needed at other positions than its own; other arrays are computed entry by
entry where they are used. Arrays that are ready at the same time, and of the same shape, share a loop, and
sums share what they read: the derivatives of a network by all its inputs are one product of matrices.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from knode_cosserat.engine.program import PRODUCTS, Positions, Program

if TYPE_CHECKING:
    from knode_cosserat.engine.codegen import Function, Index, Value

#: operations that take less time than memory
CHEAP = PRODUCTS | {"add", "sub"}
#: sums in registers, arrays whose sums share a loop, and rows of a matrix that are read side by side
REGISTERS, SHARED, ROWS = 25, 5, 8


@dataclasses.dataclass(frozen=True)
class Stored:
    """Entries of an array in memory, at regular distances in doubles; truths are 1 and 0."""

    base: Value
    distance: int
    lanes: int = 1


def summands(program: Program, node: int) -> Iterator[tuple[int, Positions]]:
    """Return arrays, with their positions, that add up to an array."""
    name, *rest = program.operations[node]
    if name == "spread":
        yield rest[0], rest[1]
    elif name == "add" and all(each in program.shapes for each in rest):
        for each in rest:
            yield from summands(program, each)
    else:
        yield node, Positions.whole(program.shapes[node])


class ArrayCode:
    """Code of the arrays among the nodes of a program, in a function."""

    def __init__(
        self,
        function: Function,
        program: Program,
        outputs: Iterable[int],
        added: Iterable[int],
        values: dict[int, Any],
    ):
        #: nodes that outputs and added arrays need, in order
        self.needed = program.needed([*outputs, *added], frozenset(values))
        self.function, self.program, self._values = function, program, values
        whole = {*outputs, *added}
        stored = {node for node in outputs if node in program.shapes}
        #: needed entries of arrays that are not needed as a whole
        self._entries: dict[int, list[int]] = {}
        for node in self.needed:
            name, *rest = program.operations[node]
            if name == "entry":
                self._entries.setdefault(rest[0], []).append(rest[1])
            for each in program.arguments(node) if name != "entry" else ():
                whole.add(each)
            if name in ("view", "entry"):
                stored.add(rest[0])
            elif name in ("stack", "spread"):
                stored.add(node)
            elif name == "sum":
                stored |= {node, *self._costly(rest[0])}
        for node in whole & set(self._entries):
            del self._entries[node]
        #: arrays that are written to memory, in order
        self._stored = sorted(stored - values.keys())
        self._in_memory = stored | (values.keys() & program.shapes.keys())

    def _costly(self, node: int) -> set[int]:
        """Return the arrays in the terms of a sum that are not to be computed again for every sum."""
        name, *rest = self.program.operations[node]
        if node not in self.program.shapes or name == "view":
            return set()
        return {each for part in rest for each in self._costly(part)} if name in CHEAP else {node}

    def place(self, node: int) -> tuple[int, Positions] | None:
        """Return the array in memory, and the positions there, of the entries of an array; or None."""
        name, *rest = self.program.operations[node]
        if name == "view":
            return rest[0], rest[1]
        return (node, Positions.whole(self.program.shapes[node])) if node in self._in_memory else None

    def _sources(self, node: int) -> Iterator[tuple[int, Positions | None]]:
        """Return the scalars, and the positions in arrays in memory, from which an array is computed."""
        for each in self.program.arguments(node):
            yield from self._read(each)

    def _read(self, node: int) -> Iterator[tuple[int, Positions | None]]:
        """Return the scalars, and the positions in arrays in memory, that are read for a node."""
        if node not in self.program.shapes:
            yield node, None
        elif (place := self.place(node)) is not None:
            yield place
        else:
            yield from self._sources(node)

    def value(self, node: int) -> Any:
        """Return the value of a scalar, or the memory of an array; None if it is not known yet."""
        if self.program.is_constant(node):
            return self.function.value(self.program.values[node])
        if node not in self._values:
            return None
        return self._values[node]

    def write(self, node: int) -> None:
        """Write an array, with those that share its loop; nothing if it is computed where it is used."""
        if node not in self._in_memory or node in self._values:
            return
        name = self.program.operations[node][0]
        if name == "stack":
            self._values[node] = self._copy(self.program.arguments(node))
            return
        if name == "spread":
            self._values[node] = self._spread(node)
            return
        alike = [
            each for each in self._stored if self._kind(each) == self._kind(node) and self._is_ready(each)
        ]
        if name != "sum":
            self._write_entries(alike)
        for first in range(0, len(alike), SHARED) if name == "sum" else ():
            self._write_sums(alike[first : first + SHARED])

    def _kind(self, node: int) -> Any:
        name, *rest = self.program.operations[node]
        return (name, self.program.shapes[rest[0]]) if name == "sum" else self.program.shapes[node]

    def _is_ready(self, node: int) -> bool:
        if node in self._values or self.program.operations[node][0] in ("stack", "spread", "input", "inputs"):
            return False
        return all(self.value(each) is not None for each, _ in self._sources(node))

    def _reserve(self, count: int, lanes: int) -> Stored:
        kind = "double" if lanes == 1 else f"<{lanes} x double>"
        return Stored(self.function.address(self.function.reserve(f"[{count} x {kind}]")), lanes, lanes)

    def _lanes(self, nodes: Iterable[int]) -> int:
        return max(self.value(each).lanes for node in nodes for each, _ in self._sources(node))

    def _copy(self, scalars: Sequence[int]) -> Stored:
        """Write scalars to memory."""
        f, found = self.function, [self.value(each) for each in scalars]
        if all(self.program.is_constant(each) for each in scalars):
            return Stored(f.address(f.module.constants([self.program.values[each] for each in scalars])), 1)
        target = self._reserve(len(found), max(each.lanes for each in found))
        for k, each in enumerate(found):
            self._store(each, target, k * target.distance)
        return target

    def _spread(self, node: int) -> Stored:
        """Write zeros with entries of an array added."""
        lanes, count = self._lanes([node]), math.prod(self.program.shapes[node])
        target = self._reserve(count, lanes)
        with self.function.loop(count) as k:
            self.function.store(0.0, target.base, k.value * target.distance, lanes)
        _, part, positions, _ = self.program.operations[node]
        self._add(part, positions, target)
        return target

    def add(self, node: int, target: Value, inside: Any) -> None:
        """Add the entries of an array, each summed over the lanes inside, to numbers in memory."""
        for part, positions in summands(self.program, node):
            self._add(part, positions, Stored(target, 1), inside)

    def _add(self, node: int, positions: Positions, target: Stored, inside: Any = None) -> None:
        """Add the entries of an array at positions in memory, or the sums over their lanes inside."""
        f = self.function
        with contextlib.ExitStack() as loops:
            indices = [loops.enter_context(f.loop(count)) for count in positions.shape]
            value = _Terms(self, self._pointers(self._read(node), indices)).value(node)
            if inside is not None:
                value = f.total(f.select(inside, value, 0.0))
            offset = self._offset(indices, [stride * target.distance for stride in positions.strides])
            at = f.pointer(f.pointer(target.base, positions.first * target.distance), offset)
            f.store(f.load(at, 0, target.lanes) + value, at, 0, target.lanes)

    def _store(self, value: Value, target: Stored, offset: Any) -> None:
        number = self.function.select(value, 1.0, 0.0) if value.kind == "i1" else value
        self.function.store(number, target.base, offset, target.lanes)

    def load(self, node: int, k: int) -> Value:
        """Return an entry of an array in memory."""
        stored = self.value(node)
        return self.load_number(node, stored.base, k * stored.distance)

    def load_number(self, node: int, base: Value, offset: int) -> Value:
        """Return the number or truth of an array at an address."""
        found = self.function.load(base, offset, self.value(node).lanes)
        return self.function.compare("ne", found, 0.0) if self.program.is_boolean(node) else found

    def _offset(self, indices: Sequence[Index], distances: Sequence[int]) -> Any:
        products = [
            index.value * distance for index, distance in zip(indices, distances, strict=False) if distance
        ]
        return sum(products[1:], start=products[0]) if products else 0

    def _pointers(
        self, sources: Iterable[tuple[int, Positions | None]], indices: Sequence[Index]
    ) -> dict[Any, Value]:
        """Return the addresses, at the indices along the first axes, of arrays in memory."""
        found: dict[Any, Value] = {}
        for base, positions in sources:
            if positions is not None and (base, positions.strides) not in found:
                stored = self.value(base)
                offset = self._offset(indices, [stride * stored.distance for stride in positions.strides])
                found[base, positions.strides] = self.function.pointer(stored.base, offset)
        return found

    def _write_entries(self, nodes: Sequence[int]) -> None:
        """Write arrays of the same shape entry by entry."""
        shape, lanes = self.program.shapes[nodes[0]], self._lanes(nodes)
        targets = [self._reserve(math.prod(shape), lanes) for _ in nodes]
        strides = [stride * lanes for stride in Positions.whole(shape).strides]
        with contextlib.ExitStack() as loops:
            indices = [loops.enter_context(self.function.loop(count)) for count in shape]
            sources = (each for node in nodes for each in self._sources(node))
            terms = _Terms(self, self._pointers(sources, indices))
            at = self._offset(indices, strides)
            for node, target in zip(nodes, targets, strict=True):
                self._store(terms.compute(node), target, at)
        self._values.update(zip(nodes, targets, strict=True))

    def _rows(self, nodes: Sequence[int], width: int) -> tuple[int, int]:
        """Return the range along the last axis, of this length, of the entries that are needed of arrays."""
        needed = [k % width for node in nodes for k in self._entries.get(node, (0, width - 1))]
        return min(needed), max(needed) + 1

    def _write_sums(self, nodes: Sequence[int]) -> None:
        """Write the sums along the last axis of arrays of the same shape, several rows at once."""
        f, added = self.function, [self.program.operations[node][1] for node in nodes]
        *outer, count = self.program.shapes[added[0]]
        lanes, size = self._lanes(nodes), math.prod(outer)
        targets = [self._reserve(size, lanes) for _ in nodes]
        strides = [stride * lanes for stride in Positions.whole(tuple(outer)).strides]
        start, end = self._rows(nodes, outer[-1] if outer else 1)
        most = min(end - start, ROWS, REGISTERS // len(nodes))
        rows = -(-(end - start) // -(-(end - start) // most))
        last = end - (end - start) % rows
        for first, stop, own in (start, last, rows), (last, end, end - last):
            if first == stop:
                continue
            with contextlib.ExitStack() as loops:
                indices = [loops.enter_context(f.loop(each)) for each in outer[:-1]]
                if outer:
                    indices.append(loops.enter_context(f.loop(stop, first, own)))
                sources = (each for node in nodes for each in self._sources(node))
                pointers = self._pointers(sources, indices)
                zero = f.splat(f.value(0.0), lanes)
                sums = [[f.variable(zero) for _ in range(own)] for _ in nodes]
                with f.loop(count) as k:
                    here = {
                        (base, steps): f.pointer(pointer, k.value * (steps[-1] * self.value(base).distance))
                        for (base, steps), pointer in pointers.items()
                    }
                    terms = _Terms(self, here)
                    for node, row in zip(added, sums, strict=True):
                        for shift, total in enumerate(row):
                            total.set(total.get() + terms.value(node, shift))
                at = self._offset(indices, strides)
                for target, row in zip(targets, sums, strict=True):
                    for shift, total in enumerate(row):
                        place = f.pointer(target.base, at)
                        f.store(total.get(), place, shift * lanes, lanes)
        self._values.update(zip(nodes, targets, strict=True))


class _Terms:
    """Values of arrays at one position, or at some rows further on (along the last axis but one)."""

    def __init__(self, code: ArrayCode, pointers: dict[Any, Value]):
        self._code, self._pointers = code, pointers
        self._known: dict[Any, Value] = {}

    def value(self, node: int, shift: int = 0) -> Value:
        """Return the value of an array, or a scalar."""
        code = self._code
        if node not in code.program.shapes:
            return code.value(node)
        place = code.place(node)
        if place is None:
            return self.compute(node, shift)
        base, positions = place
        offset = positions.first + (shift * positions.strides[-2] if shift else 0)
        key = base, positions.strides, offset
        if key not in self._known:
            distance = code.value(base).distance
            self._known[key] = code.load_number(base, self._pointers[key[:2]], offset * distance)
        return self._known[key]

    def compute(self, node: int, shift: int = 0) -> Value:
        """Return the value of an operation on arrays."""
        name, *arguments = self._code.program.operations[node]
        values = [self.value(each, shift) for each in arguments]
        key = name, *(each.name for each in values)
        if key not in self._known:
            self._known[key] = self._code.function.apply(name, *values)
        return self._known[key]
