"""Tendon tensions over time, as arrays (steps, tendons) in N: the studies' signals, and CSV files.

`simulate` applies row i (from 0) from time i dt to (i + 1) dt. Signals that are functions of time are
evaluated at the middle of that step, so that what is held is the signal on average; with `sampled="end"` at
its end, t = (i + 1) dt, as in the paper's studies. Tendons are numbered from 0 in
arguments, from 1 in files.
"""

from __future__ import annotations

import csv
import difflib
import inspect
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.csv_rows import SAME_TIME, Column, CSVTextError, held_rows, read_rows
from knode_cosserat._files.writing import replacing
from knode_cosserat._numbers import numbers_in, real_array
from knode_cosserat._reprs import count_of
from knode_cosserat.errors import KnodeCosseratError

__all__ = [
    "SPECIFICATIONS",
    "TENSION_UNITS",
    "Controls",
    "ControlsError",
    "Tensions",
    "constant",
    "constant_control",
    "load",
    "parse",
    "ramp",
    "random",
    "save",
    "sine",
    "step",
]

#: factor from a unit that a file may use to newtons
TENSION_UNITS = {"N": 1.0, "gf": 9.81 / 1000.0}


Tensions = Float[np.ndarray, "steps tendons"]
#: time in each step at which a signal is evaluated
Sampled = Literal["middle", "end"]


class ControlsError(KnodeCosseratError, ValueError):
    """Controls are not possible, or a file of them cannot be read; the message is one line."""

    code = "controls"


class Controls(NamedTuple):
    """Tensions (steps, tendons) in N and the time step (s) for which each row is held."""

    tensions: Tensions
    dt: float

    def __repr__(self) -> str:
        rows, tendons = self.tensions.shape
        span = f"{self.tensions.min():.4g} to {self.tensions.max():.4g} N" if rows else "none"
        return f"Controls: {rows} steps of {self.dt:g} s; {count_of(tendons, 'tendon')}, {span}"


# signals


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


# files


def save(path: str | Path, tensions: Any, dt: float) -> None:
    """Write tensions (steps, tendons) in N as CSV: the time (s) from which each row is held, then the row.

    The file is written completely or not at all.
    """
    try:
        tensions = real_array(tensions)
    except (TypeError, ValueError) as error:
        raise ControlsError(f"tensions are not numbers ({error}); allowed is (steps, tendons)") from None
    if tensions.ndim != 2 or 0 in tensions.shape:
        raise ControlsError(f"tensions have shape {tensions.shape}; allowed is (steps, tendons)")
    checked_tensions(tensions, str(path))
    require_positive("dt", dt)
    names = [f"tension_{k + 1} [N]" for k in range(tensions.shape[1])]
    try:
        with replacing(Path(path)) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["time [s]", *names])
            # a Python float prints all its digits, so that it reads back equal
            writer.writerows([i * float(dt), *row] for i, row in enumerate(tensions.tolist()))
    except OSError as error:
        raise ControlsError(f"{path}: cannot be written: {error.strerror}") from None


def load(path: str | Path, dt: float | None = None) -> Controls:
    """Read a CSV file of tensions.

    Its header names the columns with their units: `time [s]`, and `tension_1 [N]`, `tension_2 [N]`, … or
    `[gf]` (grams-force). Each row is held from its time until the next row's. `held_tension_1 [N]`, as in
    tables of simulations, is a synonym.

    Args:
        path: the file.
        dt: sampling step (s): row i of the result is held at the file's first time + i dt, up to its last
            time. None: the file's own step, which must be constant.

    Raises:
        ControlsError: the file cannot be read; the message names the line and the column.
    """
    if dt is not None:
        require_positive("dt", dt)
    time, tensions = _read(Path(path))
    if dt is None:
        return Controls(tensions, _own_step(path, time))
    try:
        return Controls(tensions[held_rows(path, time, dt)], float(dt))
    except CSVTextError as error:
        raise ControlsError(str(error)) from None


def _own_step(path: str | Path, time: np.ndarray) -> float:
    if len(time) < 2:
        raise ControlsError(f"{path}: there is one row of tensions, which tells no time step; give dt")
    index = np.arange(len(time))
    first = float(time[1] - time[0])
    mean = float(time[-1] - time[0]) / (len(time) - 1)
    if np.all(np.abs(time - time[0] - index * mean) <= 1e-3 * mean):
        # a file written by `save` gives its exact step; rounded times are averaged
        exact = np.all(np.abs(time - time[0] - index * first) <= 1e-9 * (time[-1] - time[0]))
        return first if exact else mean
    steps = np.diff(time)
    raise ControlsError(
        f"{path}: the time step varies from {steps.min():g} to {steps.max():g} s; "
        "allowed is one step throughout, or give dt to sample at it"
    )


def _read(path: Path) -> tuple[np.ndarray, Tensions]:
    """Return times (rows,) in s and tensions (rows, tendons) in N."""
    try:
        time, tensions, _ = read_rows(path, _HEADER, _columns)
    except CSVTextError as error:
        raise ControlsError(str(error)) from None
    return time, tensions


_HEADER = "a header `time [s],tension_1 [N],tension_2 [N],…`"


def _columns(where: str, titles: list[str]) -> list[Column]:
    columns = [_column(where, title) for title in titles]
    tendons = sorted(column.place for column in columns)
    if len(tendons) < 2 or tendons != list(range(len(tendons))):
        raise ControlsError(
            f"{where}: the columns are {', '.join(titles)}; "
            "allowed is time, and tension_1, tension_2, … without a gap, once each"
        )
    return columns


def _column(where: str, title: str) -> Column:
    match = re.fullmatch(r"(?:(time)|(?:held_)?tension_([1-9]\d{0,5})) *(?:\[ *([^\[\]]*?) *\])?", title)
    if match is None:
        raise ControlsError(f"{where}: the column {title!r} is unknown; allowed is {_HEADER}")
    time, tendon, unit = match.groups()
    units = {"s": 1.0} if time else TENSION_UNITS
    allowed = " or ".join(f"[{unit}]" for unit in units)
    if not unit:
        raise ControlsError(f"{where}: the column {title!r} has no unit; allowed is {allowed} after its name")
    if unit not in units:
        raise ControlsError(f"{where}: the column {title!r} has the unit {unit!r}; allowed is {allowed}")
    if time:
        return Column(title, 0)
    return Column(title, int(tendon), units[unit], 0.0, "a finite number, 0 or more (a pull)")


# the command line


class _Signal(NamedTuple):
    make: Callable[..., Tensions]
    main: str
    #: optional named arguments, each with its parser
    options: dict[str, Callable[[str], Any]]
    #: name of the function's argument for the number of tendons
    tendon_count: str = "tendons"


def _tendons(text: str) -> tuple[int, ...]:
    return tuple(int(number) - 1 for number in text.split("+"))


_SIGNALS = {
    "sine": _Signal(sine, "period", {"base": float, "amplitude": float}),
    "step": _Signal(step, "height", {"base": float, "at": float, "tendons": _tendons}, "count"),
    "ramp": _Signal(
        ramp, "height", {"base": float, "start": float, "end": float, "tendons": _tendons}, "count"
    ),
    "random": _Signal(random, "seed", {"low": float, "high": float, "hold": int}),
    "constant": _Signal(constant, "tension", {}),
}

#: specifications that `parse` accepts, for help texts
SPECIFICATIONS = (
    ", ".join(f"{name}:{it.main.upper()}" for name, it in _SIGNALS.items())
    + ", one number for each tendon, or a CSV file"
)


def parse(
    specification: str, steps: int | None, dt: float, *, tendons: int = 4, sampled: Sampled = "middle"
) -> Tensions:
    """Return tensions from one word, as on the command line.

    `sine:1.5`, `step:1.5`, `ramp:2`, `random:0`, `constant:5`: the signal and its first number (period in s,
    height in N, height in N, seed, tension in N). Other arguments have names: `sine:1.5,base=8,amplitude=2`,
    `step:1.5,at=2,tendons=1+4` (tendons numbered from 1). Numbers are constant tensions, one for each tendon:
    `7,5,5,7` or `constant:7,5,5,7`. Anything else is a CSV file, sampled at dt.

    Args:
        specification: signal or file, as above.
        steps: number of steps; None, for a file only: all steps of the file.
        dt: time step (s).
        tendons: number of tendons of the robot.
        sampled: time in each step at which a signal is evaluated, "middle" or "end".

    Raises:
        ControlsError: the specification is not understood, the file is invalid or too short, or the signal
            has no effect during the run, such as a step after its end.
    """
    require_positive("dt", dt)
    name, colon, rest = specification.partition(":")
    held = constant_control(specification, tendons)
    if held is not None:
        count = _required_steps(specification, steps)
        return checked_tensions(np.tile(held, (count, 1)), f"controls {specification!r}")
    if os.path.exists(specification) and not (colon and name in _SIGNALS):
        return _from_file(specification, steps, dt, tendons)
    if name not in _SIGNALS:
        close = difflib.get_close_matches(name, _SIGNALS, n=1)
        hint = f"; did you mean {close[0]}:{_SIGNALS[close[0]].main.upper()}?" if close else ""
        if "=" in name:
            hint = "; NAME=SIGNAL is for named_controls.parse, and for --controls"
        raise ControlsError(
            f"controls {specification!r}: no such signal or file; allowed is {SPECIFICATIONS}{hint}"
        )
    count = _required_steps(specification, steps)
    try:
        return _from_signal(name, rest, count, (dt, sampled), tendons)
    except ControlsError as error:
        raise ControlsError(f"controls {specification!r}: {error}") from None


def constant_control(specification: str, size: int) -> np.ndarray | None:
    """Return a constant control (size,) given by its numbers: `7,5,5,7`, or with `constant:` before them.

    None if the specification is something else, such as a signal, a file, or `constant:` and one number.

    Raises:
        ControlsError: there are not as many numbers as controls.
    """
    text = specification.strip().removeprefix("constant:")
    numbers = numbers_in(text)
    if numbers is None or (text != specification.strip() and len(numbers) == 1):
        return None
    if os.path.exists(specification):
        return None
    if len(numbers) != size or not np.all(np.isfinite(numbers)):
        example = ",".join(["7", "5", "5", "7", *["5"] * size][:size]) or "none"
        raise ControlsError(
            f"controls {specification!r}: a constant control must be {size} finite numbers, one for each "
            f"control (got {len(numbers)}), such as {example}"
        )
    return np.array(numbers)


def _required_steps(specification: str, steps: int | None) -> int:
    if steps is None:
        raise ControlsError(
            f"controls {specification!r}: the number of steps is not given; only a file states its own"
        )
    require_counts(steps=steps)
    return steps


def _from_file(path: str, steps: int | None, dt: float, tendons: int) -> Tensions:
    tensions = load(path, dt).tensions
    if tensions.shape[1] != tendons:
        raise ControlsError(f"{path}: there are {tensions.shape[1]} tendons; the robot has {tendons}")
    if steps is None:
        return tensions
    require_counts(steps=steps)
    if len(tensions) < steps:
        raise ControlsError(
            f"{path}: there are {len(tensions)} steps of {dt:g} s; {steps} are requested; "
            f"allowed is up to {len(tensions)}"
        )
    return tensions[:steps]


def _from_signal(name: str, text: str, steps: int, times: tuple[float, Sampled], tendons: int) -> Tensions:
    signal = _SIGNALS[name]
    first, *others = text.split(",")
    if not first.strip():
        examples = {"period": "1.5", "height": "1.5", "seed": "0", "tension": "5"}
        example = f"{name}:{examples[signal.main]}"
        raise ControlsError(f"{signal.main} is missing; allowed is {name}:NUMBER, such as {example}")
    arguments = {signal.main: _read_as(int if signal.main == "seed" else float, signal.main, first)}
    for other in others:
        key, _, value = (part.strip() for part in other.partition("="))
        if key not in signal.options or key in arguments:
            allowed = ", ".join(f"{option}=…" for option in signal.options) or "nothing"
            raise ControlsError(f"{other!r} is not understood; allowed after the {signal.main} is {allowed}")
        arguments[key] = _read_as(signal.options[key], key, value)
    if "dt" in inspect.signature(signal.make).parameters:
        arguments |= {"dt": times[0], "sampled": times[1]}
    if not set(arguments.get("tendons", ())) <= set(range(tendons)):
        given = "+".join(str(k + 1) for k in arguments["tendons"])
        raise ControlsError(
            f"tendons is {given}; allowed is numbers from 1 to {tendons}, such as 1+{tendons}"
        )
    tensions = signal.make(steps=steps, **arguments, **{signal.tendon_count: tendons})
    if name in ("sine", "step", "ramp") and steps > 1:
        stated = {**_defaults(signal.make), **arguments}
        require_effect(name, stated, tensions, steps, *times)
    return tensions


def _defaults(function: Callable[..., Any]) -> dict[str, Any]:
    return {name: each.default for name, each in inspect.signature(function).parameters.items()}


def _read_as(kind: Callable[[str], Any], key: str, text: str) -> Any:
    try:
        return kind(text)
    except ValueError:
        kinds = {float: "a number", int: "a whole number"}
        allowed = kinds.get(kind, "tendons like 1+4")  # type: ignore[call-overload]
        raise ControlsError(f"{key} is {text!r}; allowed is {allowed}") from None
