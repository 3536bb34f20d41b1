"""The time loop of a rod as machine code: history, Newton's method, estimates of errors.

The mathematics is that of `schemes`: a mono-implicit Runge-Kutta scheme along the rod, corrections damped by
the natural monotonicity test with factors that are kept, and corrected motions whose distances are the
estimated errors of the grid and of the time scheme.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.engine.codegen import Function, Index, StackVariable, Value
from knode_cosserat.engine.elimination import EliminationCode
from knode_cosserat.engine.equations import Equations
from knode_cosserat.engine.memory import Array
from knode_cosserat.engine.rod import StateArrays
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.history import (
    ESTIMATE_TOLERANCE,
    ESTIMATE_TURNS,
    EXTRAPOLATIONS,
    ROUNDING,
    stage_extrapolations,
)
from knode_cosserat.schemes.problem import Evaluated
from knode_cosserat.schemes.semi_discrete import has_friction
from knode_cosserat.schemes.settings import NewtonOptions, Settings

#: numbers of the outcome of a stage, for each robot
USABLE, ERROR, CORRECTIONS, LINEARISATIONS, POSITION, ANGLE, TIME, ALIVE = range(8)
#: largest correction that may be left at a solution, relative to the state and its natural units
LARGEST_CORRECTION = 1e-5
#: part of the largest correction allowed at a solution, below which an expected correction is not computed
SURELY_SMALL = 1e-2
#: index of `acceptable` in Newton's options
ACCEPTABLE = [field.name for field in dataclasses.fields(NewtonOptions)].index("acceptable")
#: the factors by which Newton's method corrects: none that are usable; those of an earlier step; those of the
#: present iterate, before its first correction and after it; those of an earlier iterate of this step
NONE, OLD, NEW, FRESH, KEPT = map(float, range(5))


class Unknowns(NamedTuple):
    """Unknowns of a step, or a change of them: y at all points, and the unknowns at the bases."""

    y: Array
    unknowns: Array


#: size of a state, and the arrays of each of its parts
_Packed = tuple[int, list[list[Array]]]


class Core(EliminationCode):
    """Machine code of a system's time loop, and of its equilibria in turn, whose rates are zero (c0 = 0).

    It does not depend on Newton's options. A run may have fewer stages in a step than the scheme.
    """

    def __init__(self, system: System, settings: Settings, robots: bool):
        #: settings, and the weights of the time scheme's error (`TimeScheme.defect`); empty: no estimate
        self.settings, self.time_defect = settings, settings.time.defect if settings.time else ()
        super().__init__(Equations(system, space=settings.space), robots)
        #: true if the code linearises steps of one robot from an equilibrium, too
        self.is_linear_step = bool(self.time_defect) and not robots
        #: true if there is no linearisation at rest
        self.has_friction = self.is_linear_step and has_friction(system)
        e = self.equations
        ny, nz, k, numbers, a = e.ny, e.nz, e.k, e.numbers, self._array
        # Newton's method: its options, the iterate and its correction, a trial point and the correction there
        self.options = a(len(dataclasses.fields(NewtonOptions)))
        self.iterate, self.step = Unknowns(self.y, self.unknowns), Unknowns(self.dy, self.step_unknowns)
        self.trial, self.direction, self.better = (Unknowns(a(ny, "ends"), a(k)) for _ in range(3))
        # the motion: records of earlier states and their rate, states for the first guess, errors of records
        memory = range(settings.memory)
        self.records, self.rate = [a(numbers, "count") for _ in memory], a(numbers, "count")
        self.past, self.weights, self.t0 = [a(ny, "ends") for _ in range(3)], a(3), a(1)
        self.errors, self.error_rate = [a(numbers, "used") for _ in memory], a(numbers, "used")
        self.time_errors = [a(numbers, "used") for _ in memory]
        #: arrays of the state of a motion (`StateHistory`) and of an equilibrium (`StaticState`)
        self.motion = [
            self.records,
            [self.rate],
            self.past,
            [self.weights],
            [self.t0],
            [*self.errors, self.error_rate],
            self.time_errors,
        ]
        self.shape = [[self.y]]
        #: of the stage solved last (`USABLE` and the next)
        self.outcome = a(8)
        #: for sizes relative to the state: one over the natural unit plus |y|
        self.weights_of_y = a(ny, "points")
        # corrected motions: history terms, defects
        self.dH, self.own_dH = (a(numbers, "used") for _ in range(2))
        self.defect, self.own_defect, self.rest = (a(ny, "pieces") for _ in range(3))
        self.tip_rest = a(k)
        # products of derivatives, for the error of the time scheme
        self.move, self.time_dH = (a(numbers, "used") for _ in range(2))
        self.tangents = StateArrays(a(ny, "ends"), a(ny, "used between"), a(nz, "used"), a(ny, "used"))
        self.dfe = a(ny, "pieces") if self.near else self.tangents.f
        self._write()
        self._functions = self._compiled()
        guesses = stage_extrapolations(settings) if settings.stages > 1 else EXTRAPOLATIONS[None]
        #: extrapolations to each stage and to the one after it
        self._guesses = np.ascontiguousarray(np.stack([guesses, np.roll(guesses, -1, axis=0)], axis=1))

    @functools.cached_property
    def states(self) -> tuple[_Packed, _Packed]:
        """Size of the state of a motion and of an equilibrium, and its arrays one after the other."""
        return self._states_of(self.motion), self._states_of(self.shape)

    def _states_of(self, parts: list[list[Array]]) -> _Packed:
        arrays = self._pack([*itertools.chain(*parts)])
        rest = iter(arrays)
        return sum(map(self._size_of, arrays)), [[next(rest) for _ in part] for part in parts]

    def _write_weights(self) -> None:
        """Weights of sizes relative to the state."""
        self.weigh = f = self._function("weigh")
        for i, j in self._components(self.equations.ny, self._count("points")):
            unit = self._unit(i, j)
            size = f.apply("abs", self._wide(self.y, i, j))
            self._write_wide(unit / (1.0 + unit * size), self.weights_of_y, i, j)

    # Newton's method

    def _write_newton(self) -> None:
        """Newton's method for a step (docs/engine.md), from y and the unknowns; the rates belong to y."""
        self.solve = f = self._function("solve")
        memory, infinity = f.arguments[0], math.inf
        options = (self._get(self.options, i) for i in range(self.options.size))
        tolerance, acceptable, most, patience, least_damping = options
        is_alive = self._get(self.outcome, ALIVE) > 0.0
        factors = self._variable(f.select(self._get(self.outcome, USABLE) > 0.0, OLD, NONE))
        is_finished = self._variable(False)
        error, size, relative_size = (self._variable(infinity) for _ in range(3))
        damping, corrections, linearisations = (self._variable(each) for each in (1.0, 0.0, 0.0))
        self._write_point(self.direction, lambda: 0.0)

        def is_in(*states: float) -> Value:
            return functools.reduce(operator.or_, (f.compare("eq", factors.get(), each) for each in states))

        def is_active() -> Value:
            needed = linearisations.get() + f.select(is_in(NONE), 1.0, 0.0)
            return is_alive & ~is_finished.get() & (needed <= most)

        with f.while_(lambda: f.any(is_active())):
            active = is_active()
            linearises = f.any(active & is_in(NONE))
            with f.if_(linearises):
                f.call(self.linearise, memory)
                f.call(self.weigh, memory)
                for variable, initial in (factors, NEW), (damping, 1.0), (size, infinity):
                    variable.set(f.select(active, initial, variable.get()))
                linearisations.set(linearisations.get() + f.select(active, 1.0, 0.0))
                self._write_point(self.trial, lambda y: y, self.iterate)
                f.call(self.defects, memory)
            with f.if_(~linearises):
                points = self.iterate, self.direction
                self._write_point(
                    self.trial, lambda part, y, dy: y + part * dy, *points, weight=damping.get()
                )
                self._write_base(self.trial.unknowns, self.trial.y, self.H)
                f.call(self.residual, memory)
            new_error = self._residual_norm()
            # by the same factors, the correction shrinks as the residual does: a tiny one is not computed
            is_tiny = relative_size.get() * new_error <= SURELY_SMALL * LARGEST_CORRECTION * error.get()
            is_tiny &= (new_error <= tolerance) & (size.get() < infinity)
            sizes = self._variable(0.0), self._variable(0.0)
            with f.if_(f.any(active & ~is_tiny)):
                f.call(self.correct, memory)
                norms = self._norms(self.dy, self._count("points"), self.weights_of_y)
                for variable, norm in zip(sizes, norms, strict=True):
                    variable.set(norm)
            new_size, new_relative_size = (each.get() for each in sizes)
            is_converged = (new_error <= tolerance) & (new_relative_size <= LARGEST_CORRECTION)
            is_shorter = (new_size <= (1.0 - damping.get() * 0.25) * size.get()) & (new_size < infinity)
            is_accepted = is_converged | is_shorter
            rate = f.apply("log", f.apply("max", size.get() / new_size, 1.0 + 1e-6))
            is_slow = f.apply("log", new_error / tolerance) > rate * patience
            is_slow = is_shorter & (size.get() < infinity) & (is_slow | (damping.get() < 1.0))
            can_shorten = is_in(FRESH) & (damping.get() > least_damping)
            is_rounding = (error.get() <= acceptable) & is_in(FRESH, KEPT)
            has_failed = ~is_accepted & (is_rounding | (is_in(NEW, FRESH) & ~can_shorten))
            finishes = is_converged | has_failed
            renews = ~finishes & (is_slow | ~(is_accepted | can_shorten))
            accepts = is_accepted & active
            new_damping = f.select(accepts, f.apply("min", 1.0, 4.0 * damping.get()), damping.get() * 0.25)
            damping.set(f.select(active, new_damping, damping.get()))
            for variable, value in (
                (error, new_error),
                (size, new_size),
                (relative_size, new_relative_size),
                (factors, f.select(is_in(NEW), FRESH, f.select(is_in(FRESH), KEPT, factors.get()))),
            ):
                variable.set(f.select(accepts, value, variable.get()))
            factors.set(f.select(active & renews, NONE, factors.get()))
            is_finished.set(is_finished.get() | (finishes & active))
            corrections.set(corrections.get() + f.select(active & ~(finishes | renews), 1.0, 0.0))
            for target, source in (self.iterate, self.trial), (self.direction, self.step):
                self._write_point(target, f.select, source, target, weight=accepts)
        left = f.apply("max", error.get(), f.apply("min", relative_size.get(), 1.0))
        left = f.select(relative_size.get() <= LARGEST_CORRECTION, error.get(), left)
        is_usable = (left <= acceptable) & ~is_in(NONE)
        for k, value in (
            (USABLE, f.select(is_usable, 1.0, 0.0)),
            (ERROR, left),
            (CORRECTIONS, corrections.get()),
            (LINEARISATIONS, linearisations.get()),
        ):
            self._put(value, self.outcome, k)

    def _residual_norm(self) -> Value:
        """Return the largest residual of pieces and tip, in natural units."""
        return self._now.apply("max", *self._norms(self.r, self._count("pieces")), self._tip_norm())

    def _write_point(
        self, target: Unknowns, formula: Callable[..., Any], *sources: Unknowns, weight: Value | None = None
    ) -> None:
        """Write a formula of a weight, if there is one, and of points, number by number, to a point."""
        wide, plain = ([], []) if weight is None else ([self._spread(weight)], [weight])
        self._write_each(target.y, "points", lambda *y: formula(*wide, *y), *(each.y for each in sources))
        for i in range(target.unknowns.size):
            numbers = (self._get(each.unknowns, i) for each in sources)
            self._put(formula(*plain, *numbers), target.unknowns, i)

    # the corrected motion

    def _write_record(self) -> None:
        """Rates and residual of y, the defects of the scheme's check formula, and the records."""
        e = self.equations
        self.record = f = self._function("record", "n_estimates", "coefficients")
        memory, estimates, _ = f.arguments
        f.call(self.residual_of_y, memory)
        formula, check = self.space.formula, self.space.check
        with f.if_(estimates > 0):
            for k in range(len(formula.stages), len(check.stages)):
                self._write_rates_between(self.rates, k, check.stages[k], self.y, self.H)
            pairs = itertools.zip_longest(check.weights, formula.weights, fillvalue=0.0)
            changes = [weight - own for weight, own in pairs]
            for i, j in self._components(e.ny, self._count("pieces")):
                self._write_wide(self._increment(changes, (self.f, self.fe), i, j), self.defect, i, j)
        self._write_records()

    def _write_check(self) -> None:
        """The solution's records, and its residual."""
        e = self.equations
        self.check = f = self._function("check", "n_estimates", "coefficients")
        memory, estimates, coefficients = f.arguments
        f.call(self.record, memory, estimates, coefficients)
        f.call(self.weigh, memory)
        self._raise_error(self._residual_norm())
        # the residual of the solution is no part of its errors
        self._copy_wide(self.r, self.rest, self._count("pieces"))
        for i in range(e.k):
            self._put(self._get(self.tip, i), self.tip_rest, i)
        # no residual has the strains of the tip; y_s is part of a record if B is not zero
        total = self._wide_variable(0.0)
        with self._places(self._count("count")) as j:
            for i in range(e.ny, e.numbers):
                size = f.apply("abs", self._wide(self.records[0], i, j))
                total.set(total.get() + self._before(self._count("count"), j, size))
        self._raise_error(self._largest(f.select(total.get() < math.inf, 0.0, math.inf)))

    def _raise_error(self, least: Value) -> None:
        """Replace the error of the outcome by a larger one."""
        error = self._now.apply("max", least, self._get(self.outcome, ERROR))
        self._put(error, self.outcome, ERROR)

    def _write_estimate(
        self, name: str, errors: list[Array], history: Array, has_defect: bool, number: int
    ) -> Function:
        """The corrected motion: from its own history, and with defects or, without, those of the solution.

        The residual that the solution has left is none of its errors. Errors beyond the rod's length, and all
        later ones, are unknown.

        The factors may be those of an earlier step: a single correction would leave an error in every step,
        and these add up where the motion turns. Corrections go on until the next one is small relative
        to the change of the error in this step.
        """
        e, better = self.equations, self.better
        f = self._function(name)
        memory = f.arguments[0]
        is_alive = self._get(self.outcome, ALIVE) > 0.0
        defects = [self.rest, *[self.defect] * has_defect]
        self._write_each(self.own_defect, "pieces", lambda rest, defect=0.0: defect - rest, *defects)
        last = errors[:2]
        self._write_each(better.y, "ends", lambda y, new, old: y + (2.0 * new - old), self.y, *last)
        with self._places(self._count("used")) as j:
            for i in e.used_history:
                value = self._wide(self.H, i, j) + self._wide(history, i, j)
                self._write_wide(value, self.own_dH, i, j)
        for k, (i, base) in enumerate(self._unknown_numbers()):
            new, old = (self._get(each, i, base) for each in last)
            self._put(self._get(self.unknowns, k) + (2.0 * new - old), better.unknowns, k)

        def write_residual() -> Value:
            self._write_base(better.unknowns, better.y, self.own_dH)
            f.call(self.residual_of_better, memory)
            self._write_each(self.r, "pieces", lambda r, own: r + own, self.r, self.own_defect)
            for i in range(e.k):
                self._put(self._get(self.tip, i) - self._get(self.tip_rest, i), self.tip, i)
            return self._residual_norm()

        left, turns = self._variable(math.inf), StackVariable(f, f.value(0.0))
        residual = self._variable(0.0)
        residual.set(write_residual())

        def is_active() -> Value:
            largest = self._wide_variable(0.0)
            for i, j in self._components(e.ny, self._count("points")):
                change = self._wide(better.y, i, j) - self._wide(self.y, i, j) - self._wide(errors[0], i, j)
                size = f.apply("abs", change) * self._wide(self.weights_of_y, i, j)
                size = self._before(self._count("points"), j, size)
                largest.set(f.apply("max", largest.get(), size))
            is_large = left.get() > ESTIMATE_TOLERANCE * self._largest(largest.get()) + ROUNDING
            return f.any(is_large & is_alive) & (turns.get() < float(ESTIMATE_TURNS)) | (turns.get() < 1.0)

        with f.while_(is_active):
            f.call(self.correct, memory)
            self._write_point(better, operator.add, better, self.step)
            _, size = self._norms(self.dy, self._count("points"), self.weights_of_y)
            before = residual.get()
            residual.set(write_residual())
            left.set(size * residual.get() / before)
            turns.set(turns.get() + 1.0)
        off, angle = self._errors_of_poses()
        known = f.select(off <= self._get(self.length, 0), 1.0, math.nan)
        wide_known = self._spread(known)
        self._write_shift(errors, self._count("used"))
        for i, j, value in self._numbers_of(self._state_arrays(better.y), "used between"):
            self._write_wide((value - self._wide(self.records[0], i, j)) * wide_known, errors[0], i, j)
        self._put(off * known, self.outcome, number)
        if has_defect:
            self._put(angle, self.outcome, ANGLE)
        return f

    def _write_static_estimate(self) -> None:
        """Errors of an equilibrium: the correction that its defects ask for."""
        self.estimate_at_rest = f = self._function("estimate_at_rest")
        self._copy_wide(self.defect, self.r, self._count("pieces"))
        for i in range(self.equations.k):
            self._put(0.0, self.tip, i)
        f.call(self.correct, f.arguments[0])
        self._write_each(self.better.y, "points", operator.add, self.y, self.dy)
        for number, value in zip((POSITION, ANGLE), self._errors_of_poses(), strict=True):
            self._put(value, self.outcome, number)

    def _errors_of_poses(self) -> tuple[Value, Value]:
        """Return the largest error of positions (m) and of orientations (rad), of the better y."""
        f, layout = self._now, self.equations.strand.y_layout
        offs, angles, total = (self._wide_variable(0.0) for _ in range(3))
        with self._places(self._count("points")) as j:

            def change(i: int) -> Value:
                return self._wide(self.better.y, i, j) - self._wide(self.y, i, j)

            def largest(found: StackVariable, value: Value) -> None:
                value = self._before(self._count("points"), j, value)
                found.set(f.apply("max", found.get(), value))
                total.set(total.get() + value)

            for rows in layout.ranges("p"):
                largest(offs, _sum(d * d for d in map(change, rows)))
            if not layout.ranges("p"):
                for i in range(self.equations.ny):
                    size = change(i) * self._unit(i, j) * self._wide(self.length, 0)
                    largest(offs, size * size)
            for rows in layout.ranges("h"):
                h, d = [self._wide(self.y, i, j) for i in rows], [change(i) for i in rows]
                square = _sum(a * a for a in h)
                along = _sum(a * b for a, b in zip(d, h, strict=True)) / square
                across = [a - b * along for a, b in zip(d, h, strict=True)]
                largest(angles, _sum(a * a for a in across) / square)
        finite = total.get() < math.inf
        off, angle = (
            f.apply("sqrt", self._largest(f.select(finite, each.get(), math.inf))) for each in (offs, angles)
        )
        return off, 2.0 * angle

    def _write_time_history(self) -> None:
        """History terms of the time scheme's errors, of a checked stage.

        The last stage adds the scheme's error (`TimeScheme.defect`): only this one reaches back to the last
        row. The equations of the step multiply by J / c0, and damp the vibrations that it does not resolve.
        """
        self.time_history = f = self._function("time_history", "coefficients")
        memory, coefficients = f.arguments
        c0, *earlier = (f.load(coefficients, i) for i in range(self.settings.memory + 1))

        def carried(i: int, j: Index) -> Value:
            pairs = zip(earlier, self.time_errors, strict=True)
            return _sum(c * self._wide(error, i, j) for c, error in pairs)

        for i, j in self._components(self.equations.numbers, self._count("used")):
            self._write_wide(carried(i, j), self.time_dH, i, j)
        with f.if_(f.compare("ne", earlier[self.settings.stages - 1], 0.0)):
            f.call(self.respond, memory)
            # J / c0 times the defect: its product with the derivatives of the step, less the defect itself
            for i, j, product in self._numbers_of(self.tangents, "used between"):
                added = -c0 * product - self._wide(self.move, i, j)
                self._write_wide(carried(i, j) + added, self.time_dH, i, j)

    def _write_response(self) -> None:
        """Changes of a linearised step by `move` of the history: of the solution, and of its record."""
        e = self.equations
        self.respond = f = self._function("respond")
        memory = f.arguments[0]
        self._write_each(self.dy, "points", lambda: 0.0)
        f.call(self.products, memory)
        state = self._base_state(self.unknowns, self.H) | self._tangents_of_history(self.bases)
        moved = self._evaluate(e.products["base"], 0, False, state)
        for k, value in enumerate(moved):
            self._put(value, self.w, k % e.ny, self.bases[k // e.ny])
        f.call(self.correct, memory)
        for k in range(len(moved)):
            self._put(0.0, self.w, k % e.ny, self.bases[k // e.ny])
        f.call(self.products, memory)

    def _write_linear_step(self) -> None:
        """The map of a linearised step at y, from changes of history to those of records (`LinearStep`)."""
        names = ["memory", "coefficients", "control"]
        f = self._now = self.module.function("linearise_step", names, exported=True)
        memory, coefficients, control = f.arguments
        f.call(self.setup, memory)
        self._write_inputs(f.load(coefficients, 0), f.load(coefficients, self.settings.memory + 2), control)
        for k, (i, base) in enumerate(self._unknown_numbers()):
            self._put(self._get(self.y, i, base), self.unknowns, k)
        f.call(self.linearise, memory)
        names = ["memory", "changes", "n_columns", "n_size"]
        f = self._now = self.module.function("map_changes", names, exported=True)
        memory, changes, columns, size = f.arguments
        with f.loop(columns) as column:
            own = f.pointer(changes, column.value * size)
            for inside, outside in self._each_packed_vector([self.move], own):
                f.store(f.load(outside, 0, self.L), inside, 0)
            f.call(self.respond, memory)
            for i, j, value in self._numbers_of(self.tangents, "used between"):
                self._write_wide(value, self.move, i, j)
            for inside, outside in self._each_packed_vector([self.move], own):
                f.store(f.load(inside, 0, self.L), outside, 0)

    def _write_products(self) -> None:
        """Products of derivatives with `dy` at the points and `move` of the history: defects, tip, record."""
        e = self.equations
        self.products = self._function("products")
        (far, between, *_), tangents = self._state_arrays(self.y), self.tangents
        self._copy_wide(self.dy, tangents.far, self._count("points"))
        if self.far is not None:
            with self._places(self._count("pieces")) as j:
                state = self._state_with_tangents((self.y, self.dy), j, j) | self._acting_at(j)
                self._write_results([(tangents.far, e.products["far"])], j, state)
        for k in self.near:
            for i in range(e.ny):
                value = self._get(self.dy, i, self._place(f"near {k}"))
                self._put(value, tangents.far, i, self._place("points") + k)
        results = (tangents.f, e.products["rates"][: e.ny]), (tangents.z, e.products["rates"][e.ny :])
        ends = tangents.far, self.dy
        rates = tangents.f, self.dfe
        with self._places(self._count("ends")) as j:
            self._write_results(results, j, self._state_with_tangents((far, tangents.far), j, j))
        self._write_ends(*rates)
        for k, stage in enumerate(self.space.formula.stages):
            self._write_between(k, stage, ends, rates, tangents.between)
            with self._places(self._count("pieces")) as j:
                y = between, tangents.between
                here = self._at_stage(k, j)
                state = self._state_with_tangents(y, self._before_stage(k, j), here)
                self._write_results(results, here, state)
        self._write_defects_of_pieces(ends, rates)
        state = self._tip_state(self.y, self.H) | self._tangents_of_history(self.tips)
        for tip, nodes in zip(self.tips, e.dy, strict=True):
            state |= {int(node): self._get(self.dy, i, tip) for i, node in enumerate(nodes)}
        for i, value in enumerate(self._evaluate(e.products["tip"], 0, False, state)):
            self._put(value, self.tip, i)

    def _tangents_of_history(self, points: Sequence[Any]) -> dict[int, Value]:
        """Return the tangents of the history of each strand at its point."""
        return {
            int(node): self._get(self.move, i, point)
            for point, nodes in zip(points, self.equations.dhistory, strict=True)
            for i, node in enumerate(nodes)
        }

    def _unknown_numbers(self) -> Iterator[tuple[int, int]]:
        """Yield the component and the point of each unknown."""
        for base in self.bases:
            for i in self.pivots:
                yield i, base

    def _state_with_tangents(self, y: tuple[Array, Array], j: Index, place: Index) -> dict[int, Value]:
        e = self.equations
        state = self._state(y[0], self.H, j, place)
        state |= {int(node): self._wide(y[1], i, j) for i, node in enumerate(e.dy[0])}
        return state | {int(node): self._wide(self.move, i, place) for i, node in enumerate(e.dhistory[0])}

    def _write_records(self) -> None:
        """Shift the records by one step; the rate and the scheme's defect need the old ones."""
        f = self._now
        coefficients = f.arguments[-1]
        c0 = f.load(coefficients, 0)
        newest = self._state_arrays(self.y)
        if self.time_defect:
            with f.if_(f.arguments[1] > 1):
                for i, j, value in self._numbers_of(newest, "used between"):
                    states = [value, *(self._wide(record, i, j) for record in self.records)]
                    found = _sum(w * state for w, state in zip(self.time_defect, states, strict=True) if w)
                    self._write_wide(-c0 * found, self.move, i, j)
        self._write_shift(self.records, self._count("count"))
        for i, j, value in self._numbers_of(newest, "between"):
            self._write_wide(value, self.records[0], i, j)
        if self.settings.uses_rate:
            self._write_each(self.rate, "count", lambda new, H: c0 * new + H, self.records[0], self.H)

    # the time loop

    def _write_run(self) -> None:
        """All steps, until every robot has failed; `reached` counts the solved.

        Errors of the grid (`n_estimates` 1 or 2) and of the time scheme (2) that are not estimated are NaN,
        also those of the state after the run.
        """
        e, P = self.equations, self.P
        names = ["memory", "controls", "coefficients", "extrapolations", "rows", "infos", "reached"]
        names += ["n_steps", "n_stages", "n_estimates"]
        self.steps = f = self._function("steps", *names[1:])
        memory, controls, coefficients, extrapolations, rows, infos, reached = f.arguments[:7]
        steps, stages, estimates = f.arguments[7:]
        self._put(1.0, self.outcome, ALIVE)
        grid, time = ((POSITION, ANGLE), (*self.errors, self.error_rate)), ((TIME,), self.time_errors)
        for least, (places, arrays) in ((1, grid), (2, time)):
            with f.if_(estimates < least):
                for k in places:
                    self._put(math.nan, self.outcome, k)
                for array in arrays:
                    self._write_each(array, "used", lambda: math.nan)
        step, nodes = StackVariable(f, f.value(0, "i64")), self._count("nodes")

        def is_active() -> Value:
            return (step.get() < steps) & f.any(self._get(self.outcome, ALIVE) > 0.0)

        with f.while_(is_active):
            with f.loop(stages) as stage:
                number = step.get() * stages + stage.value
                table = f.pointer(coefficients, number * (self.settings.memory + 3))
                control = f.pointer(controls, number * (e.nc * P))
                f.call(self.stage, memory, estimates, table, control)
                with f.if_(self._is_moving(table)):
                    f.call(self.guesses, memory, f.pointer(extrapolations, stage.value * 18))
                with f.loop(nodes) as node:
                    point = self._node(node)
                    target = f.pointer(rows, (number * nodes + node.value) * (self.strands * e.numbers * P))
                    for q, i in np.ndindex(self.strands, e.numbers):
                        array = self.y if i < e.ny else self.records[0]
                        value = self._get(array, i, self._of_strand(q, point))
                        f.store(value, target, (q * e.numbers + i) * P, P)
                info = f.pointer(infos, number * ((8 + e.k) * P))
                for k in range(8):
                    f.store(self._get(self.outcome, k), info, k * P, P)
                for k in range(e.k):
                    f.store(self._get(self.unknowns, k), info, (8 + k) * P, P)
            solved = f.select(self._get(self.outcome, ALIVE) > 0.0, 1.0, 0.0)
            f.store(f.load(reached, 0, P) + solved, reached, 0, P)
            step.set(step.get() + 1)

    def _is_moving(self, coefficients: Value) -> Value:
        """Return true for a stage of a motion, false for an equilibrium."""
        return self._now.compare("ne", self._now.load(coefficients, 0), 0.0)

    def _write_stage(self) -> None:
        """One stage of a step: history, first guess, solution, records and estimates.

        An equilibrium is solved from y as it is, and has no history.
        """
        self.stage = f = self._function("stage", "n_estimates", "coefficients", "controls")
        memory, estimates, coefficients, controls = f.arguments
        c0, *weights, t = (f.load(coefficients, i) for i in range(self.settings.memory + 3))
        self._write_inputs(c0, t + self._get(self.t0, 0), controls)

        def write_history(states: list[Array], rate: Array, target: Array, where: str) -> None:
            numbers = [*states, *[rate] * self.settings.uses_rate]
            self._write_each(target, where, lambda *x: _sum(map(operator.mul, weights, x)), *numbers)

        with f.if_(self._is_moving(coefficients)):
            write_history(self.records, self.rate, self.H, "count")
            trusts = [self._wide(self.weights, k) for k in range(3)]
            self._write_each(self.y, "points", lambda *y: _sum(map(operator.mul, trusts, y)), *self.past)
        for k, (i, base) in enumerate(self._unknown_numbers()):
            self._put(self._get(self.y, i, base), self.unknowns, k)
        self._write_base(self.unknowns, self.y, self.H)
        f.call(self.solve, memory)
        f.call(self.check, memory, estimates, coefficients)
        if self.time_defect:
            with f.if_(estimates > 1):
                f.call(self.time_history, memory, coefficients)
        with f.if_(estimates > 0), f.if_(~self._is_moving(coefficients)):
            f.call(self.estimate_at_rest, memory)
        with f.if_(estimates > 0), f.if_(self._is_moving(coefficients)):
            write_history(self.errors, self.error_rate, self.dH, "used")
            f.call(self.estimate_of_grid, memory)
            if self.settings.uses_rate:
                newest = self.errors[0], self.dH
                self._write_each(self.error_rate, "used", lambda new, H: c0 * new + H, *newest)
        if self.time_defect:
            with f.if_(estimates > 1):
                f.call(self.estimate_of_time, memory)
        solved = self._get(self.outcome, ERROR) <= self._get(self.options, ACCEPTABLE)
        self._put(f.select(solved, self._get(self.outcome, ALIVE), 0.0), self.outcome, ALIVE)

    def _write_guesses(self) -> None:
        """Weights of the extrapolations in the next first guess, and the shift of earlier states.

        The extrapolations (2, 3, 3) are those to this stage and to the next.
        """
        e = self.equations
        self.guesses = f = self._function("guesses", "extrapolations")
        _, table = f.arguments
        this, following = (
            [[f.load(table, 9 * half + 3 * row + k) for k in range(3)] for row in range(3)]
            for half in range(2)
        )
        misfits = [self._wide_variable(0.0) for _ in range(3)]
        for i, j in self._components(e.ny, self._count("points")):
            past = [self._wide(each, i, j) for each in self.past]
            unit, y = self._unit(i, j), self._wide(self.y, i, j)
            for order, (misfit, weights) in enumerate(zip(misfits, this, strict=True)):
                guess = _sum(map(operator.mul, past[: order + 1], weights))
                size = f.apply("abs", guess - y) * unit
                size = self._before(self._count("points"), j, size)
                misfit.set(f.apply("max", misfit.get(), size))
        sizes = [self._largest(each.get()) for each in misfits]
        least = f.apply("max", f.apply("min", sizes[0], f.apply("min", sizes[1], sizes[2])), ROUNDING)
        ratios = [f.apply("max", each / least, 1.0) for each in sizes]
        trusts = [1.0 / (each * each * each) for each in ratios]
        total = trusts[0] + trusts[1] + trusts[2]
        for k in range(3):
            weight = f.value(0.0)
            for order in range(k, 3):
                weight = weight + trusts[order] / total * following[order][k]
            self._put(weight, self.weights, k)
        self._write_shift([self.y, *self.past], self._count("points"))

    def _write_vectors(self) -> None:
        """Runs of vectors of robots in turn, each from its state, which is replaced by the state after it.

        Results are rows, numbers of stages, the number of solved steps and the length (m). The state of a
        robot whose first step failed remains; that of a single robot remains if any step failed. If `n_kept`
        is not zero, the factors in memory are those of the last step before the state, and are used again.
        """
        e, P, L = self.equations, self.P, self.L
        names = ["memory", "motions", "parameters", "controls", "coefficients", "extrapolations", "results"]
        names += ["n_size", "n_vectors", "n_steps", "n_stages", "n_estimates", "n_kept"]
        f = self._now = self.module.function("run", names, exported=True)
        memory, motions, parameters, controls, coefficients, extrapolations, results = f.arguments[:7]
        size, vectors, steps, stages, estimates, kept = f.arguments[7:]
        solves, is_moving = steps * stages, self._is_moving(coefficients)
        rows = solves * (self._count("nodes") * (self.strands * e.numbers * P))
        infos = solves * ((8 + e.k) * P)
        states = [(is_moving, [*itertools.chain(*self.motion)]), (~is_moving, [self.y])]
        with f.loop(vectors) as vector:
            k = vector.value
            own = f.pointer(motions, k * size)
            for condition, state in states:
                with f.if_(condition):
                    for inside, outside in self._each_packed_vector(state, own):
                        f.store(f.load(outside, 0, L), inside, 0)
            with f.loop(self.params.size * P, 0, P) as i:
                value = f.load(parameters, k * (self.params.size * P) + i.value, P)
                f.store(value, self._pointer(self.params, 0), i.value, P)
            with f.if_(f.compare("eq", kept, 0)):
                self._put(0.0, self.outcome, USABLE)
            f.call(self.setup, memory)
            result = f.pointer(results, k * (rows + infos + 2 * P))
            info, acting = f.pointer(result, rows), f.pointer(controls, k * (solves * (e.nc * P)))
            reached = f.pointer(info, infos)
            arrays = memory, acting, coefficients, extrapolations, result, info, reached
            f.call(self.steps, *arrays, steps, stages, estimates)
            f.store(self._get(self.length, 0), reached, P, P)
            least = f.splat(f.value(1.0), P) if self.batch else f.result(f"sitofp i64 {steps.name} to double")
            moved = self._spread(f.load(reached, 0, P) >= least)
            for condition, state in states:
                with f.if_(condition):
                    for inside, outside in self._each_packed_vector(state, own):
                        f.store(f.select(moved, f.load(inside, 0, L), f.load(outside, 0, L)), outside, 0)

    def _write_evaluate(self) -> None:
        """The state at y and history terms; y is corrected at points between nodes, `n_most` a segment."""
        names = ["memory", "coefficients", "control", "n_most"]
        f = self._now = self.module.function("evaluate", names, exported=True)
        memory, coefficients, control, most = f.arguments
        f.call(self.setup, memory)
        self._write_inputs(f.load(coefficients, 0), f.load(coefficients, self.settings.memory + 2), control)
        if self.near:
            self._write_filling(most, self.rates_and_slopes, self.rates)
        f.call(self.record, memory, 1, coefficients)

    def _write(self) -> None:
        self._write_setup()
        self._write_terms()
        self.rates = self._write_rates("rates")
        self.rates_and_slopes = self._write_rates("rates_and_slopes", [(self.slope, self.equations.nonzeros)])
        self.residual = self._write_residual("residual", self.trial.y, self.H)
        self.residual_of_y = self._write_residual("residual_of_y", self.y, self.H)
        self.residual_of_better = self._write_residual("residual_of_better", self.better.y, self.own_dH)
        self.defects = self._function("defects")
        self._write_defects(self.trial.y, self.H)
        if not self.batch:
            self.solve_piece = self._write_piece_solution()
        self._write_factor()
        self.advance = self._write_advance()
        self._write_along()
        self._write_linearise()
        self._write_correct()
        self._write_weights()
        self._write_newton()
        self._write_record()
        self._write_check()
        self.estimate_of_grid = self._write_estimate("estimate_of_grid", self.errors, self.dH, True, POSITION)
        self._write_static_estimate()
        if self.time_defect:
            self._write_products()
            self._write_response()
            time = self.time_errors, self.time_dH
            self.estimate_of_time = self._write_estimate("estimate_of_time", *time, False, TIME)
            self._write_time_history()
        self._write_stage()
        self._write_guesses()
        self._write_run()
        self._write_vectors()
        if not self.batch:
            self._write_evaluate()
        if self.is_linear_step:
            self._write_linear_step()

    # running

    def evaluator(self, parameters: np.ndarray, memory: Any = None) -> Callable[..., Evaluated]:
        """Return a function that evaluates states of one robot, all in the same memory.

        Its arguments are c0, the time (s), the control, history terms (places, x), and y at all points, or at
        the nodes.
        """
        memory, counts = self._empty_memory() if memory is None else memory, self.counts
        self._put_in(memory[None], self.params, parameters[None, None, None])

        def evaluate(c0: float, t: float, control: Any, history: Any, y: Any) -> Evaluated:
            most = 0
            if len(y) < counts["points of strand"]:
                y, most = counts.grid.spread(y), counts["most"]
            for array, values in ((self.H, history), (self.y, y)):
                self._put_in(memory[None], array, self._by_strand(array, np.asarray(values))[None, None])
            table, control = np.zeros(self.settings.memory + 3), np.array(control, dtype=float)
            table[[0, -1]] = c0, t
            self._functions.run("evaluate", memory, table, control, most)
            arrays = self.y, self.records[0], self.r, self.scale_y, self.tip
            y, records, defects, inverse, tip = (self._numbers(memory[None], each)[0, 0] for each in arrays)
            pieces = slice(counts["pieces"])
            error = np.max(np.abs(defects[pieces]) * inverse[pieces])
            y = self._join(self.y, y, counts["points of strand"])
            records = self._join(self.records[0], records, counts.grid.count)
            return Evaluated(y.copy(), records.copy(), error, tip[0].copy())

        return evaluate


def _sum(values: Iterable[Value]) -> Value:
    return functools.reduce(operator.add, values)
