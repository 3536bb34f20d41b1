"""Derivatives of a simulation, by the implicit function theorem in each step.

A solved step satisfies G(y, ξ; history, control, parameters) = 0. Its tangent therefore solves the linear
equations of Newton's method, with the tangents of history, control and parameters on the right-hand side.
The iteration is not differentiated, and reverse mode is the transpose of the same recursion.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.engine import loops as engine
from knode_cosserat.engine.program import EngineError
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.history import StateHistory, history_of, used_places
from knode_cosserat.solvers.problem import StepProblem, no_history, row_of
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.tangent import Moves, StepTangent, SystemMoves
from knode_cosserat.solvers.time_loop import StepCoefficients

#: number of steps of one program
PIECE = 40


class TangentState(NamedTuple):
    """History before a step at the places of the scheme, and its tangents: the carry of the tangent loop."""

    records: Float[Any, "2 used x"]
    rate: Float[Any, "used x"]
    d_records: Float[Any, "2 used x ..."]
    d_rate: Float[Any, "used x ..."]
    #: time of row 0 (s)
    t0: Any

    @classmethod
    def of(cls, system: System, space: SpaceScheme, past: StateHistory, d_records: Any, d_rate: Any) -> Self:
        """Return the state before the first step, from a history and its tangents at all places.

        Many tangents are columns: one more axis, the last.
        """
        used = used_places(system, space)
        records, d_records = (part[:, :used] for part in (past.records, d_records))
        return cls(records, past.rate[:used], d_records, d_rate[:used], past.t0)


def tangent_time_loop(
    settings: Settings, steps: StepCoefficients, solved: tuple[Any, Any], at: tuple[System, Any],
    changes: tuple[SystemMoves, Any], state: TangentState,
) -> tuple[TangentState, tuple[Any, Any]]:  # fmt: skip
    """Return the state after the last of some solved rows, and the tangents of all rows and unknowns.

    They are linear in `changes`, the tangents of system and controls, and in those of `state`. `solved` are
    all rows and unknowns, and with several stages those of every stage, like the result; `at` are system and
    controls. Tangents are columns: weights, controls, state and results have one more axis, the last.
    """
    given = state.records, state.rate, state.d_records, state.d_rate
    try:
        after, found = engine.tangent_loop(settings, steps, solved, at, changes, given, float(state.t0))
        return TangentState._make((*after, state.t0)), found
    except EngineError:
        pass
    (system, controls), (moves, d_controls) = at, changes
    parts, stages, begun = [], settings.stages, state.t0
    for k in range(0, len(controls), PIECE):
        size = min(PIECE, len(controls) - k)

        def piece(rows: Any, m: int = 1, k: int = k, size: int = size) -> np.ndarray:
            """Return the rows of these steps; the last one again and again, for one program."""
            own = np.asarray(rows)[k * m : (k + size) * m]
            return own[np.minimum(np.arange(PIECE * m), len(own) - 1)]

        own = piece(solved[0], stages), piece(solved[1], stages)
        state, found = tangent_loop_in_jax(
            settings, steps, own, (system, piece(controls)), (moves, piece(d_controls)), state, size
        )
        state = state._replace(t0=state.t0 + size * steps.dt)
        parts.append([np.asarray(each)[: size * stages] for each in found])
        steps = steps._replace(table=steps.table[[1, 1]])
    d_rows, d_unknowns = (np.concatenate(each) for each in zip(*parts, strict=True))
    return state._replace(t0=begun), (d_rows, d_unknowns)


@functools.partial(jax.jit, static_argnames="settings")
def tangent_loop_in_jax(
    settings: Settings, steps: StepCoefficients, solved: tuple[Any, Any], at: tuple[System, Any],
    changes: tuple[SystemMoves, Any], state: TangentState, last: Any = None,
) -> tuple[TangentState, tuple[Any, Any]]:  # fmt: skip
    """Return the same as `tangent_time_loop`, traced by JAX, also for one tangent without the last axis.

    The state is that after `last` steps, or after all.
    """
    (system, controls), (moves, d_controls) = at, changes
    stages, count = settings.stages, len(controls)
    coefficients, t = jax.vmap(functools.partial(steps.at, state.t0))(jnp.arange(count))
    controls, d_controls = (
        each.reshape(count * stages, system.control_size, *each.shape[2:])
        if each.shape[1] > system.control_size
        else jnp.repeat(each, stages, axis=0)
        for each in (controls, d_controls)
    )

    def one(state: TangentState, now: Any) -> Any:
        coefficients, t, row, unknowns, control, d_control, i = now
        c0 = coefficients[0]
        history = history_of(state.records, state.rate, coefficients, settings)
        d_history = history_of(state.d_records, state.d_rate, coefficients, settings)
        problem = StepProblem(system, t, control, c0, history, settings.space)
        found = _step_tangent(problem, row, unknowns, moves, (d_history, d_control))
        records, d_records, d_row, d_unknowns = found
        rate, d_rate = state.rate, state.d_rate
        if settings.uses_rate:
            rate, d_rate = c0 * records + history, c0 * d_records + d_history
        after = TangentState(
            jnp.stack([records, state.records[0]]), rate, jnp.stack([d_records, state.d_records[0]]), d_rate,
            state.t0,
        )  # fmt: skip
        if last is not None:
            after = jax.tree.map(lambda a, b: jnp.where(i < last * stages, a, b), after, state)
        return after, (d_row, d_unknowns)

    numbers = jnp.arange(count * stages)
    solves = coefficients.reshape(-1, 4), t.reshape(-1), *solved, controls, d_controls, numbers
    return jax.lax.scan(one, state, solves)


def _step_tangent(problem: StepProblem, row: Any, unknowns: Any, moves: SystemMoves, changes: Any) -> Any:
    """Return the records of a solved row, and the tangents of records, row and unknowns.

    `changes` are the tangents of history and control.
    """
    y = problem.filled(row[:, : problem.system.y_layout.size])
    step = StepTangent(problem, y, unknowns, moves.directions)
    d_history, d_control = changes
    d_y, d_unknowns, d_records = step.solved(Moves(d_history, d_control, moves.weights))
    return problem.packed(step.found), d_records, row_of(problem.system, d_y, d_records), d_unknowns


def static_tangents(
    settings: Settings, solved: tuple[Any, Any], at: tuple[System, Any], changes: tuple[SystemMoves, Any]
) -> tuple[Any, Any, Any]:
    """Return the tangents of rows and unknowns of solved equilibria, and of the records of the last.

    `solved` are all rows and unknowns; `at` are system and controls, and `changes` their tangents. Tangents
    are columns. Records are those at the places of the scheme.
    """
    system, (_, d_controls) = at[0], changes
    none = np.zeros((used_places(system, settings.space), no_history(system, settings.space).shape[1]))
    d_none = np.zeros((*none.shape, d_controls.shape[-1]))
    state = TangentState(np.stack([none] * 2), none, np.stack([d_none] * 2), d_none, 0.0)
    still = dataclasses.replace(settings, time=None)
    after, found = tangent_time_loop(still, engine.STILL, solved, at, changes, state)
    return *found, after.d_records[0]
