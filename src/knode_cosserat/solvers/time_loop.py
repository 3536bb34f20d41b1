"""Compiled time loop: runs until all steps are done or one fails."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from knode_cosserat.rods.strands import in_strands
from knode_cosserat.rods.system import System, unknown_count, unknowns_of
from knode_cosserat.solvers.boundary import Kept, largest_residual, newton, none_kept, pivots_of
from knode_cosserat.solvers.history import EXTRAPOLATIONS, StateHistory, advanced, history_of
from knode_cosserat.solvers.linear import Factors, solved_correction
from knode_cosserat.solvers.problem import Stages, StepProblem, row_of
from knode_cosserat.solvers.settings import Settings

#: extrapolations are weighted by this power of their errors in the newest step
TRUST = -3
#: axis name of robots that are solved in lockstep
BATCH = "robots"
#: misfits below this are rounding errors (natural units)
ROUNDING = 1e-12


class StepRows(NamedTuple):
    """The steps' results, one row a step."""

    records: Float[Any, "steps nodes x"]
    unknowns: Float[Any, "steps k"]
    #: largest residual, natural units
    error: Float[Any, " steps"]
    corrections: Int[Any, " steps"]
    #: estimated discretisation error of positions (m), the largest over the nodes
    position_error: Float[Any, " steps"]


def solve_time_step(
    system: System, settings: Settings, past: StateHistory, coefficients: Any, control: Any, t: Any,
    kept: Kept, batch: str | None = None,
) -> Any:  # fmt: skip
    """Solve one time step: return the next history, the step's row, and the kept factors."""
    history = history_of(past.records, past.rate, coefficients, settings)
    problem = StepProblem(system, t, control, coefficients[0], history, settings.space).ready()
    # sum of products instead of a matrix product: XLA fuses it with the next operations
    guess = jnp.sum(past.weights[:, None, None] * past.y, axis=0)
    solution, kept = newton(problem, guess, unknowns_of(system, guess[0]), settings.newton, kept, batch)
    after, row = recorded_step(problem, settings, past, coefficients, solution, kept.factors)
    scale = system.scales().y
    extrapolated = jnp.sum(EXTRAPOLATIONS[:, :, None, None] * past.y, axis=1)
    weights = weights_by(jnp.max(jnp.abs(extrapolated - solution.y) / scale, axis=(1, 2)))
    return after._replace(weights=weights), row, kept


def recorded_step(
    problem: StepProblem,
    settings: Settings,
    past: StateHistory,
    coefficients: Any,
    solution: Any,
    factors: Factors,
) -> tuple[StateHistory, StepRows]:
    """Return the history after a solved step, and its row, with the discretisation error.

    The error e of a step solves the step's linear equations. Their right-hand side is the defect of the check
    formula, plus the effect of earlier steps' errors through the history.
    """
    system, space, y = problem.system, problem.space, solution.y
    d_history = history_of(past.error[:2], past.error[2], coefficients, settings)
    used = d_history.shape[0]

    def scheme(used_history: Any, y: Any) -> tuple[Stages, Any, Any, Any]:
        own = problem.with_history(jnp.concatenate([used_history, problem.history[used:]]))
        found = own.stages(y, space.formula, own.ends(y))
        reached = own.reached_by(space.formula, found)
        return found, reached, own.tip_residual(y[-1]), own.base(solution.unknowns)

    history = problem.history[:used]
    (found, reached, tip, _), (_, *moved) = jax.jvp(lambda h: scheme(h, y), (history,), (d_history,))
    checked = problem.stages(y, space.check, found)
    defects = problem.reached_by(space.check, checked) - y[1:]
    e, _ = solved_correction(factors, pivots_of(system), defects + moved[0], *moved[1:])
    records = problem.packed(checked)
    error = jax.jvp(lambda *at: problem.packed(scheme(*at)[0]), (history, y), (d_history, e))[1]
    if settings.time.uses_rate:
        rate, d_rate = coefficients[0] * records + problem.history, coefficients[0] * error + d_history
    else:
        rate, d_rate = past.rate, past.error[2]
    # residual of the returned state, evaluated independently of the iteration
    residual = jnp.maximum(solution.error, largest_residual(problem, reached - y[1:], tip))
    row = StepRows(
        row_of(system, y, records), solution.unknowns, _finite_or_infinite(residual, records),
        solution.corrections, position_error(system, e),
    )  # fmt: skip
    after = advanced(past, records, rate, y, past.weights)
    return after._replace(error=jnp.stack([error, past.error[0], d_rate])), row


def position_error(system: System, e: Float[Any, "points y"]) -> Float[Any, ""]:
    """Return the largest position error (m); without positions, that of y over its scale times the length."""
    strand = system.strand
    if "p" not in strand.y_layout.names:
        return jnp.max(jnp.abs(e) / system.scales().y) * system.length
    p = strand.y_layout.get(in_strands(system, e), "p")
    return jnp.sqrt(jnp.max(jnp.sum(p * p, axis=-1)))


def _finite_or_infinite(error: Any, records: Any) -> Any:
    """Return the residual of a step; infinite if a record is not finite (no residual has the tip's z)."""
    return jnp.where(jnp.all(jnp.isfinite(records)), error, jnp.inf)


def weights_by(misfit: Float[Any, " extrapolations"]) -> Float[Any, " past"]:
    """Return the weights of earlier states in the first guess, from the errors of the extrapolations."""
    trust = jnp.maximum(misfit / jnp.maximum(jnp.min(misfit), ROUNDING), 1.0) ** TRUST
    return jnp.sum((trust / jnp.sum(trust))[:, None] * EXTRAPOLATIONS, axis=0)


def no_factors(system: System, settings: Settings, past: StateHistory, control: Any) -> Kept:
    """Return factors of the right shape that are not usable."""
    problem = StepProblem.still(system, settings.space, control)
    y = past.y[0]
    return none_kept(problem, y, unknowns_of(system, y[0]))


def _no_rows(system: System, shape: tuple[int, ...], past: StateHistory) -> StepRows:
    """Return rows of zeros, (steps,) or (robots, steps)."""
    return StepRows(
        jnp.zeros((*shape, system.nodes, past.records.shape[-1])),
        jnp.zeros((*shape, unknown_count(system))),
        jnp.zeros(shape),
        jnp.zeros(shape, dtype=int),
        jnp.zeros(shape),
    )


def _attempt(
    system: System, settings: Settings, table: Any, past: StateHistory, control: Any, i: Any, dt: Any,
    kept: Kept, batch: str | None = None,
) -> tuple[Any, StateHistory, StepRows, Kept]:  # fmt: skip
    """Try step i: return a failure flag, the next history (unchanged on failure), row and factors."""
    coefficients = jnp.where(i == 0, table[0], table[1])
    t = past.t0 + (i + 1) * dt
    after, row, kept = solve_time_step(system, settings, past, coefficients, control, t, kept, batch)
    failed = ~(row.error <= settings.newton.acceptable)
    return failed, _where(failed, past, after), row, kept


def _where(condition: Any, one: Any, other: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


def time_loop(
    system: System, settings: Settings, table: Any, controls: Any, dt: Any, past: StateHistory, start: Any,
    stop: Any, batch: str | None = None,
) -> tuple[Any, StateHistory, StepRows]:  # fmt: skip
    """Solve the steps `start` to `stop` (exclusive; step i uses controls[i] and ends at t0 + (i + 1) dt).

    Stops at a step that does not converge. Returns the number of steps done, the history of the next step,
    and the rows of all steps tried; the remaining rows are zero.
    """

    def going(state: Any) -> Any:
        i, failed, *_ = state
        return (i < stop) & ~failed

    def one(state: Any) -> Any:
        i, _, past, rows, kept = state
        failed, past, row, kept = _attempt(system, settings, table, past, controls[i], i, dt, kept, batch)
        rows = jax.tree.map(lambda all_rows, value: all_rows.at[i].set(value), rows, row)
        return jnp.where(failed, i, i + 1), failed, past, rows, kept

    kept = no_factors(system, settings, past, controls[0])
    state = (start, jnp.array(False), past, _no_rows(system, controls.shape[:1], past), kept)
    done, _, past, rows, _ = jax.lax.while_loop(going, one, state)
    return done, past, rows


def loop_in_turn(
    system: System,
    settings: Settings,
    table: Any,
    controls: Any,
    dt: Any,
    pasts: StateHistory,
    stop: Any,
    batched: Any,
) -> tuple[Any, StepRows]:
    """Solve all steps, one robot after the other; return the numbers of steps done, and all rows.

    It is a single loop over robots and steps: XLA would copy all rows at every turn of an inner loop.
    """
    size = controls.shape[0]

    def own(tree: Any, robot: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf[robot], tree)

    def one(state: Any) -> Any:
        robot, i, past, done, rows, kept = state
        this = own(system, robot) if batched else system
        failed, past, row, kept = _attempt(this, settings, table, past, controls[robot, i], i, dt, kept)
        rows = jax.tree.map(lambda all_rows, value: all_rows.at[robot, i].set(value), rows, row)
        done = done.at[robot].set(jnp.where(failed, i, i + 1))
        ended = failed | (i + 1 >= stop)
        following = jnp.where(ended, robot + 1, robot)
        past = _where(ended, own(pasts, jnp.minimum(following, size - 1)), past)
        return (
            following,
            jnp.where(ended, 0, i + 1),
            past,
            done,
            rows,
            kept._replace(usable=kept.usable & ~ended),
        )

    kept = no_factors(own(system, 0) if batched else system, settings, own(pasts, 0), controls[0, 0])
    zero = jnp.zeros((), dtype=int)
    rows = _no_rows(system, controls.shape[:2], pasts)
    state = (zero, zero, own(pasts, 0), jnp.zeros(size, dtype=int), rows, kept)
    _, _, _, done, rows, _ = jax.lax.while_loop(lambda state: state[0] < size, one, state)
    return done, rows


@functools.partial(jax.jit, static_argnames="settings")
def loop_one(system, settings, table, controls, dt, past, start, stop):  # type: ignore[no-untyped-def]
    """Run `time_loop` as a compiled program."""
    return time_loop(system, settings, table, controls, dt, past, start, stop)


@functools.partial(jax.jit, static_argnames=("settings", "batched", "lockstep"))
def loop_many(system, settings, table, controls, dt, pasts, stop, batched, lockstep):  # type: ignore[no-untyped-def]
    """Simulate a batch as one compiled program: controls (B, T, c), and a batch of systems if `batched`.

    On a CPU the robots are solved one after the other, each with its own number of corrections; lockstep was
    measured at a third of the speed, because all robots wait for the slowest. On a GPU lockstep is faster.
    """
    if not lockstep:
        return loop_in_turn(system, settings, table, controls, dt, pasts, stop, batched)

    def one(system: System, control: Any, past: StateHistory) -> tuple[Any, StepRows]:
        done, _, rows = time_loop(system, settings, table, control, dt, past, 0, stop, BATCH)
        return done, rows

    robots = jax.vmap(one, in_axes=(0 if batched else None, 0, 0), axis_name=BATCH)
    return robots(system, controls, pasts)
