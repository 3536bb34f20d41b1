"""Configuration of a recording's topics or columns: validated settings, read from and written to YAML.

    format: 1
    description: our robot, three tendons and one body at the tip
    simulated: false
    tension: {topic: /load_cells, unit: N, order: [1, 2, 3]}
    markers:
      - {name: tip, topic: /mocap/tip/pose, fraction: 1}

The same settings serve bags and tables. In a table, a topic is the prefix of the columns' titles: the topic
`tip` has the columns `tip_x [m]`, `tip_y [m]`, `tip_z [m]` and, for its orientation, `tip_qw` to `tip_qz`.
The topic `tension` has `tension_1 [N]`, `tension_2 [N]` and so on. A robot with motor-driven tendons has
`motors` in place of `tension`: the measured motor angles. `table` gives the column titles of other
conventions, and the rate of a table without a time column. `columns` names the columns one by one:

    format: 1
    columns: {time: Time (ms), tensions: [T1, T2, T3], tip: [X, Y, Z]}

All keys but time, time_unit, tensions, commands and motors are bodies: titles of the position, or of
position and orientation (scalar first). Markers, tensions and commands that have only to be named follow from
the columns; several bodies need their fractions in `markers`.
"""

from __future__ import annotations

import dataclasses
import fractions
import functools
import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_origin, get_type_hints

from knode_cosserat._files.writing import replacing
from knode_cosserat._files.yaml_text import YAMLTextError, did_you_mean, flow, mapping_of, read_yaml, shown
from knode_cosserat.controls import TENSION_UNITS
from knode_cosserat.recordings.findings import RecordingError

Vector = tuple[float, ...]
FORMAT = 1
#: placeholder of the numbers in a command's text, or of the number or topic in a title
PLACE = "{}"
#: conversion factors to SI units
POSITION_UNITS = {"m": 1.0, "mm": 1e-3}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
#: units of the pressures of chambers, in place of tensions, with factors to Pa
PRESSURE_UNITS = {"Pa": 1.0, "kPa": 1e3, "bar": 1e5}
#: units of motors: angles to rad, or wound-up lengths to m
MOTOR_UNITS = {"rad": 1.0, "deg": math.pi / 180.0, "m": 1.0, "mm": 1e-3}
#: kinds of sensors beside motion capture: their units with factors to SI units, the default first
SENSOR_UNITS: dict[str, dict[str, float]] = {
    "orientation": {"rad": 1.0, "deg": math.pi / 180.0},
    "bending_angle": {"rad": 1.0, "deg": math.pi / 180.0},
    "curvature": {"1/m": 1.0, "1/mm": 1e3, "1/cm": 1e2},
    "base_wrench": {"N": 1.0, "mN": 1e-3},
}
#: axes of motion capture that point up, with the rotation vector (rad) that turns them to z
UP: dict[str, Vector] = {
    "z": (0.0, 0.0, 0.0), "y": (math.pi / 2, 0.0, 0.0), "x": (0.0, -math.pi / 2, 0.0),
    "-z": (math.pi, 0.0, 0.0), "-y": (-math.pi / 2, 0.0, 0.0), "-x": (0.0, math.pi / 2, 0.0),
}  # fmt: skip
#: topics of the sources that a map of columns stands for
MAPPED = {"tensions": "tension", "commands": "command", "motors": "motor"}


# checks: functions from a value and its name to the value as it is stored, or a `RecordingError`

_Check = Callable[[Any, str], Any]


def _refused(value: Any, name: str, words: str) -> RecordingError:
    return RecordingError(f"{name} is {shown(value)}; allowed is {words}")


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise _refused(value, name, "text on one line")
    return value


def _any_text(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise _refused(value, name, "text")
    return value


def _flag(value: Any, name: str) -> bool:
    if not isinstance(value, bool):
        raise _refused(value, name, "true or false")
    return value


def _choice(words: Any) -> _Check:
    def check(value: Any, name: str) -> Any:
        if not isinstance(value, str) or value not in words:
            raise _refused(value, name, " or ".join(words))
        return value

    return check


def _number(low: float, high: float, unit: str = "") -> _Check:
    def check(value: Any, name: str) -> float:
        number = _real(value)
        if number is None or not low <= number <= high:
            raise _refused(value, name, f"a number from {low:g} to {high:g} {unit}".strip())
        return number

    return check


def _real(value: Any) -> float | None:
    """Return a finite number, also from text such as 3/9; None for anything else."""
    try:
        if isinstance(value, str) and value.count("/") == 1 and len(value) < 40:
            return float(fractions.Fraction(value.replace(" ", "")))
        if isinstance(value, bool | str) or value is None:
            return None
        number = float(value)
    except (TypeError, ValueError, OverflowError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _listed(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else []


def _numbers(count: int, words: str) -> _Check:
    def check(value: Any, name: str) -> Vector:
        numbers = [number for number in map(_real, _listed(value)) if number is not None]
        if not len(numbers) == len(_listed(value)) == count:
            raise _refused(value, name, words)
        return tuple(numbers)

    return check


def _fractions(value: Any, name: str) -> Vector:
    return tuple(_number(0.0, 1.0)(place, name) for place in _listed(value) or [value])


def _quaternion(value: Any, name: str) -> Vector:
    words = "a quaternion of length 1, scalar first"
    numbers = _numbers(4, words)(value, name)
    size = math.hypot(*numbers)
    if abs(size - 1.0) > 1e-3:
        raise _refused(value, name, words)
    # a quaternion written with few digits has length 1 only to these digits
    return numbers if abs(size - 1.0) < 1e-12 else tuple(number / size for number in numbers)


def _interval(is_open: bool) -> _Check:
    def check(value: Any, name: str) -> tuple[float | None, ...]:
        listed = _listed(value)
        ends = [_real(end) for end in listed]
        unread = any(
            end is None and not (is_open and word is None) for end, word in zip(ends, listed, strict=True)
        )
        known = [end for end in ends if end is not None]
        if len(ends) != 2 or unread or (len(known) == 2 and not known[0] < known[1]):
            words = "[start, end] in s, start before end" + (", either of them null" if is_open else "")
            raise _refused(value, name, words)
        return tuple(ends)

    return check


def _order(value: Any, name: str) -> tuple[int, ...]:
    numbers = _listed(value)
    whole = all(isinstance(number, int) and not isinstance(number, bool) for number in numbers)
    if not numbers or not whole or sorted(numbers) != list(range(1, len(numbers) + 1)):
        raise _refused(value, name, "the tendons 1, 2, 3, … in the order of the wire")
    return tuple(numbers)


def _templates(count: int) -> _Check:
    """Return the check of titles of columns, each with a place for a number or a topic."""

    def check(value: Any, name: str) -> tuple[str, ...]:
        titles = _listed(value)
        has_place = [isinstance(title, str) and title.count(PLACE) == 1 for title in titles]
        if len(titles) != count or not all(has_place):
            words = "text" if count == 1 else f"{count} texts"
            raise _refused(value, name, f"{words}, with one {PLACE} in each")
        return tuple(titles)

    return check


def _template(value: Any, name: str) -> str:
    return str(_templates(1)([value], name)[0])


def _titles(*counts: int) -> _Check:
    """Return the check of titles, or numbers, of columns: so many of them, or any number."""

    def check(value: Any, name: str) -> tuple[str, ...]:
        titles = _listed(value)
        fair = all(isinstance(title, str | int) and not isinstance(title, bool) for title in titles)
        texts = tuple(str(title).strip() for title in titles)
        if not titles or not fair or len(set(texts)) < len(texts) or (counts and len(texts) not in counts):
            words = f"{' or '.join(map(str, counts))} titles" if counts else "a list of titles"
            raise _refused(value, name, f"{words} of columns, each once")
        return texts

    return check


def _bodies(value: Any, name: str) -> tuple[tuple[str, tuple[str, ...]], ...]:
    return tuple((_text(body, "body"), _titles(3, 7)(titles, str(body))) for body, titles in value)


def _time_title(value: Any, name: str) -> str:
    return _text(str(value) if type(value) is int else value, name).strip()


@functools.cache
def _checks(kind: type) -> dict[str, _Check]:
    """Return the checks of settings by name, from the annotations of their fields."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: hint.__metadata__[0] for name, hint in hints.items() if get_origin(hint) is Annotated}


class _Settings:
    """Settings whose fields are checked when they are made; a field whose default is None may be None."""

    def __post_init__(self) -> None:
        defaults = {field.name: field.default for field in dataclasses.fields(self)}  # type: ignore[arg-type]
        for name, check in _checks(type(self)).items():  # type: ignore[arg-type]
            value = getattr(self, name)
            if value is not None or defaults[name] is not None:
                self._set(name, check(value, name))

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    @classmethod
    def from_dict(cls, values: dict[Any, Any]) -> Self:
        """Return settings from plain values; missing keys get defaults. Raises `RecordingError`."""
        fields = dataclasses.fields(cls)  # type: ignore[arg-type]
        for key in values:
            _require_known(key, [field.name for field in fields])
        required = [field.name for field in fields if field.default is dataclasses.MISSING]
        missing = [name for name in required if values.get(name) is None]
        if missing:
            raise RecordingError(f"the key {missing[0]} is missing; required is {', '.join(required)}")
        return cls(**values)


def _require_known(key: Any, known: list[str]) -> None:
    if key not in known:
        raise RecordingError(
            f"the key {shown(key)} is unknown; allowed is {', '.join(known)}{did_you_mean(key, known)}"
        )


def _part(kind: Any) -> _Check:
    """Return the check of settings within settings, or of a mapping of them."""

    def check(value: Any, name: str) -> Any:
        if isinstance(value, dict):
            try:
                return kind.from_dict(value)
            except RecordingError as error:
                raise RecordingError(f"{name}: {error}") from None
        if type(value) is not kind:
            keys = ", ".join(field.name for field in dataclasses.fields(kind))
            raise _refused(value, name, f"a {kind.__name__}, or nothing; or a mapping with {keys}")
        return value

    return check


# sources


@dataclasses.dataclass(frozen=True)
class MarkerSource(_Settings):
    """Body on the rod, tracked by motion capture.

    Attributes:
        name: name in reports.
        topic: topic of its poses; a body without orientation may have positions only. In bags `/poses[2]`
            is the third pose of a PoseArray, and `/tf[tip]` the frame `tip` of transforms.
        fraction: its place, as a fraction of the rod's length: 0 is the clamped end, 1 the tip.
        rotation: the body's axes in the rod's local frame, as a quaternion, scalar first; None: the axes
            are calibrated at rest, when the rod points up.
        deviation: standard deviation of `fraction`, if it is not well known: it is identified with the robot.
    """

    name: Annotated[str, _text]
    topic: Annotated[str, _text]
    fraction: Annotated[float, _number(0.0, 1.0)]
    rotation: Annotated[Vector | None, _quaternion] = None
    deviation: Annotated[float | None, _number(0.0, 1.0)] = None


def _markers(value: Any, name: str) -> tuple[MarkerSource, ...]:
    markers = []
    for k, marker in enumerate(_listed(value)):
        where = f"{name}, number {k + 1}"
        if not isinstance(marker, MarkerSource):
            if not isinstance(marker, dict):
                raise _refused(marker, where, "a mapping with name, topic, fraction, rotation")
            # without a topic it is called like the marker
            named = {"topic": marker["name"]} if "name" in marker else {}
            marker = _part(MarkerSource)(named | marker, where)
        markers.append(marker)
    if not markers and value not in ([], ()):
        raise _refused(value, name, "a list of markers")
    places, names = [marker.fraction for marker in markers], [marker.name for marker in markers]
    if any(b <= a for a, b in itertools.pairwise(places)):
        raise RecordingError(f"markers have the fractions {shown(places)}; allowed is each above the last")
    if len(set(names)) < len(names):
        raise RecordingError(f"markers have the names {shown(names)}; allowed is each once")
    return tuple(markers)


@dataclasses.dataclass(frozen=True)
class SensorSource(_Settings):
    """Sensor beside motion capture.

    Attributes:
        kind: "orientation" (quaternion, scalar first, or roll, pitch, yaw), "bending_angle" (from the z axis,
            and its direction about z from x), "curvature" (about the local x and y axes, in turn for each
            place) or "base_wrench" (force and moment of the base on the rod).
        topic: topic in a bag (Imu, QuaternionStamped, PoseStamped, WrenchStamped, arrays); name in reports.
        columns: titles of its numbers in a table.
        fractions: places, as fractions of the rod's length.
        unit: "rad" or "deg"; "1/m", "1/cm" or "1/mm"; "N" (and N m) or "mN" (and mN m).
        rotation: quaternion from its global frame to the robot's, of orientations and wrenches.
    """

    kind: Annotated[str, _choice(SENSOR_UNITS)]
    topic: Annotated[str, _text]
    columns: Annotated[tuple[str, ...] | None, _titles()] = None
    fractions: Annotated[Vector, _fractions] = (1.0,)
    unit: str | None = None
    rotation: Annotated[Vector | None, _quaternion] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.unit is not None:
            _choice(SENSOR_UNITS[self.kind])(self.unit, "unit")
        if self.kind != "curvature" and len(self.fractions) > 1:
            raise _refused(self.fractions, "fractions", f"one place for {self.kind}: list a sensor for each")


def _sensors(value: Any, name: str) -> tuple[SensorSource, ...]:
    sensors = []
    for k, sensor in enumerate(_listed(value)):
        named = {"topic": sensor.get("kind")} | sensor if isinstance(sensor, dict) else sensor
        sensors.append(_part(SensorSource)(named, f"{name}, number {k + 1}"))
    return tuple(sensors)


@dataclasses.dataclass(frozen=True)
class BaseSource(_Settings):
    """Body fixed to the base, `height` (m) above the rod's clamped end."""

    topic: Annotated[str, _text]
    height: Annotated[float, _number(-10.0, 10.0, "m")] = 0.0


class _NumbersSource(_Settings):
    """Source with a topic, the order of its numbers, and names."""

    topic: str
    order: tuple[int, ...]
    names: tuple[str, ...] | None
    unit: str
    gain: float | None

    @property
    def factor(self) -> float:
        """Tension (N), pressure (Pa), angle (rad) or length (m) over the numbers of the messages."""
        return {**TENSION_UNITS, **PRESSURE_UNITS, **MOTOR_UNITS}[self.unit] * (
            1.0 if self.gain is None else self.gain
        )

    def __post_init__(self) -> None:
        names = None
        if self.names is not None:
            names = tuple(_text(name, "names") for name in _listed(self.names) or [self.names])
            if len(set(names)) < len(names) or self.names in ([], ()):
                raise _refused(list(_listed(self.names)), "names", "each name once")
            self._set("order", self.order or tuple(range(1, len(names) + 1)))
        self._set("names", names)
        if self.order == ():
            raise RecordingError("the key order is missing; required is topic, order or names")
        super().__post_init__()
        if names is not None and len(names) != len(self.order):
            raise RecordingError(
                f"names has {len(names)} names and order {len(self.order)} numbers; allowed is the same "
                "number"
            )
        if self.gain == 0.0:
            raise _refused(self.gain, "gain", "any other number")
        if self.topic.count(PLACE) > 1:
            raise _refused(self.topic, "topic", f"one {PLACE} at most")


@dataclasses.dataclass(frozen=True)
class TensionSource(_NumbersSource):
    """Measured tensions.

    Attributes:
        topic: topic of the tensions. With `{}` in it each tendon has its own topic: the place stands for the
            tendons' names, or without names for 1, 2, 3, …
        order: tendon of each number in a message; tendons count from 1. Empty: that of `names`.
        unit: "N" or "gf" (grams-force); "Pa", "kPa" or "bar" for pressures of chambers, which are then in Pa.
        gain: factor from a message's numbers to this unit, such as the tension of a motor current of 1 A; a
            rough one will do where gains of load cells are identified. Negative if numbers pull below zero.
        held: True if a tension acts unchanged until the next one, as commands do; otherwise it is a sample
            at that instant, and tensions are interpolated linearly.
        names: names in the messages (joints of a JointState), or in the topics, of each number in `order`;
            None: joints whose names end in numbers are matched by these.
    """

    topic: Annotated[str, _text]
    order: Annotated[tuple[int, ...], _order] = ()
    unit: Annotated[Literal["N", "gf", "Pa", "kPa", "bar"], _choice({**TENSION_UNITS, **PRESSURE_UNITS})] = (
        "N"
    )
    held: Annotated[bool | None, _flag] = None
    names: tuple[str, ...] | None = None
    gain: Annotated[float | None, _number(-1e6, 1e6)] = None


def _command_text(value: Any, name: str) -> str:
    if str(value).count(PLACE) != 1:
        raise _refused(value, name, f"text with one {PLACE} where the numbers stand")
    return str(value)


@dataclasses.dataclass(frozen=True)
class CommandSource(TensionSource):
    """Commanded tensions, each held until the next.

    Attributes:
        text: template of text messages, with `{}` in place of the numbers (other lines of a log are not
            commands); None for messages of numbers.
        latency: delay from a command's stamp until it reaches the tendons (s).
    """

    text: Annotated[str | None, _command_text] = None
    latency: Annotated[float, _number(0.0, 10.0, "s")] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.held is False:
            raise RecordingError("held is false; allowed of a command is true: it is held until the next")


@dataclasses.dataclass(frozen=True)
class MotorSource(_NumbersSource):
    """Measured angles of motors that wind up tendons, or the wound-up lengths.

    Attributes:
        topic: topic of the angles or lengths.
        order: motor of each number in a message; motors count from 1.
        unit: "rad" or "deg" for angles; "m" or "mm" for lengths.
        gain: factor from a message's numbers to this unit, such as 360 / 4096 degrees for a motor's ticks.
        latency: delay from an angle's stamp until it acts on the robot (s): the offset between the clocks
            of motors and motion capture.
        names: names of the motors in messages or topics, as in `TensionSource`. Angles in a JointState are
            its positions.
    """

    topic: Annotated[str, _text]
    order: Annotated[tuple[int, ...], _order] = ()
    unit: Annotated[Literal["rad", "deg", "m", "mm"], _choice(MOTOR_UNITS)] = "rad"
    latency: Annotated[float, _number(-10.0, 10.0, "s")] = 0.0
    names: tuple[str, ...] | None = None
    gain: Annotated[float | None, _number(-1e6, 1e6)] = None


@dataclasses.dataclass(frozen=True)
class TableSource(_Settings):
    """Titles of a table's columns, where they differ from this package's convention.

    Attributes:
        rate: rows per second (Hz), for a table without a time column; None: the column `time [s]` is used.
        position: titles of a body's position, with `{}` in place of its topic.
        quaternion: titles of its orientation, scalar first; a body without these columns has no orientation.
        motor: title of a motor's angle, or of a tension, with `{}` in place of its number.
    """

    rate: Annotated[float | None, _number(1e-6, 1e6, "Hz")] = None
    position: Annotated[tuple[str, ...] | None, _templates(3)] = None
    quaternion: Annotated[tuple[str, ...] | None, _templates(4)] = None
    motor: Annotated[str | None, _template] = None


@dataclasses.dataclass(frozen=True)
class ColumnMap(_Settings):
    """Titles of a table's columns, one by one. In a table without titles they are the numbers from 1 on.

    Attributes:
        bodies: body's name (the marker's topic, or the base's) and the titles of its position, or of its
            position and orientation (scalar first), for each body.
        time: title of the time; None: `time [s]`, or the `rate` of `TableSource`.
        time_unit: "s", "ms", "us" or "ns"; None: the unit that the title states, such as `t (ms)`, or s.
        tensions: titles of measured tensions, in the order of the source's `order`.
        commands: titles of commanded tensions.
        motors: titles of motors' angles.
    """

    bodies: Annotated[tuple[tuple[str, tuple[str, ...]], ...], _bodies] = ()
    time: Annotated[str | None, _time_title] = None
    time_unit: Annotated[Literal["s", "ms", "us", "ns"] | None, _choice(TIME_UNITS)] = None
    tensions: Annotated[tuple[str, ...] | None, _titles()] = None
    commands: Annotated[tuple[str, ...] | None, _titles()] = None
    motors: Annotated[tuple[str, ...] | None, _titles()] = None

    @classmethod
    def from_dict(cls, values: dict[Any, Any]) -> Self:
        """Return a map from a mapping, whose other keys are names of bodies. Raises `RecordingError`."""
        named = {field.name for field in dataclasses.fields(cls)} - {"bodies"}
        bodies = tuple((key, titles) for key, titles in values.items() if key not in named)
        return cls(bodies, **{key: value for key, value in values.items() if key in named})


# configuration


@dataclasses.dataclass(frozen=True)
class RecordingConfig(_Settings):
    """Configuration of the topics of a bag, or the columns of a table.

    Parts may be mappings, as in a file: `RecordingConfig(markers=[{"name": "tip", "fraction": 1}], …)`.

    Attributes:
        markers: bodies on the rod, from base to tip: name, topic, fraction of the length, its deviation,
            rotation.
        tension: measured tensions, or None: topic, order of the tendons, unit (N or gf), held, names.
        motors: measured motor angles in place of tensions, or None: topic, order, unit, latency (s), names.
        command: commanded tensions, or None: as `tension`, with text and latency (s).
        sensors: sensors beside motion capture: kind, columns or topic, fractions, unit, rotation.
        base: body that locates the clamped end, or None (`origin` locates it): topic, height above it (m).
        tensions: default choice of the tensions that drive the robot, "measured" or "commanded"; "none" for
            a recording of poses only.
        position_unit: "m" or "mm".
        up: axis of motion capture's frame that points up: "z", "y", "x", "-x", "-y" or "-z". Poses are turned
            so that z points up before `rotation` applies. None: the file's own, or z.
        origin: position of the clamped end (m), used without a base; in the turned frame, that is, with
            `up` and `rotation` applied.
        rotation: rotation from motion capture's frame (with z up) to the robot's frame, whose z points up
            the straight rod; a quaternion, scalar first.
        clock: "header": measurement times from the messages' headers; "received": recording times.
        table: titles of a table's columns, or None (this package's convention): rate of rows without times
            (Hz), position, quaternion, motor, with `{}` in place of a topic or number.
        columns: titles of a table's columns, one by one; they take precedence over `table`.
        static: True if each row is a separate equilibrium, not part of a motion.
        repeats: "drop": a frame that repeats the previous pose exactly is not a measurement, because some
            motion capture repeats the last pose of a lost body; "keep": every frame is a measurement.
        longest_gap: longest gap between frames that is bridged (s); 1.5 periods of a stream always are.
        rest: interval in which the robot rests, straight up (s); None: detected from the motion.
        trim: interval of the recording that is used (s); None: no limit at that end.
        initial_tension: tensions (N) before the first row, tendon 1 first; None: estimated from the rest.
        simulated: True if the robot was itself a simulation; None: not stated.
        description: one-line description of the recording.

    Raises:
        RecordingError: a value is not allowed.
    """

    markers: Annotated[tuple[MarkerSource, ...], _markers] = ()
    tension: Annotated[TensionSource | None, _part(TensionSource)] = None
    motors: Annotated[MotorSource | None, _part(MotorSource)] = None
    command: Annotated[CommandSource | None, _part(CommandSource)] = None
    sensors: Annotated[tuple[SensorSource, ...], _sensors] = ()
    base: Annotated[BaseSource | None, _part(BaseSource)] = None
    table: Annotated[TableSource | None, _part(TableSource)] = None
    columns: Annotated[ColumnMap | None, _part(ColumnMap)] = None
    tensions: Annotated[
        Literal["measured", "commanded", "none"], _choice(("measured", "commanded", "none"))
    ] = "measured"
    position_unit: Annotated[Literal["m", "mm"], _choice(POSITION_UNITS)] = "m"
    up: Annotated[str | None, _choice(UP)] = None
    origin: Annotated[Vector, _numbers(3, "three numbers (m)")] = (0.0, 0.0, 0.0)
    rotation: Annotated[Vector, _quaternion] = (1.0, 0.0, 0.0, 0.0)
    clock: Annotated[Literal["header", "received"], _choice(("header", "received"))] = "header"
    static: Annotated[bool, _flag] = False
    repeats: Annotated[Literal["keep", "drop"], _choice(("keep", "drop"))] = "keep"
    longest_gap: Annotated[float, _number(0.0, 60.0, "s")] = 0.1
    rest: Annotated[Vector | None, _interval(is_open=False)] = None
    trim: Annotated[tuple[float | None, float | None], _interval(is_open=True)] = (None, None)
    simulated: Annotated[bool | None, _flag] = None
    description: Annotated[str, _any_text] = ""
    initial_tension: Vector | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.markers and not self.sensors:
            raise _refused(self.markers, "markers", "a list of one marker or more, or sensors")
        if self.tension and self.motors:
            raise RecordingError("tension and motors are both there; allowed is one of them")
        if self.measured is None and self.tensions == "measured":
            raise RecordingError(
                "tension is missing; required where tensions is measured, or motors (a recording of poses "
                "only has `tensions: none`)"
            )
        if self.command is None and self.tensions == "commanded":
            raise RecordingError("command is missing; required where tensions is commanded")
        if self.motors and self.command:
            raise RecordingError("motors and command are both there; allowed is one of them")
        if self.tension and self.command and len(self.tension.order) != len(self.command.order):
            raise RecordingError(
                f"order has {len(self.tension.order)} tendons in tension and {len(self.command.order)} in "
                "command; allowed is the same number"
            )
        if self.initial_tension is not None:
            words = f"{self.tendons} numbers (N), one of each tendon"
            numbers = _numbers(self.tendons, words)(self.initial_tension, "initial_tension")
            self._set("initial_tension", numbers)
        sources = (*self.markers, *self.sensors, self.base, self.measured, self.command)
        topics = [source.topic for source in sources if source]
        repeated = next((topic for topic in topics if topics.count(topic) > 1), None)
        if repeated is not None:
            raise RecordingError(f"the topic {repeated} is there twice; allowed is one use of each topic")
        known = [source.topic for source in (*self.markers, self.base) if source]
        for name, _ in self.columns.bodies if self.columns else ():
            if name not in known:
                raise RecordingError(
                    f"columns are of {name}, and no marker has this topic; allowed is "
                    f"{', '.join(known)}{did_you_mean(name, known)}"
                )

    @property
    def measured(self) -> TensionSource | MotorSource | None:
        """Measured tensions, or angles of motors."""
        return self.tension or self.motors

    @property
    def tendons(self) -> int:
        """Number of tendons or motors."""
        source = self.measured or self.command
        return len(source.order) if source else 0

    @classmethod
    def paper_robot(cls) -> Self:
        """Return the configuration of the paper's bags: five bodies, tensions in gf, commands in the log."""
        return cls._included("paper_robot.yaml")

    @classmethod
    def asl_trunk(cls) -> Self:
        """Return the configuration of the ASL trunk (Stanford): six motor angles, three disks, 100 Hz."""
        return cls._included("asl_trunk.yaml")

    @classmethod
    @functools.cache
    def _included(cls, name: str) -> Self:
        return cls.load(Path(__file__).parent / "data" / name)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some settings changed. Raises `RecordingError`."""
        names = [field.name for field in dataclasses.fields(self)]
        for name in changes:
            _require_known(name, names)
        return dataclasses.replace(self, **changes)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read settings from a YAML file.

        Raises:
            RecordingError: the file cannot be read, or a key or value is invalid; the message names both.
        """
        try:
            return cls.from_dict(mapping_of(read_yaml(path), "format, markers and tension"))
        except (YAMLTextError, RecordingError) as error:
            raise RecordingError(f"{path}: {error}") from None

    def save(self, path: str | Path) -> None:
        """Write the settings to a YAML file; `load` reads them back equal. Raises `RecordingError`."""
        try:
            with replacing(Path(path)) as temporary:
                temporary.write_text(self.to_yaml(), encoding="utf-8")
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror}") from None

    def to_yaml(self, *, brief: bool = False) -> str:
        """Return the settings as the text of a YAML file; `brief` leaves out those with default values."""
        defaults = {field.name: _plain(field.default) for field in dataclasses.fields(self)}
        lines = [f"format: {FORMAT}"]
        for name, value in self.to_dict().items():
            if name in ("markers", "sensors"):
                lines += [f"{name}:", *(f"  - {flow(source)}" for source in value)] if value else []
            elif name == "columns":
                lines += ["columns:", *(f"  {flow(key)}: {flow(titles)}" for key, titles in value.items())]
            elif not brief or value != defaults[name]:
                lines.append(f"{name}: {flow(value)}")
        return "\n".join(lines) + "\n"

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as plain values for JSON and YAML, without unset ones."""
        return {name: value for name, value in _plain(self).items() if value not in (None, [None, None], "")}

    @classmethod
    def from_dict(cls, values: dict[Any, Any]) -> Self:
        """Return settings from the result of `to_dict`; missing keys get defaults.

        Raises:
            RecordingError: a key or value is invalid.
        """
        values = dict(values)
        number = values.pop("format", FORMAT)
        if number != FORMAT or isinstance(number, bool):
            raise _refused(number, "format", str(FORMAT))
        return super().from_dict(values if values.get("columns") is None else _with_mapped_sources(values))


def _with_mapped_sources(values: dict[Any, Any]) -> dict[Any, Any]:
    """Return settings with the sources that follow from their map of columns. Raises `RecordingError`."""
    if not isinstance(values["columns"], dict):
        raise _refused(values["columns"], "columns", "a mapping with time, tensions and the names of bodies")
    columns = _part(ColumnMap)(values["columns"], "columns")
    values = {**values, "columns": columns}
    for name, part in (("tensions", "tension"), ("commands", "command"), ("motors", "motors")):
        titles, stated = getattr(columns, name), values.get(part) or {}
        if titles is not None and isinstance(stated, dict):
            values[part] = {"topic": MAPPED[name], "order": list(range(1, len(titles) + 1))} | stated
    if columns.commands and not columns.tensions and not columns.motors:
        values.setdefault("tensions", "commanded")
    if not any(values.get(part) for part in ("tension", "command", "motors")):
        values.setdefault("tensions", "none")
    base = values.get("base")
    if isinstance(base, dict) or (base is None and "base" in dict(columns.bodies)):
        values["base"] = {"topic": "base"} | (base or {})
    bodies = [name for name, _ in columns.bodies if name != "base"]
    if not bodies and values.get("sensors"):
        return values
    if not values.get("markers") and len(bodies) != 1:
        raise RecordingError(
            f"markers is missing; required with the columns of {len(bodies)} bodies: "
            "markers: [{name: …, fraction: …}, …], from base to tip"
        )
    return values | {"markers": values.get("markers") or [{"name": bodies[0], "fraction": 1.0}]}


def _plain(value: Any) -> Any:
    """Return a value as plain values for JSON and YAML; parts without unset settings."""
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if dataclasses.is_dataclass(value):
        named = {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
        if isinstance(value, ColumnMap):
            del named["bodies"]
        if not isinstance(value, RecordingConfig):
            named = {name: part for name, part in named.items() if part is not None}
        return named | _plain(dict(value.bodies)) if isinstance(value, ColumnMap) else named
    return [_plain(part) for part in value] if isinstance(value, tuple) else value
