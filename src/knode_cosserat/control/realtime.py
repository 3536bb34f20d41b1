"""Choice of a prediction whose computation fits into a period of control, by its measured time."""

from __future__ import annotations

import contextlib
import gc
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.control.references import constant
from knode_cosserat.errors import KnodeCosseratError

#: part of a period that computations may take by default: the rest is for the robot's interface and jitter
SHARE = 0.6
#: shortest and longest horizon (s) that are chosen, and the longest step of a prediction (s)
SHORTEST, LONGEST, COARSEST = 0.3, 1.0, 0.05
#: fewest and most knots: half of the steps in between
FEWEST, MOST = 4, 8
#: ratio of the numbers of steps of neighbouring candidates
RATIO = 0.8
#: periods before a measurement, for compilation and a motion of the robot, and periods that are measured
BEFORE, MEASURED = 4, 15
#: time (s) in which the controls of a measurement swing once, and their amplitude as a part of the range
SWING, AMPLITUDE = 1.0, 0.3


class RealtimeError(KnodeCosseratError, ValueError):
    """No prediction fits into the period; one line says which period would do."""

    code = "realtime"


class Size(NamedTuple):
    """Size of a prediction: steps, knots of the plan, and periods in a step."""

    horizon: int
    knots: int
    stride: int = 1

    def described(self, dt: float) -> str:
        """Return the size in words, for periods of dt (s)."""
        step = self.stride * dt
        return (
            f"horizon {self.horizon * step:.3g} s in {self.horizon} steps of {1e3 * step:.3g} ms, "
            f"{self.knots} knots"
        )


class ChosenSize(NamedTuple):
    """Size of a prediction that was chosen for a period, and the measured time of one period's work."""

    size: Size
    #: period of control, and median time of the computations in a period (s)
    dt: float
    seconds: float

    def __str__(self) -> str:
        return f"{self.size.described(self.dt)}: {1e3 * self.seconds:.1f} ms of {1e3 * self.dt:g} ms a period"


def candidates(dt: float) -> list[Size]:
    """Return the sizes that are tried for a period dt (s), from the best and slowest to the fastest.

    Steps are as short as a period as long as the horizon is not shorter than `SHORTEST`, because a plan is
    less accurate with longer steps. Later candidates have fewer steps, and not more knots.
    """
    found: list[Size] = []
    steps, stride = math.inf, 1
    while stride == 1 or stride * dt <= COARSEST:
        step = stride * dt
        most = max(FEWEST, round(LONGEST / step))
        steps = min(most, steps - 1)
        while steps >= max(FEWEST, SHORTEST / step - 1e-9):
            found.append(Size(int(steps), min(MOST, max(FEWEST, int(steps) // 2)), stride))
            steps = min(steps - 1, round(RATIO * steps))
        steps = found[-1].horizon if found else steps
        stride += 1
    return found


def choose_size(
    seconds_of: Callable[[Size], float], dt: float, share: float, sizes: Sequence[Size] | None = None
) -> ChosenSize:
    """Return the first of some sizes, in falling order of their time, that takes the share of a period.

    Args:
        seconds_of: measured time (s) of the work in a period, by the size of the prediction.
        dt: period (s).
        share: part of it.
        sizes: by default those of `candidates`.

    Raises:
        RealtimeError: not even the last one does.
        ValueError: a share that is not allowed.
    """
    if not 0.0 < share <= 1.0:
        raise ValueError(f"realtime is {share}; allowed is above 0 to 1, the part of a period, or True")
    sizes = candidates(dt) if sizes is None else sizes
    times: dict[int, float] = {}
    first, last = 0, len(sizes) - 1
    while first < last:
        middle = (first + last) // 2
        times[middle] = seconds_of(sizes[middle])
        if times[middle] <= share * dt:
            last = middle
        else:
            first = middle + 1
    if first not in times:
        times[first] = seconds_of(sizes[first])
    found = ChosenSize(sizes[first], dt, times[first])
    if found.seconds > share * dt:
        raise RealtimeError(
            f"no prediction fits into {100.0 * share:g} % of the period of {1e3 * dt:g} ms; the fastest is "
            f"{found}; allowed is a period of at least {1e3 * found.seconds / share:.1f} ms"
        )
    return found


def seconds_in_period(controller: Any, clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the median time (s) of a period's work of a controller with an observer, while its model moves.

    The model moves by controls that swing through their range, and what the observer predicts is measured. A
    copy of the controller does the work: the controller stays as it is. Infinite if nothing is solved.
    """
    controller, limits, dt = controller.copied(), controller.limits, controller.dt
    low, high = np.asarray(limits.low), np.asarray(limits.high)
    phases = 2.0 * np.pi * np.arange(len(low)) / len(low)
    control, measured = np.asarray(limits.safe), np.full(controller.observer.output.size, np.nan)
    reference = constant(np.zeros(controller.target.size).tolist())
    times = list[float]()
    with no_garbage_collection():
        controller.prepare(0.0, reference)
        for k in range(BEFORE + MEASURED):
            swing = 0.5 + AMPLITUDE * np.sin(2.0 * np.pi * k * dt / SWING + phases)
            control = limits.applied(low + swing * (high - low), control, dt)
            began = clock()
            command = controller.command(k * dt, measured, reference)
            sent = clock()
            # the plan holds the control that swings
            controller.reset(control)
            moved = clock()
            controller.advance(control)
            controller.prepare((k + 1) * dt, reference)
            if k >= BEFORE and not command.status.is_fallback:
                times.append(clock() - moved + sent - began)
            measured = controller.observer.expected
    return statistics.median(times) if times else math.inf


@contextlib.contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Suspend Python's garbage collector, which interrupts a period for some milliseconds."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
