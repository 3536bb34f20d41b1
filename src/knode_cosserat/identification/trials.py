"""Acceptance trials of an identified robot."""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.identification.experiments import Experiment
from knode_cosserat.identification.steps import simulated_rows
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendons import remove_delay
from knode_cosserat.schemes.result import Result, SimulationError
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.equilibrium import equilibria, equilibrium
from knode_cosserat.solvers.refinement import fix_grid
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.trajectory import Trajectory

#: amplitudes of the recordings' tensions about their initial ones
AMPLITUDES = (1.0, 1.5)
#: random tensions: seconds of a trial, and for how long each is held
SECONDS, HELD = 5.0, 0.4
#: share of rows whose grid may be too coarse
FEW = 0.01
#: seconds that recovery may take in a trial: a robot that needs more is not accepted
RECOVERY = 2.0


def failed_trial(
    robot: System,
    data: Sequence[Experiment],
    space: str | SpaceScheme,
) -> str | None:
    """Return the reason why a robot is not accepted; None if it passes all trials.

    It has to follow the tensions of every recording, the same with 1.5 times the amplitude, and random
    tensions within the recordings' range, without a step that cannot be solved.
    """
    # a tendon does not push; a motor turns either way
    fields = robot.control_layout.fields
    low, high = (
        np.concatenate([np.zeros(0), *(np.full(it.size, getattr(it, end)) for it in fields)])
        for end in ("low", "high")
    )
    low = np.where(robot.control_layout.names[:1] == ("tension",), np.maximum(low, 0.0), low)
    trials = [
        (
            f"tensions of {it.name} at {amplitude:g} times their amplitude",
            it,
            np.clip(it.held + amplitude * (it.control - it.held), low, high),
        )
        for amplitude in AMPLITUDES
        for it in data
    ]
    for words, like, tension in [*trials, ("random tensions", data[0], random_controls(data, SECONDS))]:
        try:
            _, motion = moved(robot, tension, like, space)
        except SimulationError as error:
            return f"{words}: {error}"
        if not np.all(np.isfinite(np.asarray(motion.y))):
            return f"{words}: a state is not finite"
    return None


def has_coarse_rows(robot: System, data: Sequence[Experiment], space: str | SpaceScheme) -> bool:
    """Return True if the grid is too coarse in more than a few rows of the recordings.

    A robot that cannot be simulated is not too coarse: `failed_trial` reports it.
    """
    for it in data:
        try:
            _, motion = moved(robot, it.control, it, space)
        except SimulationError:
            return False
        if np.mean(np.asarray(motion.result) == Result.COARSE) > FEW:
            return True
    return False


def motions_of(robot: System, data: Sequence[Experiment], space: str | SpaceScheme) -> list[Trajectory]:
    """Return the motions of a robot under the controls of experiments; those without a solution are left out.

    Where an experiment starts in an equilibrium, that is a motion of its own.
    """
    motions = list[Trajectory]()
    with warnings.catch_warnings():
        # what is to be said of these rows was said in the search
        warnings.simplefilter("ignore")
        for it in data:
            with contextlib.suppress(SimulationError):
                if it.held is not None and (it.readings or it.static):
                    motions += moved(robot, it.control, it, space)
                    continue
                initial: Any = it.initial
                if it.held is not None:
                    initial = equilibrium(robot, it.held, space=it.settings.space, with_stability=False)
                    motions.append(initial)
                motion = simulate(
                    fix_grid(robot),
                    it.control,
                    it.dt,
                    time=it.settings.time or "bdf2",
                    space=it.settings.space,
                    start=it.settings.start,
                    initial=initial,
                    on_failure="return",
                    recovery_budget=RECOVERY,
                )
                motions.append(motion)
    return motions


def control_range(data: Sequence[Experiment]) -> Float[np.ndarray, "2 c"]:
    """Return the lowest and the highest controls of all experiments."""
    return np.array([end([end(it.control, axis=0) for it in data], axis=0) for end in (np.min, np.max)])


def random_controls(data: Sequence[Experiment], seconds: float) -> Float[np.ndarray, "T c"]:
    """Return random controls within the range of the experiments, each held for a while."""
    (low, high), dt = control_range(data), data[0].dt
    count, hold = max(round(seconds / dt), 1), max(round(HELD / dt), 1)
    drawn = np.random.default_rng(0).uniform(low, high, (-(-count // hold), len(low)))
    return np.repeat(drawn, hold, axis=0)[:count]


def moved(
    robot: System, tension: Float[np.ndarray, "T c"], like: Experiment, space: str | SpaceScheme
) -> tuple[Trajectory, Trajectory]:
    """Return the equilibrium under a recording's initial tensions, and the rows from there."""
    robot, initial, dt = fix_grid(robot), np.asarray(like.held), like.dt
    with warnings.catch_warnings():
        # this trial is about solvable steps, not about their accuracy
        warnings.filterwarnings("ignore", message="the grid is too coarse")
        if like.static:
            tension = np.concatenate([initial[None], remove_delay(robot, tension, dt, initial)])
            rows = equilibria(
                robot,
                tension,
                initial="separate",
                space=space,
                recovery_budget=RECOVERY,
                with_stability=False,
            )
            return rows[:1], dataclasses.replace(rows, time=dt * rows.time)
        still = equilibrium(robot, initial, space=space, recovery_budget=RECOVERY, with_stability=False)
        return still, simulated_rows(robot, tension, dt, still, initial, like.continuous, space, RECOVERY)
