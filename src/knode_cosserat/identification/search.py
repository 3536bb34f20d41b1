"""Robust least squares with priors, over horizons that grow.

The one objective of identification: differences of rollouts, in units of their usual size by experiment and
field, by Huber's loss, and priors of the numbers. `scipy.optimize.least_squares` minimises it.
"""

from __future__ import annotations

import dataclasses
import itertools
import logging
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.identification.experiments import Experiment
from knode_cosserat.identification.journal import Journal, hashed, identity
from knode_cosserat.identification.misfit import Misfit, Rollout

log = logging.getLogger(__name__)

#: parts of the longest motion over which preliminary searches go; with all rows at once, a search from a poor
#: nominal robot may fail
HORIZONS = (0.0, 1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2)
#: correlation time of differences from real data (s): rows within it count as one
CORRELATED = 0.25
#: largest number of independent bodies
BODIES = 2.0
#: threshold of the Huber loss, in units of the scale
ROBUST = 3.0
#: smallest scale of the differences: as a fraction of the length where a model with priors is not exact, and
#: of natural sizes otherwise, ten times the solver's tolerance
LEAST_SCALE, LEAST = 5e-4, 1e-9
#: the scale is at least this part of the root mean square: fields may be zero in most rows
OF_ALL = 0.2
#: number of held-out pieces of a single recording
FOLDS = 5
#: duration of the blocks (s) for the scatter of an effect's improvement; at least two blocks
BLOCK = 1.0
#: evaluations of a search at one horizon, and of the last one; parts by which the cost falls at their end
ROUGH, FINE = (6, 2e-2), (25, 1e-3)
#: the same without priors, where a start may be far
FIRST, EXACT = (50, 1e-5), (100, 1e-10)
#: evaluations with one scale where there are priors, most updates of the scale, and its relative change at
#: the end
PASS, PASSES, SETTLED = 5, 8, 0.05
METHOD: Literal["trf"] = "trf"


class Problem(NamedTuple):
    """Normal equations at a point: robust cost, gradient and Gauss-Newton matrix of each recording."""

    cost: Float[np.ndarray, " R"]
    #: number of independent differences
    amount: Float[np.ndarray, " R"]
    gradient: Float[np.ndarray, "R n"]
    matrix: Float[np.ndarray, "R n n"]


@dataclasses.dataclass(frozen=True)
class Point:
    """End of a search: coordinates, scales of the differences, and the normal equations there."""

    x: Float[np.ndarray, " n"]
    #: by experiment and field; of poses in m
    scale: Float[np.ndarray, "R G"]
    #: rows of each part that is left out together, and of the blocks of each part (equally many), in order
    problem: Problem
    blocks: Problem
    free: Bool[np.ndarray, " n"]
    #: precision of each coordinate's prior
    prior: Float[np.ndarray, " n"]
    converged: bool = True

    def arrays(self) -> dict[str, np.ndarray]:
        """Return its arrays by name, for a file."""
        names = ("x", "scale", "free", "prior", "converged")
        found = {name: np.asarray(getattr(self, name)) for name in names}
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
        converged = bool(arrays["converged"])
        return cls(arrays["x"], arrays["scale"], problem, blocks, arrays["free"], arrays["prior"], converged)

    @property
    def cost(self) -> float:
        """Robust cost with the prior."""
        return float(self.problem.cost.sum() + np.sum(self.prior * self.x**2))

    def covariance(self) -> Float[np.ndarray, "n n"]:
        """Return the covariance of the coordinates, of the prior where nothing is known or searched."""
        free = self.free
        full = np.diag(1.0 / np.where(self.prior > 0.0, self.prior, 1.0))
        matrix = self.problem.matrix.sum(axis=0)[np.ix_(free, free)] + np.diag(self.prior[free])
        full[np.ix_(free, free)] = np.linalg.inv(matrix)
        return full


def huber(values: Float[np.ndarray, " m"]) -> tuple[np.ndarray, np.ndarray]:
    """Return Huber's cost of scaled differences, and their weights."""
    size = np.abs(values)
    weights = np.where(size <= ROBUST, 1.0, ROBUST / np.maximum(size, ROBUST))
    return np.where(size <= ROBUST, values**2, 2.0 * ROBUST * size - ROBUST**2), weights


def normal_equations(
    rollouts: Sequence[Rollout], units: Sequence[np.ndarray], thinned: float,
    folds: Sequence[Any] = (slice(None),), derivatives: bool = True,
) -> Problem:  # fmt: skip
    """Return the normal equations, of each fold of each rollout; a difference counts 1 / `thinned`.

    `units` are sizes (e,) of the differences of each rollout.
    """
    parts = []
    for rollout, unit in zip(rollouts, units, strict=True):
        for fold in folds:
            scaled = rollout.values[fold] / unit
            known = np.isfinite(scaled)
            cost, weights = huber(scaled[known])
            gradient, matrix = np.zeros(0), np.zeros((0, 0))
            if derivatives:
                slopes = (rollout.derivatives[:, fold] / unit)[:, known]
                weighted = slopes * weights
                gradient, matrix = weighted @ scaled[known], weighted @ slopes.T
            parts.append((cost.sum() / thinned, known.sum() / thinned, gradient / thinned, matrix / thinned))
    return Problem(*(np.array(part) for part in zip(*parts, strict=True)))


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
        self.prior = np.asarray(misfit.model.prior if prior is None else prior)
        #: True if no number has a prior: the equations are taken to be exact, and noise to be white
        self.exact = not np.any(self.prior)
        self._identity = "" if journal is None else identity(misfit, self.prior)
        self.length = float(np.asarray(misfit.model.nominal.length))
        self.low, self.high = misfit.model.bounds
        self.least = [self._least_scale(data) for data in misfit.data]

    def _least_scale(self, data: Experiment) -> np.ndarray:
        """Return the smallest scale (G,) of the differences of an experiment."""
        fields, groups = data.fields, data.groups
        if not self.exact:
            return np.full(len(fields), LEAST_SCALE * self.length)
        if len(fields) == 1:
            return np.array([LEAST * self.length])
        count = np.maximum(np.isfinite(data.data[1:]).sum(axis=0), 1)
        usual = np.sqrt(np.nansum(np.square(data.data[1:]), axis=0) / count)
        sizes = np.array([np.max(usual[groups == k]) for k in range(len(fields))])
        return LEAST * np.where(sizes > 0.0, sizes, 1.0)

    @property
    def folds(self) -> list[slice]:
        """Rows that are left out together: of a recording that is alone, one piece after the other."""
        first = self.misfit.data[0]
        if len(self.misfit.data) > 1:
            return [slice(None)]
        if first.static:
            return [slice(k, None, FOLDS) for k in range(FOLDS)]
        edges = np.linspace(0, len(first.control) + 1, FOLDS + 1).astype(int)
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
        if self.exact:
            return 1.0
        bodies = max(1.0, len(getattr(data.output, "fractions", ())) / BODIES)
        return max(1.0, CORRELATED / data.dt) * bodies

    def from_far(self, free: Bool[np.ndarray, " n"], skipped: int = 0) -> Point:
        """Return the end of a search from the nominal robot, over horizons that grow, without the first ones.

        Raises:
            SearchError: the nominal robot cannot be simulated, not even at rest.
        """
        x = np.where(free, self.misfit.model.begin, 0.0)
        data = self.misfit.data
        longest = max(len(it.control) - it.moves for it in data)
        wound = {"reel", "motor"} & {*self.misfit.model.nominal.control_layout.names}
        if data[0].static or wound:
            # rows are independent of each other, and wound-up lengths keep the search near the solution
            longest = 0
        rows = [0] * (not self.exact) + [max(2, round(part * longest)) for part in HORIZONS[1:]]
        for horizon in [*dict.fromkeys(rows)][skipped:]:
            if horizon < 0.8 * longest:
                x = self.run(x, free, horizon, *(FIRST if self.exact else ROUGH)).x
        return self.run(x, free, None, *(EXACT if self.exact else FINE))

    def run(
        self, x: Float[np.ndarray, " n"], free: Bool[np.ndarray, " n"], rows: int | None = None,
        most: int = FINE[0], fall: float = FINE[1], which: Sequence[int] | None = None,
        scale: Float[np.ndarray, "R G"] | None = None,
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
        fall: float, which: Sequence[int] | None, scale: Float[np.ndarray, "R G"] | None,
    ) -> Point:  # fmt: skip
        now = self._solved(x, rows, which)
        if now is None:
            raise SearchError("the robot that the search begins from cannot be simulated")
        remaining, converged, sizes = most, False, scale
        for _ in range(PASSES if most else 0):
            sizes = self.scales_of(now, which) if scale is None else scale
            budget = remaining if scale is not None else min(PASS if not self.exact else most, remaining)
            descent = _Descent(self, x, free, rows, which, sizes, now)
            used, converged = descent.run(budget, fall)
            x, now, remaining = descent.x, descent.rollouts, remaining - used
            after = self.scales_of(now, which)
            text = ", ".join(f"{1e3 * size:.2f}" for size in after[:, 0])
            told = "all rows" if rows is None else f"{rows} rows"
            self.tell(f"{told}, {most - remaining} evaluations: {text} mm")
            settled = np.all(np.abs(after - sizes) <= SETTLED * sizes)
            if scale is not None or (converged and settled) or remaining <= 0:
                break
        sizes = self.scales_of(now, which) if scale is None else scale
        units = self.units(sizes, which)
        self.misfit.differentiated(now)
        if self.exact:
            problem = normal_equations(now, units, self.thinned())
            return Point(x, sizes, problem, problem, free, self.prior, converged)
        # a short horizon has fewer rows of a recording that rests for less time
        rows_of_all = min(len(rollout.values) for rollout in now)
        blocks = normal_equations(now, units, self.thinned(), self.blocks(rows_of_all))
        parts = len(now) * len(self.folds)
        problem = Problem(*(part.reshape(parts, -1, *part.shape[1:]).sum(axis=1) for part in blocks))
        return Point(x, sizes, problem, blocks, free, self.prior, converged)

    def scales_of(self, rollouts: Sequence[Rollout], which: Sequence[int] | None = None) -> np.ndarray:
        """Return the usual size (R, G) of the differences by experiment and field.

        Each experiment is weighted by its residual, so one that cannot be explained does not spoil others.
        """
        chosen = range(len(self.misfit.data)) if which is None else which
        found = np.ones((len(rollouts), max(len(self.least[k]) for k in chosen)))
        for row, rollout, k in zip(found, rollouts, chosen, strict=True):
            for field, least in enumerate(self.least[k]):
                values = rollout.values[:, self.misfit.data[k].groups == field]
                sizes = np.abs(values[np.isfinite(values)])
                usual = 0.0
                if len(sizes):
                    usual = max(1.4826 * float(np.median(sizes)), OF_ALL * float(np.sqrt(np.mean(sizes**2))))
                row[field] = max(usual, least)
        if self.exact and len({self.misfit.data[k].fields for k in chosen}) == 1:
            # white noise of one sensor; separate weights would drift where the model is wrong
            found[:] = np.sqrt(np.mean(found**2, axis=0))
        return found

    def units(self, scale: np.ndarray, which: Sequence[int] | None = None) -> list[np.ndarray]:
        """Return the unit (e,) of every number of a difference."""
        chosen = range(len(self.misfit.data)) if which is None else which
        return [sizes[self.misfit.data[k].groups] for sizes, k in zip(scale, chosen, strict=True)]

    def _solved(self, x: np.ndarray, rows: int | None, which: Sequence[int] | None) -> list[Rollout] | None:
        found = self.misfit.differences(x, rows, which)
        return None if any(rollout is None for rollout in found) else found  # type: ignore[return-value]


class _Descent:
    """One run of least squares with fixed sizes of the differences, from a point whose rollouts are known."""

    def __init__(
        self, search: Search, x: np.ndarray, free: np.ndarray, rows: int | None, which: Any,
        sizes: np.ndarray, rollouts: list[Rollout],
    ):  # fmt: skip
        self.search, self.free, self.rows, self.which = search, free, rows, which
        self.begin, self.x, self.rollouts = x, x, rollouts
        self.units, self.thinned = search.units(sizes, which), np.sqrt(search.thinned())
        self.known = [np.isfinite(rollout.values) for rollout in rollouts]
        self.last: tuple[bytes, list[Rollout] | None] = (x[free].tobytes(), rollouts)
        self.best = np.inf

    def run(self, most: int, fall: float) -> tuple[int, bool]:
        """Minimise; return the number of evaluations and a flag of convergence."""
        from scipy.optimize import least_squares  # imported here: it takes a third of a second

        search, free = self.search, self.free
        begin = self.x[free]
        low, high = search.low[free], search.high[free]
        self.unit = 1.0 / np.sqrt(len(begin))
        self.origin, self.reach = begin, np.ones(len(begin))
        if search.exact:
            self.reach = self._reach(begin)
        # numbers of length one: the first step is at most that long, and tolerances are relative to it
        self.origin = begin - self.reach * self.unit
        low, high = ((end - self.origin) / self.reach for end in (low, high))
        ended = least_squares(
            self.values, np.clip(self.unit, low, high), self.slopes, (low, high), method=METHOD,
            ftol=fall, xtol=1e-9 if search.exact else 1e-4, gtol=1e-15, max_nfev=most,
        )  # fmt: skip
        self._at(ended.x)
        self.x = self._whole(ended.x)
        assert self.last[1] is not None
        self.rollouts = self.last[1]
        return int(ended.nfev), bool(ended.status > 0)

    def _reach(self, begin: np.ndarray) -> np.ndarray:
        """Return steps of length one: a factor of e, a number's size, or its own Gauss-Newton step."""
        numbers = [it for it, on in zip(self.search.misfit.model.numbers, self.free, strict=True) if on]
        values, slopes = self.values(np.zeros(len(begin))), self.slopes(np.zeros(len(begin)))
        lengths = np.linalg.norm(slopes, axis=0)
        alone = np.linalg.norm(values) / np.where(lengths > 0.0, lengths, np.inf)
        zero = np.array([not number.logarithmic and number.value(at) == 0.0
                         for number, at in zip(numbers, begin, strict=True)])  # fmt: skip
        return np.where(zero & (alone > 0.0), alone, 1.0)

    def _whole(self, step: np.ndarray) -> np.ndarray:
        x = self.begin.copy()
        moved = self.origin + self.reach * step
        x[self.free] = np.clip(moved, self.search.low[self.free], self.search.high[self.free])
        return x

    def _at(self, step: np.ndarray) -> list[Rollout] | None:
        x = self._whole(step)
        key = x[self.free].tobytes()
        if self.last[0] != key:
            self.last = key, self.search._solved(x, self.rows, self.which)
        return self.last[1]

    def _priors(self) -> np.ndarray:
        return np.sqrt(self.search.prior[self.free])

    def values(self, step: np.ndarray) -> np.ndarray:
        """Return square roots of Huber's costs, with signs, and the priors; infinite without a solution."""
        found, prior = self._at(step), self._priors()
        count = sum(int(known.sum()) for known in self.known) + len(prior)
        if found is None:
            return np.full(count, np.inf)
        scaled = self._scaled(found)
        roots = np.sign(scaled) * np.sqrt(huber(scaled)[0]) / self.thinned
        return np.concatenate([roots, prior * self._whole(step)[self.free]])

    def slopes(self, step: np.ndarray) -> np.ndarray:
        """Return the derivatives of the values."""
        found, prior = self._at(step), self._priors()
        assert found is not None
        self.search.misfit.differentiated(found)
        scaled = self._scaled(found)
        size = np.abs(scaled)
        # of the square root of the cost
        factor = np.where(size <= ROBUST, 1.0, ROBUST / np.sqrt(np.maximum(huber(scaled)[0], 1.0)))
        rows = np.concatenate(
            [
                (rollout.derivatives[self.free] / unit)[:, known].T
                for rollout, unit, known in zip(found, self.units, self.known, strict=True)
            ]
        )
        rows = rows * (factor / self.thinned)[:, None]
        return np.concatenate([rows, np.diag(prior)]) * self.reach

    def _scaled(self, rollouts: list[Rollout]) -> np.ndarray:
        parts = zip(rollouts, self.units, self.known, strict=True)
        return np.concatenate([(rollout.values / unit)[known] for rollout, unit, known in parts])


class SearchError(KnodeCosseratError, RuntimeError):
    """A search cannot go on; one line says why."""

    code = "search"
