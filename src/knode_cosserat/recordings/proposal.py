"""Proposal of a configuration for a recording without one: from names, types, titles and positions."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from knode_cosserat.recordings.config import (
    MAPPED,
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
from knode_cosserat.recordings.table import TIME, Table, columns_of, position_titles, stated_time_unit

#: names of a body at the clamped end, of times, and of numbers that drive the robot
_BASE = re.compile(r"base|clamp|root|ground|origin|mount|world", re.IGNORECASE)
_TIME = re.compile(
    r"%?(time|zeit|temps|tiempo)|t$|t ?[\[(/]|t_(s|sec|ms|us|ns)$|stamp|rosbagtimestamp|clock|sec",
    re.IGNORECASE,
)
_TENSION = re.compile(
    r"tension|tendon|force|load|cell|effort|pull|cable|wire|zug|kraft|^[tf]$", re.IGNORECASE
)
_COMMAND = re.compile(r"cmd|command|desired|target|ref|set|soll|goal", re.IGNORECASE)
_MOTOR = re.compile(r"motor|phi|encoder|angle|servo", re.IGNORECASE)
#: beginnings of titles of turns, speeds and forces along x, y, z
_NO_PLACE = re.compile(
    r"(q|quat|quaternion|rot|rotation|orientation|vel|speed|acc|(^|[_ .])[vrawf])[_ .]?$", re.I
)
#: spellings of the parts of an orientation, scalar first
_QUATERNIONS = (
    *(
        tuple(f"{stem}{part}" for part in "wxyz")
        for stem in ("q", "r", "o", "quat_", "orientation.", "orientation_")
    ),
    ("q0", "q1", "q2", "q3"),
)
#: rows at the start that a body's place is estimated from
_ROWS = 20


_Sources = tuple[TensionSource | None, CommandSource | None, MotorSource | None]


class _Body(NamedTuple):
    name: str
    topic: str
    #: (n, 3) positions in the recording's unit
    position: Float[np.ndarray, "n 3"]
    titles: tuple[str, ...] = ()


# bags


def useful_topics(bag: Bag) -> set[str]:
    """Return the topics whose messages are poses or numbers."""
    kinds = {*POSES, *NUMBERS, POSE_ARRAY, *TRANSFORMS}
    return {name for name, topic in bag.topics.items() if topic.type in kinds}


def config_of_bag(bag: Bag, path: str) -> tuple[RecordingConfig, tuple[str, ...]]:
    """Return a configuration of a bag's topics, and remarks. Raises `RecordingError` without poses."""
    names: dict[str, str] = {}
    for topic in bag.topics.values():
        if topic.type in POSES:
            words = [
                word for word in topic.name.split("/") if word and not re.fullmatch(r"pose|odom|tf", word)
            ]
            names[topic.name] = words[-1] if words else topic.name
        elif topic.type == POSE_ARRAY or (topic.type in TRANSFORMS and topic.name != STATIC):
            for part in _parts(bag, topic.name):
                names[f"{topic.name}[{part}]"] = part if topic.type in TRANSFORMS else f"body {part}"
    bodies: list[_Body] = []
    for name, word in names.items():
        stream = decoded(bag, MarkerSource(word, name, 1.0), "pose", path)
        if len(stream.values):
            is_new = word not in [body.name for body in bodies]
            bodies.append(_Body(word if is_new else name, name, stream.values[:, :3]))
    if not bodies:
        listed = ", ".join(
            f"{topic.name} ({topic.type.replace('/msg/', '/')})" for topic in bag.topics.values()
        )
        raise RecordingError(f"{path}: no topic has poses; the bag has {listed or 'no topics'}")
    found: dict[str, tuple[str, tuple[str, ...]]] = {}
    remarks: list[str] = []
    singles: dict[tuple[str, str], list[str]] = {}
    for topic in bag.topics.values():
        if topic.type not in NUMBERS or not topic.raw:
            continue
        messages = (message for _, message in topic.messages() if message is not None)
        first = next(messages, None)
        count = 0 if first is None else len(NUMBERS[topic.type](first))
        if count == 1 and (numbered := re.fullmatch(r"(.*?)(\d+)(\D*)", topic.name)):
            singles.setdefault((numbered[1], numbered[3]), []).append(numbered[2])
        elif count:
            order = tuple(range(1, count + 1))
            named = [list(getattr(first, "name", ()))]
            joints = joint_names(TensionSource(topic.name, order), named, path)[0]
            found.setdefault(_role(topic.name), (topic.name, tuple(joints) or ("",) * count))
            if joints:
                remarks.append(f"tendons 1 to {count} are taken to be the joints {', '.join(joints)}")
    for (before, after), numbers in singles.items():
        found.setdefault(_role(before + after), (f"{before}{{}}{after}", tuple(sorted(numbers, key=int))))
    sources: dict[str, dict[str, Any]] = {
        role: {
            "topic": name,
            "order": tuple(range(1, len(names) + 1)),
            "names": names if any(names) else None,
        }
        for role, (name, names) in found.items()
    }
    tension = TensionSource(**sources["tension"]) if "tension" in sources else None
    command = CommandSource(**sources["command"]) if "command" in sources else None
    return _config(bodies, (tension, command, None), None, None, remarks)


def _role(topic: str) -> str:
    return "command" if _COMMAND.search(topic) else "tension"


def _parts(bag: Bag, name: str) -> list[str]:
    """Return the parts of a topic's messages: numbers of poses, or frames."""
    topic, parts = bag.topics[name], dict[str, None]()
    for _, message in topic.messages():
        if message is None:
            continue
        if topic.type == POSE_ARRAY:
            parts |= dict.fromkeys(map(str, range(len(message.poses))))
        else:
            parts |= dict.fromkeys(each.child_frame_id.strip("/") for each in message.transforms)
    return list(parts)


# tables


def config_of_table(table: Table, path: str) -> tuple[RecordingConfig, tuple[str, ...]]:
    """Return a configuration of a table's columns, and remarks. Raises `RecordingError` without positions."""
    titles, remarks = list(map(str, table.numbers.columns)), list[str]()
    if table.bodies:
        bodies = []
        for name in table.bodies:
            places = [titles.index(title) for title in position_titles(name, "m")]
            bodies.append(_Body(name, name, columns_of(table.numbers, places, path)))
        taken = {title for title in titles if re.search(r"_(x|y|z) \[m\]$|_q[wxyz]$", title)}
        sources = _number_columns(
            [title for title in titles if title not in taken and title != TIME], remarks
        )
        mapped = ColumnMap.from_dict(sources) if sources else None
        return _config(bodies, _sources(sources), mapped, table.up, remarks)
    time = next((title for title in titles if _TIME.match(title)), None)
    rest = [title for title in titles if title != time]
    bodies = _bodies(table, rest, path)
    used = {title for body in bodies for title in body.titles}
    sources = _number_columns([title for title in rest if title not in used], remarks)
    rate = None
    if time is None:
        rate = TableSource(rate=100.0)
        remarks.append("no column looks like times: the rate of 100 Hz is a guess")
    elif stated_time_unit(time):
        remarks.append(f"times are in {stated_time_unit(time)} by their title")
    places_of = {body.topic: body.titles for body in bodies}
    mapped = ColumnMap.from_dict({"time": time, **sources, **places_of})
    is_mm = any("mm" in re.findall(r"[a-z]+", title.lower()) for title in used)
    return _config(bodies, _sources(sources), mapped, None, remarks, table=rate, is_mm=is_mm)


def _bodies(table: Table, titles: Sequence[str], path: str) -> list[_Body]:
    """Return the bodies whose coordinates have titles that differ in x, y and z only."""
    columns = list(map(str, table.numbers.columns))
    found: dict[str, _Body] = {}
    for title in titles:
        for match in re.finditer("x", title.lower()):
            variants = [title[: match.start()] + axis + title[match.end() :] for axis in "xyz"]
            variants = [next((each for each in titles if each.lower() == it.lower()), it) for it in variants]
            before = title[: match.start()]
            # the x of a quaternion, or of a speed, is not that of a position
            if not set(variants) <= set(titles) or _NO_PLACE.search(before):
                continue
            name = re.sub(r"\[.*?\]|\(.*?\)", "", title[: match.start()] + title[match.end() :])
            name = (
                re.sub(r"(^|[_ .-])(pos(ition)?|p|mm|m)(?=$|[_ .-])", "", name, flags=re.IGNORECASE).strip(
                    "_ .-"
                )
                or "tip"
            )
            if name in found:
                continue
            position = columns_of(table.numbers, [columns.index(each) for each in variants], path)
            found[name] = _Body(name, name, position, (*variants, *_quaternion(before, titles, len(found))))
            break
    if not found:
        raise RecordingError(
            f"{path}: the columns are {', '.join(columns)}; none look like a body's position x, y, z; "
            "no map can be proposed. Write `columns: {time: …, tensions: […], tip: [x, y, z]}` in a YAML file"
        )
    return list(found.values())


def _quaternion(before: str, titles: Sequence[str], number: int) -> tuple[str, ...]:
    """Return the titles of the orientation that belongs to a position, scalar first; empty without one."""
    lower = {title.lower(): title for title in titles}
    stem = re.sub(r"(p|pos|position|t)?[_ .-]?$", "", before, flags=re.IGNORECASE)
    for parts, joint in itertools.product(_QUATERNIONS, ("", "_", ".", " ", "-")):
        names = [f"{stem}{joint}{part}".lower() for part in parts]
        if all(name in lower for name in names) and (stem or number == 0):
            return tuple(lower[name] for name in names)
    return ()


def _number_columns(titles: Sequence[str], remarks: list[str]) -> dict[str, list[str]]:
    """Return the columns of tensions, commands and motors: those with names that differ in a number."""
    families: dict[str, list[tuple[int, str]]] = {}
    for title in titles:
        match = re.fullmatch(r"(\D*?)[_ .-]?(\d+)(\D.*)?", title)
        if match:
            families.setdefault(match[1], []).append((int(match[2]), title))
    found: dict[str, list[str]] = {}
    for stem, numbered in families.items():
        columns = [title for _, title in sorted(numbered)]
        if _COMMAND.search(stem):
            found.setdefault("commands", columns)
        elif _TENSION.search(stem):
            found.setdefault("tensions", columns)
        elif _MOTOR.search(stem) and "tensions" not in found:
            found.setdefault("motors", columns)
    if "motors" in found and ("tensions" in found or "commands" in found):
        del found["motors"]
    for name, columns in found.items():
        remarks.append(f"{name} are taken to be the columns {', '.join(columns)}, in this order")
    return found


def _sources(
    found: Mapping[str, Sequence[str]],
) -> _Sources:
    order = {name: tuple(range(1, len(columns) + 1)) for name, columns in found.items()}
    gram = any(re.search(r"\[(gf|g)\]|\((gf|g)\)|_gf?$", title) for title in found.get("tensions", ()))
    return (
        TensionSource(MAPPED["tensions"], order["tensions"], "gf" if gram else "N")
        if "tensions" in order
        else None,
        CommandSource(MAPPED["commands"], order["commands"]) if "commands" in order else None,
        MotorSource(MAPPED["motors"], order["motors"], "deg") if "motors" in order else None,
    )


# places on the rod


def _config(
    bodies: Sequence[_Body],
    sources: _Sources,
    columns: ColumnMap | None,
    up: str | None,
    remarks: list[str],
    *,
    table: TableSource | None = None,
    is_mm: bool = False,
) -> tuple[RecordingConfig, tuple[str, ...]]:
    """Return the configuration of bodies whose places are guessed from distances at the start."""
    where = {}
    for body in bodies:
        seen = body.position[np.isfinite(body.position).all(axis=1)][:_ROWS]
        if len(seen):
            where[body.topic] = np.median(seen, axis=0) * (1e-3 if is_mm else 1.0)
    bodies = [body for body in bodies if body.topic in where]
    if not bodies:
        raise RecordingError("no body is ever seen")
    upright = Rotation.from_rotvec(UP[up or "z"])
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
    tension, command, motors = sources
    kinds = "measured" if tension or motors else "commanded" if command else "none"
    if kinds == "none":
        remarks.append("no tensions were found: `tensions: none` makes a recording of poses only")
    config = RecordingConfig(
        markers=tuple(
            MarkerSource(body.name, body.topic, fraction)
            for body, fraction in zip(others, fractions, strict=True)
        ),
        tension=tension,
        motors=motors,
        command=command,
        base=BaseSource(base.topic) if base else None,
        table=table,
        columns=columns,
        tensions=kinds,  # type: ignore[arg-type]
        position_unit="mm" if is_mm else "m",
        up=up,
        rotation=(1.0, 0.0, 0.0, 0.0) if rotation is None else rotation,
    )
    return config, tuple(remarks)


def _rotation(axis: Float[np.ndarray, " 3"]) -> tuple[float, ...] | None:
    """Return the quaternion that turns the nearest coordinate axis of a rod to z; None if that is z."""
    k = int(np.argmax(np.abs(axis)))
    name = ("-" if axis[k] < 0.0 else "") + "xyz"[k]
    if name == "z":
        return None
    turn = Rotation.from_rotvec(UP[name]).as_quat(scalar_first=True)
    return tuple(round(float(part), 12) for part in turn)
