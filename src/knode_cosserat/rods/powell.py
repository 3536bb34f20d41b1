"""Powell's hybrid method for many small systems of equations at once.

The method and its constants are those of MINPACK's `hybrd` (Moré, Garbow & Hillstrom 1980), which
`scipy.optimize.root` calls for one system: a dogleg between Gauss-Newton and scaled gradient, with Broyden's
updates of the derivatives. Problems with several solutions therefore have the same one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

#: relative step of forward differences, relative tolerance of x, and most rounds
STEP, TOLERANCE, ROUNDS = 1.49e-8, 1.49e-8, 100
#: radius of the first step, in units of the scaled start, or as such from zero
FACTOR = 100.0
#: reductions below which a radius shrinks, and a step is refused
POOR, REFUSED = 0.1, 1e-4
#: failed steps after which derivatives are computed anew
FAILED = 2
#: rounds in a row that bring too little after which there is none: any, and those after new derivatives
SLOW, STUCK = 10, 5


def roots(
    function: Callable[[Float[np.ndarray, "B n"]], Float[np.ndarray, "B n"]], start: Float[np.ndarray, "B n"]
) -> tuple[Float[np.ndarray, "B n"], Bool[np.ndarray, " B"]]:
    """Return zeros of a function of rows, found from a start each, and which of them were found."""
    x = np.array(start, dtype=float)
    f, count = function(x), x.shape[1]
    J = _derivatives(function, x, f)
    diag = _positive(np.linalg.norm(J, axis=1))
    delta = _first_radius(diag, x)
    good, bad = np.zeros(len(x), dtype=int), np.zeros(len(x), dtype=int)
    found, lost, slow, stuck, recent = (np.zeros(len(x), dtype=kind) for kind in (bool, bool, int, int, bool))
    recent[:] = True
    #: before the first step that was accepted
    begun = np.zeros(len(x), dtype=bool)
    for _ in range(ROUNDS * count):
        p = _dogleg(J, diag, f, delta)
        length = np.linalg.norm(diag * p, axis=1)
        delta = np.where(begun, delta, np.minimum(delta, length))
        f_next = function(x + p)
        linear = f + np.einsum("bij,bj->bi", J, p)
        before, after, expected = (np.linalg.norm(it, axis=1) for it in (f, f_next, linear))
        known = _positive(before)
        actual = np.where(after < before, 1.0 - (after / known) ** 2, -1.0)
        promised = np.where(expected < before, 1.0 - (expected / known) ** 2, 0.0)
        ratio = np.where(promised > 0.0, actual / _positive(promised), 0.0)
        fails = ~(ratio >= POOR)
        good, bad = np.where(fails, 0, good + 1), np.where(fails, bad + 1, 0)
        wider = np.where((ratio >= 0.5) | (good > 1), np.maximum(delta, 2.0 * length), delta)
        wider = np.where(np.abs(ratio - 1.0) <= 0.1, 2.0 * length, wider)
        active = ~(found | lost)
        delta = np.where(~active, delta, np.where(fails, 0.5 * delta, wider))
        accepted = (ratio >= REFUSED) & active
        # Broyden's update, in scaled coordinates, of steps that are accepted or refused
        change = (f_next - linear) / _positive(length**2)[:, None]
        updated = J + change[:, :, None] * (diag**2 * p)[:, None, :]
        J = np.where(np.isfinite(updated).all(axis=(1, 2))[:, None, None], updated, J)
        begun |= accepted
        x, f = np.where(accepted[:, None], x + p, x), np.where(accepted[:, None], f_next, f)
        slow = np.where(actual >= 1e-3, 0, slow + 1)
        stuck = np.where(actual >= 0.1, 0, stuck + recent)
        near = (delta <= TOLERANCE * np.linalg.norm(diag * x, axis=1)) | (np.linalg.norm(f, axis=1) == 0.0)
        found |= active & near
        lost |= active & ~near & ((slow >= SLOW) | (stuck >= STUCK))
        if (found | lost).all():
            break
        anew = (bad == FAILED) & ~(found | lost)
        recent = anew
        if anew.any():
            J[anew] = _derivatives(function, x, f)[anew]
            lengths = np.linalg.norm(J, axis=1)
            renewed = np.where(begun[:, None], np.maximum(diag, lengths), _positive(lengths))
            diag = np.where(anew[:, None], renewed, diag)
            delta = np.where(anew & ~begun, _first_radius(diag, x), delta)
    return x, found


def _positive(sizes: np.ndarray) -> np.ndarray:
    return np.where(sizes > 0.0, sizes, 1.0)


def _first_radius(diag: np.ndarray, x: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(diag * x, axis=1)
    return np.where(size > 0.0, FACTOR * size, FACTOR)


def _derivatives(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Return forward differences (B, n, n)."""
    columns = []
    for k in range(x.shape[1]):
        h = STEP * np.abs(x[:, k])
        h = np.where(h > 0.0, h, STEP)
        moved = x.copy()
        moved[:, k] += h
        columns.append((function(moved) - f) / h[:, None])
    return np.stack(columns, axis=2)


def _dogleg(J: np.ndarray, diag: np.ndarray, f: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """Return the step within the scaled radius on the path from the scaled gradient to Gauss-Newton's."""
    newton = -np.einsum("bij,bj->bi", np.linalg.pinv(J), f)
    size = np.linalg.norm(diag * newton, axis=1)
    gradient = -np.einsum("bij,bi->bj", J, f) / diag
    steep = np.linalg.norm(gradient, axis=1)
    down = gradient / (_positive(steep)[:, None] * diag)
    bend = np.linalg.norm(np.einsum("bij,bj->bi", J, down), axis=1)
    best = steep / _positive(bend) ** 2
    # between the lowest point along the gradient and Gauss-Newton's; a start that is a zero has no radius
    radius = _positive(delta)
    cosine = np.einsum("bi,bi->b", diag * down, diag * newton) / _positive(size)
    linear = _between(best / radius, size / radius, cosine)
    part = np.where(best >= delta, 0.0, linear)
    inner = np.where(best >= delta, delta, np.minimum(best, delta))
    step = (1.0 - part)[:, None] * inner[:, None] * down + part[:, None] * newton
    return np.where((size <= delta)[:, None], newton, step)


def _between(a: np.ndarray, b: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Return the part t at which (1 - t) a + t b (lengths over the radius, an angle between) has length 1."""
    square = a * a + b * b - 2.0 * a * b * cosine
    half = a * (b * cosine - a)
    root = np.sqrt(np.maximum(half**2 + square * (1.0 - a * a), 0.0))
    return np.clip((root - half) / _positive(square), 0.0, 1.0)
