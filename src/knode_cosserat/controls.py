"""Controls over time, as arrays (steps, c): signals, words of the command line, and CSV files.

`simulate` applies row i (from 0) from time i dt to (i + 1) dt. Signals that are functions of time are
evaluated at the middle of that step, so that what is held is the signal on average; with `sampled="end"` at
its end, t = (i + 1) dt, as in the paper's studies. The functions make tensions in N; tendons are numbered
from 0 in arguments, from 1 in files. `parse` makes the controls of any robot.
"""

from __future__ import annotations

import csv
import difflib
import functools
import inspect
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.csv_rows import SAME_TIME, Column, CSVTextError, held_rows, read_rows
from knode_cosserat._files.writing import replacing
from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat._numbers import numbers_in, real_array
from knode_cosserat._reprs import count_of
from knode_cosserat._units import UnitError, factors_of, in_unit, numbers_with_units
from knode_cosserat.errors import KnodeCosseratError

if TYPE_CHECKING:
    from knode_cosserat.rods.layout import Layout
    from knode_cosserat.rods.system import System

__all__ = [
    "Controls",
    "ControlsError",
    "base_motion",
    "constant",
    "load",
    "parse",
    "ramp",
    "random",
    "save",
    "sine",
    "step",
]

#: factor from a unit that a file may use to newtons
TENSION_UNITS = factors_of("N", "gf")

Array = Float[np.ndarray, "steps c"]
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


# names


def labels(layout: Layout) -> list[str]:
    """Return the name of every number of a control: its field's, numbered from 1 in a field of several."""
    return layout.labels


def units(layout: Layout) -> list[str]:
    """Return the unit of every number of a control."""
    return [field.unit for field in layout.fields for _ in range(field.size)]


def titles(layout: Layout) -> list[str]:
    """Return the names with their units, as the column titles of a file: `reel_1 [m]`."""
    return [f"{name} [{unit}]" for name, unit in zip(labels(layout), units(layout), strict=True)]


# limits

#: limits of a tension (N) and its rate (N/s) where none are given
TENSION_LIMITS = {"low": 0.0, "high": 10.0, "rate": 40.0}


def completed_limits(layout: Layout, given: Mapping[str, Any], options: bool = False) -> dict[str, Any]:
    """Return limits by name: those given, else those that the robot states, else the usual ones of tensions.

    Args:
        layout: the robot's controls, of c numbers.
        given: numbers or (c,), or None, for the wanted ones of `low`, `high` (units of the controls) and
            `rate` (per s). Those that are None become (c,).
        options: True if the message names options of the command line.

    Raises:
        ControlsError: a limit that is neither given, nor stated, nor of tensions.
    """
    limits, missing = dict(given), []
    for name in (name for name, value in given.items() if value is None):
        # a robot states no rates
        stated = [getattr(field, name, np.inf) for field in layout.fields]
        usual = [
            TENSION_LIMITS[name] if field.name.rpartition("_")[2] == "tension" else np.nan
            for field in layout.fields
        ]
        sizes = [field.size for field in layout.fields]
        limits[name] = np.repeat(np.where(np.isfinite(stated), stated, usual), sizes)
        if np.any(np.isnan(limits[name])):
            missing.append(f"--{name}" if options else name)
    if missing:
        names = ", ".join(f"{field.name} ({field.unit})" for field in layout.fields)
        *most, last = missing
        listed = (f"{', '.join(most)} and {last}" if most else last) + (
            "" if options else " of ControlLimits"
        )
        raise ControlsError(
            f"limits are needed for the controls {names}: give {listed}, one number for all, or one for each "
            f"of {layout.size}"
        )
    return limits


# signals


def constant(tension: float, steps: int, *, tendons: int = 4) -> Tensions:
    """Return one constant tension (N) in all tendons.

    Raises:
        ControlsError: an argument is not possible; likewise in every function here.
    """
    check_arguments(constant, locals(), ControlsError)
    _require_numbers(tension=tension)
    _require_counts(steps=steps, tendons=tendons)
    return _checked_tensions(np.full((steps, tendons), float(tension)), "constant")


def sine(
    period: float,
    steps: int,
    dt: float,
    *,
    base: float = 6.0,
    amplitude: float = 1.0,
    tendons: int = 4,
    sampled: Sampled = "middle",
) -> Tensions:
    """Return τ_k = base + amplitude sin(2πt/period + 2πk/tendons) in N, k = 0, 1, …; period in s."""
    check_arguments(sine, locals(), ControlsError)
    _require_numbers(base=base, amplitude=amplitude)
    _require_counts(tendons=tendons)
    phase = 2 * np.pi * np.arange(tendons) / tendons
    t = step_times(steps, dt, sampled)
    _require_positive("period", period)
    # 2πt/period has to be finite
    if not period > (least := 8.0 * (float(t[-1]) / np.finfo(float).max)):
        raise ControlsError(f"period is {period!r}; allowed is a number of seconds above {least:g}")
    return _checked_tensions(sine_values(t[:, None], period, base, amplitude, phase), "sine")


def step(
    height: float,
    steps: int,
    dt: float,
    *,
    base: float = 5.0,
    at: float = 1.5,
    tendons: Sequence[int] | None = None,
    count: int = 4,
    sampled: Sampled = "middle",
) -> Tensions:
    """Return `base` (N) in `count` tendons, and base + height in the named tendons from t = at (s).

    The named tendons are by default the first and the last, as in the paper's studies of four.
    """
    check_arguments(step, locals(), ControlsError)
    _require_numbers(height=height, base=base, at=at)
    t = step_times(steps, dt, sampled)
    return _in_tendons("step", step_values(t, height, base, at, dt), base, tendons, count)


def ramp(
    height: float,
    steps: int,
    dt: float,
    *,
    base: float = 5.0,
    start: float = 0.0,
    end: float | None = None,
    tendons: Sequence[int] | None = None,
    count: int = 4,
    sampled: Sampled = "middle",
) -> Tensions:
    """Return `base` (N) in `count` tendons, with a linear rise by `height` (N) in the named tendons.

    The rise is from `start` to `end` (s), by default until the last step. The tension is constant after. The
    named tendons are by default the first and the last.
    """
    check_arguments(ramp, locals(), ControlsError)
    t = step_times(steps, dt, sampled)
    if end is None:
        end = float(t[-1])
        _require_numbers(start=start)
        if end <= start:
            raise ControlsError(
                f"ramp: start is {start!r} s; allowed is a time before the last step, {end:g} s; "
                f"use {_steps_until(start, dt, sampled, after=True)} steps or more, or an earlier start"
            )
    _require_numbers(height=height, base=base, start=start, end=end)
    if end <= start:
        raise ControlsError(f"ramp: end is {end!r} s; allowed is a time after its start, {start!r} s")
    return _in_tendons("ramp", ramp_values(t, height, base, start, end), base, tendons, count)


def random(
    steps: int, *, low: float = 5.0, high: float = 10.0, seed: int = 0, tendons: int = 4, hold: int = 1
) -> Tensions:
    """Return independent uniform samples between `low` and `high` (N), each held for `hold` steps."""
    check_arguments(random, locals(), ControlsError)
    _require_counts(steps=steps, tendons=tendons, hold=hold)
    _require_counts(least=0, seed=seed)
    _require_numbers(low=low, high=high)
    if high < low:
        raise ControlsError(f"random: high is {high!r} N; allowed is a tension from low, {low!r} N, on")
    draws = np.random.default_rng(seed).uniform(low, high, (-(-steps // hold), tendons))
    return _checked_tensions(np.repeat(draws, hold, axis=0)[:steps], "random")


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


# a moving base


def base_motion(
    robot: System,
    controls: Any,
    dt: float,
    *,
    position: Any = None,
    orientation: Any = None,
) -> Float[np.ndarray, "rows c"]:
    """Return controls in rows 0, 1, … of a robot whose base moves, with the velocities of its path.

    The first row is that of the initial equilibrium, the others are those of `simulate`:

        rows = kc.controls.base_motion(arm, tensions, dt, position=path)
        motion = kc.simulate(arm, rows[1:], dt, initial=kc.equilibrium(arm, rows[0]))

    Args:
        robot: with the base_end `kc.robots.ends.Moving()`.
        controls: its other controls, (rows, k), or (k,) in all rows.
        dt: time (s) from row to row.
        position: (rows, 3), or (3,) in all rows, of the body that carries the base, in m; by default zero.
        orientation: quaternions (rows, 4), scalar first, or (4,); by default upright. Their signs are free.

    Raises:
        ControlsError: a robot without a moving base, or arrays of other shapes.
    """
    check_arguments(base_motion, locals())
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    names = [f"base_{name}" for name in ("position", "orientation", "velocity", "angular_velocity")]
    layout = robot.control_layout
    if not set(names) <= set(layout.names):
        raise ControlsError(
            f"robot has the controls {', '.join(layout.names) or 'none'}, no base_position; allowed is a "
            "robot with base_end=kc.robots.ends.Moving()"
        )
    columns = [layout.indices((name,)) for name in names]
    own = np.setdiff1d(np.arange(layout.size), np.concatenate(columns))
    given = {"controls": (controls, len(own)), "position": (position, 3), "orientation": (orientation, 4)}
    usual = {"position": np.zeros(3), "orientation": np.array([1.0, 0.0, 0.0, 0.0])}
    values = {name: usual[name] if value is None else real_array(value) for name, (value, _) in given.items()}
    counts = {len(value) for value in values.values() if value.ndim == 2}
    for name, (_, size) in given.items():
        shape = values[name].shape
        if len(shape) not in (1, 2) or shape[-1] != size or len(counts) > 1 or not min(counts, default=2) > 1:
            raise ControlsError(
                f"{name} has the shape {shape}; allowed is (rows, {size}), with as many rows in all of these "
                f"that have rows, 2 or more, or ({size},)"
            )
    if not counts:
        raise ControlsError(
            "controls, position and orientation have no rows; allowed is (rows, …) for one of them"
        )
    count = counts.pop()
    every = np.zeros((count, layout.size))
    h = values["orientation"]
    if not np.all(np.linalg.norm(h, axis=-1) > 0.0):
        raise ControlsError("an orientation is zero; allowed are quaternions, scalar first")
    every[:, own] = values["controls"]
    p = np.broadcast_to(values["position"], (count, 3))
    turned = Rotation.from_quat(np.broadcast_to(h, (count, 4)), scalar_first=True)
    h = turned.as_quat(scalar_first=True)
    # of two signs that nearest to the row before
    sign = np.cumprod(np.where(np.sum(h[1:] * h[:-1], axis=1) < 0.0, -1.0, 1.0))
    h[1:] *= sign[:, None]
    t = dt * np.arange(count)
    # rates of the spline are in the frame of the body
    spun = turned.apply(RotationSpline(t, turned)(t, 1))
    for where, value in zip(columns, (p, h, CubicSpline(t, p)(t, 1), spun), strict=True):
        every[:, where] = value
    return every


def _in_tendons(
    signal: str, values: np.ndarray, base: float, tendons: Sequence[int] | None, count: int
) -> Tensions:
    _require_counts(count=count)
    tendons = (0, count - 1) if tendons is None else tendons
    if not set(tendons) <= set(range(count)):
        raise ControlsError(f"{signal}: tendons is {tendons!r}; allowed is numbers from 0 to {count - 1}")
    tensions = np.full((len(values), count), float(base))
    tensions[:, [int(k) for k in tendons]] = values[:, None]
    return _checked_tensions(tensions, signal)


def step_times(steps: int, dt: float, sampled: Sampled = "middle") -> np.ndarray:
    """Return the times (s) at which a signal is evaluated: the middles of steps of dt (s), or their ends."""
    _require_counts(steps=steps)
    _require_positive("dt", dt)
    if sampled not in get_args(Sampled):
        raise ControlsError(f'sampled is {sampled!r}; allowed is "middle" or "end"')
    return (np.arange(1, steps + 1) - _EARLIER[sampled]) * dt


#: parts of a step from the time at which a signal is evaluated to its end
_EARLIER = {"middle": 0.5, "end": 0.0}


def _steps_until(t: float, dt: float, sampled: Sampled, after: bool = False) -> int:
    """Return the number of steps of dt (s) of which the last is evaluated at time t (s), or later.

    With `after`, only later.
    """
    steps = t / dt + _EARLIER[sampled]
    return int(np.floor(steps + SAME_TIME)) + 1 if after else int(np.ceil(steps - SAME_TIME))


def _checked_tensions(tensions: Tensions, signal: str) -> Tensions:
    """Return tensions that are finite and not negative. Raises `ControlsError` otherwise."""
    wrong = tensions[~(np.isfinite(tensions) & (tensions >= 0.0))]
    if wrong.size:
        raise ControlsError(f"{signal}: a tension is {wrong.min():g} N; allowed is 0 or more (a pull)")
    return tensions


def _require_numbers(**values: Any) -> None:
    """Raise `ControlsError` unless all values are finite numbers."""
    for name, value in values.items():
        if not _is_number(value):
            raise ControlsError(f"{name} is {value!r}; allowed is a finite number")


def _require_positive(name: str, value: Any) -> None:
    """Raise `ControlsError` unless a time (s) is above 0."""
    if not (_is_number(value) and value > 0.0):
        raise ControlsError(f"{name} is {value!r}; allowed is a number of seconds above 0")


def _require_counts(least: int = 1, **values: Any) -> None:
    """Raise `ControlsError` unless all values are whole numbers, at least `least`."""
    for name, value in values.items():
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
            raise ControlsError(f"{name} is {value!r}; allowed is a whole number from {least} on")


def _is_number(value: Any) -> bool:
    if not isinstance(value, int | float | np.integer | np.floating) or isinstance(value, bool):
        return False
    return bool(np.isfinite(value))


def _require_effect(
    signal: str,
    arguments: Mapping[str, Any],
    values: Float[np.ndarray, "steps ..."],
    dt: float,
    sampled: Sampled = "middle",
) -> None:
    """Raise `ControlsError` if a signal does nothing during a run: a step or ramp after the end, for example.

    Args:
        signal: "sine", "step" or "ramp".
        arguments: its arguments by name. A height or amplitude of 0 is taken as intended.
        values: the signal in all steps.
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
    begin, steps = arguments[option], len(values)
    # a step that acts from the first time step on is constant, too
    if begin > (1.0 - _EARLIER[sampled]) * dt:
        raise ControlsError(
            f"the {signal} starts at {begin:g} s, after the end of the run ({steps} steps of {dt:g} s: "
            f"{steps * dt:g} s); use {_steps_until(begin, dt, sampled, after=signal == 'ramp')} steps or "
            f"more, or {option}=0"
        )


# files


def save(path: str | Path, tensions: Any, dt: float) -> None:
    """Write tensions (steps, tendons) in N as CSV: the time (s) from which each row is held, then the row.

    The file is written completely or not at all.
    """
    check_arguments(save, locals(), ControlsError)
    try:
        tensions = real_array(tensions)
    except (TypeError, ValueError) as error:
        raise ControlsError(f"tensions are not numbers ({error}); allowed is (steps, tendons)") from None
    if tensions.ndim != 2 or 0 in tensions.shape:
        raise ControlsError(f"tensions have shape {tensions.shape}; allowed is (steps, tendons)")
    _checked_tensions(tensions, str(path))
    _require_positive("dt", dt)
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
    check_arguments(load, locals(), ControlsError)
    if dt is not None:
        _require_positive("dt", dt)
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


# words


class _Signal(NamedTuple):
    """Signal of a word: its function, the name of its first number, and parsers of its other arguments."""

    make: Callable[..., Any]
    main: str
    options: Mapping[str, Callable[[str], Any]]


def _tendons(text: str) -> tuple[int, ...]:
    return tuple(int(number) - 1 for number in text.split("+"))


#: signals of all tendons
_TENSIONS = {
    "sine": _Signal(sine, "period", {"base": float, "amplitude": float}),
    "step": _Signal(step, "height", {"base": float, "at": float, "tendons": _tendons}),
    "ramp": _Signal(ramp, "height", {"base": float, "start": float, "end": float, "tendons": _tendons}),
    "random": _Signal(random, "seed", {"low": float, "high": float, "hold": int}),
    "constant": _Signal(constant, "tension", {}),
}

#: units of the numbers of signals that are not in that of the control
_UNITS = {"period": "s", "at": "s", "start": "s", "end": "s", "phase": "rad"}

_SPECIFICATIONS = (
    ", ".join(f"{name}:{signal.main.upper()}" for name, signal in _TENSIONS.items())
    + ", one number for each tendon, or a CSV file"
)


def parse(
    specification: str,
    steps: int | None,
    dt: float,
    robot: System | Layout | int = 4,
    sampled: Sampled = "middle",
) -> Array:
    """Return controls (steps, c) from one word, as on the command line.

    Words of tensions are for all tendons: `sine:1.5`, `step:1.5`, `ramp:2`, `random:0`, `constant:5`, that
    is, the signal and its first number (period in s, height in N, height in N, seed, tension in N). Other
    arguments have names: `sine:1.5,base=8,amplitude=2`, `step:1.5,at=2,tendons=1,4` (tendons from 1).

    For any controls of a robot, the word has signals by name: `tension_4=ramp:2`, or
    `base_z=ramp:0.1;reel_1=sine:2,amplitude=0.01`. The name of a field stands for all its numbers. Each
    control is given at most once, and the others are zero; `none` stands for zeros. Signals are a number or
    `constant:VALUE`, `ramp:HEIGHT[,base=,start=,end=]`, `step:HEIGHT[,base=,at=]`,
    `sine:PERIOD[,base=,amplitude=,phase=]`. Numbers are in SI units, or have one: `rotation_1=180deg`.

    Numbers are a constant control, one for each: `7,5,5,7`, `constant:7,5,5,7` or `500 gf,5,5,7`. Anything
    else is a CSV file of tensions, as for `load`, or with the columns `time [s]` and any names of controls
    with their units; it is sampled at dt.

    Args:
        specification: signals, numbers or file, as above.
        steps: number of steps; None, for a file only: all steps of the file.
        dt: time step (s).
        robot: the robot, its control layout, or the number of tendons of a robot with tensions only.
        sampled: time in each step at which a signal for all tendons is evaluated, "middle" or "end". Signals
            by name are evaluated at the middle; displacements and rotations at the end, because `simulate`
            changes these gradually until then.

    Raises:
        ControlsError: the specification is not understood, the file is invalid or too short, or the signal
            has no effect during the run, such as a step after its end.
    """
    check_arguments(parse, locals(), ControlsError)
    # its import takes long, and readers of recordings use the units of this module
    from knode_cosserat.rods.layout import Layout

    if isinstance(robot, int):
        robot = Layout(("tension", robot, "N", "tendon tension"))
    layout = robot if isinstance(robot, Layout) else robot.control_layout
    _require_positive("dt", dt)
    if steps is not None:
        _require_counts(steps=steps)
    name, _, rest = specification.partition(":")
    is_tension = layout.names == ("tension",)
    is_signal = is_tension and name in _TENSIONS
    if os.path.exists(specification) and not (is_signal and rest):
        return _from_file(specification, layout, steps, dt)
    held = _constant_control(specification, layout)
    # `NAME=SIGNAL;…` and `none`; words such as `sine:2,base=5` are for all tendons
    word, equals, _ = specification.partition("=")
    is_named = not is_tension or specification.strip() == "none" or (equals and not set(":,") & set(word))
    if held is None and not (is_named or is_signal):
        close = difflib.get_close_matches(name, _TENSIONS, n=1)
        hint = f"; did you mean {close[0]}:{_TENSIONS[close[0]].main.upper()}?" if close else ""
        raise ControlsError(
            f"controls {specification!r}: no such signal or file; allowed is {_SPECIFICATIONS}{hint}"
        )
    if steps is None:
        raise ControlsError(
            f"controls {specification!r}: the number of steps is not given; only a file states its own"
        )
    if held is not None:
        values = np.tile(held, (steps, 1))
    elif is_named:
        words = [] if specification.strip() == "none" else specification.split(";")
        places: tuple[Sampled, ...] = ("middle", "end")
        values = parse_signals(layout, words, {place: step_times(steps, dt, place) for place in places})
    else:
        try:
            return _tension_signal(name, rest, steps, (dt, sampled), layout.size)
        except ControlsError as error:
            raise ControlsError(f"controls {specification!r}: {error}") from None
    return _checked_tensions(values, f"controls {specification!r}") if is_tension else values


def _constant_control(specification: str, layout: Layout) -> np.ndarray | None:
    """Return a constant control (c,) given by its numbers: `7,5,5,7`, or with `constant:` before them.

    None if the specification is something else, such as a signal, or `constant:` and one number.

    Raises:
        ControlsError: there are not as many numbers as controls, or a unit is not theirs.
    """
    size, text = layout.size, specification.strip().removeprefix("constant:")
    if text.endswith(".csv"):  # 2026.csv is no number in csv
        return None
    try:
        numbers = numbers_with_units(text, units(layout))
    except UnitError as error:
        raise ControlsError(f"controls {specification!r}: {error}") from None
    if numbers is None or (text != specification.strip() and len(numbers) == 1):
        return None
    if len(numbers) != size or not np.all(np.isfinite(numbers)):
        example = ",".join(["7", "5", "5", "7", *["5"] * size][:size]) or "none"
        raise ControlsError(
            f"controls {specification!r}: a constant control must be {size} finite numbers, one for each "
            f"control (got {len(numbers)}), such as {example}"
        )
    return np.array(numbers)


def _from_file(path: str, layout: Layout, steps: int | None, dt: float) -> Array:
    """Return a file's columns, each row held until the next row's time; other controls are zero."""
    if layout.names == ("tension",):
        rows = load(path, dt).tensions
        if rows.shape[1] != layout.size:
            raise ControlsError(f"{path}: there are {rows.shape[1]} tendons; the robot has {layout.size}")
    else:
        known = ["time [s]", *titles(layout)]

        def columns_of(where: str, stated: list[str]) -> list[Column]:
            if not {"time [s]"} <= set(stated) <= set(known) or len(set(stated)) < len(stated):
                raise ControlsError(
                    f"{where}: the columns are {', '.join(stated)}; "
                    f"allowed is time [s], and any of {', '.join(known[1:]) or 'none'}, once each"
                )
            return [Column(title, known.index(title)) for title in stated]

        try:
            time, values, places = read_rows(Path(path), f"a header `{','.join(known)}`", columns_of)
            held = held_rows(path, time, dt)
        except CSVTextError as error:
            raise ControlsError(str(error)) from None
        rows = np.zeros((len(held), layout.size))
        rows[:, [place - 1 for place in places]] = values[held]
    if steps is not None and steps > len(rows):
        raise ControlsError(
            f"{path}: there are {len(rows)} steps of {dt:g} s; {steps} are requested; "
            f"allowed is up to {len(rows)}"
        )
    return rows[:steps]


def _arguments(signal: _Signal, text: str, unit: str) -> dict[str, Any]:
    """Return the arguments of a signal of controls in a unit from the text after its colon: `1.5,base=8`."""
    first, *others = text.split(",")
    kinds: dict[str, Any] = {signal.main: int if signal.main == "seed" else float, **signal.options}
    texts, key = {signal.main: first}, signal.main
    for other in others:
        if key == "tendons" and "=" not in other:
            texts[key] += f"+{other}"
            continue
        key, _, value = (part.strip() for part in other.partition("="))
        if key not in signal.options or key in texts:
            allowed = ", ".join(f"{option}=…" for option in signal.options) or "nothing"
            raise ControlsError(f"{other!r} is not understood; allowed after the {signal.main} is {allowed}")
        texts[key] = value
    arguments = {}
    for key, word in texts.items():
        try:
            number = None if kinds[key] in (int, _tendons) else in_unit(word, _UNITS.get(key, unit))
            arguments[key] = kinds[key](word) if number is None else number
        except UnitError as error:
            raise ControlsError(f"{key} is {word!r}: {error}") from None
        except ValueError:
            allowed = {int: "a whole number", _tendons: "tendons like 1,4"}.get(kinds[key], "a number")
            raise ControlsError(f"{key} is {word!r}; allowed is {allowed}") from None
    return arguments


@functools.cache
def _parameters_of(function: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(function).parameters


def _tension_signal(name: str, text: str, steps: int, times: tuple[float, Sampled], tendons: int) -> Tensions:
    """Return a signal of all tendons; `times` are the time step (s) and the time in it."""
    signal = _TENSIONS[name]
    if not text.partition(",")[0].strip():
        example = f"{name}:{ {'seed': '0', 'tension': '5'}.get(signal.main, '1.5') }"
        raise ControlsError(f"{signal.main} is missing; allowed is {name}:NUMBER, such as {example}")
    arguments = _arguments(signal, text, "N")
    if not set(raised := arguments.get("tendons", ())) <= set(range(tendons)):
        listed = ",".join(str(k + 1) for k in raised)
        raise ControlsError(
            f"tendons is {listed}; allowed is numbers from 1 to {tendons}, such as 1,{tendons}"
        )
    parameters = _parameters_of(signal.make)
    arguments |= {"steps": steps, "count" if "count" in parameters else "tendons": tendons}
    if "dt" in parameters:
        arguments |= {"dt": times[0], "sampled": times[1]}
    tensions: Tensions = signal.make(**arguments)
    if name in ("sine", "step", "ramp") and steps > 1:
        defaults = {key: parameter.default for key, parameter in parameters.items()}
        _require_effect(name, defaults | arguments, tensions, *times)
    return tensions


# signals by name


def parse_signals(
    layout: Layout, words: Sequence[str], times: Mapping[Sampled, Float[np.ndarray, " steps"]]
) -> Array:
    """Return controls (steps, c) from words `NAME=SIGNAL`; see `parse`.

    Signals are evaluated at the times (s) in the "middle" of steps, and displacements and rotations at their
    "end". Controls without a word are zero.
    """
    known = labels(layout)
    controls = np.zeros((len(times["middle"]), layout.size))
    sources: dict[int, str] = {}
    for word in words:
        entry = word.strip()
        name, equals, text = (part.strip() for part in entry.partition("="))
        if not equals:
            meant = known and name.partition(":")[0] in _SIGNALS
            raise ControlsError(
                f"controls {entry!r}: allowed is NAME=SIGNAL;…, one number for each control, `none` "
                f"or a CSV file; names are {', '.join(known) or 'none'}"
                + (f"; did you mean {known[0]}={name}?" if meant else "")
            )
        if name in layout.names:
            columns = list(range(*layout.slice(name).indices(layout.size)))
        elif name in known:
            columns = [known.index(name)]
        else:
            raise ControlsError(
                f"the control {name!r} is unknown; there are {', '.join(known) or 'none'}"
                f"{did_you_mean(name, known)}"
            )
        sampled: Sampled = "end" if layout.moving[columns[0]] else "middle"
        # a very short period, for example, overflows: the check below refuses it without a NumPy warning
        try:
            with np.errstate(all="ignore"):
                values = _signal(text, times[sampled], sampled, units(layout)[columns[0]])
        except ControlsError as error:
            raise ControlsError(f"controls {entry!r}: {error}") from None
        if not np.all(np.isfinite(values)):
            raise ControlsError(
                f"controls {entry!r}: a value is {values[~np.isfinite(values)][0]}; "
                "allowed is a signal of finite numbers"
            )
        for column in columns:
            if column in sources:
                raise ControlsError(
                    f"controls {entry!r}: {known[column]} is given already, by "
                    f"{sources[column]!r}; allowed is each control once"
                )
            sources[column] = entry
        controls[:, columns] = values[:, None]
    return controls


def _ramp(t: Any, height: float, *, base: float = 0.0, start: float = 0.0, end: float | None = None) -> Any:
    last = float(t[-1]) if end is None else end
    if last <= start:
        raise ControlsError(
            f"ramp: start is {start!r} s; allowed is a time before the last step, {last:g} s"
            if end is None
            else f"ramp: end is {last!r} s; allowed is a time after its start, {start!r} s"
        )
    return ramp_values(t, height, base, start, last)


def _step(t: Any, height: float, *, base: float = 0.0, at: float = 0.0) -> Any:
    return step_values(t, height, base, at, t[0])


def _sine(t: Any, period: float, *, base: float = 0.0, amplitude: float = 1.0, phase: float = 0.0) -> Any:
    if period <= 0.0:
        raise ControlsError(f"sine: the period is {period!r} s; allowed is a number above 0")
    return sine_values(t, period, base, amplitude, phase)


def _constant(t: Any, value: float) -> Any:
    return np.full(len(t), value)


def _finite(text: str) -> float:
    if not np.isfinite(value := float(text)):
        raise ValueError
    return value


_SIGNALS = {
    "constant": _Signal(_constant, "value", {}),
    "ramp": _Signal(_ramp, "height", dict.fromkeys(("base", "start", "end"), _finite)),
    "step": _Signal(_step, "height", dict.fromkeys(("base", "at"), _finite)),
    "sine": _Signal(_sine, "period", dict.fromkeys(("base", "amplitude", "phase"), _finite)),
}


def _signal(
    word: str, t: Float[np.ndarray, " steps"], sampled: Sampled, unit: str
) -> Float[np.ndarray, " steps"]:
    is_number = numbers_in(word) is not None or re.fullmatch(r"[-+.\d][^,;:=]*", word)
    name, _, text = ("constant", "", word) if is_number else word.partition(":")
    if name not in _SIGNALS:
        raise ControlsError(
            f"the signal {word!r} is unknown; allowed is {', '.join(_SIGNALS)}{did_you_mean(name, _SIGNALS)}"
        )
    signal = _SIGNALS[name]
    arguments = _arguments(signal, text, unit)
    values = np.asarray(signal.make(t, **arguments))
    if len(t) > 1 and name != "constant" and np.all(np.isfinite(values)):
        stated = {**(signal.make.__kwdefaults__ or {}), **arguments}
        _require_effect(name, stated, values, float(t[1] - t[0]), sampled)
    return values
