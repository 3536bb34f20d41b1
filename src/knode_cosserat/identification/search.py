"""Robust least squares with priors, over horizons that grow.

The one objective of identification: differences of rollouts, in units of their usual size by experiment and
field, by Huber's loss, and priors of the numbers. `scipy.optimize.least_squares` minimises it.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, Self

import jax
import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat._files.writing import package_version
from knode_cosserat.estimation.outputs import States
from knode_cosserat.identification.experiments import Experiment
from knode_cosserat.identification.information import (
    ROBUST,
    NormalEquations,
    dispersion,
    huber,
    normal_equations,
)
from knode_cosserat.identification.journal import Journal, SearchError
from knode_cosserat.identification.misfit import Misfit, Rollout
from knode_cosserat.learning.training.checkpoint import hashed

#: parts of the longest motion over which preliminary searches go; with all rows at once, a search from a poor
#: nominal robot may fail
HORIZONS = (0.0, 1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2)
#: correlation time of differences from real data (s): rows within it count as one
CORRELATED = 0.25
#: largest number of independent bodies
BODIES = 2.0
#: smallest scale of the differences: as a fraction of the length where a model with priors is not exact, and
#: of natural sizes otherwise, ten times the solver's tolerance
LEAST_SCALE, LEAST = 5e-4, 1e-9
#: the scale is at least this part of the root mean square: fields may be zero in most rows
OF_ALL = 0.2
#: evaluations with one scale and without new derivatives where there are priors, and the relative change of
#: the scale at the end
PASS, SETTLED = 5, 0.05
#: evaluations of a search at one horizon, and of the last one; parts by which the cost falls at their end
ROUGH, FINE = (PASS, 2e-2), (25, 1e-3)
#: the same without priors, where a start may be far
FIRST, EXACT = (50, 1e-5), (100, 1e-10)
#: no coordinate moves by less, in units of a first step
NO_STEP = 1e-9
METHOD: Literal["trf"] = "trf"
#: a number is not seen if its variance stays above this part of its prior's
UNSEEN = 0.8
#: a row is not used if it moves by more lengths than this for each standard deviation of the priors: such a
#: motion is unstable there, and derivatives say nothing
LARGEST = 10.0
#: lags in rows, and the correlation above which a remainder is not noise
LAGS, ALIKE = range(3, 11), 0.3
#: scales below so many times the solver's errors are not examined
NEAR = 10.0


#: coordinates of the normal equations at the end of a search
Equations = Literal["free", "all", "none"]


class Subset(NamedTuple):
    """Part of the data: rows after the first in motion, and numbers of experiments; None: all."""

    rows: int | None = None
    which: Sequence[int] | None = None


ALL = Subset()


@dataclasses.dataclass(frozen=True)
class SearchEnd:
    """End of a search: coordinates, scales of the differences, and the normal equations there."""

    x: Float[np.ndarray, " n"]
    #: by experiment and field; of poses in m
    scale: Float[np.ndarray, "R G"]
    problem: NormalEquations
    free: Bool[np.ndarray, " n"]
    #: precision of each coordinate's prior
    prior: Float[np.ndarray, " n"]
    converged: bool = True

    def facts(self) -> dict[str, Any]:
        """Return its attributes, for a file."""
        return {**vars(self), "problem": self.problem._asdict()}

    @classmethod
    def of(cls, facts: dict[str, Any]) -> Self:
        """Return the point with these attributes: the inverse of `facts`."""
        return cls(**{**facts, "problem": NormalEquations(**facts["problem"])})

    def scattered(self, ratio: float) -> Self:
        """Return it with differences of a larger variance, which count less."""
        return dataclasses.replace(self, problem=NormalEquations(*(part / ratio for part in self.problem)))

    def covariance(self) -> Float[np.ndarray, "n n"]:
        """Return the covariance of the coordinates, of the prior where nothing is known or searched."""
        free = self.free
        full = np.diag(1.0 / np.where(self.prior > 0.0, self.prior, 1.0))
        matrix = self.problem.matrix.sum(axis=0)[np.ix_(free, free)] + np.diag(self.prior[free])
        full[np.ix_(free, free)] = np.linalg.inv(matrix)
        return full


class ParameterSearch:
    """Searches coordinates of a model from recordings.

    Args:
        misfit: the recordings and the model.
        journal: course of the identification.
        prior: precision of each coordinate's prior, about zero; by default that of the model.
    """

    def __init__(
        self,
        misfit: Misfit,
        journal: Journal | None = None,
        prior: Float[np.ndarray, " n"] | None = None,
    ):
        self.misfit, self.journal = misfit, journal or Journal()
        self.prior = np.asarray(misfit.model.prior if prior is None else prior)
        #: True if no number has a prior: the equations are taken to be exact, and noise to be white
        self.exact = not np.any(self.prior)
        self.length = float(np.asarray(misfit.model.nominal.length))
        self.low, self.high = misfit.model.bounds
        self._least = {data: self._least_scale(data) for data in misfit.data}

    @functools.cached_property
    def identity(self) -> str:
        """Return a hash of everything that a search depends on: model, recordings, settings, this package."""
        model = self.misfit.model
        words = [package_version(), repr(model.numbers), repr(model.names)]
        arrays = [self.prior, *jax.tree.leaves(model.robot)]
        for it in self.misfit.data:
            words.append(f"{it.name} {it.dt!r} {it.moves} {it.static} {it.continuous} {it.steps}")
            words += [repr(it.settings), repr(it.output)]
            arrays += [np.zeros(0) if it.held is None else it.held, it.control, it.data]
        return hashed(*words, *arrays)

    def _least_scale(self, data: Experiment) -> np.ndarray:
        """Return the smallest scale (G,) of the differences of an experiment."""
        fields, groups = data.fields, data.groups
        if not self.exact:
            return np.full(len(fields), LEAST_SCALE * self.length)
        if not isinstance(data.output, States):
            return np.full(len(fields), LEAST * self.length)
        count = np.maximum(np.isfinite(data.data[1:]).sum(axis=0), 1)
        usual = np.sqrt(np.nansum(np.square(data.data[1:]), axis=0) / count)
        sizes = np.array([np.max(usual[groups == k]) for k in range(len(fields))])
        return LEAST * np.where(sizes > 0.0, sizes, 1.0)

    def thinned(self) -> float:
        """Return a guess of the number of differences that count as one (`information.dispersion`)."""
        data = self.misfit.data[0]
        if self.exact:
            return 1.0
        bodies = max(1.0, len(getattr(data.output, "fractions", ())) / BODIES)
        return max(1.0, CORRELATED / data.dt) * bodies

    def from_far(
        self, free: Bool[np.ndarray, " n"], skipped: int = 0, effort: tuple[int, float] | None = None
    ) -> SearchEnd:
        """Return the end of a search from the nominal robot, over horizons that grow, without the first ones.

        `effort` is that of the last search, as in `run`.

        Raises:
            SearchError: the nominal robot cannot be simulated, not even at rest.
        """
        x = self.over(np.where(free, self.misfit.model.begin, 0.0), free, HORIZONS, skipped)
        point = self.run(x, free, effort=effort or (EXACT if self.exact else FINE), equations="all")
        return self._beyond_kinks(point) if self.separate_rows else point

    @property
    def separate_rows(self) -> bool:
        """True if tendons' lengths, or equilibria, keep every row near its solution."""
        wound = {"reel", "motor"} & {*self.misfit.model.nominal.control_layout.names}
        return bool(self.misfit.data[0].static or wound)

    def _beyond_kinks(self, point: SearchEnd) -> SearchEnd:
        """Return the best end of searches that begin at other values of numbers that were not seen.

        A tendon that is slack in the model, but not in the robot, hides the numbers that it depends on.
        """
        unseen = point.free & (self.prior * np.diag(point.covariance()) > UNSEEN)
        rollouts = self.solved(point.x)
        for k, step in itertools.product(np.flatnonzero(unseen), (-1.0, 1.0)):
            x = np.clip(point.x + step * (np.arange(len(point.x)) == k), self.low, self.high)
            moved = self.solved(x)
            if rollouts is None or moved is None:
                continue
            changed = zip(moved, rollouts, self.units(point.scale, rollouts), strict=True)
            if all(np.nanmax(np.abs(new.values - old.values) / unit) < 1.0 for new, old, unit in changed):
                continue
            try:
                found = self.run(x, point.free, equations="all")
            except SearchError:
                continue
            if np.sum(np.log(found.scale)) < np.sum(np.log(point.scale)):
                point, rollouts = found, self.solved(found.x)
        return point

    def over(
        self,
        x: Float[np.ndarray, " n"],
        free: Bool[np.ndarray, " n"],
        parts: Sequence[float],
        skipped: int = 0,
    ) -> Float[np.ndarray, " n"]:
        """Return coordinates after searches over parts of the longest motion, without the first ones."""
        used = [] if self.separate_rows else [part for part in parts if part or not self.exact]
        for rows in [*dict.fromkeys(map(self.rows_of, used))][skipped:]:
            if rows < 0.8 * self.rows_of(1.0):
                x = self.run(x, free, Subset(rows), FIRST if self.exact else ROUGH, equations="none").x
        return x

    def rows_of(self, part: float) -> int:
        """Return the number of rows after the first in motion that are this part of the longest motion."""
        longest = max(len(it.control) - it.moves for it in self.misfit.data)
        count = max(2, round(part * longest)) if part else 0
        return max(self._rows_until(count, it) for it in self.misfit.data)

    def _rows_until(self, count: int, data: Experiment) -> int:
        """Return the number of rows after the first in motion with so many rows that were measured."""
        measured = 1 + np.flatnonzero(np.isfinite(data.data[data.moves + 1 :]).any(axis=1))
        return int(measured[:count][-1]) if count and len(measured) else count

    def run(
        self,
        x: Float[np.ndarray, " n"],
        free: Bool[np.ndarray, " n"],
        subset: Subset = ALL,
        effort: tuple[int, float] = FINE,
        scale: Float[np.ndarray, "R G"] | None = None,
        equations: Equations = "free",
        near: Float[np.ndarray, " n"] | None = None,
    ) -> SearchEnd:
        """Return the end of a search (Levenberg-Marquardt) from a point.

        Args:
            x: the point.
            free: coordinates that are searched.
            subset: recordings and rows.
            effort: most evaluations, and the relative fall of the cost at which the search ends.
            scale: fixed scales of the differences; None: they follow the differences.
            equations: coordinates of the normal equations at the end; none: there are no equations.
            near: coordinates whose accurate differences are good enough to begin with; None: those of `x`.

        Raises:
            SearchError: the robot at that point cannot be simulated.
        """
        options = (subset.rows, subset.which and tuple(subset.which), effort, scale is None, equations)
        begins = (np.zeros(0) if it is None else it for it in (scale, near))
        solve = functools.partial(self._searched, x, free, subset, effort, scale, equations, near)
        facts = self.journal.finished(lambda: solve().facts(), self.identity, repr(options), x, free, *begins)
        point = SearchEnd.of(facts)
        if subset.which is None:
            self.journal.last = self, point
        return point

    def first_explaining(self, *searches: Callable[[], SearchEnd]) -> SearchEnd:
        """Return the end of the first search that explains the data, or of the best search.

        Raises:
            SearchError: all searches failed.
        """
        points, error = list[SearchEnd](), None
        for search in searches:
            try:
                points.append(search())
            except SearchError as failed:
                self.journal.tell(f"the search failed: {failed}")
                error = failed
                continue
            if (points[-1].converged or not self.exact) and not self.unexplained(points[-1].x):
                return points[-1]
        if error and not points:
            raise error
        return min(points, key=lambda it: (self.exact and not it.converged, float(np.sum(np.log(it.scale)))))

    def unexplained(self, x: Float[np.ndarray, " n"]) -> tuple[str, ...]:
        """Return the fields whose remaining differences are not noise: rows are correlated at large lags."""
        fields: dict[str, None] = {}
        for rollout in self.misfit.whole(x):
            if rollout is None or rollout.data.static:
                continue
            data, [scale] = rollout.data, self.scales_of([rollout])
            known = np.isfinite(rollout.values[1:])
            values = np.where(known, rollout.values[1:], 0.0)
            for field, name in enumerate(data.fields):
                if scale[field] <= NEAR * self._least[data][field]:
                    continue
                rows, seen = values[:, data.groups == field], known[:, data.groups == field]
                for lag in LAGS:
                    one, other = rows[:-lag], rows[lag:]
                    size = np.sum(one**2 + other**2) / 2.0
                    count = max(int(np.sum(seen[lag:])), 1)
                    if np.abs(np.sum(one * other)) > max(ALIKE, 5.0 / np.sqrt(count)) * size:
                        several = len(self.misfit.data) > 1 and data.readings
                        fields[f"{name} in {data.name}" if several else name] = None
                        break
        return tuple(fields)

    def without(
        self, point: SearchEnd, k: int, effort: tuple[int, float], equations: Equations = "free"
    ) -> SearchEnd | None:
        """Return the end of a search from a point without recording k; None if it fails.

        A single recording is not left out.
        """
        others = [j for j in range(len(self.misfit.data)) if j != k] or [k]
        try:
            return self.run(point.x, point.free, Subset(None, others), effort, point.scale[others], equations)
        except SearchError:
            return None

    def _searched(
        self,
        x: Float[np.ndarray, " n"],
        free: Bool[np.ndarray, " n"],
        subset: Subset,
        effort: tuple[int, float],
        scale: Float[np.ndarray, "R G"] | None,
        equations: Equations,
        near: Float[np.ndarray, " n"] | None,
    ) -> SearchEnd:
        most, fall = effort
        begun = None if near is None else self.solved(near, subset)
        rollouts = self.solved(x, subset, begun and [it.offset for it in begun])
        if rollouts is None:
            raise SearchError("the robot that the search begins from cannot be simulated")
        columns = np.ones(len(x), dtype=bool) if equations == "all" else free
        rough, remaining, converged = equations == "none", most, False
        #: true if nothing finer is to be known of these rollouts
        fine = begun is None or rough
        while remaining > 0 and not converged:
            sizes, known = self.scales_of(rollouts) if scale is None else scale, fine
            descent = _Descent(self, subset, x, free, columns, rollouts, sizes)
            budget = remaining if self.exact or scale is not None else min(PASS, remaining)
            used, ended = descent.run(budget, fall, rough)
            x, rollouts, remaining = descent.x, descent.rollouts, remaining - used
            fine = rough or (fine and not used)
            if not fine and (ended or remaining <= 0):
                fine = True
                if subset.rows is None:
                    rollouts = self.misfit.refined(rollouts, x)
            after = self.scales_of(rollouts)
            horizon = "all rows" if subset.rows is None else f"{subset.rows} rows"
            text = ", ".join(f"{1e3 * size:.2f}" for size in after[:, 0])
            self.journal.tell(f"{horizon}, {most - remaining} evaluations: {text} mm")
            settled = scale is not None or np.all(np.abs(after - sizes) <= SETTLED * sizes)
            converged = bool(ended and (rough or (settled and (known or self.exact))))
        sizes = self.scales_of(rollouts) if scale is None else scale
        if rough:
            empty = (np.zeros((0, *[len(x)] * dimensions)) for dimensions in (0, 0, 1, 2))
            return SearchEnd(x, sizes, NormalEquations(*empty), free, self.prior, converged)
        units = self.units(sizes, rollouts)
        self.misfit.differentiated(rollouts, columns)
        rollouts = [it.only(used) for it, used in zip(rollouts, self.used(rollouts, columns), strict=True)]
        thinned = self.thinned()
        if not self.exact:
            spacing = [0.0 if it.data.static else it.data.dt for it in rollouts]
            thinned = dispersion(rollouts, units, spacing, free)
        problem = normal_equations(rollouts, units, thinned, columns)
        return SearchEnd(x, sizes, problem, free, self.prior, converged)

    def scales_of(self, rollouts: Sequence[Rollout]) -> Float[np.ndarray, "R G"]:
        """Return the usual size of the differences by experiment and field.

        Each experiment is weighted by its residual, so one that cannot be explained does not spoil others.
        """
        scales = np.ones((len(rollouts), max(len(it.data.fields) for it in rollouts)))
        for row, rollout in zip(scales, rollouts, strict=True):
            for field, least in enumerate(self._least[rollout.data]):
                values = rollout.values[:, rollout.data.groups == field]
                sizes = np.abs(values[np.isfinite(values)])
                usual = 0.0
                if len(sizes):
                    usual = max(1.4826 * float(np.median(sizes)), OF_ALL * float(np.sqrt(np.mean(sizes**2))))
                row[field] = max(usual, least)
        if self.exact and len({it.data.fields for it in rollouts}) == 1:
            # white noise of one sensor; separate weights would drift where the model is wrong
            scales[:] = np.sqrt(np.mean(scales**2, axis=0))
        return scales

    def used(self, rollouts: Sequence[Rollout], which: Bool[np.ndarray, " n"]) -> list[np.ndarray]:
        """Return which differences (rows, e) of each rollout are known, in rows with usable derivatives."""
        found = []
        for rollout in rollouts:
            known = np.isfinite(rollout.values)
            if not self.exact:
                sizes = np.linalg.norm(rollout.derivatives_by(which), axis=0)
                known &= (np.max(sizes, axis=1) <= LARGEST * self.length)[:, None]
            found.append(known)
        return found

    def units(self, scale: Float[np.ndarray, "R G"], rollouts: Sequence[Rollout]) -> list[np.ndarray]:
        """Return the unit (e,) of every number of a difference."""
        return [sizes[it.data.groups] for sizes, it in zip(scale, rollouts, strict=True)]

    def solved(
        self, x: np.ndarray, subset: Subset = ALL, offsets: Sequence[Any] | None = None
    ) -> list[Rollout] | None:
        """Return the rollouts at a point; None if one failed. Whole ones are refined without `offsets`.

        Raises:
            OutOfTimeError: the deadline is over.
        """
        self.journal.require_time()
        if offsets is None and subset.rows is None:
            rollouts = self.misfit.whole(x, subset.which)
        else:
            rollouts = self.misfit.differences(x, *subset, offsets)
        return None if any(it is None for it in rollouts) else rollouts  # type: ignore[return-value]


@dataclasses.dataclass
class _Descent:
    """One run of least squares with fixed sizes of the differences, from a point whose rollouts are known.

    The derivatives are those at the begin; where numbers have priors, each step updates them (Broyden 1965).
    """

    search: ParameterSearch
    subset: Subset
    x: Float[np.ndarray, " n"]
    free: Bool[np.ndarray, " n"]
    #: coordinates whose derivatives are computed at the begin
    columns: Bool[np.ndarray, " n"]
    rollouts: list[Rollout]
    sizes: Float[np.ndarray, "R G"]

    def __post_init__(self) -> None:
        search, free = self.search, self.free
        self.begin, self.low, self.high = self.x, search.low[free], search.high[free]
        self.units, self.thinned = search.units(self.sizes, self.rollouts), np.sqrt(search.thinned())
        search.misfit.differentiated(self.rollouts, self.columns)
        self.known = search.used(self.rollouts, free)
        #: the derivatives, and where they belong
        self.derivatives = [it.derivatives_by(free).copy() for it in self.rollouts]
        self.at, self.about = self.x[free], self.rollouts
        #: the last rollouts, and those of least cost, with their coordinates
        self.last: tuple[bytes, list[Rollout] | None] = (self.x[free].tobytes(), self.rollouts)
        self.best, self.lowest = self.last, np.inf
        self.prior, self.offsets = np.sqrt(search.prior[free]), [it.offset for it in self.rollouts]

    def run(self, most: int, fall: float, rough: bool) -> tuple[int, bool]:
        """Minimise; return the number of evaluations and a flag of convergence.

        With updated derivatives it has converged if the first step promises or brings too little; a `rough`
        end is where any step did.
        """
        from scipy.optimize import least_squares  # imported here: it takes a third of a second

        begin, exact = self.x[self.free], self.search.exact
        # numbers of length one: the first step is at most that long, and tolerances are relative to it
        self.unit, self.reach = 1.0 / np.sqrt(len(begin)), np.ones(len(begin))
        if exact:
            self.reach = self._reach(begin)
        low, high = ((end - begin) / self.reach + self.unit for end in (self.low, self.high))
        start = np.clip(self.unit, low, high)
        if not exact and not rough and self._promise(start, low, high) < fall:
            return 0, True
        ended = least_squares(
            self.values,
            start,
            self.slopes,
            (low, high),
            method=METHOD,
            ftol=fall,
            xtol=1e-9 if exact else 1e-4,
            gtol=1e-15,
            max_nfev=most + 1,
        )
        solved = self._at(ended.x)
        assert solved is not None
        self.x, self.rollouts = self._whole(ended.x), solved
        used = max(int(ended.nfev) - 1, 1)
        return used, bool(ended.status > 0) and (exact or rough or used == 1)

    def _promise(self, start: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
        """Return the part by which the cost falls in a Gauss-Newton step from a start within bounds."""
        values, slopes = self.values(start), self.slopes(start)
        pull = slopes.T @ values
        inside = ~((start <= low) & (pull > 0.0) | (start >= high) & (pull < 0.0))
        slopes, pull = slopes[:, inside], pull[inside]
        return float(pull @ np.linalg.solve(slopes.T @ slopes, pull) / (values @ values))

    def _reach(self, begin: np.ndarray) -> np.ndarray:
        """Return steps of length one: a factor of e, a number's size, or its own Gauss-Newton step."""
        numbers = [it for it, on in zip(self.search.misfit.model.numbers, self.free, strict=True) if on]
        at = np.full(len(begin), self.unit)
        values, slopes = self.values(at), self.slopes(at)
        lengths = np.linalg.norm(slopes, axis=0)
        alone = np.linalg.norm(values) / np.where(lengths > 0.0, lengths, np.inf)
        zero = np.array(
            [
                not number.logarithmic and number.value(at) == 0.0
                for number, at in zip(numbers, begin, strict=True)
            ]
        )
        return np.where(zero & (alone > 0.0), alone, 1.0)

    def _whole(self, step: np.ndarray) -> np.ndarray:
        x, moved = self.begin.copy(), step - self.unit
        if np.max(np.abs(moved)) > NO_STEP:
            x[self.free] = np.clip(x[self.free] + self.reach * moved, self.low, self.high)
        return x

    def _at(self, step: np.ndarray) -> list[Rollout] | None:
        x = self._whole(step)
        key = x[self.free].tobytes()
        if self.best[0] == key:
            self.last = self.best
        if self.last[0] != key:
            self.last = key, self.search.solved(x, self.subset, self.offsets)
        return self.last[1]

    def values(self, step: np.ndarray) -> np.ndarray:
        """Return square roots of Huber's costs, with signs, and the priors; infinite without a solution."""
        rollouts = self._at(step)
        if rollouts is None:
            return np.full(sum(int(known.sum()) for known in self.known) + len(self.prior), np.inf)
        scaled = self._scaled(rollouts)
        roots = np.sign(scaled) * np.sqrt(huber(scaled)[0]) / self.thinned
        found = np.concatenate([roots, self.prior * self._whole(step)[self.free]])
        if found @ found < self.lowest:
            self.best, self.lowest = (self.last[0], rollouts), float(found @ found)
        return found

    def slopes(self, step: np.ndarray) -> np.ndarray:
        """Return the derivatives of the values."""
        rollouts = self._at(step)
        if rollouts is None:  # a begin at a bound, from which it was moved
            raise SearchError("the robot that the search begins from cannot be simulated")
        self._renew(self._whole(step)[self.free], rollouts)
        scaled = self._scaled(rollouts)
        size = np.abs(scaled)
        # of the square root of the cost
        factor = np.where(size <= ROBUST, 1.0, ROBUST / np.sqrt(np.maximum(huber(scaled)[0], 1.0)))
        parts = zip(self.derivatives, self.units, self.known, strict=True)
        rows = [(derivatives / unit)[:, known].T for derivatives, unit, known in parts]
        scaled_rows = np.concatenate(rows) * (factor / self.thinned)[:, None]
        if not np.isfinite(scaled_rows).all():
            raise SearchError("the search left the range of robots whose motion has derivatives")
        return np.concatenate([scaled_rows, np.diag(self.prior)]) * self.reach

    def _renew(self, x: np.ndarray, rollouts: list[Rollout]) -> None:
        """Compute the derivatives at other coordinates, or update them by the step there."""
        step = x - self.at
        if not step.any():
            return
        if self.search.exact:
            self.search.misfit.differentiated(rollouts, self.free)
            self.derivatives = [it.derivatives_by(self.free) for it in rollouts]
        else:
            for derivatives, new, old in zip(self.derivatives, rollouts, self.about, strict=True):
                more = new.values - old.values - np.tensordot(step, derivatives, 1)
                derivatives += step[:, None, None] * np.nan_to_num(more) / (step @ step)
        self.at, self.about = x, rollouts

    def _scaled(self, rollouts: list[Rollout]) -> np.ndarray:
        parts = zip(rollouts, self.units, self.known, strict=True)
        return np.concatenate([(rollout.values / unit)[known] for rollout, unit, known in parts])
