"""Estimates with 95 % intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from knode_cosserat.identification.model import Model
from knode_cosserat.identification.result import Estimate
from knode_cosserat.identification.search import Point

#: quantile of the normal distribution for 95 %
SIGMAS = 1.96
#: a number whose uncertainty is more than this part of its prior's is held by the prior
HELD = 0.8


def estimates_of(
    model: Model, names: Sequence[str], point: Point, folds: Sequence[Float[np.ndarray, " n"]]
) -> list[Estimate]:
    """Return the numbers of the named effects with their intervals.

    Args:
        model: all effects.
        names: the identified effects.
        point: end of their search.
        folds: ends of searches that left one recording out each.
    """
    x, spread = point.x, standard_deviations(point, folds)
    low, high = model.bounds
    found = []
    for name in names:
        for k in range(*model.slice(name).indices(model.size)):
            number = model.numbers[k]
            ends = np.clip([x[k] - SIGMAS * spread[k], x[k] + SIGMAS * spread[k]], low[k], high[k])
            value, *interval = (float(number.value(np.asarray(at))) for at in (x[k], *ends))
            is_held = bool(spread[k] > HELD and abs(x[k]) < 1.0)
            bounds = (interval[0], interval[1])
            found.append(Estimate(name, number.label, number.unit, number.nominal, value, bounds, is_held))
    return found


def standard_deviations(point: Point, folds: Sequence[Float[np.ndarray, " n"]]) -> Float[np.ndarray, " n"]:
    """Return the standard deviations of the coordinates, widened by the scatter of the folds.

    Least squares assumes random differences; those of an incomplete model are systematic. Estimates that
    leave out one recording then scatter more than expected (jackknife, Efron & Stein 1981). All standard
    deviations are multiplied by the root of the mean ratio of both variances, up to the prior's.
    """
    spread = np.sqrt(np.diag(point.covariance()))
    count = len(folds)
    free = point.free & (spread < HELD)
    if count < 2 or not free.any():
        return spread
    scatter = (count - 1) ** 2 / count * np.var(np.array(folds), axis=0, ddof=1)
    ratio = float(np.mean(scatter[free] / spread[free] ** 2))
    return np.where(free, np.minimum(spread * np.sqrt(max(ratio, 1.0)), 1.0), spread)
