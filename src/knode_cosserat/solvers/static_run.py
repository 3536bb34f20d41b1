"""Equilibria of one robot in turn, with the winding and the stability of rods that are held at both ends.

An orientation is known up to whole turns: an end turned by more than about a radian at once loses some. And
a straight rod between ends nearer than its length is in equilibrium, but unstable. Large rotations are
therefore made in parts, turns between two equilibria are counted, and equilibria found without a guess are
tested.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.aspects import Ends
from knode_cosserat.rods.ends import Free
from knode_cosserat.rods.strands import strand_count
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.schemes.grid import grid_of
from knode_cosserat.schemes.history import StepRows
from knode_cosserat.schemes.result import Result
from knode_cosserat.solvers.energy import RodEnergy, is_tested
from knode_cosserat.solvers.guess import (
    LARGEST_TURN,
    curve_guesses,
    held_ends,
    largest_turns,
    turns_between,
)
from knode_cosserat.solvers.refinement import is_too_coarse
from knode_cosserat.solvers.rest import unloaded_shape
from knode_cosserat.solvers.run import TimeIntegration, run_batch, run_one

#: number of times that a change of control is divided where turns are lost, and parts of each division
DIVISIONS, PARTS = 8, 4
#: chord over length of the unloaded rod from which it counts as straight
STRAIGHT = 0.999
#: part of the length by which a chord is shorter before a rod counts as compressed
COMPRESSED = 1e-9
#: tip of systems that state none
FREE = Free()


def static_run(
    task: TimeIntegration, system: System, controls: Any, y: Any = None, before: Any = None
) -> tuple[StepRows, Any, str]:
    """Solve the equilibria under controls (T, c) in turn, with recovery, from y at all points.

    `before` is the control of y. Without y, the equilibria start from the unloaded shape. They are then
    tested for stability. An unstable shape of a compressed rod is replaced by a stable one, if one is found.
    """
    walk, controls = _Walk(task, system), np.asarray(controls)
    return walk.from_rest(controls) if y is None else walk.along(controls, y, before)


def static_batch(
    task: TimeIntegration, system: System, controls: Any, y: Any = None, before: Any = None
) -> Any:
    """Solve the equilibria of a batch as `run_batch`, but robots that need `static_run` by themselves.

    There are controls (B, T, c) for one system, or for as many of them.
    """
    controls, many, size = np.asarray(controls), np.ndim(system.length) > 0, len(controls)
    guess = unloaded_shape(system, task.settings.space) if y is None else y
    guess = guess if guess.ndim == 3 else jnp.broadcast_to(guess, (size, *guess.shape))
    if y is None and not many:
        guess = np.stack([Ends.of(system).placed(*each) for each in zip(guess, controls[:, 0], strict=True)])
    last = np.broadcast_to(0.0 if before is None else before, (size, controls.shape[-1]))

    def walk(i: int) -> _Walk:
        return _Walk(task, jax.tree.map(lambda leaf: leaf[i], system) if many else system)

    angles = largest_turns(system, np.diff(np.concatenate([last[:, None], controls], axis=1), axis=1))
    alone = set(np.flatnonzero(np.max(angles, axis=-1) > LARGEST_TURN * (1.0 + 1e-9)).tolist())
    plain = np.array([i for i in range(size) if i not in alone], dtype=int)
    runs: dict[int, tuple[StepRows, Any, str]] = {}
    if len(plain):
        own = jax.tree.map(lambda leaf: leaf[plain], system) if many else system
        rows, states, causes = run_batch(task, own, controls[plain], (guess[plain], last[plain]))
        tested = is_tested(system)
        for k, i in enumerate(plain):
            one, state = jax.tree.map(lambda leaf, k=k: leaf[k], (rows, states))
            runs[i] = one, state, causes.get(k, "")
            if y is None and tested:
                walking = walk(i)
                solved = np.flatnonzero(walking._testable(one.result))
                if any(walking.is_unstable(one.records[j], controls[i, j]) for j in solved):
                    alone.add(i)
    for i in alone:
        runs[i] = static_run(task, walk(i).system, controls[i], y, before)
    parts = [runs[i] for i in range(size)]
    rows, states = (
        jax.tree.map(lambda *x: np.stack(x), *each) for each in list(zip(*parts, strict=True))[:2]
    )
    return rows, states, {i: cause for i, (*_, cause) in enumerate(parts) if cause}


def separate_run(task: TimeIntegration, system: System, controls: Any) -> tuple[StepRows, Any, str]:
    """Solve the equilibria of one robot under controls (T, c), each by itself, in a batch.

    They do not depend on their order: the first guess of each is the unloaded shape. What is not found from
    there is sought from the solved row with the nearest controls, and then with recovery. Returned are rows,
    y at all points of each, and the likely cause for the first row that is not solved.
    """
    controls, ends = np.asarray(controls), Ends.of(system)
    still = dataclasses.replace(task, steps=1, recovery_budget=0.0)
    begin = unloaded_shape(system, task.settings.space)
    along = grid_of(system, task.settings.space).along[: len(begin)]
    begins = ends.unloaded(begin, along, controls)
    rows, points, _ = run_batch(still, system, controls[:, None], (begins, controls), watch=None)
    rows = StepRows(*(np.array(leaf[:, 0]) for leaf in rows))
    size = np.ptp(controls, axis=0) if len(controls) else np.ones(controls.shape[-1])
    size, points = np.where(size > 0.0, size, 1.0), np.array(points)
    alone = np.max(largest_turns(system, controls[:, None]), axis=-1) > LARGEST_TURN * (1.0 + 1e-9)
    # turns of driven ends are counted, and shapes of a rod between two ends chosen, from the unloaded robot
    alone |= strand_count(system) == 1 and not isinstance(
        getattr(nominal_model(system), "tip_end", FREE), Free
    )
    good, tried = (rows.result >= 0) & ~alone, np.zeros(len(controls), dtype=int) - 1
    while good.any() and not (good | alone).all():
        missing, known = np.flatnonzero(~good & ~alone), np.flatnonzero(good)
        away = np.linalg.norm((controls[missing, None] - controls[known]) / size, axis=-1)
        nearest = known[np.argmin(away, axis=1)]
        new = nearest != tried[missing]
        if not new.any():
            break
        missing, nearest = missing[new], nearest[new]
        tried[missing] = nearest
        found, at, _ = run_batch(
            still, system, controls[missing, None], (points[nearest], controls[nearest]), watch=None
        )
        solved = found.result[:, 0] >= 0
        for every, part in zip(rows, found, strict=True):
            every[missing[solved]] = part[solved, 0]
        points[missing[solved]], good[missing[solved]] = np.asarray(at)[solved], True
    causes = dict[int, str]()
    for k in np.flatnonzero(alone if task.recovery_budget == 0.0 else ~good):
        one, points[k], cause = static_run(dataclasses.replace(task, steps=1), system, controls[k][None])
        for every, part in zip(rows, one, strict=True):
            every[k] = part[0]
        if cause:
            causes[int(k)] = cause
    failed = np.flatnonzero(rows.result < 0)
    return rows, points, causes.get(int(failed[0]), "no equilibrium was found") if len(failed) else ""


class _Walk:
    """Equilibria of one robot, each from the one before."""

    def __init__(self, task: TimeIntegration, system: System):
        self.task, self.system, self.grid = task, system, grid_of(system)
        #: chord of the unloaded shape (m) while unstable shapes are replaced
        self.chord = 0.0

    def from_rest(self, controls: np.ndarray) -> tuple[StepRows, Any, str]:
        """Start from the unloaded shape, or from a curve between ends nearer than the length; test all."""
        y, before = unloaded_shape(self.system, self.task.settings.space), np.zeros_like(controls[0])
        # a rod with a free tip is not compressed
        free = isinstance(getattr(nominal_model(self.system), "tip_end", None), Free)
        if not free and "p" in self.system.y_layout.names and strand_count(self.system) == 1:
            p = np.asarray(y)[:, self.system.y_layout.slice("p")]
            self.chord = float(np.linalg.norm(p[-1] - p[0]))
        y, guess = Ends.of(self.system).placed(y, controls[0]), None
        if self.chord > STRAIGHT * float(self.system.length) and self._compressed(controls[0]):
            guess = self._best(controls[0], curve_guesses(self.system, controls[0]))[0]
        if guess is None:
            rows, state, cause = self.along(controls, y, before, fits=False)
            if np.any(rows.result < 0) and np.all(largest_turns(self.system, controls) <= np.pi):
                # no turns can be lost: at once, where recovery starts from curves between the ends
                rows, state, cause = run_one(self.task, self.system, controls, (y, before))
        else:
            rows, state, cause = self.along(controls, guess, controls[0])
        for k in np.flatnonzero(self._testable(rows.result)):
            if self.is_unstable(rows.records[k], controls[k]):
                rows.result[k] = Result.UNSTABLE
        return rows, state, cause

    def along(
        self, controls: np.ndarray, y: Any, before: Any, fits: bool = True
    ) -> tuple[StepRows, Any, str]:
        """Solve the equilibria from y, which meets the conditions of both ends if it `fits`."""
        path, wanted = self.path(controls, before, fits)
        # one row for each control of the path that is done
        rows: list[StepRows] = []
        last = np.asarray(y)[self.grid.nodes] if fits else None
        divisions, missing, cause = 0, 0, ""
        while len(rows) < len(path):
            task = dataclasses.replace(self.task, steps=len(path) - len(rows))
            start = y, path[len(rows) - 1] if rows else before
            new, y, cause = run_one(task, self.system, path[len(rows) :], start)
            for row in map(StepRows._make, zip(*new, strict=True)):
                control, solved = path[len(rows)], row.result >= 0
                turns = turns_between(self.system, last, row.records) if solved and last is not None else 0
                if turns and rows and divisions < DIVISIONS:
                    # again from the row before, in smaller parts
                    parts = np.linspace(path[len(rows) - 1], control, PARTS + 1)[1:-1]
                    path = np.insert(path, len(rows), parts, axis=0)
                    wanted = wanted + (PARTS - 1) * (wanted >= len(rows))
                    divisions, y = divisions + 1, self._points(last)
                    break
                missing += turns
                stable = self._stable(row, control) if solved and self._compressed(control) else row
                last = stable.records
                rows.append(stable._replace(result=int(Result.OTHER_TURNS)) if solved and missing else stable)
                if stable is not row:
                    y = self._points(last)
                    break
        leaves = (np.stack(leaf)[wanted] for leaf in zip(*rows, strict=True))
        return StepRows(*leaves), y, cause

    def path(self, controls: np.ndarray, before: Any, fits: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Return controls (P, c) from `before` on, with ends turned in parts, and the indices of `controls`.

        If an end is turned in parts, the path begins with `before`, unless y already fits it.
        """
        every = np.concatenate([np.asarray(before)[None], controls])
        angles = largest_turns(self.system, np.diff(every, axis=0))
        counts = np.maximum(1, np.ceil(angles / LARGEST_TURN - 1e-9).astype(int))
        first = [] if fits or np.all(counts == 1) else [every[:1]]
        pairs = zip(every[:-1], controls, counts, strict=True)
        parts = [np.linspace(start, end, n + 1)[1:] for start, end, n in pairs]
        return np.concatenate([*first, *parts]), np.cumsum(counts) - 1 + len(first)

    def _testable(self, results: Any) -> Any:
        """True for solved rows with the control's turns, unless the grid is too coarse for a verdict."""
        coarse = is_too_coarse(self.task.settings.space, results)
        return (results >= 0) & (results != Result.OTHER_TURNS) & ~coarse

    def is_unstable(self, records: Any, control: Any) -> bool:
        """True if an equilibrium is unstable; false where that is not tested."""
        y = records[:, : self.system.y_layout.size]
        return is_tested(self.system) and RodEnergy(self.system, y, control).mode() is not None

    def _compressed(self, control: Any) -> bool:
        """True if the ends are held nearer to each other than in the unloaded shape."""
        if not self.chord:
            return False
        base, tip = held_ends(self.system, control)
        if base is None or tip is None:
            return False
        return float(np.linalg.norm(tip.p - base.p)) < self.chord - COMPRESSED * float(self.system.length)

    def _points(self, records: Any) -> Any:
        """Return y at all points from records at the nodes."""
        return self.grid.spread(np.asarray(records)[:, : self.system.y_layout.size])

    # stable equilibria of compressed rods

    def _best(self, control: Any, guesses: list[Any]) -> tuple[Any, StepRows | None]:
        """Return the first guess with a stable equilibrium near it, or else with any, and the equilibrium."""
        best: tuple[Any, StepRows | None] = None, None
        for guess in guesses:
            rows = self.task.solve(self.system, np.asarray(control)[None], guess, (0, 1))[2]
            row = StepRows(*(leaf[0] for leaf in rows))
            if row.result < 0 or turns_between(self.system, np.asarray(guess)[self.grid.nodes], row.records):
                continue
            if not self.is_unstable(row.records, control):
                return guess, row
            if best[0] is None:
                best = guess, row
        return best

    def _stable(self, row: StepRows, control: Any) -> StepRows:
        """Return a stable equilibrium below an unstable one; if there is none, or it is stable, the same."""
        if not is_tested(self.system):
            return row
        y, layout = np.array(row.records[:, : self.system.y_layout.size]), self.system.y_layout
        energy = RodEnergy(self.system, y, control)
        mode = energy.mode()
        if mode is None:
            return row
        for name, values in energy.stable_shape(mode).items():
            y[:, layout.slice(name)] = values
        found = self._best(control, [self._points(y)])[1]
        if found is not None and not self.is_unstable(found.records, control):
            return found
        # no more attempts
        self.chord = 0.0
        return row
