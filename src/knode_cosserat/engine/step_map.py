"""The linear map of a solved step: from the tangents of its data to those of its solution and records.

The data are the records before the step, the control, and results of the equations at fixed y that move with
the system. Two lists of operations (`linear`) give first the results at fixed y, then the solution by the
factors of the linearisation.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.engine.codegen import Index, Value
from knode_cosserat.engine.elimination import EliminationCode
from knode_cosserat.engine.equations import TangentEquations
from knode_cosserat.engine.linear import (
    Add,
    Columns,
    Entry,
    Operation,
    PlaceLoop,
    Scale,
    Show,
    write,
)
from knode_cosserat.engine.memory import Array
from knode_cosserat.engine.program import Nonzeros
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.settings import Settings

#: number of the argument of a step's function that is the memory of a state; records follow
STATE = 1
#: tangents side by side: they share each number of the map, so two vectors are faster than one
COLUMNS = 8


class Tangents(NamedTuple):
    """Arrays of the tangents of a step, or of their cotangents."""

    #: records before the step, from the last one, and their rate
    records: list[Array]
    rate: Array
    #: history terms that the rate needs; rates and strains, y behind jumps and at stages, lengths, tip, and y
    #: at the bases, at fixed y; rates at ends of pieces
    history: Array
    rates: Array
    far: Array
    between: Array
    lengths: Array
    tip: Array
    base: Array
    ends: Array
    #: y along the strands without the changes of the unknowns, and those of each strand's groups of pieces
    w: Array
    alpha: Array
    beta: Array
    #: the solution y at the points, the change of rates by it, and the new record
    y: Array
    change: Array
    newest: Array


class StepMap(EliminationCode):
    """Operations of the map, which are written forward for many tangents or transposed for one cotangent."""

    equations: TangentEquations
    keeps_both = True

    def __init__(self, system: System, settings: Settings, moving: Sequence[np.ndarray], transposed: bool):
        self.settings = settings
        super().__init__(TangentEquations(system, moving, transposed, settings.space), False)
        e, a = self.equations, self._array
        ny, nx, numbers, k = e.ny, e.ny + e.nz, e.numbers, e.k
        # derivatives at all places
        self.z_by_y = a(len(e.z_by_y), "used")
        self.places: dict[str, int | str] = {"rates": "used", "far": "pieces", "tip": 1, "base": 1}
        self.by_history = {name: a(len(e.by_history[name]), n) for name, n in self.places.items()}
        self.by_control = {name: a(len(e.by_control[name]), n) for name, n in self.places.items()}
        #: numbers of the results at fixed y that are not always zero; all slopes act on rates at stages
        self.rows = {
            name: sorted({i for i, *_ in e.by_history[name] + e.by_control[name]}.union(e.moving_rows[name]))
            for name in self.places
        }
        # the unknowns act on all residuals at the tip
        self.rows["tip"] = list(range(k))
        reached = range(ny) if self.stages else self.rows["far"]
        slopes = {i for i, c in e.pattern if c in reached}
        self.rows["rates"] = sorted(slopes.union(self.rows["rates"]))
        blocks = range(0, self.own, COLUMNS)
        #: columns of X and T in lanes, in as many vectors as are needed
        self.width = len(blocks) * COLUMNS
        self.X, self.T = (
            dataclasses.replace(self._columns(rows * len(blocks), count), component=1)
            for rows, count in ((ny, "points"), (self.own, "groups"))
        )
        #: component of a packed row for each number of each strand's record
        self.packed = e.by_strand(np.arange(self.strands * numbers))
        many = a if transposed else self._columns
        whole, self._size = self._size, 0
        #: arrays of a state, which last from step to step, and its size
        self.lasting = [many(numbers, "used", STATE) for _ in range(settings.memory + 1)]
        self._reserve_state()
        self.state_size, self._size = self._size, whole
        #: records change places from step to step; the new one takes the place of the oldest
        records = [
            dataclasses.replace(each, offset=0, memory=STATE + 1 + n)
            for n, each in enumerate(self.lasting[:-1])
        ]
        # without jumps, y at the points is part of the new record
        y = dataclasses.replace(records[-1], size=ny, count=self.room["points"], where="points")
        t = self.tangents = Tangents(
            records,
            self.lasting[-1],
            many(numbers, "used"),
            many(nx, "used"),
            many(ny, "pieces"),
            many(ny, "used between"),
            many(1, "pieces"),
            many(k, 1),
            many(ny * self.strands, 1),
            many(ny, "pieces"),
            many(ny, "points"),
            many(self.own, "groups and tips"),
            many(self.own, "groups"),
            y if self.far is None else many(ny, "points"),
            many(ny, "used"),
            records[-1],
        )
        #: the results of the equations at fixed y, by the names of their derivatives
        self.results = {"rates": t.rates, "far": t.far, "tip": t.tip, "base": t.base}

    def _columns(self, size: int, where: int | str, memory: int = 0) -> Array:
        """Reserve an array of tangents side by side."""
        count, name = self._room(where)
        found = Array(self._size, size, count, COLUMNS, size * COLUMNS, memory, where=name)
        self._size += size * count * COLUMNS
        return found

    def _of_X(self, row: int, column: int) -> int:
        return row * self.width + column

    def _reserve_state(self) -> None:
        """Reserve further arrays that last from step to step, for each column."""

    def _at(self, array: Array | Columns, i: Any, j: int | Index) -> tuple[Value, Any]:
        if isinstance(array, Columns):
            return array.base, array.width * i
        return super()._at(array, i, j)

    @property
    def _history_weights(self) -> range:
        """Numbers of the coefficients of records and, if the scheme uses it, of the rate."""
        return range(1, 1 + self.settings.memory + self.settings.uses_rate)

    # X, with the unknowns of a strand in lanes

    def _write_along(self) -> None:
        """X along the strands from their bases; at the tips the inverse of M X."""
        k, own = self.equations.k, self.own
        self.along = f = self._function("along")
        size, count = self.groups

        advance = functools.partial(PlaceLoop, body=self._advance_columns)
        with f.loop(self.strands) as strand:
            base = strand.value * self._count("points of strand")
            with f.loop(count) as g:
                first = base + g.value * size
                last = f.index(first + size)
                write(self, [advance(first, last.value)], COLUMNS, False)
                self._write_change(last, f.index(strand.value * count + g.value))
            tip = f.index(base + self._count("tip 0"))
            write(self, [advance(base + count * size, tip.value)], COLUMNS, False)
            column = strand.value * (own * self._padded(k))
            for i, block in itertools.product(range(k), range(0, own, COLUMNS)):
                row = f.splat(f.value(0.0), COLUMNS)
                for c in np.flatnonzero(self.nonzero_M[i]).tolist():
                    entry = self._get(self.M, c * self._padded(k) + i, strand)
                    row = row + entry * self._get(self.X, self._of_X(c, block), tip, COLUMNS)
                for c in range(block, min(block + COLUMNS, own)):
                    place = self.at_tip.at(c * self._padded(k) + i, 0)
                    f.store(f.lane(row, c - block), f.pointer(f.arguments[0], column), place)
        self._write_inverse()

    def _advance_columns(self, j: Index) -> list[Operation]:
        """Set X at the end of a piece."""
        found = list[Operation]()
        for block in range(0, self.own, COLUMNS):
            start, end = (
                [Entry(self.X, self._of_X(i, block), point) for i in range(self.equations.ny)]
                for point in (j, j + 1)
            )
            found += [*map(Scale, end), *self._by_factors(start, end, j)]
        return found

    def _write_change(self, point: Index, group: Index) -> None:
        """Replace X at a point by X T, with T the inverse of X's rows of pivots: columns in turn."""
        f, L, own, blocks = self._now, COLUMNS, self.own, range(0, self.own, COLUMNS)
        lanes = [f.join([f.value(float(b + n)) for n in range(L)]) for b in blocks]
        for i, (b, numbers) in itertools.product(range(own), zip(blocks, lanes, strict=True)):
            unit = f.select(f.compare("eq", numbers, float(i)), 1.0, 0.0)
            self._put(unit, self.T, self._of_X(i, b), group, L)
        for r, pivot in enumerate(self.pivots):
            scale = 1.0 / self._get(self.X, self._of_X(pivot, r), point)
            changes = []
            for b, numbers in zip(blocks, lanes, strict=True):
                change = -(scale * self._get(self.X, self._of_X(pivot, b), point, L))
                changes.append(f.select(f.compare("eq", numbers, float(r)), scale - 1.0, change))
            for matrix, at, rows in ((self.X, point, self.equations.ny), (self.T, group, own)):
                first = self._pointer(matrix, at)
                with f.loop(rows) as row:
                    here = f.pointer(first, row.value * self.width)
                    number = f.load(here, r)
                    for b, change in zip(blocks, changes, strict=True):
                        f.store(f.load(here, b, L) + number * change, here, b)

    # results at fixed y

    def _at_fixed_y(self, coefficients: Value, control: Columns) -> list[Operation]:
        """Return the map from the data to the results at fixed y; the system does not change."""
        t = self.tangents
        weights = [self._now.load(coefficients, k) for k in self._history_weights]

        def by_data(name: str, places: Sequence[Any], j: Any) -> list[Operation]:
            return self._by_data(name, j, places, (weights, control))

        found: list[Operation] = [PlaceLoop(0, self._count("used"), lambda j: by_data("rates", [j], j))]
        if self.rows["far"]:
            found.append(PlaceLoop(0, self._count("pieces"), lambda j: by_data("far", [j], j)))
        if self.equations.moves_lengths:
            found.append(PlaceLoop(0, self._count("pieces"), lambda j: [Scale(Entry(t.lengths, 0, j))]))
        return [*found, *by_data("tip", self.tips, 0), *by_data("base", self.bases, 0)]

    def _by_data(self, name: str, j: Any, places: Sequence[Any], data: Any) -> list[Operation]:
        """Set results at place j by the history at a place of each strand, and by the control."""
        e, t, target, (weights, control) = self.equations, self.tangents, self.results[name], data
        columns = {c for _, c, _ in e.by_history[name]}
        if name == "rates" and self.settings.uses_rate:
            columns |= set(range(e.numbers))
        kept = t.history if self.settings.uses_rate else None
        history = {c: Entry(kept, c % e.numbers, places[c // e.numbers]) for c in sorted(columns)}
        found: list[Operation] = []
        for number in history.values():
            found.append(Scale(number))
            for part, weight in zip((*t.records, t.rate), weights, strict=False):
                found.append(Add(number, Entry(part, number.i, number.j), weight))
        found += [Scale(Entry(target, i, j)) for i in self.rows[name]]
        controls = {c: Entry(control, c) for c in range(e.nc)}
        for nonzeros, matrix, source in (
            (e.by_history[name], self.by_history[name], history),
            (e.by_control[name], self.by_control[name], controls),
        ):
            found += _products(nonzeros, (matrix, j), (target, j), source.__getitem__)
        return found

    # the solution

    def _solution(self, coefficients: Value, row: Columns, unknowns: Columns) -> list[Operation]:
        """Return the map from the results at fixed y to the solution, and to the records after the step."""
        t, c0 = self.tangents, self._now.load(coefficients, 0)
        found = self._near_ends(t.rates) + self._correction()
        if self.far is not None:
            found.append(
                PlaceLoop(
                    0, self._count("points"), lambda j: _copies(self.equations.ny, (t.newest, j), (t.y, j))
                )
            )
        for k in self.near:
            near = t.y, self._place(f"near {k}")
            found += _copies(self.equations.ny, (t.newest, self._place("points") + k), near)
        if self.far is not None:
            found.append(PlaceLoop(0, self._count("pieces"), self._add_jumps))
        if self.stages or self.equations.system.mixed:
            found += [PlaceLoop(0, self._count("ends"), self._change_of_rates), *self._near_ends(t.change)]
            for k in range(len(self.stages)):
                found.append(PlaceLoop(0, self._count("pieces"), functools.partial(self._solve_stage, k)))
        if self.far is not None and self.rows["far"]:
            found.append(PlaceLoop(0, self._count("pieces"), self._add_jumps_at_fixed_y))
        found.append(PlaceLoop(0, self._count("used"), functools.partial(self._set_record, c0)))
        found.append(PlaceLoop(0, self._count("nodes"), functools.partial(self._show, row)))
        last = ((c % self.own, self._place(f"first alpha {c // self.own}")) for c in range(self.equations.k))
        return found + [Show(Entry(unknowns, c), Entry(t.alpha, *at)) for c, at in enumerate(last)]

    def _near_ends(self, rates: Array) -> list[Operation]:
        """Copy rates to the ends of pieces, if they are not those at the start of the next piece."""
        if not self.near:
            return []
        t, ny = self.tangents, self.equations.ny
        found: list[Operation] = [
            PlaceLoop(
                0,
                self._count("pieces"),
                lambda j: _copies(ny, (t.ends, j), (rates, j + 1), self._rows_of(rates)),
            )
        ]
        for k in self.near:
            end, near = self._place(f"near {k}") + -1, self._place("points") + k
            found += _copies(ny, (t.ends, end), (rates, near), self._rows_of(rates))
        return found

    def _rows_of(self, rates: Array) -> list[int]:
        """Return the components of y whose rates, or changes of rates, are not always zero."""
        e, t = self.equations, self.tangents
        rows = self.rows["rates"] if rates is t.rates else {i for i, _ in e.pattern}
        return [i for i in sorted(rows) if i < e.ny]

    def _rates_over_piece(
        self, weights: Sequence[float], target: Sequence[Entry], rates: Array, j: Index
    ) -> list[Operation]:
        """Add h times the weighted sum of a piece's rates."""
        h, found = self._get(self.h, 0, j), list[Operation]()
        places = self._places_of((rates, self.tangents.ends if self.near else rates), j)
        for weight, (array, place) in zip(weights, places, strict=False):
            if weight:
                own = h * weight
                found += [Add(target[i], Entry(array, i, place), own) for i in self._rows_of(rates)]
        return found

    def _by_length(self, weights: Sequence[float], target: Sequence[Entry], j: Index) -> list[Operation]:
        """Add the weighted sum of a piece's rates times the tangent of its length."""
        found, places = list[Operation](), self._places_of((self.f, self.fe), j)
        if not self.equations.moves_lengths:
            return found
        for i, number in enumerate(target):
            parts = [
                weight * self._get(array, i, place)
                for weight, (array, place) in zip(weights, places, strict=False)
                if weight
            ]
            if parts:
                rate = functools.reduce(operator.add, parts)
                found.append(Add(number, Entry(self.tangents.lengths, 0, j), rate))
        return found

    def _slopes(self, target: tuple[Array, Any], source: Callable[[int], Entry], j: Any) -> list[Operation]:
        """Add the product of the rates' derivatives at a place with numbers."""
        nonzeros = [(i, c, 0) for i, c in self.equations.pattern]
        return _products(nonzeros, (self.slope, j), target, source)

    def _moved(self, j: Index) -> list[Operation]:
        """Add the part of rates at a piece's start by y behind a jump."""
        t, far = self.tangents, self.rows["far"]
        return [
            Add(Entry(t.rates, i, j), Entry(t.far, c, j), Entry(self.slope, n, j))
            for n, (i, c) in enumerate(self.equations.pattern)
            if c in far
        ]

    def _at_fixed_ends(self, k: int, j: Index) -> list[Operation]:
        """Set y at a stage at fixed y, and add its part of the rates there."""
        t, stage, first, at = self.tangents, *self._stage(k, j)
        own = [Entry(t.between, i, at) for i in range(self.equations.ny)]
        found: list[Operation] = [Scale(number) for number in own]
        found += [Add(own[i], Entry(t.far, i, j), 1.0 - stage.end) for i in self.rows["far"]]
        found += self._by_length(stage.rates, own, j) + self._rates_over_piece(stage.rates, own, t.rates, j)
        return found + self._slopes((t.rates, first), own.__getitem__, first)

    def _stage(self, k: int, j: Index) -> tuple[Any, Index, Index]:
        """Return a stage, its place in a piece, and that among the places between ends."""
        return self.space.formula.stages[k], self._at_stage(k, j), self._before_stage(k, j)

    def _advance(self, j: Index) -> list[Operation]:
        """Set w at the end of a piece: its defect at fixed y, and w at its start by the factors."""
        e, t, formula = self.equations, self.tangents, self.space.formula
        end, found = [Entry(t.w, i, j + 1) for i in range(e.ny)], self._moved(j)
        for k in range(len(self.stages)):
            found += self._at_fixed_ends(k, j)
        found += map(Scale, end)
        found += [Add(end[i], Entry(t.far, i, j)) for i in self.rows["far"]]
        found += self._by_length(formula.weights, end, j)
        found += self._rates_over_piece(formula.weights, end, t.rates, j)
        return found + self._by_factors([Entry(t.w, i, j) for i in range(e.ny)], end, j)

    def _by_factors(self, start: Sequence[Entry], end: Sequence[Entry], j: Index) -> list[Operation]:
        """Add A times numbers at the start of a piece to those at its end, and apply B⁻¹ to the sum."""
        el, found = self.elimination, list[Operation]()
        stored = {int(node): n for n, node in enumerate(el.stored)}
        entries = {at: n for n, at in enumerate(el.entries)}
        for i, c in zip(*np.nonzero(el.matrix != el.program.constant(0.0)), strict=True):
            entry: Any = el.program.values[int(el.matrix[i, c])]
            if (i, c) in entries:
                entry = Entry(self.entries, entries[i, c], j)
            found.append(Add(end[i], start[c], entry))
        for i, c, node in el.substitution:
            factor = Entry(self.factor, stored[node], j) if node in stored else el.program.values[node]
            found.append(Scale(end[i], factor) if i == c else Add(end[i], end[c], factor, is_negative=True))
        return found

    def _by_unknowns(
        self, target: Array, j: Any, source: Array, group: Any, is_negative: bool = False
    ) -> list[Operation]:
        """Add the changes of y at a point by those of its unknowns."""
        return [
            Add(
                Entry(target, i, j),
                Entry(source, c, group),
                Entry(self.X, self._of_X(i, c), j),
                is_negative,
            )
            for i, c in zip(*map(np.ndarray.tolist, np.nonzero(self.nonzero_X)), strict=True)
        ]

    def _entry_at(self, matrix: Array, rows: int, i: int, c: int, j: Any = 0) -> Entry:
        """Return an entry of a matrix with rows in lanes."""
        return Entry(matrix, c * self._padded(rows) + i, j)

    def _correction(self) -> list[Operation]:
        """Return the map from the results at fixed y to y and the unknowns."""
        e, t, k, own = self.equations, self.tangents, self.equations.k, self.own
        found = _set(
            (
                Entry(t.w, i % e.ny, self.bases[i // e.ny]),
                Entry(t.base, i) if i in self.rows["base"] else None,
            )
            for i in range(t.base.size)
        )
        found.append(PlaceLoop(0, self.strands, self._sweep_to_tip))
        for i, c, _ in e.tip_slopes:
            strand, component = divmod(c, e.ny)
            entry = self._entry_at(self.M, k, i, component, strand)
            found.append(Add(Entry(t.tip, i), Entry(t.w, component, self.tips[strand]), entry))
        alpha = [Entry(t.alpha, i % own, self._place(f"alpha {i // own}")) for i in range(k)]
        found += map(Scale, alpha)
        for i, c in np.ndindex(k, k):
            entry = self._entry_at(self.inverse, k, i, c)
            found.append(Add(alpha[i], Entry(t.tip, c), entry, is_negative=True))
        return [*found, PlaceLoop(0, self.strands, self._sweep_to_base)]

    def _sweep_to_tip(self, strand: Index) -> list[Operation]:
        """Set w along a strand; after every few pieces the unknowns change."""
        t, (size, count), base = self.tangents, self.groups, strand.value * self._count("points of strand")

        def group(g: Index) -> list[Operation]:
            first = base + g.value * size
            last, at = self._now.index(first + size), self._now.index(strand.value * count + g.value)
            pivots = ((Entry(t.beta, c, at), Entry(t.w, p, last)) for c, p in enumerate(self.pivots))
            changed = self._by_unknowns(t.w, last, t.beta, at, is_negative=True)
            return [PlaceLoop(first, last.value, self._advance), *_set(pivots), *changed]

        return [
            PlaceLoop(0, count, group),
            PlaceLoop(base + count * size, base + self._count("tip 0"), self._advance),
        ]

    def _sweep_to_base(self, strand: Index) -> list[Operation]:
        """Set y along a strand from its tip, by the unknowns of each group of pieces."""
        t, (size, count), own, f = self.tangents, self.groups, self.own, self._now
        base, first = (
            f.index(strand.value * self._count("points of strand")),
            f.index(strand.value * (count + 1)),
        )

        def solve(group: Any, j: Any) -> list[Operation]:
            copies = _copies(self.equations.ny, (t.y, j), (t.w, j))
            return copies + self._by_unknowns(t.y, j, t.alpha, group)

        def group_back(g: Index) -> list[Operation]:
            start = base.value + g.value * size
            end, group = f.index(start + size), f.index(strand.value * count + g.value)
            # a strand has one more alpha
            alpha, change = (
                f.index(group.value + strand.value),
                [Entry(t.beta, c, group) for c in range(own)],
            )
            found = solve(alpha + 1, end)
            found += [Scale(Entry(t.alpha, c, alpha)) for c in range(own)]
            found += [Add(change[c], Entry(t.alpha, c, alpha + 1), is_negative=True) for c in range(own)]
            for i, c in zip(*map(np.ndarray.tolist, np.nonzero(self.nonzero_T)), strict=True):
                entry = Entry(self.T, self._of_X(i, c), group)
                found.append(Add(Entry(t.alpha, i, alpha), change[c], entry, is_negative=True))
            return [*found, PlaceLoop(start + 1, end.value, functools.partial(solve, alpha))]

        stop = base.value + self._count("points of strand")
        return [
            PlaceLoop(base.value + (count * size + 1), stop, functools.partial(solve, first + count)),
            PlaceLoop(0, count, group_back, descends=True),
            *solve(first, base),
        ]

    # the new record

    def _add_jumps(self, j: Index) -> list[Operation]:
        """Add the changes of jumps by y."""
        t, nonzeros = self.tangents, [(i, c, 0) for i, c, _ in self.equations.jumping]
        return _products(nonzeros, (self.jump, j), (t.newest, j), lambda c: Entry(t.y, c, j))

    def _add_jumps_at_fixed_y(self, j: Index) -> list[Operation]:
        """Add the changes of jumps at fixed y."""
        t = self.tangents
        return [Add(Entry(t.newest, i, j), Entry(t.far, i, j)) for i in self.rows["far"]]

    def _change_of_rates(self, j: Index) -> list[Operation]:
        """Set the change of rates at ends of pieces by y."""
        t = self.tangents
        found: list[Operation] = [Scale(Entry(t.change, i, j)) for i in self._rows_of(t.change)]
        return found + self._slopes((t.change, j), lambda c: Entry(t.newest, c, j), j)

    def _solve_stage(self, k: int, j: Index) -> list[Operation]:
        """Add the change of y at a stage, and set that of the rates there."""
        e, t, stage, first, at = self.equations, self.tangents, *self._stage(k, j)
        own, found = [Entry(None, i) for i in range(e.ny)], list[Operation]()
        for i in range(e.ny):
            found.append(Add(own[i], Entry(t.newest, i, j), 1.0 - stage.end))
            found.append(Add(own[i], Entry(t.y, i, j + 1), stage.end))
        found += self._rates_over_piece(stage.rates, own, t.change, j)
        found += [Scale(Entry(t.change, i, first)) for i in self._rows_of(t.change)]
        found += self._slopes((t.change, first), own.__getitem__, first)
        found += [Add(Entry(t.between, i, at), own[i]) for i in range(e.ny)]
        return found + _copies(e.ny, (t.newest, first), (t.between, at))

    def _set_record(self, c0: Value, j: Index) -> list[Operation]:
        """Set strains, y_s and the rate of the new record at a place."""
        e, t, rows = self.equations, self.tangents, self.rows["rates"]
        strains = [(e.ny + i, c, node) for i, c, node in e.z_by_y]
        found = _set(
            (Entry(t.newest, i, j), Entry(t.rates, i, j) if i in rows else None)
            for i in range(e.ny, e.ny + e.nz)
        )
        found += _products(strains, (self.z_by_y, j), (t.newest, j), lambda c: Entry(t.newest, c, j))
        for i in range(e.numbers - e.ny - e.nz):
            rate = Entry(t.newest, e.ny + e.nz + i, j)
            found.append(Scale(rate))
            for rates in (t.rates, t.change):
                found += [Add(rate, Entry(rates, i, j))] if i in self._rows_of(rates) else []
        if self.settings.uses_rate:
            found += _copies(e.numbers, (t.rate, j), (t.history, j))
            found += [Add(Entry(t.rate, i, j), Entry(t.newest, i, j), c0) for i in range(e.numbers)]
        return found

    def _show(self, row: Columns, node: Index) -> list[Operation]:
        """Copy y and strains at a node to its row."""
        t, point = self.tangents, self._node(node)
        own = Columns(self._now.pointer(row.base, node.value * (row.width * self.packed.size)), row.width)
        return [
            Show(
                Entry(own, int(component)),
                Entry(t.y if i < self.equations.ny else t.newest, i, self._of_strand(q, point)),
            )
            for (q, i), component in np.ndenumerate(self.packed)
        ]


def _products(
    nonzeros: Nonzeros,
    matrix: tuple[Array, Any],
    target: tuple[Array, Any],
    source: Callable[[int], Entry],
) -> list[Operation]:
    """Add the product of a sparse matrix with numbers; matrix and result have an array and a place."""
    return [
        Add(Entry(target[0], i, target[1]), source(c), Entry(matrix[0], n, matrix[1]))
        for n, (i, c, _) in enumerate(nonzeros)
    ]


def _copies(
    size: int, target: tuple[Array, Any], source: tuple[Array, Any], rows: Iterable[int] | None = None
) -> list[Operation]:
    """Copy components, by default all; target and source have an array and a place."""
    return _set(
        (Entry(target[0], i, target[1]), Entry(source[0], i, source[1]))
        for i in (range(size) if rows is None else rows)
    )


def _set(pairs: Iterable[tuple[Entry, Entry | None]]) -> list[Operation]:
    """Set the first number of each pair to the second, or to zero."""
    found = list[Operation]()
    for target, source in pairs:
        found += [Scale(target), *([Add(target, source)] if source else [])]
    return found
