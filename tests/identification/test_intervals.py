"""Intervals: those of least squares, widened by the scatter of estimates that leave one recording out."""

import numpy as np
import pytest

from knode_cosserat.identification.information import NormalEquations
from knode_cosserat.identification.result import variance_ratio
from knode_cosserat.identification.search import SearchEnd

SIZE, RECORDINGS = 30, 3


def point_of(matrices):
    """The end of a search of `SIZE` numbers by linear recordings with these normal equations."""
    count = len(matrices)
    problem = NormalEquations(np.ones(count), np.ones(count), np.zeros((count, SIZE)), np.array(matrices))
    return SearchEnd(np.zeros(SIZE), np.ones(count), problem, np.ones(SIZE, dtype=bool), np.ones(SIZE))


def folds_of(point, correlated, rng):
    """Ends without one recording each, where all differences count `correlated` times but are drawn once."""
    matrices = point.problem.matrix
    pulls = [rng.multivariate_normal(np.zeros(SIZE), correlated * matrix) for matrix in matrices]
    found = []
    for k in range(RECORDINGS):
        others = [j for j in range(RECORDINGS) if j != k]
        matrix = sum(matrices[j] for j in others) + np.eye(SIZE)
        found.append(np.linalg.solve(matrix, sum(pulls[j] for j in others)))
    return found


@pytest.mark.parametrize("correlated", [1.0, 16.0])
def test_they_grow_by_the_scatter_of_the_folds(correlated):
    rng = np.random.default_rng(0)
    point = point_of([100.0 * np.diag(rng.uniform(0.5, 2.0, SIZE)) for _ in range(RECORDINGS)])
    growth = [np.sqrt(variance_ratio(point, folds_of(point, correlated, rng))) for _ in range(40)]
    # the jackknife is not small by chance: it leans to the large side (Efron & Stein 1981)
    assert np.sqrt(correlated) <= np.mean(growth) <= 1.4 * np.sqrt(correlated)


def test_what_is_held_by_its_prior_stays_so():
    point = point_of([np.diag([1e-3] * SIZE)] * RECORDINGS)
    folds = [np.full(SIZE, float(k)) for k in range(RECORDINGS)]
    assert variance_ratio(point, folds) == 1.0
    known = point_of([100.0 * np.eye(SIZE)] * 3)
    # not above the prior's deviation, however much the folds scatter
    ratio = variance_ratio(known, folds)
    assert ratio > 100.0
    assert np.all(known.scattered(1e9 * ratio).covariance().diagonal() <= 1.0)
    # one recording has nothing to be left out
    assert variance_ratio(known, []) == 1.0
