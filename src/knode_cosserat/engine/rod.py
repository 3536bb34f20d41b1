"""Code of a rod's equations at all places: terms, rates, jumps, stages and defects of pieces, norms."""

from __future__ import annotations

import contextlib
import functools
import math
import operator
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.engine.arrays import Stored
from knode_cosserat.engine.codegen import Function, Index, StackVariable, Stores, Sums, Value
from knode_cosserat.engine.counts import Counts
from knode_cosserat.engine.equations import Equations
from knode_cosserat.engine.memory import Array, Memory, aligned_zeros
from knode_cosserat.schemes.space import Stage


class StateArrays(NamedTuple):
    """Arrays of an evaluated state, or of its tangents: y at ends of pieces and at stages, z and y_s."""

    far: Array
    between: Array
    z: Array
    f: Array


class RodCode(Memory):
    """Functions that evaluate the equations of a system along the rod.

    Several strands lie end to end. The pieces between the tip of one and the base of the next are idle: of no
    length and without defects.
    """

    rates: Function
    rates_and_slopes: Function

    def __init__(self, equations: Equations, robots: bool):
        system, room = equations.system, Counts.room_of(equations.system, equations.space)
        super().__init__(robots, room)
        self.equations, self.space, self.strands = equations, equations.space, equations.strands
        e = self.equations
        #: numbers of points with a near side, and of stages of the check and of the scheme
        self.near = list(range(self.strands * room.near))
        self.check_stages = list(range(len(self.space.check.stages)))
        self.stages = self.check_stages[: len(self.space.formula.stages)]
        ny, nz, k, a = e.ny, e.nz, e.k, self._array
        self.params, self.scale_tip = a(len(e.parameter_values)), a(k)
        self.scale_y = a(ny, 0 if self.strands == 1 else "points")
        self.inputs, self.step_terms = a(2 + e.nc), a(e.size(e.step_terms))
        self.s, self.h, self.length = a(1, "count"), a(1, "pieces"), a(1)
        #: places and pieces as parts of the length
        self.s_parts, self.h_parts = a(1, "count"), a(1, "pieces")
        self.place_terms = a(e.size(e.place_terms), "count")
        self.f, self.z = a(ny, "count"), a(nz, "count")
        self.slope = a(len(e.pattern), "used")
        # at the ends of pieces; without near sides these are the starts of the next ones
        self.fe, self.slope_end = (
            a(each.size, "pieces") if self.near else each for each in (self.f, self.slope)
        )
        self.acting, self.jump = a(e.acting.size, "pieces"), a(len(e.jumping), "pieces")
        #: y at the places of the ends; with jumps it differs from y at the points
        self.far = a(ny, "ends") if system.discontinuities.jump is not None else None
        #: y at the stages between ends
        self.between = a(ny, "between")
        #: points of the nodes, and points between nodes with the nodes around them, as whole numbers
        self.node_table, self.filled = a(room["nodes"]), a(3 * room["filled"])
        #: parts of segments before points between nodes
        self.filled_parts = a(room["filled"])
        #: slopes of jumps
        self.jumps = [(self.jump, [node for *_, node in e.jumping])]
        #: defects of the pieces and of the tip
        self.r, self.tip = a(ny, "pieces"), a(k)
        #: subtracted from the tip's residual
        self.tip_offset = a(k)

    @property
    def bases(self) -> list[Any]:
        """First points of the strands."""
        return [0, *(self._place(f"base {q}") for q in range(1, self.strands))]

    @property
    def tips(self) -> list[Index]:
        """Last points of the strands."""
        return [self._place(f"tip {q}") for q in range(self.strands)]

    def _empty_memory(self) -> np.ndarray:
        """Return the memory before a run: zeros but for those of the grid; aligned to 64 bytes."""
        found, counts = aligned_zeros(self._size), self.counts
        numbers = (self.s_parts, counts.along[:, None]), (self.h_parts, counts.lengths[:, None])
        for array, values in (*numbers, (self.acting, counts.grid.acting)):
            if array.size:
                self._put_in(found[None], array, values[None, None])
        whole = found.view(np.int64)
        whole[: len(counts.whole)] = counts.whole
        whole[self.node_table.offset :][: len(counts.grid.nodes)] = counts.grid.nodes
        whole[self.filled.offset :][: counts.filled.size] = counts.filled.ravel()
        found[self.filled_parts.offset :][: len(counts.filled_parts)] = counts.filled_parts
        return found

    def _width(self, array: Array) -> int:
        """Return the size of an array's numbers, of all strands, at one place of the grid."""
        return array.size * (self.strands if array.count else 1)

    def _by_strand(self, array: Array, packed: np.ndarray) -> np.ndarray:
        """Return an array's numbers from those of all strands at places of the grid (…, places, width)."""
        if self._width(array) == array.size:
            return packed
        origins = self.counts.origins
        strand, place = np.transpose([each for each in origins if each[1] < packed.shape[-2]])
        return self.equations.by_strand(packed)[..., place, strand, :]

    def _join(self, array: Array, values: np.ndarray, count: int) -> np.ndarray:
        """Return the numbers of all strands at the first places of the grid (…, count, width)."""
        if self._width(array) == array.size:
            return values[..., :count, :]
        first = {origin: k for k, origin in reversed(list(enumerate(self.counts.origins)))}
        places = [[first[q, j] for q in range(self.strands)] for j in range(count)]
        return self.equations.join(values[..., places, :])

    def _node(self, node: Index) -> Index:
        """Return the point of a node."""
        return self._from_table(self.node_table.offset, node.value) if self.near else node

    def _from_table(self, offset: int, k: Value) -> Index:
        """Return a whole number of a table."""
        f = self._now
        at = f.pointer(f.pointer(f.arguments[0], offset), k)
        return f.index(f.result(f"load i64, ptr {at.name}", "i64"))

    def _known(self, j: Any, wide: bool, state: dict[int, Any]) -> dict[int, Any]:
        """Return the values of hoisted terms at a place."""
        e = self.equations
        values = self._arrays_of(self.params, e.parameters) | state
        needed = set(e.program.needed(self._outputs, frozenset([*values, *e.step_terms, *e.place_terms])))
        for array, terms, place in (self.step_terms, e.step_terms, 0), (self.place_terms, e.place_terms, j):
            for node, first, _ in e.slots(terms):
                if node in needed:
                    lanes = self._lanes(array) if wide else self.P
                    values[node] = self._term(node, array, first, place, lanes)
        return values

    def _term(self, node: int, array: Array, first: int, j: Any, lanes: int) -> Any:
        """Return the value of a term; that of an array is its memory."""
        if node not in self.equations.program.shapes:
            return self._get(array, first, j, lanes)
        return Stored(self._now.pointer(*self._at(array, first, j)), array.component, lanes)

    def _put_terms(
        self, values: dict[int, Any], array: Array, terms: Sequence[int], j: Any, lanes: int
    ) -> None:
        """Write the values of terms to memory."""
        for node, first, count in self.equations.slots(terms):
            if node not in self.equations.program.shapes:
                self._put(values[node], array, first, j, lanes)
                continue
            target, stored = self._pointer(array, j), values[node]
            with self._now.loop(count) as k:
                number = self._now.load(stored.base, k.value * stored.distance, stored.lanes)
                self._now.store(number, target, (k.value + first) * array.component, lanes)

    def _arrays_of(self, array: Array, inputs: Sequence[np.ndarray]) -> dict[int, Stored]:
        """Return the memory of arrays of inputs that follow each other in an array."""
        found, first = {}, 0
        for nodes in inputs:
            node = self.equations.program.known_inputs(nodes)
            if node is not None:
                found[node] = Stored(self._now.pointer(*self._at(array, first, 0)), array.component, self.P)
            first += nodes.size
        return found

    def _evaluate(
        self,
        outputs: Sequence[int] | np.ndarray,
        j: Any,
        wide: bool,
        state: dict[int, Any],
        sums: Sums = ((), True),
        stores: Stores | None = None,
    ) -> list[Value]:
        """Write the operations of outputs at a place, and of arrays that are added (`Function.evaluate`)."""
        own = [int(each) for each in outputs]
        self._outputs = [*own, *(node for node, _ in sums[0])]
        lanes = self.L if wide else self.P
        known = self._known(j, wide, state)
        values = self._now.evaluate(self.equations.program, own, known, lanes, sums, stores)
        return [] if stores else [values[node] for node in own]

    def _write_setup(self) -> None:
        """Scales, places and lengths of pieces: once a run."""
        e = self.equations
        self.setup = f = self._function("setup")
        outputs = [int(node) for nodes in e.geometry for node in nodes.flat]
        values = f.evaluate(e.program, outputs, self._parameters(outputs), self.P)
        scale_y, scale_tip, length = e.geometry
        for i, node in enumerate(scale_tip):
            self._put(values[int(node)], self.scale_tip, i)
        self._put(values[int(length[0])], self.length, 0)
        for k, node in enumerate(scale_y):
            q, i = divmod(k, e.ny)
            if self.strands == 1:
                self._put(values[int(node)], self.scale_y, i)
                continue
            with f.loop(self._count("points of strand")) as j:
                self._put(values[int(node)], self.scale_y, i, self._of_strand(q, j))
        whole = self._spread(self._get(self.length, 0))
        for source, target in ((self.s_parts, self.s), (self.h_parts, self.h)):
            # also in the lanes beyond the last place
            with self._places(source.count if not self.batch else self._used_places(source)) as j:
                self._write_wide(whole * self._wide(source, 0, j), target, 0, j)

    def _of_strand(self, q: int, j: Index) -> Index:
        """Return the place j of strand q in loops over the places of a strand."""
        return j + self._count(f"base {q}") if q else j

    def _inputs_of(
        self, array: Array, inputs: Sequence[np.ndarray], outputs: Iterable[int]
    ) -> dict[int, Any]:
        """Return the values of the inputs that outputs depend on, and the memory of arrays of them."""
        found: dict[int, Any] = dict(self._arrays_of(array, inputs))
        needed = set(self.equations.program.needed(outputs, frozenset(found)))
        nodes = np.concatenate([nodes.reshape(-1) for nodes in inputs]).tolist()
        return found | {node: self._get(array, k) for k, node in enumerate(nodes) if node in needed}

    def _parameters(self, outputs: Iterable[int]) -> dict[int, Any]:
        return self._inputs_of(self.params, self.equations.parameters, outputs)

    def _write_terms(self) -> None:
        """Terms that depend on neither y nor the history: once a step."""
        e = self.equations
        self.terms = f = self._function("terms")
        state = self._parameters([*e.step_terms, *e.place_terms])
        for k, node in enumerate([e.c0.item(), e.t.item(), *e.control]):
            state[int(node)] = self._get(self.inputs, k)
        values = f.evaluate(e.program, e.step_terms, state, self.P)
        self._put_terms(values, self.step_terms, e.step_terms, 0, self.P)
        if not e.place_terms:
            return
        known = {node: values[node] for node in e.step_terms} | state
        with self._places(self._count("count")) as j:
            here = known | {e.s.item(): self._wide(self.s, 0, j)}
            values = f.evaluate(e.program, e.place_terms, here, self.L)
            self._put_terms(values, self.place_terms, e.place_terms, j, self.L)

    def _write_inputs(self, c0: Value, t: Value, control: Value) -> None:
        """Set the inputs of a step, with the control at an address, and evaluate its terms."""
        f, P = self._now, self.P
        self._put(c0, self.inputs, 0)
        self._put(t, self.inputs, 1)
        for i in range(self.equations.nc):
            self._put(f.load(control, i * P, P), self.inputs, 2 + i)
        f.call(self.terms, f.arguments[0])

    def _write_rates(self, name: str, slopes: Sequence[tuple[Array, Any]] = ()) -> Function:
        """A function of the addresses of y and history, and a place: rates and strains, and slopes."""
        e = self.equations
        f = self._function(name, "y", "history", "n_place")
        _, y, history, place = f.arguments
        j = f.index(place)
        component = self.f.component
        state = {int(node): f.load(y, i * component, self.L) for i, node in enumerate(e.y)}
        for i in e.used_history:
            state[int(e.history[i])] = f.load(history, i * component, self.L)
        results = (self.f, e.f), (self.z, e.z), *slopes
        self._write_results(results, j, state)
        return f

    def _write_results(self, results: Sequence[tuple[Array, Any]], j: Any, state: dict[int, Value]) -> None:
        """Write the values of nodes at a place into arrays."""
        stores = self._stores(((array, enumerate(nodes)) for array, nodes in results), j)
        self._evaluate([node for _, nodes in results for node in nodes], j, True, state, stores=stores)

    def _rates_at(
        self, function: Function, y: Array, history: Array, j: Index, place: Index | None = None
    ) -> None:
        """Write a call of a function of rates; `place` if y is not stored by place."""
        place = j if place is None else place
        f = self._now
        f.call(function, f.arguments[0], self._pointer(y, j), self._pointer(history, place), place.value)

    def _write_far(self, y: Array, history: Array, slopes: bool = False) -> Array:
        """Write y at all ends of pieces: after jumps at their starts, before jumps at their ends."""
        e = self.equations
        far = y if self.far is None else self.far
        if self.far is not None:
            self._copy_wide(y, far, self._count("points"))
            with self._places(self._count("pieces")) as j:
                results = (far, e.far), *(self.jumps if slopes else ())
                self._write_results(results, j, self._state(y, history, j) | self._acting_at(j))
        for k in self.near:
            for i in range(e.ny):
                self._put(self._get(y, i, self._place(f"near {k}")), far, i, self._place("points") + k)
        # also in the lanes beyond, where a loop of the equations would not end
        if self.near and not self.batch:
            with self._now.loop(self._count("ends of vectors"), self._count("ends")) as j:
                for i in range(e.ny):
                    self._put(self._get(y, i, self._place(f"near {self.near[-1]}")), far, i, j)
        return far

    def _write_ends(self, source: Array, target: Array) -> None:
        """Copy values at places to the ends of pieces, if these are other places."""
        if target is source:
            return
        self._copy_wide(source, target, self._count("pieces"), shift=1)
        for k in self.near:
            for i in range(source.size):
                value = self._get(source, i, self._place("points") + k)
                self._put(value, target, i, self._place(f"near {k}") + -1)

    def _write_residual(self, name: str, y: Array, history: Array) -> Function:
        """Rates at all ends of pieces by y, and the defects of all pieces and of the tip."""
        f = self._function(name)
        self._write_places(self.rates, y, history)
        self._write_defects(y, history)
        return f

    def _write_places(self, function: Function, y: Array, history: Array, slopes: bool = False) -> None:
        """Evaluate a function of rates at all places that the scheme uses."""
        far = self._write_far(y, history, slopes)
        with self._places(self._count("ends")) as j:
            self._rates_at(function, far, history, j)
        self._write_ends(self.f, self.fe)
        for k, stage in enumerate(self.space.formula.stages):
            self._write_rates_between(function, k, stage, y, history)

    def _write_rates_between(
        self, function: Function, k: int, stage: Stage, y: Array, history: Array
    ) -> None:
        """Evaluate a function of rates at a stage of all pieces."""
        far = y if self.far is None else self.far
        self._write_between(k, stage, (far, y), (self.f, self.fe), self.between)
        with self._places(self._count("pieces")) as j:
            self._rates_at(function, self.between, history, self._before_stage(k, j), self._at_stage(k, j))

    def _at_stage(self, k: int, j: Index) -> Index:
        """Return the place of stage k of a piece."""
        return j + self._count(f"stage {k}")

    def _before_stage(self, k: int, j: Index) -> Index:
        """Return the place of stage k of a piece among those between ends."""
        return j + self._count(f"pieces {k}") if k else j

    def _write_between(
        self, k: int, stage: Stage, y: tuple[Array, Array], rates: tuple[Array, Array], target: Array
    ) -> None:
        """Write y at stage k, from y at starts of pieces and at points, and earlier rates."""
        for i, j in self._components(self.equations.ny, self._count("pieces")):
            ends = self._wide(y[0], i, j), self._wide(y[1], i, j + 1)
            mean = self._weighted_sum((1.0 - stage.end, stage.end), ends)
            moved = self._increment(stage.rates, rates, i, j)
            self._write_wide(mean + moved, target, i, self._before_stage(k, j))
        with self._idle_pieces() as j:
            for i in range(self.equations.ny):
                self._put(self._get(y[0], i, j), target, i, self._before_stage(k, j))

    @contextlib.contextmanager
    def _idle_pieces(self) -> Iterator[Index]:
        """Write a loop over the pieces between strands."""
        with self._now.loop(self.strands - 1) as q:
            yield self._now.index((q.value + 1) * self._count("points of strand")) + -1

    def _increment(self, weights: Sequence[float], rates: tuple[Array, Array], i: int, j: Index) -> Value:
        """Return h times the weighted sum of a piece's rates: at its start, its end and its stages."""
        places = self._places_of(rates, j)
        values = [self._wide(array, i, place) for array, place in places[: len(weights)]]
        return self._weighted_sum(weights, values, self._wide(self.h, 0, j))

    def _places_of(self, rates: tuple[Array, Array], j: Index) -> list[tuple[Array, Index]]:
        """Return where a piece's rates are: at its start, its end and its stages."""
        at, end = rates
        stages = ((at, self._at_stage(k, j)) for k in self.check_stages)
        return [(at, j), (end, j + int(end is at)), *stages]

    def _weighted_sum(self, weights: Sequence[float], values: Sequence[Value], unit: Any = 1.0) -> Value:
        """Return a weighted sum times a unit, by one product for each size of a weight."""
        found = self._now.value(0.0)
        for size in dict.fromkeys(abs(weight) for weight in weights if weight):
            parts = [
                value if weight > 0.0 else -value
                for weight, value in zip(weights, values, strict=True)
                if abs(weight) == size
            ]
            found = found + size * unit * functools.reduce(operator.add, parts)
        return found

    def _write_defects(self, y: Array, history: Array) -> None:
        e, far = self.equations, y if self.far is None else self.far
        self._write_defects_of_pieces((far, y), (self.f, self.fe))
        at_tip = self._tip_state(y, history)
        for i, value in enumerate(self._evaluate(e.tip, 0, False, at_tip)):
            self._put(value - self._get(self.tip_offset, i), self.tip, i)

    def _state_arrays(self, y: Array) -> StateArrays:
        """Return the arrays of the state that was evaluated last, from y at the points."""
        return StateArrays(y if self.far is None else self.far, self.between, self.z, self.f)

    def _numbers_of(self, state: StateArrays, between: str) -> Iterator[tuple[int, Index, Value]]:
        """Write loops over places, and yield components of their records, places and numbers.

        `between` is the count of places between ends.
        """
        e = self.equations
        for y, count in (state.far, "ends"), (state.between, between):
            with self._places(self._count(count)) as j:
                here, first = j if count == "ends" else j + self._count("ends"), 0
                for array, size, at in (
                    (y, e.ny, j),
                    (state.z, e.nz, here),
                    (state.f, e.numbers - e.ny - e.nz, here),
                ):
                    for i in self._each(size):
                        yield i + first, here, self._wide(array, i, at)
                    first += size

    def _write_defects_of_pieces(self, y: tuple[Array, Array], rates: tuple[Array, Array]) -> None:
        """Write the defects of all pieces: y at their ends by the scheme, minus y."""
        for i, j in self._components(self.equations.ny, self._count("pieces")):
            change = self._wide(y[0], i, j) - self._wide(y[1], i, j + 1)
            value = change + self._increment(self.space.formula.weights, rates, i, j)
            self._write_wide(value, self.r, i, j)
        with self._idle_pieces() as j:
            for i in range(self.equations.ny):
                self._put(0.0, self.r, i, j)

    def _state(self, y: Array, history: Array, j: Index, place: Index | None = None) -> dict[int, Value]:
        """Return the values of y and of the history at a place; `place` if y is not stored by place."""
        e, place = self.equations, j if place is None else place
        state = {int(node): self._wide(y, i, j) for i, node in enumerate(e.y)}
        return state | {int(e.history[i]): self._wide(history, i, place) for i in e.used_history}

    def _acting_at(self, j: Index) -> dict[int, Value]:
        """Return which discontinuities act at the start of a piece."""
        return {int(node): self._wide(self.acting, i, j) for i, node in enumerate(self.equations.acting)}

    def _tip_state(self, y: Array, history: Array) -> dict[int, Value]:
        state = {
            int(node): self._get(y, i, tip)
            for tip, nodes in zip(self.tips, self.equations.strand_y, strict=True)
            for i, node in enumerate(nodes)
        }
        return state | self._history_of_strands(history, self.tips)

    def _history_of_strands(self, history: Array, points: Sequence[Any]) -> dict[int, Value]:
        """Return the values of the history of each strand at its point."""
        e = self.equations
        return {
            int(nodes[i]): self._get(history, i, point)
            for point, nodes in zip(points, e.strand_history, strict=True)
            for i in e.used_history
        }

    def _base_state(self, unknowns: Array, history: Array) -> dict[int, Value]:
        e = self.equations
        state = {int(node): self._get(unknowns, i) for i, node in enumerate(e.unknowns)}
        return state | self._history_of_strands(history, self.bases)

    def _norms(self, array: Array, count: Any, *weights: Array) -> list[Value]:
        """Return the largest component in natural units, and by further weights; infinite for NaN."""
        f, zero = self._now, self._now.splat(self._now.value(0.0), self.L)
        every = self.scale_y, *weights
        found, finite = [StackVariable(f, zero) for _ in every], StackVariable(f, zero)
        with self._places(count) as j:
            largest, totals = [zero for _ in every], [zero, zero]
            for i in range(array.size):
                size = f.apply("abs", self._wide(array, i, j))
                totals[i % 2] = totals[i % 2] + size
                for k, each in enumerate(every):
                    x = size * self._wide(each, i, j if each.count else 0)
                    largest[k] = f.select(x > largest[k], x, largest[k])
            inside = self._inside(j, count)
            for variable, value in zip(found, largest, strict=True):
                value = f.select(inside, value, 0.0)
                variable.set(f.select(value > variable.get(), value, variable.get()))
            finite.set(finite.get() + f.select(inside, totals[0] + totals[1], 0.0))
        # a comparison drops NaN; a sum keeps it
        known = f.compare("lt", finite.get(), math.inf)
        return [self._largest(f.select(known, each.get(), math.inf)) for each in found]

    def _unit(self, i: int, j: Index) -> Value:
        """Return 1 over the natural unit of a component of y at a point."""
        return self._wide(self.scale_y, i, j if self.strands > 1 else 0)

    def _tip_norm(self) -> Value:
        """Return the tip's largest residual in natural units; infinite for NaN."""
        f = self._now
        found = f.splat(f.value(0.0), self.P)
        for i in range(self.equations.k):
            size = f.apply("abs", self._get(self.tip, i)) * self._get(self.scale_tip, i)
            found = f.apply("max", found, size)
        return f.select(found < math.inf, found, math.inf)

    def _write_base(self, unknowns: Array, y: Array, history: Array) -> None:
        e = self.equations
        state = self._base_state(unknowns, history)
        for k, value in enumerate(self._evaluate(e.base, 0, False, state)):
            self._put(value, y, k % e.ny, self.bases[k // e.ny])
