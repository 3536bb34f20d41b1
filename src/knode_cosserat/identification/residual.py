"""A residual on an identified robot, kept only if it predicts measured rows that were left out.

The robot stays as it is. First, motions or equilibria and their tangents by all learned numbers are computed
once, at the robot itself. With these linear equations, the parts of the residual and the widths of their
priors are ranked by the expected error of blocks of rows that are left out: recordings, or parts of them.
Then each block is left out in turn: Gauss-Newton steps find the residual from the other rows, and a
simulation with it predicts the block.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from knode_cosserat.estimation.parameters import RESIDUAL, Number, ParameterModel, PossibleEffect, Replace
from knode_cosserat.identification.experiments import Experiment
from knode_cosserat.identification.information import NormalEquations, normal_equations
from knode_cosserat.identification.journal import Journal, SearchError
from knode_cosserat.identification.misfit import Misfit, Rollout
from knode_cosserat.identification.search import ParameterSearch, Subset
from knode_cosserat.identification.trials import failed_trial
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.terms import terms
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.space import SpaceScheme

#: widths of priors that are tried, for learned numbers in their units
TRIED = (0.1, 0.3, 1.0, 3.0)
#: least expected reduction of the held-out cost by a part
PROMISE = 4.0
#: smallest remaining fraction of the cost in linearised predictions
LEAST_LEFT = 1e-3
#: blocks of rows that are left out in turn, if there are fewer recordings, and fewest rows of a block
BLOCKS, FEWEST = 6, 3
#: Gauss-Newton steps, parts of one that are tried, and the fall of the cost at the end
STEPS, PARTS, FALL = 4, (1.0, 0.5, 0.25), 1e-3
#: fractions of the residual that are tried
FRACTIONS = (1.0, 0.5)
#: part by which a residual has to lower held-out errors on average, and standard errors of that average
LOWERS, ERRORS = 0.02, 2.0
#: part by which it may raise the held-out error of a recording
RAISES = 0.01


def residual_model(robot: System, controls: Float[np.ndarray, "rows c"], moving: bool) -> ParameterModel:
    """Return a robot with a residual (`terms`); its parts are effects with names such as "residual.load"."""
    residual, effects = terms(robot, controls, moving), []
    for part, value in residual.coefficients().items():
        name, low = f"{RESIDUAL}.{part}", 0.0 if part == "damping" else -np.inf
        numbers = [Number(f"{name}[{k}]", "", 0.0, 1.0, low) for k in range(np.size(value))]
        effects.append(PossibleEffect(name, tuple(numbers), Replace((name,), "coefficients")))
    return ParameterModel(KNODE(robot, residual), effects)


@dataclasses.dataclass(frozen=True)
class LearnedResidual:
    """Result of the search for a residual.

    Attributes:
        robot: the robot, with the residual if it is kept.
        kept: true if the residual is kept.
        without: by block that was left out, the root mean square error of the robot without a residual: of
            the last body (m), or of all differences where no positions were measured.
        with_residual: the same with it; empty if it is not kept.
        steps: the steps of the search, in words.
    """

    robot: System
    kept: bool = False
    without: tuple[float, ...] = ()
    with_residual: tuple[float, ...] = ()
    steps: tuple[str, ...] = ()

    def held_out_error(self, data: Sequence[Experiment]) -> dict[str, float]:
        """Return the error with the residual of each recording whose blocks were left out, in turn (m)."""
        blocks, squares, count = blocks_of(data), np.zeros(len(data)), np.zeros(len(data))
        for block, error in zip(blocks, self.with_residual, strict=True):
            squares[block.experiment] += len(block.rows) * error**2
            count[block.experiment] += len(block.rows)
        errors = np.sqrt(squares / np.maximum(count, 1)).tolist()
        places = [it.positions(it.data) is not None for it in data]
        return {it.name: error for it, error, known in zip(data, errors, places, strict=True) if known}


def learn_residual(
    robot: System, data: Sequence[Experiment], space: str | SpaceScheme, journal: Journal
) -> LearnedResidual:
    """Learn a residual on a robot.

    Args:
        robot: the identified robot, or any system.
        data: experiments of recordings.
        space: the scheme along the rod, of trial simulations.
        journal: course of the search.

    Raises:
        SearchError: the robot cannot be simulated.
        OutOfTimeError: the deadline is over.
    """
    controls = np.concatenate([it.control for it in data])
    model = residual_model(robot, controls, not all(it.static for it in data))
    if not model.size:
        journal.step("nothing to learn: the system has neither controls nor bending stiffness")
        return LearnedResidual(robot, steps=tuple(journal.steps))
    if len(blocks_of(data)) < 2:
        journal.step(
            "no residual: nothing can be left out of one recording whose controls are related in all rows; "
            "give several"
        )
        return LearnedResidual(robot, steps=tuple(journal.steps))
    learner = _Learner.of(ParameterSearch(Misfit(model, data), journal))
    blocks = learner.blocks
    parts = ", ".join(map(_short, model.names))
    journal.tell(f"{model.size} numbers in {parts}; {len(blocks)} blocks of rows to leave out")
    widths = promising(learner.problem, model)
    without = [learner.error(learner.begun, block) for block in blocks]
    if not widths:
        journal.step("no residual: none of its parts promises a lower error of rows that are left out")
    chosen: _Tested | None = None
    for count in range(1, len(widths) + 1):
        some = dict(list(widths.items())[:count])
        tested = learner.tested(some, without)
        fraction, words = _verdict(blocks, without, tested.errors)
        journal.step(f"residual ({tested.words}): {words}")
        if fraction:
            tested = tested._replace(errors={fraction: tested.errors[fraction]})
            if chosen is None or tested.mean < chosen.mean:
                chosen = tested
    if chosen is not None:
        [(fraction, errors)] = chosen.errors.items()
        x = fraction * learner.searched(chosen.widths, blocks, "all")
        learned = model.reduced(x, model.names)
        learned = KNODE(learned.knowledge, learned.residual.clamped().pruned())
        # trials begin in an equilibrium; where the robot fails, too, the residual is not to blame
        trials = [it for it in data if it.held is not None]
        reason = failed_trial(learned, trials, space) if trials else None
        if reason is not None and failed_trial(robot, trials, space) is not None:
            journal.step(f"the robot fails with and without a residual: {reason}")
            reason = None
        if reason is None:
            if len(widths) > 1:
                journal.step(f"kept: {chosen.words}")
            return LearnedResidual(learned, True, tuple(without), tuple(errors), tuple(journal.steps))
        journal.step(f"not accepted: {reason}")
    return LearnedResidual(robot, False, tuple(without), (), tuple(journal.steps))


class _Tested(NamedTuple):
    """Parts of a residual with the widths of their priors, and held-out errors by fraction and block."""

    widths: dict[str, float]
    errors: dict[float, list[float]]

    @property
    def words(self) -> str:
        """The parts in words."""
        return ", ".join(f"{_short(part)} x {width:g}" for part, width in self.widths.items())

    @property
    def mean(self) -> float:
        """Mean error with the first fraction."""
        return float(np.mean(next(iter(self.errors.values()))))


def _short(part: str) -> str:
    """Return the name of a part in words."""
    return part.removeprefix(f"{RESIDUAL}.").removesuffix(".weights")


# blocks of rows


class Block(NamedTuple):
    """Rows of an experiment that are left out together."""

    experiment: int
    rows: Int[np.ndarray, " rows"]


def blocks_of(data: Sequence[Experiment]) -> list[Block]:
    """Return blocks of rows with data: whole recordings, or parts of these if they are few.

    A run of consecutive rows with related controls is not divided. Parts of motions are runs that follow one
    another, of equilibria any. A recording that is one run, such as a motion after a release, stays whole:
    its rows tell little of each other's errors.
    """
    several = max(1, -(-BLOCKS // len(data)))
    blocks = []
    for k, it in enumerate(data):
        rows = 1 + np.flatnonzero(np.isfinite(it.data[1:]).any(axis=1))
        run = np.arange(len(rows)) // _related(it)
        count = min(several, max(len(rows) // FEWEST, 1))
        part = run % count if it.static else run * count // (run[-1] + 1)
        blocks += [Block(k, rows[part == number]) for number in np.unique(part)]
    return blocks


def _related(data: Experiment) -> int:
    """Return the number of rows in which controls go half the way to unrelated ones."""
    control = data.control
    unrelated = 2.0 * np.sum(np.var(control / np.maximum(np.std(control, axis=0), 1e-300), axis=0))
    moved = control / np.maximum(np.std(control, axis=0), 1e-300)
    for lag in range(1, len(control)):
        if np.sum((moved[lag:] - moved[:-lag]) ** 2, axis=1).mean() >= 0.5 * unrelated > 0.0:
            return lag
    return len(control)


@dataclasses.dataclass
class _Learner:
    """Least squares for a residual, with the tangents at its begin."""

    search: ParameterSearch
    blocks: list[Block]
    #: rollouts without a residual, and their units
    begun: list[Rollout]
    units: list[np.ndarray]
    #: linear equations, a block each
    problem: NormalEquations

    @classmethod
    def of(cls, search: ParameterSearch) -> _Learner:
        """Compute the rollouts without a residual, and their tangents.

        Raises:
            SearchError: the robot cannot be simulated.
        """
        misfit, blocks = search.misfit, blocks_of(search.misfit.data)
        search.journal.tell("simulating the robot")
        begun = search.solved(np.zeros(misfit.model.size))
        if begun is None:
            raise SearchError("the robot cannot be simulated with these recordings")
        search.journal.tell("tangents by all numbers")
        misfit.differentiated(begun)
        units = search.units(search.scales_of(begun), begun)
        learner = cls(search, blocks, begun, units, NormalEquations(*np.zeros((4, 0))))
        learner.problem = learner.equations(begun, blocks)
        return learner

    def equations(self, rollouts: Sequence[Rollout], blocks: Sequence[Block]) -> NormalEquations:
        """Return the normal equations of blocks, with the tangents at the begin."""
        parts, units = [], []
        for block in blocks:
            begun, rollout = self.begun[block.experiment], rollouts[block.experiment]
            used = np.zeros(rollout.values.shape, dtype=bool)
            used[block.rows] = True
            parts.append(begun.moved(rollout.values - begun.plain).only(used))
            units.append(self.units[block.experiment])
        every = np.ones(self.search.misfit.model.size, dtype=bool)
        return normal_equations(parts, units, self.search.thinned(), every)

    def at(self, x: Float[np.ndarray, " n"]) -> list[Rollout] | None:
        """Return the rollouts with a residual, refined as those without."""
        return self.search.solved(x, Subset(), [it.offset for it in self.begun])

    def tested(self, widths: dict[str, float], without: Sequence[float]) -> _Tested:
        """Leave each block out of a search, and predict it."""
        journal, found = self.search.journal, _Tested(widths, {fraction: [] for fraction in FRACTIONS})
        journal.tell(f"trying {found.words}")
        for k, block in enumerate(self.blocks):
            others = [it for j, it in enumerate(self.blocks) if j != k]
            x = self.searched(widths, others, f"block {k + 1}")
            for fraction, errors in found.errors.items():
                rollouts = self.at(fraction * x)
                errors.append(np.inf if rollouts is None else self.error(rollouts, block))
            told = ", ".join(f"{1e3 * errors[-1]:.2f}" for errors in found.errors.values())
            journal.tell(f"block {k + 1} left out: {1e3 * without[k]:.2f} mm, with the residual {told} mm")
        return found

    def searched(
        self, widths: dict[str, float], blocks: Sequence[Block], name: str
    ) -> Float[np.ndarray, " n"]:
        """Return the residual that is learned from blocks, a search that is finished once only."""
        search = self.search

        def solve() -> dict[str, Any]:
            return {"x": self._descended(widths, blocks)}

        identity = [search.identity, name, repr(widths), *(it.rows for it in blocks)]
        return np.asarray(search.journal.finished(solve, *identity)["x"])

    def _descended(self, widths: dict[str, float], blocks: Sequence[Block]) -> Float[np.ndarray, " n"]:
        model = self.search.misfit.model
        by, free = np.ones(model.size), model.mask(f"{RESIDUAL}.{part}" for part in widths)
        for part, width in widths.items():
            by[model.slice(f"{RESIDUAL}.{part}")] = width
        x, rollouts = np.zeros(model.size), self.begun

        def cost_of(rollouts: Sequence[Rollout], x: np.ndarray) -> tuple[float, NormalEquations]:
            equations = self.equations(rollouts, blocks)
            return float(equations.cost.sum() + np.sum((x / by) ** 2)), equations

        cost, equations = cost_of(rollouts, x)
        for _ in range(STEPS):
            gradient, matrix = equations.gradient.sum(axis=0) * by, equations.matrix.sum(axis=0)
            move = by * _linear(x / by, free, gradient, matrix * np.outer(by, by), model.bounds / by)
            for share in PARTS:
                tried = self.at(x + share * move)
                if tried is None:
                    continue
                after, there = cost_of(tried, x + share * move)
                if after < cost:
                    break
            else:
                return x
            fall, x, cost, equations = cost - after, x + share * move, after, there
            if fall < FALL * cost:
                break
        return x

    def error(self, rollouts: Sequence[Rollout], block: Block) -> float:
        """Return the root mean square error of a block: of the last body's position (m), or of all."""
        rollout = rollouts[block.experiment]
        values = rollout.values * rollout.data.noise
        places = rollout.data.positions(values)
        squares = rollout.values**2 if places is None else np.sum(places[:, -1] ** 2, axis=-1)
        return float(np.sqrt(np.nanmean(squares[block.rows])))


# parts that promise an improvement


def promising(problem: NormalEquations, model: ParameterModel) -> dict[str, float]:
    """Return the parts that promise a lower held-out cost, the most promising first, and their widths."""

    def cost_of(widths: dict[str, float]) -> float:
        """Return the held-out cost, in coordinates in which all priors are alike."""
        by, names = np.ones(model.size), [f"{RESIDUAL}.{part}" for part in widths]
        for name, width in zip(names, widths.values(), strict=True):
            by[model.slice(name)] = width
        free = model.mask(names)
        scaled = NormalEquations(
            problem.cost,
            problem.amount,
            (problem.gradient * by)[:, free],
            (problem.matrix * np.outer(by, by))[:, free][:, :, free],
        )
        return held_out(scaled, (model.bounds / by)[:, free])

    widths: dict[str, float] = {}
    cost = cost_of(widths)
    while True:
        options = [
            (cost_of({**widths, part: width}), part, width)
            for part in (name.removeprefix(f"{RESIDUAL}.") for name in model.names)
            if part not in widths
            for width in TRIED
        ]
        if not options or min(options)[0] > cost - PROMISE:
            return widths
        cost, part, width = min(options)
        widths[part] = width


def held_out(problem: NormalEquations, bounds: Float[np.ndarray, "2 n"]) -> float:
    """Return the cost of blocks that were each left out of a search from zero, linearised there.

    It is -2 times the logarithm of the likelihood of differences of unknown size, by block.
    """
    gradient, matrix = problem.gradient.sum(axis=0), problem.matrix.sum(axis=0)
    begin, free = np.zeros(len(gradient)), np.ones(len(gradient), dtype=bool)
    total = 0.0
    for cost, amount, own, square in zip(*problem, strict=True):
        move = _linear(begin, free, gradient - own, matrix - square, bounds)
        after = max(cost + 2.0 * own @ move + move @ square @ move, LEAST_LEFT * cost)
        total += amount * np.log(after / amount) if cost > 0.0 else 0.0
    return float(total)


def _linear(
    x: Float[np.ndarray, " n"],
    free: Bool[np.ndarray, " n"],
    gradient: Float[np.ndarray, " n"],
    matrix: Float[np.ndarray, "n n"],
    bounds: Float[np.ndarray, "2 n"],
) -> Float[np.ndarray, " n"]:
    """Return the move to the least cost, with the prior, of the free numbers within their bounds."""
    move, (low, high) = np.zeros(len(x)), bounds
    active = free.copy()
    for _ in range(len(x)):
        where = np.ix_(active, active)
        right = (gradient + x + matrix @ np.where(active, 0.0, move))[active]
        move[active] = -np.linalg.solve(matrix[where] + np.eye(int(active.sum())), right)
        beyond = active & ((x + move < low - 1e-9) | (x + move > high + 1e-9))
        if not beyond.any():
            break
        move = np.where(beyond, np.clip(x + move, low, high) - x, move)
        active &= ~beyond
    return move


# acceptance


def _verdict(
    blocks: Sequence[Block], without: Sequence[float], tested: dict[float, list[float]]
) -> tuple[float, str]:
    """Return the fraction of the residual that is kept, 0 for none, and the reason in words.

    It must raise the held-out error of no recording, and lower the errors of blocks by more than two standard
    errors of their mean change, as an effect must.
    """
    count = np.array([len(block.rows) for block in blocks])
    recording = np.array([block.experiment for block in blocks])
    words = ""
    for fraction, after in tested.items():
        change = np.array(after) / np.maximum(without, 1e-12) - 1.0
        if not np.isfinite(change).all():
            words = words or "not kept: it cannot be simulated for a block that was left out"
            continue
        mean = float(np.mean(change))
        spread = float(np.std(change, ddof=1) / np.sqrt(len(change))) if len(change) > 1 else np.inf
        raised = max(
            np.sqrt(np.sum((count * np.square(after))[of]) / np.sum((count * np.square(without))[of])) - 1.0
            for of in (recording == k for k in np.unique(recording))
        )
        told = f"held-out errors change by {100 * mean:+.1f} % ± {100 * spread:.1f} %"
        if raised <= RAISES and mean < -max(LOWERS, ERRORS * spread):
            return fraction, told if fraction == 1.0 else f"kept by a part of {fraction:g}: {told}"
        words = words or f"not kept: {told}"
    return 0.0, words
