"""Tangents and cotangents of solved motions and equilibria as machine code, by the implicit function theorem.

A solved step satisfies G(y, ξ; history, control, parameters) = 0. Its derivatives are evaluated once for a
step, with places in lanes. Its tangents are then a linear map (`linear`) of the tangents of its data, with
tangents in lanes. Cotangents pass through the transposed maps, from the last step to the first.
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.engine.codegen import Index, Value
from knode_cosserat.engine.elimination import EliminationCode
from knode_cosserat.engine.equations import Nonzeros, TangentEquations
from knode_cosserat.engine.linear import Add, Loop, Number, Operation, Scale, write
from knode_cosserat.engine.memory import Array
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.problem import FILLING
from knode_cosserat.solvers.settings import Settings


class SolvedSteps(NamedTuple):
    """Solved steps, all stages in turn, from which derivatives are evaluated."""

    parameters: Float[np.ndarray, " n"]
    #: coefficients and times
    table: Float[np.ndarray, "solves n"]
    controls: Float[np.ndarray, "solves c"]
    rows: Float[Any, "solves nodes x"]
    unknowns: Float[Any, "solves k"]
    #: history before the first step
    records: Float[Any, "memory used x"]
    rate: Float[Any, "used x"]


class _Tangents(NamedTuple):
    """Arrays of the tangents of a step, or of their cotangents."""

    #: the step's data: records and rate before it, control
    records: list[Array]
    rate: Array
    control: Array
    #: history terms; rates and strains, those at ends of pieces, y behind jumps and at stages, lengths,
    #: defects of pieces and tip, and y at the bases, at fixed y
    history: Array
    rates: Array
    far: Array
    ends: Array
    between: Array
    lengths: Array
    r: Array
    tip: Array
    base: Array
    #: y along the strands without the changes of the unknowns, and those of each strand's groups of pieces
    w: Array
    alpha: Array
    beta: Array
    #: the solution: y, the change of rates by it, the new records, row and unknowns
    y: Array
    change: Array
    newest: Array
    row: Array
    unknowns: Array


class _TangentCode(EliminationCode):
    """Code of the derivatives of a system's solved steps, by all data of a step.

    The system changes in its `moving` parameters, a mask for each of its leaves. Functions are written by
    subclasses, forward for many tangents side by side or transposed for one cotangent.
    """

    equations: TangentEquations
    transposed: bool
    has_entries = True

    def __init__(self, system: System, settings: Settings, moving: Sequence[np.ndarray]):
        self.settings = settings
        super().__init__(TangentEquations(system, moving, self.transposed, settings.space), False)
        e, a = self.equations, self._array
        ny, nx, numbers, k = e.ny, e.ny + e.nz, e.numbers, e.k
        memory = range(settings.memory)
        self.records, self.rate = [a(numbers, self.used) for _ in memory], a(numbers, self.used)
        # derivatives at all places
        self.z_by_y = a(len(e.z_by_y), self.used)
        self.places = {"rates": self.used, "far": self.pieces, "tip": 1, "base": 1}
        self.by_history = {name: a(len(e.by_history[name]), n) for name, n in self.places.items()}
        self.by_control = {name: a(len(e.by_control[name]), n) for name, n in self.places.items()}
        self.jumps += [
            (self.by_history["far"], _nodes(e.by_history["far"])),
            (self.by_control["far"], _nodes(e.by_control["far"])),
        ]
        #: stages of the pieces between strands
        self.idle = [first + tip for first in self.stages for tip in self.tips[:-1]]
        #: number of tangents side by side, and an array of them
        self.columns = 1 if self.transposed else self.L
        many = a if self.transposed else self._tangent_array
        whole, self._size = self._size, 0
        records, rate = [many(numbers, self.used, 1) for _ in memory], many(numbers, self.used, 1)
        self._reserve_state()
        self.state_size, self._size = self._size, whole
        groups = self.groups[1] * self.strands
        #: component of a packed row for each number of each strand's record
        self.packed = e.by_strand(np.arange(self.strands * numbers))
        self.tangents = _Tangents(
            records, rate, many(e.nc, 1), many(numbers, self.used), many(nx, self.used),
            many(ny, self.pieces), many(ny, self.pieces), many(ny, self.used - self.ends),
            many(1, self.pieces), many(ny, self.pieces), many(k, 1), many(ny * self.strands, 1),
            many(ny, self.points), many(self.own, groups + self.strands), many(self.own, groups),
            many(ny, self.points), many(ny, self.used), many(numbers, self.used),
            many(self.packed.size, len(self.grid.nodes)), many(k, 1),
        )  # fmt: skip
        #: the results of the equations at fixed y, by the names of their derivatives
        t = self.tangents
        self.results = {"rates": t.rates, "far": t.far, "tip": t.tip, "base": t.base}
        #: arrays of further values of the rates, and their nodes
        self.shared = list[tuple[Array, Any]]()
        self._reserve_products()
        self._write()
        self._functions = self.module.compile()

    def _reserve_state(self) -> None:
        """Reserve arrays that last from step to step, for each column."""

    def _reserve_products(self) -> None:
        """Reserve arrays of the products of derivatives by the system."""

    def _write(self) -> None:
        e = self.equations
        self._write_setup()
        self._write_terms()
        slopes = [
            (self.slope, e.nonzeros), (self.z_by_y, _nodes(e.z_by_y)),
            (self.by_history["rates"], _nodes(e.by_history["rates"])),
            (self.by_control["rates"], _nodes(e.by_control["rates"])),
        ]  # fmt: skip
        self.rates_and_slopes = self._write_rates("rates_and_slopes", slopes + self.shared)
        self.solved = self._write_solved()
        self._write_factor()
        self.advance = self._write_advance()
        self._write_along()
        self._write_linearise()
        self.defects = self._function("defects")
        self._write_defects(self.y, self.H)
        self._write_data()
        self._write_solution()
        self._write_derivatives()
        self._write_records()

    # a solved step

    def _write_data(self) -> None:
        """Inputs, history terms and unknowns of a step."""
        e = self.equations
        self.data = f = self._function("data", "coefficients", "control", "unknowns")
        _, coefficients, control, unknowns = f.arguments
        self._write_inputs(f.load(coefficients, 0), f.load(coefficients, self.settings.memory + 2), control)
        weights = [f.load(coefficients, k) for k in self._history_weights]
        for i, j in self._components(e.numbers, self.used):
            parts = [self._wide(each, i, j) for each in (*self.records, self.rate)]
            products = [weight * part for weight, part in zip(weights, parts, strict=False)]
            self._write_wide(sum(products[1:], products[0]), self.H, i, j)
        for i in range(e.k):
            self._put(f.load(unknowns, i), self.unknowns, i)

    @property
    def _history_weights(self) -> range:
        """Numbers of the coefficients of records and, if the scheme uses it, of the rate."""
        return range(1, 1 + self.settings.memory + self.settings.uses_rate)

    def _write_solution(self) -> None:
        """The solution y at all points, from its row at the nodes (see `StepProblem.filled`)."""
        e, grid = self.equations, self.grid
        self.solution = f = self._function("solution", "row")
        row = f.arguments[1]
        with f.loop(len(self.grid.nodes)) as node:
            at, here = f.pointer(row, node.value * self.packed.size), self._node(node)
            for q, i in np.ndindex(self.strands, e.ny):
                self._put(f.load(at, int(self.packed[q, i])), self.y, i, here + self.bases[q])
        if not len(grid.between):
            return
        for base, cut in itertools.product(self.bases, map(int, grid.between)):
            point = base + cut
            start, end = (base + int(grid.nodes[grid.segment[cut] + k]) for k in (0, 1))
            part = float(grid.bounds[cut, 0])
            for i in range(e.ny):
                low, high = self._get(self.y, i, start), self._get(self.y, i, end)
                self._put(low + part * (high - low), self.y, i, point)
        self._write_filling(FILLING * (int(np.max(np.diff(grid.nodes))) - 1), self.defects)

    def _write_derivatives(self) -> None:
        """The derivatives of a step at its solution."""
        e = self.equations
        self.derivatives = f = self._function("derivatives")
        f.call(self.linearised, f.arguments[0])
        for name, state in self._end_states():
            for array, nonzeros in (
                (self.by_history[name], e.by_history[name]), (self.by_control[name], e.by_control[name])
            ):  # fmt: skip
                for i, value in enumerate(self._evaluated(_nodes(nonzeros), 0, False, state)):
                    self._put(value, array, i)

    def _end_states(self) -> Sequence[tuple[str, dict[int, Value]]]:
        """Return the state at the tips and at the bases."""
        return ("tip", self._tip_state(self.y, self.H)), ("base", self._base_state(self.unknowns, self.H))

    def _write_records(self) -> None:
        """The records after a step."""
        self.shift = f = self._function("shift", "coefficients")
        c0 = f.load(f.arguments[1], 0)
        self._write_shift(self.records, self.used)
        for i, j, newest in self._numbers_of(self._evaluated_at(self.y), self.used):
            self._write_wide(newest, self.records[0], i, j)
            if self.settings.uses_rate:
                self._write_wide(c0 * newest + self._wide(self.H, i, j), self.rate, i, j)

    def _terms_known(self, nodes: Sequence[int], moves: Mapping[int, Any] | None = None) -> dict[int, Any]:
        """Write terms of a step, once for all places, and return their values with those of the inputs."""
        e = self.equations
        known = self._parameters(nodes) | dict(moves or {})
        for k, node in enumerate([e.c0.item(), e.t.item(), *e.control]):
            known[int(node)] = self._get(self.inputs, k)
        for node, first, _ in e.slots(e.step_terms):
            known[node] = self._term(node, self.step_terms, first, 0, self.P)
        return self._now.evaluate(e.program, nodes, known, 1)

    def _of_places(self, nodes: Any) -> Iterator[tuple[int, int]]:
        """Yield all places with their nodes, from the nodes of a strand's places."""
        yield from ((k, int(nodes[place])) for k, (_, place) in enumerate(self.origins[: self.used]))

    def _of_pieces(self, nodes: Any) -> Iterator[tuple[int, int]]:
        """Yield all pieces but the idle ones with their nodes, from the nodes of a strand's pieces."""
        yield from ((base + k, int(node)) for base in self.bases for k, node in enumerate(nodes))

    def _states_at(self, name: str) -> Iterator[tuple[Index, Value | bool, dict[int, Value]]]:
        """Write loops over places on which rates and strains, or y behind jumps, depend.

        Yields the place, which lanes are inside, and the values there.
        """
        far = self.y if self.far is None else self.far
        if name == "far":
            with self._places(self.pieces) as j:
                yield j, self._inside(j, self.pieces), self._state(self.y, self.H, j) | self._acting_at(j)
            return
        for y, first, count in ((far, 0, self.ends), (self.between, self.ends, self.used - self.ends)):
            if count:
                with self._places(count) as j:
                    place = {self.equations.s.item(): self._wide(self.s, 0, j + first)}
                    yield j + first, self._inside(j, count), self._state(y, self.H, j, j + first) | place

    # the linear map of a step

    def _by_data(self, name: str, j: Any, places: Sequence[Any]) -> list[Operation]:
        """Set results at fixed y, by the history at a place of each strand, and by the control."""
        e, t, target = self.equations, self.tangents, self.results[name]
        found: list[Operation] = [Scale(Number(target, i, j)) for i in range(target.size)]
        for nonzeros, matrix, source, at in (
            (e.by_history[name], self.by_history[name], t.history, places),
            (e.by_control[name], self.by_control[name], t.control, (0,)),
        ):
            for n, (i, c, _) in enumerate(nonzeros):
                strand, component = divmod(c, source.size)
                number = Number(source, component, at[strand])
                found.append(Add(Number(target, i, j), number, Number(matrix, n, j)))
        return found

    def _at_fixed_y(self, coefficients: Value) -> list[Operation]:
        """Return the map from the data to the results at fixed y; the system does not change."""
        t, f = self.tangents, self._now
        weights = [f.load(coefficients, k) for k in self._history_weights]

        def at_place(j: Index) -> list[Operation]:
            found = list[Operation]()
            for i in range(t.history.size):
                found.append(Scale(Number(t.history, i, j)))
                for part, weight in zip((*t.records, t.rate), weights, strict=False):
                    found.append(Add(Number(t.history, i, j), Number(part, i, j), weight))
            return found + self._by_data("rates", j, [j])

        def behind(j: Index) -> list[Operation]:
            return [Scale(Number(t.lengths, 0, j)), *self._by_data("far", j, [j])]

        return [
            Loop(0, self.used, at_place), Loop(0, self.pieces, behind),
            *self._by_data("tip", 0, self.tips), *self._by_data("base", 0, self.bases),
        ]  # fmt: skip

    def _solution_and_records(self, coefficients: Value) -> list[Operation]:
        """Return the map from the results at fixed y to the solution, and to the records after the step."""
        e, t, formula = self.equations, self.tangents, self.space.formula
        near = [(self.points + k, point) for k, point in enumerate(self.near)]
        stages = list(zip(formula.stages, self.stages, strict=True))

        def slopes_by(target: tuple[Array, Any], source: Any, place: Any) -> list[Operation]:
            """Add the product of the rates' derivatives at a place with numbers."""
            return [
                Add(Number(target[0], i, target[1]), source(c), Number(self.slope, n, place))
                for n, (i, c) in enumerate(e.pattern)
            ]

        def at_ends(rates: Array) -> list[Operation]:
            """Copy rates to the ends of pieces."""
            found: list[Operation] = [
                Loop(0, self.pieces, lambda j: _copies(e.ny, (t.ends, j), (rates, j + 1)))
            ]
            for place, point in near:
                found += _copies(e.ny, (t.ends, point - 1), (rates, place))
            return found

        def increment(weights: Sequence[float], target: Any, rates: Array, j: Index) -> list[Operation]:
            """Add h times the weighted sum of a piece's rates: at its start, its end and its stages."""
            h, found = self._get(self.h, 0, j), list[Operation]()
            places = (rates, j), (t.ends, j), *((rates, j + first) for first in self.stages)
            for weight, (array, place) in zip(weights, places, strict=False):
                if weight:
                    own = h * weight
                    found += [Add(target(i), Number(array, i, place), own) for i in range(e.ny)]
            return found

        def by_length(weights: Sequence[float], target: Any, j: Index) -> list[Operation]:
            """Add the weighted sum of a piece's rates times the tangent of its length."""
            places = self._places_of((self.f, self.fe), j)
            found = list[Operation]()
            for i in range(e.ny):
                parts = [
                    weight * self._get(array, i, place)
                    for weight, (array, place) in zip(weights, places, strict=False)
                    if weight
                ]
                if parts:
                    rate = functools.reduce(operator.add, parts)
                    found.append(Add(target(i), Number(t.lengths, 0, j), rate))
            return found

        def moved(j: Index) -> list[Operation]:
            return slopes_by((t.rates, j), lambda c: Number(t.far, c, j), j)

        def between(k: int, j: Index) -> list[Operation]:
            """Set y at a stage at fixed y, and add its part of the rates there."""
            (stage, first), at = stages[k], j + k * self.pieces
            own = [Number(t.between, i, at) for i in range(e.ny)]
            found: list[Operation] = [Scale(number) for number in own]
            if self.far is not None:
                found += [Add(own[i], Number(t.far, i, j), 1.0 - stage.end) for i in range(e.ny)]
            found += by_length(stage.rates, own.__getitem__, j)
            found += increment(stage.rates, own.__getitem__, t.rates, j)
            return found + slopes_by((t.rates, j + first), own.__getitem__, j + first)

        def defect(j: Index) -> list[Operation]:
            r = [Number(t.r, i, j) for i in range(e.ny)]
            found: list[Operation] = [Scale(number) for number in r]
            found += [Add(r[i], Number(t.far, i, j)) for i in range(e.ny)]
            found += by_length(formula.weights, r.__getitem__, j)
            return found + increment(formula.weights, r.__getitem__, t.rates, j)

        found: list[Operation] = [Loop(0, self.pieces, moved)] if e.jumping else []
        found += at_ends(t.rates)
        found += [Loop(0, self.pieces, functools.partial(between, k)) for k in range(len(stages))]
        found.append(Loop(0, self.pieces, defect))
        found += self._correction()

        def jumped(j: Index) -> list[Operation]:
            own = [(i, c, 0) for i, c, _ in e.jumping]
            return _products(own, (self.jump, j), (t.newest, j), (t.y, j))

        def changed(j: Index) -> list[Operation]:
            """Set the change of rates at ends of pieces by y."""
            found: list[Operation] = [Scale(Number(t.change, i, j)) for i in range(e.ny)]
            return found + slopes_by((t.change, j), lambda c: Number(t.newest, c, j), j)

        def solved_between(k: int, j: Index) -> list[Operation]:
            """Add the change of y at a stage, and set that of the rates there."""
            (stage, first), at = stages[k], j + k * self.pieces
            own = [Number(None, i) for i in range(e.ny)]
            found = list[Operation]()
            for i in range(e.ny):
                found.append(Add(own[i], Number(t.newest, i, j), 1.0 - stage.end))
                found.append(Add(own[i], Number(t.y, i, j + 1), stage.end))
            found += increment(stage.rates, own.__getitem__, t.change, j)
            found += [Scale(Number(t.change, i, j + first)) for i in range(e.ny)]
            found += slopes_by((t.change, j + first), own.__getitem__, j + first)
            found += [Add(Number(t.between, i, at), own[i]) for i in range(e.ny)]
            return found + _copies(e.ny, (t.newest, j + first), (t.between, at))

        found.append(Loop(0, self.points, lambda j: _copies(e.ny, (t.newest, j), (t.y, j))))
        if e.jumping:
            found.append(Loop(0, self.pieces, jumped))
        for place, point in near:
            found += _copies(e.ny, (t.newest, place), (t.y, point))
        if stages or self.equations.system.mixed:
            found += [Loop(0, self.ends, changed), *at_ends(t.change)]
            found += [Loop(0, self.pieces, functools.partial(solved_between, k)) for k in range(len(stages))]
        if self.far is not None:
            found.append(
                Loop(
                    0, self.pieces,
                    lambda j: [Add(Number(t.newest, i, j), Number(t.far, i, j)) for i in range(e.ny)],
                )
            )  # fmt: skip
        c0 = self._now.load(coefficients, 0)

        def recorded(j: Index) -> list[Operation]:
            found = _copies(e.nz, (t.newest, j), (t.rates, j), e.ny)
            strains = [(e.ny + i, c, node) for i, c, node in e.z_by_y]
            found += _products(strains, (self.z_by_y, j), (t.newest, j), (t.newest, j))
            for i in range(e.numbers - e.ny - e.nz):
                rate = Number(t.newest, e.ny + e.nz + i, j)
                found += [Scale(rate), Add(rate, Number(t.rates, i, j)), Add(rate, Number(t.change, i, j))]
            if self.settings.uses_rate:
                found += _copies(e.numbers, (t.rate, j), (t.history, j))
                for i in range(e.numbers):
                    found.append(Add(Number(t.rate, i, j), Number(t.newest, i, j), c0))
            for newer, older in reversed(list(itertools.pairwise(t.records))):
                found += _copies(e.numbers, (older, j), (newer, j))
            return found + _copies(e.numbers, (t.records[0], j), (t.newest, j))

        def shown(node: Index) -> list[Operation]:
            point = self._node(node)
            return _set(
                (
                    Number(t.row, int(component), node),
                    Number(t.y if i < e.ny else t.newest, i, point + self.bases[q]),
                )
                for (q, i), component in np.ndenumerate(self.packed)
            )

        found += [Loop(0, self.used, recorded), Loop(0, len(self.grid.nodes), shown)]
        return found + _set(
            (Number(t.unknowns, c), Number(t.alpha, c % self.own, c // self.own * (self.groups[1] + 1)))
            for c in range(e.k)
        )

    def _correction(self) -> list[Operation]:
        """Return the map from the defects of pieces and tip, and y at the bases, to y and the unknowns."""
        e, t, el = self.equations, self.tangents, self.elimination
        ny, k, own, (size, count) = e.ny, e.k, self.own, self.groups
        stored = {int(node): n for n, node in enumerate(el.stored)}
        entries = {at: n for n, at in enumerate(el.entries)}

        def piece(j: Index) -> list[Operation]:
            end, found = [Number(t.w, i, j + 1) for i in range(ny)], list[Operation]()
            for i in range(ny):
                found += [Scale(end[i]), Add(end[i], Number(t.r, i, j))]
            for i, c in zip(*np.nonzero(el.matrix != el.program.constant(0.0)), strict=True):
                entry: Any = el.program.values[int(el.matrix[i, c])]
                if (i, c) in entries:
                    entry = Number(self.entries, entries[i, c], j)
                found.append(Add(end[i], Number(t.w, int(c), j), entry))
            for i, c, node in el.substitution:
                factor = Number(self.factor, stored[node], j) if node in stored else el.program.values[node]
                found.append(
                    Scale(end[i], factor) if i == c else Add(end[i], end[c], factor, is_negative=True)
                )
            return found

        def by_unknowns(target: Array, j: Any, source: Array, g: Any, is_negative: bool) -> list[Operation]:
            found = list[Operation]()
            for i, c in np.ndindex(ny, own):
                entry = self._entry_at(self.X, ny, i, c, j)
                found.append(Add(Number(target, i, j), Number(source, c, g), entry, is_negative))
            return found

        def group(strand: Index, g: Index) -> list[Operation]:
            first = strand.value * self.strand_points + g.value * size
            last, group = self._now.index(first + size), self._now.index(strand.value * count + g.value)
            pivots = ((Number(t.beta, c, group), Number(t.w, p, last)) for c, p in enumerate(self.pivots))
            return [
                Loop(first, last.value, piece), *_set(pivots), *by_unknowns(t.w, last, t.beta, group, True)
            ]  # fmt: skip

        def solved(g: Any, j: Any) -> list[Operation]:
            return [*_copies(ny, (t.y, j), (t.w, j)), *by_unknowns(t.y, j, t.alpha, g, False)]

        def group_back(strand: Index, g: Index) -> list[Operation]:
            first = strand.value * self.strand_points + g.value * size
            end, group = self._now.index(first + size), self._now.index(strand.value * count + g.value)
            # a strand has one more alpha
            alpha = self._now.index(group.value + strand.value)
            found = solved(alpha + 1, end)
            for c in range(own):
                found += [
                    Scale(Number(t.alpha, c, alpha)),
                    Add(Number(t.beta, c, group), Number(t.alpha, c, alpha + 1), is_negative=True),
                ]
            for i, c in np.ndindex(own, own):
                entry = self._entry_at(self.T, own, i, c, group)
                found.append(
                    Add(Number(t.alpha, i, alpha), Number(t.beta, c, group), entry, is_negative=True)
                )
            return [*found, Loop(first + 1, end.value, functools.partial(solved, alpha))]

        def strand_ahead(strand: Index) -> list[Operation]:
            base = strand.value * self.strand_points
            return [
                Loop(0, count, functools.partial(group, strand)),
                Loop(base + count * size, base + self.grid.tip, piece),
            ]

        def strand_back(strand: Index) -> list[Operation]:
            base = self._now.index(strand.value * self.strand_points)
            first = self._now.index(strand.value * (count + 1))
            return [
                Loop(
                    base.value + (count * size + 1), base.value + self.strand_points,
                    functools.partial(solved, first + count),
                ),
                Loop(0, count, functools.partial(group_back, strand), descends=True), *solved(first, base),
            ]  # fmt: skip

        bases = ((Number(t.w, i % ny, self.bases[i // ny]), Number(t.base, i)) for i in range(t.base.size))
        at_tip = list[Operation]()
        for i, c, _ in self.tip_slopes:
            strand, component = divmod(c, ny)
            entry = self._entry_at(self.M, k, i, component, strand)
            at_tip.append(Add(Number(t.tip, i), Number(t.w, component, self.tips[strand]), entry))
        alpha = [Number(t.alpha, i % own, i // own * (count + 1) + count) for i in range(k)]
        at_tip += map(Scale, alpha)
        for i, c in np.ndindex(k, k):
            entry = self._entry_at(self.inverse, k, i, c)
            at_tip.append(Add(alpha[i], Number(t.tip, c), entry, is_negative=True))
        return [
            *_set(bases), Loop(0, self.strands, strand_ahead), *at_tip, Loop(0, self.strands, strand_back)
        ]  # fmt: skip

    def _entry_at(self, matrix: Array, rows: int, i: int, c: int, j: Any = 0) -> Number:
        """Return an entry of a matrix with rows in lanes."""
        return Number(matrix, c * self._padded(rows) + i, j)

    # running

    def _data_of(self, step: Index, coefficients: Value, *data: Value) -> list[Value]:
        """Return the addresses of a step's coefficients, and of its control, row and unknowns."""
        f, e = self._now, self.equations
        sizes = e.nc, self._row_size, e.k
        found = [f.pointer(each, step.value * size) for each, size in zip(data, sizes, strict=True)]
        return [f.pointer(coefficients, step.value * (self.settings.memory + 3)), *found]

    @property
    def _row_size(self) -> int:
        return len(self.grid.nodes) * self.packed.size

    def _begun(self, solved: SolvedSteps) -> list[np.ndarray]:
        """Return the memory before a run, controls, coefficients, rows and unknowns."""
        memory = self._empty_memory()
        self._put_in(memory[None], self.params, solved.parameters[None, None, None])
        for array, values in zip((*self.records, self.rate), (*solved.records, solved.rate), strict=True):
            self._put_in(memory[None], array, self._by_strand(array, np.asarray(values, float))[None, None])
        rows = np.asarray(solved.rows)[..., : self.packed.size]
        data = solved.controls, solved.table, rows, solved.unknowns
        return [memory, *(np.ascontiguousarray(each, float) for each in data)]


class TangentCore(_TangentCode):
    """Machine code of the tangents of solved steps, as many side by side as there are lanes."""

    transposed = False

    def _reserve_state(self) -> None:
        #: added to the residual of the tip's conditions
        self.added_tip = self._tangent_array(self.equations.k, 1, 1)

    def _reserve_products(self) -> None:
        e, a = self.equations, self._array
        self.common = a(len(e.common), self.used)
        self.shared.append((self.common, e.common))
        whole, self._size = self._size, 0
        # of one direction of the system
        self.dparameters = a(len(e.dparameters), memory=1)
        self.ds, self.dh = a(1, self.used, 1), a(1, self.pieces, 1)
        self.moved = {name: a(len(nodes), self.places[name], 1) for name, nodes in e.moved.items()}
        self.direction_size, self._size = self._size, whole

    def _write(self) -> None:
        super()._write()
        self._write_direction()
        self._write_tangents()
        self._write_run()

    def _write_direction(self) -> None:
        """Tangents of rates, strains, jumps, tip and base by one direction of the system, at fixed y."""
        e = self.equations
        self.direction = self._function("direction", "direction")
        every = [*e.moved_terms, *e.dplaces, *e.dlengths]
        moves = self._inputs_of(self.dparameters, [e.dparameters], every)
        values = self._terms_known(every, moves)
        for array, nodes in ((self.ds, self._of_places(e.dplaces)), (self.dh, self._of_pieces(e.dlengths))):
            for k, node in nodes:
                self._put(values[node], array, 0, k)
        known = {node: values[node] for node in e.moved_terms} | moves
        for name in ("rates", "far"):
            for j, _, here in self._states_at(name) if e.moved[name] else ():
                here |= known
                if name == "rates":
                    here |= {node: self._wide(self.common, i, j) for i, node in enumerate(e.common)}
                    here[e.ds.item()] = self._wide(self.ds, 0, j)
                self._write_results([(self.moved[name], e.moved[name])], j, here)
        for name, here in self._end_states():
            for i, value in enumerate(self._evaluated(e.moved[name], 0, False, here | known)):
                self._put(value, self.moved[name], i)

    def _write_tangents(self) -> None:
        """Tangents of the step, of as many columns as there are lanes."""
        e, L, t = self.equations, self.L, self.tangents
        arguments = ["state", "directions", "weights", "d_control", "coefficients", "row", "unknowns"]
        self.step = f = self._function("step", *arguments, "n_directions", "n_columns")
        _, _, directions, weights, d_control, coefficients, row, d_unknowns, count, width = f.arguments
        for i in range(e.nc):
            self._put(f.load(d_control, width * i, L), t.control, i, 0, L)
        at_tip = [Add(Number(t.tip, i), Number(self.added_tip, i)) for i in range(e.k)]
        write(self, [*self._at_fixed_y(coefficients), *at_tip], L, False)
        with f.loop(count) as d:
            own = f.pointer(directions, d.value * self.direction_size)
            weight = f.load(weights, d.value * width, L)
            with f.if_(f.any(f.apply("abs", weight) > 0.0)):
                for source, target in (
                    *((self.moved[name], target) for name, target in self.results.items()),
                    (self.dh, t.lengths),
                ):
                    with f.loop(source.count) as j:
                        for i in range(source.size):
                            number = f.load(j.address(own, source.place), source.at(i, 0))
                            self._put(self._get(target, i, j, L) + weight * number, target, i, j, L)
        write(self, self._solution_and_records(coefficients), L, False)
        with f.loop(len(self.grid.nodes)) as node:
            at = f.pointer(row, node.value * width * t.row.size)
            for i in range(t.row.size):
                f.store(self._get(t.row, i, node, L), at, width * i, L)
        for i in range(e.k):
            f.store(self._get(t.unknowns, i, 0, L), d_unknowns, width * i, L)

    def _write_run(self) -> None:
        """All solved steps in turn; tangents have `n_columns` columns, a multiple of the lanes."""
        e, L = self.equations, self.L
        names = ["memory", "controls", "coefficients", "rows", "unknowns", "directions", "states", "weights"]
        names += ["d_controls", "d_rows", "d_unknowns", "n_steps", "n_directions", "n_columns"]
        f = self._now = self.module.function("run", names, exported=True)
        memory, controls, coefficients, rows, unknowns, directions, states, weights = f.arguments[:8]
        d_controls, d_rows, d_unknowns, steps, count, width = f.arguments[8:]
        f.call(self.setup, memory)
        with f.loop(steps) as step:
            table, control, row, unknown = self._data_of(step, coefficients, controls, rows, unknowns)
            f.call(self.data, memory, table, control, unknown)
            f.call(self.solution, memory, row)
            f.call(self.derivatives, memory)
            with f.loop(count) as d:
                f.call(self.direction, memory, f.pointer(directions, d.value * self.direction_size))
            own = f.pointer(d_controls, step.value * width * e.nc)
            d_row = f.pointer(d_rows, step.value * width * self._row_size)
            d_unknown = f.pointer(d_unknowns, step.value * width * e.k)
            with f.loop(width, 0, L) as first:
                parts = (f.pointer(each, first.value) for each in (weights, own, d_row, d_unknown))
                own_weights, own_control, own_row, own_unknowns = parts
                state = f.pointer(states, first.value * (self.state_size // L))
                f.call(
                    self.step, memory, state, directions, own_weights, own_control, table, own_row,
                    own_unknowns, count, width,
                )  # fmt: skip
            f.call(self.shift, memory, table)

    def solve(
        self, solved: SolvedSteps, moves: tuple[Any, Any], d_controls: Any, d_states: Any, d_tip: Any = 0.0
    ) -> tuple[Any, Any]:
        """Return states, and the tangents of solved rows (solves, nodes, x, m) and unknowns (solves, k, m).

        `moves` are directions of the moving parameters (d, n) and weights (d, m); `d_states` are the tangents
        of records and rate before the first step, with one more axis (m). `d_tip` (k, m) is added to the
        tangents of the tip's residual. The states returned are those after the last step: records, rate, and
        their tangents.
        """
        e, L, (d_records, d_rate) = self.equations, self.L, d_states
        (directions, weights), count = moves, len(solved.controls)
        m, nodes, places = d_controls.shape[-1], len(self.grid.nodes), len(solved.rate)
        blocks = -(-m // L)

        def filled(values: Any) -> np.ndarray:
            """Return tangents with columns of zeros, so that their number is a multiple of the lanes."""
            found = np.zeros((*np.shape(values)[:-1], blocks * L))
            found[..., :m] = values
            return found

        begun = self._begun(solved)
        memory = begun[0]
        moved = np.zeros((len(directions), self.direction_size))
        if directions.size:
            self._put_in(moved, self.dparameters, directions[:, None, None])
        tangents = np.zeros((blocks, self.state_size))
        parts = (*self.tangents.records, self.tangents.rate)
        for array, values in zip(parts, (*d_records, d_rate), strict=True):
            columns = filled(values).reshape(places, -1, blocks, L)
            self._put_in(tangents, array, self._by_strand(array, np.moveaxis(columns, (2, 3), (0, 1))))
        added = filled(np.broadcast_to(d_tip, (e.k, m))).reshape(1, -1, blocks, L)
        self._put_in(tangents, self.added_tip, np.moveaxis(added, (2, 3), (0, 1)))
        shapes = (nodes, self.packed.size), (e.k,)
        d_rows, d_unknowns = (np.empty((count, *shape, blocks * L)) for shape in shapes)
        arrays = *begun, moved, tangents, filled(weights), filled(d_controls), d_rows, d_unknowns
        self._functions["run"](*(each.ctypes.data for each in arrays), count, len(directions), blocks * L)
        after, moved_after = (
            [self._joined(each, self._numbers(numbers, each), places) for each in arrays]
            for numbers, arrays in ((memory[None], (*self.records, self.rate)), (tangents, parts))
        )
        after = [each[0, 0] for each in after]
        moved_after = [
            np.moveaxis(each, (0, 1), (2, 3)).reshape(places, -1, blocks * L)[..., :m] for each in moved_after
        ]
        found = np.stack(after[:-1]), after[-1], np.stack(moved_after[:-1]), moved_after[-1]
        return found, (d_rows[..., :m], d_unknowns[..., :m])


class CotangentCore(_TangentCode):
    """Machine code of the cotangents of solved steps, one after the other."""

    transposed = True

    def _reserve_state(self) -> None:
        e, a = self.equations, self._array
        #: cotangents of the moving parameters, of places, and of lengths of pieces
        self.parameter, self.place = a(len(e.by_terms) - len(e.moving_arrays), memory=1), a(1, self.used, 1)
        self.length_of_piece = a(1, self.pieces, 1)

    def _reserve_products(self) -> None:
        #: cotangents of the terms of a step, for each lane of places
        self.term = self._tangent_array(len(self.equations.moving_terms), 1)

    def _write(self) -> None:
        super()._write()
        self.rates = self._write_rates("rates")
        self._write_recorded()
        self._write_products()
        self._write_geometry()
        self._write_cotangents()
        self._write_run()

    def _write_recorded(self) -> None:
        """Rates and strains at all ends of pieces."""
        self.recorded = self._function("recorded")
        self._write_places(self.rates, self.y, self.H)

    def _write_products(self) -> None:
        """Add the cotangents of parameters, places and lengths, from those of the results at fixed y."""
        e, t = self.equations, self.tangents
        self.pulled = f = self._function("pulled", "state")
        terms = self._terms_known(e.pulled_terms)
        known = {node: terms[node] for node in e.pulled_terms}
        count, zero = len(e.moving_terms), f.splat(f.value(0.0), self.L)
        for k in range(count):
            self._put(zero, self.term, k, 0, self.L)
        for name in ("rates", "far"):
            if not self.results[name].size or not e.cotangents[name].size:
                continue
            for j, inside, here in self._states_at(name):
                here |= known
                for i, node in enumerate(e.cotangents[name]):
                    here[int(node)] = self._wide(self.results[name], i, j)
                nodes, added = self._parted(e.pulled[name])
                *values, place = self._evaluated(nodes, j, True, here, (added, inside))
                for k, value in enumerate(values):
                    own = f.select(inside, f.splat(value, self.L), 0.0)
                    self._put(self._get(self.term, k, 0, self.L) + own, self.term, k, 0, self.L)
                if name == "rates":
                    own = f.select(inside, f.splat(place, self.L), 0.0)
                    self._write_wide(self._wide(self.place, 0, j) + own, self.place, 0, j)
        sums = [f.total(self._get(self.term, k, 0, self.L)) for k in range(count)]
        for name, here in self._end_states():
            for i, node in enumerate(e.cotangents[name]):
                here[int(node)] = self._get(self.results[name], i)
            nodes, added = self._parted(e.pulled[name])
            values = self._evaluated(nodes, 0, False, here | known, (added, True))
            sums = [a + b for a, b in zip(sums, values, strict=False)]
        given = self._parameters(e.by_terms) | terms
        given |= {int(node): each for node, each in zip(e.of_terms, sums, strict=True)}
        self._add_parameters(e.by_terms, given)
        with self._places(self.pieces) as j:
            total = self._wide(self.length_of_piece, 0, j) + self._wide(t.lengths, 0, j)
            self._write_wide(total, self.length_of_piece, 0, j)

    def _write_geometry(self) -> None:
        """Add the cotangents of parameters from those of places and lengths: once a run."""
        e = self.equations
        self.by_geometry = self._function("by_geometry", "state")
        known = self._parameters(e.by_geometry)
        for nodes, array in (
            (self._of_places(e.of_places), self.place), (self._of_pieces(e.of_lengths), self.length_of_piece)
        ):  # fmt: skip
            for k, node in nodes:
                value = self._get(array, 0, k)
                known[node] = known[node] + value if node in known else value
        self._add_parameters(e.by_geometry, known)

    def _parted(self, cotangents: Sequence[int]) -> tuple[list[int], list[tuple[int, Value]]]:
        """Return the cotangents of scalars, and those of moving arrays with the addresses of their sums."""
        arrays, zero = self.equations.moving_arrays, self.equations.program.constant(0.0)
        first = len(cotangents) - len(arrays)
        added = [
            (node, self._now.pointer(*self._at(self.parameter, k, 0)))
            for k, node in zip(arrays.values(), cotangents[first:], strict=True)
            if node != zero
        ]
        return list(cotangents[:first]), added

    def _add_parameters(self, cotangents: Sequence[int], known: dict[int, Any]) -> None:
        """Add cotangents of the moving parameters to those known."""
        (nodes, added), program = self._parted(cotangents), self.equations.program
        moving = {k: node for k, node in enumerate(nodes) if not program.is_constant(node, 0.0)}
        values = self._now.evaluate(program, [*moving.values()], known, 1, (added, True))
        for k, node in moving.items():
            self._put(self._get(self.parameter, k) + values[node], self.parameter, k)

    def _write_cotangents(self) -> None:
        """Cotangents of a step's data from those of its results."""
        e, t = self.equations, self.tangents
        self.step = f = self._function(
            "step", "state", "coefficients", "control", "row", "unknowns", "n_columns"
        )
        memory, state, coefficients, control, row, unknowns, width = f.arguments
        with f.loop(len(self.grid.nodes)) as node:
            at = f.pointer(row, node.value * width * t.row.size)
            for i in range(t.row.size):
                self._put(f.load(at, width * i), t.row, i, node)
        for i in range(e.k):
            self._put(f.load(unknowns, width * i), t.unknowns, i)
        write(self, self._solution_and_records(coefficients), 1, True)
        if e.by_terms:
            f.call(self.pulled, memory, state)
        write(self, self._at_fixed_y(coefficients), 1, True)
        for i in range(e.nc):
            f.store(self._get(t.control, i), control, width * i)
            self._put(0.0, t.control, i)

    def _write_run(self) -> None:
        """All solved steps in turn, which keeps what each starts from; then their cotangents in reverse."""
        e = self.equations
        names = ["memory", "controls", "coefficients", "rows", "unknowns", "kept", "states"]
        names += ["d_controls", "d_rows", "d_unknowns", "n_steps", "n_columns"]
        f = self._now = self.module.function("run", names, exported=True)
        memory, controls, coefficients, rows, unknowns, kept, states = f.arguments[:7]
        d_controls, d_rows, d_unknowns, steps, width = f.arguments[7:]

        def copy(step: Index, forth: bool) -> None:
            """Keep the arrays that a step starts from, or restore them."""
            at = 0
            for array in self._kept:
                inside = f.pointer(memory, array.offset)
                outside = f.pointer(kept, step.value * self._kept_size + at)
                source, target = (inside, outside) if forth else (outside, inside)
                with f.loop(self._length_of(array), 0, self.L) as k:
                    f.store(f.load(source, k.value, self.L), target, k.value)
                at += self._length_of(array)

        f.call(self.setup, memory)
        with f.loop(steps) as step:
            table, control, row, unknown = self._data_of(step, coefficients, controls, rows, unknowns)
            f.call(self.data, memory, table, control, unknown)
            f.call(self.solution, memory, row)
            copy(step, True)
            f.call(self.recorded, memory)
            f.call(self.shift, memory, table)
        with f.loop(0, steps - 1, -1) as step:
            table, control, row, unknown = self._data_of(step, coefficients, controls, rows, unknowns)
            copy(step, False)
            f.call(self.data, memory, table, control, unknown)
            f.call(self.derivatives, memory)
            own = f.pointer(d_controls, step.value * width * e.nc)
            d_row = f.pointer(d_rows, step.value * width * self._row_size)
            d_unknown = f.pointer(d_unknowns, step.value * width * e.k)
            with f.loop(width) as column:
                parts = (f.pointer(each, column.value) for each in (own, d_row, d_unknown))
                state = f.pointer(states, column.value * self.state_size)
                f.call(self.step, memory, state, table, *parts, width)
        if e.by_terms:
            with f.loop(width) as column:
                f.call(self.by_geometry, memory, f.pointer(states, column.value * self.state_size))

    @property
    def _kept(self) -> Sequence[Array]:
        """Arrays from which the derivatives of a step are evaluated."""
        return self.y, *self.records, self.rate

    def _length_of(self, array: Array) -> int:
        return array.size * array.component

    @property
    def _kept_size(self) -> int:
        return sum(map(self._length_of, self._kept))

    def solve(self, solved: SolvedSteps, cotangents: Any) -> tuple[Any, Any, Any, Any]:
        """Return the cotangents of moving parameters (n, m), controls (solves, c, m), records and rate.

        `cotangents` are those of rows (solves, nodes, x, m) and unknowns (solves, k, m), and of records and
        rate after the last step.
        """
        begun, count = self._begun(solved), len(solved.controls)
        d_rows, d_unknowns, d_records, d_rate = (np.ascontiguousarray(each, float) for each in cotangents)
        m, parts = d_rate.shape[-1], (*self.tangents.records, self.tangents.rate)
        state = np.zeros((m, self.state_size))
        for array, values in zip(parts, (*d_records, d_rate), strict=True):
            self._put_in(state, array, self._by_strand(array, np.moveaxis(values, -1, 0))[:, None])
            # idle pieces have no results
            for place in self.idle:
                self._numbers(state, array)[:, :, place] = 0.0
        d_controls = np.empty((count, self.equations.nc, m))
        kept = np.empty((count, self._kept_size))
        arrays = *begun, kept, state, d_controls, d_rows, d_unknowns
        self._functions["run"](*(each.ctypes.data for each in arrays), count, m)
        joined = [self._joined(each, self._numbers(state, each)[:, 0], len(d_rate)) for each in parts]
        before = [np.moveaxis(each, 0, -1) for each in joined]
        return self._numbers(state, self.parameter)[:, 0, 0].T, d_controls, np.stack(before[:-1]), before[-1]


def _nodes(nonzeros: Nonzeros) -> list[int]:
    return [node for *_, node in nonzeros]


def _products(
    nonzeros: Nonzeros, matrix: tuple[Array, Any], target: tuple[Array, Any], source: tuple[Array, Any]
) -> list[Operation]:
    """Add the product of a sparse matrix with a vector; each has an array and a place."""
    return [
        Add(Number(target[0], i, target[1]), Number(source[0], c, source[1]), Number(matrix[0], n, matrix[1]))
        for n, (i, c, _) in enumerate(nonzeros)
    ]


def _copies(
    size: int, target: tuple[Array, Any], source: tuple[Array, Any], first: int = 0
) -> list[Operation]:
    """Copy components from `first` on; each has an array and a place."""
    return _set(
        (Number(target[0], i, target[1]), Number(source[0], i, source[1])) for i in range(first, first + size)
    )


def _set(pairs: Iterable[tuple[Number, Number]]) -> list[Operation]:
    """Set the first number of each pair to the second."""
    found = list[Operation]()
    for target, source in pairs:
        found += [Scale(target), Add(target, source)]
    return found
