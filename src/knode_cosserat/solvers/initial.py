"""Initial state of a run: rest, an equilibrium, or the last row of another trajectory."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import jax
import numpy as np

from knode_cosserat.engine.pattern import Pattern
from knode_cosserat.rods.aspects import Ends
from knode_cosserat.rods.passport import without_passport
from knode_cosserat.rods.strands import strand_count
from knode_cosserat.rods.system import System, array_module, is_traced
from knode_cosserat.schemes.grid import grid_of
from knode_cosserat.schemes.history import EXTRAPOLATIONS, SolverState
from knode_cosserat.schemes.problem import no_history, row_of
from knode_cosserat.schemes.result import Result, SimulationError
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.solvers.replay import (
    at_one_state,
    change_at_places,
    history_settings,
    replay,
    state_of_rows,
)
from knode_cosserat.solvers.rest import SOLVED, rest_record, resting_history, unloaded_shape
from knode_cosserat.solvers.rollout import static_rollout
from knode_cosserat.solvers.run import InitialState, TimeIntegration, failure, warn_of_results
from knode_cosserat.solvers.static_run import static_batch, static_run
from knode_cosserat.trajectory import Trajectory

#: starts that have a name
STARTS = ("equilibrium", "unstressed")


def start_of(
    system: System,
    initial: Any,
    settings: Settings,
    dt: float,
    batch: int | None = None,
    recovery_budget: float | None = None,
) -> InitialState:
    """Return where a run starts: a named state at rest, or the last row of a trajectory.

    A system that nothing holds has no equilibrium, and starts unstressed.

    Raises:
        SimulationError: the equilibrium was not found.
    """
    if isinstance(initial, Trajectory):
        return continued_state(system, initial, settings, dt)
    settles = initial == "equilibrium" and Ends.of(system).held
    held = np.zeros(system.control_layout.size) if settles else None
    try:
        return initial_state(system, settings, batch, recovery_budget, held)
    except SimulationError as error:
        cause = f'{error.cause} The motion would start there; initial="unstressed" starts without it.'
        facts = error.step, error.time, error.residual, error.result
        raise SimulationError(*facts, cause, error.robot) from None


def named_start(
    trajectory: Trajectory, names: tuple[str, ...] | None = None
) -> Literal["equilibrium", "unstressed"]:
    """Return the state at rest under zero control that is nearer to row 0 of a motion, in fields of y."""
    system, settings = without_passport(trajectory.system), trajectory.settings or Settings()
    columns = system.y_layout.indices(system.y_layout.names if names is None else names)
    seen, scale = np.asarray(trajectory.y[0])[:, columns], np.asarray(system.scales().y)[..., columns]

    def distance(held: Any) -> float:
        record = np.asarray(initial_state(system, settings, held=held).record)
        return float(np.nansum(((record[:, columns] - seen) / scale) ** 2))

    try:
        settled = distance(np.zeros(system.control_layout.size))
    except SimulationError:
        return "unstressed"
    # where both are one state, runs start as they do by default
    return "unstressed" if settled > SOLVED**2 and distance(None) < settled else "equilibrium"


def begins_unstressed(trajectory: Trajectory) -> bool:
    """Return True if the rows of a trajectory begin, under zero control, with the unstressed state."""
    begins = trajectory.time[0] == 0.0 and not np.any(trajectory.control[0])
    return bool(begins) and named_start(trajectory) == "unstressed"


def initial_state(
    system: System,
    settings: Settings,
    batch: int | None = None,
    recovery_budget: float | None = None,
    held: Any = None,
) -> InitialState:
    """Return the unstressed state, or the equilibrium under a held control.

    Args:
        system: one system, or a batch.
        settings: of the run.
        batch: number of robots, of one system or of as many.
        recovery_budget: seconds that recovery of the equilibrium may take.
        held: control (c,) of the equilibrium. None: the unstressed state, or the equilibrium under zero
            control if that state is only a guess.
    """
    many, made = np.ndim(system.length) > 0, history_settings(settings)
    result: Any = int(Result.CONVERGED)
    control = np.zeros(system.control_layout.size) if held is None else np.asarray(held, dtype=float)
    if held is not None or Ends.of(system).rest_is_guess:
        record, result = _settle(system, settings, recovery_budget, control)
        history = at_one_state(system, made, record, control)
    else:
        record, history = rest_record(system), resting_history(system, made)
    found = record, SolverState(history), result
    if batch and not many:
        numeric = array_module(found)
        found = jax.tree.map(lambda x: numeric.broadcast_to(x, (batch, *np.shape(x))), found)
    shape = (batch, system.control_layout.size) if batch else (system.control_layout.size,)
    return InitialState(found[0], np.broadcast_to(control, shape).copy(), *found[1:])


def _settle(system: System, settings: Settings, budget: float | None, control: Any) -> tuple[Any, Any]:
    """Return y and z of the equilibrium under a control, and COARSE or CONVERGED."""
    many, held = np.ndim(system.length) > 0, control[None]
    task = TimeIntegration(Settings(None, settings.space, newton=settings.newton), recovery_budget=budget)
    if is_traced(system):
        find, y = static_rollout(task, Pattern.of(system)), unloaded_shape(system, settings.space)
        rows = jax.vmap(find, in_axes=(0, None, 0))(system, held, y) if many else find(system, held, y)
    else:
        robots = np.shape(system.length)[:1]
        rows, _, causes = (static_batch if many else static_run)(
            task, system, np.broadcast_to(held, (*robots, *held.shape))
        )
        if causes:
            raise failure(rows, causes, None)
        warn_of_results(rows)
    size = system.y_layout.size + system.z_layout.size
    return rows.records[..., 0, :, :size], _coarse_only(rows.result[..., 0])


# continuation of another trajectory


def continued_state(system: System, initial: Trajectory, settings: Settings, dt: float) -> InitialState:
    """Return the initial state of a motion that continues from a trajectory's last row.

    A trajectory on the same points and stages gives the solver's state, by its own or by a replay of its
    rows. Other rows are interpolated between nodes. An equilibrium, or a single row, is one state.
    """
    numeric = array_module((system, initial))
    record = numeric.concatenate([initial.y[-1], initial.z[-1]], axis=-1)
    control, t0 = initial.control[-1], initial.time[-1]
    state = _last_state(system, initial, settings, record)
    if state is None:
        state = SolverState(at_one_state(system, history_settings(settings), record, control, t0))
    elif (
        state.dt is None
        or not np.isclose(state.dt, dt)
        or not state.known(settings)
        or len(state.history.records) != settings.memory
    ):
        # one state is all that a step of another length can use
        history = state.history
        alone = history._replace(
            records=numeric.stack([history.records[0]] * settings.memory),
            weights=numeric.asarray(EXTRAPOLATIONS[0]),
            error=numeric.stack([history.error[0]] * settings.memory + [history.error[-1]]),
            time_error=numeric.stack([*history.time_error[:1]] * settings.memory),
        )
        state = SolverState(alone, None, state.rate_known)
    history = state.history._replace(t0=numeric.asarray(t0, dtype=float))
    state = dataclasses.replace(state, history=history)
    made = initial.settings
    result = initial.result[-1] if made and made.time else _coarse_only(initial.result[-1])
    return InitialState(record, control, state, result)


def _coarse_only(result: Any) -> Any:
    """Return COARSE or CONVERGED: a recovered equilibrium is one on every grid."""
    return int(Result.COARSE) * (result == int(Result.COARSE))


def _last_state(system: System, initial: Trajectory, settings: Settings, record: Any) -> SolverState | None:
    """Return the solver's state at a trajectory's last row; None if one state is all that is known."""
    made = initial.settings
    if made is not None and made.time is None:
        return None
    grid_before, grid = (
        (it.discontinuities.places, it.nodes, strand_count(it), it.mixed) for it in (initial.system, system)
    )
    same_grid = made is not None and made.space == settings.space and grid_before == grid
    state = initial.final_state
    if not same_grid or state is None or state.history.rate.shape != no_history(system, settings.space).shape:
        if len(initial.time) < 2:
            return None
        if is_traced(initial):
            raise ValueError(
                "inside JAX's transformations initial is a motion without its final state on this grid; "
                "allowed is a name, an equilibrium, or a result of simulate with the same nodes and space"
            )
        if same_grid:
            known = replay(initial, initial.system)
            return None if known is None else known.state
        rows = np.concatenate([initial.y, initial.z], axis=-1)[-settings.memory :]
        return state_of_rows(system, settings, rows, float(initial.time[-1] - initial.time[-2]))
    # the row may have been changed since; rates are unchanged
    history = state.history
    change = record - row_of(system, history.y[0], history.records[0])[:, : record.shape[1]]
    shift = change_at_places(system, settings.space, change)
    y = history.y + grid_of(system).spread(change[:, : system.y_layout.size])
    return dataclasses.replace(state, history=history._replace(records=history.records + shift, y=y))
