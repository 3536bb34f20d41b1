"""Sparse linear regression: automatic relevance determination, and selection by held-out error.

Every weight has its own prior, w_i ~ N(0, 1/α_i), and the noise has a precision β. All are set by maximising
the evidence (MacKay, "Bayesian interpolation", 1992; Tipping, "Sparse Bayesian learning", 2001). Irrelevant
weights go to zero and are removed. The algorithm uses the triangular factor of the features, not their normal
equations: simulated data are exact to ten digits, and normal equations would lose half of them.

The remainder of an incomplete set of functions is not noise. Selection by evidence would then add many terms,
which overfit. Instead, groups of columns are added one by one, each time the one that lowers the error on
held-out data most (whole trajectories, or parts of a single one), until none lowers it enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

#: a weight is removed if its effect on the prediction, over all samples, is below this part of the noise
RELEVANCE = 0.3
MOST_SWEEPS = 100
#: a weight stays if it is this many times its standard error
SIGNIFICANCE = 5.0
#: a term stays if it lowers the held-out squared error by this part
GAIN = 0.05
MOST_TERMS = 12
#: number of folds of the rows of a single trajectory
PARTS = 3


def relevant(
    features: Float[Any, "S k"],
    targets: Float[Any, "S n"],
    floors: Float[Any, " n"],
    weight: Float[Any, " S"],
) -> tuple[Float[np.ndarray, "n k"], list[float]]:
    """Return sparse weights of the features for each target, and the remainders (rms).

    Args:
        features: (S, k).
        targets: (S, n), each with its own regression.
        floors: lower bounds of the noise (rms) in each target, such as the solver's tolerance.
        weight: sample weights, on average one.
    """
    root = np.sqrt(weight)[:, None]
    features, targets = features * root, targets * root
    count, size = features.shape
    spreads = np.sqrt(np.mean(targets**2, axis=0))
    sizes = np.sqrt(np.mean(features**2, axis=0))
    weights, noise = np.zeros((len(floors), size)), [float(spread) for spread in spreads]
    live = np.flatnonzero(sizes > 1e-13 * max(sizes.max(initial=0.0), 1e-300))
    if not len(live) or np.all(spreads <= floors):
        return weights, noise
    # in units in which features and targets are of size one; the factor stands for all the samples
    units = np.concatenate([sizes[live], np.where(spreads > 0.0, spreads, 1.0)])
    factor: Any = np.linalg.qr(np.column_stack([features[:, live], targets]) / units, mode="r")
    X, along = factor[: len(live), : len(live)], factor[:, len(live) :]
    # orthogonal to the features only the length of a target matters
    y = np.vstack([along[: len(live)], np.linalg.norm(along[len(live) :], axis=0)])
    X = np.vstack([X, np.zeros((len(y) - len(X), len(live)))])
    for k, (spread, floor) in enumerate(zip(spreads, floors, strict=True)):
        part = None if spread <= floor else _relevant_part(X, y[:, k], count, floor / spread)
        if part is not None:
            active, w, rest = part
            weights[k, live[active]] = w * spread / sizes[live[active]]
            noise[k] = float(spread * np.sqrt(rest / count))
    return weights, noise


def _relevant_part(X: Any, y: Any, count: int, least: float) -> tuple[Any, Any, float] | None:
    """Return the active weights of one target, their values and remaining squares; None if all are zero."""
    active = np.arange(X.shape[1])
    alpha, beta = np.full(X.shape[1], 1e-2), 1e6
    for sweep in range(MOST_SWEEPS):
        w, variance, rest = _posterior(X[:, active], y, alpha[active], beta)
        determined = np.clip(1.0 - alpha[active] * variance, 1e-12, 1.0)
        old, beta = beta, max(count - determined.sum(), 1.0) / max(rest, count * least**2)
        alpha[active] = np.minimum(determined / np.maximum(w**2, 1e-300), 1e30)
        keep = (np.abs(w) * np.sqrt(beta * count) > RELEVANCE) & (determined > 1e-6)
        if keep.all() and sweep > 10 and abs(np.log(beta / old)) < 1e-3:
            break
        active = active[keep]
        if not len(active):
            return None
    while True:
        w, variance, rest = _posterior(X[:, active], y, alpha[active], beta)
        # remove the less certain half of the insignificant ones at a time: others may take over their effect
        certainty = np.abs(w) / np.sqrt(variance)
        insignificant = certainty[certainty <= SIGNIFICANCE]
        if not len(insignificant):
            return active, w, rest
        active = active[certainty >= min(SIGNIFICANCE, np.median(insignificant) * (1.0 + 1e-9))]
        if not len(active):
            return None
        rest = _posterior(X[:, active], y, alpha[active], beta)[2]
        beta = max(count - len(active), 1.0) / max(rest, count * least**2)


def _posterior(X: Any, y: Any, alpha: Any, beta: float) -> tuple[Any, Any, float]:
    """Return mean and variance of the weights, and the remaining sum of squares."""
    k = len(alpha)
    Q, R = np.linalg.qr(np.vstack([np.sqrt(beta) * X, np.diag(np.sqrt(alpha))]))
    w = np.linalg.solve(R, Q.T @ np.concatenate([np.sqrt(beta) * y, np.zeros(k)]))
    rest = X @ w - y
    return w, np.sum(np.linalg.inv(R) ** 2, axis=1), float(rest @ rest)


# selection by held-out error


class _Moments(NamedTuple):
    """Sums over the samples of one fold: features by features, features by values, values by values."""

    G: Float[Any, "k k"]
    b: Float[Any, "k n"]
    c: Float[Any, " n"]


def folds(origin: Any) -> Any:
    """Return the fold of each sample (trajectory, row): its trajectory, or a part of a single one."""
    trajectories = np.unique(origin[:, 0])
    if len(trajectories) > 1:
        return np.searchsorted(trajectories, origin[:, 0])
    rows = origin[:, 1]
    return np.minimum(PARTS * (rows - rows.min()) // max(np.ptp(rows) + 1, 1), PARTS - 1)


def moments(features: Float[Any, "S k"], values: Float[Any, "S n"], fold: Any) -> list[_Moments]:
    """Return the moments of every fold."""
    parts = [(features[fold == k], values[fold == k]) for k in np.unique(fold)]
    return [_Moments(X.T @ X, X.T @ y, np.sum(y * y, axis=0)) for X, y in parts]


def held_out_error(parts: Sequence[_Moments], columns: Any) -> float:
    """Return the cross-validated sum of squared errors: each fold is predicted from the others."""
    total = _Moments(*(sum(sums) for sums in zip(*parts, strict=True)))
    square, error = np.ix_(columns, columns), 0.0
    for part in parts:
        G, b = (total.G - part.G)[square], (total.b - part.b)[columns]
        # in units in which every feature has size one
        size = np.sqrt(np.maximum(np.diag(G), 1e-300))
        scaled = G / size[:, None] / size[None, :] + 1e-11 * np.eye(len(G))
        w = np.linalg.solve(scaled, b / size[:, None]) / size[:, None]
        left = part.c - 2.0 * np.sum(w * part.b[columns], axis=0) + np.sum(w * (part.G[square] @ w), axis=0)
        error += float(np.sum(left))
    return max(error, 0.0)


def selected_columns(parts: Sequence[_Moments], groups: Sequence[Any], floor: float) -> tuple[Any, float]:
    """Return the columns of the selected groups, and their held-out error; stops at the error `floor`."""
    columns, rest = np.zeros(0, dtype=int), [*groups]
    error = held_out_error(parts, columns)
    for _ in range(min(MOST_TERMS, len(rest))):
        trials = [held_out_error(parts, np.concatenate([columns, group])) for group in rest]
        if error <= floor or min(trials) > (1.0 - GAIN) * error:
            break
        error = min(trials)
        columns = np.concatenate([columns, rest.pop(int(np.argmin(trials)))])
    return columns, error
