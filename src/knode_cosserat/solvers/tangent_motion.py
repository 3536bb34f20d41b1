"""Motions and equilibria of a system with parameters, and their tangents by the parameters.

Every solved step is differentiated by the implicit function theorem (`solvers.sensitivity`), and the start as
well: an equilibrium like any other, the unstressed state and given rows by JAX.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.rods.aspects import Ends
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.history import StateHistory, at_stages
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.solvers.initial import continued_state, initial_state
from knode_cosserat.solvers.replay import at_one_state
from knode_cosserat.solvers.rest import constant_history, rest_record, resting_history
from knode_cosserat.solvers.run import TimeIntegration, run_one
from knode_cosserat.solvers.sensitivity import Changes, TangentState, static_tangents, tangent_time_loop
from knode_cosserat.solvers.static_run import separate_run, static_run
from knode_cosserat.trajectory import Trajectory


class Start(NamedTuple):
    """Start of a simulation: record and history, and a function that returns their tangents."""

    #: y and z at the nodes
    record: Float[Any, "N x"]
    #: history, or y at all points before a list of equilibria
    state: Any
    control: Any
    #: earlier states that the first step may use, as in `TimeIntegration`
    known: int
    #: true if the first control acts at once
    sudden: bool
    #: from directions of the system and the weights of each in each tangent: tangents of the record, the
    #: history, and its tangents
    tangents: Callable[[Any, np.ndarray], tuple[Any, StateHistory, Any]]
    #: false if the equilibrium before a list of equilibria was not found: the record is that at rest
    found: bool = True


def start_at(
    robot: Callable[[Any], System],
    x: Float[np.ndarray, " n"],
    system: System,
    task: TimeIntegration,
    held: Any,
    initial: Trajectory | str,
) -> Start | None:
    """Return the start of a simulation; None if there is no equilibrium.

    Args:
        robot: system as a function of coordinates, a pytree.
        x: coordinates.
        system: the system there.
        task: settings and time step of the simulation.
        held: control (c,) of the equilibrium from which it starts; None: it starts as `initial` says.
        initial: rows from which it continues, or a name: then it starts unstressed, or in the equilibrium
            under zero control if the unstressed state is only a guess.
    """
    rows = isinstance(initial, Trajectory)
    if held is None and (rows or not Ends.of(system).rest_is_guess):
        return _moving_start(robot, x, system, task, initial if isinstance(initial, Trajectory) else None)
    settings, size = task.settings, system.y_layout.size + system.z_layout.size
    control = np.zeros(system.control_layout.size) if held is None else np.asarray(held, dtype=float)
    still = dataclasses.replace(settings, time=None)
    find = TimeIntegration(still, recovery_budget=task.recovery_budget)
    if settings.time is None:
        rest, (y,), cause = separate_run(find, system, control[None])
    else:
        rest, y, cause = static_run(find, system, control[None])
    if cause and settings.time is None:
        return Start(rest_record(system)[:, :size], y, control, 1, True, _unmoved, False)
    if cause:
        return None
    record = np.asarray(rest.records[0][:, :size])
    past = None if settings.time is None else at_one_state(system, settings, record, control)

    def tangents(directions: Any, weights: np.ndarray) -> Any:
        solved, d_held = (rest.records, rest.unknowns), np.zeros((1, len(control), weights.shape[1]))
        changes = Changes(d_held, directions, weights)
        d_rows, _, d_records = static_tangents(still, solved, (system, control[None]), changes)
        return d_rows[0], past, (np.stack([d_records] * settings.memory), np.zeros_like(d_records))

    return Start(record, y if past is None else past, control, 1, True, tangents)


def _unmoved(directions: Any, weights: np.ndarray) -> Any:
    """Return no tangents of a record, for a start that does not count."""
    return np.zeros((1, 1, 1, weights.shape[1])), None, (None, None)


def _moving_start(
    robot: Any, x: np.ndarray, system: System, task: TimeIntegration, initial: Trajectory | None
) -> Start:
    """Return the start in the unstressed state, or from given rows."""
    settings, rows = task.settings, None
    if initial is None:
        begun = initial_state(system, settings)
    else:
        begun = continued_state(system, initial, settings, task.dt)
        # a control acts on the history only where that is one state
        rows = (begun.record, begun.control) if begun.state.known(settings) == 1 else (begun.record,)
    past = begun.state.history
    record = np.asarray(begun.record)[:, : system.y_layout.size + system.z_layout.size]

    def tangents(directions: Any, weights: np.ndarray) -> Any:
        history, d_record, d_past = _begun(robot, x, rows, past, settings)
        return np.asarray(d_record) @ weights, history, tuple(np.asarray(part) @ weights for part in d_past)

    known, sudden = begun.state.known(settings), begun.state.dt is None
    return Start(record, past, np.asarray(begun.control), known, sudden, tangents)


@functools.partial(jax.jit, static_argnames="settings")
def _begun(robot: Any, x: Any, rows: Any, past: Any, settings: Settings) -> Any:
    """Return the history of an unstressed robot or of rows, and tangents of record and history.

    `rows` are the record of the last row and, if it is the whole history, its control; None: unstressed.
    """

    def begun(x: Any) -> Any:
        system = robot(x)
        if rows is None:
            return rest_record(system), resting_history(system, settings)
        if system.mixed and len(rows) == 2:
            return rows[0], constant_history(system, settings, *rows, past.t0)
        return rows[0], past

    def along(direction: Any) -> Any:
        (_, start), (d_record, d_past) = jax.jvp(begun, (x,), (direction,))
        return start, d_record, (d_past.records, d_past.rate)

    return jax.vmap(along, out_axes=(None, -1, -1))(jnp.eye(x.shape[0]))


class TangentMotion(NamedTuple):
    """A solved motion, or list of equilibria, from a start."""

    task: TimeIntegration
    system: System
    start: Start
    #: at the end of each step, or at its stages
    controls: Float[Any, "steps c"]
    #: y and z at the nodes, of the start and after every step
    records: Float[Any, "steps+1 N x"]
    #: rows and unknowns of all stages
    solved: tuple[Any, Any]
    #: true for equilibria that were not found: their records are those of others
    missing: Bool[np.ndarray, " steps+1"] | None = None

    def tangents(
        self,
        directions: Any,
        weights: Float[np.ndarray, "n m"],
        d_controls: Any,
        kept: Bool[np.ndarray, "N x"],
    ) -> Float[np.ndarray, "steps+1 q m"]:
        """Return the tangents of the numbers that are `kept` of all records.

        Args:
            directions: n tangents of the system, stacked.
            weights: of each direction in each tangent.
            d_controls: tangents of the controls, (steps, c, m).
            kept: true for the numbers of a record.
        """
        settings, size = self.task.settings, self.records.shape[-1]
        d_first, past, d_past = self.start.tangents(directions, weights)
        at, changes = (self.system, self.controls), Changes(d_controls, directions, weights, kept=kept)
        if settings.time is None:
            d_rows = static_tangents(settings, self.solved, at, changes)[0]
        else:
            state = TangentState.of(self.system, settings.space, past, *d_past)
            d_rows = tangent_time_loop(self.task.coefficients, self.solved, at, changes, state)[1][0]
        last = d_rows[settings.stages - 1 :: settings.stages]
        first = d_first[None, :, :size][:, kept] if self.start.found else np.zeros_like(last[:1])
        return np.concatenate([first, last])


def tangent_motion(
    task: TimeIntegration, system: System, start: Start, controls: Float[np.ndarray, "steps c"], steps: int
) -> TangentMotion | None:
    """Solve some steps, or equilibria, from a start, without estimates of errors; None if it failed.

    Equilibria are solved each by itself; it has failed if none is found.

    Args:
        task: settings, time step and recovery.
        system: the system.
        start: its start (`start_at`).
        controls: at the end of each step; there may be more than are solved, for the shape of programs.
        steps: number of steps.
    """
    settings = dataclasses.replace(task.settings, errors=False)
    if settings.time is not None:
        controls = at_stages(system, settings, controls, start.control[None], start.sudden)
    task = dataclasses.replace(task, settings=settings, steps=max(steps, 1), known=start.known)
    if settings.time is None:
        return _equilibria(task, system, start, np.asarray(controls)[: max(steps, 1)], steps)
    rows, _, cause = run_one(task, system, controls, (start.state, start.control), watch=None)
    if cause:
        return None
    records = np.concatenate([start.record[None], rows.records[:steps, :, : start.record.shape[1]]])
    solved = tuple(part[: steps * settings.stages] for part in rows.every_stage)
    return TangentMotion(task, system, start, controls[:steps], records, solved)


def _equilibria(
    task: TimeIntegration, system: System, start: Start, controls: Any, steps: int
) -> TangentMotion | None:
    """Return some equilibria that were found each by itself."""
    rows, _, _ = separate_run(task, system, controls)
    solved = rows.result >= 0
    if not solved.any():
        return None
    # rows that are not solved are others in the equations, and do not count
    used = np.where(solved, np.arange(len(solved)), np.argmax(solved))[:steps]
    records, unknowns = rows.records[used], rows.unknowns[used]
    missing = np.concatenate([[not start.found], ~solved[:steps]])
    every = np.concatenate([start.record[None], records[:, :, : start.record.shape[1]]])
    return TangentMotion(task, system, start, controls[used], every, (records, unknowns), missing)
