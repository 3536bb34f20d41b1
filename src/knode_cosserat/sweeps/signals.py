"""Controls of many cases at once, from one word with varied numbers.

`named_controls.parse` takes some 90 µs a case, a twentieth of the solution of 20 steps. The usual signals are
therefore evaluated for all cases at once. Other words, and cases that `parse` may refuse, go through `parse`
one by one; tests compare both.
"""

from __future__ import annotations

import re
import string
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat import controls, named_controls
from knode_cosserat._files.csv_rows import SAME_TIME
from knode_cosserat._numbers import numbers_in
from knode_cosserat.controls import step_times
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.system import System
from knode_cosserat.sweeps.errors import SweepError

Array = Any


class Signals(NamedTuple):
    """Controls (cases, steps, c), and by case the reasons of refused controls, which are zeros here."""

    controls: Array
    refused: dict[int, str]


def placeholders(word: str) -> list[str]:
    """Return the names in braces in a word of controls. Raises `SweepError` for unmatched braces."""
    try:
        parts = list(string.Formatter().parse(word))
    except ValueError as error:
        raise SweepError(
            f"controls {word!r}: {error}; allowed is a name in braces: sine:{{period}}"
        ) from None
    names = [name for _, name, _, _ in parts if name is not None]
    for name in names:
        if not re.fullmatch(r"[A-Za-z_][\w-]*", name):
            raise SweepError(
                f"controls {word!r}: {{{name}}} is no name; allowed is a name in braces: sine:{{period}}"
            )
    return list(dict.fromkeys(names))


def signals(
    robot: System, word: str, steps: int, dt: float, numbers: Mapping[str, Array], count: int
) -> Signals:
    """Return the controls of `count` cases; `numbers` are the values of the names in braces, one a case."""
    layout = robot.control_layout
    names = placeholders(word)
    if not names:
        one = named_controls.parse(robot, word, steps, dt)
        return Signals(np.broadcast_to(one, (count, *one.shape)), {})
    own = {name: numbers[name] for name in names}
    times = step_times(steps, dt), step_times(steps, dt, "end")
    found = _at_once(layout, word, times, own, count)
    if found is None:
        found = np.full((count, steps, layout.size), np.nan)
    refused: dict[int, str] = {}
    for k in np.flatnonzero(~_allowed(layout, found)):
        text = _substituted(word, {name: values[k] for name, values in own.items()})
        try:
            found[k] = named_controls.parse(robot, text, steps, dt)
        except controls.ControlsError as error:
            found[k], refused[int(k)] = 0.0, str(error)
    return Signals(found, refused)


def _substituted(word: str, values: Mapping[str, Any]) -> str:
    """Return a word with its numbers; a Python number prints all its digits."""
    return word.format(**{name: value.item() for name, value in values.items()})


def _allowed(layout: Layout, found: Array) -> Array:
    """True for cases that `parse` allows."""
    ok = np.all(np.isfinite(found), axis=(1, 2))
    if layout.names == ("tension",):
        ok &= np.all(np.nan_to_num(found) >= 0.0, axis=(1, 2))
    return ok


def _at_once(
    layout: Layout, word: str, times: tuple[Array, Array], numbers: Mapping[str, Array], count: int
) -> Array | None:
    """Return the controls of all cases (cases, steps, c); None for a word that is not a usual signal.

    `times` (s) are those of held controls, and of displacements and rotations, as in `named_controls`.
    """
    with np.errstate(all="ignore"):
        if layout.names == ("tension",):
            return _tensions(layout.size, word, times[0], numbers, count)
        found = np.zeros((count, len(times[0]), layout.size))
        known, given = named_controls.labels(layout), set()
        for entry in word.split(";"):
            name, _, rest = (part.strip() for part in entry.partition("="))
            values = _values(rest, numbers, _NAMED)
            if values is None or (name not in known and name not in layout.names) or name in given:
                return None
            given.add(name)
            columns = layout.slice(name) if name in layout.names else known.index(name)
            t = times[int(np.max(layout.moving[columns]))]
            signal = _NAMED[rest.partition(":")[0]].make(t, *values)
            found[:, :, columns] = signal if name not in layout.names else signal[:, :, None]
        if len({name.rpartition("_")[0] for name in given if name not in layout.names} & given):
            return None  # a field, and one of its numbers
        return found


def _tensions(tendons: int, word: str, t: Array, numbers: Mapping[str, Array], count: int) -> Array | None:
    values = _values(word, numbers, _TENSIONS)
    if values is None:
        return None
    name = word.strip().partition(":")[0]
    if name == "random":
        return _random(tendons, len(t), values, count)
    found = np.empty((count, len(t), tendons))
    if name == "sine":
        phase = 2 * np.pi * np.arange(tendons) / tendons
        period, base, amplitude = (each[..., None] for each in values)
        found[:] = _sine(t[:, None], period, base, amplitude, phase)
        return found
    signal = _TENSIONS[name].make(t, *values)[..., None]
    if name == "constant":
        found[:] = signal
        return found
    if tendons < 4:
        return None  # without the default tendons 1 and 4, `parse` refuses
    found[:] = values[1][..., None]
    found[:, :, [0, 3]] = signal
    return found


def _random(tendons: int, steps: int, values: list[Array], count: int) -> Array | None:
    """Return random tensions by the signal's own function, which draws for one seed."""
    seed, low, high, hold = (np.broadcast_to(each[:, 0], count) for each in values)
    whole = (seed == np.round(seed)) & (seed >= 0) & (hold == np.round(hold)) & (hold >= 1) & (low <= high)
    if not np.all(whole):
        return None
    rows = zip(seed.tolist(), low.tolist(), high.tolist(), hold.tolist(), strict=True)
    every = [
        controls.random(steps, low=a, high=b, seed=int(k), tendons=tendons, hold=int(h))
        if a >= 0.0 else np.full((steps, tendons), np.nan)
        for k, a, b, h in rows
    ]  # fmt: skip
    return np.stack(every)


class _Signal(NamedTuple):
    #: function of the times and of numbers (cases, 1)
    make: Callable[..., Array]
    #: optional numbers with their defaults; NaN: the end of the last step
    options: dict[str, float]


def _sine(t: Array, period: Array, base: Array, amplitude: Array, phase: Array) -> Array:
    return np.where(period > 0.0, base + amplitude * np.sin(2.0 * np.pi * t / period + phase), np.nan)


def _step(t: Array, height: Array, base: Array, at: Array) -> Array:
    return base + height * (t >= at - SAME_TIME * t[0])


def _ramp(t: Array, height: Array, base: Array, start: Array, end: Array) -> Array:
    end = np.where(np.isnan(end), t[-1], end)
    part = np.clip((t - start) / (end - start), 0.0, 1.0)
    return np.where(end > start, base + height * part, np.nan)


def _constant(t: Array, value: Array) -> Array:
    return np.broadcast_to(value, (len(value), len(t)))


_NAMED = {
    "constant": _Signal(_constant, {}),
    "ramp": _Signal(_ramp, {"base": 0.0, "start": 0.0, "end": np.nan}),
    "step": _Signal(_step, {"base": 0.0, "at": 0.0}),
    "sine": _Signal(_sine, {"base": 0.0, "amplitude": 1.0, "phase": 0.0}),
}
_TENSIONS = {
    "sine": _Signal(_sine, {"base": 6.0, "amplitude": 1.0}),
    "random": _Signal(controls.random, {"low": 5.0, "high": 10.0, "hold": 1.0}),
    "step": _Signal(_step, {"base": 5.0, "at": 1.5}),
    "ramp": _Signal(_ramp, {"base": 5.0, "start": 0.0, "end": np.nan}),
    "constant": _Signal(_constant, {}),
}


def _values(word: str, numbers: Mapping[str, Array], known: Mapping[str, _Signal]) -> list[Array] | None:
    """Return the numbers (cases, 1) of a signal in its order; None if the word is not `NAME:NUMBER,…`."""
    name, colon, rest = word.strip().partition(":")
    if name not in known or not colon:
        return None
    first, *others = (part.strip() for part in rest.split(","))
    options: dict[str, Any] = dict(known[name].options)
    given = set()
    for other in others:
        key, equals, text = (part.strip() for part in other.partition("="))
        if key not in options or key in given or not equals:
            return None
        given.add(key)
        options[key] = text
    values = [_value(each, numbers) for each in (first, *options.values())]
    return None if any(each is None for each in values) else values


def _value(text: str | float, numbers: Mapping[str, Array]) -> Array | None:
    """Return a number or the numbers of a name in braces, (cases, 1)."""
    if not isinstance(text, str):
        return np.full((1, 1), text)
    if text.startswith("{") and text.endswith("}"):
        return np.asarray(numbers[text[1:-1]], dtype=float)[:, None]
    found = numbers_in(text)
    return np.full((1, 1), found[0]) if found is not None and len(found) == 1 else None
