"""Tangents and cotangents of solved motions and equilibria as machine code, by the implicit function theorem.

A solved step satisfies G(y, ξ; history, control, parameters) = 0. Its derivatives are evaluated once for a
step, with places in lanes. Its tangents are then a linear map (`linear`) of the tangents of its data, with
tangents in lanes. Cotangents pass through the transposed maps, from the last step to the first.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.engine.codegen import Index, StackVariable, Value
from knode_cosserat.engine.linear import Add, Columns, Entry, write
from knode_cosserat.engine.memory import Array, aligned_zeros
from knode_cosserat.engine.program import Nonzeros
from knode_cosserat.engine.step_map import COLUMNS, STATE, StepMap
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.settings import Settings


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


class _TangentCode(StepMap):
    """Code of the derivatives of a system's solved steps, by all data of a step.

    The system changes in its `moving` parameters, a mask for each of its leaves. Functions are written by
    subclasses, forward for many tangents side by side or transposed for one cotangent.
    """

    transposed: bool

    def __init__(self, system: System, settings: Settings, moving: Sequence[np.ndarray]):
        super().__init__(system, settings, moving, self.transposed)
        e, a = self.equations, self._array
        for arrays, nonzeros in (self.by_history, e.by_history), (self.by_control, e.by_control):
            self.jumps.append((arrays["far"], _nodes(nonzeros["far"])))
        # the solved motion
        self.records = [a(e.numbers, "used") for _ in range(settings.memory)]
        self.rate = a(e.numbers, "used")
        #: arrays of further values of the rates, and their nodes
        self.shared = list[tuple[Array, Any]]()
        self._reserve_products()
        self._write()
        self._functions = self._compiled()

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
        self._write_factor()
        self._write_along()
        self._write_linearise()
        if self.transposed or self.near:
            self.rates = self._write_rates("rates")
        if self.near:
            self.solve_piece = self._write_piece_solution()
            self.slopes = self._write_rates("slopes", [(self.slope, e.nonzeros)])
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
        for i, j in self._components(e.numbers, self._count("used")):
            parts = [self._wide(each, i, j) for each in (*self.records, self.rate)]
            products = [weight * part for weight, part in zip(weights, parts, strict=False)]
            self._write_wide(sum(products[1:], products[0]), self.H, i, j)
        for i in range(e.k):
            self._put(f.load(unknowns, i), self.unknowns, i)

    def _write_solution(self) -> None:
        """The solution y at all points, from its row at the nodes (see `StepProblem.filled`)."""
        e = self.equations
        self.solution = f = self._function("solution", "row")
        memory, row = f.arguments
        with f.loop(self._count("nodes")) as node:
            at, here = f.pointer(row, node.value * self.packed.size), self._node(node)
            for q, i in np.ndindex(self.strands, e.ny):
                self._put(f.load(at, int(self.packed[q, i])), self.y, i, self._of_strand(q, here))
        if not self.near:
            return
        with f.loop(self._count("filled")) as cut:
            point, start, end = (self._from_table(self.filled.offset + k, cut.value * 3) for k in range(3))
            part = f.load(f.pointer(memory, self.filled_parts.offset), cut.value)
            for i in range(e.ny):
                low, high = self._get(self.y, i, start), self._get(self.y, i, end)
                self._put(low + part * (high - low), self.y, i, point)
        self._write_filling(self._count("most"), self.slopes, self.rates)

    def _write_derivatives(self) -> None:
        """The derivatives of a step at its solution."""
        e = self.equations
        self.derivatives = f = self._function("derivatives")
        f.call(self.linearise, f.arguments[0])
        for name, state in self._end_states():
            for array, nonzeros in (
                (self.by_history[name], e.by_history[name]),
                (self.by_control[name], e.by_control[name]),
            ):
                for i, value in enumerate(self._evaluate(_nodes(nonzeros), 0, False, state)):
                    self._put(value, array, i)

    def _end_states(self) -> Sequence[tuple[str, dict[int, Value]]]:
        """Return the state at the tips and at the bases."""
        return ("tip", self._tip_state(self.y, self.H)), ("base", self._base_state(self.unknowns, self.H))

    def _write_records(self) -> None:
        """The records after a step."""
        self.shift = f = self._function("shift", "coefficients")
        c0 = f.load(f.arguments[1], 0)
        self._write_shift(self.records, self._count("used"))
        for i, j, newest in self._numbers_of(self._state_arrays(self.y), "used between"):
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

    def _states_at(self, name: str) -> Iterator[tuple[Index, Value | bool, dict[int, Value]]]:
        """Write loops over places on which rates and strains, or y behind jumps, depend.

        Yields the place, which lanes are inside, and the values there.
        """
        far = self.y if self.far is None else self.far
        if name == "far":
            pieces = self._count("pieces")
            with self._places(pieces) as j:
                yield j, self._inside(j, pieces), self._state(self.y, self.H, j) | self._acting_at(j)
            return
        for y, name in ((far, "ends"), (self.between, "used between")):
            if name == "ends" or self.stages:
                count = self._count(name)
                with self._places(count) as j:
                    here = j if name == "ends" else j + self._count("ends")
                    place = {self.equations.s.item(): self._wide(self.s, 0, here)}
                    yield here, self._inside(j, count), self._state(y, self.H, j, here) | place

    # running

    def _data_of(self, step: Index, coefficients: Value, *data: Value) -> list[Value]:
        """Return the addresses of a step's coefficients, and of its control, row and unknowns."""
        f, sizes = self._now, self._sizes
        found = [f.pointer(each, step.value * size) for each, size in zip(data, sizes, strict=True)]
        return [f.pointer(coefficients, step.value * (self.settings.memory + 3)), *found]

    @property
    def _sizes(self) -> tuple[int, Value, int]:
        """Numbers of a step's control, row and unknowns."""
        return self.equations.nc, self._count("nodes") * self.packed.size, self.equations.k

    def _begin_turns(self) -> None:
        """Begin a run, in which the records of a state change places from step to step."""
        offsets = (self._now.value(each.offset, "i64") for each in self.lasting[:-1])
        #: where the records are, from the last one
        self.turning = [StackVariable(self._now, each) for each in offsets]

    def _turn(self, last: int) -> None:
        """Change the places of records; `last` is the one that becomes the last."""
        values = [each.get() for each in self.turning]
        for place, value in zip(self.turning, values[last:] + values[:last], strict=True):
            place.set(value)

    def _lasting(self, states: np.ndarray, lanes: int, turns: int = 0) -> np.ndarray:
        """Return records and rate (m, lanes, memory + 1, places, numbers) of states: a view before turns."""
        first, second = self.lasting[:2]
        strides = self.state_size, 1, second.offset - first.offset, first.place, first.component
        found = np.lib.stride_tricks.as_strided(
            states[:, first.offset :],
            (len(states), lanes, len(self.lasting), self.counts["used"], first.size),
            [8 * each for each in strides],
        )
        memory = self.settings.memory
        turned = [*((k + turns) % memory for k in range(memory)), memory]
        return found[:, :, turned] if turns else found

    def _begin_step(self, *arguments: str) -> list[Any]:
        """Begin the map of a step for columns side by side; return data, then what else is given."""
        records = [f"record{k}" for k in range(self.settings.memory)]
        names = "state", *records, "coefficients", "control", "row", "unknowns", *arguments
        self.step = self._function("step", *names, "n_columns")
        coefficients, *data, width = self.step.arguments[STATE + 1 + len(records) :]
        return [coefficients, *(Columns(each, width) for each in data[:3]), *data[3:], width]

    def _write_columns(
        self, step: Index, table: Value, lanes: int, states: Value, moved: Sequence[Value], *given: Value
    ) -> None:
        """Write the map of a step for all columns: those of `moved` control, row, unknowns, and weights."""
        f, width = self._now, given[-1]
        sizes = itertools.chain(self._sizes, itertools.repeat(0))
        starts = [
            f.pointer(each, step.value * width * size) for each, size in zip(moved, sizes, strict=False)
        ]
        with f.loop(width, 0, lanes) as first:
            own = [f.pointer(each, first.value) for each in starts]
            state = f.pointer(states, first.value * (self.state_size // lanes))
            records = [f.pointer(state, place.get()) for place in self.turning]
            f.call(self.step, f.arguments[0], state, *records, table, *own, *given)

    def _prepare(self, solved: SolvedSteps) -> list[np.ndarray]:
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
        self.added_tip = self._columns(self.equations.k, 1, STATE)

    def _reserve_products(self) -> None:
        e, a = self.equations, self._array
        self.common = a(len(e.common), "used")
        self.shared.append((self.common, e.common))
        whole, self._size = self._size, 0
        # of one direction of the system
        self.dparameters = a(len(e.dparameters), memory=1)
        self.ds, self.dh = a(1, "used", 1), a(1, "pieces" if e.moves_lengths else 0, 1)
        self.by_system = {name: a(len(rows), self.places[name], 1) for name, rows in e.moving_rows.items()}
        self.direction_size, self._size = self._size, whole

    def _write(self) -> None:
        super()._write()
        self._write_direction()
        self._write_tangents()
        self._write_run()

    def _nodes_by_system(self, name: str) -> list[int]:
        """Return the nodes of the tangents of results by the system, those that are not always zero."""
        return [self.equations.by_system[name][i] for i in self.equations.moving_rows[name]]

    def _write_direction(self) -> None:
        """Tangents of rates, strains, jumps, tip and base by one direction of the system, at fixed y."""
        e = self.equations
        self.direction = self._function("direction", "direction")
        every = [*e.moved_terms, e.dlength]
        moves = self._inputs_of(self.dparameters, [e.dparameters], every)
        values = self._terms_known(every, moves)
        for array, parts in (self.ds, self.s_parts), (self.dh, self.h_parts):
            for _, j in self._components(1, self._used_places(array)) if array.count else ():
                self._write_wide(values[e.dlength] * self._wide(parts, 0, j), array, 0, j)
        known = {node: values[node] for node in e.moved_terms} | moves
        for name in ("rates", "far"):
            for j, _, here in self._states_at(name) if e.moving_rows[name] else ():
                here |= known
                if name == "rates":
                    here |= {node: self._wide(self.common, i, j) for i, node in enumerate(e.common)}
                    here[e.ds.item()] = self._wide(self.ds, 0, j)
                self._write_results([(self.by_system[name], self._nodes_by_system(name))], j, here)
        for name, here in self._end_states():
            for i, value in enumerate(self._evaluate(self._nodes_by_system(name), 0, False, here | known)):
                self._put(value, self.by_system[name], i)

    def _write_tangents(self) -> None:
        """Tangents of the step, of as many columns as there are lanes."""
        t = self.tangents
        coefficients, control, row, unknowns, weights, directions, count, width = self._begin_step(
            "weights", "directions", "n_directions"
        )
        f = self._now
        at_tip = [Add(Entry(t.tip, i), Entry(self.added_tip, i)) for i in range(self.equations.k)]
        write(self, [*self._at_fixed_y(coefficients, control), *at_tip], COLUMNS, False)
        with f.loop(count) as d:
            own = f.pointer(directions, d.value * self.direction_size)
            weight = f.load(weights, d.value * width, COLUMNS)
            with f.if_(f.any(f.apply("abs", weight) > 0.0)):
                self._write_change_of_system(own, weight)
        write(self, self._solution(coefficients, row, unknowns), COLUMNS, False)

    def _write_change_of_system(self, direction: Value, weight: Value) -> None:
        """Add a direction of the system to the results at fixed y, with a weight in each column."""
        f, e = self._now, self.equations
        parts = [(self.by_system[name], e.moving_rows[name], target) for name, target in self.results.items()]
        for source, rows, target in (*parts, (self.dh, [0], self.tangents.lengths)):
            if not source.size or (source is self.dh and not e.moves_lengths):
                continue
            with f.loop(self._used_places(source)) as j:
                for k, i in enumerate(rows):
                    number = f.load(j.address(direction, source.place), source.at(k, 0))
                    moved = self._get(target, i, j, COLUMNS) + weight * number
                    self._put(moved, target, i, j, COLUMNS)

    def _write_run(self) -> None:
        """All solved steps in turn; tangents have `n_columns` columns, a multiple of the lanes."""
        names = ["memory", "controls", "coefficients", "rows", "unknowns", "directions", "states", "weights"]
        names += ["d_controls", "d_rows", "d_unknowns", "n_steps", "n_directions", "n_columns"]
        f = self._now = self.module.function("run", names, exported=True)
        memory, controls, coefficients, rows, unknowns, directions, states, weights = f.arguments[:8]
        *moved, steps, count, width = f.arguments[8:]
        self._begin_turns()
        f.call(self.setup, memory)
        with f.loop(steps) as step:
            table, control, row, unknown = self._data_of(step, coefficients, controls, rows, unknowns)
            f.call(self.data, memory, table, control, unknown)
            f.call(self.solution, memory, row)
            f.call(self.derivatives, memory)
            with f.loop(count) as d:
                f.call(self.direction, memory, f.pointer(directions, d.value * self.direction_size))
            self._write_columns(step, table, COLUMNS, states, [*moved, weights], directions, count, width)
            f.call(self.shift, memory, table)
            self._turn(-1)

    def solve(
        self, solved: SolvedSteps, moves: tuple[Any, Any], d_controls: Any, d_states: Any, d_tip: Any = 0.0
    ) -> tuple[Any, Any]:
        """Return states, and the tangents of solved rows (solves, nodes, x, m) and unknowns (solves, k, m).

        `moves` are directions of the moving parameters (d, n) and weights (d, m); `d_states` are the tangents
        of records and rate before the first step, with one more axis (m). `d_tip` (k, m) is added to the
        tangents of the tip's residual. The states returned are those after the last step: records, rate, and
        their tangents.
        """
        k, L, (directions, weights), count = self.equations.k, COLUMNS, moves, len(solved.controls)
        m, places = d_controls.shape[-1], len(solved.rate)
        blocks = -(-m // L)

        def pad(values: Any) -> np.ndarray:
            """Return tangents with columns of zeros, so that their number is a multiple of the lanes."""
            if np.shape(values)[-1] == blocks * L:
                return np.ascontiguousarray(values, float)
            found = np.zeros((*np.shape(values)[:-1], blocks * L))
            found[..., :m] = values
            return found

        begun = self._prepare(solved)
        moved = np.zeros((len(directions), self.direction_size))
        if directions.size:
            self._put_in(moved, self.dparameters, directions[:, None, None])
        states = aligned_zeros(blocks * self.state_size).reshape(blocks, -1)
        d_records, d_rate = d_states
        columns = pad(np.concatenate([d_records, d_rate[None]])).reshape(-1, *d_rate.shape[:2], blocks, L)
        self._lasting(states, L)[:] = self._by_strand(self.records[0], columns.transpose(3, 4, 0, 1, 2))
        if np.any(d_tip):
            added = pad(np.broadcast_to(d_tip, (k, m))).reshape(k, blocks, L).transpose(1, 0, 2)
            states[:, self.added_tip.offset :][:, : k * L] = added.reshape(blocks, -1)
        shapes = (self.counts["nodes"], self.packed.size), (k,)
        d_rows, d_unknowns = (np.empty((count, *shape, blocks * L)) for shape in shapes)
        arrays = *begun, moved, states, pad(weights), pad(d_controls), d_rows, d_unknowns
        self._functions.run("run", *arrays, count, len(directions), blocks * L)
        motion = (self._numbers(begun[0][None], each)[0, 0] for each in (*self.records, self.rate))
        *records, rate = (self._join(self.rate, each, places) for each in motion)
        columns = self._join(self.rate, self._lasting(states, L, -count), places).transpose(2, 3, 4, 0, 1)
        columns = columns.reshape(*columns.shape[:3], blocks * L)[..., :m]
        after = np.stack(records), rate, columns[:-1], columns[-1]
        return after, (d_rows[..., :m], d_unknowns[..., :m])


class CotangentCore(_TangentCode):
    """Machine code of the cotangents of solved steps, one after the other."""

    transposed = True

    def _reserve_state(self) -> None:
        e, a = self.equations, self._array
        #: cotangents of the moving parameters, of places, and of lengths of pieces
        self.parameter, self.place = a(len(e.by_terms) - len(e.moving_arrays), memory=1), a(1, "used", 1)
        self.length_of_piece = a(1, "pieces", 1)

    def _reserve_products(self) -> None:
        #: cotangents of the terms of a step, for each lane of places
        self.term = self._tangent_array(len(self.equations.moving_terms), 1)

    def _write(self) -> None:
        super()._write()
        self._write_rates_of_step()
        self._write_products()
        self._write_geometry()
        self._write_cotangents()
        self._write_run()

    def _write_rates_of_step(self) -> None:
        """Rates and strains at all ends of pieces."""
        self.rates_of_step = self._function("rates_of_step")
        self._write_places(self.rates, self.y, self.H)

    def _write_products(self) -> None:
        """Add the cotangents of parameters, places and lengths, from those of the results at fixed y."""
        e, t = self.equations, self.tangents
        self.pull = f = self._function("pull", "state")
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
                nodes, added = self._split(e.pulled[name])
                *values, place = self._evaluate(nodes, j, True, here, (added, inside))
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
            nodes, added = self._split(e.pulled[name])
            values = self._evaluate(nodes, 0, False, here | known, (added, True))
            sums = [a + b for a, b in zip(sums, values, strict=False)]
        given = self._parameters(e.by_terms) | terms
        given |= {int(node): each for node, each in zip(e.of_terms, sums, strict=True)}
        self._add_parameters(e.by_terms, given)
        with self._places(self._count("pieces")) as j:
            total = self._wide(self.length_of_piece, 0, j) + self._wide(t.lengths, 0, j)
            self._write_wide(total, self.length_of_piece, 0, j)

    def _write_geometry(self) -> None:
        """Add the cotangents of parameters from those of places and lengths: once a run."""
        e = self.equations
        self.by_geometry = f = self._function("by_geometry", "state")
        total = self._wide_variable(0.0)
        for array, parts in (self.place, self.s_parts), (self.length_of_piece, self.h_parts):
            count = self._used_places(array)
            for _, j in self._components(1, count):
                product = self._wide(array, 0, j) * self._wide(parts, 0, j)
                total.set(total.get() + self._before(count, j, product))
        known = self._parameters(e.by_geometry) | {e.of_length.item(): f.total(total.get())}
        self._add_parameters(e.by_geometry, known)

    def _split(self, cotangents: Sequence[int]) -> tuple[list[int], list[tuple[int, Value]]]:
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
        (nodes, added), program = self._split(cotangents), self.equations.program
        moving = {k: node for k, node in enumerate(nodes) if not program.is_constant(node, 0.0)}
        values = self._now.evaluate(program, [*moving.values()], known, 1, (added, True))
        for k, node in moving.items():
            self._put(self._get(self.parameter, k) + values[node], self.parameter, k)

    def _write_cotangents(self) -> None:
        """Cotangents of a step's data from those of its results."""
        coefficients, control, row, unknowns, _ = self._begin_step()
        write(self, self._solution(coefficients, row, unknowns), 1, True)
        if self.equations.by_terms:
            self._now.call(self.pull, *self._now.arguments[:2])
        write(self, self._at_fixed_y(coefficients, control), 1, True)

    def _write_run(self) -> None:
        """All solved steps in turn, which keeps what each starts from; then their cotangents in reverse."""
        names = ["memory", "controls", "coefficients", "rows", "unknowns", "kept", "states"]
        names += ["d_controls", "d_rows", "d_unknowns", "n_size", "n_steps", "n_columns"]
        f = self._now = self.module.function("run", names, exported=True)
        memory, controls, coefficients, rows, unknowns, kept, states, *moved, size, steps, width = f.arguments
        self._begin_turns()

        def copy(step: Index, forth: bool) -> None:
            """Keep the arrays that a step starts from, or restore them."""
            for inside, outside in self._each_packed_vector(self._kept, f.pointer(kept, step.value * size)):
                source, target = (inside, outside) if forth else (outside, inside)
                f.store(f.load(source, 0, self.L), target, 0)

        f.call(self.setup, memory)
        with f.loop(steps) as step:
            table, control, row, unknown = self._data_of(step, coefficients, controls, rows, unknowns)
            f.call(self.data, memory, table, control, unknown)
            f.call(self.solution, memory, row)
            copy(step, True)
            f.call(self.rates_of_step, memory)
            f.call(self.shift, memory, table)
        with f.loop(0, steps - 1, -1) as step:
            table, control, row, unknown = self._data_of(step, coefficients, controls, rows, unknowns)
            copy(step, False)
            f.call(self.data, memory, table, control, unknown)
            f.call(self.derivatives, memory)
            self._turn(1)
            self._write_columns(step, table, 1, states, moved, width)
        if self.equations.by_terms:
            with f.loop(width) as column:
                f.call(self.by_geometry, memory, f.pointer(states, column.value * self.state_size))

    @property
    def _kept(self) -> Sequence[Array]:
        """Arrays from which the derivatives of a step are evaluated."""
        return self.y, *self.records, self.rate

    def solve(self, solved: SolvedSteps, cotangents: Any) -> tuple[Any, Any, Any, Any]:
        """Return the cotangents of moving parameters (n, m), controls (solves, c, m), records and rate.

        `cotangents` are those of rows (solves, nodes, x, m) and unknowns (solves, k, m), and of records and
        rate after the last step.
        """
        begun, count = self._prepare(solved), len(solved.controls)
        d_rows, d_unknowns, d_records, d_rate = (np.ascontiguousarray(each, float) for each in cotangents)
        m, places = d_rate.shape[-1], len(d_rate)
        states = np.zeros((m, self.state_size))
        columns = np.concatenate([d_records, d_rate[None]]).transpose(3, 0, 1, 2)[:, None]
        lasting = self._lasting(states, 1)
        lasting[:] = self._by_strand(self.rate, columns)
        # idle pieces have no results
        lasting[..., self.counts.idle, :] = 0.0
        d_controls = np.zeros((count, self.equations.nc, m))
        size = sum(map(self._size_of, self._pack(self._kept)))
        kept = np.empty((count, size))
        arrays = *begun, kept, states, d_controls, d_rows, d_unknowns
        self._functions.run("run", *arrays, size, count, m)
        before = self._join(self.rate, self._lasting(states, 1, count)[:, 0], places).transpose(1, 2, 3, 0)
        return self._numbers(states, self.parameter)[:, 0, 0].T, d_controls, before[:-1], before[-1]


def _nodes(nonzeros: Nonzeros) -> list[int]:
    return [node for *_, node in nonzeros]
