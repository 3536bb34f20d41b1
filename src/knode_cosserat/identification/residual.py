"""A residual on an identified robot: learned through rollouts, kept only if held-out recordings improve.

Its parameters are further coordinates of the search that identified the robot, with normal priors. First, the
equations are linearised about the identified robot, to rank the parts of the residual and the widths of their
priors by the expected held-out error. Then each recording is held out in turn: a search over the others finds
robot and residual, and another finds a robot without a residual, for comparison.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.identification.experiments import Experiment
from knode_cosserat.identification.misfit import Misfit, Rollout
from knode_cosserat.identification.residual_model import ResidualModel
from knode_cosserat.identification.search import (
    FINE,
    Point,
    Problem,
    Search,
    SearchError,
    normal_equations,
)
from knode_cosserat.identification.selection import held_out
from knode_cosserat.identification.trials import failed_trial
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.passive import PARTS
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.space import SpaceScheme

#: widths of priors that are tried, as multiples of those in `residual_model`
TRIED = (0.3, 1.0, 3.0)
#: least expected reduction of the held-out cost by a part
PROMISE = 4.0
#: parts of the way to the residual that are tried beside all of it
SHRUNK = (0.5, 0.25)
#: most corrections of a search without one recording
FOLD = (5, 1e-2)
#: part by which a residual has to lower held-out errors on average, and standard errors of that average
LOWERS, ERRORS = 0.02, 2.0
#: part by which it may raise one of them
RAISES = 0.01
#: part of the measured positions that has to lie within the spread, and that of a normal distribution
LEVEL, NORMAL = 0.9, 1.645
#: an uncertainty is at most multiplied by this
MOST_INFLATED = 30.0


class PositionErrors(NamedTuple):
    """Root mean square errors of a recording's positions (m): of the last body, and of all."""

    tip: float
    bodies: float


@dataclasses.dataclass(frozen=True)
class LearnedResidual:
    """Result of the search for a residual.

    Attributes:
        robot: the identified robot, with the residual if it is kept.
        kept: true if the residual is kept.
        without: by recording, the held-out errors of the robot without a residual.
        with_residual: the same with it; empty if none was promising.
        steps: the steps of the search, in words.
        x: coordinates of robot and residual.
        covariance: covariance of the coordinates, widened until held-out recordings lie within the spread.
        model: the model that defines the coordinates.
    """

    robot: System
    kept: bool
    without: dict[str, PositionErrors]
    with_residual: dict[str, PositionErrors]
    steps: tuple[str, ...]
    x: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]
    model: ResidualModel

    def member(self, seed: int) -> System:
        """Return a random sample of the robots that agree with the recordings."""
        rng = np.random.default_rng(seed)
        values, vectors = np.linalg.eigh(self.covariance)
        drawn = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.normal(size=len(values)))
        low, high = self.model.bounds
        return self.model.robot(np.clip(self.x + drawn, low, high))


def learn_residual(
    model: ResidualModel, x: Float[np.ndarray, " m"], data: Sequence[Experiment], space: str | SpaceScheme,
    tell: Callable[[str], None],
) -> LearnedResidual:  # fmt: skip
    """Learn a residual on an identified robot from at least two recordings.

    Args:
        model: the robot with the residual.
        x: coordinates of all effects of the identified robot.
        data: recordings of one length.
        space: the scheme along the rod.
        tell: called with a line of progress.

    Raises:
        SearchError: the identified robot cannot be simulated.
    """
    misfit = Misfit(model, data)  # type: ignore[arg-type]  # it offers what a Model does
    begin = model.begun(x)
    rollouts = _solved(misfit, begin)
    search = Search(misfit, tell)
    misfit.differentiated(rollouts)
    scale = search.scales_of(rollouts)
    problem = normal_equations(rollouts, search.units(scale), search.thinned())
    point = Point(begin, scale, problem, problem, model.mask(()), search.prior)
    widths = promising(problem, begin, model)
    without = [_fold(search, point, k) for k in range(len(data))]
    before, steps = [each.errors for each in without], []
    tested: dict[float, list[PositionErrors]] = {}
    if not widths:
        steps.append("no part of a residual promises anything for held-out recordings")
    while widths:
        named = ", ".join(f"{part} x {width:g}" for part, width in widths.items())
        own = _with_widths(misfit, widths, tell)
        free = dataclasses.replace(point, free=model.mask(widths), prior=own.prior)
        folds = [_fold(own, free, k, from_=each.point.x) for k, each in enumerate(without) if each.point]
        tested = _in_parts(misfit, without, folds) if len(folds) == len(without) else {}
        part, words = _verdict(before, tested)
        steps.append(f"residual ({named}): {words}")
        tell(steps[-1])
        if part:
            learned = own.run(begin, free.free, None, *FINE, scale=scale)
            there = begin + part * (learned.x - begin)
            reason = failed_trial(model.robot(there), data, space)
            if reason is None:
                wide = _widened(learned, folds)
                return _learned(model, model.robot(there), data, before, tested[part], steps, there, wide)
            steps.append(f"not accepted: {reason}")
        widths = dict(list(widths.items())[: len(widths) // 2])
    alone = model.model.reduced(x, model.names)
    wide = _widened(point, without)
    return _learned(model, alone, data, before, tested.get(1.0), steps, begin, wide)


def _learned(
    model: ResidualModel, robot: System, data: Sequence[Experiment], before: Sequence[PositionErrors],
    after: Sequence[PositionErrors] | None, steps: list[str], x: np.ndarray, covariance: np.ndarray,
) -> LearnedResidual:  # fmt: skip
    names = [each.name for each in data]
    without, found = (dict(zip(names, each or (), strict=False)) for each in (before, after))
    return LearnedResidual(
        robot, isinstance(robot, KNODE), without, found, tuple(steps), x, covariance, model
    )


def _solved(misfit: Misfit, x: np.ndarray) -> list[Rollout]:
    found = misfit.differences(x)
    solved = [each for each in found if each is not None]
    if len(solved) < len(found):
        raise SearchError("the identified robot cannot be simulated")
    return solved


# parts that promise an improvement


class _Scaled(NamedTuple):
    """Members of a model that `held_out` uses."""

    bounds: tuple[np.ndarray, np.ndarray]


def promising(problem: Problem, x: Float[np.ndarray, " n"], model: ResidualModel) -> dict[str, float]:
    """Return the parts that promise a lower held-out cost, the most promising first, and their widths."""
    widths: dict[str, float] = {}
    cost = _promised(problem, x, model, widths)
    while True:
        options = [
            (_promised(problem, x, model, {**widths, part: width}), part, width)
            for part in PARTS
            if part not in widths
            for width in TRIED
        ]
        if not options or min(options)[0] > cost - PROMISE:
            return widths
        cost, part, width = min(options)
        widths[part] = width


def _promised(problem: Problem, x: np.ndarray, model: ResidualModel, widths: dict[str, float]) -> float:
    """Return the held-out cost, in coordinates in which all priors are alike."""
    by = np.ones(model.size)
    for part, width in widths.items():
        by[model.slice(part)] = width
    low, high = model.bounds
    scaled = problem._replace(gradient=problem.gradient * by, matrix=problem.matrix * np.outer(by, by))
    return held_out(scaled, x / by, model.mask(widths), _Scaled((low / by, high / by)))  # type: ignore[arg-type]


# acceptance


class _Fold(NamedTuple):
    """A search without one recording, and the errors of that recording.

    `over` are the differences of its positions, divided by the standard deviations of the search.
    """

    point: Point | None
    errors: PositionErrors
    over: Float[np.ndarray, " m"]


def _with_widths(misfit: Misfit, widths: dict[str, float], tell: Callable[[str], None]) -> Search:
    prior = np.ones(misfit.model.size)
    for part, width in widths.items():
        prior[misfit.model.slice(part)] = width**-2
    return Search(misfit, tell, prior)


def _fold(search: Search, point: Point, k: int, from_: Any = None) -> _Fold:
    """Leave recording k out."""
    begin = point if from_ is None else dataclasses.replace(point, x=from_)
    fold = search.without(begin, k, *FOLD)
    (found,) = [None] if fold is None else search.misfit.differences(fold.x, which=[k])
    if fold is None or found is None:
        return _Fold(None, PositionErrors(np.inf, np.inf), np.zeros(0))
    return _Fold(fold, _errors(found), _over_spread(found, fold))


def _in_parts(
    misfit: Misfit, without: Sequence[_Fold], folds: Sequence[_Fold]
) -> dict[float, list[PositionErrors]]:
    """Return the held-out errors of parts of the way from the robots without to those with a residual."""
    found: dict[float, list[PositionErrors]] = {1.0: [each.errors for each in folds]}
    for part in SHRUNK:
        found[part] = []
        for k, (one, other) in enumerate(zip(without, folds, strict=True)):
            if one.point is None or other.point is None:
                found[part].append(PositionErrors(np.inf, np.inf))
                continue
            x = one.point.x + part * (other.point.x - one.point.x)
            (rollout,) = misfit.differences(x, which=[k])
            found[part].append(PositionErrors(np.inf, np.inf) if rollout is None else _errors(rollout))
    return found


def _errors(found: Rollout) -> PositionErrors:
    square = np.sum(found.values.reshape(len(found.values), -1, 6)[..., :3] ** 2, axis=-1)
    return PositionErrors(float(np.sqrt(np.nanmean(square[:, -1]))), float(np.sqrt(np.nanmean(square))))


def _over_spread(found: Rollout, fold: Point) -> Float[np.ndarray, " m"]:
    bodies = (*found.values.shape[:1], -1, 6)
    values = found.values.reshape(bodies)[1:, :, :3]
    slopes = found.derivatives[fold.free].reshape(int(fold.free.sum()), *bodies)[:, 1:, :, :3]
    covariance = fold.covariance()[np.ix_(fold.free, fold.free)]
    spread = np.sqrt(np.einsum("i...,ij,j...->...", slopes, covariance, slopes))
    known = np.isfinite(values)
    return np.abs(values[known]) / np.maximum(spread[known], 1e-9)


def _verdict(
    without: Sequence[PositionErrors], tested: dict[float, list[PositionErrors]]
) -> tuple[float, str]:
    """Return the part of the residual that is kept, 0 for none, and why, in words.

    It must raise no held-out error, of tip or bodies, and lower them by more than two standard errors of
    their mean change, as an effect must.
    """
    best, gain, words = 0.0, 0.0, "not kept: a held-out recording cannot be simulated with it"
    for part, errors in tested.items():
        ratios = np.array(errors) / np.array(without)
        if not np.all(np.isfinite(ratios)):
            continue
        told = ", ".join(f"{100.0 * (ratio - 1.0):+.1f} %" for ratio in ratios[:, 0])
        changes = np.log(ratios).mean(axis=1)
        doubt = np.std(changes, ddof=1) / np.sqrt(len(changes)) if len(changes) > 1 else np.inf
        enough = np.mean(changes) < -max(LOWERS, ERRORS * doubt) and np.max(ratios) <= 1.0 + RAISES
        if not best and (part == 1.0 or enough):
            words = f"{'kept' if enough else 'not kept'}: held-out errors of the tip change by {told}"
        if enough and np.mean(changes) < gain:
            best, gain = part, float(np.mean(changes))
            words = f"kept by a part of {part:g}: held-out errors of the tip change by {told}"
    return best, words


def _widened(point: Point, folds: Sequence[_Fold]) -> Float[np.ndarray, "n n"]:
    """Return the covariance of the free coordinates, as wide as held-out positions are spread."""
    over = np.concatenate([each.over for each in folds])
    ratio = np.quantile(over, LEVEL) / NORMAL if len(over) else 1.0
    fixed = ~point.free
    covariance = point.covariance()
    covariance[fixed, :] = covariance[:, fixed] = 0.0
    return covariance * np.clip(ratio, 1.0, MOST_INFLATED) ** 2
