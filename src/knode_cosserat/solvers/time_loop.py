"""Compiled time loop: runs until all steps are done or one fails."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.rods.strands import in_strands
from knode_cosserat.rods.system import System, is_traced, unknown_count, unknowns_of
from knode_cosserat.solvers.boundary import (
    Kept,
    NewtonOptions,
    Solution,
    largest_of,
    largest_residual,
    newton,
    none_kept,
    pivots_of,
)
from knode_cosserat.solvers.history import (
    EXTRAPOLATIONS,
    GUESS_STATES,
    FirstStep,
    StateHistory,
    advanced,
    coefficient_table,
    history_of,
)
from knode_cosserat.solvers.linear import Factors, solved_correction
from knode_cosserat.solvers.problem import Stages, StepProblem, no_history, row_of
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import LOBATTO2
from knode_cosserat.solvers.time import SDIRK2

#: extrapolations are weighted by this power of their errors in the newest step
TRUST = -3
#: a row is COARSE if its position error is above this part of the length, or its orientation error above this
#: angle (rad), which is the position error relative to the radius of curvature of a coil
COARSE_SHARE, COARSE_ANGLE = 0.02, 0.1
#: tolerance of a step's error estimate relative to its change, and largest number of corrections
ESTIMATE_TOLERANCE, ESTIMATE_TURNS = 1e-2, 10
#: misfits below this are rounding errors (natural units)
ROUNDING = 1e-12


class StepRows(NamedTuple):
    """The steps' results, one row a step; with a batch, one axis more in front.

    A row is that of the step's last stage; `stages` and `stage_unknowns` are those of the stages before it.
    """

    records: Float[Any, "steps nodes x"]
    unknowns: Float[Any, "steps k"]
    #: largest residual, natural units
    error: Float[Any, " steps"]
    corrections: Int[Any, " steps"]
    #: estimated discretisation error of positions (m), the largest over the nodes; NaN: no estimate
    position_error: Float[Any, " steps"]
    #: result codes (`result.Result`)
    result: Int[Any, " steps"]
    #: estimated error of positions (m) by the time scheme, the largest over the nodes; NaN: no estimate
    time_error: Float[Any, " steps"]
    stages: Float[Any, "steps stages nodes x"]
    stage_unknowns: Float[Any, "steps stages k"]

    @property
    def every_stage(self) -> tuple[Float[Any, "solves nodes x"], Float[Any, "solves k"]]:
        """Records and unknowns of all stages of all steps in turn, those of the rows among them."""
        pairs = (self.stages, self.records), (self.stage_unknowns, self.unknowns)
        numeric: Any = jnp if is_traced(self) else np
        joined = [numeric.concatenate([stages, last[:, None]], axis=1) for stages, last in pairs]
        records, unknowns = (part.reshape(-1, *part.shape[2:]) for part in joined)
        return records, unknowns


class StepCoefficients(NamedTuple):
    """Coefficients of a run's first step and of all later steps, its time step (s), and the ends of stages.

    A scheme of several stages has coefficients (2, stages, 4) and as many ends, as parts of a step.
    """

    table: Float[Any, "2 4"]
    dt: Any
    ends: Any = 1.0

    @classmethod
    def of(cls, settings: Settings, dt: float, first: FirstStep = "start") -> StepCoefficients:
        """Return the coefficients of a run with steps of dt (s)."""
        ends = np.array(settings.time.ends) if settings.time and settings.stages > 1 else 1.0
        return cls(coefficient_table(settings, dt, first), dt, ends)

    def at(self, t0: Any, i: Any) -> tuple[Any, Any]:
        """Return the coefficients of step i, and the times (s) at its end or at those of its stages."""
        numeric: Any = jnp if is_traced((self, i)) else np
        return numeric.where(i == 0, self.table[0], self.table[1]), t0 + (i + self.ends) * self.dt


class TimeStep(NamedTuple):
    """A time step, without its control: the history before it, its coefficients, and the time at its end.

    With several stages, coefficients (stages, 4) and times (stages,).
    """

    past: StateHistory
    coefficients: Float[Any, "4"]
    t: Any

    @classmethod
    def of(cls, steps: StepCoefficients, past: StateHistory, i: Any) -> TimeStep:
        """Return step i of a run."""
        return cls(past, *steps.at(past.t0, i))

    def problem(self, system: System, settings: Settings, control: Any) -> StepProblem:
        """Return the boundary-value problem of the step."""
        history = history_of(self.past.records, self.past.rate, self.coefficients, settings)
        return StepProblem(system, self.t, control, self.coefficients[0], history, settings.space)


def solve_time_step(
    system: System, settings: Settings, step: TimeStep, control: Any, kept: Kept
) -> tuple[StateHistory, StepRows, Kept]:
    """Solve one time step: return the next history, the step's row, and the kept factors.

    The control (c,) is held during all stages, or is (stages * c,), one after the other.
    """
    if settings.stages == 1:
        guesses = EXTRAPOLATIONS, EXTRAPOLATIONS
        return solve_stage(system, settings, step, control, kept, guesses)
    own = stage_controls(system, settings, control)
    own_guesses = stage_extrapolations(settings)
    pairs = own_guesses, jnp.roll(own_guesses, -1, axis=0)

    def solve(state: tuple[StateHistory, Kept], stage: Any) -> Any:
        past, kept = state
        coefficients, t, control, guesses = stage
        one = TimeStep(past, coefficients, t)
        past, row, kept = solve_stage(system, settings, one, control, kept, guesses)
        return (past, kept), row

    stages = step.coefficients, step.t, own, pairs
    (past, kept), rows = jax.lax.scan(solve, (step.past, kept), stages)
    return past, joined_stages(rows), kept


def stage_controls(system: System, settings: Settings, control: Any) -> Float[Any, "stages c"]:
    """Return the control of each stage of a step; see `solve_time_step`."""
    size = system.control_size
    own = control[None] if control.shape[0] == size else control.reshape(settings.stages, size)
    numeric: Any = jnp if is_traced(own) else np
    return numeric.broadcast_to(own, (settings.stages, size))


def joined_stages(rows: StepRows) -> StepRows:
    """Return the row of a step from those of its stages: the last, with the worst result of all."""
    numeric: Any = jnp if is_traced(rows) else np
    last, failed = jax.tree.map(lambda leaf: leaf[-1], rows), numeric.min(rows.result)
    return last._replace(
        error=numeric.max(rows.error), corrections=numeric.sum(rows.corrections),
        result=numeric.where(failed < 0, failed, last.result),
        stages=rows.records[:-1], stage_unknowns=rows.unknowns[:-1],
    )  # fmt: skip


def stage_extrapolations(settings: Settings) -> Float[np.ndarray, "stages past past"]:
    """Return for each stage the constant, linear and quadratic extrapolations from the last three states."""
    assert settings.time is not None
    ends = np.array(settings.time.ends)
    times = np.concatenate([ends - 2.0, ends - 1.0, ends])
    found = np.zeros((len(ends), *EXTRAPOLATIONS.shape))
    for k in range(len(ends)):
        now = 2 * len(ends) + k
        for order in range(GUESS_STATES):
            nodes = times[now - 1 - order : now][::-1] - times[now]
            found[k, order, : order + 1] = np.linalg.solve(
                np.vander(nodes, increasing=True).T, np.eye(order + 1)[0]
            )
    return found


def solve_stage(
    system: System, settings: Settings, step: TimeStep, control: Any, kept: Kept, guesses: tuple[Any, Any],
) -> tuple[StateHistory, StepRows, Kept]:  # fmt: skip
    """Solve one stage of a time step; `guesses` are the extrapolations to it and to the next stage."""
    extrapolations, following = guesses
    problem, past = step.problem(system, settings, control).ready(), step.past
    # sum of products instead of a matrix product: XLA fuses it with the next operations
    guess = jnp.sum(past.weights[:, None, None] * past.y, axis=0)
    solution, kept = newton(problem, guess, unknowns_of(system, guess[0]), settings.newton, kept)
    after, row = recorded_step(problem, settings, step, solution, kept.factors)
    if settings.stages > 1:
        time_error, largest = time_errors(problem, settings, step, solution, kept.factors, after)
        after, row = after._replace(time_error=time_error), row._replace(time_error=largest)
    scale = system.scales().y
    extrapolated = jnp.sum(extrapolations[:, :, None, None] * past.y, axis=1)
    weights = weights_by(jnp.max(jnp.abs(extrapolated - solution.y) / scale, axis=(1, 2)), following)
    return after._replace(weights=weights), row, kept


def recorded_step(
    problem: StepProblem, settings: Settings, step: TimeStep, solution: Solution, factors: Factors
) -> tuple[StateHistory, StepRows]:
    """Return the history after a solved step, and its row."""
    past, c0 = step.past, step.coefficients[0]
    d_history = history_of(past.error[:2], past.error[2], step.coefficients, settings)
    row, records, error = solved_row(problem, settings.newton, solution, factors, (d_history, past.error))
    rate, d_rate = past.rate, past.error[2]
    if settings.uses_rate:
        rate, d_rate = c0 * records + problem.history, c0 * error + d_history
    after = advanced(past, records, rate, solution.y, past.weights)
    return after._replace(error=jnp.stack([error, past.error[0], d_rate])), row


def solved_row(
    problem: StepProblem, newton: NewtonOptions, solution: Solution, factors: Factors, earlier: Any = None
) -> tuple[StepRows, Float[Any, "places x"], Any]:
    """Return the row of a solution, its records at all places, and their discretisation error.

    `earlier` are the errors of the history terms, and those of earlier records; an equilibrium has none.
    """
    system, space, y = problem.system, problem.space, solution.y
    found = problem.stages(y, space.formula, problem.ends(y))
    missing = problem.reached_by(space.formula, found) - y[1:], problem.tip_residual(y[-1])
    checked = problem.stages(y, space.check, found)
    defects = problem.reached_by(space.check, checked) - y[1:]
    records, error = problem.packed(checked), None
    if earlier is None:
        e, _ = solved_correction(factors, pivots_of(system), defects, jnp.zeros_like(missing[1]))
    else:
        better, error = _corrected(problem, solution, factors, (defects - missing[0], -missing[1]), earlier)
        # larger errors are no estimates: they are lost for the rest of the motion
        known = jnp.where(position_error(system, better - y) <= system.length, 1.0, jnp.nan)
        e, error = known * (better - y), known * (error - records[: len(error)])
    # residual of the returned state, evaluated independently of the iteration
    residual = jnp.maximum(solution.error, largest_residual(problem, *missing))
    residual = _finite_or_infinite(residual, records)
    off = position_error(system, e)
    fine = (off <= COARSE_SHARE * system.length) & (orientation_error(system, y, e) <= COARSE_ANGLE)
    result = jnp.where(fine, int(Result.CONVERGED), int(Result.COARSE))
    result = jnp.where(residual <= newton.acceptable, result, int(Result.NO_CONVERGENCE))
    row = StepRows(
        row_of(system, y, records), solution.unknowns, residual, solution.corrections, off, result,
        jnp.array(jnp.nan), *no_stages(system),
    )  # fmt: skip
    return row, records, error


def time_errors(
    problem: StepProblem, settings: Settings, step: TimeStep, solution: Solution, factors: Factors,
    after: StateHistory,
) -> tuple[Any, Any]:  # fmt: skip
    """Return the errors of the states after a stage by the time scheme, and the largest of positions (m).

    They are the distances to a corrected motion, as the errors of the grid are. A step of y' = J y + … adds a
    multiple of dt³ J² y'. The difference of the rates at both stages is one of dt J y'; the equations of the
    step multiply it once more by J, and damp the share of vibrations that a step does not resolve.
    """
    scheme, past, used = settings.time, step.past.time_error, step.past.time_error.shape[1]
    assert isinstance(scheme, SDIRK2)
    c0, system, y, history = problem.c0, problem.system, solution.y, problem.history[:used]
    newest, (stage, row) = after.records[0, :used], step.past.records[:, :used]

    def solved(history: Any, y: Any) -> tuple[Any, Any]:
        """Return the residuals of pieces, tip and base, and the records."""
        own = problem.with_history(jnp.concatenate([history, problem.history[used:]]))
        found = own.stages(y, problem.space.formula, own.ends(y))
        reached = own.reached_by(problem.space.formula, found) - y[1:]
        return (reached, own.tip_residual(y[-1]), own.base(solution.unknowns)), own.packed(found)

    (reached, tip, _), _ = solved(history, y)

    def added() -> Any:
        difference = newest + history / c0 - (stage - row)
        moved, _ = jax.jvp(lambda h: solved(h, y), (history,), (-c0 * difference,))[1]
        e, _ = solved_correction(factors, pivots_of(system), *moved)
        once = jax.jvp(lambda h, y: solved(h, y)[1], (history, y), (-c0 * difference, e))[1]
        return -c0 * scheme.defect * (once - difference)

    carried = history_of(past, jnp.zeros_like(past[0]), step.coefficients, settings)
    is_last = step.coefficients[2] != 0.0
    d_history = carried + jax.lax.cond(is_last, added, lambda: jnp.zeros_like(carried))
    better, records = _corrected(problem, solution, factors, (-reached, -tip), (d_history, past))
    off = position_error(system, better - y)
    # larger errors are no estimates: they are lost for the rest of the motion
    known = jnp.where(off <= system.length, 1.0, jnp.nan)
    return jnp.stack([known * (records - newest), past[0]]), known * off


class _Corrected(NamedTuple):
    """Iterate of a corrected step: y, unknowns, stages, and residuals of pieces and tip."""

    y: Float[Any, "points y"]
    unknowns: Float[Any, " k"]
    stages: Stages
    residuals: tuple[Any, Any]
    #: largest residual, natural units
    largest: Any
    #: expected size of the next correction, and number of corrections
    left: Any
    turns: Any


def _corrected(
    problem: StepProblem, solution: Solution, factors: Factors, defects: tuple[Any, Any], earlier: Any
) -> tuple[Any, Any]:
    """Return y at the points, and the records at the places of the scheme, of the corrected step.

    The corrected motion solves the equations with the defects of the check formula, from its own history. The
    factors may be those of an earlier step, so that a single correction would leave an error at every step.
    These errors add up where the motion turns: corrections go on until the one that is left is small relative
    to the change of the error in this step.
    """
    system, formula, y = problem.system, problem.space.formula, solution.y
    d_history, errors = earlier
    used = len(d_history)
    history = jnp.concatenate([problem.history[:used] + d_history, problem.history[used:]])
    own, scales = problem.with_history(history), system.scales()
    scale = scales.y + jnp.abs(y)
    before, earliest = errors[:2, : len(y), : y.shape[1]]

    def evaluated(y: Any, unknowns: Any, left: Any, turns: Any) -> _Corrected:
        y = jnp.concatenate([own.base(unknowns)[None], y[1:]])
        found = own.stages(y, formula, own.ends(y))
        residuals = own.reached_by(formula, found) - y[1:] + defects[0], own.tip_residual(y[-1]) + defects[1]
        return _Corrected(y, unknowns, found, residuals, largest_of(scales, *residuals), left, turns)

    def better(last: _Corrected) -> _Corrected:
        d_y, d_unknowns = solved_correction(factors, pivots_of(system), *last.residuals)
        size = jnp.max(jnp.abs(d_y) / scale)
        now = evaluated(last.y + d_y, last.unknowns + d_unknowns, size, last.turns + 1)
        return now._replace(left=size * now.largest / last.largest)

    def going(last: _Corrected) -> Any:
        change = jnp.max(jnp.abs(last.y - y - before) / scale)
        far = (last.left > ESTIMATE_TOLERANCE * change + ROUNDING) & (last.turns < ESTIMATE_TURNS)
        return (last.turns < 1) | far

    # linear extrapolation of the errors in time
    e = 2.0 * before - earliest
    first = evaluated(y + e, solution.unknowns + unknowns_of(system, e[0]), jnp.inf, 0)
    last = jax.lax.while_loop(going, better, first)
    return last.y, own.packed(last.stages)


def position_error(system: System, e: Float[Any, "points y"]) -> Float[Any, ""]:
    """Return the largest position error (m); without positions, that of y over its scale times the length."""
    strand = system.strand
    if "p" not in strand.y_layout.names:
        return jnp.max(jnp.abs(e) / system.scales().y) * system.length
    p = strand.y_layout.get(in_strands(system, e), "p")
    return jnp.sqrt(jnp.max(jnp.sum(p * p, axis=-1)))


def orientation_error(system: System, y: Float[Any, "points y"], e: Float[Any, "points y"]) -> Any:
    """Return the largest angle (rad) by which an error of y turns cross-sections; 0 without orientations."""
    layout = system.strand.y_layout
    if "h" not in layout.names:
        return 0.0
    h, d_h = (layout.get(in_strands(system, rows), "h") for rows in (y, e))
    square = jnp.sum(h * h, axis=-1)
    across = d_h - h * (jnp.sum(h * d_h, axis=-1) / square)[..., None]
    return 2.0 * jnp.sqrt(jnp.max(jnp.sum(across * across, axis=-1) / square))


def _finite_or_infinite(error: Any, records: Any) -> Any:
    """Return the residual of a step; infinite if a record is not finite (no residual has the tip's z)."""
    return jnp.where(jnp.all(jnp.isfinite(records)), error, jnp.inf)


def weights_by(misfit: Float[Any, " extrapolations"], following: Any = EXTRAPOLATIONS) -> Float[Any, " past"]:
    """Return the weights of earlier states in the next first guess, from the errors of the extrapolations."""
    trust = jnp.maximum(misfit / jnp.maximum(jnp.min(misfit), ROUNDING), 1.0) ** TRUST
    return jnp.sum((trust / jnp.sum(trust))[:, None] * following, axis=0)


def no_factors(system: System, settings: Settings, y: Any, control: Any) -> Kept:
    """Return factors of the right shape that are not usable."""
    problem = StepProblem.still(system, settings.space, control[: system.control_size])
    return none_kept(problem, y, unknowns_of(system, y[0]))


def no_stages(system: System, count: int = 1, shape: tuple[int, ...] = ()) -> tuple[Any, Any]:
    """Return empty records and unknowns of the stages before the last of `count`, for rows of this shape."""
    numbers = no_history(system, LOBATTO2).shape[-1]
    shape = (*shape, count - 1)
    return jnp.zeros((*shape, system.nodes, numbers)), jnp.zeros((*shape, unknown_count(system)))


def no_rows(system: System, shape: tuple[int, ...], stages: int = 1) -> StepRows:
    """Return rows of steps that were not reached, (steps,) or (robots, steps)."""
    numbers = no_history(system, LOBATTO2).shape[-1]
    return StepRows(
        jnp.zeros((*shape, system.nodes, numbers)),
        jnp.zeros((*shape, unknown_count(system))),
        jnp.zeros(shape),
        jnp.zeros(shape, dtype=int),
        jnp.zeros(shape),
        jnp.full(shape, int(Result.NOT_REACHED)),
        jnp.full(shape, jnp.nan),
        *no_stages(system, stages, shape),
    )


def solve_until_failure(
    solve: Callable[[Any, Kept, Any], tuple[Any, StepRows, Kept]], first: Any, kept: Kept, rows: StepRows,
    start: Any, stop: Any,
) -> tuple[Any, Any, StepRows]:  # fmt: skip
    """Solve the steps `start` to `stop` (exclusive) in a compiled loop, until one fails.

    `solve` maps the result of the previous step, kept factors and the step's number to a result, a row and
    factors. Returns the number of steps done, the result of the last one, and the rows of all steps tried.
    """

    def going(state: Any) -> Any:
        i, failed, *_ = state
        return (i < stop) & ~failed

    def one(state: Any) -> Any:
        i, _, last, kept, rows = state
        following, row, kept = solve(last, kept, i)
        failed = row.result < 0
        rows = jax.tree.map(lambda all_rows, value: all_rows.at[i].set(value), rows, row)
        return jnp.where(failed, i, i + 1), failed, _where(failed, last, following), kept, rows

    state = (start, jnp.array(False), first, kept, rows)
    done, _, last, _, rows = jax.lax.while_loop(going, one, state)
    return done, last, rows


def _where(condition: Any, one: Any, other: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


def time_loop(
    system: System, settings: Settings, steps: StepCoefficients, controls: Any, past: StateHistory,
    span: tuple[Any, Any],
) -> tuple[Any, StateHistory, StepRows]:  # fmt: skip
    """Solve the steps of a span (step i uses controls[i] and ends at t0 + (i + 1) dt) until one fails."""

    def solve(past: StateHistory, kept: Kept, i: Any) -> tuple[StateHistory, StepRows, Kept]:
        step = TimeStep.of(steps, past, i)
        return solve_time_step(system, settings, step, controls[i], kept)

    kept = no_factors(system, settings, past.y[0], controls[0])
    rows = no_rows(system, controls.shape[:1], settings.stages)
    return solve_until_failure(solve, past, kept, rows, *span)


@functools.partial(jax.jit, static_argnames="settings")
def loop_one(system, settings, steps, controls, past, span):  # type: ignore[no-untyped-def]
    """Run `time_loop` as a compiled program."""
    return time_loop(system, settings, steps, controls, past, span)


@functools.partial(jax.jit, static_argnames="settings")
def loop_many(system, settings, steps, controls, pasts, stop):  # type: ignore[no-untyped-def]
    """Solve a batch, one robot after the other: controls (B, T, c), and one system or a batch of them.

    It is a single loop over robots and steps: XLA would copy all rows at every turn of an inner loop. First
    and last histories are different arrays, one only read and one only written, for the same reason.
    """
    size, many = controls.shape[0], jnp.ndim(system.length) > 0

    def own(tree: Any, robot: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf[robot], tree)

    def one(state: Any) -> Any:
        robot, i, past, lasts, done, rows, kept = state
        this, past = own(system, robot) if many else system, _where(i == 0, own(pasts, robot), past)
        step = TimeStep.of(steps, past, i)
        after, row, kept = solve_time_step(this, settings, step, controls[robot, i], kept)
        failed = row.result < 0
        rows = jax.tree.map(lambda all_rows, value: all_rows.at[robot, i].set(value), rows, row)
        after = _where(failed, past, after)
        lasts = jax.tree.map(lambda every, value: every.at[robot].set(value), lasts, after)
        done = done.at[robot].set(jnp.where(failed, i, i + 1))
        ended = failed | (i + 1 >= stop)
        following = jnp.where(ended, robot + 1, robot), jnp.where(ended, 0, i + 1)
        return *following, after, lasts, done, rows, kept._replace(usable=kept.usable & ~ended)

    first = own(system, 0) if many else system
    kept = no_factors(first, settings, pasts.y[0, 0], controls[0, 0])
    zero, past = jnp.zeros((), dtype=int), own(pasts, 0)
    lasts = jax.tree.map(jnp.zeros_like, pasts)
    rows = no_rows(system, controls.shape[:2], settings.stages)
    state = (zero, zero, past, lasts, jnp.zeros(size, dtype=int), rows, kept)
    _, _, _, lasts, done, rows, _ = jax.lax.while_loop(lambda state: state[0] < size, one, state)
    return done, lasts, rows
