"""Sparse linear regression with automatic relevance determination.

Every weight has its own prior, w_i ~ N(0, 1/α_i), and the noise has a precision β. All are set by maximising
the evidence (MacKay, "Bayesian interpolation", 1992; Tipping, "Sparse Bayesian learning", 2001). Irrelevant
weights go to zero and are removed. The algorithm uses the triangular factor of the features, not their normal
equations: simulated data are exact to ten digits, and normal equations would lose half of them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

#: a weight is removed if its effect on the prediction, over all samples, is below this part of the noise
RELEVANCE = 0.3
MOST_SWEEPS = 100
#: a weight stays if it is this many times its standard error
SIGNIFICANCE = 5.0


class Weights(NamedTuple):
    """Weights (k,), zero if irrelevant, their standard errors, and the rms remainder."""

    values: Float[Any, " k"]
    errors: Float[Any, " k"]
    noise: float
    #: Bayes' information criterion: smaller is better
    criterion: float


def relevant(
    features: Float[Any, "S k"],
    targets: Float[Any, "S n"],
    floors: Float[Any, " n"],
    weight: Float[Any, " S"] | None = None,
) -> list[Weights]:
    """Return sparse weights of the features for each target.

    Args:
        features: (S, k).
        targets: (S, n), each with its own regression.
        floors: lower bounds of the noise (rms) in each target, such as the solver's tolerance.
        weight: sample weights, on average one.
    """
    if weight is not None:
        root = np.sqrt(weight)[:, None]
        features, targets = features * root, targets * root
    count, size = features.shape
    spreads = np.sqrt(np.mean(targets**2, axis=0))
    sizes = np.sqrt(np.mean(features**2, axis=0))
    live = np.flatnonzero(sizes > 1e-13 * max(sizes.max(initial=0.0), 1e-300))
    if not len(live) or np.all(spreads <= floors):
        return [_nothing(count, size, *each) for each in zip(spreads, floors, strict=True)]
    # in units in which features and targets are of size one; the factor stands for all the samples
    units = np.concatenate([sizes[live], np.where(spreads > 0.0, spreads, 1.0)])
    factor: Any = np.linalg.qr(np.column_stack([features[:, live], targets]) / units, mode="r")
    X, along = factor[: len(live), : len(live)], factor[:, len(live) :]
    # orthogonal to the features only the length of a target matters
    beside = np.linalg.norm(along[len(live) :], axis=0)
    y = np.vstack([along[: len(live)], beside])
    X = np.vstack([X, np.zeros((len(y) - len(X), len(live)))])
    found = []
    for target, spread, floor in zip(y.T, spreads, floors, strict=True):
        nothing = _nothing(count, size, spread, floor)
        part = None if spread <= floor else _of_one(X, target, count, floor / spread)
        if part is None:
            found.append(nothing)
            continue
        active, w, errors, rest = part
        values, doubts = np.zeros(size), np.zeros(size)
        values[live[active]] = w * spread / sizes[live[active]]
        doubts[live[active]] = errors * spread / sizes[live[active]]
        noise = spread * np.sqrt(rest / count)
        criterion = count * np.log(max(noise, floor) ** 2) + len(active) * np.log(count)
        found.append(Weights(values, doubts, float(noise), float(criterion)))
    return found


def _nothing(count: int, size: int, spread: float, floor: float) -> Weights:
    return Weights(
        np.zeros(size), np.zeros(size), float(spread), float(count * np.log(max(spread, floor, 1e-300) ** 2))
    )


def _of_one(X: Any, y: Any, count: int, least: float) -> tuple[Any, Any, Any, float] | None:
    """Return the active weights of one target, values, errors and remaining squares; None if all are zero."""
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
        certain = np.abs(w) > SIGNIFICANCE * np.sqrt(variance)
        if certain.all():
            break
        # remove the less certain half of the insignificant ones at a time: others may take over their effect
        doubt = np.abs(w) / np.sqrt(variance)
        active = active[doubt >= min(SIGNIFICANCE, np.median(doubt[~certain]) * (1.0 + 1e-9))]
        if not len(active):
            return None
        beta = max(count - len(active), 1.0) / max(
            _posterior(X[:, active], y, alpha[active], beta)[2], count * least**2
        )
    return active, w, np.sqrt(variance), rest


def _posterior(X: Any, y: Any, alpha: Any, beta: float) -> tuple[Any, Any, float]:
    """Return mean and variance of the weights, and the remaining sum of squares."""
    k = len(alpha)
    stacked = np.vstack([np.sqrt(beta) * X, np.diag(np.sqrt(alpha))])
    Q, R = np.linalg.qr(stacked)
    w = np.linalg.solve(R, Q.T @ np.concatenate([np.sqrt(beta) * y, np.zeros(k)]))
    inverse = np.linalg.inv(R)
    rest = X @ w - y
    return w, np.sum(inverse**2, axis=1), float(rest @ rest)
