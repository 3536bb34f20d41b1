"""Histories along the rows of a trajectory, evaluated again from its equations.

For samples, and to continue from rows without a solver state: a trajectory cut before its end, or the file of
an earlier version. Rows hold the nodes only; the equations give the other places, row by row.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.engine import loops as engine
from knode_cosserat.rods.system import System, array_module, is_traced
from knode_cosserat.schemes.grid import at_places, grid_of
from knode_cosserat.schemes.history import (
    EXTRAPOLATIONS,
    SolverState,
    StateHistory,
    StepCoefficients,
    advance_history,
    at_stages,
    history_of,
    repeated_record_history,
)
from knode_cosserat.schemes.problem import Evaluated, no_history, row_of
from knode_cosserat.schemes.settings import MEASURED, Settings
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.rest import (
    constant_history,
    map_robots,
    rest_record,
    resting_history,
    still_records,
)
from knode_cosserat.trajectory import Trajectory

#: row 0 is the state at rest if it differs by less than this (natural units)
AT_REST = 1e-12


def still_state(system: System, space: SpaceScheme, control: Any, y: Any, t: Any = 0.0) -> Evaluated:
    """Return the state at rest of y at all points, or at the nodes, under a control."""
    return engine.evaluator(system, Settings(None, space))(0.0, t, control, no_history(system, space), y)


def at_one_state(system: System, settings: Settings, row: Any, control: Any, t0: Any = 0.0) -> StateHistory:
    """Return the history of one state, or of a batch of robots (see `constant_history`).

    It is found in the engine outside of transformations.
    """
    many, space = np.ndim(system.length) > 0, settings.space
    if is_traced((system, row, control, t0)):

        def constant(one: System, row: Any) -> StateHistory:
            return constant_history(one, settings, row, control, t0)

        return map_robots(constant, system, row) if many else constant(system, row)
    nothing, found = no_history(system, space), []
    evaluate = engine.evaluators(system, Settings(None, space))
    for own, each in zip(np.asarray(row) if many else [np.asarray(row)], evaluate, strict=True):
        still = each(0.0, t0, control, nothing, own[:, : system.y_layout.size])
        found.append((still_records(system, space, own, still), still.y))
    records, y = map(np.stack, zip(*found, strict=True)) if many else found[0]
    return repeated_record_history(system, settings, records, y, t0)


class _Replay(NamedTuple):
    """Solver states along the rows of a trajectory."""

    #: first row whose step has a known history
    first: int
    #: history terms of the steps to that row and to all later rows
    terms: Float[Any, "steps places x"]
    #: state of the solver at the last row
    state: SolverState


def replay(trajectory: Trajectory, system: System) -> _Replay | None:
    """Return the histories along a motion's rows by a system's equations; None if the rows do not suffice."""
    made, time = replayed_settings(trajectory), trajectory.time
    if len(time) < 2:
        return None
    dt = trajectory.dt
    known = _known_row(trajectory, system, made, dt)
    if known is None:
        return None
    row, state = known
    rows: Any = np.concatenate([trajectory.y, trajectory.z], axis=-1)[row:]
    controls: Any = trajectory.control[row:]
    if made.stages > 1:
        between: Any = trajectory.stages[row + 1 :, :, :, : rows.shape[-1]]
        every = np.concatenate([between, rows[1:, None]], axis=1)
        rows = np.concatenate([rows[:1], every.reshape(-1, *rows.shape[1:])])
        acting = at_stages(system, made, controls[1:], controls[:1], state.dt is None)
        if acting.shape[1] == controls.shape[1]:
            acting = np.tile(acting, made.stages)
        acting = acting.reshape(len(acting) * made.stages, controls.shape[1])
        controls = np.concatenate([controls[:1], acting])
    steps = StepCoefficients.of(made, dt, state.known(made))
    past = state.history._replace(t0=np.asarray(time[row], dtype=float))
    history, terms = _along(system, made, past, (rows, controls), steps)
    last = state.after(history, dt, len(time) - 1 - row, made)
    last = dataclasses.replace(last, rate_known=state.rate_known and made.uses_rate)
    return _Replay(row + 1, terms[made.stages - 1 :: made.stages], last)


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
    count = made.memory
    rows: Any = np.concatenate([trajectory.y[:count], trajectory.z[:count]], axis=-1)
    if time[0] != 0.0:
        state = state_of_rows(system, made, rows, dt)
        return None if state is None else (count - 1, state)
    if np.allclose(rest_record(system), rows[0], rtol=0.0, atol=AT_REST):
        return 0, SolverState(resting_history(system, made))
    return 0, SolverState(at_one_state(system, made, rows[0], trajectory.control[0]))


def state_of_rows(
    system: System, settings: Settings, rows: Float[Any, "memory nodes x"], dt: float
) -> SolverState | None:
    """Return the solver's state at the last of the rows, interpolated between nodes.

    None if the rows are too few, or do not hold the history, which has y_s.
    """
    if system.mixed or len(rows) < settings.memory:
        return None
    records = [at_places(system, settings.space, row) for row in rows[::-1]]
    y = grid_of(system).spread(rows[-1, :, : system.y_layout.size])
    repeated = repeated_record_history(system, settings, records[0], y, 0.0)
    return SolverState(repeated._replace(records=np.stack(records)), dt, rate_known=False)


def _along(
    system: System, settings: Settings, past: StateHistory, motion: tuple[Any, Any], steps: StepCoefficients
) -> tuple[StateHistory, Float[Any, "steps places x"]]:
    """Return the history after a motion's last row, and the history terms of each step.

    `motion` are rows and controls, the stages between them included. If a row was changed after it was
    solved, its difference from the equations at the nodes is interpolated to the other places.
    """
    t0, stages, (rows, controls) = past.t0, settings.stages, motion
    evaluate = engine.evaluator(system, settings)

    # errors in time are not evaluated again
    lost = np.full(past.time_error.shape, np.nan)
    past, count = past._replace(time_error=lost, weights=EXTRAPOLATIONS[1]), len(rows) - 1
    terms = np.empty((count, *past.rate.shape))
    for i, (row, control) in enumerate(zip(rows[1:], controls[1:], strict=True)):
        coefficients, t = steps.at(t0, i // stages)
        if stages > 1:
            coefficients, t = coefficients[i % stages], t[i % stages]
        terms[i] = history_of(past.records, past.rate, coefficients, settings)
        found = evaluate(coefficients[0], t, control, terms[i], row[:, : system.y_layout.size])
        change = row - row_of(system, found.y, found.records)[:, : row.shape[1]]
        records = found.records + change_at_places(system, settings.space, change)
        past = advance_history(past, records, coefficients[0] * records + terms[i], found.y, past.weights)
    return past._replace(t0=t0 + count // stages * steps.dt), terms


def change_at_places(
    system: System, space: SpaceScheme, change: Float[Any, "nodes x"]
) -> Float[Any, "places more"]:
    """Return a change of y and z at the nodes as a change of the records at all places; y_s is unchanged."""
    width = no_history(system, space).shape[-1] - change.shape[1]
    numeric = array_module(change)
    return at_places(system, space, numeric.pad(change, ((0, 0), (0, width))))
