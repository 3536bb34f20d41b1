"""Runs of compiled loops over time steps or equilibria: one robot with recovery, or a batch on all cores."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
import logging
import os
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from knode_cosserat.engine import loops as engine
from knode_cosserat.engine.motions import Motions, StaticState
from knode_cosserat.rods.kept import kept
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.rods.section import INWARD
from knode_cosserat.rods.strands import in_strands, strand_count, strand_of
from knode_cosserat.rods.system import SEEN_TURN, System, array_module, is_traced
from knode_cosserat.schemes.grid import grid_of, turn_of_segments
from knode_cosserat.schemes.history import (
    COARSE_ANGLE,
    COARSE_SHARE,
    SolverState,
    StepCoefficients,
    StepRows,
    TimeStep,
    no_rows,
)
from knode_cosserat.schemes.result import Result, SimulationError
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.solvers.guess import LARGEST_JUMP, LARGEST_TURN, materials, turns_between, turns_within
from knode_cosserat.solvers.recovery import Budget, SolvedStep, StaticRecovery, StepRecovery, recovered_stages
from knode_cosserat.solvers.refinement import mark_unseen
from knode_cosserat.solvers.rest import map_robots

log = logging.getLogger(__name__)

#: number of robots that one thread solves at a time
CHUNK = 64
#: seconds between two checks for signals, and number of steps before the first check
RESPONSE, FIRST_STEPS = 0.2, 128
#: rod theory holds up to this product of radius and curvature, and between these stretches
MOST_BENT, STRETCH = 0.5, (0.5, 2.0)


class InitialState(NamedTuple):
    """Initial state of a run of one robot or a batch."""

    #: y and z at the nodes
    record: Any
    #: control before the first step
    control: Any
    state: SolverState
    #: result that the motion's rows take on: COARSE or recovered, otherwise CONVERGED
    result: Any = int(Result.CONVERGED)


@dataclasses.dataclass(frozen=True)
class TimeIntegration:
    """The steps of a run, shared by all its robots.

    Without a time scheme they are equilibria, each solved from the one before. The state of a motion is a
    `StateHistory`, that of equilibria y at all points.
    """

    settings: Settings
    #: time step (s)
    dt: float = 0.0
    steps: int = 1
    #: states before the first step (`SolverState.known`)
    known: int = 1
    #: seconds that recovery may take; None: 20 times the run's own time or 5 s, whichever is more
    recovery_budget: float | None = None

    @property
    def coefficients(self) -> StepCoefficients:
        """Coefficients of the steps."""
        return StepCoefficients.of(self.settings, self.dt, self.known)

    def solve(
        self,
        system: System,
        controls: Any,
        state: Any,
        span: tuple[int, int] | None = None,
        rows: StepRows | None = None,
    ) -> Any:
        """Solve steps, all by default, until one fails: the number done, the last state, rows of the span.

        A batch of robots has controls (B, T, c) and as many states; each is solved until one of its steps
        fails. Rows are written to `rows` if they are given.
        """
        found = engine.solve_steps(system, self.coefficients, controls, state, span or (0, self.steps), rows)
        mark_unseen(system, found[2])
        return found

    def motions(self, system: System, state: Any) -> Motions:
        """Return the motion of one robot, or its equilibria, from a state, for steps one by one."""
        return engine.motions_of(system, self.coefficients, self.one_of(state))

    def one_of(self, state: Any) -> Any:
        """Return the state of one robot as states (1, ...) of `Motions`."""
        state = StaticState(state) if self.settings.time is None else state
        return jax.tree.map(lambda leaf: np.asarray(leaf)[None], state)

    def recover(self, system: System, state: Any, controls: Any, i: int, budget: Budget) -> SolvedStep:
        """Recover step i; `controls` are the previous step's and its own."""
        if self.settings.time is None:
            found = StaticRecovery(system, self.settings, state, budget).recover(controls)
            return found._replace(row=mark_unseen(system, found.row))
        step = TimeStep.of(self.coefficients, state, i)
        recovery = StepRecovery(system, self.settings, step, self.dt, budget)
        recover = (
            functools.partial(recovered_stages, recovery) if self.settings.stages > 1 else recovery.recover
        )
        found = recover(controls)
        found = found._replace(row=mark_unseen(system, found.row))
        last, now = (np.asarray(each)[-system.control_layout.size :] for each in controls)
        if recovery.largest_part((last, now)) == 1.0:
            return found
        # an extrapolation from before a far turn would lose turns in the next steps
        y = found.state.y
        return found._replace(state=found.state._replace(y=np.stack([y[0]] * len(y))))


def run_one(
    task: TimeIntegration,
    system: System,
    controls: np.ndarray,
    start: tuple[Any, Any],
    watch: Literal["signals", "bar"] | None = "signals",
    rows: StepRows | None = None,
) -> tuple[StepRows, Any, str]:
    """Return all steps of one robot, with recovery, the last state, and the likely cause of a failure.

    They start from a state and the control before it. To watch for signals, the compiled loop returns about
    every `RESPONSE` seconds; a progress bar shows it. The result is the same bits in pieces of any length.
    Rows are written to `rows` if they are given: those of steps that are not reached.
    """
    total, (state, before) = task.steps, start
    piece = FIRST_STEPS if watch else total
    budget = Budget(task.recovery_budget)
    rows = no_rows(system, (total,), task.settings.stages) if rows is None else rows
    done, cause = 0, ""
    # equilibria are already in small parts
    angles = turns_within(system, controls, before) if task.settings.time else np.zeros(total)
    far, watched = (np.flatnonzero(angles > limit) for limit in (LARGEST_JUMP, LARGEST_TURN))
    first_state, motions = state, task.motions(system, state)
    with _bar(watch, total, "step") as advance:
        while done < total and not cause:
            began = time.perf_counter()
            stop = min(total, done + piece)
            reached, last = done, min([stop, *(int(k) for k in far if k >= done)])
            while last > done:
                earlier, part = motions.motions.copy(), _pick(rows, (None, slice(done, last)))
                [reached], part = motions.solve(controls[None], (done, last), StepRows(*part))
                mark_unseen(system, part)
                if not len(watched) or reached <= watched[0]:
                    break
                previous = rows.records[done - 1] if done else _nodes(system, first_state)
                last = _turns_kept(system, previous, rows.records[done:reached]) + done
                if last == reached:
                    break
                # again, up to the step that loses turns
                reached = done
                motions.restore(earlier)
            elapsed = time.perf_counter() - began
            budget.ran(elapsed)
            if watch:
                # short enough to respond to an interruption, long enough to cost nothing
                piece = max(piece, int((reached - done) * RESPONSE / max(elapsed, 1e-6)))
            if reached < stop:
                pair = (controls[reached - 1] if reached else before), controls[reached]
                solved = task.recover(system, _state_of(motions), pair, reached, budget)
                cause = solved.cause
                motions.put(task.one_of(solved.state), np.zeros(1, dtype=int))
                log.info("step %d: %s", reached + 1, Result(int(solved.row.result)).message)
                for every, value in zip(rows, solved.row, strict=True):
                    every[reached] = value
                reached += not cause
            advance(reached - done)
            done = reached
    return rows, _state_of(motions), cause


def _state_of(motions: Motions) -> Any:
    """Return the state of one robot: a history, or y of an equilibrium."""
    state = jax.tree.map(lambda leaf: leaf[0], motions.states)
    return state.y if isinstance(state, StaticState) else state


def refuse_far_turns(system: System, results: Any, controls: Any, before: Any) -> Any:
    """Return results (..., T) where no step after one that turns an end too far is solved.

    For runs without recovery; arguments as in `turns_within`.
    """
    numeric = array_module((results, controls, before))
    far = numeric.cumsum(turns_within(system, controls, before) > LARGEST_JUMP, axis=-1) > 0
    first = numeric.cumsum(far, axis=-1) == 1
    codes = numeric.where(first, int(Result.NO_CONVERGENCE), int(Result.NOT_REACHED))
    return numeric.where(far & (results >= 0), codes, results)


def _nodes(system: System, state: Any) -> Any:
    """Return y at the nodes of the newest state of a history."""
    return state.y[0][grid_of(system).nodes]


def _turns_kept(system: System, before: Any, records: Any) -> int:
    """Return the number of rows up to the first with other turns than the row before."""
    for k, record in enumerate(records):
        if turns_between(system, before, record):
            return k
        before = record
    return len(records)


@contextlib.contextmanager
def _bar(watch: str | None, total: int, unit: str) -> Iterator[Callable[[int], Any]]:
    """Show a progress bar, if it is to be watched: a function that advances it."""
    if watch != "bar":
        yield lambda _: None
        return
    with tqdm(total=total, unit=unit, leave=False) as bar:
        yield bar.update


def carried_results(result: Any, before: Any) -> Any:
    """Return the results of a motion's rows: COARSE, or recovered, from the first such row on.

    The error estimate is that of one solution. It cannot show that the exact motion diverges from the
    computed one on a coarse grid. A step that needed recovery may have several solutions, and two grids may
    follow different ones. `before` is the result before the motion.
    """
    traced = is_traced((result, before))
    if not traced and not np.any(result) and not np.any(before):
        return result
    numeric: Any = jnp if traced else np
    first = numeric.broadcast_to(numeric.asarray(before)[..., None], (*result.shape[:-1], 1))
    codes = numeric.concatenate([first, result], axis=-1)
    latest = numeric.where(codes > int(Result.COARSE), numeric.arange(codes.shape[-1]), 0)
    latest = jax.lax.cummax(latest, codes.ndim - 1) if traced else np.maximum.accumulate(latest, axis=-1)
    coarse = numeric.cumsum(codes == int(Result.COARSE), axis=-1) > 0
    codes = numeric.where(coarse, int(Result.COARSE), numeric.take_along_axis(codes, latest, axis=-1))
    return numeric.where(result >= 0, codes[..., 1:], result)


def warn_of_coarse_grids(system: System, settings: Settings, rows: StepRows) -> None:
    """Warn of rows with a large discretisation error; not for schemes that only reproduce results."""
    coarse = np.asarray(rows.result) == Result.COARSE
    if not np.any(coarse) or settings.space.is_reproduction:
        return
    errors, length = np.asarray(rows.position_error)[coarse], float(np.max(system.length))
    lost, worst = (
        np.count_nonzero(np.isnan(errors)),
        float(np.max(errors, initial=0.0, where=~np.isnan(errors))),
    )
    causes = []
    if worst > COARSE_SHARE * length:
        causes.append(f"positions are off by up to about {worst:.2g} m ({worst / length:.0%} of the length)")
    elif lost < len(errors):
        causes.append(f"orientations are off by more than about {COARSE_ANGLE:g} rad")
    causes += [f"{lost} rows have no estimate of the error"] if lost else []
    turn = _turn_of_frames(system, np.asarray(rows.records)[coarse])
    wound = turn_of_segments(system)
    causes += [f"parts turn by {wound:.2g} rad from node to node"] if wound > SEEN_TURN else []
    causes += [f"frames turn by up to {turn:.2g} rad from node to node"] if turn > LARGEST_TURN else []
    said = ", ".join(causes)
    warnings.warn(
        f"the grid is too coarse in {np.count_nonzero(coarse)} of {coarse.size} rows: {said} with "
        f"{system.nodes} nodes. Use more nodes, or position_tolerance.",
        stacklevel=4,
    )


def _turn_of_frames(system: System, records: Any) -> float:
    """Return the largest angle (rad) between frames of neighbouring nodes; 0 for several rods."""
    if strand_count(system) > 1 or "h" not in system.y_layout.names:
        return 0.0
    h = records[..., system.y_layout.slice("h")]
    cosine = np.abs(np.sum(h[..., 1:, :] * h[..., :-1, :], axis=-1))
    sizes = np.linalg.norm(h, axis=-1)
    return float(np.max(2.0 * np.arccos(np.minimum(cosine / (sizes[..., 1:] * sizes[..., :-1]), 1.0))))


def warn_outside_rod_theory(system: System, rows: StepRows) -> None:
    """Warn once if solved rows are bent or stretched beyond the assumptions of rod theory."""
    many, solved = np.ndim(system.length) > 0, np.asarray(rows.result) >= 0
    # a batch of robots of several rods has no `strand`
    strand = system if strand_count(system) == 1 or many else strand_of(system)
    if not solved.any() or not isinstance(strand, SlenderRod):
        return
    ny, nz = system.y_layout.size, system.z_layout.size
    z = in_strands(system, np.asarray(rows.records)[..., ny : ny + nz])
    radius = _radii(strand, system.control_layout.size)
    where: Any = slice(None) if solved.all() else solved
    u, v = strand.z_layout.get(z, "u")[..., :2], strand.z_layout.get(z, "v")
    # several times as fast as norms
    bent = np.max((np.sqrt(np.einsum("...i,...i", u, u)) * radius[..., None, :, None])[where])
    stretch = np.einsum("...i,...i", v, v)[where]
    found = []
    if bent > MOST_BENT:
        found.append(f"radius × curvature reaches {bent:.2g} (allowed: up to {MOST_BENT:g})")
    low, high = float(np.sqrt(np.min(stretch))), float(np.sqrt(np.max(stretch)))
    if low < STRETCH[0] or high > STRETCH[1]:
        found.append(f"the stretch is {low:.2g} to {high:.2g} (allowed: {STRETCH[0]:g} to {STRETCH[1]:g})")
    if found:
        warnings.warn(
            f"outside rod theory: {' and '.join(found)}; such rows solve the equations, but no real rod "
            "follows them: check loads, stiffness and radius, and their units",
            stacklevel=4,
        )


@kept
def _radii(rod: Any, controls: int) -> Float[np.ndarray, "... nodes"]:
    """Return the radius (m) at the nodes of a rod or of a batch of rods, or one for all nodes."""
    if rod.is_uniform:
        return np.asarray(rod.section.radius)[..., None]
    still = np.zeros(controls)
    # on the far side of the ends of sections, inside the rod, as z
    s = (np.arange(rod.nodes) + 0.2 * INWARD) / (rod.nodes - 1)
    s[-1] -= 0.4 * INWARD / (rod.nodes - 1)

    def along(rod: Any) -> Any:
        return np.asarray(materials(rod, s * rod.length, still).radius)

    return map_robots(along, rod) if np.ndim(rod.length) else along(rod)


def warn_of_results(rows: StepRows) -> None:
    """Warn of equilibria that are unstable, or have another winding than the control asks for."""
    for result, advice in (
        (Result.UNSTABLE, "give positions near the shape that you expect as initial"),
        (Result.OTHER_TURNS, "turn the ends in smaller steps, each from the last equilibrium as initial"),
    ):
        count = np.count_nonzero(np.asarray(rows.result) == result)
        if count:
            warnings.warn(
                f"{count} of {np.size(rows.result)} equilibria: {result.message}; {advice}", stacklevel=4
            )


def failure(rows: StepRows, causes: str | dict[int, str], times: Any) -> SimulationError:
    """Return the error of the first step that failed; without times, of an equilibrium.

    `causes` is the likely cause, or that of each robot of a batch.
    """
    robot = None if isinstance(causes, str) else next(iter(causes))
    cause = causes if isinstance(causes, str) else causes[next(iter(causes))]
    if robot is not None:
        rows = StepRows(*(leaf[robot] for leaf in rows))
    i = int(np.argmax(rows.result < 0))
    number, t = (0, 0.0) if times is None else (i + 1, float(times[i]))
    return SimulationError(number, t, float(rows.error[i]), Result(int(rows.result[i])), cause, robot)


def rows_of(system: System, rows: StepRows) -> dict[str, Any]:
    """Return a trajectory's arrays of rows, with NaN in unsolved rows."""
    numeric = array_module(rows)
    ny, nz = system.y_layout.size, system.z_layout.size
    invalid = numeric.asarray(rows.result) < 0
    length = system.length[..., None] if np.ndim(system.length) else system.length

    def known(values: Any, axes: int) -> Any:
        if numeric is np and not invalid.any():
            return values
        return numeric.where(invalid[(..., *[None] * axes)], numeric.nan, values)

    records = known(rows.records, 2)
    found = {
        "y": records[..., :ny], "z": records[..., ny : ny + nz], "result": rows.result,
        "residual": rows.error, "iterations": rows.corrections,
        "position_error": known(rows.position_error, 0),
        # an estimate beyond the rod's length is none
        "time_error": numeric.where(~invalid & (rows.time_error <= length), rows.time_error, numeric.nan),
    }  # fmt: skip
    if rows.stages.shape[-3]:
        found["stages"] = known(rows.stages, 3)
    return found


def run_batch(
    task: TimeIntegration,
    system: System,
    controls: np.ndarray,
    start: tuple[Any, Any],
    watch: Literal["signals", "bar"] | None = "signals",
    rows: StepRows | None = None,
) -> tuple[StepRows, Any, dict[int, str]]:
    """Return the rows and last states of all robots, and the likely cause for each robot that failed.

    Arguments as in `run_one`. Robots are solved in chunks, one thread a core. A robot with a failed step is
    then run by itself, with recovery.
    """
    size, batched, (states, before) = controls.shape[0], np.ndim(system.length) > 0, start
    workers = usable_cores()
    chunk = min(CHUNK, -(-size // workers))
    every = no_rows(system, (size, task.steps), task.settings.stages) if rows is None else rows
    done, lasts = np.zeros(size, dtype=int), jax.tree.map(lambda leaf: np.empty(np.shape(leaf)), states)

    def robot(index: Any) -> System:
        return _pick(system, index) if batched else system

    with _bar(watch, size, "robot") as advance:

        def work(first: int) -> None:
            index = slice(first, first + chunk)
            own, rows = _pick(states, index), _pick(every, index)
            done[index], after, _ = task.solve(robot(index), controls[index], own, rows=rows)
            _put(lasts, index, after)
            advance(len(done[index]))

        with concurrent.futures.ThreadPoolExecutor(workers) as pool:
            list(pool.map(work, range(0, size, chunk)))
    causes = {}
    # a run in chunks does not count turns
    turned = np.max(turns_within(system, controls, before), axis=-1) > LARGEST_TURN
    far = turned if task.settings.time else False
    for i in np.flatnonzero((done < task.steps) | far):
        *solved, cause = run_one(task, robot(i), controls[i], (_pick(states, i), before[i]))
        _put((every, lasts), i, solved)
        if cause:
            causes[int(i)] = cause
    return every, lasts, causes


def _pick(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def _put(tree: Any, index: Any, values: Any) -> None:
    for every, part in zip(jax.tree.leaves(tree), jax.tree.leaves(values), strict=True):
        every[index] = part


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
