"""Limits of commanded tensions, and latency of commands."""

from __future__ import annotations

from collections import deque

import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware.description import require_limits
from knode_cosserat_hardware.driver import HardwareError, Latency, Limits

#: longest time between commands that a rate counts (s): a pause allows no jump; and that of the first command
LONGEST_STEP, FIRST_STEP = 0.1, 0.02


class TensionLimiter:
    """Reduces commanded tensions to limits of size, rate and sum.

    Args:
        limits: the limits.
        count: number of tendons.

    Raises:
        HardwareError: the limits contradict each other, or all tendons at their low limit exceed the total.
    """

    def __init__(self, limits: Limits, count: int):
        require_limits(limits)
        if limits.low * count > limits.total:
            raise HardwareError(
                f"total must be at least {count} times low, {limits.low * count:g} N (got {limits.total:g})"
            )
        self.limits = limits
        self.count = count
        self.reset(-np.inf)

    def reset(self, now: float) -> None:
        """Start at zero tension, at a time (s)."""
        self._last = np.zeros(self.count)
        self._time = now - FIRST_STEP

    def reduced(self, tension: Float[np.ndarray, " c"], now: float) -> Float[np.ndarray, " c"]:
        """Return tensions (N) within the limits, and remember them as the last ones.

        Rates are limited against the last tensions and the time since (0.1 s at most). A rising tendon is
        held back further if the sum would be too large.

        Args:
            tension: wanted tensions (N).
            now: time (s).

        Raises:
            HardwareError: a tension is not finite, or their number is wrong.
        """
        limits, wanted = self.limits, checked_tensions(tension, self.count)
        step = limits.rate * min(max(now - self._time, 0.0), LONGEST_STEP)
        target = np.clip(wanted, limits.low, limits.high)
        excess = target.sum() - limits.total
        if excess > 0.0:
            # reduced in proportion above the low limit
            above = target - limits.low
            target = target - above * (excess / above.sum())
        change = np.clip(target - self._last, -step, step)
        rise, fall = np.maximum(change, 0.0), np.minimum(change, 0.0)
        # rounding makes the room of a full sum slightly negative
        room = max(limits.total - self._last.sum() - fall.sum(), 0.0)
        if rise.sum() > room:
            rise *= room / rise.sum()
        self._last = np.maximum(self._last + rise + fall, 0.0)
        self._time = now
        result: Float[np.ndarray, " c"] = self._last.copy()
        return result


def checked_tensions(tension: Float[np.ndarray, " c"], count: int) -> Float[np.ndarray, " c"]:
    """Return tensions (N) as an array of floats.

    Raises:
        HardwareError: a tension is not finite, or their number is wrong.
    """
    try:
        wanted = np.asarray(tension, dtype=float)
    except (TypeError, ValueError):
        raise HardwareError(f"tensions must be {count} numbers in N (got {str(tension)[:60]})") from None
    if wanted.shape != (count,):
        raise HardwareError(f"tensions must be {count} numbers in N (got an array of shape {wanted.shape})")
    if not np.all(np.isfinite(wanted)):
        raise HardwareError(
            f"tensions must be finite (got {wanted.tolist()}); the last command stays in force"
        )
    return wanted


class LatencyWindow:
    """Latencies of the last commands (s)."""

    def __init__(self, size: int = 1000):
        self._values: deque[float] = deque(maxlen=size)

    def add(self, latency: float) -> None:
        """Add the latency of one command (s)."""
        self._values.append(latency)

    def summary(self) -> Latency:
        """Return median, 99th percentile and number; NaN without any."""
        if not self._values:
            return Latency(float("nan"), float("nan"), 0)
        values = np.array(self._values)
        return Latency(float(np.median(values)), float(np.quantile(values, 0.99)), len(values))
