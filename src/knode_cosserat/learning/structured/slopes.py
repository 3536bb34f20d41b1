"""The slopes of saturating functions, refined together with their weights.

Where the true law saturates, the fixed slopes of an expansion only surround the right one. The weights are
solved for inside (variable projection, Golub & Pereyra 1973), so that the search is over the slopes alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

#: how far a slope may go, either way
FURTHEST = 30.0


def refined(
    build: Callable[[Any], Float[Any, "S k"]],
    target: Float[Any, " S"],
    used: Float[Any, " k"],
    slopes: Float[Any, " slopes"],
    owned: Float[Any, "slopes k"],
    kinds: Sequence[Any],
) -> Float[Any, " slopes"]:
    """Slopes with which the features in use explain the target best.

    Args:
        build: features (S, k) from slopes.
        target: (S,).
        used: which features have a weight.
        slopes: where to start.
        owned: which features each slope belongs to.
        kinds: of each slope; those of a kind stay apart, because two that meet are no better than one.
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
    """How far each logarithm may go: a long way, but only near the middle to the next of its kind."""
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
