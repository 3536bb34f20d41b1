"""Controls of many cases at once, from one word with varied numbers.

`controls.parse` takes a sixth of the time of 20 steps of a tendon robot, and a twentieth for others.
The usual signals of tensions are therefore evaluated for all cases at once. Other words, and cases that
`parse` may refuse, go through `parse` one by one; tests compare both.
"""

from __future__ import annotations

import re
import string
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from knode_cosserat import controls
from knode_cosserat._numbers import numbers_in
from knode_cosserat.controls import ramp_values, sine_values, step_times, step_values
from knode_cosserat.rods.system import System
from knode_cosserat.sweeps._description import SweepError

Array = Any


def placeholders(word: str) -> list[str]:
    """Return the names in braces in a word of controls. Raises `SweepError` for unmatched braces."""
    allowed = "allowed is a name in braces: sine:{period}"
    try:
        names = [name for _, name, _, _ in string.Formatter().parse(word) if name is not None]
    except ValueError as error:
        raise SweepError(f"controls {word!r}: {error}; {allowed}") from None
    for name in names:
        if not re.fullmatch(r"[A-Za-z_][\w-]*", name):
            raise SweepError(f"controls {word!r}: {{{name}}} is no name; {allowed}")
    return list(dict.fromkeys(names))


def case_controls(
    robot: System, word: str, steps: int, dt: float, numbers: Mapping[str, Array]
) -> tuple[Array, dict[int, str]]:
    """Return the controls (cases, steps, c) of cases, and reasons of refused ones, which are zeros.

    `numbers` are the values of the names in braces, one a case.
    """
    layout, values, count = robot.control_layout, None, len(next(iter(numbers.values())))
    varied = {name: numbers[name] for name in placeholders(word)}
    if layout.names == ("tension",):
        with np.errstate(all="ignore"):
            values = _tensions(layout.size, word, step_times(steps, dt), varied, count)
    if values is None:
        values = np.full((count, steps, layout.size), np.nan)
    fair = np.all(np.nan_to_num(values, nan=-1.0, posinf=-1.0) >= 0.0, axis=(1, 2))
    refused: dict[int, str] = {}
    for k in np.flatnonzero(~fair):
        # a Python number prints all its digits
        text = word.format(**{name: value[k].item() for name, value in varied.items()})
        try:
            values[k] = controls.parse(text, steps, dt, robot)
        except controls.ControlsError as error:
            values[k], refused[int(k)] = 0.0, str(error)
    return values, refused


def _tensions(tendons: int, word: str, t: Array, numbers: Mapping[str, Array], count: int) -> Array | None:
    """Return the tensions of all cases; None if the word is not a usual signal of `controls`."""
    values, name = _numbers_of(word, numbers), word.strip().partition(":")[0]
    if values is None:
        return None
    if name == "random":
        seed, low, high, hold = (np.broadcast_to(value[:, 0], count) for value in values)
        fair = (seed == np.round(seed)) & (seed >= 0) & (hold == np.round(hold)) & (hold >= 1) & (low <= high)
        if not np.all(fair & (low >= 0.0)):
            return None
        return np.stack([
            controls.random(len(t), low=a, high=b, seed=int(k), tendons=tendons, hold=int(h))
            for k, a, b, h in zip(seed.tolist(), low.tolist(), high.tolist(), hold.tolist(), strict=True)
        ])  # fmt: skip
    tensions = np.empty((count, len(t), tendons))
    if name == "sine":
        phase = 2 * np.pi * np.arange(tendons) / tendons
        period, base, amplitude = (value[..., None] for value in values)
        tensions[:] = _sine(t[:, None], period, base, amplitude, phase)
        return tensions
    signal = _TENSIONS[name][0](t, *values)[..., None]
    if name == "constant":
        tensions[:] = signal
        return tensions
    if tendons < 4:
        return None  # without the default tendons 1 and 4, `parse` refuses
    tensions[:] = values[1][..., None]
    tensions[:, :, [0, 3]] = signal
    return tensions


def _sine(t: Array, period: Array, base: Array, amplitude: Array, phase: Array) -> Array:
    return np.where(period > 0.0, sine_values(t, period, base, amplitude, phase), np.nan)


def _ramp(t: Array, height: Array, base: Array, start: Array, end: Array) -> Array:
    end = np.where(np.isnan(end), t[-1], end)
    return np.where(end > start, ramp_values(t, height, base, start, end), np.nan)


def _step(t: Array, height: Array, base: Array, at: Array) -> Array:
    return step_values(t, height, base, at, t[0])


def _constant(t: Array, value: Array) -> Array:
    return np.broadcast_to(value, (len(value), len(t)))


#: signals by name: their functions of times and of numbers (cases, 1), and their optional numbers with
#: defaults; NaN: the end of the last step
_TENSIONS: dict[str, tuple[Callable[..., Array], dict[str, float]]] = {
    "sine": (_sine, {"base": 6.0, "amplitude": 1.0}),
    "random": (controls.random, {"low": 5.0, "high": 10.0, "hold": 1.0}),
    "step": (_step, {"base": 5.0, "at": 1.5}),
    "ramp": (_ramp, {"base": 5.0, "start": 0.0, "end": np.nan}),
    "constant": (_constant, {}),
}


def _numbers_of(word: str, numbers: Mapping[str, Array]) -> list[Array] | None:
    """Return the numbers (cases, 1) of a signal in its order; None if the word is not `NAME:NUMBER,…`."""
    name, colon, rest = word.strip().partition(":")
    if name not in _TENSIONS or not colon:
        return None
    defaults = _TENSIONS[name][1]
    first, *entries = (part.strip() for part in rest.split(","))
    texts: dict[str, Any] = {}
    for entry in entries:
        key, equals, text = (part.strip() for part in entry.partition("="))
        if key not in defaults or key in texts or not equals:
            return None
        texts[key] = text
    values = []
    for text in (first, *(defaults | texts).values()):
        if not isinstance(text, str):
            values.append(np.full((1, 1), text))
        elif text.startswith("{") and text.endswith("}"):
            values.append(np.asarray(numbers[text[1:-1]], dtype=float)[:, None])
        elif (constant := numbers_in(text)) is not None and len(constant) == 1:
            values.append(np.full((1, 1), constant[0]))
        else:
            return None
    return values
