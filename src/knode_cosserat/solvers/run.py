"""Execution of compiled time loops: one robot with recovery, or a batch on all cores."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import logging
import os
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from knode_cosserat.rods.system import System, is_traced
from knode_cosserat.solvers.history import StateHistory, padded_rows
from knode_cosserat.solvers.recovery import Budget, Outcome, recover
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.run_types import InitialCondition, RunSettings, StepResults
from knode_cosserat.solvers.time import Static
from knode_cosserat.solvers.time_loop import StepRows, loop_many, loop_one

log = logging.getLogger(__name__)

#: number of robots that one thread solves at a time
CHUNK = 16
#: smallest number of steps for which a run of one robot is compiled, so that short runs share a program
LEAST_CAPACITY = 128
#: seconds between two checks for signals, and number of steps before the first check
RESPONSE, FIRST_STEPS = 0.2, 128
#: a row whose position error is above this part of the length is COARSE
COARSE_SHARE = 0.02


def run_one(
    task: RunSettings, system: System, controls: np.ndarray, start: InitialCondition, progress: bool = False
) -> tuple[StepResults, str]:
    """Return all steps of one robot, and the likely cause if a step failed (`result` < 0)."""
    past, total, piece = start.past, task.steps, FIRST_STEPS
    padded = padded_rows(controls, least=LEAST_CAPACITY)
    budget = Budget(task.recovery_budget)
    rows: StepResults | None = None
    done, cause = 0, ""
    with tqdm(total=total, disable=not progress, unit="step", leave=False) as bar:
        while done < total and not cause:
            began = time.perf_counter()
            stop = min(total, done + piece)
            reached, past, new = loop_one(
                system, task.settings, task.table, padded, task.dt, past, done, stop
            )
            reached = int(reached)
            elapsed = time.perf_counter() - began
            budget.ran(elapsed)
            # short enough to respond to an interruption, long enough to cost nothing
            piece = max(piece, int((reached - done) * RESPONSE / max(elapsed, 1e-6)))
            rows = _merged(rows, new, done, reached, total)
            if reached < stop:
                before = controls[reached - 1] if reached else start.control
                outcome = rescue(task, system, past, (before, controls[reached]), reached, budget)
                past, cause = outcome.past, outcome.cause
                log.info("step %d: %s", reached + 1, outcome.result.message)
                _set_row(rows, reached, outcome)
                reached += outcome.result.solved
            bar.update(reached - done)
            done = reached
    assert rows is not None
    return mark_coarse(rows, system, task, start), cause


def rescue(
    task: RunSettings, system: System, past: StateHistory, controls: tuple[Any, Any], i: int, budget: Budget
) -> Outcome:
    """Recover step i after the compiled loop failed; `controls` are the previous step's and its own."""
    settings = task.settings
    if task.first == "still":
        settings = dataclasses.replace(settings, time=Static())
    t = float(past.t0) + (i + 1) * task.dt
    return recover(system, settings, past, task.table[min(i, 1)], controls, t, task.dt, budget)


def is_coarse(position_error: Any, system: System) -> Any:
    """Return true where a position error is above `COARSE_SHARE` of the length, or NaN."""
    length = system.length
    return ~(position_error <= COARSE_SHARE * (length[..., None] if np.ndim(length) else length))


def mark_coarse(
    steps: StepResults, system: System, task: RunSettings, start: InitialCondition
) -> StepResults:
    """Mark solved rows for which the grid is too coarse, and in a motion all rows after such a row.

    The error is propagated by linearised equations. They give its decay along the computed motion, but cannot
    show that the exact motion diverges from it.
    """
    numeric: Any = jnp if is_traced((steps, system, start.coarse)) else np
    coarse = is_coarse(steps.position_error, system)
    if not task.still:
        before = numeric.asarray(start.coarse)[..., None]
        coarse = (numeric.cumsum(coarse, axis=-1) > 0) | before
    coarse &= steps.result >= 0
    return steps._replace(result=numeric.where(coarse, int(Result.COARSE), steps.result))


def run_batch(
    task: RunSettings,
    system: System,
    batched: bool,
    controls: np.ndarray,
    start: InitialCondition,
    progress: bool,
) -> tuple[StepResults, dict[int, str]]:
    """Return the steps of all robots, and the likely cause for each robot that failed.

    Robots are solved in chunks, one thread a core. A robot with a failed step is then run by itself, with
    recovery.
    """
    size = controls.shape[0]
    lockstep = jax.default_backend() != "cpu"
    workers = 1 if lockstep else usable_cores()
    chunk = size if lockstep else min(CHUNK, -(-size // workers))
    padded = padded_rows(controls)

    def robot(index: Any) -> System:
        return jax.tree.map(lambda leaf: leaf[index], system) if batched else system

    with tqdm(total=size, disable=not progress, unit="robot", leave=False) as bar:

        def work(first: int) -> Any:
            # the last chunk is padded with its last robot: one shape, one program
            index = np.minimum(np.arange(first, first + chunk), size - 1)
            past = jax.tree.map(lambda leaf: leaf[index], start.past)
            done, rows = loop_many(
                robot(index), task.settings, task.table, padded[index], task.dt, past, task.steps, batched,
                lockstep,
            )  # fmt: skip
            count = min(chunk, size - first)
            bar.update(count)
            return np.asarray(done)[:count], *(np.asarray(leaf)[:count, : task.steps] for leaf in rows)

        firsts = range(0, size, chunk)
        program = _program(system, start.past, padded, task.settings, batched, lockstep, chunk)
        first = [] if program in _COMPILED else [work(firsts[0])]
        _COMPILED.add(program)
        with concurrent.futures.ThreadPoolExecutor(workers) as pool:
            chunks = first + list(pool.map(work, firsts[len(first) :]))
    done, *rows = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
    results = np.zeros((*done.shape, task.steps), dtype=int)
    steps = mark_coarse(StepResults._make([*rows, results]), system, task, start)
    causes = {}
    coarse = np.broadcast_to(start.coarse, size)
    for i in np.flatnonzero(done < task.steps):
        own = InitialCondition(
            jax.tree.map(lambda leaf, i=i: leaf[i], start.past), start.control[i], coarse[i]
        )
        alone, cause = run_one(task, robot(i), controls[i], own)
        for all_robots, one in zip(steps, alone, strict=True):
            all_robots[i] = one
        if alone.result.min() < 0:
            causes[int(i)] = cause
    return steps, causes


#: compiled programs of `run_batch`. JAX may crash if one thread writes a program to the disk's cache while
#: another compiles the same program, so the first chunk of a new program runs alone.
_COMPILED: set[Any] = set()


def _program(system: System, past: Any, controls: np.ndarray, *static: Any) -> Any:
    """Return the structures and shapes that determine a compiled program."""
    leaves, structure = jax.tree.flatten((system, past))
    return structure, tuple(np.shape(leaf) for leaf in leaves), controls.shape, static


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _merged(rows: StepResults | None, new: StepRows, first: int, last: int, total: int) -> StepResults:
    """Add the rows `first` to `last` of a time loop to the existing rows."""
    if rows is None:
        leaves = [np.asarray(leaf)[:total] for leaf in new]
        if last == total:
            return StepResults._make([*leaves, np.zeros(total, dtype=int)])
        rows = StepResults._make([*map(np.array, leaves), np.full(total, int(Result.NOT_REACHED))])
    for old, leaf in zip(rows[:-1], new, strict=True):
        old[first:last] = np.asarray(leaf)[first:last]
    rows.result[first:last] = Result.CONVERGED
    return rows


def _set_row(rows: StepResults, i: int, outcome: Outcome) -> None:
    rows.records[i], rows.unknowns[i] = outcome.record, outcome.unknowns
    rows.error[i], rows.corrections[i] = outcome.error, outcome.corrections
    rows.position_error[i] = outcome.position_error
    rows.result[i] = outcome.result
