"""Conversion of ROS messages to numbers: the types for poses, tensions and commands, and their fields.

Messages are decoded with the definitions of rosbags. Definitions in a bag are not used, because rosbags
turns definitions into Python code.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.recordings.config_values import PLACE
from knode_cosserat.recordings.container import Topic
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.sources import CommandSource

Role = Literal["pose", "tension", "command"]


@dataclasses.dataclass(frozen=True, eq=False)
class Stream:
    """Numbers of one topic, in the units and the order of its messages."""

    topic: str
    #: measurement times from the headers (ns); -1 without a stamp
    stamped: Int[np.ndarray, " n"]
    #: recording times (ns)
    received: Int[np.ndarray, " n"]
    #: poses (position and, if known, quaternion, scalar first) or tensions
    values: Float[np.ndarray, "n size"]
    #: number of messages that could not be decoded
    broken: int = 0


def _xyz(v: Any) -> tuple[float, ...]:
    return v.x, v.y, v.z


def _wxyz(q: Any) -> tuple[float, ...]:
    return q.w, q.x, q.y, q.z


def _transform(m: Any) -> tuple[float, ...]:
    return *_xyz(m.transform.translation), *_wxyz(m.transform.rotation)


#: reader of a pose, by message type
POSES: dict[str, Callable[[Any], Any]] = {
    "geometry_msgs/msg/PoseStamped": lambda m: (*_xyz(m.pose.position), *_wxyz(m.pose.orientation)),
    "geometry_msgs/msg/TransformStamped": _transform,
    "geometry_msgs/msg/PointStamped": lambda m: _xyz(m.point),
}
#: reader of the numbers in the order of the fields, by message type
NUMBERS: dict[str, Callable[[Any], Any]] = {
    "geometry_msgs/msg/QuaternionStamped": lambda m: (*_xyz(m.quaternion), m.quaternion.w),
    "geometry_msgs/msg/Vector3Stamped": lambda m: _xyz(m.vector),
    "std_msgs/msg/Float64MultiArray": lambda m: m.data,
    "std_msgs/msg/Float32MultiArray": lambda m: m.data,
    "sensor_msgs/msg/JointState": lambda m: m.effort,
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
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise ImportError("bags need rosbags: pip install 'knode-cosserat[ros]'") from None
    return get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)


def decoded_messages(
    topic: Topic, ros: int, role: Role, command: CommandSource | None, source: str
) -> Stream:
    """Return the numbers in a topic's messages; messages that cannot be decoded are left out and counted.

    Raises:
        RecordingError: the topic's message type is not allowed for this role.
    """
    text = command.text if role == "command" and command is not None else None
    readers = _readers(role, text)
    where = f"{source}: topic {topic.name}"
    if topic.type not in readers:
        raise RecordingError(
            f"{where}: its messages are {_short(topic.type)}; allowed for a {role}"
            f"{' in text' if text else ''} is {', '.join(map(_short, readers))}"
        )
    store = typestore(ros)
    if ros == 1 and topic.digest not in ("", "*", store.generate_msgdef(topic.type)[1]):
        raise RecordingError(
            f"{where}: its {_short(topic.type)} is not the type that ROS defines by this name"
        )
    read, deserialize = readers[topic.type], store.deserialize_ros1 if ros == 1 else store.deserialize_cdr
    rows: list[tuple[int, int, Any]] = []
    broken = 0
    for received, raw in zip(topic.received, topic.raw, strict=True):
        # rosbags raises various errors on damaged bytes
        try:
            message = deserialize(raw, topic.type)
            found = read(message)
        except Exception:
            broken += 1
            continue
        if found is not None:
            rows.append((_stamp(message), received, found))
    return _stream(topic.name, rows, broken)


def _readers(role: Role, text: str | None) -> dict[str, Callable[[Any], Any]]:
    if role == "pose":
        return POSES
    if text is None:
        return NUMBERS
    return {kind: functools.partial(_spoken, read, text) for kind, read in TEXTS.items()}


def _spoken(read: Callable[[Any], str], text: str, message: Any) -> tuple[float, ...] | None:
    """Return the numbers in a text message; None if the text does not match the template."""
    before, after = text.split(PLACE)
    said = read(message).strip()
    before, after = before.strip(), after.strip()
    if not said.startswith(before) or not said.endswith(after) or len(said) < len(before) + len(after):
        return None
    return tuple(map(float, said[len(before) : len(said) - len(after)].replace(",", " ").split()))


def _stream(topic: str, rows: list[tuple[int, int, Any]], broken: int) -> Stream:
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


def _short(kind: str) -> str:
    return kind.replace("/msg/", "/")
