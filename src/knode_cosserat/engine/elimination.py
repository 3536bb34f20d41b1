"""Code of the linear equations of a correction: elimination along the rod.

    δy_0 = S δξ,     B δy_{j+1} = A δy_j + r_j,     M δy_N = -tip

From base to tip every solution is written as δy_j = X_j α_j + w_j. α_j are the values at point j of the
fields that are unknown at the base. For a clamped rod these are force and moment, and X is the compliance of
the rod behind the point. After every few pieces α changes to the values at the point that is reached. Waves
that grow along the rod are thereby kept apart, and rounding errors stay small. This is the Riccati form of
the method of particular solutions (Ascher, Mattheij & Russell 1995, ch. 4).
"""

from __future__ import annotations

import functools
import itertools
import math
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np

from knode_cosserat.engine.codegen import Function, Index, StackVariable, Value
from knode_cosserat.engine.equations import Elimination, Equations
from knode_cosserat.engine.program import EngineError
from knode_cosserat.engine.rod import RodCode
from knode_cosserat.schemes.problem import FILLING

#: columns that are solved side by side: each operation of a column waits for the one before
COLUMNS = 2
#: corrections between nodes with new factors, and the largest, in natural units, after which none is needed
RENEWALS, FILLED = 2, 1e-10


class EliminationCode(RodCode):
    """Functions that factor a linearisation and solve for corrections."""

    solve_piece: Function
    advance: Function
    #: true if A and B are needed, and not B⁻¹ A
    keeps_both = False

    def __init__(self, equations: Equations, robots: bool):
        super().__init__(equations, robots)
        system = equations.system
        self.elimination = Elimination(equations)
        e, a, by_rows = self.equations, self._array, self._by_rows
        ny, k = e.ny, e.k
        #: number of unknowns of a strand, and their rows in y
        self.own = k // self.strands
        unknown = system.y_layout.indices(system.base_unknowns)
        self.pivots = [int(index) for index in unknown[: self.own]]
        if any(i // ny != c // self.own for i, c, _ in self.equations.base_slopes):
            raise EngineError("engine: the base of a strand depends on the unknowns of another")
        #: structural nonzeros of X, of a change of the unknowns, and of M
        self.nonzero_X, self.nonzero_T = self._nonzeros_along()
        self.nonzero_M = np.zeros((k, ny), dtype=bool)
        for i, c, _ in self.equations.tip_slopes:
            self.nonzero_M[i, c % ny] = True
        self.factor = a(len(self.elimination.factors), "pieces")
        #: true if B⁻¹ A is formed; the recursion along the rod solves by B in every piece if it is not
        self.has_matrix = not (robots or self.keeps_both)
        if self.keeps_both:
            self.entries = a(len(self.elimination.entries), "pieces")
        if not self.has_matrix:
            self.added = self.r
        else:
            #: columns of B⁻¹ A, and B⁻¹ r: places in lanes, and rows in lanes for the recursion along the rod
            self.wide_matrix = a(ny * (ny + 1), "pieces")
            self.matrix, self.added = by_rows(ny, ny, "pieces"), by_rows(ny, 1, "pieces")
        if not robots:
            self.wide_added = a(ny, "pieces")
        #: columns of the unknowns along the rod
        self.X = by_rows(ny, self.own, "points")
        self.T = by_rows(self.own, self.own, "groups")
        self.M, self.inverse = by_rows(k, ny, self.strands), by_rows(k, k, 1)
        #: M X with orthogonal columns, and the factor that makes them so
        self.at_tip, self.triangle = by_rows(k, k, 1), by_rows(k, k, 1)
        self.zeros = by_rows(ny, 1, 1)
        #: the solution, its unknowns, and the correction of both
        self.y, self.unknowns = a(ny, "ends"), a(k)
        self.dy, self.step_unknowns = a(ny, "ends"), a(k)
        #: corrections along the rod at fixed unknowns, changes of unknowns at the ends of groups of pieces,
        #: all corrections, and those of each strand's unknowns
        self.w, self.beta = by_rows(ny, 1, "points"), by_rows(self.own, 1, "groups")
        self.column_dy = self.dy if robots else by_rows(ny, 1, "points")
        self.alpha = by_rows(self.own, 1, self.strands)
        #: history terms of the step
        self.H = a(self.equations.numbers, "count")

    @property
    def groups(self) -> tuple[Value, Value]:
        """Number of pieces of a group, and of groups of a strand."""
        return self._count("pieces of group"), self._count("groups of strand")

    def _nonzeros_along(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the structural nonzeros of X and of T anywhere along the rod."""
        ny, X, T = (
            self.equations.ny,
            np.zeros((self.equations.ny, self.own), dtype=bool),
            np.eye(self.own) > 0,
        )
        for i, c, _ in self.equations.base_slopes:
            X[i % ny, c % self.own] = True
        for _ in range(self.own + ny):
            T = T @ T | X[self.pivots]
            X = X | self.elimination.nonzero @ X | X @ T
        return X, T

    def _nonzero_blocks(self, nonzero: np.ndarray) -> list[bool]:
        """Return true for the blocks of a column that are not zero."""
        return [bool(nonzero[row : row + self._rows_at_once].any()) for row in self._blocks(len(nonzero))]

    def _write_piece_solution(
        self, name: str = "solve_piece", columns: int = 1, rows: Sequence[int] = ()
    ) -> Function:
        """A piece's B⁻¹ r, of one column or of several one after the other, which are zero in other rows."""
        f, el = self._function(name, "from", "to", "n_piece"), self.elimination
        _, source, target, piece = f.arguments
        j, component = f.index(piece), self.r.component
        n = len(el.r)
        rows = rows or range(n)
        factors, every = self._factors_at(j), list[dict[int, Any]]()
        for c in range(columns):
            own = {int(el.r[i]): f.load(source, (c * n + i) * component, self.L) for i in rows}
            every.append(factors | own)
        for c, values in enumerate(f.side_by_side(el.program, [el.solution[i] for i in rows], every)):
            for i in rows:
                f.store(values[el.solution[i]], target, (c * n + i) * component, self.L)
        return f

    def _blocks_of_rows(self) -> list[range]:
        """Return the ranges of rows of B⁻¹ A that are not coupled, such as the rods of an assembly."""
        nonzero = self.elimination.nonzero | self.elimination.nonzero.T
        ends = (i for i in range(1, len(nonzero) + 1) if not nonzero[:i, i:].any())
        return [range(*bounds) for bounds in itertools.pairwise([0, *ends])]

    def _write_factor(self) -> None:
        """Factors and the matrix B⁻¹ A of all pieces, from the slopes at their ends and stages."""
        el, n, blocks = self.elimination, self.equations.ny, self._blocks_of_rows()
        # a function for each block: LLVM's time grows faster than the size of a function
        self.factors = [self._write_factor_of(f"factorise{k}", rows) for k, rows in enumerate(blocks)]
        # nothing is to be solved for a constant field
        blocks = [rows for rows in blocks if any(el.solution[i] != int(el.r[i]) for i in rows)]
        if self.has_matrix:
            solved_columns = [
                self._write_piece_solution(f"solved_columns{k}", COLUMNS, rows)
                for k, rows in enumerate(blocks)
            ]
        self.factorise = f = self._function("factorise")
        memory = f.arguments[0]
        for function in self.factors:
            f.call(function, memory)
        if not self.has_matrix:
            return
        with self._places(self._count("pieces")) as j:
            first = self._pointer(self.wide_matrix, j)
            for rows, function in zip(blocks, solved_columns, strict=True):
                # the last column may be another block's, zero in these rows
                with f.loop(rows.stop, rows.start, COLUMNS) as c:
                    column = f.pointer(first, c.value * (n * self.wide_matrix.component))
                    f.call(function, memory, column, column, j.value)
        with f.loop(n) as c:
            source = c.value * (n * self.wide_matrix.component) + self.wide_matrix.offset
            target = c.value * self._padded(n) + self.matrix.offset
            wide = f.pointer(memory, source), self.wide_matrix.component
            columns = f.pointer(memory, target), self.matrix.place
            self._transpose(n, self._count("pieces"), wide, columns)

    def _write_factor_of(self, name: str, block: range) -> Function:
        """Factors and A of all pieces, in a block of rows and columns."""
        f, el, n = self._function(name), self.elimination, self.equations.ny
        factors = [k for k, (i, _) in enumerate(el.places) if i in block]
        entries = [k for k, (i, _) in enumerate(el.entries) if i in block]
        outputs = [] if self.batch else [int(node) for node in el.matrix[block][:, block].flat]
        outputs += [el.factors[k] for k in factors]
        with self._places(self._count("pieces")) as j:
            known = self._slopes_at(j)
            results = [(self.factor, [(k, el.factors[k]) for k in factors])]
            if self.keeps_both:
                results += [(self.entries, [(k, el.matrix[el.entries[k]]) for k in entries])]
            if self.has_matrix:
                inside = itertools.product(block, block)
                results += [(self.wide_matrix, [(c * n + i, el.matrix[i, c]) for i, c in inside])]
            f.evaluate(el.program, outputs, known, self.L, stores=self._stores(results, j))
        return f

    def _slopes_at(self, j: Index) -> dict[int, Any]:
        """Return functions that read the slopes, jumps and length of a piece."""
        el = self.elimination
        slopes = self._places_of((self.slope, self.slope_end), j)[: len(el.slopes)]
        known: dict[int, Any] = {el.h: functools.partial(self._wide, self.h, 0, j)}
        for (array, at), nodes in zip((*slopes, (self.jump, j)), (*el.slopes, el.jump), strict=True):
            known |= {int(node): functools.partial(self._wide, array, k, at) for k, node in enumerate(nodes)}
        return known

    def _factors_at(self, j: Index) -> dict[int, Any]:
        """Return functions that read the factors of a piece."""
        stored = enumerate(self.elimination.stored)
        return {int(node): functools.partial(self._wide, self.factor, k, j) for k, node in stored}

    def _write_advance_of(self, name: str, columns: int, has_added: bool) -> Function:
        """Columns of all robots at a piece's start to its end, side by side, perhaps with an added column."""
        el, n = self.elimination, self.equations.ny
        f = self._function(name, "from", *["added"] * has_added, "to", "n_piece")
        _, source, *added, target, piece = f.arguments
        j = f.index(piece)
        zero = f.splat(f.value(0.0), self.L)
        known, every = self._slopes_at(j) | self._factors_at(j), list[dict[int, Any]]()
        for c in range(columns):
            own = {int(node): f.load(source, (c * n + i) * self.L, self.L) for i, node in enumerate(el.x)}
            for i, node in enumerate(el.r):
                own[int(node)] = f.load(added[0], i * self.L, self.L) if has_added else zero
            every.append(known | own)
        for c, values in enumerate(f.side_by_side(el.program, el.advance, every)):
            for i, node in enumerate(el.advance):
                f.store(values[node], target, (c * n + i) * self.L, self.L)
        return f

    def _write_advance(self) -> Function:
        """A column at a piece's start to its end: B⁻¹ A x plus an added column."""
        if self.batch:
            return self._write_advance_of("advance", 1, True)
        el, n = self.elimination, self.equations.ny
        f = self._function("advance", "from", "added", "to", "n_piece")
        _, source, added, target, piece = f.arguments
        width, j, component = self._rows_at_once, f.index(piece), 1
        x = [f.load(source, c) for c in range(n)]
        for row in self._blocks(n):
            # two sums, because each addition waits for the one before
            sums = [f.load(added, row * component, self.L), f.splat(f.value(0.0), self.L)]
            for c in range(n):
                if el.nonzero[row : row + width, c].any():
                    entry = self._get(self.matrix, c * self._padded(n) + row, j, self.L)
                    sums = [sums[1], sums[0] + entry * x[c]]
            f.store(sums[0] + sums[1], target, row * component, self.L)
        return f

    def _changed(self, columns: list[list[Value]]) -> list[list[Value]]:
        """Write X T, with T the inverse of X's rows of pivots, and return T; X's columns are replaced."""
        k = len(columns)
        eye = [self._unit_column(c, k) for c in range(k)]
        for r, pivot in enumerate(self.pivots):
            scale = 1.0 / self._entry(columns[r], pivot)
            others = [c for c in range(k) if c != r and self.nonzero_X[pivot, c]]
            factors = {c: self._entry(columns[c], pivot) * scale for c in others}
            for matrix, nonzero in ((columns, self.nonzero_X), (eye, self.nonzero_T)):
                pivotal, used = matrix[r], self._nonzero_blocks(nonzero[:, r])
                for c in others:
                    blocks = zip(matrix[c], pivotal, used, strict=True)
                    matrix[c] = [a - factors[c] * b if some else a for a, b, some in blocks]
                matrix[r] = [scale * b if some else b for b, some in zip(pivotal, used, strict=True)]
        return eye

    def _unit_column(self, c: int, rows: int) -> list[Value]:
        f = self._now
        if self.batch:
            return [f.splat(f.value(float(i == c)), self.L) for i in range(rows)]
        lanes = range(self.L)
        return [f.join([f.value(float(row + i == c)) for i in lanes]) for row in self._blocks(rows)]

    def _write_along(self) -> None:
        """X along the strands from their bases; at the tips the inverse of M X."""
        ny, k, own = self.equations.ny, self.equations.k, self.own
        width, advance = 1, self.advance
        if self.batch:
            # two share their factors where there are 32 registers; 16 are too few
            width = math.gcd(own, self.L // 4)
            advance = self._write_advance_of("advance_columns", width, False)
        self.along = f = self._function("along")
        memory = f.arguments[0]
        zero = [] if self.batch else [self._pointer(self.zeros, 0)]
        size, count = self.groups

        def piece(j: Index) -> None:
            for c in range(0, own, width):
                first = c * self._padded(ny)
                source, target = (f.pointer(*self._at(self.X, first, point)) for point in (j, j + 1))
                f.call(advance, memory, source, *zero, target, j.value)

        with f.loop(self.strands) as strand:
            base = strand.value * self._count("points of strand")
            with f.loop(count) as g:
                last = f.index(base + (g.value + 1) * size)
                with f.loop(last.value, base + g.value * size) as j:
                    piece(j)
                columns = [self._column(self.X, ny, c, last) for c in range(own)]
                T = self._changed(columns)
                group = f.index(strand.value * count + g.value)
                for c in range(own):
                    self._set_column(columns[c], self.X, ny, c, last)
                    self._set_column(T[c], self.T, own, c, group)
            tip = f.index(base + self._count("tip 0"))
            with f.loop(tip.value, base + count * size) as j:
                piece(j)
            M = [self._column(self.M, k, i, strand) for i in range(ny)]
            component, lanes = self.X.component, self.P
            for c in range(own):
                x = f.pointer(*self._at(self.X, c * self._padded(ny), tip))
                rows = [i for i in range(ny) if self.nonzero_X[i, c]]
                product = self._product(
                    [M[i] for i in rows],
                    [f.load(x, i * component, lanes) for i in rows],
                    self.nonzero_M[:, rows],
                )
                column = f.pointer(memory, (strand.value * own + c) * (self._padded(k) * component))
                for row, value in zip(self._blocks(k), product, strict=True):
                    f.store(value, column, self.at_tip.at(row, 0), self.L)
        self._write_inverse()

    def _of_X(self, row: int, column: int) -> int:
        """Return the component of an entry of X."""
        return column * self._padded(self.equations.ny) + row

    def _write_inverse(self) -> None:
        """The inverse of M X, by orthogonal columns (Gram-Schmidt), in the units of the residual.

        With Q = M X W, in which the columns of Q are orthonormal, the inverse is W Qᵀ. There is no pivot to
        choose, which would differ from lane to lane.
        """
        f, k, component = self._now, self.equations.k, self.inverse.component
        rows = [row * component for row in self._blocks(k)]
        Q, W, inverse = (self._pointer(each, 0) for each in (self.at_tip, self.triangle, self.inverse))

        def column(matrix: Value, c: Index) -> Value:
            return f.pointer(matrix, c.value * (self._padded(k) * component))

        def total(products: list[Value]) -> Value:
            found = functools.reduce(operator.add, products)
            return found if self.batch else f.total(found)

        with f.loop(k) as c:
            for at in rows:
                f.store(0.0, column(W, c), at, self.L)
            f.store(1.0, column(W, c), c.value * component, self.P)
            for i in range(k):
                number = f.load(column(Q, c), i * component, self.P)
                f.store(number * self._get(self.scale_tip, i), column(Q, c), i * component)
        with f.loop(k) as c:
            # twice, because rounding leaves some of the other columns (Giraud et al. 2005)
            with f.loop(2), f.loop(c.value) as r:
                pairs = [(f.load(column(Q, r), at, self.L), f.load(column(Q, c), at, self.L)) for at in rows]
                factor = total([one * other for one, other in pairs])
                for matrix in (Q, W):
                    for at in rows:
                        change = factor * f.load(column(matrix, r), at, self.L)
                        f.store(f.load(column(matrix, c), at, self.L) - change, column(matrix, c), at)
            own = [f.load(column(Q, c), at, self.L) for at in rows]
            scale = 1.0 / f.apply("sqrt", total([each * each for each in own]))
            for matrix in (Q, W):
                for at in rows:
                    f.store(scale * f.load(column(matrix, c), at, self.L), column(matrix, c), at)
        with f.loop(k) as c:
            found = [self._wide_variable(0.0) for _ in rows]
            with f.loop(k) as r:
                number = f.load(column(Q, r), c.value * component, self.P)
                for each, at in zip(found, rows, strict=True):
                    each.set(each.get() + number * f.load(column(W, r), at, self.L))
            unit = f.load(
                f.pointer(self._pointer(self.scale_tip, 0), c.value * self.scale_tip.component), 0, self.P
            )
            for each, at in zip(found, rows, strict=True):
                f.store(each.get() * unit, column(inverse, c), at)

    def _product(
        self, columns: list[list[Value]], x: list[Value], nonzero: np.ndarray | None = None
    ) -> list[Value]:
        """Return a matrix times a vector; `nonzero` are the matrix's structural nonzeros."""
        found: list[Any] = [None] * len(columns[0])
        for c, (column, number) in enumerate(zip(columns, x, strict=True)):
            used = [True] * len(column) if nonzero is None else self._nonzero_blocks(nonzero[:, c])
            for block, part in enumerate(column):
                if used[block]:
                    product = number * part
                    found[block] = product if found[block] is None else found[block] + product
        zero = self._now.splat(self._now.value(0.0), self.L)
        return [zero if each is None else each for each in found]

    def _write_linearise(self) -> None:
        """Rates, slopes and factors at y."""
        e = self.equations
        self.linearise = f = self._function("linearise")
        memory = f.arguments[0]
        self._write_places(self.rates_and_slopes, self.y, self.H, slopes=True)
        self._write_ends(self.slope, self.slope_end)
        f.call(self.factorise, memory)
        state = self._base_state(self.unknowns, self.H)
        values = self._evaluate([node for *_, node in self.equations.base_slopes], 0, False, state)
        for (i, c, _), value in zip(self.equations.base_slopes, values, strict=True):
            strand, row = divmod(i, e.ny)
            self._put(value, self.X, self._of_X(row, c % self.own), self.bases[strand])
        state = self._tip_state(self.y, self.H)
        values = self._evaluate([node for *_, node in self.equations.tip_slopes], 0, False, state)
        for (i, c, _), value in zip(self.equations.tip_slopes, values, strict=True):
            strand, column = divmod(c, e.ny)
            self._put(value, self.M, column * self._padded(e.k) + i, strand)
        f.call(self.along, memory)

    def _write_correct(self) -> None:
        """The correction of all points and of the unknowns, from the defects."""
        ny = self.equations.ny
        self.correct = f = self._function("correct")
        memory = f.arguments[0]
        if not self.batch:
            with self._places(self._count("pieces")) as j:
                points = self._pointer(self.r, j), self._pointer(self.wide_added, j)
                f.call(self.solve_piece, memory, *points, j.value)
            wide = self._pointer(self.wide_added, 0), self.wide_added.component
            columns = self._pointer(self.added, 0), self.added.place
            self._transpose(ny, self._count("pieces"), wide, columns)
        self._write_correction()
        if not self.batch:
            wide = self._pointer(self.dy, 0), self.dy.component
            columns = self._pointer(self.column_dy, 0), self.column_dy.place
            self._transpose(ny, self._count("points"), wide, columns, back=True)
        for k in range(self.equations.k):
            strand, i = divmod(k, self.own)
            self._put(self._get(self.alpha, i, strand), self.step_unknowns, k)

    def _write_filling(self, most: Any, slopes: Function, rates: Function) -> None:
        """Corrections of y at points between nodes (see `StepProblem.filled`), at most `most` in a segment.

        `slopes` and `rates` are functions at a place. The first corrections for each point have new factors.
        """
        f, ny = self._now, self.equations.ny
        left, turns = StackVariable(f, f.value(math.inf)), StackVariable(f, f.value(0, "i64"))
        with f.while_(lambda: (left.get() > FILLED) & (turns.get() < most * FILLING)):
            turn = f.result(f"srem i64 {turns.get().name}, {FILLING}", "i64")
            with f.if_(turn < RENEWALS):
                self._write_places(slopes, self.y, self.H, slopes=True)
                self._write_ends(self.slope, self.slope_end)
                for function in self.factors:
                    f.call(function, f.arguments[0])
            with f.if_(~(turn < RENEWALS)):
                self._write_places(rates, self.y, self.H)
            self._write_defects(self.y, self.H)
            with self._places(self._count("pieces")) as j:
                points = self._pointer(self.r, j), self._pointer(self.wide_added, j)
                f.call(self.solve_piece, f.arguments[0], *points, j.value)
            left.set(0.0)
            with f.loop(self._count("filled")) as cut:
                point = self._from_table(self.filled.offset, cut.value * 3)
                for i in range(ny):
                    change = self._get(self.wide_added, i, point + -1)
                    self._put(self._get(self.y, i, point) + change, self.y, i, point)
                    unit = self._get(self.scale_y, i, point if self.strands > 1 else 0)
                    left.set(f.apply("max", left.get(), f.apply("abs", change) * unit))
            turns.set(turns.get() + 1)

    def _write_correction(self) -> None:
        """Solve for a correction, from B⁻¹ r of all pieces."""
        f, ny, k, own = self._now, self.equations.ny, self.equations.k, self.own
        memory, (size, count) = f.arguments[0], self.groups

        def piece(j: Index) -> None:
            start, added, end = (self.w, j), (self.added, j), (self.w, j + 1)
            f.call(self.advance, memory, *(self._pointer(*each) for each in (start, added, end)), j.value)

        tips = [StackVariable(f, each) for each in self._column(self.tip, k)]
        with f.loop(self.strands) as strand:
            base = strand.value * self._count("points of strand")
            with f.loop(count) as g:
                last = f.index(base + (g.value + 1) * size)
                with f.loop(last.value, base + g.value * size) as j:
                    piece(j)
                w = self._column(self.w, ny, 0, last)
                columns = [self._column(self.X, ny, c, last) for c in range(own)]
                moved = self._product(
                    columns, [self._entry(w, pivot) for pivot in self.pivots], self.nonzero_X
                )
                self._set_column([a - b for a, b in zip(w, moved, strict=True)], self.w, ny, 0, last)
                group = f.index(strand.value * count + g.value)
                self._set_column(self._gather(w, self.pivots), self.beta, own, 0, group)
            tip = f.index(base + self._count("tip 0"))
            with f.loop(tip.value, base + count * size) as j:
                piece(j)
            w = self._column(self.w, ny, 0, tip)
            M = [self._column(self.M, k, i, strand) for i in range(ny)]
            products = self._product(M, [self._entry(w, i) for i in range(ny)], self.nonzero_M)
            for variable, value in zip(tips, products, strict=True):
                variable.set(variable.get() + value)
        inverse = [self._column(self.inverse, k, c) for c in range(k)]
        tip_values = [each.get() for each in tips]
        unknowns = [-each for each in self._product(inverse, [self._entry(tip_values, c) for c in range(k)])]
        for q in range(self.strands):
            rows = list(range(q * own, (q + 1) * own))
            self._set_column(self._gather(unknowns, rows), self.alpha, own, 0, q)

        def correct(start: Any, stop: Any) -> None:
            """Write the corrections of points that share their unknowns."""
            numbers = [self._entry([each.get() for each in alpha], c) for c in range(own)]
            with f.loop(stop, start) as j:
                columns = [self._column(self.X, ny, c, j) for c in range(own)]
                moved = self._product(columns, numbers, self.nonzero_X)
                w = self._column(self.w, ny, 0, j)
                self._set_column([a + b for a, b in zip(w, moved, strict=True)], self.column_dy, ny, 0, j)

        with f.loop(self.strands) as strand:
            base = strand.value * self._count("points of strand")
            alpha = [StackVariable(f, each) for each in self._column(self.alpha, own, 0, strand)]
            correct(base + (count * size + 1), base + self._count("points of strand"))
            with f.loop(0, count - 1, -1) as g:
                end = base + (g.value + 1) * size
                correct(end, end + 1)
                group = f.index(strand.value * count + g.value)
                beta = self._column(self.beta, own, 0, group)
                change = [a.get() - b for a, b in zip(alpha, beta, strict=True)]
                T = [self._column(self.T, own, c, group) for c in range(own)]
                moved = self._product(T, [self._entry(change, c) for c in range(own)], self.nonzero_T)
                for variable, value in zip(alpha, moved, strict=True):
                    variable.set(value)
                correct(base + (g.value * size + 1), end)
            correct(base, base + 1)
            self._set_column([each.get() for each in alpha], self.alpha, own, 0, strand)

    def _gather(self, column: list[Value], rows: list[int]) -> list[Value]:
        """Return rows of a column as a column."""
        if self._rows_at_once == 1:
            return [column[row] for row in rows]
        f, numbers = self._now, [self._now.lane(column[p // self.L], p % self.L) for p in rows]
        numbers += [f.value(0.0)] * (self._padded(len(rows)) - len(rows))
        return [f.join(numbers[first : first + self.L]) for first in self._blocks(len(rows))]
