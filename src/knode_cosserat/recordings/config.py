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
import itertools
import math
from pathlib import Path
from typing import Any, Literal, Self

from knode_cosserat._files.writing import replacing
from knode_cosserat._files.yaml_text import YAMLTextError, did_you_mean, flow, mapping_of, read_yaml, shown
from knode_cosserat.recordings.config_values import (
    Vector,
    checked_choice,
    checked_interval,
    checked_number,
    checked_numbers,
    checked_quaternion,
)  # fmt: skip
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.sources import (
    MAPPED,
    POSITION_UNITS,
    BaseSource,
    ColumnMap,
    CommandSource,
    MarkerSource,
    MotorSource,
    TableSource,
    TensionSource,
    set_field,
)

FORMAT = 1
#: axes of motion capture that point up, with the rotation vector (rad) that turns them to z
UP: dict[str, Vector] = {
    "z": (0.0, 0.0, 0.0),
    "y": (math.pi / 2, 0.0, 0.0),
    "x": (0.0, -math.pi / 2, 0.0),
    "-z": (math.pi, 0.0, 0.0),
    "-y": (-math.pi / 2, 0.0, 0.0),
    "-x": (0.0, math.pi / 2, 0.0),
}


@dataclasses.dataclass(frozen=True)
class RecordingConfig:
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

    def __post_init__(self) -> None:
        set_field(self, "markers", _markers(self.markers))
        for name, kind in _PARTS.items():
            value = getattr(self, name)
            if value is not None and type(value) is not kind:
                raise RecordingError(f"{name} is {shown(value)}; allowed is a {kind.__name__}, or nothing")
        checked_choice(self.tensions, "tensions", ("measured", "commanded", "none"))
        checked_choice(self.position_unit, "position_unit", POSITION_UNITS)
        if self.up is not None:
            checked_choice(self.up, "up", UP)
        checked_choice(self.clock, "clock", ("header", "received"))
        checked_choice(self.repeats, "repeats", ("keep", "drop"))
        if not isinstance(self.static, bool):
            raise RecordingError(f"static is {shown(self.static)}; allowed is true or false")
        set_field(self, "origin", checked_numbers(self.origin, "origin", 3, "three numbers (m)"))
        set_field(self, "rotation", checked_quaternion(self.rotation, "rotation"))
        set_field(self, "longest_gap", checked_number(self.longest_gap, "longest_gap", 0.0, 60.0, "s"))
        if self.rest is not None:
            set_field(self, "rest", checked_interval(self.rest, "rest", open_ended=False))
        set_field(self, "trim", checked_interval(self.trim, "trim", open_ended=True))
        if self.simulated is not None and not isinstance(self.simulated, bool):
            raise RecordingError(f"simulated is {shown(self.simulated)}; allowed is true or false")
        if not isinstance(self.description, str):
            raise RecordingError(f"description is {shown(self.description)}; allowed is text")
        self._check_together()

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
            given = checked_numbers(self.initial_tension, "initial_tension", self.tendons, words)
            set_field(self, "initial_tension", given)
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

    @classmethod
    def asl_trunk(cls) -> Self:
        """Return the configuration of the ASL trunk (Stanford): six motor angles (deg), three disks, 100 Hz.

        Its frame has gravity along -y and the clamped end near (0.1, 0, 0.1) m. The robot's z axis points
        down. The disks' orientations, present in
        some files, are unreliable (axes flip) and are not read.
        """
        return cls(
            markers=tuple(
                MarkerSource(f"disk {k + 1}", f"{k + 1}", fraction)
                for k, fraction in enumerate((0.338, 0.636, 1.0))
            ),
            motors=MotorSource("phi", (1, 2, 3, 4, 5, 6), "deg"),
            table=TableSource(rate=100.0, position=("x{}", "y{}", "z{}"), motor="phi{}"),
            origin=(0.1, 0.1, 0.0),
            rotation=(math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0),
            repeats="drop",
            simulated=False,
            description="ASL trunk of Stanford, StanfordASL/trunk-stack, MIT",
        )

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
            raise RecordingError(f"format is {shown(number)}; allowed is {FORMAT}")
        if values.get("columns") is not None:
            values = _with_mapped_sources(values)
        for name, kind in _PARTS.items():
            if values.get(name) is not None and not isinstance(values[name], kind):
                values[name] = _part(kind, values[name], name)
        if isinstance(values.get("markers"), list):
            values["markers"] = tuple(
                _part(MarkerSource, _with_topic(marker), f"markers, number {k + 1}")
                for k, marker in enumerate(values["markers"])
            )
        return _made(cls, values)


_PARTS: dict[str, type] = {
    "tension": TensionSource, "motors": MotorSource, "command": CommandSource, "base": BaseSource,
    "table": TableSource, "columns": ColumnMap,
}  # fmt: skip


# mappings


def _part(kind: type, values: Any, where: str) -> Any:
    if not isinstance(values, dict):
        names = ", ".join(field.name for field in dataclasses.fields(kind))
        raise RecordingError(f"{where} is {shown(values)}; allowed is a mapping with {names}")
    try:
        return _made(kind, values)
    except RecordingError as error:
        raise RecordingError(f"{where}: {error}") from None


def _with_topic(marker: Any) -> Any:
    """Return a marker's settings; without a topic it is called like the marker."""
    if isinstance(marker, dict) and "topic" not in marker and "name" in marker:
        return {**marker, "topic": marker["name"]}
    return marker


def _with_mapped_sources(values: dict[Any, Any]) -> dict[Any, Any]:
    """Return settings with the sources that follow from their map of columns. Raises `RecordingError`."""
    if not isinstance(values["columns"], dict):
        raise RecordingError(
            f"columns is {shown(values['columns'])}; allowed is a mapping with time, tensions and the names "
            "of bodies"
        )
    try:
        columns = ColumnMap.from_dict(values["columns"])
    except RecordingError as error:
        raise RecordingError(f"columns: {error}") from None
    values = {**values, "columns": columns}
    for name, part in (("tensions", "tension"), ("commands", "command"), ("motors", "motors")):
        titles, stated = getattr(columns, name), values.get(part) or {}
        if titles is not None and isinstance(stated, dict):
            default = {"topic": MAPPED[name], "order": list(range(1, len(titles) + 1))}
            values[part] = default | stated
    if columns.commands and not columns.tensions and not columns.motors:
        values.setdefault("tensions", "commanded")
    if not any(values.get(part) for part in ("tension", "command", "motors")):
        values.setdefault("tensions", "none")
    base = values.get("base")
    if isinstance(base, dict):
        values["base"] = {"topic": "base"} | base
    elif base is None and "base" in dict(columns.bodies):
        values["base"] = {"topic": "base"}
    bodies = [name for name, _ in columns.bodies if name != "base"]
    if not values.get("markers") and len(bodies) == 1:
        values["markers"] = [{"name": bodies[0], "fraction": 1.0}]
    elif not values.get("markers"):
        raise RecordingError(
            f"markers is missing; required with the columns of {len(bodies)} bodies: "
            "markers: [{name: …, fraction: …}, …], from base to tip"
        )
    return values


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
    if isinstance(value, ColumnMap):
        return value.to_dict()
    if dataclasses.is_dataclass(value):
        named = {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
        if not isinstance(value, RecordingConfig):
            named = {name: part for name, part in named.items() if part is not None}
        return named
    return [_plain(part) for part in value] if isinstance(value, tuple) else value


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
