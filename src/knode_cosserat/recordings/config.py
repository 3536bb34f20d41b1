"""What a recording's topics or columns mean: settings as data, checked when they are made, as YAML and back.

    format: 1
    description: our robot, three tendons and one body at the tip
    simulated: false
    tension: {topic: /load_cells, unit: N, order: [1, 2, 3]}
    markers:
      - {name: tip, topic: /mocap/tip/pose, fraction: 1}

The same settings serve bags and tables. In a table a topic is what the columns' titles begin with: the topic
`tip` has the columns `tip_x [m]`, `tip_y [m]`, `tip_z [m]` and, for its orientation, `tip_qw` to `tip_qz`;
the topic `tension` has `tension_1 [N]`, `tension_2 [N]` and so on.
"""

from __future__ import annotations

import dataclasses
import fractions
import itertools
import math
from pathlib import Path
from typing import Any, Literal, Self

from knode_cosserat._files import replacing
from knode_cosserat._yaml import YAMLTextError, did_you_mean, flow, mapping_of, shown
from knode_cosserat.recordings.findings import RecordingError

FORMAT = 1
#: how many of the SI unit one is
TENSION_UNITS = {"N": 1.0, "gf": 9.81 / 1000.0}
POSITION_UNITS = {"m": 1.0, "mm": 1e-3}
#: where the numbers stand in the text of a command
PLACE = "{}"
Vector = tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class MarkerSource:
    """A body that motion capture sees on the rod.

    Attributes:
        name: what reports call it.
        topic: where its poses are; a body without orientation may have positions only.
        fraction: where it sits, as a fraction of the rod's length: 0 is the clamped end, 1 the tip.
        rotation: the body's axes in the rod's frame there, as a quaternion, scalar first; None: they are
            those seen at rest, when the rod points up.
    """

    name: str
    topic: str
    fraction: float
    rotation: Vector | None = None

    def __post_init__(self) -> None:
        _set(self, "name", _text(self.name, "name"))
        _set(self, "topic", _text(self.topic, "topic"))
        _set(self, "fraction", _number(self.fraction, "fraction", 0.0, 1.0))
        if self.rotation is not None:
            _set(self, "rotation", _quaternion(self.rotation, "rotation"))


@dataclasses.dataclass(frozen=True)
class BaseSource:
    """A body that does not move with the rod, `height` (m) above the rod's clamped end."""

    topic: str
    height: float = 0.0

    def __post_init__(self) -> None:
        _set(self, "topic", _text(self.topic, "topic"))
        _set(self, "height", _number(self.height, "height", -10.0, 10.0, "m"))


@dataclasses.dataclass(frozen=True)
class TensionSource:
    """Measured tensions.

    Attributes:
        topic: where they are.
        order: which tendon each number of a message belongs to; tendons count from 1.
        unit: "N" or "gf" (grams-force).
    """

    topic: str
    order: tuple[int, ...]
    unit: Literal["N", "gf"] = "N"

    def __post_init__(self) -> None:
        _set(self, "topic", _text(self.topic, "topic"))
        _set(self, "order", _order(self.order))
        _choice(self.unit, "unit", TENSION_UNITS)


@dataclasses.dataclass(frozen=True)
class CommandSource(TensionSource):
    """Commanded tensions, each held until the next.

    Attributes:
        text: what a message of text says, with `{}` where the numbers stand (in a log, other lines are not
            commands); None for messages of numbers.
        latency: how long after its stamp a command reaches the tendons (s).
    """

    text: str | None = None
    latency: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _set(self, "latency", _number(self.latency, "latency", 0.0, 10.0, "s"))
        if self.text is not None and str(self.text).count(PLACE) != 1:
            raise RecordingError(
                f"text is {shown(self.text)}; allowed is text with one {PLACE} where the numbers stand"
            )


@dataclasses.dataclass(frozen=True)
class RecordingConfig:
    """What the topics of a bag, or the columns of a table, mean.

    Attributes:
        markers: the bodies on the rod, from base to tip.
        tension: measured tensions, or None if there are none.
        command: commanded tensions, or None.
        base: the body that tells where the clamped end is, or None: then `origin` says it.
        tensions: which of the two a robot is driven by, where nothing else is asked for.
        position_unit: "m" or "mm".
        origin: the clamped end in motion capture's frame (m), where there is no base.
        rotation: turns motion capture's frame to the robot's, whose z points up the straight rod; a
            quaternion, scalar first.
        clock: "header": the stamps in messages' headers, when they were measured; "received": when they were
            recorded.
        longest_gap: the longest time without frames that is bridged (s); a stream's own period always is.
        rest: from when to when the robot rests, straight up (s); None: found from the motion.
        trim: from when to when the recording is used (s); None: from its start, to its end.
        simulated: whether the robot was itself a simulation; None: not stated.
        description: what was recorded, in one line.

    Raises:
        RecordingError: a value is not allowed.
    """

    markers: tuple[MarkerSource, ...]
    tension: TensionSource | None = None
    command: CommandSource | None = None
    base: BaseSource | None = None
    tensions: Literal["measured", "commanded"] = "measured"
    position_unit: Literal["m", "mm"] = "m"
    origin: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (1.0, 0.0, 0.0, 0.0)
    clock: Literal["header", "received"] = "header"
    longest_gap: float = 0.1
    rest: Vector | None = None
    trim: tuple[float | None, float | None] = (None, None)
    simulated: bool | None = None
    description: str = ""

    def __post_init__(self) -> None:
        _set(self, "markers", _markers(self.markers))
        for name, kind in _PARTS.items():
            value = getattr(self, name)
            if value is not None and type(value) is not kind:
                raise RecordingError(f"{name} is {shown(value)}; allowed is a {kind.__name__}, or nothing")
        _choice(self.tensions, "tensions", ("measured", "commanded"))
        _choice(self.position_unit, "position_unit", POSITION_UNITS)
        _choice(self.clock, "clock", ("header", "received"))
        _set(self, "origin", _numbers(self.origin, "origin", 3, "three numbers (m)"))
        _set(self, "rotation", _quaternion(self.rotation, "rotation"))
        _set(self, "longest_gap", _number(self.longest_gap, "longest_gap", 0.0, 60.0, "s"))
        if self.rest is not None:
            _set(self, "rest", _interval(self.rest, "rest", open_ended=False))
        _set(self, "trim", _interval(self.trim, "trim", open_ended=True))
        if self.simulated is not None and not isinstance(self.simulated, bool):
            raise RecordingError(f"simulated is {shown(self.simulated)}; allowed is true or false")
        if not isinstance(self.description, str):
            raise RecordingError(f"description is {shown(self.description)}; allowed is text")
        self._check_together()

    def _check_together(self) -> None:
        driver = "tension" if self.tensions == "measured" else "command"
        if getattr(self, driver) is None:
            raise RecordingError(f"{driver} is missing; required where tensions is {self.tensions}")
        if self.tension and self.command and len(self.tension.order) != len(self.command.order):
            raise RecordingError(
                f"order has {len(self.tension.order)} tendons in tension and {len(self.command.order)} in "
                "command; allowed is the same number"
            )
        topics = [source.topic for source in (*self.markers, self.base, self.tension, self.command) if source]
        twice = next((topic for topic in topics if topics.count(topic) > 1), None)
        if twice is not None:
            raise RecordingError(f"the topic {twice} is there twice; allowed is one use of each topic")

    @property
    def tendons(self) -> int:
        """How many tendons there are."""
        source = self.tension or self.command
        assert source is not None
        return len(source.order)

    @classmethod
    def paper_robot(cls) -> Self:
        """The bags of the paper's robot: five bodies, tensions in grams-force, commands in the log."""
        wire = (4, 1, 2, 3)
        return cls(
            markers=tuple(
                MarkerSource(f"rib {k + 1}", f"/vicon/continuum_{k}/pose", ninths / 9)
                for k, ninths in enumerate((3, 5, 7, 9))
            ),
            tension=TensionSource("/tension", wire, "gf"),
            command=CommandSource("/rosout", wire, "gf", text="Serial Command: {}", latency=0.06),
            base=BaseSource("/vicon/continuum_base/pose", height=0.0635),
            description="the paper's tendon robot, or one with the same topics",
        )

    def replace(self, **changes: Any) -> Self:
        """The same settings with some of them changed. Raises `RecordingError`."""
        names = [field.name for field in dataclasses.fields(self)]
        for name in changes:
            _require_known(name, names)
        return dataclasses.replace(self, **changes)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read settings from a YAML file.

        Raises:
            RecordingError: the file cannot be read, or a key or value is not right; it names both.
        """
        try:
            text = Path(path).read_text(encoding="utf-8-sig")
            return cls.from_dict(mapping_of(text, "format, markers and tension"))
        except FileNotFoundError:
            raise RecordingError(f"{path}: no such file") from None
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
        except UnicodeDecodeError:
            raise RecordingError(f"{path}: not YAML: it is not UTF-8 text") from None
        except (YAMLTextError, RecordingError) as error:
            raise RecordingError(f"{path}: {error}") from None

    def save(self, path: str | Path) -> None:
        """Write the settings as a YAML file that `load` reads back equal. Raises `RecordingError`."""
        lines = [f"format: {FORMAT}"]
        for name, value in self.to_dict().items():
            if name == "markers":
                lines += ["markers:", *(f"  - {flow(marker)}" for marker in value)]
            else:
                lines.append(f"{name}: {flow(value)}")
        try:
            with replacing(Path(path)) as temporary:
                temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror}") from None

    def to_dict(self) -> dict[str, Any]:
        """The settings as JSON and YAML can have them, without those that are not given."""
        return {name: value for name, value in _plain(self).items() if value not in (None, [None, None], "")}

    @classmethod
    def from_dict(cls, values: dict[Any, Any]) -> Self:
        """The settings that `to_dict` gave; what is not there is at its default. Raises `RecordingError`."""
        values = dict(values)
        number = values.pop("format", FORMAT)
        if number != FORMAT or isinstance(number, bool):
            raise RecordingError(f"format is {shown(number)}; allowed is {FORMAT}")
        for name, kind in _PARTS.items():
            if values.get(name) is not None:
                values[name] = _part(kind, values[name], name)
        if isinstance(values.get("markers"), list):
            values["markers"] = tuple(
                _part(MarkerSource, marker, f"markers, number {k + 1}")
                for k, marker in enumerate(values["markers"])
            )
        return _made(cls, values)


_PARTS: dict[str, type] = {"tension": TensionSource, "command": CommandSource, "base": BaseSource}


# mappings


def _part(kind: type, values: Any, where: str) -> Any:
    if not isinstance(values, dict):
        names = ", ".join(field.name for field in dataclasses.fields(kind))
        raise RecordingError(f"{where} is {shown(values)}; allowed is a mapping with {names}")
    try:
        return _made(kind, values)
    except RecordingError as error:
        raise RecordingError(f"{where}: {error}") from None


def _made(kind: Any, values: dict[Any, Any]) -> Any:
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
    if dataclasses.is_dataclass(value):
        named = {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
        if not isinstance(value, RecordingConfig):
            named = {name: part for name, part in named.items() if part is not None}
        return named
    return [_plain(part) for part in value] if isinstance(value, tuple) else value


# values


def _set(settings: Any, name: str, value: Any) -> None:
    object.__setattr__(settings, name, value)


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise RecordingError(f"{name} is {shown(value)}; allowed is text on one line")
    return value


def _choice(value: Any, name: str, allowed: Any) -> None:
    if not isinstance(value, str) or value not in allowed:
        raise RecordingError(f"{name} is {shown(value)}; allowed is {' or '.join(allowed)}")


def _number(value: Any, name: str, low: float, high: float, unit: str = "") -> float:
    number = _fraction(value)
    if number is None or not low <= number <= high:
        words = f"a number from {low:g} to {high:g} {unit}".strip()
        raise RecordingError(f"{name} is {shown(value)}; allowed is {words}")
    return number


def _fraction(value: Any) -> float | None:
    """A finite number, also if it is written as 3/9; None of anything else."""
    try:
        if isinstance(value, str) and value.count("/") == 1 and len(value) < 40:
            return float(fractions.Fraction(value.replace(" ", "")))
        if isinstance(value, bool | str) or value is None:
            return None
        number = float(value)
    except (TypeError, ValueError, OverflowError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _numbers(value: Any, name: str, count: int, words: str) -> Vector:
    numbers = [_fraction(each) for each in value] if isinstance(value, list | tuple) else []
    if len(numbers) != count or None in numbers:
        raise RecordingError(f"{name} is {shown(value)}; allowed is {words}")
    return tuple(number for number in numbers if number is not None)


def _quaternion(value: Any, name: str) -> Vector:
    words = "a quaternion of length 1, scalar first"
    numbers = _numbers(value, name, 4, words)
    size = math.hypot(*numbers)
    if abs(size - 1.0) > 1e-3:
        raise RecordingError(f"{name} is {shown(value)}; allowed is {words}")
    # what is written with few digits is not of length 1 to all of them
    return numbers if abs(size - 1.0) < 1e-12 else tuple(number / size for number in numbers)


def _order(value: Any) -> tuple[int, ...]:
    given = tuple(value) if isinstance(value, list | tuple) else ()
    whole = all(isinstance(each, int) and not isinstance(each, bool) for each in given)
    if not given or not whole or sorted(given) != list(range(1, len(given) + 1)):
        raise RecordingError(
            f"order is {shown(value)}; allowed is the tendons 1, 2, 3, … in the order of the wire"
        )
    return given


def _interval(value: Any, name: str, *, open_ended: bool) -> tuple[float | None, float | None]:
    words = "[start, end] in s, start before end" + (", either of them null" if open_ended else "")
    pair = list(value) if isinstance(value, list | tuple) else []
    ends = [None if end is None and open_ended else _fraction(end) for end in pair]
    wrong = [
        end is None and not (given is None and open_ended) for given, end in zip(pair, ends, strict=True)
    ]
    if len(ends) != 2 or any(wrong) or (None not in ends and not ends[0] < ends[1]):  # type: ignore[operator]
        raise RecordingError(f"{name} is {shown(value)}; allowed is {words}")
    return ends[0], ends[1]


def _markers(value: Any) -> tuple[MarkerSource, ...]:
    markers = tuple(value) if isinstance(value, list | tuple) else ()
    if not markers or any(not isinstance(marker, MarkerSource) for marker in markers):
        raise RecordingError(f"markers is {shown(value)}; allowed is a list of one marker or more")
    fractions_given = [marker.fraction for marker in markers]
    if any(b <= a for a, b in itertools.pairwise(fractions_given)):
        raise RecordingError(
            f"markers have the fractions {shown(fractions_given)}; allowed is each above the last"
        )
    names = [marker.name for marker in markers]
    if len(set(names)) < len(names):
        raise RecordingError(f"markers have the names {shown(names)}; allowed is each once")
    return markers
