"""Code of the linear equations of a correction: elimination along the rod (see `solvers.linear`)."""

from __future__ import annotations

from knode_cosserat.engine.codegen import Function, Index, Value, Variable
from knode_cosserat.engine.equations import Elimination
from knode_cosserat.engine.memory import Array
from knode_cosserat.engine.rod import RodCode
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import pivots_of
from knode_cosserat.solvers.linear import _each


class EliminationCode(RodCode):
    """Functions that factor a linearisation and solve for corrections, of one vector or of columns."""

    advance: Function
    advance_columns: Function

    def __init__(self, system: System, robots: bool, lanes: int):
        super().__init__(system, robots, lanes)
        self.elimination = Elimination(self.equations)
        self.pivots = [int(index) for index in pivots_of(system)]
        ny, k, a = self.equations.ny, self.equations.k, self._array
        self.factor = a(len(self.elimination.factors), self.pieces)
        # the recursion along the rod reads one piece after the other
        self.pieces_in_turn = [self.slope, self.factor, self.jump]
        if not robots:
            self.pieces_in_turn = [self._by_place(each.size, self.pieces) for each in self.pieces_in_turn]
        self.w, self.X = a(ny, self.points), a(ny * k, self.points)
        groups = -(-self.pieces // _each(self.pieces))
        self.T, self.inverse = a(k * k, groups), a(k * k, 1)
        self.beta, self.alpha = a(k, groups), a(k, self.points)
        self.S, self.M = a(ny * k, 1), a(ny * k, 1)
        #: the solution, its unknowns, and the correction of both
        self.y, self.unknowns = a(ny, self.ends), a(k, 1)
        self.dy, self.step_unknowns = a(ny, self.ends), a(k, 1)
        #: history terms of the step
        self.H = a(self.equations.numbers, self.count)
        self.columns = [self._columns(ny * k) for _ in range(2)]

    def _write_factor(self) -> None:
        """Factors of all pieces, from the slopes at their ends."""
        f, el = self._function("factored"), self.elimination
        self.factored = f
        with self._places(self.pieces) as j:
            known = {int(node): self._wide(self.slope_end, k, j) for k, node in enumerate(el.end)}
            known[el.h] = self._wide(self.h, 0, j)
            values = f.evaluate(el.program, el.factors, known, self.L)
            for k, node in enumerate(el.factors):
                self._write_wide(values[node], self.factor, k, j)

    def _write_advance(self, name: str, columns: bool) -> Function:
        """A piece's B⁻¹ (A x + r), of one vector, or of the columns of a matrix without r."""
        el = self.elimination
        f = self._function(name, "from", "to", "n_piece")
        _, source, target, piece = f.arguments
        j = f.index(piece)
        lanes = self.L if columns else self.P
        step = self.L if self.batch or columns else self.w.component
        known = {el.h: self._get(self.h, 0, j)}
        for array, nodes in zip(self.pieces_in_turn, (el.start, el.stored, el.jump), strict=True):
            known |= {int(node): self._get(array, k, j) for k, node in enumerate(nodes)}
        known |= {int(node): f.load(source, i * step, lanes) for i, node in enumerate(el.x)}
        if not columns:
            known |= {int(node): self._get(self.r, i, j) for i, node in enumerate(el.r)}
        outputs = el.advanced[1 if columns else 0]
        values = f.evaluate(el.program, outputs, known, lanes)
        for i, node in enumerate(outputs):
            f.store(values[node], target, i * step, lanes)
        return f

    def _matrix(self, i: int, c: int) -> int:
        """Index of an entry of a matrix of `columns`."""
        return c * self.equations.ny + i if self.batch else i

    def _write_change(self) -> None:
        """Change of parameters: X T with T the inverse of X's rows of pivots, and T."""
        self.change = f = self._function("change", "n_group")
        group = f.index(f.arguments[1])
        e, columns = self.equations, self.columns[0]
        k = e.k
        rows = [self._row(columns, i) for i in range(e.ny)]
        eye = [self._unit_row(i) for i in range(k)]
        for r, pivot in enumerate(self.pivots):
            scale = 1.0 / self._entry(rows[pivot], r)
            g = [each * scale for each in rows[pivot]]
            g = self._with_entry(g, r, 1.0 - scale)
            for each in (rows, eye):
                for i, row in enumerate(each):
                    x = self._entry(row, r)
                    each[i] = [a - x * b for a, b in zip(row, g, strict=True)]
        for i, row in enumerate(rows):
            self._set_row(row, columns, i)
        for i, row in enumerate(eye):
            for c in range(k):
                self._put(self._entry(row, c), self.T, i * k + c, group)

    def _row(self, columns: Array, i: int) -> list[Value]:
        """Return a row of a matrix of `columns`: a list of robots' numbers, or one vector."""
        count = self.equations.k if self.batch else 1
        return [self._get(columns, self._matrix(i, c), 0, self.L) for c in range(count)]

    def _set_row(self, row: list[Value], columns: Array, i: int) -> None:
        for c, value in enumerate(row):
            self._put(value, columns, self._matrix(i, c), 0, self.L)

    def _unit_row(self, i: int) -> list[Value]:
        f, k = self._now, self.equations.k
        if self.batch:
            return [f.splat(f.value(float(c == i)), self.L) for c in range(k)]
        return [f.joined([f.value(float(c == i)) for c in range(self.L)])]

    def _entry(self, row: list[Value], c: int) -> Value:
        return row[c] if self.batch else self._now.lane(row[0], c)

    def _with_entry(self, row: list[Value], c: int, value: Value) -> list[Value]:
        if self.batch:
            return [*row[:c], value, *row[c + 1 :]]
        kind = row[0].type
        found = f"insertelement {kind} {row[0].name}, double {value.name}, i32 {c}"
        return [self._now.result(found, lanes=self.L)]

    def _write_along(self) -> None:
        """X along the rod, from S at the base; at the tip the inverse of M X."""
        e = self.equations
        k = e.k
        self.along = f = self._function("along")
        memory = f.arguments[0]
        one, other = self.columns
        for i in range(e.ny):
            if self.batch:
                self._set_row([self._get(self.S, i * k + c) for c in range(k)], one, i)
            else:
                numbers = [self._get(self.S, i * k + c) if c < k else f.value(0.0) for c in range(self.L)]
                self._set_row([f.joined(numbers)], one, i)
        each = _each(self.pieces)
        full = (self.pieces - 1) // each

        def piece(j: Index) -> None:
            for c in range(k if self.batch else 1):
                first = self._matrix(0, c)
                source, target = (f.pointer(memory, each.at(first, 0)) for each in (one, other))
                f.call(self.advance_columns, memory, source, target, j.value)
            for i in range(e.ny):
                self._set_row(self._row(other, i), one, i)

        def keep(j: Index) -> None:
            for i in range(e.ny):
                row = self._row(one, i)
                for c in range(k):
                    self._put(self._entry(row, c), self.X, i * k + c, j + 1)

        with f.loop(full) as g:
            with f.loop((g.value + 1) * each, g.value * each) as j:
                piece(j)
                keep(j)
            f.call(self.change, memory, g.value)
            keep(f.index((g.value + 1) * each - 1))
        with f.loop(self.pieces, full * each) as j:
            piece(j)
            keep(j)
        # M X at the tip and its inverse: reuse of the change of parameters
        rows = []
        for a in range(k):
            row = None
            for i in range(e.ny):
                if e.program.is_constant(int(e.tip_slopes[a, i]), 0.0):
                    continue
                term = [self._get(self.M, a * e.ny + i) * x for x in self._row(one, i)]
                row = term if row is None else [p + q for p, q in zip(row, term, strict=True)]
            assert row is not None
            rows.append(row)
        eye = [self._unit_row(i) for i in range(k)]
        for r in range(k):
            scale = 1.0 / self._entry(rows[r], r)
            changed = self._with_entry([x * scale for x in rows[r]], r, 1.0 - scale)
            for matrix in (rows, eye):
                for i, row in enumerate(matrix):
                    x = self._entry(row, r)
                    matrix[i] = [p - x * q for p, q in zip(row, changed, strict=True)]
        for i, row in enumerate(eye):
            for c in range(k):
                self._put(self._entry(row, c), self.inverse, i * k + c)

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
        if not self.batch:
            for source, target in zip((self.slope, self.factor, self.jump), self.pieces_in_turn, strict=True):
                self._write_in_turn(source, target)
        state = self._base_state(self.unknowns, self.H)
        for k, value in enumerate(self._evaluated(e.base_slopes.reshape(-1), 0, False, state)):
            self._put(value, self.S, k)
        for k, value in enumerate(
            self._evaluated(e.tip_slopes.reshape(-1), 0, False, self._tip_state(self.y, self.H))
        ):
            self._put(value, self.M, k)
        f.call(self.along, memory)

    def _write_in_turn(self, source: Array, target: Array) -> None:
        """Copy numbers with places in lanes to numbers by place."""
        f = self._now
        memory = f.arguments[0]
        with f.loop(self.pieces) as j, f.loop(source.size) as i:
            value = f.load(memory, i.value * source.component + (j.value + source.offset))
            f.store(value, memory, j.value * target.place + (i.value + target.offset))

    def _write_correct(self) -> None:
        """The correction of all points and of the unknowns, from the defects."""
        e = self.equations
        ny, k = e.ny, e.k
        self.correct = f = self._function("correct")
        memory = f.arguments[0]
        each = _each(self.pieces)
        full = (self.pieces - 1) // each
        for i in range(ny):
            self._put(0.0, self.w, i, 0)

        def piece(j: Index) -> None:
            source, target = self._pointer(self.w, j), self._pointer(self.w, j + 1)
            f.call(self.advance, memory, source, target, j.value)

        with f.loop(full) as g:
            with f.loop((g.value + 1) * each, g.value * each) as j:
                piece(j)
            last = f.index((g.value + 1) * each)
            beta = [self._get(self.w, p, last) for p in self.pivots]
            for c in range(k):
                self._put(beta[c], self.beta, c, g)
            for i in range(ny):
                w = self._get(self.w, i, last)
                for c in range(k):
                    w = w - self._get(self.X, i * k + c, last) * beta[c]
                self._put(w, self.w, i, last)
        with f.loop(self.pieces, full * each) as j:
            piece(j)
        at_tip = []
        for a in range(k):
            value = self._get(self.tip, a)
            for i in range(ny):
                if not e.program.is_constant(int(e.tip_slopes[a, i]), 0.0):
                    value = value + self._get(self.M, a * ny + i) * self._get(self.w, i, self.points - 1)
            at_tip.append(value)
        alpha = [Variable(f, f.splat(f.value(0.0), self.P)) for _ in range(k)]
        for a in range(k):
            value = self._get(self.inverse, a * k) * at_tip[0]
            for c in range(1, k):
                value = value + self._get(self.inverse, a * k + c) * at_tip[c]
            alpha[a].set(-value)

        def keep(j: Index) -> None:
            for a in range(k):
                self._put(alpha[a].get(), self.alpha, a, j)

        with f.loop(self.pieces + 1, full * each + 1) as j:
            keep(j)
        with f.loop(0, full - 1, -1) as g:
            keep(f.index((g.value + 1) * each))
            change = [alpha[c].get() - self._get(self.beta, c, g) for c in range(k)]
            for a in range(k):
                value = self._get(self.T, a * k, g) * change[0]
                for c in range(1, k):
                    value = value + self._get(self.T, a * k + c, g) * change[c]
                alpha[a].set(value)
            with f.loop((g.value + 1) * each, g.value * each + 1) as j:
                keep(j)
        for a in range(k):
            self._put(alpha[a].get(), self.step_unknowns, a)
        with self._places(self.points - 1, 1) as j:
            own = [self._wide(self.alpha, c, j) for c in range(k)]
            for i in range(ny):
                value = self._wide(self.w, i, j)
                for c in range(k):
                    value = value + self._wide(self.X, i * k + c, j) * own[c]
                self._write_wide(value, self.dy, i, j)
        for i in range(ny):
            value = f.splat(f.value(0.0), self.P)
            for c in range(k):
                if not e.program.is_constant(int(e.base_slopes[i, c]), 0.0):
                    value = value + self._get(self.S, i * k + c) * alpha[c].get()
            self._put(value, self.dy, i, 0)
