"""History of a motion: the earlier states that a time step needs.

An implicit scheme in time needs y, z and y_s of earlier steps at all places where a step evaluates the
equations (`grid.Grid`). The history stores them there. A trajectory holds the nodes only. A motion that
continues from it evaluates the other places again, row by row.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.grid import at_places, grid_of
from knode_cosserat.solvers.problem import StepProblem, row_of
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.time import BDF1

#: number of earlier states in the first guess of a step, and the extrapolations in time (constant, linear,
#: quadratic) of which the guess is the weighted mean
GUESS_STATES = 3
EXTRAPOLATIONS = np.array([[1.0, 0.0, 0.0], [2.0, -1.0, 0.0], [3.0, -3.0, 1.0]])
#: a row counts as an equilibrium of its grid if its residuals are at most this (natural units); it is larger
#: than the solver's `acceptable`
SOLVED = 2e-8


class StateHistory(NamedTuple):
    """The states before a step, newest first."""

    records: Float[Any, "2 places x"]
    rate: Float[Any, "places x"]
    #: for the first guess
    y: Float[Any, "past points y"]
    #: weight of each state in the first guess
    weights: Float[Any, " past"]
    #: time of row 0 (s): step i ends at t0 + (i + 1) dt
    t0: Float[Any, ""]
    #: estimated discretisation errors of both records and of the rate, at the places of the scheme
    error: Float[Any, "3 used x"]


class InitialHistory(NamedTuple):
    """Initial history: the states before the first step of a motion."""

    records: Float[Any, "2 places x"]
    rate: Float[Any, "places x"]
    #: coefficients of the first step: c0, c1, c2 (1/s) and d1
    coefficients: Float[Any, "4"]
    #: time step (s) between the two states
    dt: Float[Any, ""]


def coefficient_table(settings: Settings, dt: float) -> np.ndarray:
    """Return the coefficients (2, 4) of the first step and of all later steps."""
    regular = settings.time.coefficients(dt, dt)
    first = BDF1().coefficients(dt, dt) if settings.start == "consistent" else regular
    return np.array([first, regular])


def history_of(states: Any, rate: Any, coefficients: Any, settings: Settings) -> Any:
    """Return ʰ of y, z and y_s (paper eq. 3, lumped history terms).

    ʰ = c1 (newest) + c2 (second newest) + d1 (newest rate)
    """
    _, c1, c2, d1 = coefficients
    history = c1 * states[0] + c2 * states[1]
    return history + d1 * rate if settings.time.uses_rate else history


def advanced(past: StateHistory, records: Any, rate: Any, y: Any, weights: Any) -> StateHistory:
    """Return the history of the next step."""
    return past._replace(
        records=jnp.stack([records, past.records[0]]),
        rate=rate,
        y=jnp.concatenate([y[None], past.y[:-1]]),
        weights=weights,
    )


# histories of one state


def rest_record(system: System) -> Float[Any, "nodes x"]:
    """Return y and z (nodes, y + z) of the system at rest."""
    s = jnp.linspace(0.0, 1.0, system.nodes) * system.length
    y, z = jax.vmap(system.rest)(s)
    return jnp.concatenate([y, z], axis=1)


def resting_history(system: System, settings: Settings) -> StateHistory:
    """Return the history of the robot at rest under zero control, at time 0."""
    none = jnp.zeros(system.control_size)
    if system.mixed:
        return constant_history(system, settings, rest_record(system), none)
    grid = grid_of(system, settings.space)
    y, z = jax.vmap(system.rest)(StepProblem.still(system, settings.space, none).places)
    return repeated_record_history(
        system, settings.space, jnp.concatenate([y, z], axis=-1), y[: grid.tip + 1], 0.0
    )


def constant_history(
    system: System, settings: Settings, row: Any, control: Any, t0: Any = 0.0
) -> StateHistory:
    """Return a history in which all earlier states equal one state, given by y and z at the nodes.

    Between nodes, an equilibrium under this control is evaluated from its equations; any other state is
    interpolated.
    """
    still = StepProblem.still(system, settings.space, control, t0)
    y = still.filled(row[:, : system.y_layout.size])
    return repeated_record_history(system, settings.space, still_records(still, row, y), y, t0)


def repeated_record_history(
    system: System, space: SpaceScheme, records: Float[Any, "places x"], y: Float[Any, "points y"], t0: Any
) -> StateHistory:
    """Return a history in which all earlier states equal one state."""
    used = used_places(system, space)
    return StateHistory(
        jnp.stack([records] * 2),
        jnp.zeros_like(records),
        jnp.stack([y] * GUESS_STATES),
        jnp.asarray(EXTRAPOLATIONS[0]),
        jnp.asarray(t0, dtype=float),
        jnp.zeros((3, used, records.shape[-1])),
    )


def used_places(system: System, space: SpaceScheme) -> int:
    """Return the number of places that the scheme itself uses, without the extra stages of its check."""
    grid = grid_of(system, space)
    return grid.ends + len(space.formula.stages) * grid.tip


def still_records(still: StepProblem, row: Any, y: Any) -> Float[Any, "places x"]:
    """Return records of one row at all places: evaluated if the row is an equilibrium, else interpolated."""
    system, ny = still.system, still.system.y_layout.size
    solved = still.records(y)
    own = row_of(system, y, solved)
    nodes = jnp.concatenate([row, own[:, row.shape[1] :]], axis=1)
    scales = system.scales()
    off = jnp.max(jnp.abs(still.reached(y) - y[1:]) / scales.y)
    # the strains must also equal the equilibrium's: otherwise the state moves
    bent = jnp.max(jnp.abs(nodes - own)[:, ny:]) <= SOLVED * (1.0 + jnp.max(jnp.abs(own[:, ny:])))
    return jnp.where((off <= SOLVED) & bent, solved, at_places(system, still.space, nodes))


def rows_suffice(system: System, space: SpaceScheme) -> bool:
    """True if rows hold every state that steps need: no stages between nodes, no discontinuities, B zero."""
    return not (system.mixed or space.formula.stages or system.cuts)


# rows of a trajectory


def padded_rows(rows: Any, least: int = 1) -> np.ndarray:
    """Return rows (…, T, n) padded to a power of two, so that a few more rows need no new program."""
    rows = np.asarray(rows)
    count = rows.shape[-2]
    width = [(0, 0)] * rows.ndim
    width[-2] = (0, max(least, 2 ** int(np.ceil(np.log2(count)))) - count)
    return np.pad(rows, width, mode="edge")


class ContinuedMotion(NamedTuple):
    """Rows of a motion with the history of the first."""

    begun: InitialHistory
    #: coefficients of each step after the first
    regular: Float[Any, "4"]
    #: y and z of the nodes
    rows: Float[Any, "rows nodes x"]
    #: control of each row; the first is not used
    controls: Float[Any, "rows c"]
    #: time of the first row (s)
    t0: Any
    #: number of rows; the rest is padding
    count: Any


def history_of_rows(
    system: System, space: SpaceScheme, rows: Any, coefficients: Any, dt: Any
) -> InitialHistory:
    """Return the history at the second of two rows (2, nodes, x) of a system without y_st."""
    found = jax.vmap(lambda row: at_places(system, space, row))(rows)
    return InitialHistory(found[::-1], jnp.zeros_like(found[0]), jnp.asarray(coefficients), jnp.asarray(dt))


def history_along(system: System, settings: Settings, motion: ContinuedMotion) -> tuple[StateHistory, Any]:
    """Return the history after a motion's last row, and the history terms (rows - 1, places, x) of each step.

    The equations are evaluated again at every place of each step. If a row was changed after it was solved,
    its difference from the equations at the nodes is interpolated to the other places.
    """
    begun, regular, rows, controls, t0, count = motion
    ny, dt, space = system.y_layout.size, begun.dt, settings.space

    def one(past: StateHistory, step: Any) -> Any:
        i, row, control = step
        coefficients = jnp.where(i == 1, begun.coefficients, jnp.asarray(regular))
        history = history_of(past.records, past.rate, coefficients, settings)
        problem = StepProblem(system, t0 + i * dt, control, coefficients[0], history, space)
        y = problem.filled(row[:, :ny])
        records = _records_of_row(problem, row, y)
        after = advanced(past, records, coefficients[0] * records + history, y, past.weights)
        return jax.tree.map(lambda a, b: jnp.where(i < count, a, b), after, past), history

    steps = jnp.arange(1, len(rows)), rows[1:], controls[1:]
    y = grid_of(system).spread(rows[0, :, :ny])
    first = repeated_record_history(system, space, begun.records[0], y, t0)
    first = first._replace(records=begun.records, rate=begun.rate, weights=jnp.asarray(EXTRAPOLATIONS[1]))
    past, histories = jax.lax.scan(one, first, steps)
    return past._replace(t0=t0 + (count - 1) * dt), histories


def _records_of_row(problem: StepProblem, row: Any, y: Any) -> Float[Any, "places x"]:
    """Return records of a step's solution at all places, from its row."""
    system = problem.system
    found = problem.records(y)
    beside = row - row_of(system, y, found)[:, : row.shape[1]]
    width = found.shape[-1] - row.shape[1]
    return found + at_places(system, problem.space, jnp.pad(beside, ((0, 0), (0, width))))
