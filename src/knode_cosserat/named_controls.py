"""Controls of any robot, by the names of its control layout, such as `base_z`, `reel_1` or `load0_scale`.

The counterpart of `controls`, which has tensions only, for robots with other controls. `simulate` applies
row i from time i dt to (i + 1) dt, and signals are evaluated at that step's end.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat import controls
from knode_cosserat._files.csv_rows import Column, CSVTextError, held_rows, read_rows
from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat._numbers import numbers_in
from knode_cosserat.controls import (
    ControlsError,
    Sampled,
    checked_tensions,
    ramp_values,
    require_effect,
    sine_values,
    step_times,
    step_values,
)
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.system import System

Array = Float[np.ndarray, "steps c"]


def labels(layout: Layout) -> list[str]:
    """Return the name of every number of a control: its field's, numbered from 1 in a field of several."""
    return [
        field.name if field.size == 1 else f"{field.name}_{k + 1}"
        for field in layout.fields
        for k in range(field.size)
    ]


def units(layout: Layout) -> list[str]:
    """Return the unit of every number of a control."""
    return [field.unit for field in layout.fields for _ in range(field.size)]


def titles(layout: Layout) -> list[str]:
    """Return the names with their units, as the column titles of a file: `reel_1 [m]`."""
    return [f"{name} [{unit}]" for name, unit in zip(labels(layout), units(layout), strict=True)]


def parse(robot: System | Layout, specification: str, steps: int | None, dt: float) -> Array:
    """Return controls (steps, c) of a robot, or of its control layout, from one word as on the command line.

    The word has signals by name, `tension_4=ramp:2` or `base_z=ramp:0.1;reel_1=sine:2,amplitude=0.01`. The
    name of a field stands for all its numbers. Each control is given at most once, and the others are zero.
    Signals are a number or `constant:VALUE`, `ramp:HEIGHT[,base=,start=,end=]`, `step:HEIGHT[,base=,at=]`,
    `sine:PERIOD[,base=,amplitude=,phase=]`. The word may also be a CSV file with the columns `time [s]` and
    any of these names with their units, or the numbers of a constant control in the layout's order. `none`
    stands for zeros. A robot with tensions only also takes the words of `controls.parse`: the signals of the
    paper for all tendons, and files of tensions.

    Raises:
        ControlsError: the specification is not understood, or the file is invalid or too short.
    """
    layout = robot if isinstance(robot, Layout) else robot.control_layout
    tensions_only = layout.names == ("tension",)
    if tensions_only and not _is_named(specification):
        return controls.parse(specification, steps, dt, tendons=layout.size)
    if not 0.0 < dt < np.inf:
        raise ControlsError(f"dt is {dt!r}; allowed is a number of seconds above 0")
    whole = isinstance(steps, int | np.integer) and not isinstance(steps, bool)
    if steps is not None and (not whole or steps < 1):
        raise ControlsError(f"steps is {steps!r}; allowed is a whole number from 1 on")
    if os.path.isfile(specification):
        return _sampled(specification, layout, steps, dt)
    if steps is None:
        raise ControlsError(
            f"controls {specification!r}: the number of steps is not given; only a file states its own"
        )
    held = controls.constant_control(specification, layout.size)
    if held is not None:
        return np.tile(held, (steps, 1))
    words = [] if specification.strip() == "none" else specification.split(";")
    places: tuple[Sampled, ...] = ("middle", "end")
    times = {place: step_times(steps, dt, place) for place in places}
    found = parse_signals(layout, words, times)
    return checked_tensions(found, f"controls {specification!r}") if tensions_only else found


def _is_named(specification: str) -> bool:
    """Return True for `NAME=SIGNAL;…` and `none`; words such as `sine:2,base=5` are for all tendons."""
    name, equals, _ = specification.partition("=")
    named = specification.strip() == "none" or bool(equals and not set(":,") & set(name))
    return named and not os.path.isfile(specification)


def parse_signals(
    layout: Layout, words: list[str], times: dict[Sampled, Float[np.ndarray, " steps"]]
) -> Array:
    """Return controls (steps, c) from words `NAME=SIGNAL`; see `parse`.

    Signals are evaluated at the times (s) in the "middle" of steps, and displacements and rotations at their
    "end": `simulate` changes these gradually until then.
    """
    found = np.zeros((len(times["middle"]), layout.size))
    given: dict[int, str] = {}
    for entry in words:
        name, equals, word = (part.strip() for part in entry.partition("="))
        if not equals:
            known = labels(layout)
            meant = known and name.partition(":")[0] in _SIGNALS
            raise ControlsError(
                f"controls {entry.strip()!r}: allowed is NAME=SIGNAL;…, one number for each control, `none` "
                f"or a CSV file; names are {', '.join(known) or 'none'}"
                + (f"; did you mean {known[0]}={name}?" if meant else "")
            )
        columns = _columns(layout, name)
        sampled: Sampled = "end" if layout.moving[columns[0]] else "middle"
        # a very short period, for example, overflows: the check below refuses it without a NumPy warning
        try:
            with np.errstate(all="ignore"):
                values = _signal(word, times[sampled], sampled)
        except ControlsError as error:
            raise ControlsError(f"controls {entry.strip()!r}: {error}") from None
        if not np.all(np.isfinite(values)):
            raise ControlsError(
                f"controls {entry.strip()!r}: a value is {values[~np.isfinite(values)][0]}; "
                "allowed is a signal of finite numbers"
            )
        for column in columns:
            if column in given:
                raise ControlsError(
                    f"controls {entry.strip()!r}: {labels(layout)[column]} is given already, by "
                    f"{given[column]!r}; allowed is each control once"
                )
            given[column] = entry.strip()
        found[:, columns] = values[:, None]
    return found


def _columns(layout: Layout, name: str) -> list[int]:
    known = labels(layout)
    if name in layout.names:
        return list(range(*layout.slice(name).indices(layout.size)))
    if name in known:
        return [known.index(name)]
    raise ControlsError(
        f"the control {name!r} is unknown; there are {', '.join(known) or 'none'}{did_you_mean(name, known)}"
    )


def _ramp(t: Any, height: float, *, base: float = 0.0, start: float = 0.0, end: float | None = None) -> Any:
    last = float(t[-1]) if end is None else end
    if last <= start and end is None:
        raise ControlsError(f"ramp: start is {start!r} s; allowed is a time before the last step, {last:g} s")
    if last <= start:
        raise ControlsError(f"ramp: end is {last!r} s; allowed is a time after its start, {start!r} s")
    return ramp_values(t, height, base, start, last)


def _step(t: Any, height: float, *, base: float = 0.0, at: float = 0.0) -> Any:
    return step_values(t, height, base, at, t[0])


def _sine(t: Any, period: float, *, base: float = 0.0, amplitude: float = 1.0, phase: float = 0.0) -> Any:
    if period <= 0.0:
        raise ControlsError(f"sine: the period is {period!r} s; allowed is a number above 0")
    return sine_values(t, period, base, amplitude, phase)


def _constant(t: Any, value: float) -> Any:
    return np.full(len(t), value)


_SIGNALS: dict[str, tuple[Callable[..., Any], tuple[str, ...]]] = {
    "constant": (_constant, ()),
    "ramp": (_ramp, ("base", "start", "end")),
    "step": (_step, ("base", "at")),
    "sine": (_sine, ("base", "amplitude", "phase")),
}


def _signal(word: str, t: Float[np.ndarray, " steps"], sampled: Sampled) -> Float[np.ndarray, " steps"]:
    name, _, rest = word.partition(":") if numbers_in(word) is None else ("constant", "", word)
    if name not in _SIGNALS:
        raise ControlsError(
            f"the signal {word!r} is unknown; allowed is {', '.join(_SIGNALS)}{did_you_mean(name, _SIGNALS)}"
        )
    function, options = _SIGNALS[name]
    first, *others = rest.split(",")
    given = {}
    for other in others:
        key, _, text = (part.strip() for part in other.partition("="))
        if key not in options or key in given:
            allowed = ", ".join(f"{option}=…" for option in options) or "nothing"
            raise ControlsError(f"{name}: {other!r} is not understood; allowed is {allowed}")
        given[key] = _number(name, text)
    value = _number(name, first)
    found = np.asarray(function(t, value, **given))
    if len(t) > 1 and name != "constant" and np.all(np.isfinite(found)):
        main = "period" if name == "sine" else "height"
        known = function.__kwdefaults__ or {}
        require_effect(name, {**known, main: value, **given}, found, len(t), float(t[1] - t[0]), sampled)
    return found


def _number(where: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ControlsError(f"{where}: {text.strip()!r} is not a number")
    return value


def _sampled(path: str, layout: Layout, steps: int | None, dt: float) -> Array:
    """Return a file's columns, each row held until the next row's time."""
    known = ["time [s]", *titles(layout)]

    def columns_of(where: str, found: list[str]) -> list[Column]:
        if not {"time [s]"} <= set(found) <= set(known) or len(set(found)) < len(found):
            raise ControlsError(
                f"{where}: the columns are {', '.join(found)}; "
                f"allowed is time [s], and any of {', '.join(known[1:]) or 'none'}, once each"
            )
        return [Column(title, known.index(title)) for title in found]

    try:
        time, values, places = read_rows(Path(path), f"a header `{','.join(known)}`", columns_of)
        rows = held_rows(path, time, dt)
    except CSVTextError as error:
        raise ControlsError(str(error)) from None
    if steps is not None and steps > len(rows):
        raise ControlsError(
            f"{path}: there are {len(rows)} steps of {dt:g} s; {steps} are requested; "
            f"allowed is up to {len(rows)}"
        )
    found = np.zeros((len(rows), layout.size))
    found[:, [place - 1 for place in places]] = values[rows]
    return found[:steps]
