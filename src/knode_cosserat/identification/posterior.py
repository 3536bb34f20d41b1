"""Probabilities of effects, and of their numbers, after a search: Bayesian model averaging.

About the end of a search the differences are taken to be linear in the coordinates, whose priors are normal.
The evidence of every set of effects then has a closed form (Hoeting et al. 1999), and sets are sampled
instead of searched. The prior of a set corrects for the number of effects (Scott & Berger 2010).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.parameters import ParameterModel
from knode_cosserat.identification.search import SearchEnd

#: sweeps over all effects, and those at the begin that do not count
SWEEPS, BURNT = 200, 40
#: draws of the coordinates
DRAWS = 4000
#: an effect is found with this probability, and left out below the other one
SURE, UNLIKELY = 0.95, 1.0 - 0.95


@dataclasses.dataclass(frozen=True)
class Posterior:
    """Distribution of a model's coordinates, linear about the end of a search.

    Attributes:
        model: all effects.
        point: the end of the search.
        probability: of each effect.
        draws: of the coordinates (D, n); None if the effects are known.
    """

    model: ParameterModel
    point: SearchEnd
    probability: dict[str, float]
    draws: Float[np.ndarray, "D n"] | None = None

    @classmethod
    def of(cls, model: ParameterModel, point: SearchEnd, names: Sequence[str] | None = None) -> Posterior:
        """Return the distribution about the end of a search.

        Args:
            model: all effects.
            point: end of the search.
            names: the effects that the robot has, which were searched; None: this is not known.
        """
        if names is not None:
            return cls(model, point, {name: float(name in names) for name in model.names})
        linear = cls(model, point, {})
        sets = linear._sampled()
        probability = {
            name: float(sum(share for names, share in sets.items() if name in names)) for name in model.names
        }
        return cls(model, point, probability, linear._drawn(sets))

    @functools.cached_property
    def _equations(self) -> tuple[np.ndarray, np.ndarray]:
        """Information of the differences (n, n), and its product with the coordinates of least cost (n,)."""
        matrix = self.point.problem.matrix.sum(axis=0)
        return matrix, matrix @ self.point.x - self.point.problem.gradient.sum(axis=0)

    def names(self, least: float = 0.5) -> tuple[str, ...]:
        """Return the effects that are at least as probable, with those that they need.

        Those above one half are the median probability model (Barbieri & Berger 2004).
        """
        return _with_needs((name for name, share in self.probability.items() if share >= least), self.model)

    @property
    def mean(self) -> Float[np.ndarray, " n"]:
        """Mean coordinates, over all sets of effects."""
        return self.point.x if self.draws is None else self.draws.mean(axis=0)

    @property
    def deviation(self) -> Float[np.ndarray, " n"]:
        """Standard deviations of the coordinates, over all sets of effects."""
        if self.draws is None:
            return np.sqrt(np.diag(self.point.covariance()))
        return self.draws.std(axis=0)

    def about(self, x: Float[np.ndarray, " n"]) -> Posterior:
        """Return it with the same spread about other coordinates of the effects that are present."""
        if self.draws is None:
            return self
        present = self.draws != 0.0
        mean = self.draws.sum(axis=0) / np.maximum(present.sum(axis=0), 1)
        return dataclasses.replace(self, draws=self._clipped(np.where(present, self.draws + (x - mean), 0.0)))

    def samples(self) -> Float[np.ndarray, "D n"]:
        """Return random samples of the coordinates."""
        return self._drawn({self.names(): 1.0}) if self.draws is None else self.draws

    def interval(self, level: float) -> Float[np.ndarray, "2 n"]:
        """Return the ends of an interval of each coordinate, within the bounds."""
        # imported here: it takes a third of a second
        from scipy.special import stdtrit

        if self.draws is None:
            amount = float(np.sum(self.point.problem.amount)) - float(np.sum(self.point.free))
            reach = float(stdtrit(max(amount, 1.0), 0.5 + level / 2.0)) * self.deviation
            ends = np.array([self.point.x - reach, self.point.x + reach])
        else:
            ends = np.quantile(self.draws, [0.5 - level / 2.0, 0.5 + level / 2.0], axis=0)
        return self._clipped(ends)

    def correlation(self, labels: Sequence[str]) -> Float[np.ndarray, "m m"]:
        """Return the correlation of the errors of some numbers, by their labels."""
        on = [self.model.labels.index(label) for label in labels]
        full = self.point.covariance() if self.draws is None else np.cov(self.draws, rowvar=False)
        covariance = full[np.ix_(on, on)]
        spread = np.sqrt(np.diag(covariance))
        # numbers of improbable effects do not vary
        spread = np.where(spread > 0.0, spread, np.inf)
        return covariance / np.outer(spread, spread)

    def score(self, names: Iterable[str]) -> float:
        """Return the logarithm of the probability of a set of effects, but for a constant."""
        from scipy.special import betaln

        options = sum(not effect.basic for effect in self.model.effects)
        extra = sum(not self.model.effect(name).basic for name in names)
        return self.evidence(names) + float(betaln(extra + 1, options - extra + 1))

    def evidence(self, names: Iterable[str]) -> float:
        """Return the logarithm of the probability of the data with these effects, but for a constant."""
        return self._solved(names)[2]

    def mode(self, names: Iterable[str]) -> Float[np.ndarray, " n"]:
        """Return the most probable coordinates with these effects, within their bounds."""
        return self._clipped(self._solved(names)[0])

    def _solved(self, names: Iterable[str]) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the mode, a square root of the covariance, and the logarithm of the evidence."""
        from scipy.linalg import cho_solve

        model, mask = self.model, self.model.mask(names)
        # the shape of an absent effect stays: without its other numbers it changes nothing
        on, fixed = np.flatnonzero(mask), np.where(model.shapes & ~mask, self.point.x, 0.0)
        (information, pull), prior = self._equations, self.point.prior[on]
        left = pull - information @ fixed
        factor = np.linalg.cholesky(information[np.ix_(on, on)] + np.diag(prior))
        x, root = np.zeros(model.size), np.zeros((model.size, len(on)))
        x[on] = cho_solve((factor, True), left[on])
        root[on] = np.linalg.inv(factor).T
        evidence = 0.5 * left[on] @ x[on] - np.sum(np.log(np.diag(factor))) + 0.5 * fixed @ (pull + left)
        return x, root, float(evidence + 0.5 * np.sum(np.log(prior[prior > 0.0])))

    def _clipped(self, x: np.ndarray) -> np.ndarray:
        return np.clip(x, *self.model.bounds)

    def _sampled(self) -> dict[tuple[str, ...], float]:
        """Return sets of effects with their shares of a Markov chain (Madigan & York 1995)."""
        model, random, score = self.model, np.random.default_rng(0), functools.cache(self.score)
        options = [effect.name for effect in model.effects if not effect.basic]
        names, counts = model.names, dict[tuple[str, ...], float]()
        for sweep in range(SWEEPS):
            for name in random.permutation(options):
                if name in names:
                    other = _with_needs({*names} - {name}, model, False)
                else:
                    other = _with_needs([*names, name], model)
                if np.log(random.uniform()) < score(other) - score(names):
                    names = other
                if sweep >= BURNT:
                    counts[names] = counts.get(names, 0.0) + 1.0
        return {names: count / sum(counts.values()) for names, count in counts.items()}

    def _drawn(self, sets: dict[tuple[str, ...], float]) -> np.ndarray:
        random, draws = np.random.default_rng(0), []
        numbers = random.multinomial(DRAWS, list(sets.values()))
        for names, number in zip(sets, numbers, strict=True):
            if number:
                x, root, _ = self._solved(names)
                draws.append(x + random.normal(size=(number, root.shape[1])) @ root.T)
        return self._clipped(np.concatenate(draws))


def _with_needs(names: Iterable[str], model: ParameterModel, added: bool = True) -> tuple[str, ...]:
    """Return effects with those that they need, or without those that lack one, in the model's order."""
    present = set(names)
    for effect in model.effects if not added else reversed(model.effects):
        if effect.name in present and not set(effect.needs) <= present:
            present = present | set(effect.needs) if added else present - {effect.name}
    return tuple(name for name in model.names if name in present)
