"""Initial state and history of a simulation: rest, an equilibrium, or the end of another motion."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.system import System, is_traced
from knode_cosserat.solvers import sensitivity
from knode_cosserat.solvers.grid import at_places, grid_of
from knode_cosserat.solvers.history import (
    ContinuedMotion,
    InitialHistory,
    StateHistory,
    coefficient_table,
    constant_history,
    history_along,
    history_of_rows,
    padded_rows,
    repeated_record_history,
    rest_record,
    resting_history,
    rows_suffice,
)
from knode_cosserat.solvers.problem import no_history
from knode_cosserat.solvers.result import Result, SimulationError
from knode_cosserat.solvers.run import is_coarse, run_one
from knode_cosserat.solvers.run_types import FirstStep, InitialCondition, RunSettings
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.time import Static
from knode_cosserat.trajectory import Trajectory

#: an unknown initial rate is ignored if its weight has decayed below this after all available steps
FORGOTTEN = 1e-9
#: row 0 is the state at rest if it differs by less than this (natural units)
AT_REST = 1e-12


class SimulationRun(NamedTuple):
    """The checked arguments of one call; `many` is true if the systems themselves are batched."""

    system: System
    controls: Any
    initial: Trajectory | None
    settings: Settings
    dt: float
    batch: int | None
    many: bool
    #: seconds that recovery may take, or None
    budget: float | None = None


class InitialState(NamedTuple):
    """Initial state and history of a run."""

    #: y and z at the nodes
    record: Any
    start: InitialCondition
    #: time of the initial state (s)
    t0: Any
    #: kind of the first step (`RunSettings.first`)
    first: FirstStep
    #: initial history of a motion; None for statics
    begun: InitialHistory | None


def initial_state(run: SimulationRun) -> InitialState:
    """Return the initial state and history of a run."""
    system, controls, initial, settings, dt, batch, many, _ = run
    if initial is not None:
        return _going_on(system, initial, settings, dt)
    record, past = (_all_at_rest if many else _at_rest)(system, _of_past(settings))
    still = isinstance(settings.time, Static)
    coarse: Any = False
    if system.rest_is_guess and not still:
        record, past, coarse = _settled(run, past)
    begun = None if still else _begun(past, RunSettings(settings, dt, 1).table[0], dt)

    def for_each(tree: Any) -> Any:
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *jnp.shape(x))), tree)

    if batch and not many:
        record, past, begun, coarse = for_each((record, past, begun, coarse))
    elif batch and begun is not None:
        begun = begun._replace(coefficients=for_each(begun.coefficients), dt=for_each(begun.dt))
    none_yet = np.zeros((*np.shape(controls)[:-2], system.control_size))
    return InitialState(record, InitialCondition(past, none_yet, coarse), 0.0, "start", begun)


# at rest, or in equilibrium


def _of_past(settings: Settings) -> Settings:
    """Return only the settings that affect the history; runs that differ in others share programs."""
    return Settings(settings.time, settings.space, settings.start)


@functools.partial(jax.jit, static_argnames="settings")
def _at_rest(system: System, settings: Settings) -> Any:
    return rest_record(system), resting_history(system, settings)


@functools.partial(jax.jit, static_argnames="settings")
def _all_at_rest(system: System, settings: Settings) -> Any:
    return jax.vmap(lambda each: _at_rest(each, settings))(system)


def _settled(run: SimulationRun, past: Any) -> tuple[Any, Any, Any]:
    """Return the equilibrium under zero control, its history, and a flag: true if its grid is too coarse."""
    system, many = run.system, run.many
    task = RunSettings(run.settings, run.dt, 1, "still")
    none = np.zeros((1, system.control_size))
    if is_traced((system, past)):
        find = sensitivity.rollout(task)
        rows = jax.vmap(find, in_axes=(0, None, 0))(system, none, past) if many else find(system, none, past)
        found, coarse = rows.records[..., 0, :, :], is_coarse(rows.position_error, system)[..., 0]
    else:
        each = range(np.shape(past.t0)[0]) if many else [...]
        both = [_settled_one(task, _part(system, i), none, _part(past, i), i) for i in each]
        found, coarse = map(np.stack, zip(*both, strict=True)) if many else both[0]
    kept = found[..., : system.y_layout.size + system.z_layout.size]
    history = (_all_pasts if many else _past)(system, _of_past(run.settings), kept, none[0], 0.0)
    return kept, history, coarse


def _settled_one(task: RunSettings, system: System, none: Any, past: Any, i: Any) -> tuple[Any, Any]:
    """Return the equilibrium of one robot, and a flag for a too coarse grid; raise if there is none."""
    steps, cause = run_one(task, system, none, InitialCondition(past, none[0]))
    if steps.result[0] < 0:
        robot = None if i is ... else i
        raise SimulationError(0, 0.0, float(steps.error[0]), Result(int(steps.result[0])), cause, robot)
    return np.asarray(steps.records[0]), steps.result[0] == Result.COARSE


def _part(tree: Any, i: Any) -> Any:
    return tree if i is ... else jax.tree.map(lambda leaf: leaf[i], tree)


_past = jax.jit(constant_history, static_argnames="settings")


@functools.partial(jax.jit, static_argnames="settings")
def _all_pasts(system: System, settings: Settings, rows: Any, control: Any, t0: Any) -> Any:
    return jax.vmap(lambda each, row: constant_history(each, settings, row, control, t0))(system, rows)


# continuation of another motion


def _going_on(system: System, initial: Trajectory, settings: Settings, dt: float) -> InitialState:
    record = jnp.concatenate([initial.y[-1], initial.z[-1]], axis=-1)
    control, t0 = initial.control[-1], initial.time[-1]
    made = initial.settings
    rests = made is not None and isinstance(made.time, Static)
    still = isinstance(settings.time, Static)
    known = None if rests or still else _known(system, initial, settings, dt)
    first: FirstStep = "start"
    if still:
        past = _shape(system, settings.space, record, t0)
    elif known is None:
        past = _past(system, _of_past(settings), record, control, t0)
    else:
        past, first = known
    begun = None if still else _begun(past, RunSettings(settings, dt, 1, first).table[0], dt)
    return InitialState(
        record, InitialCondition(past, control, initial.result[-1] == Result.COARSE), t0, first, begun
    )


@functools.partial(jax.jit, static_argnames="space")
def _shape(system: System, space: SpaceScheme, record: Any, t0: Any) -> StateHistory:
    """Return a history of one shape, the start of a search for an equilibrium; interpolated between nodes."""
    more = no_history(system, space).shape[-1] - record.shape[-1]
    y = grid_of(system).spread(record[:, : system.y_layout.size])
    records = at_places(system, space, jnp.pad(record, ((0, 0), (0, more))))
    return repeated_record_history(system, space, records, y, t0)


def _begun(past: StateHistory, coefficients: Any, dt: Any) -> InitialHistory:
    return InitialHistory(past.records, past.rate, np.asarray(coefficients), np.asarray(dt))


def _known(
    system: System, initial: Trajectory, settings: Settings, dt: float
) -> tuple[StateHistory, FirstStep] | None:
    """Return the history from a motion's rows, and the kind of the next step; None if one state is all.

    A motion that was simulated on the same points and stages is evaluated again by its own equations. Other
    states are interpolated between nodes.
    """
    rows: Any = jnp.concatenate([initial.y, initial.z], axis=-1)
    made = initial.settings
    moved = made is not None and made.space == settings.space and _alike(initial.system, system)
    if moved:
        system, made = initial.system, _of_past(made)
    else:
        made = _of_past(settings)
    again = moved or rows_suffice(system, settings.space)
    known = (_of_first_rows if again else _of_last_rows)(system, made, initial, rows, dt)
    if known is None:
        return None
    begun, row, rate_known, regular = known
    count = len(rows) - row
    controls: Any = initial.control[row:]
    rows = rows[row:]
    if not is_traced((rows, controls)):
        packed = padded_rows(np.reshape(rows, (count, -1)))
        rows, controls = packed.reshape(-1, *np.shape(rows)[1:]), padded_rows(controls)
    motion = ContinuedMotion(begun, regular, rows, controls, initial.time[row], count)
    past, _ = _along(system, made, motion)
    alone = repeated_record_history(system, made.space, past.records[0], past.y[0], past.t0)
    # traced times cannot be compared: the rows are assumed to have the same time step as the continuation
    if not is_traced(begun.dt) and not np.isclose(begun.dt, dt):
        return alone, "start"
    if settings.time.uses_rate and not rate_known:
        # the rate at a first row in motion is unknown; its effect decays over the steps in most schemes
        forgotten = float(abs(made.time.coefficients(dt, dt).d1)) ** (count - 1)
        if forgotten >= FORGOTTEN:
            return alone, "consistent"
    return past, "regular"


def _alike(one: System, other: System) -> bool:
    """True if two systems have the same places and records."""

    def grid(system: System) -> Any:
        return system.cuts, system.nodes, system.strands, system.mixed

    return bool(grid(one) == grid(other))


class _Known(NamedTuple):
    """Known history of a motion at one of its rows, a flag for a known rate, and the steps' coefficients."""

    begun: InitialHistory
    row: int
    rate: bool
    regular: np.ndarray


def _apart(times: Any, dt: float) -> float:
    """Return the difference of the last two times; if they are traced, the given time step."""
    return dt if is_traced(times) else float(times[-1] - times[-2])


def _of_first_rows(
    system: System, made: Settings, initial: Trajectory, rows: Any, dt: float
) -> _Known | None:
    """Return the history at a motion's first row, or its second."""
    time, begun = initial.time, initial.begun
    if begun is not None and begun.rate.shape == no_history(system, made.space).shape:
        regular = coefficient_table(made, dt if is_traced(begun) else float(begun.dt))[1]
        # a single row that was the first of a motion has no earlier state; a traced row cannot be tested
        if len(time) > 1 or is_traced(begun) or np.any(begun.records[0] != begun.records[1]):
            return _Known(begun, 0, made.time.uses_rate, regular)
    if len(time) < 2:
        return None
    if is_traced(time) or time[0] != 0.0:
        return _of_rows(system, made, rows[:2], _apart(time[:2], dt), 1)
    apart = _apart(time[:2], dt)
    record, past = _at_rest(system, made)
    if not is_traced((record, rows)) and not np.allclose(record, rows[0], rtol=0.0, atol=AT_REST):
        # files of earlier versions do not hold the initial history
        past = _past(system, made, rows[0], initial.control[0], 0.0)
    first, regular = coefficient_table(made, apart)
    return _Known(_begun(past, first, apart), 0, True, regular)


def _of_last_rows(system: System, made: Settings, initial: Trajectory, rows: Any, dt: float) -> _Known | None:
    """Return the history at the last row of states that solve no equations of this system."""
    time = initial.time
    if len(time) < 2:
        return None
    return _of_rows(system, made, rows[-2:], _apart(time[-2:], dt), len(time) - 1)


def _of_rows(system: System, made: Settings, two: Any, apart: float, row: int) -> _Known | None:
    """Return the history at the second of two rows from their nodes; None with y_st."""
    if system.mixed:
        return None
    regular = coefficient_table(made, apart)[1]
    return _Known(_between(system, made.space, two, regular, apart), row, False, regular)


_between = jax.jit(history_of_rows, static_argnames="space")


_along = jax.jit(history_along, static_argnames="settings")


def histories_along(system: System, moved: Trajectory) -> tuple[int, Float[Any, "steps places x"]] | None:
    """Return the first row whose step has a known history, and the history terms of that and all later steps.

    None if the rows do not suffice.
    """
    made = _of_past(moved.settings)
    rows = jnp.concatenate([moved.y, moved.z], axis=-1)
    known = _of_first_rows(system, made, moved, rows, moved.dt)
    if known is None:
        return None
    row, count = known.row, len(rows) - known.row
    controls = jnp.asarray(moved.control[row:])
    motion = ContinuedMotion(known.begun, known.regular, rows[row:], controls, moved.time[row], count)
    return row + 1, _along(system, made, motion)[1]
