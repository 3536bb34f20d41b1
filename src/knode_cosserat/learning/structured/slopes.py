"""Refinement of the slopes of saturating functions together with their weights.

If the true law saturates, its slope lies between the fixed slopes of an expansion. The weights are
solved for inside (variable projection, Golub & Pereyra 1973), so that the search is over the slopes alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

#: largest factor by which a slope may change, in both directions
FURTHEST = 30.0


def refined_slopes(
    build: Callable[[Any], Float[Any, "S k"]],
    target: Float[Any, " S"],
    used: Float[Any, " k"],
    slopes: Float[Any, " slopes"],
    owned: Float[Any, "slopes k"],
    kinds: Sequence[Any],
) -> Float[Any, " slopes"]:
    """Return the slopes with which the used features explain the target best.

    Args:
        build: features (S, k) from slopes.
        target: (S,).
        used: true for features with a weight.
        slopes: initial slopes.
        owned: true where a feature depends on a slope.
        kinds: kind of each slope; slopes of one kind are kept apart, because two equal ones are redundant.
    """
    # imported here: it takes a third of a second
    from scipy.optimize import least_squares

    free = np.flatnonzero(owned[:, used].any(axis=1))
    if not len(free):
        return slopes
    scale = np.sqrt(np.mean(target**2))

    def at(logarithms: Any) -> Any:
        moved = slopes.copy()
        moved[free] = np.exp(logarithms)
        return moved

    def left(logarithms: Any) -> Any:
        features = build(at(logarithms))[:, used]
        Q, _ = np.linalg.qr(features)
        return (target - Q @ (Q.T @ target)) / scale

    start = np.log(slopes[free])
    found = least_squares(
        left, start, bounds=_bounds(start, [kinds[int(k)] for k in free]),
        xtol=1e-12, ftol=1e-14, gtol=1e-14, max_nfev=60,
    )  # fmt: skip
    return at(found.x)


def _bounds(start: Any, kinds: Sequence[Any]) -> tuple[Any, Any]:
    """Return bounds of each logarithm; they stay below the middle to the next slope of the same kind."""
    low, high = start - np.log(FURTHEST), start + np.log(FURTHEST)
    for i, kind in enumerate(kinds):
        for other, same in zip(start, kinds, strict=True):
            if same != kind or other == start[i]:
                continue
            middle = start[i] + 0.4 * (other - start[i])
            if other > start[i]:
                high[i] = min(high[i], middle)
            else:
                low[i] = max(low[i], middle)
    return low, high
