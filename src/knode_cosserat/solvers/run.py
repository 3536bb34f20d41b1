"""Running compiled marches: one robot with everything that can be tried, or a batch on all cores."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import logging
import os
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import static_error
from knode_cosserat.solvers.linear import ELIMINATIONS
from knode_cosserat.solvers.march import Rows, march_many, march_one
from knode_cosserat.solvers.past import Past, initial_past, newest_row, padded_rows, refined
from knode_cosserat.solvers.recovery import Outcome, other_unit, recover
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.stability import SAFE_DECAY, decay_per_segment
from knode_cosserat.solvers.task import Start, Steps, Task
from knode_cosserat.solvers.time import Static
from knode_cosserat.solvers.trust import GROWS, SUSPICIOUS, agree, finite, refuse, trusted_size, trustworthy

log = logging.getLogger(__name__)

#: robots that one thread takes at a time
CHUNK = 16
#: what every run of one robot has room for: short ones, and equilibria, then share a program
LEAST_CAPACITY = 128
#: steps that need the stable elimination before a run changes to it, which costs a program
ENOUGH_RESCUES = 2
#: how far segments are divided when they are too long to be stable
MOST_NODES = 400
#: into how many parts, where a step is not found though they seem short enough
MOST_PARTS = 4


def run_one(
    task: Task, system: System, controls: np.ndarray, start: Start, progress: bool = False
) -> tuple[Steps, str]:
    """All steps of one robot, and the likely cause if one of them (`result` < 0) could not be solved."""
    steps, cause = _with_recovery(task, system, controls, start, progress)
    if refuse(steps, ~finite(steps, system), Result.NOT_FINITE):
        cause = "At the tip strains are undefined."
    still = isinstance(task.settings.time, Static)

    def decay_of(steps: Steps, parts: int = 1) -> float:
        """By how much waves decay within a segment, or a part of it: of equilibria, in the largest.

        A motion is judged by its first state, as if it rested there.
        """
        i = int(np.argmax(steps.size)) if still and steps.result.min() >= 0 else 0
        record = steps.records[i] if still else newest_row(system, start.past)
        return (
            decay_per_segment(system, task.settings, task.table[1], record, np.asarray(controls[i])) / parts
        )

    def to_be_believed(steps: Steps, parts: int = 1) -> bool:
        return trustworthy(steps, system, start, still, lambda: decay_of(steps, parts))

    if to_be_believed(steps):
        return steps, cause
    decay = decay_of(steps)
    steep = decay >= SAFE_DECAY / 4.0
    failed = np.flatnonzero(steps.result < 0)
    if not steep and (len(failed) == 0 or other_unit(system, controls[failed[0]])):
        return steps, cause
    # powers of two: few different node counts, so few programs to compile
    parts = 2 ** int(np.ceil(np.log2(max(2.0, decay / SAFE_DECAY))))
    # a step may also fail because the rod bends too sharply, or snaps too fast, for its segments
    most = MOST_NODES if steep else MOST_PARTS * (system.nodes - 1)
    log.info("states are large or not found; waves decay by e^%.2g within a segment", decay)
    before = steps
    while parts * (system.nodes - 1) <= most:
        log.info("every segment in %d parts", parts)
        finer = _with_finer_segments(task, system, parts, controls, start, progress)
        if agree(finer, steps, system, still):
            # as large as that, and no instability
            return steps, cause
        if to_be_believed(finer, parts) or agree(finer, before, system, still):
            return finer._replace(result=np.full(task.steps, int(Result.RECOVERED_FINER_SEGMENTS))), ""
        parts, before = 2 * parts, finer
    if steep:
        trusted = SUSPICIOUS if decay > GROWS else trusted_size(system, start)
        refuse(steps, steps.size > trusted, Result.UNSTABLE)
        cause = (
            f"{cause} At this time step its waves decay by e^{decay:.2g} within a segment, too much for an "
            "explicit scheme in space, and dividing the segments did not help: use longer time steps."
        ).strip()
    return steps, cause


def _with_finer_segments(
    task: Task, system: System, parts: int, controls: np.ndarray, start: Start, progress: bool
) -> Steps:
    """The same robot with every segment divided, given at its own nodes."""
    fine = system.replace(nodes=parts * (system.nodes - 1) + 1)
    steps, _ = _with_recovery(task, fine, controls, _refined(task, system, fine, start), progress)
    refuse(steps, ~finite(steps, fine), Result.NOT_FINITE)
    return steps._replace(records=np.ascontiguousarray(steps.records[:, ::parts]))


def _refined(task: Task, system: System, fine: System, start: Start) -> Start:
    """The start on a finer grid; an equilibrium is the finer grid's own, or the motion began with a jolt."""
    space = task.settings.space
    past = refined(system, fine, space, start.past)
    if _is_still(task, system, start):
        still = dataclasses.replace(task, steps=1, first="still")
        found, _ = _with_recovery(still, fine, start.control[None], start._replace(past=past), False)
        if found.result[0] >= 0:
            kept = fine.y_layout.size + fine.z_layout.size
            past = initial_past(fine, task.settings, found.records[0][:, :kept], start.control, start.past.t0)
    return start._replace(past=past)


def _is_still(task: Task, system: System, start: Start) -> bool:
    """Whether a motion begins in an equilibrium of its grid, under the control before it."""
    if start.equilibrium:
        return True
    records = np.asarray(start.past.records)
    if isinstance(task.settings.time, Static) or np.any(records != records[0]):
        return False
    row = newest_row(system, start.past)
    error = static_error(system, task.settings.space, row, start.control, start.past.t0)
    return bool(error <= task.settings.newton.acceptable)


def _with_recovery(
    task: Task, system: System, controls: np.ndarray, start: Start, progress: bool
) -> tuple[Steps, str]:
    past, total, table, settings = start.past, task.steps, task.table, task.settings
    padded = padded_rows(controls, least=LEAST_CAPACITY)
    piece = max(1, total // 100) if progress else total
    rows: Steps | None = None
    done = rescues = 0
    with tqdm(total=total, disable=not progress, unit="step", leave=False) as bar:
        while done < total:
            stop = min(total, done + piece)
            reached, past, new = march_one(system, settings, table, padded, task.dt, past, done, stop)
            reached = int(reached)
            rows = _merged(rows, new, done, reached, total)
            if reached < stop:
                before = controls[reached - 1] if reached else start.control
                outcome = rescue(task, system, past, (before, controls[reached]), reached)
                past = outcome.past
                log.info("step %d: %s", reached + 1, outcome.result.message)
                _set_row(rows, reached, outcome)
                if not outcome.result.solved:
                    return rows, outcome.cause
                reached += 1
                if outcome.result is Result.RECOVERED_STABLE_ELIMINATION:
                    rescues += 1
                    if rescues == ENOUGH_RESCUES:
                        log.info("step %d: from here on by the stable elimination", reached)
                if rescues >= ENOUGH_RESCUES:
                    settings = with_stable_elimination(task.settings)
            bar.update(reached - done)
            done = reached
    assert rows is not None
    return rows, ""


def rescue(task: Task, system: System, past: Past, controls: tuple[Any, Any], i: int) -> Outcome:
    """All that is tried of step i where the compiled march fails; with the controls before it and of it."""
    settings = task.settings
    if task.first == "still":
        settings = dataclasses.replace(settings, time=Static())
    t = float(past.t0) + (i + 1) * task.dt
    return recover(system, settings, past, task.table[min(i, 1)], controls, t, task.dt)


def with_stable_elimination(settings: Settings) -> Settings:
    """What a run goes on with that needs the stable elimination again and again."""
    return dataclasses.replace(settings, elimination=ELIMINATIONS["decoupled"])


def as_ended(settings: Settings, steps: Steps) -> Settings:
    """The settings that one robot's run ended with: what goes on from it begins so."""
    rescues = np.count_nonzero(steps.result == Result.RECOVERED_STABLE_ELIMINATION)
    return with_stable_elimination(settings) if rescues >= ENOUGH_RESCUES else settings


def run_batch(
    task: Task, system: System, batched: bool, controls: np.ndarray, start: Start, progress: bool
) -> tuple[Steps, dict[int, str]]:
    """All robots, and the likely cause for each that could not be solved.

    They go in chunks, one thread a core. A robot with a step that fails, or that seems unstable, is then run
    by itself, with everything that `run_one` tries.
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
            # the last chunk is filled up with its last robot: one shape, one program
            index = np.minimum(np.arange(first, first + chunk), size - 1)
            past = jax.tree.map(lambda leaf: leaf[index], start.past)
            done, rows = march_many(
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
    steps = Steps._make([*rows, np.zeros((*done.shape, task.steps), dtype=int)])
    causes = {}
    doubtful = (steps.size.max(axis=1) > SUSPICIOUS) | ~finite(steps, system).all(axis=1)
    for i in np.flatnonzero((done < task.steps) | doubtful):
        own = Start(jax.tree.map(lambda leaf, i=i: leaf[i], start.past), start.control[i])
        alone, cause = run_one(task, robot(i), controls[i], own)
        for all_robots, one in zip(steps, alone, strict=True):
            all_robots[i] = one
        if alone.result.min() < 0:
            causes[int(i)] = cause
    return steps, causes


#: programs of `run_batch` that there are already. JAX may crash where one thread writes a program to the
#: disk's cache while another compiles the same, so the first chunk of a new one goes alone.
_COMPILED: set[Any] = set()


def _program(system: System, past: Any, controls: np.ndarray, *static: Any) -> Any:
    """What makes JAX compile anew: structures and shapes."""
    leaves, structure = jax.tree.flatten((system, past))
    return structure, tuple(np.shape(leaf) for leaf in leaves), controls.shape, static


def usable_cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _merged(rows: Steps | None, new: Rows, first: int, last: int, total: int) -> Steps:
    """Add the rows `first` to `last` of a march to those there already."""
    if rows is None:
        leaves = [np.asarray(leaf)[:total] for leaf in new]
        if last == total:
            return Steps._make([*leaves, np.zeros(total, dtype=int)])
        rows = Steps._make([*map(np.array, leaves), np.full(total, int(Result.NOT_REACHED))])
    for old, leaf in zip(rows[:-1], new, strict=True):
        old[first:last] = np.asarray(leaf)[first:last]
    rows.result[first:last] = Result.CONVERGED
    return rows


def _set_row(rows: Steps, i: int, outcome: Outcome) -> None:
    rows.records[i], rows.unknowns[i] = outcome.record, outcome.unknowns
    rows.error[i], rows.corrections[i] = outcome.error, outcome.corrections
    rows.size[i] = outcome.size
    rows.result[i] = outcome.result
