"""Signals of tendon tensions over time, as arrays (steps, tendons) in N; see `controls`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.csv_rows import SAME_TIME
from knode_cosserat.errors import KnodeCosseratError

Tensions = Float[np.ndarray, "steps tendons"]
#: time in each step at which a signal is evaluated
Sampled = Literal["middle", "end"]


class ControlsError(KnodeCosseratError, ValueError):
    """Controls are not possible, or a file of them cannot be read; the message is one line."""

    code = "controls"


def constant(tension: float, steps: int, *, tendons: int = 4) -> Tensions:
    """Return one constant tension (N) in all tendons.

    Raises:
        ControlsError: an argument is not possible; likewise in every function here.
    """
    require_numbers(tension=tension)
    require_counts(steps=steps, tendons=tendons)
    return checked_tensions(np.full((steps, tendons), float(tension)), "constant")


def sine(
    period: float, steps: int, dt: float, *, base: float = 6.0, amplitude: float = 1.0, tendons: int = 4,
    sampled: Sampled = "middle",
) -> Tensions:  # fmt: skip
    """Return τ_k = base + amplitude sin(2πt/period + 2πk/tendons) in N, k = 0, 1, …; period in s."""
    require_numbers(base=base, amplitude=amplitude)
    require_counts(tendons=tendons)
    phase = 2 * np.pi * np.arange(tendons) / tendons
    t = step_times(steps, dt, sampled)
    _require_period(period, float(t[-1]))
    return checked_tensions(sine_values(t[:, None], period, base, amplitude, phase), "sine")


def step(
    height: float, steps: int, dt: float, *, base: float = 5.0, at: float = 1.5,
    tendons: Sequence[int] = (0, 3), count: int = 4, sampled: Sampled = "middle",
) -> Tensions:  # fmt: skip
    """Return `base` (N) in `count` tendons, and base + height in the named tendons from t = at (s)."""
    require_numbers(at=at)
    t = step_times(steps, dt, sampled)
    return _raised("step", height, step_values(t, 1.0, 0.0, at, dt), base, tendons, count)


def ramp(
    height: float, steps: int, dt: float, *, base: float = 5.0, start: float = 0.0, end: float | None = None,
    tendons: Sequence[int] = (0, 3), count: int = 4, sampled: Sampled = "middle",
) -> Tensions:  # fmt: skip
    """Return `base` (N) in `count` tendons, with a linear rise by `height` (N) in the named tendons.

    The rise is from `start` to `end` (s), by default until the last step. The tension is constant after.
    """
    t = step_times(steps, dt, sampled)
    if end is None:
        end = float(t[-1])
        require_numbers(start=start)
        if end <= start:
            raise ControlsError(
                f"ramp: start is {start!r} s; allowed is a time before the last step, {end:g} s; "
                f"use {steps_until(start, dt, sampled, after=True)} steps or more, or an earlier start"
            )
    require_numbers(start=start, end=end)
    if end <= start:
        raise ControlsError(f"ramp: end is {end!r} s; allowed is a time after its start, {start!r} s")
    return _raised("ramp", height, ramp_values(t, 1.0, 0.0, start, end), base, tendons, count)


def random(
    steps: int, *, low: float = 5.0, high: float = 10.0, seed: int = 0, tendons: int = 4, hold: int = 1
) -> Tensions:
    """Return independent uniform samples between `low` and `high` (N), each held for `hold` steps."""
    require_counts(steps=steps, tendons=tendons, hold=hold)
    require_counts(least=0, seed=seed)
    require_numbers(low=low, high=high)
    if high < low:
        raise ControlsError(f"random: high is {high!r} N; allowed is a tension from low, {low!r} N, on")
    draws = np.random.default_rng(seed).uniform(low, high, (-(-steps // hold), tendons))
    return checked_tensions(np.repeat(draws, hold, axis=0)[:steps], "random")


# values of signals at times t (s), without checks; numbers may be arrays that broadcast


def sine_values(t: Any, period: Any, base: Any, amplitude: Any, phase: Any) -> Any:
    """Return base + amplitude sin(2πt/period + phase)."""
    return base + amplitude * np.sin(2.0 * np.pi * t / period + phase)


def step_values(t: Any, height: Any, base: Any, at: Any, dt: Any) -> Any:
    """Return `base`, and base + height from the time `at` on, to rounding errors of steps `dt` (s)."""
    return base + height * (t >= at - SAME_TIME * dt)


def ramp_values(t: Any, height: Any, base: Any, start: Any, end: Any) -> Any:
    """Return `base` with a linear rise by `height` from `start` to `end`."""
    return base + height * np.clip((t - start) / (end - start), 0.0, 1.0)


def _raised(
    signal: str, height: float, part: np.ndarray, base: float, tendons: Sequence[int], count: int
) -> Tensions:
    require_counts(count=count)
    require_numbers(height=height, base=base)
    if not set(tendons) <= set(range(count)):
        raise ControlsError(f"{signal}: tendons is {tendons!r}; allowed is numbers from 0 to {count - 1}")
    tensions = np.full((len(part), count), float(base))
    tensions[:, [int(k) for k in tendons]] += height * part[:, None]
    return checked_tensions(tensions, signal)


def step_times(steps: int, dt: float, sampled: Sampled = "middle") -> np.ndarray:
    """Return the times (s) at which a signal is evaluated: the middles of steps of dt (s), or their ends."""
    require_counts(steps=steps)
    require_positive("dt", dt)
    if sampled not in get_args(Sampled):
        raise ControlsError(f'sampled is {sampled!r}; allowed is "middle" or "end"')
    return (np.arange(1, steps + 1) - _EARLIER[sampled]) * dt


#: parts of a step from the time at which a signal is evaluated to its end
_EARLIER = {"middle": 0.5, "end": 0.0}


def steps_until(t: float, dt: float, sampled: Sampled, after: bool = False) -> int:
    """Return the number of steps of dt (s) of which the last is evaluated at time t (s), or later.

    With `after`, only later.
    """
    steps = t / dt + _EARLIER[sampled]
    return int(np.floor(steps + SAME_TIME)) + 1 if after else int(np.ceil(steps - SAME_TIME))


def checked_tensions(tensions: Tensions, signal: str) -> Tensions:
    """Return tensions that are finite and not negative. Raises `ControlsError` otherwise."""
    wrong = tensions[~(np.isfinite(tensions) & (tensions >= 0.0))]
    if wrong.size:
        raise ControlsError(f"{signal}: a tension is {wrong.min():g} N; allowed is 0 or more (a pull)")
    return tensions


def require_numbers(**values: Any) -> None:
    """Raise `ControlsError` unless all values are finite numbers."""
    for name, value in values.items():
        if not _is_number(value):
            raise ControlsError(f"{name} is {value!r}; allowed is a finite number")


def require_positive(name: str, value: Any) -> None:
    """Raise `ControlsError` unless a time (s) is above 0."""
    if not (_is_number(value) and value > 0.0):
        raise ControlsError(f"{name} is {value!r}; allowed is a number of seconds above 0")


def _require_period(period: Any, last: float) -> None:
    """Raise `ControlsError` if 2πt/period is not finite at all times up to the last (s)."""
    require_positive("period", period)
    least = 8.0 * (last / np.finfo(float).max)
    if not period > least:
        raise ControlsError(f"period is {period!r}; allowed is a number of seconds above {least:g}")


def require_counts(least: int = 1, **values: Any) -> None:
    """Raise `ControlsError` unless all values are whole numbers, at least `least`."""
    for name, value in values.items():
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
            raise ControlsError(f"{name} is {value!r}; allowed is a whole number from {least} on")


def _is_number(value: Any) -> bool:
    if not isinstance(value, int | float | np.integer | np.floating) or isinstance(value, bool):
        return False
    return bool(np.isfinite(value))


def require_effect(
    signal: str, arguments: dict[str, Any], values: Float[np.ndarray, "steps ..."], steps: int, dt: float,
    sampled: Sampled = "middle",
) -> None:  # fmt: skip
    """Raise `ControlsError` if a signal does nothing during a run: a step or ramp after the end, for example.

    Args:
        signal: "sine", "step" or "ramp".
        arguments: its arguments by name. A height or amplitude of 0 is taken as intended.
        values: the signal in all steps.
        steps: number of time steps.
        dt: time step (s).
        sampled: time in each step at which it was evaluated.
    """
    size = abs(arguments["amplitude" if signal == "sine" else "height"])
    if size == 0.0 or np.any(np.ptp(values, axis=0) > 1e-9 * size):
        return
    if signal == "sine":
        period = arguments["period"]
        raise ControlsError(
            f"the sine has the same value at every time step: its period is {period:g} s and the time step "
            f"{dt:g} s; use a longer period, or a time step of at most {period / 8:g} s"
        )
    option = "at" if signal == "step" else "start"
    begin = arguments[option]
    if (
        begin <= (1.0 - _EARLIER[sampled]) * dt
    ):  # a step that acts from the first time step on is constant, too
        return
    needed = steps_until(begin, dt, sampled, after=signal == "ramp")
    raise ControlsError(
        f"the {signal} starts at {begin:g} s, after the end of the run ({steps} steps of {dt:g} s: "
        f"{steps * dt:g} s); use {needed} steps or more, or {option}=0"
    )
