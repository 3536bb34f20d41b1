"""Derivatives of a simulation, by the implicit function theorem in each step.

A solved step satisfies G(y, ξ; history, control, parameters) = 0. Its tangent therefore solves the linear
equations of Newton's method, with the tangents of history, control and parameters on the right-hand side.
The iteration is not differentiated, and reverse mode is the transpose of the same recursion.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import factors_of, pivots_of
from knode_cosserat.solvers.history import StateHistory, advanced, history_of
from knode_cosserat.solvers.linear import solved_correction
from knode_cosserat.solvers.problem import StepProblem, row_of
from knode_cosserat.solvers.run_types import RunSettings
from knode_cosserat.solvers.settings import Settings
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

    @run.defjvp
    def tangent(primals: Any, tangents: Any) -> Any:
        rows = run(*primals)
        system, controls, past = primals
        d_system, d_controls, d_past = tangents
        d_records, d_unknowns = tangent_time_loop(
            settings, table, dt, rows.records, rows.unknowns, system, controls, past, d_system, d_controls,
            d_past.records, d_past.rate,
        )  # fmt: skip
        still = np.zeros(steps, dtype=jax.dtypes.float0)
        none = jnp.zeros_like(rows.error)
        return rows, StepRows(d_records, d_unknowns, none, still, none)

    return run


@functools.partial(jax.jit, static_argnames="settings")
def tangent_time_loop(
    settings: Settings, table: Any, dt: Any, rows: Any, unknowns: Any, system: System, controls: Any,
    past: StateHistory, d_system: Any, d_controls: Any, d_records: Any, d_rate: Any,
) -> Any:  # fmt: skip
    """Return tangents of all rows and unknowns, linear in the tangents of system, controls and history."""
    return tangent_piece(
        settings, table, dt, rows, unknowns, system, controls, past, d_system, d_controls, d_records, d_rate
    )[1]


def tangent_piece(
    settings: Settings, table: Any, dt: Any, rows: Any, unknowns: Any, system: System, controls: Any,
    past: StateHistory, d_system: Any, d_controls: Any, d_records: Any, d_rate: Any,
) -> Any:  # fmt: skip
    """Return the history after the last row with its tangents, and the result of `tangent_time_loop`."""
    ny, pivots = system.y_layout.size, pivots_of(system)

    def one(carry: Any, now: Any) -> Any:
        past, d_recent, d_rate = carry
        i, row, xi, control, d_control = now
        coefficients = jnp.where(i == 0, table[0], table[1])
        t = past.t0 + (i + 1) * dt
        history = history_of(past.records, past.rate, coefficients, settings)
        d_history = history_of(d_recent, d_rate, coefficients, settings)

        def now_with(system: Any, control: Any, history: Any) -> StepProblem:
            return StepProblem(system, t, control, coefficients[0], history, settings.space)

        problem = now_with(system, control, history)
        y = problem.filled(row[:, :ny])
        factors = factors_of(problem, y, xi)

        def at_solution(system: Any, control: Any, history: Any) -> Any:
            problem = now_with(system, control, history)
            return *problem.residuals(y), problem.base(xi)

        given, d_given = (system, control, history), (d_system, d_control, d_history)
        defects, tip, base = jax.jvp(at_solution, given, d_given)[1]
        dy, dxi = solved_correction(factors, pivots, defects, tip, base)

        def kept_of(system: Any, control: Any, history: Any, y: Any) -> Any:
            records = now_with(system, control, history).records(y)
            return records, row_of(system, y, records)

        (records, _), (d_records, d_row) = jax.jvp(kept_of, (*given, y), (*d_given, dy))
        rate = coefficients[0] * records + history if settings.time.uses_rate else past.rate
        d_rate = coefficients[0] * d_records + d_history if settings.time.uses_rate else d_rate
        past = advanced(past, records, rate, y, past.weights)
        return (past, jnp.stack([d_records, d_recent[0]]), d_rate), (d_row, dxi)

    steps = jnp.arange(rows.shape[0])
    begun = past, d_records, d_rate
    (past, d_records, d_rate), tangents = jax.lax.scan(
        one, begun, (steps, rows, unknowns, controls, d_controls)
    )
    return (past, d_records, d_rate), tangents
