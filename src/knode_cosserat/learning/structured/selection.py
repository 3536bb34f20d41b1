"""Forward selection of terms by held-out error.

The remainder of an incomplete set of functions is not noise. Selection by evidence would then add many terms,
which overfit. Instead, terms are added one by one, each time the one that lowers the error on held-out data
most (whole trajectories, or parts of a single one), until none lowers it enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

#: a term stays if it lowers the held-out squared error by this part
GAIN = 0.05
MOST_TERMS = 12
#: number of folds of the rows of a single trajectory
PARTS = 3


class Moments(NamedTuple):
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


def moments(features: Float[Any, "S k"], values: Float[Any, "S n"], fold: Any) -> list[Moments]:
    """Return the moments of every fold."""
    parts = [(features[fold == k], values[fold == k]) for k in np.unique(fold)]
    return [Moments(X.T @ X, X.T @ y, np.sum(y * y, axis=0)) for X, y in parts]


def held_out_error(parts: Sequence[Moments], columns: Any) -> float:
    """Return the cross-validated sum of squared errors: each fold is predicted from the others."""
    total = Moments(*(sum(each) for each in zip(*parts, strict=True)))
    error = 0.0
    for part in parts:
        G, b = total.G - part.G, total.b - part.b
        w = _solution(G[np.ix_(columns, columns)], b[columns])
        own = part.G[np.ix_(columns, columns)]
        error += float(
            np.sum(part.c - 2.0 * np.sum(w * part.b[columns], axis=0) + np.sum(w * (own @ w), axis=0))
        )
    return max(error, 0.0)


def selected_groups(parts: Sequence[Moments], groups: Sequence[Any], floor: float) -> tuple[list[int], float]:
    """Return the selected groups of columns, and their held-out error; stops at the error `floor`."""
    taken: list[int] = []
    columns = np.zeros(0, dtype=int)
    error = held_out_error(parts, columns)
    while len(taken) < MOST_TERMS and error > floor:
        rest = [k for k in range(len(groups)) if k not in taken]
        trials = [held_out_error(parts, np.concatenate([columns, groups[k]])) for k in rest]
        if not rest or min(trials) > (1.0 - GAIN) * error:
            break
        best = rest[int(np.argmin(trials))]
        error = min(trials)
        taken.append(best)
        columns = np.concatenate([columns, groups[best]])
    return taken, error


def _solution(G: Any, b: Any) -> Any:
    """Solve least squares from moments, in units in which every feature has size one."""
    size = np.sqrt(np.maximum(np.diag(G), 1e-300))
    scaled = G / size[:, None] / size[None, :] + 1e-11 * np.eye(len(G))
    return np.linalg.solve(scaled, b / size[:, None]) / size[:, None]
