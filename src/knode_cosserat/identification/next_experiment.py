"""The next experiment: controls that would decide what the data leave open."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.identification.experiments import Experiment
from knode_cosserat.identification.misfit import Misfit
from knode_cosserat.identification.posterior import Posterior
from knode_cosserat.identification.search import ParameterSearch
from knode_cosserat.identification.trials import HELD, control_range, moved, random_controls
from knode_cosserat.schemes.result import SimulationError

#: longest experiment (s), and periods of sines (s)
LONGEST, PERIODS = 8.0, (1.0, 3.0)
#: an experiment ends when so much of the information of the longest one is there
ENOUGH = 0.8


@dataclasses.dataclass(frozen=True, repr=False)
class NextExperiment:
    """Controls, of those that were tried, that tell most about undecided effects; `print` says which.

    Attributes:
        words: which controls.
        control: from each row to the next (T, c).
        dt: time from row to row (s).
        deviations: standard deviation of each number of the undecided effects, in units of that of its
            prior: as it is, and after the experiment.
    """

    words: str
    control: Float[np.ndarray, "T c"]
    dt: float
    deviations: dict[str, tuple[float, float]]

    def __str__(self) -> str:
        label, (before, after) = min(self.deviations.items(), key=lambda item: item[1][1] / item[1][0])
        return (
            f"{self.words}, for {len(self.control) * self.dt:.2g} s; the standard deviation of {label} "
            f"would be {after / before:.2g} of what it is"
        )


def next_experiment(
    search: ParameterSearch, posterior: Posterior, x: Float[np.ndarray, " n"], undecided: Sequence[str]
) -> NextExperiment | None:
    """Return the experiment after which the numbers of undecided effects are known best.

    The information matrix of each experiment follows from derivatives of its simulation (D-optimal design,
    Fedorov 1972). Tensions are within those of the recordings.

    Args:
        search: recordings, and the model with all effects.
        posterior: what is known from the recordings.
        x: coordinates of the identified robot.
        undecided: effects.

    Returns:
        The experiment; None if no control can be simulated.
    """
    model, first, point = posterior.model, search.misfit.data[0], posterior.point
    robot, second = search.misfit.system(x), max(round(1.0 / first.dt), 1)
    experiments = []
    for words, control in _controls(search.misfit.data, round(LONGEST) * second):
        like = first.replace(control=control, moves=0, accurate=None, name=words)
        with contextlib.suppress(SimulationError):
            _, motion = moved(robot, control, like, like.settings.space)
            seen = jax.vmap(lambda *row: first.output.value(robot, *row))(motion.y, motion.z)
            experiments.append(like.replace(data=np.asarray(seen)))
    misfit = Misfit(model, experiments)
    found: list[Any] = misfit.differences(x)
    solved = [k for k, rollout in enumerate(found) if rollout is not None]
    experiments, rollouts = [experiments[k] for k in solved], [found[k] for k in solved]
    misfit.differentiated(rollouts)
    usable = search.used(rollouts, np.ones(model.size, dtype=bool))
    on, known = np.flatnonzero(model.mask(undecided)), point.problem.matrix.sum(axis=0) + np.diag(point.prior)
    before, unit = _deviations(known, on), point.scale[0][first.groups]
    # a difference counts as in the recordings
    weight = np.sqrt(point.problem.amount[0] / len(first.data) / len(unit)) / unit
    best: tuple[float, NextExperiment | None] = 0.0, None
    for like, rollout, used in zip(experiments, rollouts, usable, strict=True):
        slopes = np.where(used, rollout.derivatives * weight, 0.0)
        ends = range(second, len(like.control) + 1, second)
        parts = [slopes[:, : end + 1].reshape(model.size, -1) for end in ends]
        after = [_deviations(known + part @ part.T, on) for part in parts]
        gains = np.mean(np.log(before / np.array(after)), axis=1)
        if gains[-1] > best[0]:
            k = int(np.argmax(gains >= ENOUGH * gains[-1]))
            changes = zip(before.tolist(), after[k].tolist(), strict=True)
            deviations = dict(zip((model.labels[i] for i in on), changes, strict=True))
            best = gains[-1], NextExperiment(like.name, like.control[: ends[k]], like.dt, deviations)
    return best[1]


def _deviations(information: np.ndarray, on: np.ndarray) -> np.ndarray:
    return np.sqrt(np.diag(np.linalg.inv(information))[on])


def _controls(data: Sequence[Experiment], count: int) -> Iterator[tuple[str, np.ndarray]]:
    """Yield words and controls (count, c) within those of the recordings."""
    low, high = control_range(data)
    held = low if data[0].held is None else np.asarray(data[0].held)
    time, size = data[0].dt * np.arange(1, count + 1), len(low)
    for k in range(size):
        step = np.tile(held, (count, 1))
        step[:, k] = high[k]
        yield f"control {k + 1} steps to {high[k]:.3g}, the others as at the start", step
    for period in PERIODS:
        phase = 2.0 * np.pi * (time[:, None] / period - np.arange(size) / size)
        swing = 0.5 * (1.0 - np.cos(phase)) * np.minimum(time / period, 1.0)[:, None]
        yield (
            f"sines of {period:g} s up to the highest, one control after the other",
            low + swing * (high - low),
        )
    yield "all controls rise together to the highest", held + np.outer(time / time[-1], high - held)
    yield f"random controls, new ones every {HELD:g} s", random_controls(data, count * data[0].dt)
