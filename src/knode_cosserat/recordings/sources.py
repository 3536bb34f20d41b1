"""Sources of a recording's data: topics of a bag or columns of a table, with their units and order."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal, Self

from knode_cosserat._files.yaml_text import shown
from knode_cosserat.recordings.config_values import (
    PLACE,
    Vector,
    checked_choice,
    checked_column_titles,
    checked_number,
    checked_order,
    checked_quaternion,
    checked_text,
    checked_titles,
)
from knode_cosserat.recordings.findings import RecordingError

#: conversion factors to SI units
TENSION_UNITS = {"N": 1.0, "gf": 9.81 / 1000.0}
POSITION_UNITS = {"m": 1.0, "mm": 1e-3}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
#: units of motors: angles to rad, or wound-up lengths to m
MOTOR_UNITS = {"rad": 1.0, "deg": math.pi / 180.0, "m": 1.0, "mm": 1e-3}

#: default prefixes of a table's columns of tensions
TENSION, HELD, COMMAND = "tension", "held_tension", "command"


def set_field(settings: Any, name: str, value: Any) -> None:
    """Set a field of frozen settings while they are made."""
    object.__setattr__(settings, name, value)


@dataclasses.dataclass(frozen=True)
class MarkerSource:
    """Body on the rod, tracked by motion capture.

    Attributes:
        name: name in reports.
        topic: topic of its poses; a body without orientation may have positions only. In bags `/poses[2]`
            is the third pose of a PoseArray, and `/tf[tip]` the frame `tip` of transforms.
        fraction: its place, as a fraction of the rod's length: 0 is the clamped end, 1 the tip.
        rotation: the body's axes in the rod's local frame, as a quaternion, scalar first; None: the axes
            are calibrated at rest, when the rod points up.
    """

    name: str
    topic: str
    fraction: float
    rotation: Vector | None = None

    def __post_init__(self) -> None:
        set_field(self, "name", checked_text(self.name, "name"))
        set_field(self, "topic", checked_text(self.topic, "topic"))
        set_field(self, "fraction", checked_number(self.fraction, "fraction", 0.0, 1.0))
        if self.rotation is not None:
            set_field(self, "rotation", checked_quaternion(self.rotation, "rotation"))


@dataclasses.dataclass(frozen=True)
class BaseSource:
    """Body fixed to the base, `height` (m) above the rod's clamped end."""

    topic: str
    height: float = 0.0

    def __post_init__(self) -> None:
        set_field(self, "topic", checked_text(self.topic, "topic"))
        set_field(self, "height", checked_number(self.height, "height", -10.0, 10.0, "m"))


def _check_numbers(source: Any) -> None:
    """Check and set topic, order and names of numbers in messages. Raises `RecordingError`."""
    set_field(source, "topic", checked_text(source.topic, "topic"))
    if source.names is not None:
        given = source.names if isinstance(source.names, list | tuple) else [source.names]
        names = tuple(checked_text(name, "names") for name in given)
        if len(set(names)) < len(names) or not names:
            raise RecordingError(f"names is {shown(list(names))}; allowed is each name once")
        set_field(source, "names", names)
        if source.order == ():
            set_field(source, "order", tuple(range(1, len(names) + 1)))
    if source.order == ():
        raise RecordingError("the key order is missing; required is topic, order or names")
    set_field(source, "order", checked_order(source.order))
    if source.names is not None and len(source.names) != len(source.order):
        raise RecordingError(
            f"names has {len(source.names)} names and order {len(source.order)} numbers; allowed is the same "
            "number"
        )
    if source.topic.count(PLACE) > 1:
        raise RecordingError(f"topic is {shown(source.topic)}; allowed is one {PLACE} at most")


@dataclasses.dataclass(frozen=True)
class TensionSource:
    """Measured tensions.

    Attributes:
        topic: topic of the tensions. With `{}` in it each tendon has its own topic: the place stands for the
            tendons' names, or without names for 1, 2, 3, …
        order: tendon of each number in a message; tendons count from 1. Empty: that of `names`.
        unit: "N" or "gf" (grams-force).
        held: True if a tension acts unchanged until the next one, as commands do; otherwise it is a sample
            at that instant, and tensions are interpolated linearly.
        names: names in the messages (joints of a JointState), or in the topics, of each number in `order`;
            None: joints whose names end in numbers are matched by these.
    """

    topic: str
    order: tuple[int, ...] = ()
    unit: Literal["N", "gf"] = "N"
    held: bool | None = None
    names: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        _check_numbers(self)
        checked_choice(self.unit, "unit", TENSION_UNITS)
        if self.held not in (None, True, False):
            raise RecordingError(f"held is {shown(self.held)}; allowed is true or false")


@dataclasses.dataclass(frozen=True)
class CommandSource(TensionSource):
    """Commanded tensions, each held until the next.

    Attributes:
        text: template of text messages, with `{}` in place of the numbers (other lines of a log are not
            commands); None for messages of numbers.
        latency: delay from a command's stamp until it reaches the tendons (s).
    """

    text: str | None = None
    latency: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.held is False:
            raise RecordingError("held is false; allowed of a command is true: it is held until the next")
        set_field(self, "latency", checked_number(self.latency, "latency", 0.0, 10.0, "s"))
        if self.text is not None and str(self.text).count(PLACE) != 1:
            raise RecordingError(
                f"text is {shown(self.text)}; allowed is text with one {PLACE} where the numbers stand"
            )


@dataclasses.dataclass(frozen=True)
class MotorSource:
    """Measured angles of motors that wind up tendons, or the wound-up lengths.

    Attributes:
        topic: topic of the angles or lengths.
        order: motor of each number in a message; motors count from 1.
        unit: "rad" or "deg" for angles; "m" or "mm" for lengths.
        latency: delay from an angle's stamp until it acts on the robot (s): the offset between the clocks
            of motors and motion capture.
        names: names of the motors in messages or topics, as in `TensionSource`. Angles in a JointState are
            its positions.
    """

    topic: str
    order: tuple[int, ...] = ()
    unit: Literal["rad", "deg", "m", "mm"] = "rad"
    latency: float = 0.0
    names: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        _check_numbers(self)
        checked_choice(self.unit, "unit", MOTOR_UNITS)
        set_field(self, "latency", checked_number(self.latency, "latency", -10.0, 10.0, "s"))


@dataclasses.dataclass(frozen=True)
class TableSource:
    """Titles of a table's columns, where they differ from this package's convention.

    Attributes:
        rate: rows per second (Hz), for a table without a time column; None: the column `time [s]` is used.
        position: titles of a body's position, with `{}` in place of its topic.
        quaternion: titles of its orientation, scalar first; a body without these columns has no orientation.
        motor: title of a motor's angle, or of a tension, with `{}` in place of its number.
    """

    rate: float | None = None
    position: tuple[str, ...] | None = None
    quaternion: tuple[str, ...] | None = None
    motor: str | None = None

    def __post_init__(self) -> None:
        if self.rate is not None:
            set_field(self, "rate", checked_number(self.rate, "rate", 1e-6, 1e6, "Hz"))
        for name, count in (("position", 3), ("quaternion", 4)):
            if getattr(self, name) is not None:
                set_field(self, name, checked_titles(getattr(self, name), name, count))
        if self.motor is not None:
            set_field(self, "motor", checked_titles([self.motor], "motor", 1)[0])


#: topics of the sources that a map of columns stands for
MAPPED = {"tensions": "tension", "commands": "command", "motors": "motor"}


@dataclasses.dataclass(frozen=True)
class ColumnMap:
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

    bodies: tuple[tuple[str, tuple[str, ...]], ...] = ()
    time: str | None = None
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    tensions: tuple[str, ...] | None = None
    commands: tuple[str, ...] | None = None
    motors: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.time is not None:
            time: Any = self.time
            time = str(time) if type(time) is int else time
            set_field(self, "time", checked_text(time, "time").strip())
        if self.time_unit is not None:
            checked_choice(self.time_unit, "time_unit", TIME_UNITS)
        for name in MAPPED:
            if getattr(self, name) is not None:
                set_field(self, name, checked_column_titles(getattr(self, name), name))
        bodies = tuple(
            (checked_text(name, "body"), checked_column_titles(titles, str(name), (3, 7)))
            for name, titles in self.bodies
        )
        set_field(self, "bodies", bodies)

    @classmethod
    def from_dict(cls, values: dict[Any, Any]) -> Self:
        """Return a map from a mapping, whose other keys are names of bodies. Raises `RecordingError`."""
        named = {field.name for field in dataclasses.fields(cls)} - {"bodies"}
        bodies = tuple((key, titles) for key, titles in values.items() if key not in named)
        return cls(bodies, **{key: value for key, value in values.items() if key in named})

    def to_dict(self) -> dict[str, Any]:
        """Return the mapping that `from_dict` reads, as plain values."""
        names = ("time", "time_unit", *MAPPED)
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        plain = {name: list(value) if isinstance(value, tuple) else value for name, value in given.items()}
        return plain | {name: list(titles) for name, titles in self.bodies}
