"""Derivatives of a simulation, by the implicit function theorem in each step.

A solved step satisfies G(y, ξ; history, control, parameters) = 0. Its tangent therefore solves the linear
equations of Newton's method, with the tangents of history, control and parameters on the right-hand side.
The iteration is not differentiated, and reverse mode is the transpose of the same recursion.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.history import StateHistory, history_of, used_places
from knode_cosserat.solvers.problem import StepProblem, row_of
from knode_cosserat.solvers.run_types import RunSettings
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.tangent import Moves, StepTangent, SystemMoves
from knode_cosserat.solvers.time_loop import StepRows, loop_one


@functools.lru_cache(maxsize=64)
def rollout(task: RunSettings) -> Callable[[System, Any, StateHistory], StepRows]:
    """Return a differentiable function from (system, controls (T, c), past) to the rows of all steps.

    Cached between calls: JAX recognises functions that it has already traced by identity.
    """
    settings, table, dt, steps = task.settings, task.table, task.dt, task.steps

    @jax.custom_jvp
    def run(system: System, controls: Any, past: StateHistory) -> StepRows:
        done, _, rows = loop_one(system, settings, table, controls, dt, past, 0, steps)
        unsolved = jnp.arange(steps) >= done
        return StepRows(
            jnp.where(unsolved[:, None, None], jnp.nan, rows.records),
            jnp.where(unsolved[:, None], jnp.nan, rows.unknowns),
            jnp.where(unsolved, jnp.inf, rows.error),
            rows.corrections,
            rows.position_error,
        )

    def tangent(primals: Any, tangents: Any) -> Any:
        rows = run(*primals)
        system, controls, past = primals
        moves = any(
            not isinstance(each, SymbolicZero) for each in jax.tree.leaves(tangents[0], is_leaf=_is_zero)
        )
        d_system, d_controls, d_past = jax.tree.map(_instantiated, tangents, is_leaf=_is_zero)
        d_records, d_unknowns = tangent_time_loop(
            settings, table, dt, rows.records, rows.unknowns, system, controls, past,
            d_system if moves else None, d_controls, d_past.records, d_past.rate,
        )  # fmt: skip
        still = np.zeros(steps, dtype=jax.dtypes.float0)
        none = jnp.zeros_like(rows.error)
        return rows, StepRows(d_records, d_unknowns, none, still, none)

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


class TangentState(NamedTuple):
    """History before a step at the places of the scheme, and its tangents: the carry of the tangent loop."""

    records: Float[Any, "2 used x"]
    rate: Float[Any, "used x"]
    d_records: Float[Any, "2 used x"]
    d_rate: Float[Any, "used x"]
    #: time of row 0 (s)
    t0: Any

    @classmethod
    def of(cls, system: System, settings: Settings, past: StateHistory, d_records: Any, d_rate: Any) -> Self:
        """Return the state before the first step, from a history and its tangents at all places."""
        used = used_places(system, settings.space)
        records, rate, d_records, d_rate = (
            part[..., :used, :] for part in (past.records, past.rate, d_records, d_rate)
        )
        return cls(records, rate, d_records, d_rate, past.t0)


@functools.partial(jax.jit, static_argnames="settings")
def tangent_time_loop(
    settings: Settings, table: Any, dt: Any, rows: Any, unknowns: Any, system: System, controls: Any,
    past: StateHistory, d_system: Any, d_controls: Any, d_records: Any, d_rate: Any,
) -> Any:  # fmt: skip
    """Return tangents of all rows and unknowns, linear in the tangents of system, controls and history.

    `d_system` is None if the system does not change.
    """
    state = TangentState.of(system, settings, past, d_records, d_rate)
    moves, solved = SystemMoves.of(d_system), (rows, unknowns)
    return tangent_piece(settings, table, dt, solved, system, controls, state, moves, d_controls)[1]


def tangent_piece(
    settings: Settings, table: Any, dt: Any, solved: tuple[Any, Any], system: System, controls: Any,
    state: TangentState, moves: SystemMoves, d_controls: Any,
) -> tuple[TangentState, Any]:  # fmt: skip
    """Return the state after the last of some solved rows and unknowns, and the tangents of these."""
    ny = system.y_layout.size

    def one(state: TangentState, now: Any) -> Any:
        i, row, unknowns, control, d_control = now
        coefficients = jnp.where(i == 0, table[0], table[1])
        t, c0 = state.t0 + (i + 1) * dt, coefficients[0]
        history = history_of(state.records, state.rate, coefficients, settings)
        d_history = history_of(state.d_records, state.d_rate, coefficients, settings)
        problem = StepProblem(system, t, control, c0, history, settings.space)
        step = StepTangent(problem, problem.filled(row[:, :ny]), unknowns, moves.directions)
        d_y, d_unknowns, d_records = step.solved(Moves(d_history, d_control, moves.weights))
        records = problem.packed(step.found)
        rate, d_rate = state.rate, state.d_rate
        if settings.time.uses_rate:
            rate, d_rate = c0 * records + history, c0 * d_records + d_history
        after = TangentState(
            jnp.stack([records, state.records[0]]), rate, jnp.stack([d_records, state.d_records[0]]), d_rate,
            state.t0,
        )  # fmt: skip
        return after, (row_of(system, d_y, d_records), d_unknowns)

    return jax.lax.scan(one, state, (jnp.arange(len(controls)), *solved, controls, d_controls))
