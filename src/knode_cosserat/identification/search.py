"""Robust least squares with priors, over horizons that grow."""

from __future__ import annotations

import dataclasses
import itertools
import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.identification.journal import Journal, hashed, identity
from knode_cosserat.identification.misfit import Misfit, Rollout

log = logging.getLogger(__name__)

#: horizons (s) after the first motion; with all rows at once, a search from a poor nominal robot may fail
HORIZONS = (0.0, 0.2, 0.4, 0.7, 1.1, 1.7, 2.5, 4.0)
#: correlation time of differences (s): rows within it count as one
CORRELATED = 0.25
#: largest number of independent bodies
BODIES = 2.0
#: threshold of the Huber loss, in units of the scale
ROBUST = 3.0
#: smallest scale of the differences, as a fraction of the length
LEAST_SCALE = 5e-4
#: largest change of a coordinate in one correction
LARGEST_MOVE = 1.0
#: number of held-out pieces of a single recording
FOLDS = 5
#: duration of the blocks (s) for the scatter of an effect's improvement; at least two blocks
BLOCK = 1.0
#: corrections of a search at one horizon, and of the last one; parts by which the cost falls at their end
ROUGH, FINE = (6, 2e-2), (25, 1e-3)
#: failed tries of one correction
TRIES = 7


class Problem(NamedTuple):
    """Normal equations at a point: robust cost, gradient and Gauss-Newton matrix of each recording."""

    cost: Float[np.ndarray, " R"]
    #: number of independent differences
    amount: Float[np.ndarray, " R"]
    gradient: Float[np.ndarray, "R n"]
    matrix: Float[np.ndarray, "R n n"]


@dataclasses.dataclass(frozen=True)
class Point:
    """End of a search: coordinates, scales of the differences (m), and the normal equations there."""

    x: Float[np.ndarray, " n"]
    scale: Float[np.ndarray, " R"]
    #: rows of each part that is left out together, and of the blocks of each part (equally many), in order
    problem: Problem
    blocks: Problem
    free: Bool[np.ndarray, " n"]
    #: precision of each coordinate's prior
    prior: Float[np.ndarray, " n"]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return its arrays by name, for a file."""
        found = {name: getattr(self, name) for name in ("x", "scale", "free", "prior")}
        for name in ("problem", "blocks"):
            found |= {f"{name}.{part}": array for part, array in getattr(self, name)._asdict().items()}
        return found

    @classmethod
    def of(cls, arrays: dict[str, np.ndarray]) -> Self:
        """Return the point of these arrays: the inverse of `arrays`."""
        problem, blocks = (
            Problem(**{part: arrays[f"{name}.{part}"] for part in Problem._fields})
            for name in ("problem", "blocks")
        )
        return cls(arrays["x"], arrays["scale"], problem, blocks, arrays["free"], arrays["prior"])

    @property
    def cost(self) -> float:
        """Robust cost with the prior."""
        return float(self.problem.cost.sum() + np.sum(self.prior * self.x**2))

    def covariance(self) -> Float[np.ndarray, "n n"]:
        """Return the covariance of the coordinates, of the prior where nothing is known or searched."""
        free, full = self.free, np.diag(1.0 / self.prior)
        matrix = self.problem.matrix.sum(axis=0)[np.ix_(free, free)] + np.diag(self.prior[free])
        full[np.ix_(free, free)] = np.linalg.inv(matrix)
        return full


def huber(values: Float[np.ndarray, " m"]) -> tuple[np.ndarray, np.ndarray]:
    """Return Huber's cost of scaled differences, and their weights."""
    size = np.abs(values)
    weights = np.where(size <= ROBUST, 1.0, ROBUST / np.maximum(size, ROBUST))
    return np.where(size <= ROBUST, values**2, 2.0 * ROBUST * size - ROBUST**2), weights


def normal_equations(
    rollouts: Sequence[Rollout], scales: Float[np.ndarray, " R"], thinned: float,
    folds: Sequence[Any] = (slice(None),),
) -> Problem:  # fmt: skip
    """Return the normal equations, of each fold of each recording; a difference counts 1 / `thinned`."""
    parts = []
    pieces = [
        (_rows(rollout, fold), scale)
        for rollout, scale in zip(rollouts, scales, strict=True)
        for fold in folds
    ]
    for rollout, scale in pieces:
        known = np.isfinite(rollout.values)
        values = rollout.values[known] / scale
        cost, weights = huber(values)
        n = 0 if rollout.derivatives is None else len(rollout.derivatives)
        gradient, matrix = np.zeros(n), np.zeros((n, n))
        if rollout.derivatives is not None:
            slopes = rollout.derivatives[:, known] / scale
            weighted = slopes * weights
            gradient, matrix = weighted @ values, weighted @ slopes.T
        parts.append((cost.sum() / thinned, known.sum() / thinned, gradient / thinned, matrix / thinned))
    return Problem(*(np.array(part) for part in zip(*parts, strict=True)))


def _rows(rollout: Rollout, fold: Any) -> Rollout:
    slopes = rollout.derivatives
    return Rollout(rollout.values[fold], None if slopes is None else slopes[:, fold])


def scales_of(rollouts: Sequence[Rollout], length: float) -> Float[np.ndarray, " R"]:
    """Return the usual size of the differences of each recording (m).

    Each recording is weighted by its residual, so one that cannot be explained does not spoil the others.
    """
    known = [rollout.values[np.isfinite(rollout.values)] for rollout in rollouts]
    return np.array([max(1.4826 * float(np.median(np.abs(v))), LEAST_SCALE * length) for v in known])


class Search:
    """Searches coordinates of a model from recordings.

    Args:
        misfit: the recordings and the model.
        tell: called with a line of progress.
        prior: precision of each coordinate's prior, about zero; by default 1.
        journal: where the ends of finished searches are kept, and looked up.
    """

    def __init__(
        self, misfit: Misfit, tell: Callable[[str], None] = lambda line: None,
        prior: Float[np.ndarray, " n"] | None = None, journal: Journal | None = None,
    ):  # fmt: skip
        self.misfit, self.tell, self.journal = misfit, tell, journal
        self.prior = np.ones(misfit.model.size) if prior is None else prior
        self._identity = "" if journal is None else identity(misfit, self.prior)
        self.length = float(misfit.model.nominal.length)
        self.low, self.high = misfit.model.bounds

    @property
    def folds(self) -> list[slice]:
        """Rows that are left out together: of a recording that is alone, one piece after the other."""
        first = self.misfit.data[0]
        if len(self.misfit.data) > 1:
            return [slice(None)]
        if first.static:
            return [slice(k, None, FOLDS) for k in range(FOLDS)]
        edges = np.linspace(0, len(first.tension) + 1, FOLDS + 1).astype(int)
        return [slice(low, high) for low, high in itertools.pairwise(edges)]

    def blocks(self, count: int) -> list[Int[np.ndarray, " m"]]:
        """Return which of so many rows are in the blocks of each fold, one fold after the other."""
        first = self.misfit.data[0]
        rows = [np.arange(count)[fold] for fold in self.folds]
        pieces = FOLDS if first.static else max(2, round(min(map(len, rows)) * first.dt / BLOCK))
        return [block for each in rows for block in np.array_split(each, pieces)]

    def thinned(self) -> float:
        """Return how many differences count as one: they are correlated in time, and between bodies."""
        data = self.misfit.data[0]
        bodies = max(1.0, data.position.shape[1] / BODIES)
        return max(1.0, CORRELATED / data.dt) * bodies

    def from_far(self, free: Bool[np.ndarray, " n"]) -> Point:
        """Return the end of a search from the nominal robot, over horizons that grow.

        Raises:
            SearchError: the nominal robot cannot be simulated, not even at rest.
        """
        x = np.where(free, self.misfit.model.begin, 0.0)
        data = self.misfit.data
        longest = max(len(each.tension) - each.moves for each in data) * data[0].dt
        wound = {"reel", "motor"} & {*self.misfit.model.nominal.control_layout.names}
        if data[0].static or wound:
            # rows are independent of each other, and wound-up lengths keep the search near the solution
            longest = 0.0
        for horizon in [h for h in HORIZONS if h < 0.8 * longest]:
            rows = round(horizon / data[0].dt)
            x = self.run(x, free, rows, *ROUGH).x
        return self.run(x, free, None, *FINE)

    def run(
        self, x: Float[np.ndarray, " n"], free: Bool[np.ndarray, " n"], rows: int | None = None,
        most: int = FINE[0], fall: float = FINE[1], which: Sequence[int] | None = None,
        scale: Float[np.ndarray, " R"] | None = None,
    ) -> Point:  # fmt: skip
        """Return the end of a search (Levenberg-Marquardt) from a point, by some recordings and rows.

        Raises:
            SearchError: the robot at that point cannot be simulated.
        """
        if self.journal is None:
            return self._searched(x, free, rows, most, fall, which, scale)
        given = repr((rows, most, fall, None if which is None else tuple(which), scale is None))
        key = hashed(self._identity, given, x, free, np.zeros(0) if scale is None else scale)
        kept = self.journal.load(key)
        if kept is None:
            try:
                kept = self._searched(x, free, rows, most, fall, which, scale).arrays()
            except SearchError as error:
                kept = {"failed": np.array(str(error))}
            self.journal.save(key, kept)
        if "failed" in kept:
            raise SearchError(str(kept["failed"]))
        return Point.of(kept)

    def without(self, point: Point, k: int, most: int, fall: float) -> Point | None:
        """Return the end of a search from a point without recording k; None if it fails.

        A recording that is alone is kept.
        """
        others = [j for j in range(len(self.misfit.data)) if j != k] or [k]
        try:
            return self.run(point.x, point.free, None, most, fall, others, point.scale[others])
        except SearchError:
            return None

    def _searched(
        self, x: Float[np.ndarray, " n"], free: Bool[np.ndarray, " n"], rows: int | None, most: int,
        fall: float, which: Sequence[int] | None, scale: Float[np.ndarray, " R"] | None,
    ) -> Point:  # fmt: skip
        now = self._solved(x, rows, which)
        if now is None:
            raise SearchError("the robot that the search begins from cannot be simulated")
        fixed = scale
        damping = 1e-3
        for k in range(most):
            scale = scales_of(now, self.length) if fixed is None else fixed
            problem = normal_equations(now, scale, self.thinned())
            cost = problem.cost.sum() + np.sum(self.prior * x**2)
            step = self._correction(x, free, problem, cost, scale, damping, rows, which)
            if step is None:
                break
            there, damping, lower = step
            again = self._solved(there, rows, which)
            if again is None:  # recovery has its time, and a busy machine gets less done in it
                break
            x, now = there, again
            sizes = ", ".join(f"{1e3 * size:.2f}" for size in scales_of(now, self.length))
            self.tell(f"{'all rows' if rows is None else f'{rows} rows'}, correction {k + 1}: {sizes} mm")
            if cost - lower < fall * cost:
                break
        scale = scales_of(now, self.length) if fixed is None else fixed
        # a short horizon has fewer rows of a recording that rests for less time
        rows_of_all = min(len(each.values) for each in now)
        blocks = normal_equations(now, scale, self.thinned(), self.blocks(rows_of_all))
        parts = len(now) * len(self.folds)
        problem = Problem(*(each.reshape(parts, -1, *each.shape[1:]).sum(axis=1) for each in blocks))
        return Point(x, scale, problem, blocks, free, self.prior)

    def _solved(self, x: np.ndarray, rows: int | None, which: Sequence[int] | None) -> list[Rollout] | None:
        found = self.misfit.differences(x, rows, which)
        return None if any(each is None for each in found) else found  # type: ignore[return-value]

    def _correction(
        self, x: np.ndarray, free: np.ndarray, problem: Problem, cost: float, scale: np.ndarray,
        damping: float, rows: int | None, which: Sequence[int] | None,
    ) -> tuple[np.ndarray, float, float] | None:  # fmt: skip
        """Return a better point, the next damping and its cost; None if none was found."""
        gradient = problem.gradient.sum(axis=0) + self.prior * x
        matrix = problem.matrix.sum(axis=0) + np.diag(self.prior)
        for _ in range(TRIES):
            there = self._proposed(x, free, gradient, matrix, damping)
            tried = self.misfit.differences(there, rows, which, derivatives=False)
            if all(each is not None for each in tried):
                found = [each for each in tried if each is not None]
                lower = normal_equations(found, scale, self.thinned()).cost.sum()
                lower = lower + np.sum(self.prior * there**2)
                if lower < cost:
                    return there, max(damping / 10.0, 1e-6), float(lower)
            damping = max(damping, 1e-4) * 8.0
        return None

    def _proposed(
        self, x: np.ndarray, free: np.ndarray, gradient: np.ndarray, matrix: np.ndarray, damping: float
    ) -> np.ndarray:
        """Return the point of a damped correction; coordinates that meet a bound stay there."""
        active = free.copy()
        move = np.zeros(len(x))
        for _ in range(len(x)):
            where = np.ix_(active, active)
            damped = matrix[where] + damping * np.diag(np.diag(matrix)[active])
            move = np.zeros(len(x))
            move[active] = -np.linalg.solve(damped, gradient[active])
            out = active & (((x <= self.low) & (move < 0.0)) | ((x >= self.high) & (move > 0.0)))
            if not out.any():
                break
            active &= ~out
        longest = np.max(np.abs(move))
        move = move / max(1.0, longest / LARGEST_MOVE)
        return np.clip(x + move, self.low, self.high)


class SearchError(KnodeCosseratError, RuntimeError):
    """A search cannot go on; one line says why."""

    code = "search"
