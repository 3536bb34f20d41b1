"""The past of a motion: what a step looks back on, and how a motion that goes on finds it again.

An implicit scheme in time looks back on y, z and y_s wherever a step evaluates the equations: at the stages
of the scheme in arclength. They are kept as they were found there. Taken from the nodes by interpolation, the
past of the strains is off by what the interpolation misses, and a rate is that over dt: a damped rod in
equilibrium then creeps, the more the shorter its time steps.

A trajectory shows the nodes only. The rest of its states is evaluated again, row by row, for a motion that
goes on from it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.between import at_stages
from knode_cosserat.solvers.crossing import points_of, spread
from knode_cosserat.solvers.problem import StepProblem, keeps_stages, row_of
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.time import BDF1

#: how many past states the first guess of a step looks at, and the extrapolations it is a mean of: constant,
#: linear, quadratic in time
PAST = 3
EXTRAPOLATIONS = np.array([[1.0, 0.0, 0.0], [2.0, -1.0, 0.0], [3.0, -3.0, 1.0]])
#: a row is taken for an equilibrium of its grid if its residuals are at most this (natural units): more than
#: the solver's `acceptable`
SOLVED = 2e-8


class Past(NamedTuple):
    """What a step needs of the steps before it, newest first."""

    records: Float[Any, "2 stages points x"]
    rate: Float[Any, "stages points x"]
    #: of which the first guess is made
    y: Float[Any, "past points y"]
    #: what each state counts in the first guess of the next step
    weights: Float[Any, " past"]
    #: time of row 0 (s): step i ends at t0 + (i + 1) dt
    t0: Float[Any, ""]


class Begun(NamedTuple):
    """What the first step of a motion looked back on."""

    records: Float[Any, "2 stages points x"]
    rate: Float[Any, "stages points x"]
    #: of that step: c0, c1, c2 (1/s) and d1
    coefficients: Float[Any, "4"]
    #: by which time step (s) the two states are apart
    dt: Float[Any, ""]


def coefficient_table(settings: Settings, dt: float) -> np.ndarray:
    """Coefficients (2, 4) of the first step and of every other."""
    regular = settings.time.coefficients(dt, dt)
    first = BDF1().coefficients(dt, dt) if settings.start == "consistent" else regular
    return np.array([first, regular])


def problem_of(
    system: System, settings: Settings, t: Any, control: Any, c0: Any, history: Any
) -> StepProblem:
    """The equations of a step that looks back on this history."""
    own = keeps_stages(system, settings.time, settings.space)
    return StepProblem(system, t, control, c0, history, settings.space, own_past=own)


def history_of(past: Past, coefficients: Any, settings: Settings) -> Any:
    """ʰ = c1 (newest) + c2 (the one before) + d1 (its rate), for y, z and y_s alike."""
    _, c1, c2, d1 = coefficients
    history = c1 * past.records[0] + c2 * past.records[1]
    return history + d1 * past.rate if settings.time.uses_rate else history


def advanced(past: Past, records: Any, rate: Any, y: Any, weights: Any) -> Past:
    """The past of the next step."""
    return past._replace(
        records=jnp.stack([records, past.records[0]]),
        rate=rate,
        y=jnp.concatenate([y[None], past.y[:-1]]),
        weights=weights,
    )


# one state, and no other before it


def rest_record(system: System) -> Float[Any, "nodes x"]:
    """y and z (nodes, y + z) of the system at rest."""
    s = jnp.linspace(0.0, 1.0, system.nodes) * system.length
    y, z = jax.vmap(system.rest)(s)
    return jnp.concatenate([y, z], axis=1)


def resting_past(system: System, settings: Settings) -> Past:
    """A past of nothing but rest under no control, at time 0."""
    none = jnp.zeros(system.control_size)
    if system.mixed or not keeps_stages(system, settings.time, settings.space):
        return initial_past(system, settings, rest_record(system), none)
    stages = StepProblem.still(system, settings.space, none).stages
    y, z = jax.vmap(jax.vmap(system.rest))(stages)
    return past_of_one(jnp.concatenate([y, z], axis=-1), y[0], 0.0)


def initial_past(system: System, settings: Settings, row: Any, control: Any, t0: Any = 0.0) -> Past:
    """A past of one state only, y and z of it at the nodes: every state before the first is the first.

    Of an equilibrium under this control, stages are where its solution has them; of other states between
    nodes by interpolation.
    """
    own = keeps_stages(system, settings.time, settings.space)
    still = StepProblem.still(system, settings.space, control, t0, own_past=own)
    y = still.filled(row[:, : system.y_layout.size])
    told = rows_tell(system, settings)
    records = at_stages(system, settings.space, row) if told else still_records(still, row, y)
    return past_of_one(records, y, t0)


def past_of_one(records: Float[Any, "stages points x"], y: Float[Any, "points y"], t0: Any) -> Past:
    """A past of one state only."""
    return Past(
        jnp.stack([records] * 2),
        jnp.zeros_like(records),
        jnp.stack([y] * PAST),
        jnp.asarray(EXTRAPOLATIONS[0]),
        jnp.asarray(t0, dtype=float),
    )


def still_records(still: StepProblem, row: Any, y: Any) -> Float[Any, "stages points x"]:
    """Records of one row at the stages: those of its equilibrium, if it is one, and between nodes if not."""
    system, ny = still.system, still.system.y_layout.size
    solved = still.records(y)
    own = row_of(system, y, solved)
    nodes = jnp.concatenate([row, own[:, row.shape[1] :]], axis=1)
    scales = system.scales()
    off = jnp.max(jnp.abs(still.reached(y) - y[1:]) / scales.y)
    # what the nodes' strains are beside those of the equilibrium: nothing, or the past is not still
    bent = jnp.max(jnp.abs(nodes - own)[:, ny:]) <= SOLVED * (1.0 + jnp.max(jnp.abs(own[:, ny:])))
    return jnp.where((off <= SOLVED) & bent, solved, at_stages(system, still.space, nodes))


def rows_tell(system: System, settings: Settings) -> bool:
    """Whether rows hold all that steps look back on."""
    at_nodes = settings.space.parts == (0.0,) and not system.cuts
    return not system.mixed and (at_nodes or not keeps_stages(system, settings.time, settings.space))


def newest_row(system: System, past: Past) -> Float[Any, "nodes x"]:
    """The newest state of a past as a row."""
    return row_of(system, past.y[0], past.records[0])


def refined(system: System, fine: System, space: SpaceScheme, past: Past) -> Past:
    """A past on a finer grid, by splines through its nodes."""
    # imported here, where it is rarely needed: it would double this package's import time
    from scipy.interpolate import make_interp_spline

    coarse_s, fine_s = np.linspace(0.0, 1.0, system.nodes), np.linspace(0.0, 1.0, fine.nodes)
    nodes = points_of(system).nodes

    def finer(values: Any) -> Any:
        return make_interp_spline(coarse_s, np.asarray(values)[nodes], k=min(3, system.nodes - 1))(fine_s)

    def stages(records: Any, y: Any = None) -> Any:
        # of y on the near side of cuts, where that is known
        row = records[0] if y is None else jnp.concatenate([y, records[0][:, y.shape[1] :]], axis=1)
        return at_stages(fine, space, jnp.asarray(finer(row)))

    y = jnp.stack([spread(points_of(fine), jnp.asarray(finer(each))) for each in past.y])
    records = jnp.stack([stages(each, own) for each, own in zip(past.records, past.y, strict=False)])
    return past._replace(records=records, rate=stages(past.rate), y=y)


# rows of a trajectory


def padded_rows(rows: Any, least: int = 1) -> np.ndarray:
    """Rows (…, T, n) filled up to a power of two, so that a few more need no new program."""
    rows = np.asarray(rows)
    count = rows.shape[-2]
    width = [(0, 0)] * rows.ndim
    width[-2] = (0, max(least, 2 ** int(np.ceil(np.log2(count)))) - count)
    return np.pad(rows, width, mode="edge")


class Motion(NamedTuple):
    """Rows of a motion, the first of which `begun` tells all of."""

    begun: Begun
    #: coefficients of each step after the first
    regular: Float[Any, "4"]
    #: y and z of the nodes
    rows: Float[Any, "rows nodes x"]
    #: of each row; that of the first is not looked at
    controls: Float[Any, "rows c"]
    #: time of the first row (s)
    t0: Any
    #: how many rows there are; more are filling
    count: Any


def begun_between(system: System, space: SpaceScheme, rows: Any, coefficients: Any, dt: Any) -> Begun:
    """What the nodes tell at the second of two rows (2, nodes, x) of a system without y_st."""
    found = jax.vmap(lambda row: at_stages(system, space, row))(rows)
    return Begun(found[::-1], jnp.zeros_like(found[0]), jnp.asarray(coefficients), jnp.asarray(dt))


def past_along(system: System, settings: Settings, motion: Motion, solved: bool = True) -> tuple[Past, Any]:
    """The past at a motion's last row, and the history (rows - 1, stages, points, x) of each step.

    The equations are evaluated again where each step's solution has them. What a row has at its nodes beside
    that (nothing, unless it was changed since) is carried over to the stages between them. If they are not
    those that were `solved`, but a model's, what pieces reach is brought to where the next ones begin.
    """
    begun, regular, rows, controls, t0, count = motion
    ny, dt, space, told = system.y_layout.size, begun.dt, settings.space, rows_tell(system, settings)

    def one(past: Past, step: Any) -> Any:
        i, row, control = step
        coefficients = jnp.where(i == 1, begun.coefficients, jnp.asarray(regular))
        history = history_of(past, coefficients, settings)
        problem = problem_of(system, settings, t0 + i * dt, control, coefficients[0], history)
        y = problem.filled(row[:, :ny])
        records = at_stages(system, space, row) if told else _records_of_row(problem, row, y, solved)
        after = advanced(past, records, coefficients[0] * records + history, y, past.weights)
        return jax.tree.map(lambda a, b: jnp.where(i < count, a, b), after, past), history

    steps = jnp.arange(1, len(rows)), rows[1:], controls[1:]
    y = spread(points_of(system), rows[0, :, :ny])
    weights = jnp.asarray(EXTRAPOLATIONS[1])
    first = Past(begun.records, begun.rate, jnp.stack([y] * PAST), weights, jnp.asarray(t0))
    past, histories = jax.lax.scan(one, first, steps)
    return past._replace(t0=t0 + (count - 1) * dt), histories


def _records_of_row(problem: StepProblem, row: Any, y: Any, solved: bool) -> Float[Any, "stages points x"]:
    """Records of a step's solution at the stages, where a row shows it at the nodes."""
    system, space = problem.system, problem.space
    found = problem.records(y) if solved else problem.records_between(y)
    beside = row - row_of(system, y, found)[:, : row.shape[1]]
    width = found.shape[-1] - row.shape[1]
    return found + at_stages(system, space, jnp.pad(beside, ((0, 0), (0, width))))
