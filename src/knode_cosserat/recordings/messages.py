"""Messages of ROS 1 and 2, decoded to numbers and made from numbers: poses, controls and commands.

Messages are decoded and encoded by rosbags with its own definitions. Definitions in a bag are not used,
because rosbags turns definitions into Python code.

A topic may name a part of its messages: `/poses[2]` is the third pose of a PoseArray, `/tf[tip]` the frame
`tip` of transforms. In a topic of controls, `{}` stands for their names or numbers, of which each has its own
topic.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from knode_cosserat._files.limits import MORE
from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat.recordings.config import PLACE, ControlSource, RecordingConfig
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.streams import OutgoingStream, Stream
from knode_cosserat.rods.layout import MOVING

Role = Literal["pose", "sensor", "control", "command"]
#: stamp and recording time (ns), and the numbers
_Row = tuple[int, int, Any]


@dataclasses.dataclass
class Topic:
    """Raw messages of one topic.

    `type` is as ROS 2 writes it: geometry_msgs/msg/PoseStamped. `ros` is the version (1 or 2) of the
    serialisation, `digest` the hash of the type's definition (ROS 1; empty if unknown), and `received` has
    the recording time of each message (ns).
    """

    name: str
    type: str
    ros: int
    digest: str = ""
    received: list[int] = dataclasses.field(default_factory=list)
    raw: list[bytes] = dataclasses.field(default_factory=list)
    _decoded: list[Any] | None = None

    def messages(self) -> Iterator[tuple[int, Any]]:
        """Yield the recording time (ns) and the message, None for bytes that cannot be decoded."""
        # messages about several bodies are decoded once and read for each of them
        if self.type == POSE_ARRAY or self.type in TRANSFORMS:
            if self._decoded is None:
                self._decoded = list(self._decode())
            return iter(zip(self.received, self._decoded, strict=True))
        return zip(self.received, self._decode(), strict=True)

    def _decode(self) -> Iterator[Any]:
        store = typestore(self.ros)
        deserialize = store.deserialize_ros1 if self.ros == 1 else store.deserialize_cdr
        for raw in self.raw:
            # rosbags raises various errors on damaged bytes
            try:
                message = deserialize(raw, self.type)
            except Exception:
                message = None
            yield message


@dataclasses.dataclass
class Bag:
    """Raw messages of a bag by topic.

    `ros` is the version (1 or 2) of the serialisation, `lost` the number of bytes that could not be read, and
    `damage` describes the damage to the file (empty: none). `is_limited` is true if its chunks expand beyond
    a limit, so that a part was not read.
    """

    ros: int
    topics: dict[str, Topic] = dataclasses.field(default_factory=dict)
    lost: int = 0
    damage: str = ""
    is_limited: bool = False
    findings: tuple[Finding, ...] = ()
    source: str = ""

    def topic(self, name: str, kind: str, digest: str = "") -> Topic | None:
        """Return the topic of that name, created if new; None if it exists with another type."""
        kind = kind if kind.count("/") != 1 else kind.replace("/", "/msg/")
        topic = self.topics.setdefault(name, Topic(name, kind, self.ros, digest))
        return topic if topic.type == kind else None

    def completed(self, config: RecordingConfig) -> RecordingConfig:
        """Return a configuration that has also what the bag states: that the robot was a simulation."""
        used = [self.topics.get(topics_of(source)[0]) for source in roles_of(config)]
        # messages contain text verbatim
        first = (bytes(message) for topic in used if topic is not None for message in topic.raw[:100])
        is_simulated = any(SIMULATED.encode() in message for message in first)
        return config.replace(simulated=True) if config.simulated is None and is_simulated else config

    @property
    def names(self) -> list[str]:
        """Names of the topics."""
        return sorted(self.topics)

    def topics_there(self, config: RecordingConfig) -> list[str]:
        """Return the topics of a configuration whose messages are all there."""
        sources = roles_of(config)
        return [source.topic for source in sources if set(topics_of(source)) <= set(self.topics)]

    def uses(self, config: RecordingConfig) -> dict[str, str]:
        """Return the use of each topic; empty text for those that are not read."""
        uses = dict.fromkeys(self.names, "")
        for source, role in roles_of(config).items():
            word = {"control": getattr(source, "quantity", ""), "pose": getattr(source, "name", "base")}
            for name in topics_of(source):
                if name in uses:
                    uses[name] = ", ".join(filter(None, (uses[name], word.get(role, role))))
        return uses

    def resets(self, config: RecordingConfig) -> list[float]:
        """Return no times: the times of recording tell where stamps were set back."""
        return []

    def streams(
        self, config: RecordingConfig, findings: list[Finding], topics: Collection[str] | None = None
    ) -> dict[str, Stream]:
        """Return the messages of each source of a configuration, by topic, and add findings.

        `topics` are those that are read; None: all of the configuration.

        Raises:
            RecordingError: a topic is missing, its messages are not of a type for their role, or have no such
                part.
        """
        streams: dict[str, Stream] = {}
        for source, role in roles_of(config).items():
            if topics is not None and source.topic not in topics:
                continue
            missing = [name for name in topics_of(source) if name not in self.topics]
            if not missing:
                streams[source.topic] = decoded(self, source, role)
            elif source in config.idle:
                what = f"{source.kind.plural}" if role == "control" else f"{role}s"
                findings.append(Finding("note", missing[0], f"there is no such topic, and so no {what}"))
            else:
                listed = ", ".join(sorted(self.topics)) or "none"
                what = source.quantity if role == "control" else role
                raise RecordingError(f"topic {missing[0]} ({what}) is missing; the bag has {listed}")
        if self.damage:
            received = np.concatenate([[0], *(stream.received for stream in streams.values())])[1:]
            duration = np.ptp(received) * 1e-9 if len(received) else 0.0
            lost = f", {self.lost} bytes could not be read" if self.lost else ""
            more = f"; {MORE}" if self.is_limited else ""
            what = f"{self.damage}: recovered up to {duration:.3f} s{lost}{more}"
            findings.append(Finding("warning", "", what))
        return streams


def roles_of(config: RecordingConfig) -> dict[Any, Role]:
    """Return the role of each source of a configuration."""
    roles: dict[Any, Role] = dict.fromkeys((*config.markers, config.base), "pose")
    roles |= dict.fromkeys(config.sensors, "sensor")
    roles |= dict.fromkeys(config.measured, "control")
    roles[config.command] = "command"
    return {source: role for source, role in roles.items() if source is not None}


def topics_read(config: RecordingConfig) -> set[str]:
    """Return the topics of a bag that a configuration reads."""
    return {STATIC, *(topic for source in roles_of(config) for topic in topics_of(source))}


def _xyz(v: Any) -> tuple[float, ...]:
    return v.x, v.y, v.z


def _wxyz(q: Any) -> tuple[float, ...]:
    return q.w, q.x, q.y, q.z


def _pose(pose: Any) -> tuple[float, ...]:
    return *_xyz(pose.position), *_wxyz(pose.orientation)


#: reader of a pose, by message type
POSES: dict[str, Callable[[Any], Any]] = {
    "geometry_msgs/msg/PoseStamped": lambda m: _pose(m.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _pose(m.pose.pose),
    "nav_msgs/msg/Odometry": lambda m: _pose(m.pose.pose),
    "geometry_msgs/msg/Pose": _pose,
    "geometry_msgs/msg/TransformStamped": lambda m: (
        *_xyz(m.transform.translation),
        *_wxyz(m.transform.rotation),
    ),
    "geometry_msgs/msg/PointStamped": lambda m: _xyz(m.point),
}
#: message type of several poses, which have numbers; and of transforms between named frames
POSE_ARRAY, TRANSFORMS = "geometry_msgs/msg/PoseArray", ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
#: topic of transforms that do not change
STATIC = "/tf_static"
#: message type of named joints
JOINTS = "sensor_msgs/msg/JointState"
#: reader of the numbers in the order of the fields, by message type. A wrench is a load cell's: its force
#: in whatever direction
NUMBERS: dict[str, Callable[[Any], Any]] = {
    "geometry_msgs/msg/QuaternionStamped": lambda m: (*_xyz(m.quaternion), m.quaternion.w),
    "geometry_msgs/msg/Vector3Stamped": lambda m: _xyz(m.vector),
    "geometry_msgs/msg/WrenchStamped": lambda m: (math.hypot(*_xyz(m.wrench.force)),),
    "std_msgs/msg/Float64MultiArray": lambda m: m.data,
    "std_msgs/msg/Float32MultiArray": lambda m: m.data,
    "sensor_msgs/msg/FluidPressure": lambda m: (m.fluid_pressure,),
    "sensor_msgs/msg/MagneticField": lambda m: _xyz(m.magnetic_field),
    **{f"std_msgs/msg/{kind}": lambda m: (m.data,) for kind in ("Float64", "Float32", "Int16", "Int32")},
    JOINTS: lambda m: m.effort,
}
#: reader of the numbers of other sensors, by message type
SENSORS: dict[str, Callable[[Any], Any]] = {
    **{kind: lambda m, read=read: read(m)[3:] for kind, read in POSES.items()},  # type: ignore[misc]
    "sensor_msgs/msg/Imu": lambda m: _wxyz(m.orientation),
    "geometry_msgs/msg/QuaternionStamped": lambda m: _wxyz(m.quaternion),
    "geometry_msgs/msg/WrenchStamped": lambda m: (*_xyz(m.wrench.force), *_xyz(m.wrench.torque)),
    **{kind: read for kind, read in NUMBERS.items() if kind.endswith("MultiArray")},
}
#: line of a log that marks a recording of a simulated robot
SIMULATED = "Simulated: the robot of this recording is a simulation, and not a physical one"
#: reader of the text, by message type
TEXTS: dict[str, Callable[[Any], str]] = {
    "rosgraph_msgs/msg/Log": lambda m: m.msg,
    "rcl_interfaces/msg/Log": lambda m: m.msg,
    "std_msgs/msg/String": lambda m: m.data,
}


@functools.cache
def typestore(ros: int) -> Any:
    """Return the standard message types of ROS 1 or 2. Raises `ImportError` without rosbags."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise ImportError("bags need rosbags: pip install 'knode-cosserat[ros]'") from None
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    for kind in TRANSFORMS:
        if kind not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return store


def topic_and_part(name: str) -> tuple[str, str]:
    """Return the topic of a name such as /poses[2], and the part of its messages, empty for all of it."""
    topic, bracket, part = name.partition("[")
    return (topic, part[:-1].strip()) if bracket and part.endswith("]") else (name, "")


def topics_of(source: Any) -> list[str]:
    """Return the topics of a bag that a source of a configuration is read from."""
    if isinstance(source, ControlSource) and PLACE in source.topic:
        words = source.names or [str(k + 1) for k in range(len(source.order))]
        return [source.topic.replace(PLACE, word) for word in words]
    return [topic_and_part(source.topic)[0]]


def decoded(bag: Bag, source: Any, role: Role) -> Stream:
    """Return the numbers of a source of a configuration; messages that cannot be decoded are counted.

    Raises:
        RecordingError: a topic's message type is not allowed for this role, or has no such part.
    """
    names = topics_of(source)
    if PLACE in source.topic:
        parts = [_simple(bag.topics[name], NUMBERS, role) for name in names]
        return _merged(source.topic, parts, is_held=role == "command" or bool(getattr(source, "held", None)))
    topic, part = bag.topics[names[0]], topic_and_part(source.topic)[1]
    if role == "pose":
        stream = _poses(bag, topic, part)
    elif role == "sensor":
        stream = _simple(topic, SENSORS, role)
    elif role == "command" and source.text is not None:
        kinds = {kind: functools.partial(_spoken, read, source.text) for kind, read in TEXTS.items()}
        stream = _simple(topic, kinds, "command in text")
    elif topic.type == JOINTS:
        stream = _joints(topic, source)
    else:
        stream = _simple(topic, NUMBERS, role)
    return dataclasses.replace(stream, topic=source.topic)


def _simple(topic: Topic, readers: Mapping[str, Any], role: str) -> Stream:
    """Return the numbers of a topic with one row a message."""
    _require_type(topic, readers, role)
    rows: list[_Row] = []
    broken = 0
    for received, message in topic.messages():
        # text with other words than numbers, too
        try:
            values = readers[topic.type](message)
        except Exception:
            broken += 1
            continue
        if values is not None:
            rows.append((_stamp(message), received, values))
    return _stream(topic.name, rows, broken)


def _require_type(topic: Topic, kinds: Collection[str], role: str) -> None:
    name = topic.type.replace("/msg/", "/")
    if topic.type not in kinds:
        listed = ", ".join(kind.replace("/msg/", "/") for kind in kinds)
        raise RecordingError(f"topic {topic.name}: its messages are {name}; allowed for a {role} is {listed}")
    if topic.ros == 1 and topic.digest not in ("", "*", typestore(1).generate_msgdef(topic.type)[1]):
        raise RecordingError(f"topic {topic.name}: its {name} is not the type that ROS defines by this name")


# poses


def _poses(bag: Bag, topic: Topic, part: str) -> Stream:
    _require_type(topic, (*POSES, POSE_ARRAY, *TRANSFORMS), "pose")
    if topic.type in TRANSFORMS:
        return _frame(bag, topic, part)
    if topic.type in POSES:
        if part:
            raise RecordingError(
                f"topic {topic.name}: a {topic.type.replace('/msg/', '/')} has no part [{part}]; "
                f"allowed is {topic.name}"
            )
        return _simple(topic, POSES, "pose")
    messages = list(topic.messages())
    most = max((len(message.poses) for _, message in messages if message is not None), default=0)
    number = int(_required_part(part, list(map(str, range(most))), topic.name)) if most else 0
    # a source that leaves lost bodies out changes the numbers of the others: such a message is not used
    rows = [
        (_stamp(message), received, _pose(message.poses[number]))
        for received, message in messages
        if message is not None and len(message.poses) == most
    ]
    return _stream(topic.name, rows, len(messages) - len(rows))


def _required_part(part: str, parts: Sequence[str], topic: str) -> str:
    """Return the named part of a topic's messages; the only one if none is named."""
    if not part and len(parts) == 1:
        return parts[0]
    if part not in parts:
        words = ", ".join(f"{topic}[{name}]" for name in parts[:20])
        what = f"has no part [{part}]" if part else f"has {len(parts)} bodies"
        raise RecordingError(f"topic {topic} {what}; allowed is {words or 'no part'}")
    return part


def _frame(bag: Bag, topic: Topic, part: str) -> Stream:
    """Return the pose of a frame in the frame at the root of its tree."""
    edges: dict[str, tuple[str, list[_Row]]] = {}
    broken = 0
    # transforms that do not change come from a topic of their own
    for source in {topic.name: topic, STATIC: bag.topics.get(STATIC, topic)}.values():
        for received, message in source.messages():
            broken += message is None
            for transform in () if message is None else message.transforms:
                child, parent = transform.child_frame_id.strip("/"), transform.header.frame_id.strip("/")
                pose = POSES["geometry_msgs/msg/TransformStamped"](transform)
                if not (math.isfinite(math.fsum(pose)) and 0.5 < math.hypot(*pose[3:]) < 2.0):
                    broken += 1
                    continue
                if edges.setdefault(child, (parent, []))[0] != parent:
                    raise RecordingError(
                        f"topic {topic.name}: the frame {child} has two parents, "
                        f"{edges[child][0]} and {parent}; allowed is one"
                    )
                edges[child][1].append((_stamp(transform), received, pose))
    name = _required_part(part.strip("/"), sorted(edges), topic.name)
    stream, parent = _stream(topic.name, edges[name][1], broken), edges[name][0]
    above = [name]
    while parent in edges:
        if parent in above:
            raise RecordingError(f"topic {topic.name}: the frames {', '.join(above)} are in a circle")
        above.append(parent)
        stream = _seen_from(_stream(topic.name, edges[parent][1], 0), stream)
        parent = edges[parent][0]
    return stream


def _seen_from(parent: Stream, child: Stream) -> Stream:
    """Return a child's poses in the frame that its parent is given in, at the child's times."""
    from scipy.spatial.transform import Rotation, Slerp

    stamped = bool(np.all(child.stamped >= 0) and np.all(parent.stamped >= 0))
    at = child.stamped if stamped else child.received
    known, first = np.unique(parent.stamped if stamped else parent.received, return_index=True)
    poses, turned = parent.values[first], Rotation.from_quat(parent.values[first, 3:], scalar_first=True)
    if len(known) > 1:
        inside = np.clip(at, known[0], known[-1])
        # ns since 1970 have more digits than a float
        seconds, grid = (inside - known[0]) * 1e-9, (known - known[0]) * 1e-9
        position = np.stack([np.interp(seconds, grid, axis) for axis in poses[:, :3].T], axis=1)
        rotation = Slerp(grid, turned)(seconds)
    else:
        position, rotation = poses[:1, :3], turned[0]
    place = position + rotation.apply(child.values[:, :3])
    turn = rotation * Rotation.from_quat(child.values[:, 3:], scalar_first=True)
    return dataclasses.replace(child, values=np.concatenate([place, turn.as_quat(scalar_first=True)], axis=1))


# numbers


def _joints(topic: Topic, source: ControlSource) -> Stream:
    """Return the efforts of named joints, or positions for lengths and angles, in the order of the source."""
    _require_type(topic, (JOINTS,), "control")
    rows: list[tuple[int, int, list[str], Any]] = []
    broken = 0
    for received, message in topic.messages():
        names = [] if message is None else list(message.name)
        values: Any = () if message is None else message.effort
        if message is not None and source.kind.unit in MOVING:
            values = message.position
        if message is None or (names and len(names) != len(values)):
            broken += 1
        else:
            rows.append((_stamp(message), received, names, values))
    reference, remark = joint_names(source, [names for _, _, names, _ in rows], topic.name)
    chosen: list[_Row] = []
    for stamp, received, names, values in rows:
        by_name = dict(zip(names, values, strict=True)) if reference else {}
        # messages about other joints only are not about the robot
        if not reference or any(name in by_name for name in reference):
            chosen.append((stamp, received, [by_name.get(name, math.nan) for name in reference] or values))
    stream = _stream(topic.name, chosen, broken)
    return dataclasses.replace(stream, remarks=(Finding("note", topic.name, remark),) if remark else ())


def joint_names(source: ControlSource, seen: Sequence[list[str]], topic: str) -> tuple[list[str], str]:
    """Return the joints in the order of the source's numbers, and a remark; no names if messages have none.

    Numbers in the names (tendon_1, tendon_2, …) say which number a joint is. An order that differs from
    1, 2, 3, … says which number each joint of a message is; it must not contradict the names.
    """
    if source.names:
        there = sorted({name for names in seen for name in names})
        missing = [name for name in source.names if name not in there]
        if missing and seen:
            listed = ", ".join(there) or "not named"
            raise RecordingError(
                f"topic {topic}: no joint is called {missing[0]}; its joints are {listed}"
                f"{did_you_mean(missing[0], there)}"
            )
        return list(source.names), ""
    first = next((names for names in seen if len(names) == len(source.order)), [])
    if not first:
        return [], ""
    if len(set(first)) < len(first):
        raise RecordingError(
            f"topic {topic}: the joints {', '.join(first)} have the same names; allowed is each once"
        )
    listed = ", ".join(first)
    matches = [re.fullmatch(r"(.*?)(\d+)(\D*)", name) for name in first]
    numbers = [int(match[2]) for match in matches if match]
    stems = {(match[1], match[3]) for match in matches if match}
    lowest = min(numbers, default=0)
    if len(stems) != 1 or sorted(numbers) != list(range(lowest, lowest + len(first))) or lowest > 1:
        return first, f"its joints {listed} are taken in this order; `names` in the configuration states it"
    by_name, counted = [number - lowest + 1 for number in numbers], list(range(1, len(first) + 1))
    if by_name in (list(source.order), counted):
        return first, ""
    if list(source.order) == counted:
        matched = sorted(first, key=lambda name: by_name[first.index(name)])
        return matched, f"its joints {listed} are matched by name"
    raise RecordingError(
        f"topic {topic}: its joints are {listed}, and the configuration's order is {list(source.order)}; "
        "allowed is one that agrees with the names, or `names` with the joint of each number in the order"
    )


def _merged(topic: str, parts: Sequence[Stream], *, is_held: bool) -> Stream:
    """Return one row of all numbers at each time of the topic with most messages.

    Numbers that are held have their last value there; others are interpolated linearly. A row beyond the
    first or last message of another topic is NaN.
    """
    stamped = all(np.all(part.stamped >= 0) for part in parts)
    clocks = [part.stamped if stamped else part.received for part in parts]
    columns = []
    longest = max(parts, key=lambda part: len(part.received))
    at = longest.stamped if stamped else longest.received
    if is_held:
        at = np.unique(np.concatenate(clocks))
    for part, clock in zip(parts, clocks, strict=True):
        known, first = np.unique(clock, return_index=True)
        if not len(known):
            columns.append(np.full(len(at), math.nan))
            continue
        value = part.values[first, 0]
        if is_held:
            last = np.searchsorted(known, at, side="right") - 1
            columns.append(np.where(last >= 0, value[np.maximum(last, 0)], math.nan))
        else:
            # messages of one instant are sent one after the other: half a period is no extrapolation
            reach = 0.5 * float(np.median(np.diff(known))) if len(known) > 1 else 0.0
            inside = (at >= known[0] - reach) & (at <= known[-1] + reach)
            line = np.interp((at - known[0]) * 1e-9, (known - known[0]) * 1e-9, value)
            columns.append(np.where(inside, line, math.nan))
    received = at if is_held or not stamped else longest.received
    stamps = at if stamped else np.full(len(at), -1, dtype=np.int64)
    return Stream(topic, stamps, received, np.stack(columns, axis=1), sum(part.broken for part in parts))


def _spoken(read: Callable[[Any], str], text: str, message: Any) -> tuple[float, ...] | None:
    """Return the numbers in a text message; None if the text does not match the template."""
    before, after = text.split(PLACE)
    said = read(message).strip()
    before, after = before.strip(), after.strip()
    if not said.startswith(before) or not said.endswith(after) or len(said) < len(before) + len(after):
        return None
    return tuple(map(float, said[len(before) : len(said) - len(after)].replace(",", " ").split()))


def _stream(topic: str, rows: Sequence[_Row], broken: int) -> Stream:
    """Return rows as arrays; rows whose size differs from most are counted as broken."""
    counts = [len(values) for _, _, values in rows]
    size = max(set(counts), key=counts.count) if counts else 0
    kept = [row for row in rows if len(row[2]) == size]
    return Stream(
        topic,
        np.array([stamped for stamped, _, _ in kept], dtype=np.int64),
        # a damaged stamp can be larger than any time
        np.array([min(received, 2**62) for _, received, _ in kept], dtype=np.int64),
        np.array([values for _, _, values in kept], dtype=float).reshape(len(kept), size),
        broken + len(rows) - len(kept),
    )


def _stamp(message: Any) -> int:
    stamped = getattr(message, "header", message)
    stamp = getattr(stamped, "stamp", None)
    if stamp is None or (stamp.sec == 0 and stamp.nanosec == 0):
        return -1
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


# encoding

#: line types of the log, and message types by count of numbers; other counts are sent as arrays
LOGS = {1: "rosgraph_msgs/msg/Log", 2: "rcl_interfaces/msg/Log"}
_SENT = {3: "geometry_msgs/msg/Vector3Stamped", 4: "geometry_msgs/msg/QuaternionStamped"}
_ARRAY = "std_msgs/msg/Float64MultiArray"


def message_type(stream: OutgoingStream, ros: int) -> str:
    """Return the message type of a stream, as ROS 2 writes it, for a ROS version.

    Raises:
        RecordingError: the topic is a part of messages, or stands for several topics.
    """
    if topic_and_part(stream.topic)[1] or PLACE in stream.topic:
        raise RecordingError(
            f"topic {stream.topic} cannot be written; allowed is one topic for each body, and one for all "
            "controls"
        )
    size = np.shape(stream.values)[1]
    if stream.role == "pose":
        return "geometry_msgs/msg/PoseStamped" if size == 7 else "geometry_msgs/msg/PointStamped"
    return LOGS[ros] if _is_text(stream) else _SENT.get(size, _ARRAY)


def _is_text(stream: OutgoingStream) -> bool:
    return stream.role == "command" and stream.source.text is not None


def encoder_of(stream: OutgoingStream, ros: int) -> Callable[[int, int, Any], bytes]:
    """Return a function that encodes a message from a stamp (ns), a row's index and its values.

    A row of NaN of text commands stands for the line that states a simulation.
    """
    store, kind = typestore(ros), message_type(stream, ros)
    types = store.types
    serialize = store.serialize_ros1 if ros == 1 else store.serialize_cdr

    def part(name: str, **fields: Any) -> Any:
        return types[name](**fields)

    def content(values: list[float], header: Any) -> dict[str, Any]:
        if _is_text(stream):
            numbers = " ".join(f"{value:.10g}" for value in values if math.isfinite(value))
            said = stream.source.text.replace(PLACE, numbers) if numbers else SIMULATED
            head = {"header": header, "topics": []} if ros == 1 else {"stamp": header.stamp}
            return head | {"level": 2, "name": "/motors", "msg": said, "file": "", "function": "", "line": 0}
        if kind == _ARRAY:
            layout = part("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
            return {"layout": layout, "data": np.array(values)}
        xyz = dict(zip("xyz", values, strict=False))
        if stream.role != "pose":
            if len(values) == 3:
                return {"header": header, "vector": part("geometry_msgs/msg/Vector3", **xyz)}
            return {"header": header, "quaternion": part("geometry_msgs/msg/Quaternion", **xyz, w=values[3])}
        point = part("geometry_msgs/msg/Point", **xyz)
        if len(values) == 3:
            return {"header": header, "point": point}
        orientation = part("geometry_msgs/msg/Quaternion", **dict(zip("wxyz", values[3:], strict=True)))
        pose = part("geometry_msgs/msg/Pose", position=point, orientation=orientation)
        return {"header": header, "pose": pose}

    def encode(stamp: int, row: int, values: Any) -> bytes:
        time = part("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        number = {"seq": row} if ros == 1 else {}
        frame = "world" if stream.role == "pose" else ""
        header = part("std_msgs/msg/Header", stamp=time, frame_id=frame, **number)
        return bytes(serialize(types[kind](**content([float(value) for value in values], header)), kind))

    return encode
