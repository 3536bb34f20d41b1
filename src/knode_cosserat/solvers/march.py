"""The loop over time, compiled: steps until all are done or one fails."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import StepProblem, newton
from knode_cosserat.solvers.linear import Condensed
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import Euler
from knode_cosserat.solvers.time import BDF1

#: how many past states the warm start looks at, and the extrapolations it chooses from: constant, linear,
#: quadratic in time
PAST = 3
EXTRAPOLATIONS = np.array([[1.0, 0.0, 0.0], [2.0, -1.0, 0.0], [3.0, -3.0, 1.0]])


class Past(NamedTuple):
    """What a step needs of the steps before it, newest first."""

    records: Float[Any, "past nodes x"]
    rate: Float[Any, "nodes x"]
    unknowns: Float[Any, "past k"]
    #: the extrapolation that would have been best for the newest step
    order: Int[Any, ""]
    #: time of row 0 (s): step i ends at t0 + (i + 1) dt
    t0: Float[Any, ""]


class Rows(NamedTuple):
    """The steps' results, one row a step."""

    records: Float[Any, "steps nodes x"]
    unknowns: Float[Any, "steps k"]
    error: Float[Any, " steps"]
    corrections: Int[Any, " steps"]
    #: the largest number of y in natural units: a sign of instability when it is far beyond one
    size: Float[Any, " steps"]


def rest_record(system: System) -> Any:
    """y and z (nodes, y + z) of the system at rest."""
    s = jnp.linspace(0.0, 1.0, system.nodes) * system.length
    y, z = jax.vmap(system.rest)(s)
    return jnp.concatenate([y, z], axis=1)


def initial_past(system: System, record: Any, control: Any) -> Past:
    """A past of one state (y and z, nodes × x) only: every state before the first is the first.

    Where B is not zero y_s belongs to a record too: it is found from y as at rest under the control.
    """
    ny, nz = system.y_layout.size, system.z_layout.size
    if system.mixed:
        nothing = jnp.zeros((system.nodes, ny + nz + ny))
        still = StepProblem(system, jnp.zeros(()), control, jnp.zeros(()), nothing, Euler())
        record = jnp.concatenate([record, still.record(record[:, :ny])[:, ny + nz :]], axis=1)
    unknowns = system.unknowns(record[0, :ny])
    # an order of a definite type: a weak one would cost a second compilation when a march goes on
    order = jnp.zeros((), dtype=int)
    return Past(
        jnp.stack([record] * PAST), jnp.zeros_like(record), jnp.stack([unknowns] * PAST), order, jnp.zeros(())
    )


def going_on_past(system: System, settings: Settings, dt: float, records: Any, t0: Any) -> Past:
    """The past after a trajectory's rows (rows, nodes, x) at the same time step, its last at time t0.

    The rate of a row is its scheme's own, from the first row on, where there was none.
    """
    newest = [records[max(-k, -len(records))] for k in (1, 2, 3)]
    unknowns = [system.unknowns(record[0, : system.y_layout.size]) for record in newest]
    rate = jnp.zeros_like(newest[0])
    if settings.time.uses_rate:
        table = jnp.asarray(coefficient_table(settings, dt))
        before = jnp.concatenate([records[:1], records[:-1]])

        def one(rate: Any, row: Any) -> Any:
            i, now, last, last_but_one = row
            c0, c1, c2, d1 = jnp.where(i == 0, table[0], table[1])
            return c0 * now + c1 * last + c2 * last_but_one + d1 * rate, None

        rows = (jnp.arange(len(records) - 1), records[1:], before[1:], before[:-1])
        rate, _ = jax.lax.scan(one, rate, rows)
    order = jnp.ones((), dtype=int)
    return Past(jnp.stack(newest), rate, jnp.stack(unknowns), order, jnp.asarray(t0, dtype=float))


def coefficient_table(settings: Settings, dt: float) -> np.ndarray:
    """Coefficients (2, 4) of the first step and of every other."""
    regular = settings.time.coefficients(dt, dt)
    first = BDF1().coefficients(dt, dt) if settings.start == "consistent" else regular
    return np.array([first, regular])


def history_of(past: Past, coefficients: Any, settings: Settings) -> Any:
    """ʰ = c1 (newest) + c2 (the one before) + d1 (its rate), for y, z and y_s alike."""
    _, c1, c2, d1 = coefficients
    history = c1 * past.records[0] + c2 * past.records[1]
    return history + d1 * past.rate if settings.time.uses_rate else history


def advanced(past: Past, record: Any, unknowns: Any, rate: Any, order: Any) -> Past:
    """The past of the next step."""
    return past._replace(
        records=jnp.concatenate([record[None], past.records[:-1]]),
        rate=rate,
        unknowns=jnp.concatenate([unknowns[None], past.unknowns[:-1]]),
        order=order,
    )


def step(system: System, settings: Settings, past: Past, coefficients: Any, control: Any, t: Any) -> Any:
    """One time step: the next past, and the step's row."""
    ny = system.y_layout.size
    history = history_of(past, coefficients, settings)
    problem = StepProblem(system, t, control, coefficients[0], history, settings.space)
    # as sums of products, not as matrix products: XLA fuses these with what follows
    guesses = jnp.sum(EXTRAPOLATIONS[:, :, None, None] * past.records[None, :, :, :ny], axis=1)
    weights = jnp.asarray(EXTRAPOLATIONS)[past.order]
    guess = jnp.sum(weights[:, None, None] * past.records[:, :, :ny], axis=0)
    unknowns = jnp.sum(weights[:, None] * past.unknowns, axis=0)
    solution = newton(problem, guess, unknowns, Condensed(), settings.newton)
    record = problem.record(solution.y)
    scale = system.scales().y
    misfit = jnp.max(jnp.abs(guesses - solution.y) / scale, axis=(1, 2))
    rate = coefficients[0] * record + history if settings.time.uses_rate else past.rate
    size = jnp.max(jnp.abs(solution.y) / scale)
    row = Rows(record, solution.unknowns, solution.error, solution.corrections, size)
    return advanced(past, record, solution.unknowns, rate, jnp.argmin(misfit)), row


def march(
    system: System, settings: Settings, table: Any, controls: Any, dt: Any, past: Past, start: Any, stop: Any
) -> tuple[Any, Past, Rows]:
    """Steps `start` to `stop` (exclusive; step i uses controls[i] and ends at t0 + (i + 1) dt).

    Ends early at a step that does not converge. Gives how many steps are done, the past of the step that is
    next, and the rows of all steps that were tried; the rest of the rows are zero.
    """
    capacity = controls.shape[0]
    empty = Rows(
        jnp.zeros((capacity, *past.records.shape[1:])),
        jnp.zeros((capacity, past.unknowns.shape[1])),
        jnp.zeros(capacity),
        jnp.zeros(capacity, dtype=int),
        jnp.zeros(capacity),
    )

    def going(state: Any) -> Any:
        i, failed, _, _ = state
        return (i < stop) & ~failed

    def one(state: Any) -> Any:
        i, _, past, rows = state
        coefficients = jnp.where(i == 0, table[0], table[1])
        after, row = step(system, settings, past, coefficients, controls[i], past.t0 + (i + 1) * dt)
        failed = ~(row.error <= settings.newton.acceptable)
        past = jax.tree.map(lambda new, old: jnp.where(failed, old, new), after, past)
        rows = jax.tree.map(lambda all_rows, value: all_rows.at[i].set(value), rows, row)
        return jnp.where(failed, i, i + 1), failed, past, rows

    done, _, past, rows = jax.lax.while_loop(going, one, (start, jnp.array(False), past, empty))
    return done, past, rows


@functools.partial(jax.jit, static_argnames="settings")
def march_one(system, settings, table, controls, dt, past, start, stop):  # type: ignore[no-untyped-def]
    """`march`, compiled."""
    return march(system, settings, table, controls, dt, past, start, stop)


@functools.partial(jax.jit, static_argnames=("settings", "batched", "lockstep"))
def march_many(system, settings, table, controls, dt, past, start, stop, batched, lockstep):  # type: ignore[no-untyped-def]
    """`march` for a batch, compiled once: controls (B, T, c), and a batch of systems if `batched`.

    On a CPU the robots run one after the other, each with its own number of Newton corrections; together in
    lockstep they would all wait for the slowest, which measured half as fast. On a GPU lockstep wins.
    """

    def one(batch: Any) -> Any:
        own, control, past = batch
        return march(own if batched else system, settings, table, control, dt, past, start, stop)

    batch = (system if batched else None, controls, past)
    return jax.vmap(one)(batch) if lockstep else jax.lax.map(one, batch)
