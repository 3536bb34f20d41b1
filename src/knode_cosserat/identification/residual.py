"""A residual on an identified robot: learned through rollouts, kept only if held-out recordings improve.

Its parameters are further coordinates of the search that identified the robot, with normal priors. First, the
equations are linearised about the identified robot, to rank the parts of the residual and the widths of their
priors by the expected held-out error. Then each recording is held out in turn: a search over the others finds
robot and residual, and another finds a robot without a residual, for comparison.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.estimation.parameters import RESIDUAL, Number, ParameterModel, PossibleEffect, Replace
from knode_cosserat.identification.experiments import Experiment
from knode_cosserat.identification.information import NormalEquations, normal_equations
from knode_cosserat.identification.journal import Journal, SearchError
from knode_cosserat.identification.misfit import Misfit, Rollout
from knode_cosserat.identification.search import FINE, ParameterSearch, SearchEnd, Subset
from knode_cosserat.identification.trials import failed_trial
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.passive import PARTS, POSITIVE, Passive
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.space import SpaceScheme

#: standard deviation of a number's prior, by the part of the residual
WIDTHS = {"stiffness": 0.2, "levers": 0.3, "energy": 0.2, "damping": 1.0, "dissipation": 1.0}
#: widths of priors that are tried, as multiples of `WIDTHS`
TRIED = (0.3, 1.0, 3.0)
#: least expected reduction of the held-out cost by a part
PROMISE = 4.0
#: smallest remaining fraction of the cost in linearised predictions
LEAST_LEFT = 1e-3
#: fractions of the residual that are tried beside all of it
SHRUNK = (0.5, 0.25)
#: evaluations of a search without one recording, and the fall of the cost at its end
FOLD = (5, 1e-2)
#: part by which a residual has to lower held-out errors on average, and standard errors of that average
LOWERS, ERRORS = 0.02, 2.0
#: part by which it may raise one of them
RAISES = 0.01
#: part of the measured positions that has to lie within the spread, and that of a normal distribution
LEVEL, NORMAL = 0.9, 1.645
#: an uncertainty is at most multiplied by this
MOST_INFLATED = 30.0


@dataclasses.dataclass(frozen=True)
class _OfKnowledge:
    """A change of the nominal model within a KNODE."""

    change: Callable[..., Any]

    def __call__(self, model: KNODE, *values: Any) -> KNODE:
        return model.around(self.change(model.knowledge, *values))


def residual_model(
    model: ParameterModel, names: Sequence[str], residual: Passive, widths: Mapping[str, float] = WIDTHS
) -> ParameterModel:
    """Return a model of the named effects, followed by the parts of a residual whose numbers are all zero.

    Args:
        model: the robot with its effects.
        names: the identified effects.
        residual: the residual; its parts are effects with names such as "residual.damping".
        widths: standard deviations of the priors of the residual's numbers, by part.
    """
    effects = [
        dataclasses.replace(it, change=_OfKnowledge(it.change), part=it.part and _OfKnowledge(it.part))
        for it in model.effects
        if it.name in names
    ]
    for part, value in residual.coefficients().items():
        name, low = f"{RESIDUAL}.{part}", 0.0 if part in POSITIVE else -np.inf
        numbers = [Number(f"{name}[{k}]", "", 0.0, widths[part], low) for k in range(np.size(value))]
        effects.append(PossibleEffect(name, tuple(numbers), Replace((name,), "coefficients")))
    return ParameterModel(KNODE(model.nominal, residual), effects)


class PositionErrors(NamedTuple):
    """Root mean square errors of a recording's positions (m): of the last body, and of all."""

    tip: float
    bodies: float


FAILED = PositionErrors(np.inf, np.inf)


@dataclasses.dataclass(frozen=True)
class LearnedResidual:
    """Result of the search for a residual.

    Attributes:
        model: the model that defines the coordinates.
        x: coordinates of robot and residual.
        covariance: covariance of the coordinates, widened until held-out recordings lie within the spread.
        kept: true if the residual is kept.
        without: by recording, the held-out errors of the robot without a residual.
        with_residual: the same with it; empty if no part was promising.
        steps: the steps of the search, in words.
    """

    model: ParameterModel
    x: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]
    kept: bool = True
    without: Mapping[str, PositionErrors] = dataclasses.field(default_factory=dict)
    with_residual: Mapping[str, PositionErrors] = dataclasses.field(default_factory=dict)
    steps: tuple[str, ...] = ()

    @property
    def robot(self) -> System:
        """The identified robot, with the residual if it is kept."""
        if self.kept:
            return self.model.robot(self.x)
        identified = [name for name in self.model.names if not name.startswith(RESIDUAL)]
        return self.model.reduced(self.x, identified).knowledge

    def member(self, seed: int) -> System:
        """Return a random sample of the robots that agree with the recordings."""
        rng = np.random.default_rng(seed)
        values, vectors = np.linalg.eigh(self.covariance)
        drawn = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.normal(size=len(values)))
        return self.model.robot(np.clip(self.x + drawn, *self.model.bounds))


def learn_residual(
    model: ParameterModel,
    begin: Float[np.ndarray, " n"],
    data: Sequence[Experiment],
    space: str | SpaceScheme,
    journal: Journal,
) -> LearnedResidual:
    """Learn a residual on an identified robot from at least two recordings.

    Args:
        model: the robot with the residual (`residual_model`).
        begin: coordinates of the identified robot without a residual.
        data: recordings of one length.
        space: the scheme along the rod.
        journal: course of the search.

    Raises:
        SearchError: the identified robot cannot be simulated.
    """
    misfit = Misfit(model, data)
    search = ParameterSearch(misfit, journal)
    rollouts = search.solved(begin)
    if rollouts is None:
        raise SearchError("the identified robot cannot be simulated")
    misfit.differentiated(rollouts)
    scale = search.scales_of(rollouts)
    problem = normal_equations(
        rollouts, search.units(scale, rollouts), search.thinned(), np.ones(model.size, dtype=bool)
    )
    identified = [name for name in model.names if not name.startswith(RESIDUAL)]
    point = SearchEnd(begin, scale, problem, model.mask(identified), search.prior)
    widths = promising(problem, begin, model)
    without = [_fold(search, point, k) for k in range(len(data))]
    before = [fold.errors for fold in without]
    recordings = [experiment.name for experiment in data]
    tested: dict[float, list[PositionErrors]] = {}

    def learned(x: np.ndarray, end: SearchEnd, folds: Sequence[_Fold], fraction: float) -> LearnedResidual:
        """Return the result with this fraction of the residual; 0: without."""
        after = tested.get(fraction or 1.0, ())
        without_it, with_it = (dict(zip(recordings, it, strict=False)) for it in (before, after))
        covariance = _widened(end, folds)
        return LearnedResidual(
            model, x, covariance, fraction > 0.0, without_it, with_it, tuple(journal.steps)
        )

    if not widths:
        journal.step("no part of a residual promises a lower error of held-out recordings")
    while widths:
        prior = np.ones(model.size)
        for part, width in widths.items():
            prior[model.slice(f"{RESIDUAL}.{part}")] = width**-2
        wider = ParameterSearch(misfit, journal, prior)
        mask = model.mask([*identified, *(f"{RESIDUAL}.{part}" for part in widths)])
        free = dataclasses.replace(point, free=mask, prior=wider.prior)
        folds = [
            _fold(wider, dataclasses.replace(free, x=fold.point.x), k)
            for k, fold in enumerate(without)
            if fold.point
        ]
        tested = _shrunk_errors(search, without, folds) if len(folds) == len(without) else {}
        fraction, words = _verdict(before, tested)
        listed = ", ".join(f"{part} x {width:g}" for part, width in widths.items())
        journal.step(f"residual ({listed}): {words}")
        if fraction:
            end = wider.run(begin, mask, effort=FINE, scale=scale)
            x = begin + fraction * (end.x - begin)
            reason = failed_trial(model.robot(x), data, space)
            if reason is None:
                return learned(x, end, folds, fraction)
            journal.step(f"not accepted: {reason}")
        widths = dict(list(widths.items())[: len(widths) // 2])
    return learned(begin, point, without, 0.0)


# parts that promise an improvement


def promising(
    problem: NormalEquations, x: Float[np.ndarray, " n"], model: ParameterModel
) -> dict[str, float]:
    """Return the parts that promise a lower held-out cost, the most promising first, and their widths."""
    identified = [name for name in model.names if not name.startswith(RESIDUAL)]

    def cost_of(widths: dict[str, float]) -> float:
        """Return the held-out cost, in coordinates in which all priors are alike."""
        by, names = np.ones(model.size), [f"{RESIDUAL}.{part}" for part in widths]
        for name, width in zip(names, widths.values(), strict=True):
            by[model.slice(name)] = width
        scaled = problem._replace(gradient=problem.gradient * by, matrix=problem.matrix * np.outer(by, by))
        return held_out(scaled, x / by, model.mask([*identified, *names]), model.bounds / by)

    widths: dict[str, float] = {}
    cost = cost_of(widths)
    while True:
        options = [
            (cost_of({**widths, part: width}), part, width)
            for part in PARTS
            if part not in widths
            for width in TRIED
        ]
        if not options or min(options)[0] > cost - PROMISE:
            return widths
        cost, part, width = min(options)
        widths[part] = width


def held_out(
    problem: NormalEquations,
    x: Float[np.ndarray, " n"],
    free: Bool[np.ndarray, " n"],
    bounds: Float[np.ndarray, "2 n"],
) -> float:
    """Return the cost of recordings that were each left out of a search, linearised about a point.

    It is -2 times the logarithm of the likelihood of differences of unknown size, by recording. Parameters
    that are not free are nominal.
    """
    total = 0.0
    for k, move in enumerate(_moves(problem, x, free, bounds)):
        cost = problem.cost[k] + 2.0 * problem.gradient[k] @ move + move @ problem.matrix[k] @ move
        total += problem.amount[k] * np.log(max(cost, LEAST_LEFT * problem.cost[k]) / problem.amount[k])
    return float(total)


def _moves(
    problem: NormalEquations,
    x: Float[np.ndarray, " n"],
    free: Bool[np.ndarray, " n"],
    bounds: Float[np.ndarray, "2 n"],
) -> list[Float[np.ndarray, " n"]]:
    """Return the moves of searches that leave out one part each, linearised about a point."""
    count = len(problem.cost)
    moves = []
    for k in range(count):
        others = [j for j in range(count) if j != k] or [k]
        gradient, matrix = problem.gradient[others].sum(axis=0), problem.matrix[others].sum(axis=0)
        moves.append(_linear(x, free, gradient, matrix, bounds))
    return moves


def _linear(
    x: np.ndarray, free: np.ndarray, gradient: np.ndarray, matrix: np.ndarray, bounds: np.ndarray
) -> np.ndarray:
    """Return the move to the least cost, with the prior, of the free numbers within their bounds."""
    fixed, (low, high) = np.where(free, 0.0, -x), bounds
    active = free.copy()
    for _ in range(len(x)):
        where = np.ix_(active, active)
        right = gradient[active] + (matrix @ fixed)[active] + x[active]
        move = fixed.copy()
        move[active] = -np.linalg.solve(matrix[where] + np.eye(int(active.sum())), right)
        beyond = active & ((x + move < low - 1e-9) | (x + move > high + 1e-9))
        if not beyond.any():
            return move
        fixed = np.where(beyond, np.clip(x + move, low, high) - x, fixed)
        active &= ~beyond
    return fixed


# acceptance


class _Fold(NamedTuple):
    """A search without one recording, and the errors of that recording.

    `over` are the differences of its positions, divided by the standard deviations of the search.
    """

    point: SearchEnd | None
    errors: PositionErrors
    over: Float[np.ndarray, " m"]


def _fold(search: ParameterSearch, point: SearchEnd, k: int) -> _Fold:
    """Leave recording k out."""
    end = search.without(point, k, FOLD)
    rollouts = None if end is None else search.solved(end.x, Subset(None, [k]))
    if end is None or rollouts is None:
        return _Fold(None, FAILED, np.zeros(0))
    values, bodies = rollouts[0].values, (len(rollouts[0].values), -1, 6)
    off = values.reshape(bodies)[1:, :, :3]
    slopes = rollouts[0].derivatives_by(end.free).reshape(int(end.free.sum()), *bodies)[:, 1:, :, :3]
    covariance = end.covariance()[np.ix_(end.free, end.free)]
    spread = np.sqrt(np.einsum("i...,ij,j...->...", slopes, covariance, slopes))
    known = np.isfinite(off)
    return _Fold(end, _errors(rollouts[0]), np.abs(off[known]) / np.maximum(spread[known], 1e-9))


def _errors(rollout: Rollout) -> PositionErrors:
    square = np.sum(rollout.values.reshape(len(rollout.values), -1, 6)[..., :3] ** 2, axis=-1)
    return PositionErrors(float(np.sqrt(np.nanmean(square[:, -1]))), float(np.sqrt(np.nanmean(square))))


def _shrunk_errors(
    search: ParameterSearch, without: Sequence[_Fold], folds: Sequence[_Fold]
) -> dict[float, list[PositionErrors]]:
    """Return the held-out errors with fractions of the residual."""
    errors = {1.0: [fold.errors for fold in folds]}
    for fraction in SHRUNK:
        errors[fraction] = []
        for k, (one, other) in enumerate(zip(without, folds, strict=True)):
            rollouts = None
            if one.point is not None and other.point is not None:
                x = one.point.x + fraction * (other.point.x - one.point.x)
                rollouts = search.solved(x, Subset(None, [k]))
            errors[fraction].append(FAILED if rollouts is None else _errors(rollouts[0]))
    return errors


def _verdict(
    without: Sequence[PositionErrors], tested: dict[float, list[PositionErrors]]
) -> tuple[float, str]:
    """Return the fraction of the residual that is kept, 0 for none, and the reason in words.

    It must raise no held-out error, of tip or bodies, and lower them by more than two standard errors of
    their mean change, as an effect must.
    """
    best, gain, words = 0.0, 0.0, "not kept: a held-out recording cannot be simulated with it"
    for part, errors in tested.items():
        ratios = np.array(errors) / np.array(without)
        if not np.all(np.isfinite(ratios)):
            continue
        text = ", ".join(f"{100.0 * (ratio - 1.0):+.1f} %" for ratio in ratios[:, 0])
        changes = np.log(ratios).mean(axis=1)
        doubt = np.std(changes, ddof=1) / np.sqrt(len(changes)) if len(changes) > 1 else np.inf
        enough = np.mean(changes) < -max(LOWERS, ERRORS * doubt) and np.max(ratios) <= 1.0 + RAISES
        if not best and (part == 1.0 or enough):
            words = f"{'kept' if enough else 'not kept'}: held-out errors of the tip change by {text}"
        if enough and np.mean(changes) < gain:
            best, gain = part, float(np.mean(changes))
            words = f"kept by a part of {part:g}: held-out errors of the tip change by {text}"
    return best, words


def _widened(point: SearchEnd, folds: Sequence[_Fold]) -> Float[np.ndarray, "n n"]:
    """Return the covariance of the free coordinates, as wide as held-out positions are spread."""
    over = np.concatenate([fold.over for fold in folds])
    ratio = np.quantile(over, LEVEL) / NORMAL if len(over) else 1.0
    fixed = ~point.free
    covariance = point.covariance()
    covariance[fixed, :] = covariance[:, fixed] = 0.0
    return covariance * np.clip(ratio, 1.0, MOST_INFLATED) ** 2
