"""Histories along the rows of a trajectory, evaluated again from its equations.

For samples, and to continue from rows without a solver state: a trajectory cut before its end, or the file of
an earlier version. Rows hold the nodes only; the equations give the other places, row by row.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.system import System, is_traced
from knode_cosserat.solvers.grid import at_places, grid_of
from knode_cosserat.solvers.history import (
    EXTRAPOLATIONS,
    SolverState,
    StateHistory,
    advanced,
    at_stages,
    constant_history,
    history_of,
    repeated_record_history,
    rest_record,
    resting_history,
)
from knode_cosserat.solvers.problem import StepProblem, no_history, row_of
from knode_cosserat.solvers.run import padded_rows
from knode_cosserat.solvers.settings import MEASURED, Settings
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.time_loop import StepCoefficients
from knode_cosserat.trajectory import Trajectory

#: row 0 is the state at rest if it differs by less than this (natural units)
AT_REST = 1e-12

at_rest = jax.jit(resting_history, static_argnames="settings")
at_one_state = jax.jit(constant_history, static_argnames="settings")


class Replay(NamedTuple):
    """Solver states along the rows of a trajectory."""

    #: first row whose step has a known history
    first: int
    #: history terms of the steps to that row and to all later rows
    terms: Float[Any, "steps places x"]
    #: state of the solver at the last row
    state: SolverState


def replay(trajectory: Trajectory, system: System, dt: float | None = None) -> Replay | None:
    """Return the histories along a motion's rows by a system's equations; None if the rows do not suffice.

    `dt` is the time step (s) of rows whose times are traced.
    """
    made, time = replayed_settings(trajectory), trajectory.time
    if len(time) < 2:
        return None
    apart = (trajectory.initial_state and trajectory.initial_state.dt) or dt
    if not is_traced(time):
        apart = trajectory.dt
    assert apart is not None
    known = _known_row(trajectory, system, made, apart)
    if known is None:
        return None
    row, state = known
    rows: Any = jnp.concatenate([trajectory.y, trajectory.z], axis=-1)[row:]
    controls: Any = trajectory.control[row:]
    if made.stages > 1:
        between: Any = trajectory.stages[row + 1 :, :, :, : rows.shape[-1]]
        every = jnp.concatenate([between, rows[1:, None]], axis=1)
        rows = jnp.concatenate([rows[:1], every.reshape(-1, *rows.shape[1:])])
        acting = at_stages(system, made, controls[1:], controls[:1], state.dt is None)
        if acting.shape[1] == controls.shape[1]:
            acting = jnp.tile(acting, made.stages)
        acting = acting.reshape(len(acting) * made.stages, controls.shape[1])
        controls = jnp.concatenate([controls[:1], acting])
    count = len(rows)
    if not is_traced((rows, controls)):
        packed = padded_rows(np.reshape(rows, (count, -1)))
        rows, controls = packed.reshape(-1, *np.shape(rows)[1:]), padded_rows(controls)
    steps = StepCoefficients.of(made, apart, state.first_step(made))
    past = state.history._replace(t0=jnp.asarray(time[row], dtype=float))
    history, terms = _along(system, made, past, (rows, controls, count), steps)
    rate_known = state.rate_known and made.uses_rate
    return Replay(
        row + 1, terms[made.stages - 1 : count - 1 : made.stages], SolverState(history, apart, rate_known)
    )


def history_settings(settings: Settings) -> Settings:
    """Return only the settings that affect the history; runs that differ in others share programs."""
    return Settings(settings.time, settings.space, settings.start, between=settings.between)


def replayed_settings(trajectory: Trajectory) -> Settings:
    """Return the settings that affect the history of a motion's rows.

    Without the stages of its scheme the rows are like measured ones.
    """
    made = history_settings(trajectory.settings or MEASURED)
    if made.stages > 1 and trajectory.stages is None:
        return dataclasses.replace(MEASURED, space=made.space)
    return made


def _known_row(
    trajectory: Trajectory, system: System, made: Settings, dt: float
) -> tuple[int, SolverState] | None:
    """Return the first row with a known solver state, and that state."""
    time, state = trajectory.time, trajectory.initial_state
    if state is not None and state.history.rate.shape == no_history(system, made.space).shape:
        return 0, state
    rows: Any = jnp.concatenate([trajectory.y[:2], trajectory.z[:2]], axis=-1)
    if is_traced(time) or time[0] != 0.0:
        state = state_of_rows(system, made.space, rows, dt)
        return None if state is None else (1, state)
    history = at_rest(system, made)
    rest = rest_record(system)
    if not is_traced((rest, rows)) and not np.allclose(rest, rows[0], rtol=0.0, atol=AT_REST):
        history = at_one_state(system, made, rows[0], trajectory.control[0])
    return 0, SolverState(history)


def state_of_rows(
    system: System, space: SpaceScheme, rows: Float[Any, "2 nodes x"], dt: float
) -> SolverState | None:
    """Return the solver's state at the second of two rows, interpolated between nodes; None with y_st."""
    return None if system.mixed else SolverState(_of_rows(system, space, rows), dt, rate_known=False)


@functools.partial(jax.jit, static_argnames="space")
def _of_rows(system: System, space: SpaceScheme, rows: Any) -> StateHistory:
    records = jax.vmap(lambda row: at_places(system, space, row))(rows)[::-1]
    y = grid_of(system).spread(rows[1, :, : system.y_layout.size])
    return repeated_record_history(system, space, records[0], y, 0.0)._replace(records=records)


@functools.partial(jax.jit, static_argnames="settings")
def _along(
    system: System,
    settings: Settings,
    past: StateHistory,
    motion: tuple[Any, Any, Any],
    steps: StepCoefficients,
) -> tuple[StateHistory, Float[Any, "steps places x"]]:
    """Return the history after a motion's last row, and the history terms of each step.

    `motion` are rows, controls and the number of rows without padding, the stages between them included. If
    a row was changed after it was solved, its difference from the equations at the nodes is interpolated to
    the other places.
    """
    rows, controls, count = motion
    ny, t0, stages = system.y_layout.size, past.t0, settings.stages

    def one(past: StateHistory, step: Any) -> Any:
        i, row, control = step
        coefficients, t = steps.at(t0, (i - 1) // stages)
        if stages > 1:
            coefficients, t = coefficients[(i - 1) % stages], t[(i - 1) % stages]
        history = history_of(past.records, past.rate, coefficients, settings)
        problem = StepProblem(system, t, control, coefficients[0], history, settings.space)
        y = problem.filled(row[:, :ny])
        records = problem.records(y)
        records = records + carried(
            system, settings.space, row - row_of(system, y, records)[:, : row.shape[1]]
        )
        after = advanced(past, records, coefficients[0] * records + history, y, past.weights)
        return jax.tree.map(lambda a, b: jnp.where(i < count, a, b), after, past), history

    # errors in time are not evaluated again
    lost = jnp.full_like(past.time_error, jnp.nan)
    first = past._replace(time_error=lost, weights=jnp.asarray(EXTRAPOLATIONS[1]))
    past, terms = jax.lax.scan(one, first, (jnp.arange(1, len(rows)), rows[1:], controls[1:]))
    return past._replace(t0=t0 + (count - 1) // stages * steps.dt), terms


def carried(system: System, space: SpaceScheme, change: Float[Any, "nodes x"]) -> Float[Any, "places more"]:
    """Return a change of y and z at the nodes as a change of the records at all places; y_s is unchanged."""
    width = no_history(system, space).shape[-1] - change.shape[1]
    return at_places(system, space, jnp.pad(change, ((0, 0), (0, width))))
