"""Proposal of a configuration for a recording without one: from names, types, titles and positions."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from knode_cosserat.recordings.config import (
    MAPPED,
    PLACE,
    POSITION_UNITS,
    UP,
    BaseSource,
    ColumnMap,
    CommandSource,
    MarkerSource,
    MotorSource,
    RecordingConfig,
    TableSource,
    TensionSource,
)
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.messages import (
    NUMBERS,
    POSE_ARRAY,
    POSES,
    STATIC,
    TRANSFORMS,
    Bag,
    decoded,
    joint_names,
)
from knode_cosserat.recordings.table import (
    TIME,
    Table,
    columns_of,
    configured,
    position_titles,
    stated_time_unit,
)

#: names of a body at the clamped end, of times, and of numbers that drive the robot
_BASE = re.compile(r"base|clamp|root|ground|origin|mount|world", re.IGNORECASE)
_TIME = re.compile(
    r"%?(time|zeit|temps|tiempo)|t$|t ?[\[(/]|t_(s|sec|ms|us|ns)$|stamp|rosbagtimestamp|clock|sec",
    re.IGNORECASE,
)
_TENSION = re.compile(
    r"tension|tendon|force|load|cell|effort|pull|cable|wire|current|zug|kraft|^[tfi]$", re.IGNORECASE
)
_COMMAND = re.compile(r"cmd|command|desired|target|ref|set|soll|goal|ctrl", re.IGNORECASE)
_MOTOR = re.compile(r"motor|phi|encoder|angle|servo|present.?position", re.IGNORECASE)
#: names of numbers of motors that are no tensions, or not all of them
_CURRENT, _STATE = (re.compile(words, re.IGNORECASE) for words in ("current", "current|position|velocity"))
#: beginnings of titles of turns, speeds and forces along x, y, z
_NO_PLACE = re.compile(
    r"(q|quat|quaternion|rot|rotation|orientation|vel|speed|acc|(^|[_ .])[vrawfm])[_ .]?$", re.I
)
#: spellings of the parts of an orientation, scalar first
_QUATERNIONS = (
    *(
        tuple(f"{stem}{part}" for part in "wxyz")
        for stem in ("q", "r", "o", "quat_", "orientation.", "orientation_")
    ),
    ("q0", "q1", "q2", "q3"),
    *(tuple(f"quat{open}{k}{close}" for k in range(4)) for open, close in (("_", ""), ("[", "]"), ("", ""))),
)
#: rows at the start that a body's place is estimated from
_ROWS = 20


class _ProposedBody(NamedTuple):
    name: str
    topic: str
    #: (n, 3) positions in the recording's unit
    position: Float[np.ndarray, "n 3"]
    titles: tuple[str, ...] = ()


def default_config(content: Bag | Table) -> RecordingConfig:
    """Return the configuration of a recording that is read without one.

    Raises:
        RecordingError: the content has another form.
    """
    if isinstance(content, Bag):
        return RecordingConfig.paper_robot()
    if content.bodies:
        return config_of_table(content)
    return configured(content.metadata, list(map(str, content.numbers.columns)))


# bags


def useful_topics(bag: Bag) -> set[str]:
    """Return the topics whose messages are poses or numbers."""
    kinds = {*POSES, *NUMBERS, POSE_ARRAY, *TRANSFORMS}
    return {name for name, topic in bag.topics.items() if topic.type in kinds}


def config_of_bag(bag: Bag) -> RecordingConfig:
    """Return a configuration of a bag's topics, with remarks. Raises `RecordingError` without poses."""
    names: dict[str, str] = {}
    for topic in bag.topics.values():
        messages = (message for _, message in topic.messages() if message is not None)
        if topic.type in POSES:
            words = [part for part in topic.name.split("/") if part not in ("", "pose", "odom", "tf")]
            names[topic.name] = words[-1] if words else topic.name
        elif topic.type == POSE_ARRAY:
            most = max((len(message.poses) for message in messages), default=0)
            names |= {f"{topic.name}[{k}]": f"body {k}" for k in range(most)}
        elif topic.type in TRANSFORMS and topic.name != STATIC:
            frames = [part.child_frame_id.strip("/") for message in messages for part in message.transforms]
            names |= {f"{topic.name}[{frame}]": frame for frame in frames}
    bodies: list[_ProposedBody] = []
    for name, word in names.items():
        stream = decoded(bag, MarkerSource(word, name, 1.0), "pose")
        if len(stream.values):
            is_new = word not in [body.name for body in bodies]
            bodies.append(_ProposedBody(word if is_new else name, name, stream.values[:, :3]))
    if not bodies:
        topics = [f"{topic.name} ({topic.type.replace('/msg/', '/')})" for topic in bag.topics.values()]
        raise RecordingError(f"no topic has poses; the bag has {', '.join(topics) or 'no topics'}")
    remarks: list[str] = []
    sources: dict[str, Any] = {}
    singles: dict[tuple[str, str], list[str]] = {}
    for topic in bag.topics.values():
        if topic.type not in NUMBERS:
            continue
        first = next((message for _, message in topic.messages() if message is not None), None)
        count = 0 if first is None else len(NUMBERS[topic.type](first))
        if count == 1 and (match := re.fullmatch(r"(.*?)(\d+)(\D*)", topic.name)):
            singles.setdefault((match[1], match[3]), []).append(match[2])
        elif count:
            order = tuple(range(1, count + 1))
            names_there = [list(getattr(first, "name", ()))]
            joints, _ = joint_names(TensionSource(topic.name, order), names_there, topic.name)
            _add_topic(sources, topic.name, order, tuple(joints) or None)
            if joints:
                remarks.append(f"tendons 1 to {count} are taken to be the joints {', '.join(joints)}")
    for (before, after), numbers in singles.items():
        _add_topic(sources, f"{before}{PLACE}{after}", (), tuple(sorted(numbers, key=int)))
    return _config(bodies, sources, remarks)


def _add_topic(
    sources: dict[str, Any], topic: str, order: tuple[int, ...], names: tuple[str, ...] | None
) -> None:
    """Add the first topic of commands, and the first of tensions."""
    kind, role = (CommandSource, "command") if _COMMAND.search(topic) else (TensionSource, "tension")
    sources.setdefault(role, kind(topic, order, names=names))


# tables


def config_of_table(table: Table) -> RecordingConfig:
    """Return a configuration of a table's columns, with remarks. Raises `RecordingError` without poses."""
    titles, remarks = list(map(str, table.numbers.columns)), list[str]()
    if table.bodies:
        bodies = []
        for name in table.bodies:
            places = [titles.index(title) for title in position_titles(name, "m")]
            bodies.append(_ProposedBody(name, name, columns_of(table.numbers, places)))
        others = [title for title in titles if not re.search(r"_(x|y|z) \[m\]$|_q[wxyz]$", title)]
        mapped, sources = _number_columns(table, [title for title in others if title != TIME], remarks)
        columns = ColumnMap.from_dict(mapped) if mapped else None
        return _config(bodies, sources | {"columns": columns, "up": table.up}, remarks)
    time = next((title for title in titles if _TIME.match(title)), None)
    others = [title for title in titles if title != time]
    bodies = _bodies(table, others)
    used = {title for body in bodies for title in body.titles}
    mapped, sources = _number_columns(table, [title for title in others if title not in used], remarks)
    if time is None:
        sources["table"] = TableSource(rate=100.0)
        remarks.append("no column looks like times: the rate of 100 Hz is a guess")
    elif stated_time_unit(time):
        remarks.append(f"times are in {stated_time_unit(time)} by their title")
    columns = ColumnMap.from_dict({"time": time, **mapped, **{body.topic: body.titles for body in bodies}})
    is_mm = any("mm" in re.findall(r"[a-z]+", title.lower()) for title in used)
    settings = {"columns": columns, "position_unit": "mm" if is_mm else "m"}
    return _config(bodies, sources | settings, remarks)


def _bodies(table: Table, titles: Sequence[str]) -> list[_ProposedBody]:
    """Return the bodies whose coordinates have titles that differ in x, y and z, or 0, 1 and 2, only."""
    columns = list(map(str, table.numbers.columns))
    spelling = {title.lower(): title for title in reversed(titles)}
    bodies: dict[str, _ProposedBody] = {}
    for title in titles:
        for match in re.finditer("x|(?<=pos[_ .[])0", title.lower()):
            before, after = title[: match.start()], title[match.end() :]
            axes = [before + axis + after for axis in ("xyz" if match[0] == "x" else "012")]
            axes = [spelling.get(axis.lower(), axis) for axis in axes]
            # the x of a quaternion, or of a speed, is not that of a position
            if not set(axes) <= set(titles) or _NO_PLACE.search(before):
                continue
            name = re.sub(r"\[.*?\]|\(.*?\)", "", before + after)
            name = re.sub(r"(^|[_ .-])(x?pos(ition)?|p|mm|m)(?=$|[_ .-])", "", name, flags=re.IGNORECASE)
            name = name.strip("_ .-") or "tip"
            if name not in bodies:
                position = columns_of(table.numbers, [columns.index(axis) for axis in axes])
                turned = _quaternion(before, titles, len(bodies))
                bodies[name] = _ProposedBody(name, name, position, (*axes, *turned))
                break
    if not bodies:
        raise RecordingError(
            f"the columns are {', '.join(columns)}; none look like a body's position x, y, z; "
            "no map can be proposed. Write `columns: {time: …, tensions: […], tip: [x, y, z]}` in a YAML file"
        )
    return list(bodies.values())


def _quaternion(before: str, titles: Sequence[str], number: int) -> tuple[str, ...]:
    """Return the titles of the orientation that belongs to a position, scalar first; empty without one."""
    lower = {title.lower(): title for title in titles}
    stem = re.sub(r"(p|x?pos|position|t)?[_ .[-]?$", "", before, flags=re.IGNORECASE)
    for parts, joint in itertools.product(_QUATERNIONS, ("", "_", ".", " ", "-")):
        names = [f"{stem}{joint}{part}".lower() for part in parts]
        if all(name in lower for name in names) and (stem or number == 0):
            return tuple(lower[name] for name in names)
    return ()


def _number_columns(
    table: Table, titles: Sequence[str], remarks: list[str]
) -> tuple[dict[str, list[str]], dict[str, Any]]:
    """Return columns whose names differ in a number, of tensions, commands and motors, and their sources."""
    families: dict[str, list[tuple[int, str]]] = {}
    for title in titles:
        if match := re.fullmatch(r"(\D*?)[_ .-]?(\d+)(\D.*)?", title):
            families.setdefault(match[1] + (match[3] or ""), []).append((int(match[2]), title))
    kinds = {"commands": _COMMAND, "tensions": _TENSION, "motors": _MOTOR}
    mapped: dict[str, list[str]] = {}
    for stem, numbered in families.items():
        kind = next((kind for kind, pattern in kinds.items() if pattern.search(stem)), None)
        # goals of motors are no tensions
        if kind and not (kind == "commands" and _STATE.search(stem)):
            mapped.setdefault(kind, [title for _, title in sorted(numbered)])
    is_current = _CURRENT.search(mapped.get("tensions", [""])[0])
    if is_current and "motors" in mapped:
        remarks.append(f"currents ({mapped.pop('tensions')[0]}, …) are not used beside positions of motors")
    if len(mapped) > 1:
        mapped.pop("motors", None)
    sources: dict[str, Any] = {}
    for kind, columns in mapped.items():
        remarks.append(f"{kind} are taken to be the columns {', '.join(columns)}, in this order")
        order = tuple(range(1, len(columns) + 1))
        values = table.numbers[columns].to_numpy(dtype=float)
        gain = None
        whole = np.all(np.nan_to_num(values) % 1.0 == 0.0)
        if kind == "motors" and whole and np.nanmax(np.abs(values)) > 360.0:
            gain = 360.0 / 4096.0
            remarks.append("positions of motors are taken to be ticks, 4096 in a turn (`gain`, in degrees)")
        elif kind != "motors" and np.all(np.nan_to_num(values) <= 0.0):
            gain = -1.0
            remarks.append(f"{kind} are never positive: `gain` turns their sign")
        elif kind == "tensions" and is_current:
            gain = 1.0
            remarks.append("tensions are currents: `gain` has to state the tension (N) of one unit")
        if kind == "tensions":
            gram = any(re.search(r"\[(gf|g)\]|\((gf|g)\)|_gf?$", title) for title in columns)
            sources["tension"] = TensionSource(MAPPED[kind], order, "gf" if gram else "N", gain=gain)
        elif kind == "commands":
            sources["command"] = CommandSource(MAPPED[kind], order, gain=gain)
        else:
            sources["motors"] = MotorSource(MAPPED[kind], order, "deg", gain=gain)
    return mapped, sources


# places on the rod


def _config(bodies: Sequence[_ProposedBody], settings: dict[str, Any], remarks: list[str]) -> RecordingConfig:
    """Return the configuration of bodies whose places are guessed from distances at the start.

    `settings` are those that are known: sources, columns, the unit of positions and the axis that points up.
    """
    where = {}
    for body in bodies:
        seen = body.position[np.isfinite(body.position).all(axis=1)][:_ROWS]
        if len(seen):
            where[body.topic] = np.median(seen, axis=0) * POSITION_UNITS[settings.get("position_unit", "m")]
    bodies = [body for body in bodies if body.topic in where]
    if not bodies:
        raise RecordingError("no body is ever seen")
    upright = Rotation.from_rotvec(UP[settings.get("up") or "z"])
    where = {topic: upright.apply(place) for topic, place in where.items()}
    base = next((body for body in bodies if _BASE.search(body.name)), None) if len(bodies) > 1 else None
    others = [body for body in bodies if body is not base]
    origin = where[base.topic] if base else np.zeros(3)
    apart = {body.topic: float(np.linalg.norm(where[body.topic] - origin)) for body in others}
    longest = max(apart.values()) or 1.0
    others.sort(key=lambda body: apart[body.topic])
    fractions = [round(apart[body.topic] / longest, 3) for body in others]
    if any(b - a < 0.005 for a, b in itertools.pairwise(fractions)):
        fractions = [round((k + 1) / len(others), 3) for k in range(len(others))]
    if len(others) > 1:
        how = f"distances from {base.name}" if base else "distances from the origin"
        remarks.append(f"places on the rod (fractions) are guessed from {how} at the start: measure them")
    if base is None:
        remarks.append("no body is called base: `origin` has to state the position of the clamped end (m)")
    rotation = _rotation(where[others[-1].topic] - origin) if base else None
    if rotation is not None:
        remarks.append(
            "the rod is taken to point from the base to the last body: `rotation` turns this axis to z"
        )
    kinds = "commanded" if "command" in settings else "none"
    if "tension" in settings or "motors" in settings:
        kinds = "measured"
    if kinds == "none":
        remarks.append("no tensions were found: `tensions: none` makes a recording of poses only")
    return RecordingConfig(
        markers=tuple(
            MarkerSource(body.name, body.topic, fraction)
            for body, fraction in zip(others, fractions, strict=True)
        ),
        base=BaseSource(base.topic) if base else None,
        tensions=kinds,  # type: ignore[arg-type]
        rotation=(1.0, 0.0, 0.0, 0.0) if rotation is None else rotation,
        remarks=tuple(remarks),
        **settings,
    )


def _rotation(axis: Float[np.ndarray, " 3"]) -> tuple[float, ...] | None:
    """Return the quaternion that turns the nearest coordinate axis of a rod to z; None if that is z."""
    k = int(np.argmax(np.abs(axis)))
    name = ("-" if axis[k] < 0.0 else "") + "xyz"[k]
    if name == "z":
        return None
    turn = Rotation.from_rotvec(UP[name]).as_quat(scalar_first=True)
    return tuple(round(float(part), 12) for part in turn)
