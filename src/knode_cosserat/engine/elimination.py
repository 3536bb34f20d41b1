"""Code of the linear equations of a correction: elimination along the rod (see `solvers.linear`)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.engine.codegen import Function, Index, Value, Variable
from knode_cosserat.engine.equations import Elimination, Equations
from knode_cosserat.engine.memory import Array
from knode_cosserat.engine.rod import RodCode
from knode_cosserat.solvers.boundary import pivots_of
from knode_cosserat.solvers.linear import _each


class Correction(NamedTuple):
    """Arrays of one right-hand side: defects of pieces and tip, and the correction of y and unknowns."""

    r: Array
    tip: Array
    #: B⁻¹ r
    added: Array
    #: corrections along the rod without those of the unknowns, and what the groups of pieces take from them
    w: Array
    beta: Array
    dy: Array
    unknowns: Array


class EliminationCode(RodCode):
    """Functions that factor a linearisation and solve for corrections."""

    solved: Function
    advance: Function

    def __init__(self, equations: Equations, robots: bool, lanes: int):
        super().__init__(equations, robots, lanes)
        system = equations.system
        self.elimination = Elimination(equations)
        self.pivots = [int(index) for index in pivots_of(system)]
        ny, k, a, by_rows = self.equations.ny, self.equations.k, self._array, self._by_rows
        self.factor = a(len(self.elimination.factors), self.pieces)
        #: columns of B⁻¹ A, and B⁻¹ r: places in lanes, and rows in lanes for the recursion along the rod
        self.wide_matrix, self.wide_added = a(ny * ny, self.pieces), a(ny, self.pieces)
        self.matrix, self.added = self.wide_matrix, self.wide_added
        if not robots:
            self.matrix, self.added = by_rows(ny, ny, self.pieces), by_rows(ny, 1, self.pieces)
        #: columns of the unknowns along the rod
        self.X = by_rows(ny, k, self.points)
        self.groups = _each(self.pieces), (self.pieces - 1) // _each(self.pieces)
        self.T, self.M, self.inverse = by_rows(k, k, self.groups[1]), by_rows(k, ny, 1), by_rows(k, k, 1)
        self.zeros = by_rows(ny, 1, 1)
        #: the solution, its unknowns, and the correction of both
        self.y, self.unknowns = a(ny, self.ends), a(k, 1)
        self.dy, self.step_unknowns = a(ny, self.ends), a(k, 1)
        self.correction = Correction(
            self.r, self.tip, self.added, by_rows(ny, 1, self.points), by_rows(k, 1, self.groups[1]),
            self.dy if robots else by_rows(ny, 1, self.points), self.step_unknowns,
        )  # fmt: skip
        #: history terms of the step
        self.H = a(self.equations.numbers, self.count)

    def _write_solved(self) -> Function:
        """A piece's B⁻¹ r."""
        f, el = self._function("solved", "from", "to", "n_piece"), self.elimination
        _, source, target, piece = f.arguments
        j, component = f.index(piece), self.wide_added.component
        known = {int(node): self._get(self.factor, k, j, self.L) for k, node in enumerate(el.stored)}
        known |= {int(node): f.load(source, i * component, self.L) for i, node in enumerate(el.r)}
        values = f.evaluate(el.program, el.solved, known, self.L)
        for i, node in enumerate(el.solved):
            f.store(values[node], target, i * component, self.L)
        return f

    def _write_factor(self) -> None:
        """Factors and the matrix B⁻¹ A of all pieces, from the slopes at their ends."""
        f, el, n = self._function("factored"), self.elimination, self.equations.ny
        self.factored = f
        memory = f.arguments[0]
        with self._places(self.pieces) as j:
            known = {el.h: self._wide(self.h, 0, j)}
            for array, nodes in ((self.slope, el.start), (self.slope_end, el.end), (self.jump, el.jump)):
                known |= {int(node): self._wide(array, k, j) for k, node in enumerate(nodes)}
            outputs = [*el.factors, *map(int, el.matrix.reshape(-1))]
            values = f.evaluate(el.program, outputs, known, self.L)
            for k, node in enumerate(el.factors):
                self._write_wide(values[node], self.factor, k, j)
            for i, c in np.ndindex(n, n):
                self._write_wide(values[int(el.matrix[i, c])], self.wide_matrix, c * n + i, j)
        with self._places(self.pieces) as j:
            first = self._pointer(self.wide_matrix, j)
            with f.loop(n) as c:
                column = f.pointer(first, c.value * (n * self.wide_matrix.component))
                f.call(self.solved, memory, column, column, j.value)
        if not self.batch:
            with f.loop(n) as c:
                source = c.value * (n * self.wide_matrix.component) + self.wide_matrix.offset
                target = c.value * self._padded(n) + self.matrix.offset
                with f.loop(self.pieces) as j:
                    self._copy(
                        n, (f.pointer(memory, source + j.value), self.wide_matrix.component),
                        (f.pointer(memory, target + j.value * self.matrix.place), 1),
                    )  # fmt: skip

    def _copy(self, count: int, source: tuple[Value, int], target: tuple[Value, int]) -> None:
        """Write numbers from an address to another, each with the distance between numbers."""
        f = self._now
        for i in range(count):
            f.store(f.load(source[0], i * source[1]), target[0], i * target[1])

    def _write_advance(self) -> Function:
        """A column at a piece's start to its end: B⁻¹ A x plus what is added."""
        el, n = self.elimination, self.equations.ny
        f = self._function("advance", "from", "added", "to", "n_piece")
        _, source, added, target, piece = f.arguments
        width, j, lanes = self._rows_at_once, f.index(piece), self.P
        component = 1 if width > 1 else self.L
        x = [f.load(source, c * component, lanes) for c in range(n)]
        for row in self._blocks(n):
            # two sums, because each addition waits for the one before
            sums = [f.load(added, row * component, self.L), f.splat(f.value(0.0), self.L)]
            for c in range(n):
                if el.nonzero[row : row + width, c].any():
                    entry = self._get(self.matrix, c * self._padded(n) + row, j, self.L)
                    sums = [sums[1], sums[0] + entry * x[c]]
            f.store(sums[0] + sums[1], target, row * component, self.L)
        return f

    def _changed(self, columns: list[list[Value]], pivots: list[int]) -> list[list[Value]]:
        """Write X T, with T the inverse of X's rows of pivots, and return T; X's columns are replaced."""
        k = len(columns)
        eye = [self._unit_column(c, k) for c in range(k)]
        for r, pivot in enumerate(pivots):
            scale = 1.0 / self._entry(columns[r], pivot)
            factors = [self._entry(column, pivot) * scale for column in columns]
            for matrix in (columns, eye):
                pivotal = matrix[r]
                for c in range(k):
                    if c != r:
                        pairs = zip(matrix[c], pivotal, strict=True)
                        matrix[c] = [a - factors[c] * b for a, b in pairs]
                matrix[r] = [scale * b for b in pivotal]
        return eye

    def _unit_column(self, c: int, rows: int) -> list[Value]:
        f = self._now
        if self.batch:
            return [f.splat(f.value(float(i == c)), self.L) for i in range(rows)]
        lanes = range(self.L)
        return [f.joined([f.value(float(row + i == c)) for i in lanes]) for row in self._blocks(rows)]

    def _write_along(self) -> None:
        """X along the rod from the base; at the tip the inverse of M X."""
        ny, k = self.equations.ny, self.equations.k
        self.along = f = self._function("along")
        memory = f.arguments[0]
        zero = self._pointer(self.zeros, 0)
        size, count = self.groups

        def piece(j: Index) -> None:
            for c in range(k):
                first = c * self._padded(ny)
                source, target = (f.pointer(*self._at(self.X, first, point)) for point in (j, j + 1))
                f.call(self.advance, memory, source, zero, target, j.value)

        with f.loop(count) as g:
            with f.loop((g.value + 1) * size, g.value * size) as j:
                piece(j)
            last = f.index((g.value + 1) * size)
            columns = [self._column(self.X, ny, c, last) for c in range(k)]
            T = self._changed(columns, self.pivots)
            for c in range(k):
                self._set_column(columns[c], self.X, ny, c, last)
                self._set_column(T[c], self.T, k, c, g)
        with f.loop(self.pieces, count * size) as j:
            piece(j)
        at_tip = [self._column(self.X, ny, c, self.points - 1) for c in range(k)]
        M = [self._column(self.M, k, i) for i in range(ny)]
        products = [self._product(M, [self._entry(column, i) for i in range(ny)]) for column in at_tip]
        for c, column in enumerate(self._changed(products, list(range(k)))):
            self._set_column(column, self.inverse, k, c)

    def _product(self, columns: list[list[Value]], x: list[Value]) -> list[Value]:
        """Return a matrix times a vector."""
        found = [x[0] * part for part in columns[0]]
        for column, number in zip(columns[1:], x[1:], strict=True):
            found = [a + number * part for a, part in zip(found, column, strict=True)]
        return found

    def _write_linearise(self) -> None:
        """Rates, slopes and factors at y."""
        e = self.equations
        self.linearised = f = self._function("linearised")
        memory = f.arguments[0]
        far = self._write_far(self.y, self.H, slopes=True)
        with self._places(self.ends) as j:
            self._rates_at(self.rates_and_slopes, far, self.H, j)
        self._write_ends(self.slope, self.slope_end)
        f.call(self.factored, memory)
        for nodes, state, array, rows in (
            (e.base_slopes, self._base_state(self.unknowns, self.H), self.X, e.ny),
            (e.tip_slopes, self._tip_state(self.y, self.H), self.M, e.k),
        ):
            values = self._evaluated(nodes.reshape(-1), 0, False, state)
            for (i, c), value in zip(np.ndindex(nodes.shape), values, strict=True):
                self._put(value, array, c * self._padded(rows) + i)
        f.call(self.along, memory)

    def _write_correct(self) -> None:
        """The correction of all points and of the unknowns, from the defects."""
        ny = self.equations.ny
        self.correct = f = self._function("correct")
        memory = f.arguments[0]
        with self._places(self.pieces) as j:
            f.call(self.solved, memory, self._pointer(self.r, j), self._pointer(self.wide_added, j), j.value)
        if not self.batch:
            with f.loop(self.pieces) as j:
                source = self._pointer(self.wide_added, j), self.wide_added.component
                self._copy(ny, source, (self._pointer(self.added, j), 1))
        self._write_correction(self.correction, self.advance)
        if not self.batch:
            with f.loop(self.points) as j:
                source = self._pointer(self.correction.dy, j), 1
                self._copy(ny, source, (self._pointer(self.dy, j), self.dy.component))

    def _write_correction(self, arrays: Correction, advance: Function) -> None:
        """Solve for a correction, from B⁻¹ r of all pieces."""
        f, ny, k = self._now, self.equations.ny, self.equations.k
        memory, (size, count) = f.arguments[0], self.groups

        def piece(j: Index) -> None:
            start, added, end = (arrays.w, j), (arrays.added, j), (arrays.w, j + 1)
            f.call(advance, memory, *(self._pointer(*each) for each in (start, added, end)), j.value)

        with f.loop(count) as g:
            with f.loop((g.value + 1) * size, g.value * size) as j:
                piece(j)
            last = f.index((g.value + 1) * size)
            w = self._column(arrays.w, ny, 0, last)
            columns = [self._column(self.X, ny, c, last) for c in range(k)]
            moved = self._product(columns, [self._entry(w, pivot) for pivot in self.pivots])
            self._set_column([a - b for a, b in zip(w, moved, strict=True)], arrays.w, ny, 0, last)
            self._set_column(self._gathered(w), arrays.beta, k, 0, g)
        with f.loop(self.pieces, count * size) as j:
            piece(j)
        w = self._column(arrays.w, ny, 0, self.points - 1)
        M = [self._column(self.M, k, i) for i in range(ny)]
        tip = self._product(M, [self._entry(w, i) for i in range(ny)])
        tip = [a + b for a, b in zip(tip, self._column(arrays.tip, k), strict=True)]
        inverse = [self._column(self.inverse, k, c) for c in range(k)]
        alpha = [
            Variable(f, -each) for each in self._product(inverse, [self._entry(tip, c) for c in range(k)])
        ]

        def correct(start: Any, stop: Any) -> None:
            """Write the corrections of points that share their unknowns."""
            numbers = [self._entry([each.get() for each in alpha], c) for c in range(k)]
            with f.loop(stop, start) as j:
                columns = [self._column(self.X, ny, c, j) for c in range(k)]
                moved = self._product(columns, numbers)
                w = self._column(arrays.w, ny, 0, j)
                self._set_column([a + b for a, b in zip(w, moved, strict=True)], arrays.dy, ny, 0, j)

        correct(count * size + 1, self.points)
        with f.loop(0, count - 1, -1) as g:
            end = (g.value + 1) * size
            correct(end, end + 1)
            change = [a.get() - b for a, b in zip(alpha, self._column(arrays.beta, k, 0, g), strict=True)]
            T = [self._column(self.T, k, c, g) for c in range(k)]
            for variable, value in zip(
                alpha, self._product(T, [self._entry(change, c) for c in range(k)]), strict=True
            ):
                variable.set(value)
            correct(g.value * size + 1, end)
        correct(0, 1)
        self._set_column([each.get() for each in alpha], arrays.unknowns, k)

    def _gathered(self, w: list[Value]) -> list[Value]:
        """Return the rows of pivots of a column."""
        if self._rows_at_once == 1:
            return [w[pivot] for pivot in self.pivots]
        f, rows = self._now, [self._now.lane(w[p // self.L], p % self.L) for p in self.pivots]
        rows += [f.value(0.0)] * (self._padded(len(rows)) - len(rows))
        return [f.joined(rows[first : first + self.L]) for first in self._blocks(len(self.pivots))]
