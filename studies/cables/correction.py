"""A learned correction of predicted markers: linear in the motion of the grips and the predicted shape.

It adds a displacement to the rod's prediction, which grows from nothing within the first 0.3 s. The method is
ridge regression. Its strength is chosen by leaving out one motion at a time, and it is kept only where that
pays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from studies.cables import frames
from studies.cables.model import DT

#: time in which the correction grows (s): at the start the markers are known
GROWTH = 0.3
#: strengths of the ridge that are compared, by the number of rows
STRENGTHS = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
#: one in so many frames is learned from
EVERY = 5
#: least gain on motions left out, as a part of the error
LEAST_GAIN = 0.02


class Correction(NamedTuple):
    """Weights of features, and how these are scaled."""

    weights: Float[np.ndarray, "f k"]
    mean: Float[np.ndarray, " f"]
    scale: Float[np.ndarray, " f"]

    @classmethod
    def fitted(cls, rows: Sequence[tuple[Any, Any]], strength: float) -> Self:
        """Return the correction by ridge regression, from features and wanted corrections of motions."""
        features, wanted = (np.concatenate([row[k] for row in rows]) for k in (0, 1))
        mean, scale = features.mean(axis=0), features.std(axis=0) + 1e-9
        matrix = np.concatenate([(features - mean) / scale, np.ones((len(features), 1))], axis=1)
        square = matrix.T @ matrix + strength * len(matrix) * np.diag([1.0] * (matrix.shape[1] - 1) + [1e-6])
        return cls(np.linalg.solve(square, matrix.T @ wanted), mean, scale)

    def added(self, predicted: Float[np.ndarray, "T M 3"], markers: Any) -> Float[np.ndarray, "T M 3"]:
        """Return predicted free markers with the correction added; only held markers are looked at."""
        values = (features_of(predicted, markers) - self.mean) / self.scale
        change = np.concatenate([values, np.ones((len(values), 1))], axis=1) @ self.weights
        return np.asarray(predicted + _growth(len(predicted)) * change.reshape(predicted.shape))


def features_of(predicted: Float[np.ndarray, "T M 3"], markers: Any) -> Float[np.ndarray, "T f"]:
    """Return the features of each frame: grips relative to each other, their velocities, predicted shape."""
    held = markers[2:, [0, 1, -2, -1]]
    velocity = (markers[2:, [1, -2]] - markers[1:-1, [1, -2]]) / DT
    parts = [
        held[:, 2] - held[:, 1],
        frames.unit(held[:, 1] - held[:, 0]),
        frames.unit(held[:, 3] - held[:, 2]),
        velocity.reshape(len(held), -1),
        (predicted - held[:, 1:2]).reshape(len(held), -1),
    ]
    return np.concatenate(parts, axis=1)


def learned_correction(
    predicted: Sequence[Float[np.ndarray, "T M 3"]], motions: Sequence[Float[np.ndarray, "T N 3"]]
) -> tuple[Correction | None, float]:
    """Return the correction that is best on motions left out one at a time, and its gain there.

    None where it gains less than 2 %, or fewer than three motions are given.
    """
    if len(motions) < 3:
        return None, 0.0
    rows = []
    for free, markers in zip(predicted, motions, strict=True):
        wanted = (markers[2:, 2:-2] - free).reshape(len(free), -1)
        grown = slice(min(round(GROWTH / DT), len(free) // 2), None, EVERY)
        rows.append((features_of(free, markers)[grown], wanted[grown]))
    before = np.mean([np.abs(m[2:, 2:-2] - free).mean() for free, m in zip(predicted, motions, strict=True)])
    if before == 0.0:
        return None, 0.0
    errors = []
    for strength in STRENGTHS:
        left = []
        for k, (free, markers) in enumerate(zip(predicted, motions, strict=True)):
            others = [row for i, row in enumerate(rows) if i != k]
            fitted = Correction.fitted(others, strength)
            left.append(np.abs(fitted.added(free, markers) - markers[2:, 2:-2]).mean())
        errors.append(float(np.mean(left)))
    gain = float(1.0 - min(errors) / before)
    if not gain > LEAST_GAIN:
        return None, gain
    strength = STRENGTHS[int(np.argmin(errors))]
    return Correction.fitted(rows, strength), gain


def _growth(count: int) -> Float[np.ndarray, "T 1 1"]:
    return (1.0 - np.exp(-DT * np.arange(1, count + 1) / GROWTH))[:, None, None]
