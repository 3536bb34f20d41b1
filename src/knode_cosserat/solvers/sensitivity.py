"""Derivatives of a simulation, by the implicit function theorem in each step.

A solved step satisfies G(y, ξ; history, control, parameters) = 0. Its tangent therefore solves the linear
equations of Newton's method, with the tangents of history, control and parameters on the right-hand side.
The iteration is not differentiated, and reverse mode is the transpose of the same recursion.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float

from knode_cosserat.engine import loops as engine
from knode_cosserat.engine.program import EngineError
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.history import StateHistory, history_of, used_places
from knode_cosserat.solvers.problem import StepProblem, no_history, row_of
from knode_cosserat.solvers.run import Equilibria, TimeIntegration
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.static_loop import static_one
from knode_cosserat.solvers.tangent import Moves, StepTangent, SystemMoves
from knode_cosserat.solvers.time_loop import StepCoefficients, StepRows, loop_one

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


@functools.lru_cache(maxsize=64)
def rollout(task: TimeIntegration) -> Callable[[System, Any, StateHistory], tuple[StepRows, StateHistory]]:
    """Return a differentiable function from (system, controls (T, c), past) to all rows and the last history.

    Cached between calls: JAX recognises functions that it has already traced by identity.
    """
    settings, steps = task.settings, task.steps

    @jax.custom_jvp
    def run(system: System, controls: Any, past: StateHistory) -> tuple[StepRows, StateHistory]:
        done, last, rows = loop_one(system, settings, task.coefficients, controls, past, (0, steps))
        last = last._replace(t0=past.t0 + steps * task.dt)
        return _nan_where_unsolved(rows), jax.tree.map(lambda x: jnp.where(done < steps, jnp.nan, x), last)

    def tangent(primals: Any, tangents: Any) -> Any:
        rows, last = run(*primals)
        (system, controls, past), solved = primals, rows.every_stage
        moves = SystemMoves.of(_system_tangent(tangents[0]))
        _, d_controls, d_past = jax.tree.map(_instantiated, tangents, is_leaf=_is_zero)
        state = TangentState.of(system, settings.space, past, d_past.records, d_past.rate)
        after, d_solved = tangent_loop_in_jax(
            settings, task.coefficients, solved, (system, controls), (moves, d_controls), state
        )
        # first guesses, error estimates and the extra stages of these count as constants
        d_last = jax.tree.map(jnp.zeros_like, last)
        used = len(after.d_rate)
        d_last = d_last._replace(
            records=d_last.records.at[:, :used].set(after.d_records),
            rate=d_last.rate.at[:used].set(after.d_rate),
            t0=d_past.t0,
        )
        d_records, d_unknowns = (d.reshape(steps, settings.stages, *d.shape[1:]) for d in d_solved)
        d_rows = _row_tangents(rows, d_records[:, -1], d_unknowns[:, -1])
        d_rows = d_rows._replace(stages=d_records[:, :-1], stage_unknowns=d_unknowns[:, :-1])
        return (rows, last), (d_rows, d_last)

    run.defjvp(tangent, symbolic_zeros=True)
    return run


@functools.lru_cache(maxsize=64)
def static_rollout(task: Equilibria) -> Callable[[System, Any, Any], StepRows]:
    """Return a differentiable function from (system, controls (T, c), y at all points) to all rows."""

    @jax.custom_jvp
    def run(system: System, controls: Any, y: Any) -> StepRows:
        _, _, rows = static_one(system, task.settings, controls, y, (0, task.steps))
        return _nan_where_unsolved(rows)

    def tangent(primals: Any, tangents: Any) -> Any:
        rows = run(*primals)
        solved, moves = (rows.records, rows.unknowns), SystemMoves.of(_system_tangent(tangents[0]))
        changes = moves, _instantiated(tangents[1])
        d_rows, d_unknowns, _ = static_tangents_in_jax(task.settings, solved, primals[:2], changes)
        return rows, _row_tangents(rows, d_rows, d_unknowns)

    run.defjvp(tangent, symbolic_zeros=True)
    return run


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)


def _instantiated(tangent: Any) -> Any:
    """Return a tangent as an array."""
    if not _is_zero(tangent):
        return tangent
    numeric: Any = np if tangent.dtype == jax.dtypes.float0 else jnp
    return numeric.zeros(tangent.shape, tangent.dtype)


def _system_tangent(tangent: Any) -> Any:
    """Return the tangent of a system with arrays as leaves, or None if all of them are zero."""
    leaves = jax.tree.leaves(tangent, is_leaf=_is_zero)
    if all(_is_zero(leaf) for leaf in leaves):
        return None
    return jax.tree.map(_instantiated, tangent, is_leaf=_is_zero)


def _nan_where_unsolved(rows: StepRows) -> StepRows:
    unsolved = rows.result < 0
    return rows._replace(
        records=jnp.where(unsolved[:, None, None], jnp.nan, rows.records),
        unknowns=jnp.where(unsolved[:, None], jnp.nan, rows.unknowns),
        error=jnp.where(unsolved, jnp.inf, rows.error),
    )


def _row_tangents(rows: StepRows, d_records: Any, d_unknowns: Any) -> StepRows:
    whole, zero = np.zeros(rows.result.shape, dtype=jax.dtypes.float0), jnp.zeros_like(rows.error)
    none = jax.tree.map(jnp.zeros_like, (rows.stages, rows.stage_unknowns))
    return StepRows(d_records, d_unknowns, zero, whole, zero, whole, zero, *none)


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


@functools.partial(jax.jit, static_argnames="settings")
def static_tangents_in_jax(
    settings: Settings, solved: tuple[Any, Any], at: tuple[System, Any], changes: tuple[SystemMoves, Any]
) -> tuple[Any, Any, Any]:
    """Return the tangents of rows, unknowns and records of solved equilibria, traced by JAX."""
    (system, controls), (moves, d_controls) = at, changes

    def one(now: Any) -> Any:
        row, unknowns, control, d_control = now
        problem = StepProblem.still(system, settings.space, control)
        none = jnp.zeros((*problem.history.shape, *d_control.shape[1:]))
        _, d_records, d_row, d_unknowns = _step_tangent(problem, row, unknowns, moves, (none, d_control))
        return d_row, d_unknowns, d_records

    return jax.lax.map(one, (*solved, controls, d_controls))
