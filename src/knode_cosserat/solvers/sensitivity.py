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
from knode_cosserat.solvers.run import Equilibria, TimeIntegration
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.static_loop import static_one
from knode_cosserat.solvers.time_loop import StepCoefficients, StepRows, TimeStep, loop_one


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

    @run.defjvp
    def tangent(primals: Any, tangents: Any) -> Any:
        rows, last = run(*primals)
        d_system, d_controls, d_past = tangents
        solved = rows.records, rows.unknowns
        changes = d_system, d_controls, d_past.records, d_past.rate
        (_, d_records, d_rate), d_solved = tangent_time_loop(
            settings, task.coefficients, solved, primals, changes
        )
        # first guesses and error estimates count as constants
        d_last = jax.tree.map(jnp.zeros_like, last)
        d_last = d_last._replace(records=d_records, rate=d_rate, t0=d_past.t0)
        return (rows, last), (_row_tangents(rows, *d_solved), d_last)

    return run


@functools.lru_cache(maxsize=64)
def static_rollout(task: Equilibria) -> Callable[[System, Any, Any], StepRows]:
    """Return a differentiable function from (system, controls (T, c), y at all points) to all rows."""

    @jax.custom_jvp
    def run(system: System, controls: Any, y: Any) -> StepRows:
        _, _, rows = static_one(system, task.settings, controls, y, (0, task.steps))
        return _nan_where_unsolved(rows)

    @run.defjvp
    def tangent(primals: Any, tangents: Any) -> Any:
        rows = run(*primals)
        solved = rows.records, rows.unknowns
        d_rows, d_unknowns, _ = static_tangents(task.settings, solved, primals[:2], tangents[:2])
        return rows, _row_tangents(rows, d_rows, d_unknowns)

    return run


def _nan_where_unsolved(rows: StepRows) -> StepRows:
    unsolved = rows.result < 0
    return rows._replace(
        records=jnp.where(unsolved[:, None, None], jnp.nan, rows.records),
        unknowns=jnp.where(unsolved[:, None], jnp.nan, rows.unknowns),
        error=jnp.where(unsolved, jnp.inf, rows.error),
    )


def _row_tangents(rows: StepRows, d_records: Any, d_unknowns: Any) -> StepRows:
    whole, zero = np.zeros(rows.result.shape, dtype=jax.dtypes.float0), jnp.zeros_like(rows.error)
    return StepRows(d_records, d_unknowns, zero, whole, zero, whole)


def _step_tangent(problem_of: Callable[..., StepProblem], at: Any, d_at: Any, row: Any, xi: Any) -> Any:
    """Return y, records and the tangents of records, row and unknowns of a solved step.

    `problem_of` makes the step's problem from `at`, whose tangent is `d_at`.
    """
    problem = problem_of(*at)
    y = problem.filled(row[:, : problem.system.y_layout.size])
    factors = factors_of(problem, y, xi)

    def at_solution(*at: Any) -> Any:
        problem = problem_of(*at)
        return *problem.residuals(y), problem.base(xi)

    defects, tip, base = jax.jvp(at_solution, at, d_at)[1]
    dy, dxi = solved_correction(factors, pivots_of(problem.system), defects, tip, base)

    def recorded(y: Any, *at: Any) -> Any:
        problem = problem_of(*at)
        records = problem.records(y)
        return records, row_of(problem.system, y, records)

    (records, _), (d_records, d_row) = jax.jvp(recorded, (y, *at), (dy, *d_at))
    return y, records, d_records, d_row, dxi


@functools.partial(jax.jit, static_argnames="settings")
def tangent_time_loop(
    settings: Settings, steps: StepCoefficients, solved: tuple[Any, Any],
    at: tuple[System, Any, StateHistory], changes: tuple[Any, Any, Any, Any],
) -> Any:  # fmt: skip
    """Return the last history with its tangents, and the tangents of all rows and unknowns.

    They are linear in `changes`: the tangents of system, controls, and the records and rate of the history.
    `solved` are all rows and unknowns; `at` are system, controls and history before the first step.
    """
    (system, controls, past), (d_system, d_controls, d_records, d_rate) = at, changes

    def one(carry: Any, now: Any) -> Any:
        past, d_recent, d_rate = carry
        i, row, xi, control, d_control = now
        step = TimeStep.of(steps, past, i)
        history = history_of(past.records, past.rate, step.coefficients, settings)
        d_history = history_of(d_recent, d_rate, step.coefficients, settings)
        c0 = step.coefficients[0]

        def problem_of(system: System, control: Any, history: Any) -> StepProblem:
            return StepProblem(system, step.t, control, c0, history, settings.space)

        y, records, d_records, d_row, dxi = _step_tangent(
            problem_of, (system, control, history), (d_system, d_control, d_history), row, xi
        )
        rate = past.rate
        if settings.uses_rate:
            rate, d_rate = c0 * records + history, c0 * d_records + d_history
        past = advanced(past, records, rate, y, past.weights)
        return (past, jnp.stack([d_records, d_recent[0]]), d_rate), (d_row, dxi)

    numbers = jnp.arange(len(solved[0]))
    return jax.lax.scan(one, (past, d_records, d_rate), (numbers, *solved, controls, d_controls))


@functools.partial(jax.jit, static_argnames="settings")
def static_tangents(
    settings: Settings, solved: tuple[Any, Any], at: tuple[System, Any], changes: tuple[Any, Any]
) -> tuple[Any, Any, Any]:
    """Return the tangents of rows, unknowns and records at all places of solved equilibria.

    `solved` are all rows and unknowns; `at` are system and controls, and `changes` their tangents.
    """
    (system, controls), (d_system, d_controls) = at, changes

    def problem_of(system: System, control: Any) -> StepProblem:
        return StepProblem.still(system, settings.space, control)

    def one(now: Any) -> Any:
        row, xi, control, d_control = now
        _, _, d_records, d_row, dxi = _step_tangent(
            problem_of, (system, control), (d_system, d_control), row, xi
        )
        return d_row, dxi, d_records

    return jax.lax.map(one, (*solved, controls, d_controls))
