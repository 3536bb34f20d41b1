"""The loop over time, compiled: steps until all are done or one fails."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import Kept, newton_keeping, none_kept
from knode_cosserat.solvers.past import EXTRAPOLATIONS, Past, advanced, history_of, problem_of
from knode_cosserat.solvers.problem import StepProblem, row_of
from knode_cosserat.solvers.settings import Settings

#: the mean is by this power of how far each was off in the newest step: a lower one lets a bad one in, a
#: higher one trusts chance
TRUST = -3
#: misfits below this are rounding errors (natural units)
ROUNDING = 1e-12


class Rows(NamedTuple):
    """The steps' results, one row a step."""

    records: Float[Any, "steps nodes x"]
    unknowns: Float[Any, "steps k"]
    error: Float[Any, " steps"]
    corrections: Int[Any, " steps"]
    #: the largest number of y in natural units: a sign of instability when it is far beyond one
    size: Float[Any, " steps"]


def step(
    system: System, settings: Settings, past: Past, coefficients: Any, control: Any, t: Any,
    kept: Kept | None,
) -> Any:  # fmt: skip
    """One time step: the next past, the step's row, and what is kept of its linearisation."""
    history = history_of(past, coefficients, settings)
    problem = problem_of(system, settings, t, control, coefficients[0], history).ready()
    # as sums of products, not as matrix products: XLA fuses these with what follows
    guess = jnp.sum(past.weights[:, None, None] * past.y, axis=0)
    unknowns = system.unknowns(guess[0])
    solution, kept = newton_keeping(problem, guess, unknowns, settings.elimination, settings.newton, kept)
    records = problem.records(solution.y)
    scale = system.scales().y
    rate = coefficients[0] * records + history if settings.time.uses_rate else past.rate
    size = jnp.max(jnp.abs(solution.y) / scale)
    shown = row_of(system, solution.y, records)
    row = Rows(shown, solution.unknowns, solution.error, solution.corrections, size)
    extrapolated = jnp.sum(EXTRAPOLATIONS[:, :, None, None] * past.y, axis=1)
    weights = weights_by(jnp.max(jnp.abs(extrapolated - solution.y) / scale, axis=(1, 2)))
    return advanced(past, records, rate, solution.y, weights), row, kept


def weights_by(misfit: Float[Any, " extrapolations"]) -> Float[Any, " past"]:
    """What each past state counts in the mean of the extrapolations, by how far these were off."""
    trust = jnp.maximum(misfit / jnp.maximum(jnp.min(misfit), ROUNDING), 1.0) ** TRUST
    return jnp.sum((trust / jnp.sum(trust))[:, None] * EXTRAPOLATIONS, axis=0)


def _none_kept(system: System, settings: Settings, past: Past, control: Any) -> Kept | None:
    """What is kept before the first step: nothing at all, unless linearisations are kept across steps."""
    if not settings.newton.across_steps:
        return None
    problem = StepProblem.still(system, settings.space, control)
    y = past.y[0]
    return none_kept(problem, y, system.unknowns(y[0]), settings.elimination)


def _no_rows(system: System, shape: tuple[int, ...], past: Past) -> Rows:
    """Rows of zeros, (steps,) or (robots, steps), for what a past is like."""
    return Rows(
        jnp.zeros((*shape, system.nodes, past.records.shape[-1])),
        jnp.zeros((*shape, system.unknown_count)),
        jnp.zeros(shape),
        jnp.zeros(shape, dtype=int),
        jnp.zeros(shape),
    )


def _attempt(
    system: System, settings: Settings, table: Any, past: Past, control: Any, i: Any, dt: Any,
    kept: Kept | None,
) -> tuple[Any, Past, Rows, Kept | None]:  # fmt: skip
    """Step i: whether it failed, the past of the step that is next (this one, if it failed), row, kept."""
    coefficients = jnp.where(i == 0, table[0], table[1])
    t = past.t0 + (i + 1) * dt
    after, row, kept = step(system, settings, past, coefficients, control, t, kept)
    failed = ~(row.error <= settings.newton.acceptable)
    return failed, _where(failed, past, after), row, kept


def _where(condition: Any, one: Any, other: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


def march(
    system: System, settings: Settings, table: Any, controls: Any, dt: Any, past: Past, start: Any, stop: Any
) -> tuple[Any, Past, Rows]:
    """Steps `start` to `stop` (exclusive; step i uses controls[i] and ends at t0 + (i + 1) dt).

    Ends early at a step that does not converge. Gives how many steps are done, the past of the step that is
    next, and the rows of all steps that were tried; the rest of the rows are zero.
    """

    def going(state: Any) -> Any:
        i, failed, *_ = state
        return (i < stop) & ~failed

    def one(state: Any) -> Any:
        i, _, past, rows, kept = state
        failed, past, row, kept = _attempt(system, settings, table, past, controls[i], i, dt, kept)
        rows = jax.tree.map(lambda all_rows, value: all_rows.at[i].set(value), rows, row)
        return jnp.where(failed, i, i + 1), failed, past, rows, kept

    kept = _none_kept(system, settings, past, controls[0])
    state = (start, jnp.array(False), past, _no_rows(system, controls.shape[:1], past), kept)
    done, _, past, rows, _ = jax.lax.while_loop(going, one, state)
    return done, past, rows


def march_in_turn(
    system: System,
    settings: Settings,
    table: Any,
    controls: Any,
    dt: Any,
    pasts: Past,
    stop: Any,
    batched: Any,
) -> tuple[Any, Rows]:
    """All steps of one robot after the other: how many steps each has done, and all rows.

    One loop over robots and steps, not a loop in a loop: XLA copies all rows at every turn of an inner loop.
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
        if kept is not None:
            kept = kept._replace(usable=kept.usable & ~ended)
        return following, jnp.where(ended, 0, i + 1), past, done, rows, kept

    kept = _none_kept(own(system, 0) if batched else system, settings, own(pasts, 0), controls[0, 0])
    zero = jnp.zeros((), dtype=int)
    rows = _no_rows(system, controls.shape[:2], pasts)
    state = (zero, zero, own(pasts, 0), jnp.zeros(size, dtype=int), rows, kept)
    _, _, _, done, rows, _ = jax.lax.while_loop(lambda state: state[0] < size, one, state)
    return done, rows


@functools.partial(jax.jit, static_argnames="settings")
def march_one(system, settings, table, controls, dt, past, start, stop):  # type: ignore[no-untyped-def]
    """`march`, compiled."""
    return march(system, settings, table, controls, dt, past, start, stop)


@functools.partial(jax.jit, static_argnames=("settings", "batched", "lockstep"))
def march_many(system, settings, table, controls, dt, pasts, stop, batched, lockstep):  # type: ignore[no-untyped-def]
    """A batch, compiled once: controls (B, T, c), and a batch of systems if `batched`.

    On a CPU the robots run one after the other, each with its own number of Newton corrections; together in
    lockstep they would all wait for the slowest, which measured half as fast. On a GPU lockstep wins.
    """
    if not lockstep:
        return march_in_turn(system, settings, table, controls, dt, pasts, stop, batched)

    def one(system: System, control: Any, past: Past) -> tuple[Any, Rows]:
        done, _, rows = march(system, settings, table, control, dt, past, 0, stop)
        return done, rows

    return jax.vmap(one, in_axes=(0 if batched else None, 0, 0))(system, controls, pasts)
