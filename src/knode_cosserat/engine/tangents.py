"""Tangents of solved motions and equilibria as machine code, by the implicit function theorem.

A solved step satisfies G(y, ξ; history, control, parameters) = 0. Its derivatives are evaluated once for a
step, with places in lanes. All tangents then solve the linear equations of Newton's method, with tangents
in lanes.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.engine.codegen import Index, Value
from knode_cosserat.engine.elimination import Correction, EliminationCode
from knode_cosserat.engine.equations import Nonzeros, TangentEquations
from knode_cosserat.engine.memory import Array
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.problem import FILLING
from knode_cosserat.solvers.settings import Settings


class TangentCore(EliminationCode):
    """Machine code of the tangents of a system's solved steps, by all data of a step.

    The system changes in its `moving` parameters, a mask for each of its leaves.
    """

    equations: TangentEquations

    def __init__(self, system: System, settings: Settings, moving: Sequence[np.ndarray], lanes: int = 8):
        self.settings = settings
        super().__init__(TangentEquations(system, moving), False, lanes)
        e, a, many = self.equations, self._array, self._tangent_array
        ny, nx, numbers, k = e.ny, e.ny + e.nz, e.numbers, e.k
        self.records, self.rate = [a(numbers, self.ends) for _ in range(2)], a(numbers, self.ends)
        # derivatives at all places
        self.z_by_y = a(len(e.z_by_y), self.ends)
        places = {"rates": self.ends, "far": self.pieces, "tip": 1, "base": 1}
        self.by_history = {name: a(len(e.by_history[name]), count) for name, count in places.items()}
        self.by_control = {name: a(len(e.by_control[name]), count) for name, count in places.items()}
        self.jumps += [
            (self.by_history["far"], _nodes(e.by_history["far"])),
            (self.by_control["far"], _nodes(e.by_control["far"])),
        ]
        # tangents: history terms; rates and strains, and y behind jumps, at fixed y
        self.dH, self.dx, self.dfar = (
            many(numbers, self.ends),
            many(nx, self.ends),
            many(ny, self.pieces),
        )
        self.tangent = Correction(
            many(ny, self.pieces), many(k, 1), many(ny, self.pieces), many(ny, self.points),
            many(k, self.groups[1]), many(ny, self.points), many(k, 1),
        )  # fmt: skip
        whole, self._size = self._size, 0
        # of one direction of the system
        self.dparameters = a(len(e.dparameters), memory=1)
        self.ds, self.dh = a(1, self.ends, 1), a(1, self.pieces, 1)
        self.moved = {name: a(len(nodes), places[name], 1) for name, nodes in e.moved.items()}
        self.direction_size, self._size = self._size, 0
        # of as many tangents as there are lanes
        self.d_records, self.d_rate = (
            [many(numbers, self.ends, 1) for _ in range(2)],
            many(numbers, self.ends, 1),
        )
        self.state_size, self._size = self._size, whole
        self._write()
        self.compiled = self.module.compile()
        self._run = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 11, *[ctypes.c_long] * 3)(
            self.compiled.address("run")
        )

    def _write(self) -> None:
        e = self.equations
        self._write_setup()
        self._write_terms()
        slopes = [
            (self.slope, e.nonzeros), (self.z_by_y, _nodes(e.z_by_y)),
            (self.by_history["rates"], _nodes(e.by_history["rates"])),
            (self.by_control["rates"], _nodes(e.by_control["rates"])),
        ]  # fmt: skip
        self.rates_and_slopes = self._write_rates("rates_and_slopes", slopes)
        self.solved = self._write_solved()
        self._write_factor()
        self.advance = self._write_advance()
        self._write_along()
        self._write_linearise()
        self.defects = self._function("defects")
        self._write_defects(self.y, self.H)
        self._write_step()
        self._write_direction()
        self.has_tangents = True
        self.solved_tangents = self._write_solved("solved_tangents")
        self.advance_tangents = self._write_advance("advance_tangents")
        self._write_tangents()
        self._write_shift()
        self._write_run()

    def _write_step(self) -> None:
        """The derivatives of a solved step from its row: y at the nodes, unknowns, control and history."""
        e = self.equations
        self.step = f = self._function("step", "coefficients", "control", "row", "unknowns")
        memory, coefficients, control, row, unknowns = f.arguments
        self._write_inputs(f.load(coefficients, 0), f.load(coefficients, 4), control)
        with self._places(self.ends) as j:
            for i in range(e.numbers):
                parts = [self._wide(each, i, j) for each in (*self.records, self.rate)]
                self._write_wide(self._history(coefficients, parts), self.H, i, j)
        with f.loop(len(self.grid.nodes)) as node:
            at, point = f.pointer(row, node.value * e.numbers), self._node(node)
            for i in range(e.ny):
                self._put(f.load(at, i), self.y, i, point)
        for i in range(e.k):
            self._put(f.load(unknowns, i), self.unknowns, i)
        self._fill()
        f.call(self.linearised, memory)
        self._write_ends(self.f, self.fe)
        for name, state in (
            ("tip", self._tip_state(self.y, self.H)), ("base", self._base_state(self.unknowns, self.H))
        ):  # fmt: skip
            for array, nonzeros in (
                (self.by_history[name], e.by_history[name]), (self.by_control[name], e.by_control[name])
            ):  # fmt: skip
                for i, value in enumerate(self._evaluated(_nodes(nonzeros), 0, False, state)):
                    self._put(value, array, i)

    def _history(self, coefficients: Value, parts: Sequence[Value]) -> Value:
        """Return the history term of two records and the rate."""
        f = self._now
        found = f.load(coefficients, 1) * parts[0] + f.load(coefficients, 2) * parts[1]
        return found + f.load(coefficients, 3) * parts[2] if self.settings.uses_rate else found

    def _fill(self) -> None:
        """Solve for y at points between nodes (see `StepProblem.filled`)."""
        f, e, grid = self._now, self.equations, self.grid
        if not len(grid.between):
            return
        memory, nodes = f.arguments[0], grid.nodes
        for point in map(int, grid.between):
            start, end = (int(nodes[grid.segment[point] + k]) for k in (0, 1))
            part = float(grid.bounds[point, 0])
            for i in range(e.ny):
                low, high = self._get(self.y, i, start), self._get(self.y, i, end)
                self._put(low + part * (high - low), self.y, i, point)
        with f.loop(FILLING * (int(np.max(np.diff(nodes))) - 1)):
            f.call(self.linearised, memory)
            f.call(self.defects, memory)
            with self._places(self.pieces) as j:
                points = self._pointer(self.r, j), self._pointer(self.wide_added, j)
                f.call(self.solved, memory, *points, j.value)
            for point in map(int, grid.between):
                for i in range(e.ny):
                    change = self._get(self.wide_added, i, point - 1)
                    self._put(self._get(self.y, i, point) + change, self.y, i, point)

    def _write_direction(self) -> None:
        """Tangents of rates, strains, jumps, tip and base by one direction of the system, at fixed y."""
        e = self.equations
        self.direction = f = self._function("direction", "direction")
        geometry = [*e.dplaces[: self.ends], *e.dlengths]
        state = self._parameters([*e.moved_terms, *geometry])
        for k, node in enumerate([e.c0.item(), e.t.item(), *e.control]):
            state[int(node)] = self._get(self.inputs, k)
        for node, first, _ in e.slots(e.step_terms):
            state[node] = self._term(node, self.step_terms, first, 0, self.P)
        moves = self._inputs_of(self.dparameters, [e.dparameters], [*e.moved_terms, *geometry])
        state |= moves
        values = f.evaluate(e.program, [*e.moved_terms, *geometry], state, 1)
        for array, nodes in ((self.ds, e.dplaces[: self.ends]), (self.dh, e.dlengths)):
            for k, node in enumerate(nodes):
                self._put(values[node], array, 0, k)
        known = {node: values[node] for node in e.moved_terms} | moves
        far = self.y if self.far is None else self.far

        def values_at(y: Array, j: Index) -> dict[int, Value]:
            return self._state(y, self.H, j) | known | {e.s.item(): self._wide(self.s, 0, j)}

        with self._places(self.ends) as j:
            here = values_at(far, j) | {e.ds.item(): self._wide(self.ds, 0, j)}
            self._write_results([(self.moved["rates"], e.moved["rates"])], j, here)
        if e.moved["far"]:
            with self._places(self.pieces) as j:
                here = values_at(self.y, j) | self._acting_at(j)
                self._write_results([(self.moved["far"], e.moved["far"])], j, here)
        for name, here in (
            ("tip", self._tip_state(self.y, self.H)), ("base", self._base_state(self.unknowns, self.H))
        ):  # fmt: skip
            for i, value in enumerate(self._evaluated(e.moved[name], 0, False, here | known)):
                self._put(value, self.moved[name], i)

    def _sums(self, products: Iterable[tuple[Nonzeros, Array, Any]], size: int, j: Any) -> list[Value]:
        """Return the sum of products of sparse matrices at a place with vectors of tangents."""
        f = self._now
        zero = f.splat(f.value(0.0), self.L)
        found = [zero] * size
        for nonzeros, matrix, vector in products:
            for k, (i, c, _) in enumerate(nonzeros):
                product = self._get(matrix, k, j, 1) * vector(c)
                found[i] = product if found[i] is zero else found[i] + product
        return found

    def _write_tangents(self) -> None:
        """Tangents of the step, of as many columns as there are lanes."""
        e = self.equations
        arguments = ["state", "directions", "weights", "d_control", "coefficients", "row", "unknowns"]
        self.tangents = f = self._function("tangents", *arguments, "n_directions", "n_columns")
        memory, _, directions, weights, d_control, coefficients, row, d_unknowns, count, width = f.arguments
        L, ny, nx, arrays, tip = self.L, e.ny, e.ny + e.nz, self.tangent, self.pieces

        def get(array: Array, i: int, j: Any = 0) -> Value:
            return self._get(array, i, j, L)

        def put(values: Iterable[Value], array: Array, j: Any = 0) -> None:
            for i, value in enumerate(values):
                self._put(value, array, i, j, L)

        def by_data(name: str, size: int, j: Any, place: Any = None) -> list[Value]:
            place = j if place is None else place
            return self._sums(
                (
                    (e.by_history[name], self.by_history[name], lambda c: get(self.dH, c, place)),
                    (e.by_control[name], self.by_control[name], lambda c: f.load(d_control, width * c, L)),
                ),
                size, j,
            )  # fmt: skip

        # at fixed y: by history and control, then by the system
        with f.loop(self.ends) as j:
            parts = ([get(each, i, j) for each in (*self.d_records, self.d_rate)] for i in range(e.numbers))
            put([self._history(coefficients, each) for each in parts], self.dH, j)
        with f.loop(self.ends) as j:
            put(by_data("rates", nx, j), self.dx, j)
        with f.loop(self.pieces) as j:
            put(by_data("far", ny, j), self.dfar, j)
            put([f.splat(f.value(0.0), L)] * ny, arrays.r, j)
        put(by_data("tip", e.k, 0, tip), arrays.tip)
        put(by_data("base", ny, 0), arrays.w)
        with f.loop(count) as d:
            own = f.pointer(directions, d.value * self.direction_size)
            weight = f.load(weights, d.value * width, L)
            for name, array, places in (
                ("rates", self.dx, self.ends), ("far", self.dfar, self.pieces), ("tip", arrays.tip, 1),
                ("base", arrays.w, 1),
            ):  # fmt: skip
                source = self.moved[name]
                with f.loop(places) as j:
                    for i in range(source.size):
                        number = f.load(j.address(own, source.place), source.at(i, 0))
                        self._put(get(array, i, j) + weight * number, array, i, j, L)
            with f.loop(self.pieces) as j:
                half = weight * (0.5 * f.load(j.address(own, self.dh.place), self.dh.at(0, 0)))
                for i in range(ny):
                    rates = self._get(self.f, i, j) + self._get(self.fe, i, j)
                    self._put(get(arrays.r, i, j) + half * rates, arrays.r, i, j, L)
        if e.jumping:
            with f.loop(self.pieces) as j:
                slopes = ([(i, c, 0) for i, c in e.pattern], self.slope, lambda c: get(self.dfar, c, j))
                for i, change in enumerate(self._sums([slopes], ny, j)):
                    self._put(get(self.dx, i, j) + change, self.dx, i, j, L)
        with f.loop(self.pieces) as j:
            half = self._get(self.h, 0, j) * 0.5
            for i in range(ny):
                rates = get(self.dx, i, j) + get(self.dx, i, j + 1)
                self._put(get(arrays.r, i, j) + get(self.dfar, i, j) + half * rates, arrays.r, i, j, L)
        for k, point in enumerate(map(int, self.grid.near)):
            half = self._get(self.h, 0, point - 1) * 0.5
            for i in range(ny):
                change = half * (get(self.dx, i, self.points + k) - get(self.dx, i, point))
                self._put(get(arrays.r, i, point - 1) + change, arrays.r, i, point - 1, L)
        with f.loop(self.pieces) as j:
            points = self._pointer(arrays.r, j), self._pointer(arrays.added, j)
            f.call(self.solved_tangents, memory, *points, j.value)
        self._write_correction(arrays, self.advance_tangents)
        # the records
        newest, older = self.d_records
        with f.loop(self.ends) as j:
            put([get(newest, i, j) for i in range(e.numbers)], older, j)
        with f.loop(self.points) as j:
            put([get(arrays.dy, i, j) for i in range(ny)], newest, j)
        if e.jumping:
            with f.loop(self.pieces) as j:
                jumps = self._sums([(e.jumping, self.jump, lambda c: get(arrays.dy, c, j))], ny, j)
                for i, change in enumerate(jumps):
                    self._put(get(newest, i, j) + change + get(self.dfar, i, j), newest, i, j, L)
        for k, point in enumerate(map(int, self.grid.near)):
            put([get(arrays.dy, i, point) for i in range(ny)], newest, self.points + k)
        with f.loop(self.ends) as j:
            strains = self._sums([(e.z_by_y, self.z_by_y, lambda c: get(newest, c, j))], e.nz, j)
            for i, change in enumerate(strains):
                self._put(get(self.dx, ny + i, j) + change, newest, ny + i, j, L)
            if self.settings.uses_rate:
                c0 = f.load(coefficients, 0)
                put([c0 * get(newest, i, j) + get(self.dH, i, j) for i in range(e.numbers)], self.d_rate, j)
        with f.loop(len(self.grid.nodes)) as node:
            at, here = f.pointer(row, node.value * width * e.numbers), self._node(node)
            for i in range(e.numbers):
                f.store(get(arrays.dy if i < ny else newest, i, here), at, width * i, L)
        for i in range(e.k):
            f.store(get(arrays.unknowns, i), d_unknowns, width * i, L)

    def _write_shift(self) -> None:
        """The records after a step."""
        e = self.equations
        self.shift = f = self._function("shift", "coefficients")
        c0 = f.load(f.arguments[1], 0)
        far = self.y if self.far is None else self.far
        with self._places(self.ends) as j:
            for i in range(e.numbers):
                self._write_wide(self._wide(self.records[0], i, j), self.records[1], i, j)
                newest = self._wide(far, i, j) if i < e.ny else self._wide(self.z, i - e.ny, j)
                self._write_wide(newest, self.records[0], i, j)
                if self.settings.uses_rate:
                    self._write_wide(c0 * newest + self._wide(self.H, i, j), self.rate, i, j)

    def _write_run(self) -> None:
        """All solved steps in turn; tangents have `n_columns` columns, a multiple of the lanes."""
        e, L, nodes = self.equations, self.L, len(self.grid.nodes)
        names = ["memory", "controls", "coefficients", "rows", "unknowns", "directions", "states", "weights"]
        names += ["d_controls", "d_rows", "d_unknowns", "n_steps", "n_directions", "n_columns"]
        f = self._now = self.module.function("run", names, exported=True)
        memory, controls, coefficients, rows, unknowns, directions, states, weights = f.arguments[:8]
        d_controls, d_rows, d_unknowns, steps, count, width = f.arguments[8:]
        f.call(self.setup, memory)
        with f.loop(steps) as step:
            table = f.pointer(coefficients, step.value * 5)
            f.call(
                self.step, memory, table, f.pointer(controls, step.value * e.nc),
                f.pointer(rows, step.value * (nodes * e.numbers)), f.pointer(unknowns, step.value * e.k),
            )  # fmt: skip
            with f.loop(count) as d:
                f.call(self.direction, memory, f.pointer(directions, d.value * self.direction_size))
            own = f.pointer(d_controls, step.value * width * e.nc)
            d_row = f.pointer(d_rows, step.value * width * (nodes * e.numbers))
            d_unknown = f.pointer(d_unknowns, step.value * width * e.k)
            with f.loop(width, 0, L) as first:
                parts = (f.pointer(each, first.value) for each in (weights, own, d_row, d_unknown))
                own_weights, own_control, own_row, own_unknowns = parts
                state = f.pointer(states, first.value * (self.state_size // L))
                f.call(
                    self.tangents, memory, state, directions, own_weights, own_control, table, own_row,
                    own_unknowns, count, width,
                )  # fmt: skip
            f.call(self.shift, memory, table)

    def solve(
        self, parameters: np.ndarray, table: Float[np.ndarray, "solves 5"], solved: tuple[Any, Any],
        controls: Float[np.ndarray, "solves c"], moves: tuple[Any, Any], d_controls: Any, states: Any,
    ) -> tuple[Any, Any]:  # fmt: skip
        """Return the tangents of solved rows (solves, nodes, x, m) and unknowns (solves, k, m), and states.

        `moves` are directions of the moving parameters (d, n) and weights (d, m); `states` are records
        (2, used, x) and rate before the first step, and their tangents with one more axis (m). The states
        returned are those after the last step.
        """
        e, L, (records, rate, d_records, d_rate) = self.equations, self.L, states
        (rows, unknowns), (directions, weights), count = solved, moves, len(controls)
        rows = np.ascontiguousarray(np.asarray(rows, float)[..., : e.numbers])
        m, nodes = d_controls.shape[-1], len(self.grid.nodes)
        blocks = -(-m // L)

        def filled(values: Any) -> np.ndarray:
            """Return tangents with columns of zeros, so that their number is a multiple of the lanes."""
            found = np.zeros((*np.shape(values)[:-1], blocks * L))
            found[..., :m] = values
            return found

        memory = self._empty_memory()
        self._put_in(memory[None], self.params, parameters[None, None, None])
        for array, values in zip((*self.records, self.rate), (*records, rate), strict=True):
            self._put_in(memory[None], array, np.asarray(values, float)[None, None])
        moved = np.zeros((len(directions), self.direction_size))
        if directions.size:
            self._put_in(moved, self.dparameters, directions[:, None, None])
        tangents = np.zeros((blocks, self.state_size))
        parts = (*self.d_records, self.d_rate)
        for array, values in zip(parts, (*d_records, d_rate), strict=True):
            self._put_in(
                tangents, array, np.moveaxis(filled(values).reshape(self.ends, -1, blocks, L), (2, 3), (0, 1))
            )
        d_rows, d_unknowns = (np.empty((count, *shape, blocks * L)) for shape in ((nodes, e.numbers), (e.k,)))
        arrays = (
            memory, np.ascontiguousarray(controls, float), np.ascontiguousarray(table, float), rows,
            np.ascontiguousarray(unknowns, float), moved, tangents, filled(weights), filled(d_controls),
            d_rows, d_unknowns,
        )  # fmt: skip
        self._run(*(each.ctypes.data for each in arrays), count, len(directions), blocks * L)
        after = [self._numbers(memory[None], each)[0, 0] for each in (*self.records, self.rate)]
        moved_after = [
            np.moveaxis(self._numbers(tangents, each), (0, 1), (2, 3)).reshape(self.ends, -1, blocks * L)
            for each in parts
        ]
        found = (
            np.stack([each[: self.ends] for each in after[:2]]), after[2][: self.ends],
            np.stack(moved_after[:2])[..., :m], moved_after[2][..., :m],
        )  # fmt: skip
        return found, (d_rows[..., :m], d_unknowns[..., :m])


def _nodes(nonzeros: Nonzeros) -> list[int]:
    return [node for *_, node in nonzeros]
