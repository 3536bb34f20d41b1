"""Sources of a recording's data: topics of a bag or columns of a table, with their units and order."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal

from knode_cosserat._files.yaml_text import shown
from knode_cosserat.recordings.config_values import (
    PLACE,
    Vector,
    checked_choice,
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
#: units of motors: angles to rad, or wound-up lengths to m
MOTOR_UNITS = {"rad": 1.0, "deg": math.pi / 180.0, "m": 1.0, "mm": 1e-3}


def set_field(settings: Any, name: str, value: Any) -> None:
    """Set a field of frozen settings while they are made."""
    object.__setattr__(settings, name, value)


@dataclasses.dataclass(frozen=True)
class MarkerSource:
    """Body on the rod, tracked by motion capture.

    Attributes:
        name: name in reports.
        topic: topic of its poses; a body without orientation may have positions only.
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


@dataclasses.dataclass(frozen=True)
class TensionSource:
    """Measured tensions.

    Attributes:
        topic: topic of the tensions.
        order: tendon of each number in a message; tendons count from 1.
        unit: "N" or "gf" (grams-force).
        held: True if a tension acts unchanged until the next one, as commands do; otherwise it is a sample
            at that instant, and tensions are interpolated linearly.
    """

    topic: str
    order: tuple[int, ...]
    unit: Literal["N", "gf"] = "N"
    held: bool | None = None

    def __post_init__(self) -> None:
        set_field(self, "topic", checked_text(self.topic, "topic"))
        set_field(self, "order", checked_order(self.order))
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
    """

    topic: str
    order: tuple[int, ...]
    unit: Literal["rad", "deg", "m", "mm"] = "rad"
    latency: float = 0.0

    def __post_init__(self) -> None:
        set_field(self, "topic", checked_text(self.topic, "topic"))
        set_field(self, "order", checked_order(self.order))
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
