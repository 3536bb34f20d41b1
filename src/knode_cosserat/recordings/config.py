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
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from knode_cosserat._files.writing import replacing
from knode_cosserat._files.yaml_text import YAMLTextError, did_you_mean, flow, mapping_of, read_yaml, shown
from knode_cosserat.recordings.findings import RecordingError

Vector = tuple[float, ...]
FORMAT = 1
#: placeholder of the numbers in a command's text, or of the number or topic in a title
PLACE = "{}"
#: conversion factors to SI units
TENSION_UNITS = {"N": 1.0, "gf": 9.81 / 1000.0}
POSITION_UNITS = {"m": 1.0, "mm": 1e-3}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
#: units of motors: angles to rad, or wound-up lengths to m
MOTOR_UNITS = {"rad": 1.0, "deg": math.pi / 180.0, "m": 1.0, "mm": 1e-3}
#: axes of motion capture that point up, with the rotation vector (rad) that turns them to z
UP: dict[str, Vector] = {
    "z": (0.0, 0.0, 0.0),
    "y": (math.pi / 2, 0.0, 0.0),
    "x": (0.0, -math.pi / 2, 0.0),
    "-z": (math.pi, 0.0, 0.0),
    "-y": (-math.pi / 2, 0.0, 0.0),
    "-x": (0.0, math.pi / 2, 0.0),
}
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
        ends = [None if end is None and is_open else _real(end) for end in _listed(value)]
        start, end = ends if len(ends) == 2 else (None, None)
        wrong = any(
            stored is None and not (end is None and is_open)
            for stored, end in zip(ends, _listed(value), strict=True)
        )
        if len(ends) != 2 or wrong or (start is not None and end is not None and not start < end):
            words = "[start, end] in s, start before end" + (", either of them null" if is_open else "")
            raise _refused(value, name, words)
        return start, end

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


class _Settings:
    """Settings whose fields are checked when they are made; a field whose default is None may be None."""

    _checks: ClassVar[Mapping[str, _Check]]

    def __post_init__(self) -> None:
        defaults = {field.name: field.default for field in dataclasses.fields(self)}  # type: ignore[arg-type]
        for name, check in self._checks.items():
            value = getattr(self, name)
            if value is not None or defaults[name] is not None:
                self._set(name, check(value, name))

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)


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
    """

    name: str
    topic: str
    fraction: float
    rotation: Vector | None = None

    _checks: ClassVar = {
        "name": _text,
        "topic": _text,
        "fraction": _number(0.0, 1.0),
        "rotation": _quaternion,
    }


@dataclasses.dataclass(frozen=True)
class BaseSource(_Settings):
    """Body fixed to the base, `height` (m) above the rod's clamped end."""

    topic: str
    height: float = 0.0

    _checks: ClassVar = {"topic": _text, "height": _number(-10.0, 10.0, "m")}


class _NumbersSource(_Settings):
    """Source with a topic, the order of its numbers, and names."""

    topic: str
    order: tuple[int, ...]
    names: tuple[str, ...] | None

    def __post_init__(self) -> None:
        if self.names is not None:
            names = tuple(_text(name, "names") for name in _listed(self.names) or [self.names])
            if len(set(names)) < len(names) or self.names in ([], ()):
                raise _refused(list(_listed(self.names)), "names", "each name once")
            self._set("names", names)
            if self.order == ():
                self._set("order", tuple(range(1, len(names) + 1)))
        if self.order == ():
            raise RecordingError("the key order is missing; required is topic, order or names")
        super().__post_init__()
        if self.names is not None and len(self.names) != len(self.order):
            raise RecordingError(
                f"names has {len(self.names)} names and order {len(self.order)} numbers; allowed is the same "
                "number"
            )
        if self.topic.count(PLACE) > 1:
            raise _refused(self.topic, "topic", f"one {PLACE} at most")


@dataclasses.dataclass(frozen=True)
class TensionSource(_NumbersSource):
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

    _checks: ClassVar = {"topic": _text, "order": _order, "unit": _choice(TENSION_UNITS), "held": _flag}


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

    _checks: ClassVar = {**TensionSource._checks, "latency": _number(0.0, 10.0, "s")}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.held is False:
            raise RecordingError("held is false; allowed of a command is true: it is held until the next")
        if self.text is not None and str(self.text).count(PLACE) != 1:
            raise _refused(self.text, "text", f"text with one {PLACE} where the numbers stand")


@dataclasses.dataclass(frozen=True)
class MotorSource(_NumbersSource):
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

    _checks: ClassVar = {
        "topic": _text, "order": _order, "unit": _choice(MOTOR_UNITS), "latency": _number(-10.0, 10.0, "s")
    }  # fmt: skip


@dataclasses.dataclass(frozen=True)
class TableSource(_Settings):
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

    _checks: ClassVar = {
        "rate": _number(1e-6, 1e6, "Hz"),
        "position": _templates(3),
        "quaternion": _templates(4),
        "motor": lambda value, name: _templates(1)([value], name)[0],
    }


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

    bodies: tuple[tuple[str, tuple[str, ...]], ...] = ()
    time: str | None = None
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    tensions: tuple[str, ...] | None = None
    commands: tuple[str, ...] | None = None
    motors: tuple[str, ...] | None = None

    _checks: ClassVar = {
        "time": lambda value, name: _text(str(value) if type(value) is int else value, name).strip(),
        "time_unit": _choice(TIME_UNITS),
        **dict.fromkeys(MAPPED, _titles()),
        "bodies": lambda value, name: tuple(
            (_text(body, "body"), _titles(3, 7)(titles, str(body))) for body, titles in value
        ),
    }

    @classmethod
    def from_dict(cls, values: dict[Any, Any]) -> Self:
        """Return a map from a mapping, whose other keys are names of bodies. Raises `RecordingError`."""
        named = {field.name for field in dataclasses.fields(cls)} - {"bodies"}
        bodies = tuple((key, titles) for key, titles in values.items() if key not in named)
        return cls(bodies, **{key: value for key, value in values.items() if key in named})

    def to_dict(self) -> dict[str, Any]:
        """Return the mapping that `from_dict` reads, as plain values."""
        named = {field.name: _plain(getattr(self, field.name)) for field in dataclasses.fields(self)[1:]}
        return {name: value for name, value in named.items() if value is not None} | _plain(dict(self.bodies))


# configuration


@dataclasses.dataclass(frozen=True)
class RecordingConfig(_Settings):
    """Configuration of the topics of a bag, or the columns of a table.

    Attributes:
        markers: bodies on the rod, from base to tip.
        tension: measured tensions, or None.
        motors: measured motor angles in place of tensions, or None.
        command: commanded tensions, or None.
        base: body that locates the clamped end; None: `origin` locates it.
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
        table: titles of a table's columns; None: this package's convention.
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

    markers: tuple[MarkerSource, ...]
    tension: TensionSource | None = None
    motors: MotorSource | None = None
    command: CommandSource | None = None
    base: BaseSource | None = None
    table: TableSource | None = None
    columns: ColumnMap | None = None
    tensions: Literal["measured", "commanded", "none"] = "measured"
    position_unit: Literal["m", "mm"] = "m"
    up: str | None = None
    origin: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (1.0, 0.0, 0.0, 0.0)
    clock: Literal["header", "received"] = "header"
    static: bool = False
    repeats: Literal["keep", "drop"] = "keep"
    longest_gap: float = 0.1
    rest: Vector | None = None
    trim: tuple[float | None, float | None] = (None, None)
    simulated: bool | None = None
    description: str = ""
    initial_tension: Vector | None = None

    _checks: ClassVar = {
        "tensions": _choice(("measured", "commanded", "none")),
        "position_unit": _choice(POSITION_UNITS),
        "up": _choice(UP),
        "clock": _choice(("header", "received")),
        "repeats": _choice(("keep", "drop")),
        "static": _flag,
        "origin": _numbers(3, "three numbers (m)"),
        "rotation": _quaternion,
        "longest_gap": _number(0.0, 60.0, "s"),
        "rest": _interval(is_open=False),
        "trim": _interval(is_open=True),
        "simulated": _flag,
        "description": _any_text,
    }

    def __post_init__(self) -> None:
        self._check_markers()
        for name, kind in _PARTS.items():
            value = getattr(self, name)
            if value is not None and type(value) is not kind:
                raise _refused(value, name, f"a {kind.__name__}, or nothing")
        super().__post_init__()
        self._check_together()

    def _check_markers(self) -> None:
        markers = tuple(_listed(self.markers))
        if not markers or any(not isinstance(marker, MarkerSource) for marker in markers):
            raise _refused(self.markers, "markers", "a list of one marker or more")
        places = [marker.fraction for marker in markers]
        if any(b <= a for a, b in itertools.pairwise(places)):
            raise RecordingError(
                f"markers have the fractions {shown(places)}; allowed is each above the last"
            )
        names = [marker.name for marker in markers]
        if len(set(names)) < len(names):
            raise RecordingError(f"markers have the names {shown(names)}; allowed is each once")
        self._set("markers", markers)

    def _check_together(self) -> None:
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
        sources = (*self.markers, self.base, self.measured, self.command)
        topics = [source.topic for source in sources if source]
        twice = next((topic for topic in topics if topics.count(topic) > 1), None)
        if twice is not None:
            raise RecordingError(f"the topic {twice} is there twice; allowed is one use of each topic")
        bodies = [name for name, _ in self.columns.bodies] if self.columns else []
        known = [source.topic for source in (*self.markers, self.base) if source]
        unknown = next((name for name in bodies if name not in known), None)
        if unknown is not None:
            raise RecordingError(
                f"columns are of {unknown}, and no marker has this topic; allowed is "
                f"{', '.join(known)}{did_you_mean(unknown, known)}"
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
            if name == "markers":
                lines += ["markers:", *(f"  - {flow(marker)}" for marker in value)]
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
        if values.get("columns") is not None:
            values = _with_mapped_sources(values)
        for name, kind in _PARTS.items():
            if values.get(name) is not None and not isinstance(values[name], kind):
                values[name] = _part(kind, values[name], name)
        if isinstance(values.get("markers"), list):
            values["markers"] = tuple(
                _part(MarkerSource, marker, f"markers, number {k + 1}")
                for k, marker in enumerate(values["markers"])
            )
        return _constructed(cls, values)


_PARTS: dict[str, type] = {
    "tension": TensionSource, "motors": MotorSource, "command": CommandSource, "base": BaseSource,
    "table": TableSource, "columns": ColumnMap,
}  # fmt: skip


def _part(kind: Any, values: Any, where: str) -> Any:
    if not isinstance(values, dict):
        names = ", ".join(field.name for field in dataclasses.fields(kind))
        raise _refused(values, where, f"a mapping with {names}")
    if kind is MarkerSource and "name" in values:
        # without a topic it is called like the marker
        values = {"topic": values["name"]} | values
    try:
        return _constructed(kind, values)
    except RecordingError as error:
        raise RecordingError(f"{where}: {error}") from None


def _with_mapped_sources(values: dict[Any, Any]) -> dict[Any, Any]:
    """Return settings with the sources that follow from their map of columns. Raises `RecordingError`."""
    if not isinstance(values["columns"], dict):
        raise _refused(values["columns"], "columns", "a mapping with time, tensions and the names of bodies")
    try:
        columns = ColumnMap.from_dict(values["columns"])
    except RecordingError as error:
        raise RecordingError(f"columns: {error}") from None
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
    if not values.get("markers") and len(bodies) != 1:
        raise RecordingError(
            f"markers is missing; required with the columns of {len(bodies)} bodies: "
            "markers: [{name: …, fraction: …}, …], from base to tip"
        )
    return values | {"markers": values.get("markers") or [{"name": bodies[0], "fraction": 1.0}]}


def _constructed(kind: Any, values: dict[Any, Any]) -> Any:
    fields = dataclasses.fields(kind)
    for key in values:
        _require_known(key, [field.name for field in fields])
    required = [field.name for field in fields if field.default is dataclasses.MISSING]
    missing = [name for name in required if values.get(name) is None]
    if missing:
        raise RecordingError(f"the key {missing[0]} is missing; required is {', '.join(required)}")
    return kind(**values)


def _require_known(key: Any, known: list[str]) -> None:
    if key not in known:
        raise RecordingError(
            f"the key {shown(key)} is unknown; allowed is {', '.join(known)}{did_you_mean(key, known)}"
        )


def _plain(value: Any) -> Any:
    """Return a value as plain values for JSON and YAML; parts without unset settings."""
    if isinstance(value, ColumnMap):
        return value.to_dict()
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if dataclasses.is_dataclass(value):
        named = {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
        if not isinstance(value, RecordingConfig):
            named = {name: part for name, part in named.items() if part is not None}
        return named
    return [_plain(part) for part in value] if isinstance(value, tuple) else value
