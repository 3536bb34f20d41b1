"""Sparse linear regression that finds its own regularisation: automatic relevance determination.

Every weight has a prior of its own, w_i ~ N(0, 1/α_i), and the noise a precision β; all are set to what
makes the data likeliest (MacKay, "Bayesian interpolation", 1992; Tipping, "Sparse Bayesian learning", 2001).
Weights that the data do not ask for go to zero and are taken out. Worked on the triangular factor of the
features, not on their normal equations: data of simulations are exact to ten digits, and squaring would lose
half of them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

#: a weight is taken out when it moves the prediction by less than this part of the noise, over all samples
RELEVANCE = 0.3
MOST_SWEEPS = 100
#: a weight stays if it is this many times its standard error
SIGNIFICANCE = 5.0


class Weights(NamedTuple):
    """Weights (k,), zero where not needed, their standard errors, and the size of what is left (rms)."""

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
    """The few weights with which features explain each target.

    Args:
        features: (S, k).
        targets: (S, n), each on its own.
        floors: what of each target (rms) is known to be noise at least, such as the solver's tolerance.
        weight: how much each sample counts, on average one.
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
    # beside the features' directions only the length of a target counts
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
    """The active weights of one target, their values and errors, and the squares left; None if none is."""
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
        # the least certain half of the doubtful at a time: what one explains another may take over
        doubt = np.abs(w) / np.sqrt(variance)
        active = active[doubt >= min(SIGNIFICANCE, np.median(doubt[~certain]) * (1.0 + 1e-9))]
        if not len(active):
            return None
        beta = max(count - len(active), 1.0) / max(
            _posterior(X[:, active], y, alpha[active], beta)[2], count * least**2
        )
    return active, w, np.sqrt(variance), rest


def _posterior(X: Any, y: Any, alpha: Any, beta: float) -> tuple[Any, Any, float]:
    """Mean and variance of the weights, and the sum of squares that they leave."""
    k = len(alpha)
    stacked = np.vstack([np.sqrt(beta) * X, np.diag(np.sqrt(alpha))])
    Q, R = np.linalg.qr(stacked)
    w = np.linalg.solve(R, Q.T @ np.concatenate([np.sqrt(beta) * y, np.zeros(k)]))
    inverse = np.linalg.inv(R)
    rest = X @ w - y
    return w, np.sum(inverse**2, axis=1), float(rest @ rest)
