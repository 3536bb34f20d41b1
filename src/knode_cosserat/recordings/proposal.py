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
    COMMAND,
    PLACE,
    POSITION_UNITS,
    TIME_UNITS,
    UP,
    BaseSource,
    ColumnMap,
    ControlSource,
    FileSource,
    MarkerSource,
    RecordingConfig,
    TableSource,
)
from knode_cosserat.recordings.files import File
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.frame import steps_are_smooth
from knode_cosserat.recordings.messages import (
    JOINTS,
    NUMBERS,
    POSE_ARRAY,
    POSES,
    STATIC,
    TRANSFORMS,
    Bag,
    decoded,
    joint_names,
)
from knode_cosserat.recordings.quantities import (
    QUANTITIES,
    divided_title,
    guessed_unit,
    known_unit,
)
from knode_cosserat.recordings.streams import FAR, SLOW
from knode_cosserat.recordings.table import (
    LATEST,
    TIME,
    Table,
    columns_of,
    configured,
    position_titles,
    stated_time_unit,
)

#: names of a body at the clamped end, of a camera that sees a single body, and of times
_BASE = re.compile(r"base|clamp|root|ground|origin|mount|world", re.IGNORECASE)
_CAMERA = re.compile(r"(^|[_ .-])(cam|camera|kamera|caméra|mocap|vicon|optitrack|tracker)(?=$|[_ .-])", re.I)
_TIME = re.compile(
    r"%?(time|zeit|temps|tiempo|tempo|horodat)|t$|t ?[\[(/]|t_(s|sec|ms|us|ns)$|stamp|rosbagtimestamp|clock|"
    r"sec",
    re.IGNORECASE,
)
#: least part of the cells that are numbers in a column of numbers with errors
LEAST_NUMBERS = 0.5
#: names of numbers that were only commanded; and of those about motors' states, whose goals are no tensions
_COMMAND = re.compile(r"cmd|command|desired|target|ref|set|soll|goal|ctrl|consign", re.IGNORECASE)
_STATE = re.compile(r"current|position|velocity", re.IGNORECASE)
#: names of numbers that drive nothing
_RATE = re.compile(
    r"vel|speed|geschw|vitesse|temp|torque|moment|drehmoment|duty|pwm|error|fehler|roll|pitch|yaw", re.I
)
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
        return config_of_content(content)
    return configured(content.metadata, list(map(str, content.numbers.columns)))


# bags


def useful_topics(bag: Bag) -> set[str]:
    """Return the topics whose messages are poses or numbers."""
    kinds = {*POSES, *NUMBERS, POSE_ARRAY, *TRANSFORMS}
    return {name for name, topic in bag.topics.items() if topic.type in kinds}


class _Found(NamedTuple):
    """Content recognised in a file: bodies, settings of a configuration, and columns by quantity."""

    bodies: list[_ProposedBody]
    settings: dict[str, Any]
    columns: dict[str, Any]


def config_of_content(content: Bag | Table) -> RecordingConfig:
    """Return a configuration of topics or columns, with remarks. Raises `RecordingError` without poses."""
    remarks: list[str] = []
    found = _found(content, remarks)
    if not found.bodies:
        raise RecordingError(_nothing_seen(content))
    return _config(found.bodies, found.settings | _columns(found), remarks)


def config_of_files(files: Sequence[File]) -> RecordingConfig:
    """Return a configuration of several files, with remarks. Raises `RecordingError` without poses."""
    remarks: list[str] = []
    bodies, settings, columns, sources = list[_ProposedBody](), dict[str, Any](), dict[str, Any](), []
    for file in files:
        found = _found(file.content, remarks)
        timing: dict[str, Any] = {
            key: found.columns.pop(key) for key in ("time", "time_unit") if key in found.columns
        }
        if (table := found.settings.pop("table", None)) is not None:
            timing["rate"] = table.rate
        sources.append(FileSource(file.name, **timing))
        names = [body.name for body in bodies]
        for body in found.bodies:
            if body.name in names:
                body = body._replace(name=f"{file.name} {body.name}")
                if body.titles:
                    body = body._replace(topic=body.name)
            bodies.append(body)
        for quantity in [it for it in found.settings if it in (*QUANTITIES, COMMAND) and it in settings]:
            del found.settings[quantity]
            remarks.append(f"{quantity} of {file.name} is not used: another file has it")
        columns |= {name: titles for name, titles in found.columns.items() if name in found.settings}
        settings |= found.settings
    if not bodies:
        raise RecordingError("; ".join(f"{file.name}: {_nothing_seen(file.content)}" for file in files))
    found = _Found(bodies, settings, columns)
    return _config(bodies, settings | _columns(found) | {"files": tuple(sources)}, remarks)


def _found(content: Bag | Table, remarks: list[str]) -> _Found:
    return _found_in_bag(content, remarks) if isinstance(content, Bag) else _found_in_table(content, remarks)


def _columns(found: _Found) -> dict[str, Any]:
    """Return the setting of a map of columns; none for topics and for exports without others."""
    titles = {body.topic: body.titles for body in found.bodies if body.titles}
    mapped = found.columns | titles
    return {"columns": ColumnMap.from_dict(mapped)} if mapped else {}


def _nothing_seen(content: Bag | Table) -> str:
    if isinstance(content, Bag):
        topics = [f"{topic.name} ({topic.type.replace('/msg/', '/')})" for topic in content.topics.values()]
        return f"no topic has poses; the bag has {', '.join(topics) or 'no topics'}"
    return (
        f"the columns are {', '.join(content.names)}; none look like a body's position x, y, z; "
        "no map can be proposed. Write `columns: {time: …, tension: […], tip: [x, y, z]}` in a YAML file"
    )


def _found_in_bag(bag: Bag, remarks: list[str]) -> _Found:
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
    sources: dict[str, Any] = {}
    singles: dict[tuple[str, str], list[str]] = {}
    for topic in bag.topics.values():
        if topic.type not in NUMBERS:
            continue
        first = next((message for _, message in topic.messages() if message is not None), None)
        count = 0 if first is None else len(NUMBERS[topic.type](first))
        kind = _OF_TYPE.get(topic.type, "")
        if topic.type == JOINTS and first is not None:
            kind = "tension" if count else "angle"
            count = count or len(first.position)
        if count == 1 and (match := re.fullmatch(r"(.*?)(\d+)(\D*)", topic.name)):
            singles.setdefault((match[1], match[3]), []).append(match[2])
        elif count:
            order = tuple(range(1, count + 1))
            names_there = [list(getattr(first, "name", ()))]
            joints, _ = joint_names(ControlSource(topic.name, order), names_there, topic.name)
            _add_topic(sources, kind, topic.name, order, tuple(joints) or None)
            if joints:
                remarks.append(f"numbers 1 to {count} are taken to be the joints {', '.join(joints)}")
    for (before, after), numbers in singles.items():
        kind = _OF_TYPE.get(bag.topics[f"{before}{numbers[0]}{after}"].type, "")
        _add_topic(sources, kind, f"{before}{PLACE}{after}", (), tuple(sorted(numbers, key=int)))
    return _Found(bodies, sources, {})


#: quantities of message types
_OF_TYPE = {"sensor_msgs/msg/FluidPressure": "pressure", "sensor_msgs/msg/MagneticField": "field"}


def _add_topic(
    sources: dict[str, Any],
    kind: str,
    name: str,
    order: tuple[int, ...],
    names: tuple[str, ...] | None,
) -> None:
    """Add the first topic of commands, and the first of each quantity; unknown ones are tensions."""
    words = name.replace(PLACE, "").rpartition("/")[2]
    kind = kind or _recognised(words, "") or _recognised(name, "") or "tension"
    role = COMMAND if _COMMAND.search(name) else kind
    drive = QUANTITIES[kind].drive
    is_new = not any(QUANTITIES[other].drive == drive for other in sources if other != COMMAND and drive)
    if role == COMMAND or is_new:
        sources.setdefault(role, ControlSource(name, order, names=names))


# tables


def _found_in_table(table: Table, remarks: list[str]) -> _Found:
    """Return what is found in a table's columns."""
    titles = table.names
    if table.bodies:
        bodies = []
        for name in table.bodies:
            places = [titles.index(title) for title in position_titles(name, "m")]
            bodies.append(_ProposedBody(name, name, columns_of(table.numbers, places)))
        others = [title for title in titles if not re.search(r"_(x|y|z) \[m\]$|_q[wxyz]$", title)]
        mapped, sources = _controls(table, [title for title in others if title != TIME], remarks)
        return _Found(bodies, sources | {"up": table.up}, mapped)
    time = next((title for title in titles if _TIME.match(title.rpartition("/")[2])), None)
    others = [title for title in titles if title != time]
    bodies = _bodies(table, others)
    used = {title for body in bodies for title in body.titles}
    mapped, sources = _controls(table, [title for title in others if title not in used], remarks)
    settings: dict[str, Any] = {}
    timing: dict[str, Any] = {"time": time}
    if time is None:
        settings["table"] = TableSource(rate=100.0)
        remarks.append("no column looks like times: the rate of 100 Hz is a guess")
    else:
        timing |= _time_unit(table, time, remarks)
        if _is_static(table, time, timing, bodies, remarks):
            settings["static"] = True
    if bodies and not any(_length_unit(title) for body in bodies for title in body.titles[:3]):
        largest = max(float(np.nanmax(np.abs(body.position), initial=0.0)) for body in bodies)
        if largest > 20.0:
            settings["position_unit"] = "mm"
            remarks.append(f"positions state no unit: mm is a guess by their size (up to {largest:.4g})")
    if time is None:
        del timing["time"]
    return _Found(bodies, sources | settings, {**timing, **mapped})


def _length_unit(title: str) -> str:
    unit = known_unit(divided_title(title)[1])
    return unit if unit in POSITION_UNITS else ""


def _time_unit(table: Table, time: str, remarks: list[str]) -> dict[str, str]:
    """Return the unit of times, if it has to be stated, with a remark."""
    if stated := stated_time_unit(time):
        remarks.append(f"times are in {stated} by their title")
        return {}
    values = columns_of(table.numbers, [list(map(str, table.numbers.columns)).index(time)])[:, 0]
    known = values[np.isfinite(values)]
    step = float(np.median(np.diff(np.sort(known)))) if len(known) > 1 else 0.0
    largest = float(np.max(np.abs(known), initial=0.0))
    unit = next(
        (unit for unit, size in TIME_UNITS.items() if largest * size <= LATEST and step * size <= FAR), "s"
    )
    if unit == "s":
        return {}
    remarks.append(f"times state no unit: {unit} is a guess by their size (up to {largest:.4g})")
    return {"time_unit": unit}


def _is_static(
    table: Table, time: str, timing: dict[str, Any], bodies: Sequence[_ProposedBody], remarks: list[str]
) -> bool:
    """True if rows are so far apart in time and place that each is an equilibrium, with a remark."""
    titles = list(map(str, table.numbers.columns))
    seconds = columns_of(table.numbers, [titles.index(time)])[:, 0]
    seconds = seconds * TIME_UNITS[timing.get("time_unit") or stated_time_unit(time) or "s"]
    known = seconds[np.isfinite(seconds)]
    if len(known) < 3 or float(np.median(np.diff(known))) < 0.95 * SLOW:
        return False
    if any(steps_are_smooth(body.position) for body in bodies):
        return False
    remarks.append(
        f"rows are {np.median(np.diff(known)):.3g} s apart and do not follow each other smoothly: "
        "each is taken for an equilibrium (`static`)"
    )
    return True


def _bodies(table: Table, titles: Sequence[str]) -> list[_ProposedBody]:
    """Return the bodies whose coordinates have titles that differ in x, y and z, or 0, 1 and 2, only."""
    columns = list(map(str, table.numbers.columns))
    # columns in other units than metres are no positions
    titles = [title for title in titles if not divided_title(title)[1] or _length_unit(title)]
    spelling = {title.lower(): title for title in reversed(titles)}
    bodies: dict[str, _ProposedBody] = {}
    for title in titles:
        for match in re.finditer("x|(?<=pos[_ .[])0", title.lower()):
            before, after = title[: match.start()], title[match.end() :]
            axes = [before + axis + after for axis in ("xyz" if match[0] == "x" else "012")]
            axes = [spelling.get(axis.lower(), axis) for axis in axes]
            # the x of a quaternion, or of a speed, is not that of a position
            if not set(axes) <= set(titles) or _NO_PLACE.search(before) or _is_field(before, title):
                continue
            name = re.sub(r"\[.*?\]|\(.*?\)", "", before + after)
            name = re.sub(r"(^|[_ .-])(x?pos(ition)?|p|mm|cm|m)(?=$|[_ .-])", "", name, flags=re.IGNORECASE)
            name = _CAMERA.sub("", name)
            name = name.strip("_ .-") or "tip"
            if name not in bodies:
                position = columns_of(table.numbers, [columns.index(axis) for axis in axes])
                turned = _quaternion(before, titles, len(bodies))
                bodies[name] = _ProposedBody(name, name, position, (*axes, *turned))
                break
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


def _is_field(before: str, title: str) -> bool:
    """True if coordinates without a unit are those of a magnetic field, such as Bx."""
    last = re.split(r"[_ .-]", before.strip("_ .-"))[-1]
    return bool(QUANTITIES["field"].words.search(last)) and not _length_unit(title)


class _Family(NamedTuple):
    """Columns whose titles differ in a number, a letter or an axis, in this order, and their common text."""

    text: str
    #: spelling of the unit; empty if none is stated
    unit: str
    titles: tuple[str, ...]
    #: True if the titles differ in x, y and z
    is_of_axes: bool

    @property
    def name(self) -> str:
        """The name of the quantity; empty if it is not recognised."""
        return _recognised(self.text, self.unit)


def _families(titles: Sequence[str]) -> list[_Family]:
    """Return the families of columns, in the order of their first columns."""
    found: dict[tuple[str, str, bool], list[tuple[int, str]]] = {}
    for title in titles:
        text, unit = divided_title(title)
        place, stem, of_axes = 0, text, False
        if match := re.fullmatch(r"(\D*?)[_ .-]?(\d+)(\D.*)?", text):
            place, stem = int(match[2]), match[1] + (match[3] or "")
        elif match := re.fullmatch(r"(.+?)[_ .-]([A-Ha-h])|(.*[a-z])([A-H])", text):
            place, stem = ord((match[2] or match[4]).upper()), match[1] or match[3]
        elif match := re.fullmatch(r"(.+?)[_ .-]?([xyzXYZ])", text):
            place, stem, of_axes = ord(match[2].lower()), match[1], True
        found.setdefault((stem.strip("_ .-"), unit, of_axes), []).append((place, title))
    return [
        _Family(stem, unit, tuple(title for _, title in sorted(members)), of_axes)
        for (stem, unit, of_axes), members in found.items()
    ]


def _recognised(text: str, unit: str) -> str:
    """Return the name of the quantity of a text with a unit; empty if it is not recognised."""
    known = known_unit(unit)
    if (unit and not known) or _RATE.search(text):
        return ""
    alike = [it for it in QUANTITIES.values() if it.unit != "1" and (not known or known in it.units)]
    for words in ("words", "actuators"):
        # the longest word is the most special one: Drehwinkel is no Winkel, Vorschub no Hub
        matches = [(getattr(quantity, words).search(text), quantity.name) for quantity in alike]
        sizes = [(len(match[0]), name) for match, name in matches if match]
        if sizes:
            return max(sizes, key=lambda size: size[0])[1]
    # a length may be anything; a unit of anything else says what is measured
    return alike[0].name if known and known not in POSITION_UNITS else ""


def _names(family: _Family) -> bool:
    """True if the text of a family has a word for its quantity."""
    found = QUANTITIES.get(family.name)
    return found is not None and bool(found.words.search(family.text) or found.actuators.search(family.text))


def _controls(
    table: Table, titles: Sequence[str], remarks: list[str]
) -> tuple[dict[str, list[str]], dict[str, Any]]:
    """Return the columns that drive the robot by quantity, and of commands, and their sources."""
    once = [title for title in titles if titles.count(title) == 1]
    families = _families([title for title in once if _numbers_of(table, title) is not None])
    chosen: dict[str, _Family] = {}
    for family in families:
        # a single column is named in words: its unit is not enough
        if len(family.titles) == 1 and not (re.search(r"\d", family.titles[0]) or _names(family)):
            continue
        if _COMMAND.search(family.text):
            # goals of motors are no tensions
            if not _STATE.search(family.text):
                chosen.setdefault(COMMAND, family)
        elif (name := family.name) and (name == "field" or not family.is_of_axes):
            chosen.setdefault(name, family)
    # one quantity of a drive is enough
    for name, quantity in QUANTITIES.items():
        others = [it for it in list(chosen) if it != COMMAND and QUANTITIES[it].drive == quantity.drive != ""]
        for other in others if name in chosen else ():
            if other != name:
                first = chosen.pop(other).titles[0]
                what = f"{QUANTITIES[other].plural} ({first}, …)"
                remarks.append(f"{what} are not used beside {quantity.plural}")
    sources = {name: _source(table, name, family, remarks) for name, family in chosen.items()}
    return {name: list(family.titles) for name, family in chosen.items()}, sources


def _numbers_of(table: Table, title: str) -> Any:
    """Return a column's numbers (rows,), NaN for single cells that are none; None for a column of text."""
    import pandas as pd  # type: ignore[import-untyped]

    numbers = pd.to_numeric(table.numbers[title], errors="coerce").to_numpy(dtype=float, na_value=np.nan)
    is_text = table.numbers[title].dtype.kind not in "fiub"
    return None if is_text and np.mean(np.isfinite(numbers)) < LEAST_NUMBERS else numbers


def _source(table: Table, name: str, family: _Family, remarks: list[str]) -> ControlSource:
    """Return the source of a family's columns, with remarks on its unit and gain."""
    kind = QUANTITIES[name if name != COMMAND else family.name or "tension"]
    plural = "commands" if name == COMMAND else kind.plural
    listed = ", ".join(family.titles)
    remarks.append(f"{plural} are taken to be the columns {listed}, in this order")
    values = np.stack([_numbers_of(table, title) for title in family.titles], axis=1)
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    unit, gain = known_unit(family.unit), None
    if kind.name == "angle" and not unit and np.all(np.nan_to_num(values) % 1.0 == 0.0) and largest > 360.0:
        unit, gain = "deg", 360.0 / 4096.0
        remarks.append("positions of motors are taken to be ticks, 4096 in a turn (`gain`, in degrees)")
    elif kind.pulls and largest > 0.0 and np.all(np.nan_to_num(values) <= 0.0):
        gain = -1.0
        remarks.append(f"{plural} are never positive: `gain` turns their sign")
    elif kind.name == "current":
        gain = 1.0
        remarks.append("`gain` of the currents has to state the tension (N) of 1 A")
    if not unit:
        unit = guessed_unit(kind, largest)
        if unit != kind.unit or not kind.pulls:
            remarks.append(f"{plural} state no unit: {unit} is a guess by their size (up to {largest:.4g})")
    return ControlSource(name, tuple(range(1, len(family.titles) + 1)), unit, gain=gain)


# places on the rod


def _config(bodies: Sequence[_ProposedBody], settings: dict[str, Any], remarks: list[str]) -> RecordingConfig:
    """Return the configuration of bodies whose places are guessed from distances at the start.

    `settings` are those that are known: sources, columns, the unit of positions and the axis that points up.
    """
    where = {}
    for body in bodies:
        seen = body.position[np.isfinite(body.position).all(axis=1)][:_ROWS]
        if len(seen):
            where[body.topic] = np.median(seen, axis=0) * _factor(body, settings)
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
            "the rod is taken to point from the base to the last body: `frame_rotation` turns this axis to z"
        )
    kinds = "commanded" if COMMAND in settings else "none"
    if any(name in settings for name in QUANTITIES):
        kinds = "measured"
    if kinds == "none":
        remarks.append(
            "nothing was found that drives the robot: `controls: none` makes a recording of poses only"
        )
    return RecordingConfig(
        markers=tuple(
            MarkerSource(body.name, body.topic, fraction)
            for body, fraction in zip(others, fractions, strict=True)
        ),
        base=BaseSource(base.topic) if base else None,
        controls=kinds,  # type: ignore[arg-type]
        frame_rotation=(1.0, 0.0, 0.0, 0.0) if rotation is None else rotation,
        remarks=tuple(remarks),
        **settings,
    )


def _factor(body: _ProposedBody, settings: dict[str, Any]) -> Any:
    """Return metres over the units of a body's coordinates."""
    if (unit := settings.get("position_unit")) is not None:
        return POSITION_UNITS[unit]
    return np.array([POSITION_UNITS[_length_unit(title) or "m"] for title in body.titles[:3]] or 1.0)


def _rotation(axis: Float[np.ndarray, " 3"]) -> tuple[float, ...] | None:
    """Return the quaternion that turns the nearest coordinate axis of a rod to z; None if that is z."""
    k = int(np.argmax(np.abs(axis)))
    name = ("-" if axis[k] < 0.0 else "") + "xyz"[k]
    if name == "z":
        return None
    turn = Rotation.from_rotvec(UP[name]).as_quat(scalar_first=True)
    return tuple(round(float(part), 12) for part in turn)
