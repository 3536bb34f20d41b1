"""Configuration of a recording's topics or columns: validated settings, read from and written to YAML.

    format: 1
    description: our robot, three tendons and one body at the tip
    simulated: false
    tension: {topic: /load_cells, unit: N, order: [1, 2, 3]}
    markers:
      - {name: tip, topic: /mocap/tip/pose, fraction: 1}

What drives the robot stands under the name of its quantity (`quantities`): tension, length, angle, current,
pressure, volume, insertion, rotation, field or input; several of them, if several drive it. The same settings
serve bags and tables. In a table, a topic is the prefix of the columns' titles: the topic `tip` has the
columns `tip_x [m]`, `tip_y [m]`, `tip_z [m]` and, for its orientation, `tip_qw` to `tip_qz`. The topic
`tension` has `tension_1 [N]`, `tension_2 [N]` and so on. `table` gives the column titles of other
conventions, and the rate of a table without a time column. `columns` names the columns one by one:

    format: 1
    columns: {time: stamp_ms, pressure: ["P_A [mbar]", "P_B [mbar]"], tip: [X (mm), Y (mm), Z (mm)]}

All keys but time, time_unit, command and quantities are bodies: titles of the position, or of position and
orientation (scalar first). Units that are not stated are those of the titles. Markers and sources that have
only to be named follow from the columns; several bodies need their fractions in `markers`.

A recording may be in several files, each with its own clock: `files` states the offset and the drift of a
file's clock, which are estimated otherwise (`clocks`), and the title of its times.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from knode_cosserat._files.writing import replacing
from knode_cosserat._files.yaml_text import (
    YAMLTextError,
    did_you_mean,
    excerpt,
    flow,
    mapping_of,
    read_yaml,
)
from knode_cosserat._settings import (
    FLAG,
    LINE,
    TEXT,
    Rule,
    ValidatedSettings,
    choice,
    finite_number,
    items,
    number,
    numbers,
    part,
    parts,
    plain,
)
from knode_cosserat._units import factors_of
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.quantities import QUANTITIES, UNITS, Quantity, of_unit, stated_unit

Vector = tuple[float, ...]
FORMAT = 1
#: placeholder of the numbers in a command's text, or of the number or topic in a title
PLACE = "{}"
#: conversion factors to SI units
POSITION_UNITS = factors_of("m", "cm", "mm")
TIME_UNITS = factors_of("s", "ms", "us", "ns")
#: kinds of sensors beside motion capture: their units with factors to SI units, the default first
SENSOR_UNITS: dict[str, dict[str, float]] = {
    "orientation": factors_of("rad", "deg"),
    "bending_angle": factors_of("rad", "deg"),
    "curvature": factors_of("1/m", "1/mm", "1/cm"),
    "base_wrench": factors_of("N", "mN"),
}
#: axes of motion capture that point up, with the rotation vector (rad) that turns them to z
UP: dict[str, Vector] = {
    "z": (0.0, 0.0, 0.0),
    "y": (math.pi / 2, 0.0, 0.0),
    "x": (0.0, -math.pi / 2, 0.0),
    "-z": (math.pi, 0.0, 0.0),
    "-y": (-math.pi / 2, 0.0, 0.0),
    "-x": (0.0, math.pi / 2, 0.0),
}
# rules of settings


def _unit_quaternion(value: Any) -> Vector | None:
    known = numbers(4, "").read(value)
    if known is None or abs((size := math.hypot(*known)) - 1.0) > 1e-3:
        return None
    # a quaternion written with few digits has length 1 only to these digits
    return known if abs(size - 1.0) < 1e-12 else tuple(one / size for one in known)


QUATERNION = Rule(
    "a quaternion of length 1, scalar first",
    _unit_quaternion,
    {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 4},
)


def _interval(is_open: bool) -> Rule:
    def read(value: Any) -> tuple[float | None, ...] | None:
        ends = [finite_number(end) for end in items(value)]
        known = [end for end in ends if end is not None]
        is_read = all(
            end is not None or (is_open and word is None)
            for end, word in zip(ends, items(value), strict=True)
        )
        return tuple(ends) if len(ends) == 2 and is_read and known == sorted(set(known)) else None

    words = "[start, end] in s, start before end" + (", either of them null" if is_open else "")
    end = {"type": ["number", "null"] if is_open else "number"}
    return Rule(words, read, {"type": "array", "items": end, "minItems": 2, "maxItems": 2})


def _order(value: Any) -> tuple[int, ...] | None:
    listed = items(value)
    whole = all(type(one) is int for one in listed)
    return tuple(listed) if listed and whole and sorted(listed) == list(range(1, len(listed) + 1)) else None


ORDER = Rule(
    "the numbers 1, 2, 3, … in the order of the wire",
    _order,
    {"type": "array", "items": {"type": "integer", "minimum": 1}},
)


def _place(value: Any) -> Any:
    return value if isinstance(value, str) and value.count(PLACE) == 1 else None


def _templates(count: int) -> Rule:
    """Return the rule of titles of columns, each with a place for a topic."""

    def read(value: Any) -> tuple[str, ...] | None:
        titles = tuple(map(_place, items(value)))
        return titles if len(titles) == count and all(titles) else None

    words = f"{count} texts, with one {PLACE} in each"
    return Rule(
        words, read, {"type": "array", "items": {"type": "string"}, "minItems": count, "maxItems": count}
    )


TEMPLATE = Rule(f"text, with one {PLACE} in it", _place, {"type": "string"})


def _titles(*counts: int) -> Rule:
    """Return the rule of titles, or numbers, of columns: so many of them, or any number."""

    def read(value: Any) -> tuple[str, ...] | None:
        fair = all(isinstance(title, str | int) and not isinstance(title, bool) for title in items(value))
        titles = tuple(str(title).strip() for title in items(value))
        is_counted = len(titles) in counts if counts else bool(titles)
        return titles if fair and is_counted and len(set(titles)) == len(titles) else None

    words = f"{' or '.join(map(str, counts))} titles" if counts else "a list of titles"
    schema = {"type": "array", "items": {"type": ["string", "integer"]}, "minItems": 1, "uniqueItems": True}
    return Rule(f"{words} of columns, each once", read, schema)


def _fractions(value: Any) -> Vector | None:
    places = [number(0.0, 1.0).read(place) for place in items(value) or [value]]
    return None if None in places else tuple(places)


def _names(value: Any) -> tuple[str, ...] | None:
    names = tuple(map(LINE.read, [value] if isinstance(value, str) else items(value)))
    return names if names and None not in names and len(set(names)) == len(names) else None


NAMES = Rule(
    "names on one line, each once", _names, {"type": ["string", "array"], "items": {"type": "string"}}
)


class _RecordingSettings(ValidatedSettings):
    error = RecordingError


# sources


@dataclasses.dataclass(frozen=True)
class MarkerSource(_RecordingSettings):
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

    implied: ClassVar = {"topic": "name"}

    name: Annotated[str, LINE]
    topic: Annotated[str, LINE]
    fraction: Annotated[float, number(0.0, 1.0)]
    rotation: Annotated[Vector | None, QUATERNION] = None
    deviation: Annotated[float | None, number(0.0, 1.0)] = None


@dataclasses.dataclass(frozen=True)
class SensorSource(_RecordingSettings):
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

    implied: ClassVar = {"topic": "kind"}

    kind: Annotated[str, choice(SENSOR_UNITS)]
    topic: Annotated[str, LINE]
    columns: Annotated[tuple[str, ...] | None, _titles()] = None
    fractions: Annotated[Vector, Rule("numbers from 0 to 1", _fractions, {"type": ["number", "array"]})] = (
        1.0,
    )
    unit: str | None = None
    rotation: Annotated[Vector | None, QUATERNION] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.unit is not None:
            self.accept("unit", choice(SENSOR_UNITS[self.kind]))
        if self.kind != "curvature" and len(self.fractions) > 1:
            words = f"one place for {self.kind}: list a sensor for each"
            raise self.refusal("fractions", self.fractions, words)


@dataclasses.dataclass(frozen=True)
class BaseSource(_RecordingSettings):
    """Body fixed to the base, `height` (m) above the rod's clamped end."""

    topic: Annotated[str, LINE]
    height: Annotated[float, number(-10.0, 10.0, "m")] = 0.0


@dataclasses.dataclass(frozen=True)
class ControlSource(_RecordingSettings):
    """Measured or commanded numbers that drive the robot, of one quantity.

    Attributes:
        topic: topic of the numbers. With `{}` in it each number has its own topic: the place stands for
            `names`, or without names for 1, 2, 3, …
        order: number, such as the tendon, of each value in a message; they count from 1. Empty: that of
            `names`.
        unit: unit of the quantity, such as mbar; None: the one that titles of columns state, or the SI unit.
        held: True if a value acts unchanged until the next one, as commands do; otherwise it is a sample at
            that instant, and values are interpolated linearly.
        names: names in the messages (joints of a JointState), or in the topics, of each number in `order`;
            None: joints whose names end in numbers are matched by these. Lengths and angles in a JointState
            are its positions, other quantities its efforts.
        gain: factor from a message's numbers to this unit, such as 360 / 4096 degrees for a motor's ticks.
            Currents with a gain are tensions, in N for each A; a rough one will do where gains of load cells
            are identified. Negative if numbers pull below zero.
        latency: delay from a stamp until the value acts on the robot (s): of commands, or of the clock of
            motors against that of motion capture.
        text: of commands: template of text messages, with `{}` in place of the numbers (other lines of a log
            are not commands); None for messages of numbers.
    """

    topic: Annotated[str, LINE]
    order: Annotated[tuple[int, ...], ORDER] = ()
    unit: Annotated[str | None, choice(UNITS)] = None
    held: Annotated[bool | None, FLAG] = None
    names: Annotated[tuple[str, ...] | None, NAMES] = None
    gain: Annotated[float | None, number(-1e9, 1e9)] = None
    latency: Annotated[float, number(-10.0, 10.0, "s")] = 0.0
    text: Annotated[str | None, TEMPLATE._replace(words=f"text with one {PLACE} where the numbers stand")] = (
        None
    )
    #: name of the quantity, which the configuration states by the key
    quantity: str = dataclasses.field(default="tension", compare=False)

    @property
    def factor(self) -> float:
        """Number in the SI unit over the number of the messages."""
        return UNITS[self.unit or self.kind.unit][0] * (1.0 if self.gain is None else self.gain)

    @property
    def kind(self) -> Quantity:
        """Quantity of the numbers in the SI unit: currents with a gain are tensions."""
        is_pull = self.quantity == "current" and self.gain is not None
        return QUANTITIES["tension" if is_pull else self.quantity]

    def __post_init__(self) -> None:
        if self.names is not None:
            self.accept("names", NAMES)
        if self.order == ():
            if not self.names:
                raise RecordingError("the key order is missing; required is topic, order or names")
            object.__setattr__(self, "order", tuple(range(1, len(self.names) + 1)))
        super().__post_init__()
        if self.names is not None and len(self.names) != len(self.order):
            raise RecordingError(
                f"names has {len(self.names)} names and order {len(self.order)} numbers; allowed is the same "
                "number"
            )
        if self.gain == 0.0:
            raise self.refusal("gain", self.gain, "any other number")
        if self.topic.count(PLACE) > 1:
            raise self.refusal("topic", self.topic, f"one {PLACE} at most")

    def to_dict(self) -> dict[str, Any]:
        """Return the source as plain values, without a latency of zero."""
        values = super().to_dict()
        return values if self.latency else {name: it for name, it in values.items() if name != "latency"}

    def of_quantity(self, name: str, titles: Collection[str] = ()) -> Self:
        """Return the source as that of a quantity, whose unit may be stated by titles.

        Raises:
            RecordingError: the unit is not one of the quantity, or titles state several.
        """
        units, unit = QUANTITIES[name].units, self.unit
        stated = {stated for title in titles if (stated := stated_unit(title, units))}
        if unit is None and len(stated) > 1:
            raise RecordingError(
                f"{name}: the titles are in {' and '.join(sorted(stated))}; required is one unit, or "
                f"`unit` in {name}"
            )
        if unit and self.gain is None and any(units.get(it) != units.get(unit) for it in stated):
            raise RecordingError(
                f"{name}: unit is {unit}, but the titles are in {' and '.join(sorted(stated))}; allowed is "
                "that unit, or none; or `gain: 1` if the titles are wrong"
            )
        unit = unit or next(iter(stated), QUANTITIES[name].unit)
        if unit not in units:
            other = next(quantity.name for quantity in QUANTITIES.values() if unit in quantity.units)
            words = f"{' or '.join(units)}. Did you mean the key {other}, in place of {name}?"
            raise self.refusal(f"{name}: unit", unit, words)
        return dataclasses.replace(self, unit=unit, quantity=name)


#: sources that drive the robot, one for each quantity
Drive = Annotated[ControlSource | None, part(ControlSource)]


@dataclasses.dataclass(frozen=True)
class TableSource(_RecordingSettings):
    """Titles of a table's columns, where they differ from this package's convention.

    Attributes:
        rate: rows per second (Hz), for a table without a time column; None: the column `time [s]` is used.
        position: titles of a body's position, with `{}` in place of its topic.
        quaternion: titles of its orientation, scalar first; a body without these columns has no orientation.
        control: title of a number that drives the robot, with `{}` in place of its number.
    """

    rate: Annotated[float | None, number(1e-6, 1e6, "Hz")] = None
    position: Annotated[tuple[str, ...] | None, _templates(3)] = None
    quaternion: Annotated[tuple[str, ...] | None, _templates(4)] = None
    control: Annotated[str | None, TEMPLATE] = None


def _title(value: Any) -> str | None:
    return LINE.read(str(value).strip() if type(value) is int else value)


BODY_TITLES = _titles(3, 7)


#: key of commands, beside the quantities
COMMAND = "command"


@dataclasses.dataclass(frozen=True)
class ColumnMap(_RecordingSettings):
    """Titles of a table's columns, one by one. In a table without titles they are the numbers from 1 on.

    Attributes:
        bodies: body's name (the marker's topic, or the base's) and the titles of its position, or of its
            position and orientation (scalar first), for each body.
        controls: quantity, or "command", and the titles of its numbers, in the order of the source's `order`.
        time: title of the time; None: `time [s]`, or the `rate` of `TableSource`.
        time_unit: "s", "ms", "us" or "ns"; None: the unit that the title states, such as `t (ms)`, or s.
    """

    bodies: tuple[tuple[str, tuple[str, ...]], ...] = ()
    controls: tuple[tuple[str, tuple[str, ...]], ...] = ()
    time: Annotated[str | None, LINE._replace(read=_title, schema={"type": ["string", "integer"]})] = None
    time_unit: Annotated[Literal["s", "ms", "us", "ns"] | None, choice(TIME_UNITS)] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("bodies", "controls"):
            rule = BODY_TITLES if name == "bodies" else _titles()
            kept = tuple(
                (self.accepted(name, key, LINE), self._accepted_titles(str(key), titles, rule))
                for key, titles in getattr(self, name)
            )
            object.__setattr__(self, name, kept)

    @classmethod
    def _accepted_titles(cls, key: str, titles: Any, rule: Rule) -> Any:
        try:
            return cls.accepted(key, titles, rule)
        except RecordingError as error:
            # the key of a quantity that is misspelt is taken for a body
            raise RecordingError(f"{error}{did_you_mean(key, [*QUANTITIES, COMMAND])}") from None

    @classmethod
    def from_dict(cls, values: dict[Any, Any]) -> Self:
        """Return a map from a mapping, whose other keys are names of bodies. Raises `RecordingError`."""
        named = {"time", "time_unit"}
        driven = tuple((key, titles) for key, titles in values.items() if key in (*QUANTITIES, COMMAND))
        others = named | {key for key, _ in driven}
        bodies = tuple((key, titles) for key, titles in values.items() if key not in others)
        return cls(bodies, driven, **{key: value for key, value in values.items() if key in named})

    def to_dict(self) -> dict[str, Any]:
        """Return the map as plain values."""
        values = super().to_dict()
        bodies, controls = values.pop("bodies"), values.pop("controls")
        return values | dict(controls) | dict(bodies)

    @classmethod
    def json_schema(cls) -> dict[str, Any]:
        """Return the JSON Schema of a map, whose other keys are names of bodies."""
        schema = super().json_schema()
        del schema["properties"]["bodies"], schema["properties"]["controls"]
        schema["properties"] |= dict.fromkeys((*QUANTITIES, COMMAND), _titles().schema)
        return schema | {"additionalProperties": BODY_TITLES.schema}


@dataclasses.dataclass(frozen=True)
class FileSource(_RecordingSettings):
    """File of a recording in several files, and its clock.

    Attributes:
        name: name of the file, without its folder, or a pattern, such as *_motors.csv.
        offset: seconds that are added to this file's times, at its first row, so that they are those of the
            first file's clock; None: estimated.
        drift: by how much this file's clock is faster than the first one's (ppm, 1e-6); None: estimated with
            the offset, or zero beside a stated offset.
        deviation: standard deviation of the offset (s), which `identify` then finds; None: it is known, or
            that of the estimate.
        time: title of its times; None: that of `columns`.
        time_unit: "s", "ms", "us" or "ns"; None: the unit that the title states, or s.
        rate: rows per second (Hz), for a table without times.
    """

    name: Annotated[str, LINE]
    offset: Annotated[float | None, number(-1e10, 1e10, "s")] = None
    drift: Annotated[float | None, number(-1e4, 1e4, "ppm")] = None
    deviation: Annotated[float | None, number(0.0, 10.0, "s")] = None
    time: Annotated[str | None, LINE._replace(read=_title, schema={"type": ["string", "integer"]})] = None
    time_unit: Annotated[Literal["s", "ms", "us", "ns"] | None, choice(TIME_UNITS)] = None
    rate: Annotated[float | None, number(1e-6, 1e6, "Hz")] = None


# configuration


@dataclasses.dataclass(frozen=True)
class RecordingConfig(_RecordingSettings):
    """Configuration of the topics of a bag, or the columns of a table.

    Parts may be mappings, as in a file: `RecordingConfig(markers=[{"name": "tip", "fraction": 1}], …)`.

    Attributes:
        markers: bodies on the rod, from base to tip: name, topic, fraction of the length, its deviation,
            rotation.
        tension, length, angle, current, pressure, volume, insertion, rotation, field, input: measured numbers
            that drive the robot, or None: topic, order, unit, held, names, gain, latency (s).
        command: commanded numbers, or None: the same, with text. They are of the measured quantity, or of the
            first one that has their unit.
        sensors: sensors beside motion capture: kind, columns or topic, fractions, unit, rotation.
        base: body that locates the clamped end, or None (`origin` locates it): topic, height above it (m).
        controls: default choice of the numbers that drive the robot, "measured" or "commanded"; "none" for
            a recording of poses only.
        position_unit: "m", "cm" or "mm"; None: the units that titles of columns state, or m.
        up: axis of motion capture's frame that points up: "z", "y", "x", "-x", "-y" or "-z". Poses are turned
            so that z points up before `frame_rotation` applies. None: the file's own, or z.
        origin: position of the clamped end (m), used without a base; in the turned frame, that is, with
            `up` and `frame_rotation` applied.
        frame_rotation: rotation from motion capture's frame (with z up) to the robot's frame, whose z points
            up the straight rod; a quaternion, scalar first.
        clock: "header": measurement times from the messages' headers; "received": recording times.
        table: titles of a table's columns, or None (this package's convention): rate of rows without times
            (Hz), position, quaternion, control, with `{}` in place of a topic or number.
        columns: titles of a table's columns, one by one; they take precedence over `table`.
        static: True if each row is a separate equilibrium, not part of a motion.
        repeats: "drop": a frame that repeats the previous pose exactly is not a measurement, because some
            motion capture repeats the last pose of a lost body; "keep": every frame is a measurement.
        longest_gap: longest gap between frames that is bridged (s); 1.5 periods of a stream always are.
        rest: interval in which the robot rests, straight up (s); None: detected from the motion.
        trim: interval of the recording that is used (s); None: no limit at that end.
        initial_control: controls before the first row (SI units); None: estimated from the rest.
        files: files of a recording in several files, and their clocks: name, offset (s), drift (1e-6), time.
        simulated: True if the robot was itself a simulation; None: not stated.
        description: one-line description of the recording.
        remarks: remarks on the guesses of a proposal: comments in its file, and not read from there.

    Raises:
        RecordingError: a value is not allowed.
    """

    markers: Annotated[tuple[MarkerSource, ...], parts(MarkerSource, "a list of markers")] = ()
    tension: Drive = None
    length: Drive = None
    angle: Drive = None
    current: Drive = None
    pressure: Drive = None
    volume: Drive = None
    insertion: Drive = None
    rotation: Drive = None
    field: Drive = None
    input: Drive = None
    command: Drive = None
    sensors: Annotated[tuple[SensorSource, ...], parts(SensorSource, "a list of sensors")] = ()
    base: Annotated[BaseSource | None, part(BaseSource)] = None
    table: Annotated[TableSource | None, part(TableSource)] = None
    columns: Annotated[ColumnMap | None, part(ColumnMap)] = None
    controls: Annotated[
        Literal["measured", "commanded", "none"], choice(("measured", "commanded", "none"))
    ] = "measured"
    position_unit: Annotated[Literal["m", "cm", "mm"] | None, choice(POSITION_UNITS)] = None
    up: Annotated[str | None, choice(UP)] = None
    origin: Annotated[Vector, numbers(3, "three numbers (m)")] = (0.0, 0.0, 0.0)
    frame_rotation: Annotated[Vector, QUATERNION] = (1.0, 0.0, 0.0, 0.0)
    clock: Annotated[Literal["header", "received"], choice(("header", "received"))] = "header"
    static: Annotated[bool, FLAG] = False
    repeats: Annotated[Literal["keep", "drop"], choice(("keep", "drop"))] = "keep"
    longest_gap: Annotated[float, number(0.0, 60.0, "s")] = 0.1
    rest: Annotated[Vector | None, _interval(is_open=False)] = None
    trim: Annotated[tuple[float | None, float | None], _interval(is_open=True)] = (None, None)
    simulated: Annotated[bool | None, FLAG] = None
    description: Annotated[str, TEXT] = ""
    initial_control: Annotated[Vector | None, numbers(None, "numbers (SI units), one of each control")] = None
    files: Annotated[tuple[FileSource, ...], parts(FileSource, "a list of files")] = ()
    remarks: tuple[str, ...] = dataclasses.field(default=(), compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.markers and not self.sensors:
            raise self.refusal("markers", self.markers, "a list of one marker or more, or sensors")
        places, names = [marker.fraction for marker in self.markers], [marker.name for marker in self.markers]
        if any(b <= a for a, b in itertools.pairwise(places)):
            raise RecordingError(
                f"markers have the fractions {excerpt(places)}; allowed is each above the last"
            )
        if len(set(names)) < len(names):
            raise RecordingError(f"markers have the names {excerpt(names)}; allowed is each once")
        mapped = dict(self.columns.controls) if self.columns else {}
        for name in QUANTITIES:
            if (source := getattr(self, name)) is not None:
                if source.text is not None:
                    raise RecordingError(f"{name}: text is of commands; allowed is none")
                object.__setattr__(self, name, source.of_quantity(name, mapped.get(name, ())))
        if self.command is not None:
            object.__setattr__(self, "command", self._commands(mapped.get(COMMAND, ())))
        if not self.measured and self.controls == "measured":
            raise RecordingError(
                "tension is missing; required where controls is measured, or another of "
                f"{', '.join(QUANTITIES)} (a recording of poses only has `controls: none`)"
            )
        if self.command is None and self.controls == "commanded":
            raise RecordingError("command is missing; required where controls is commanded")
        if self.measured and self.command and self.count != len(self.command.order):
            raise RecordingError(
                f"order has {self.count} numbers in {' and '.join(it.quantity for it in self.measured)} and "
                f"{len(self.command.order)} in command; allowed is the same number"
            )
        if self.initial_control is not None:
            words = f"{self.count} numbers (SI units), one of each control"
            self.accept("initial_control", numbers(self.count, words))
        sources = (*self.markers, *self.sensors, self.base, *self.measured, self.command)
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

        names = [file.name for file in self.files]
        if len(set(names)) < len(names):
            raise RecordingError(f"files have the names {excerpt(names)}; allowed is each once")

    def _commands(self, titles: Collection[str]) -> ControlSource:
        """Return the commands as those of a quantity. Raises `RecordingError`."""
        source = self.command
        assert source is not None
        if source.held is False:
            raise RecordingError(
                "command: held is false; allowed of a command is true: it is held until the next"
            )
        unit = source.unit or next(filter(None, (stated_unit(title, UNITS) for title in titles)), None)
        kinds = {it.kind.name for it in self.measured}
        name = kinds.pop() if len(kinds) == 1 else of_unit(UNITS[unit][1]).name if unit else "tension"
        return source.of_quantity(name, titles)

    @property
    def measured(self) -> tuple[ControlSource, ...]:
        """Measured sources that drive the robot, in the order of `QUANTITIES`."""
        return tuple(source for name in QUANTITIES if (source := getattr(self, name)) is not None)

    @property
    def idle(self) -> tuple[ControlSource, ...]:
        """Sources that do not drive the robot by default: they may be missing."""
        sent = (self.command,) if self.command else ()
        return {"measured": sent, "commanded": self.measured, "none": (*self.measured, *sent)}[self.controls]

    @property
    def position_factor(self) -> float:
        """Metres over the unit of the streams' positions."""
        return POSITION_UNITS[self.position_unit or "m"]

    @property
    def count(self) -> int:
        """Number of controls."""
        sources = self.measured or ((self.command,) if self.command else ())
        return sum(len(source.order) for source in sources)

    @classmethod
    def paper_robot(cls) -> Self:
        """Return the configuration of the paper's bags: five bodies, tensions in gf, commands in the log."""
        return cls._included("paper_robot.yaml")

    @classmethod
    def asl_trunk(cls) -> Self:
        """Return the configuration of the ASL trunk (Stanford): six angles of motors, three disks, 100 Hz."""
        return cls._included("asl_trunk.yaml")

    @classmethod
    @functools.cache
    def _included(cls, name: str) -> Self:
        return cls.load(Path(__file__).parent / "data" / name)

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
        defaults = {field.name: plain(field.default) for field in dataclasses.fields(self)}
        lines = [*(f"# {remark}" for remark in self.remarks), f"format: {FORMAT}"]
        for name, value in self.to_dict().items():
            if name in ("markers", "sensors", "files"):
                lines += [f"{name}:", *(f"  - {flow(source)}" for source in value)] if value else []
            elif name == "columns":
                lines += ["columns:", *(f"  {flow(key)}: {flow(titles)}" for key, titles in value.items())]
            elif not brief or value != defaults[name]:
                lines.append(f"{name}: {flow(value)}")
        return "\n".join(lines) + "\n"

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as plain values for JSON and YAML, without unset ones."""
        return {name: value for name, value in super().to_dict().items() if value not in ([None, None], "")}

    @classmethod
    def from_dict(cls, values: dict[Any, Any]) -> Self:
        """Return settings from the result of `to_dict`; missing keys get defaults.

        Raises:
            RecordingError: a key or value is invalid.
        """
        values = dict(values)
        number = values.pop("format", FORMAT)
        if number != FORMAT or isinstance(number, bool):
            raise cls.refusal("format", number, str(FORMAT))
        return super().from_dict(values if values.get("columns") is None else _with_mapped_sources(values))

    @classmethod
    def json_schema(cls) -> dict[str, Any]:
        """Return the JSON Schema of a file of settings, for editors."""
        schema = super().json_schema()
        schema["properties"]["format"] = {"const": FORMAT}
        for name in ("base", COMMAND, *QUANTITIES):
            # a map of columns names their topics
            source = {**schema["properties"][name]["anyOf"][0], "required": []}
            if name in QUANTITIES:
                units = {"unit": {"enum": [*QUANTITIES[name].units, None]}}
                source["properties"] = source["properties"] | units
            schema["properties"][name] = {"anyOf": [source, {"type": "null"}]}
        return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "recording", **schema}


def _with_mapped_sources(values: dict[Any, Any]) -> dict[Any, Any]:
    """Return settings with the sources that follow from their map of columns. Raises `RecordingError`."""
    if not isinstance(values["columns"], dict):
        words = "a mapping with time, quantities such as tension, and the names of bodies"
        raise RecordingConfig.refusal("columns", values["columns"], words)
    columns = RecordingConfig.accepted("columns", values["columns"], part(ColumnMap))
    values = {**values, "columns": columns}
    for name, titles in columns.controls:
        stated = values.get(name) or {}
        if isinstance(stated, dict):
            values[name] = {"topic": name, "order": list(range(1, len(titles) + 1))} | stated
    if not any(values.get(name) for name in QUANTITIES):
        values.setdefault("controls", "commanded" if values.get(COMMAND) else "none")
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
