"""Information in differences between simulated and measured rows: normal equations, and correlation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.identification.misfit import Rollout

#: threshold of the Huber loss, in units of the scale
ROBUST = 3.0
#: time between the differences whose correlation is modelled (s), and the order of that model
SPACING, ORDER = 0.05, 8


class NormalEquations(NamedTuple):
    """Normal equations at a point: robust cost, gradient and Gauss-Newton matrix of each recording."""

    cost: Float[np.ndarray, " R"]
    #: number of independent differences
    amount: Float[np.ndarray, " R"]
    gradient: Float[np.ndarray, "R n"]
    matrix: Float[np.ndarray, "R n n"]


def huber(values: Float[np.ndarray, " m"]) -> tuple[np.ndarray, np.ndarray]:
    """Return Huber's cost of scaled differences, and their weights."""
    size = np.abs(values)
    weights = np.where(size <= ROBUST, 1.0, ROBUST / np.maximum(size, ROBUST))
    return np.where(size <= ROBUST, values**2, 2.0 * ROBUST * size - ROBUST**2), weights


def normal_equations(
    rollouts: Sequence[Rollout], units: Sequence[np.ndarray], thinned: float, which: Bool[np.ndarray, " n"]
) -> NormalEquations:
    """Return the normal equations of each rollout; a difference counts 1 / `thinned`.

    `units` are sizes (e,) of the differences of each rollout. Equations of coordinates that are not among
    `which` are zero.
    """
    parts = []
    for rollout, unit in zip(rollouts, units, strict=True):
        scaled = rollout.values / unit
        known = np.isfinite(scaled)
        cost, weights = huber(scaled[known])
        slopes = np.zeros((len(which), int(known.sum())))
        slopes[which] = (rollout.derivatives_by(which) / unit)[:, known]
        weighted = slopes * weights
        sums = cost.sum(), known.sum(), weighted @ scaled[known], weighted @ slopes.T
        parts.append([part / thinned for part in sums])
    return NormalEquations(*(np.array(part) for part in zip(*parts, strict=True)))


def dispersion(
    rollouts: Sequence[Rollout],
    units: Sequence[np.ndarray],
    spacing: Sequence[float],
    free: Bool[np.ndarray, " n"],
) -> float:
    """Return the number of differences that count as one: they are correlated in time and between bodies.

    It is the mean ratio of the variance of an estimate to that from independent differences. The
    autocovariance of each principal component is that of an autoregressive model (den Haan & Levin 1997).

    Args:
        rollouts: differences at the end of a search.
        units: sizes (e,) of the differences of each rollout.
        spacing: time from row to row of each (s); zero if the rows are equilibria.
        free: the coordinates that were searched.
    """
    from scipy.linalg import toeplitz

    count = int(free.sum())
    information, scores = np.zeros((count, count)), np.zeros((count, count))
    for rollout, unit, dt in zip(rollouts, units, spacing, strict=True):
        stride = max(1, round(SPACING / dt)) if dt else 1
        scaled = rollout.values[::stride] / unit
        known = np.isfinite(scaled)
        off = np.where(known, scaled, 0.0)
        weights = np.sqrt(huber(off)[1])
        off *= weights
        slopes = np.where(known, rollout.derivatives_by(free)[:, ::stride] / unit, 0.0) * weights
        information += np.einsum("iae,jae->ij", slopes, slopes) * stride
        sizes, components = np.linalg.eigh(off.T @ off)
        for size, component in zip(sizes, components.T, strict=True):
            if size > 1e-9 * sizes[-1]:
                along = slopes @ component
                covariance = toeplitz(_autocovariance(off @ component))
                scores += along @ covariance @ along.T * stride**2
    ridge = 1e-9 * np.trace(information) * np.eye(count)
    return max(1.0, float(np.trace(np.linalg.solve(information + ridge, scores))) / count)


def _autocovariance(rows: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """Return the autocovariance of an autoregressive model of rows (Yule-Walker)."""
    from scipy.linalg import toeplitz
    from scipy.signal import lfilter

    count = len(rows)
    order = min(ORDER, count // 10)
    lags = np.array([rows[: count - k] @ rows[k:] for k in range(order + 1)]) / count
    if not order:
        return lags[0] * (np.arange(count) == 0)
    matrix = toeplitz(lags[:order]) + 1e-6 * lags[0] * np.eye(order)
    factors = np.linalg.solve(matrix, lags[1:])
    response = lfilter([1.0], np.concatenate([[1.0], -factors]), np.arange(6 * count) == 0)
    spectrum = np.abs(np.fft.rfft(response, 12 * count)) ** 2
    covariance = np.fft.irfft(spectrum)[:count]
    return covariance * (lags[0] / covariance[0])
