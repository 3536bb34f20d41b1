"""Writer of recordings: bags of ROS 1 and 2, and tables, from the same configuration.

A file is read back with the configuration that it was written with. The name's suffix selects the format:
.bag (ROS 1), .mcap or .db3 (ROS 2), .csv, .parquet.
"""

from __future__ import annotations

import dataclasses
import heapq
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.writing import replacing, temporary_folder
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.config_values import PLACE
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.messages import SIMULATED, topic_and_part, typestore
from knode_cosserat.recordings.sources import POSITION_UNITS, TENSION_UNITS, CommandSource, TensionSource

BAGS = (".bag", ".mcap", ".db3")
FORMATS = (*BAGS, ".csv", ".parquet")
#: default of time zero on the clock of a bag (s since 1970)
START = 1_720_000_000
#: message type by count of numbers; other counts are sent as arrays, which have no stamps
_NUMBERS = {3: "geometry_msgs/msg/Vector3Stamped", 4: "geometry_msgs/msg/QuaternionStamped"}
_ARRAY = "std_msgs/msg/Float64MultiArray"
#: types of the parts of messages
_PARTS = (
    "builtin_interfaces/msg/Time",
    "geometry_msgs/msg/Point",
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/Quaternion",
    "geometry_msgs/msg/Vector3",
    "std_msgs/msg/Header",
    "std_msgs/msg/MultiArrayLayout",
)


@dataclasses.dataclass(frozen=True, eq=False)
class MocapPoses:
    """Poses of a body from motion capture, in motion capture's frame and with the body's own axes.

    Attributes:
        time: times (s), increasing.
        position: positions (m).
        quaternion: orientations, scalar first; None if only positions are known.
    """

    time: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]
    quaternion: Float[np.ndarray, "n 4"] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Pulls:
    """Tensions (N), tendon 1 first, and the times of their measurement or command (s)."""

    time: Float[np.ndarray, " n"]
    tension: Float[np.ndarray, "n tendons"]


def write_recording(
    path: str | Path,
    config: RecordingConfig,
    poses: Mapping[str, MocapPoses],
    tension: Pulls | None = None,
    command: Pulls | None = None,
    *,
    start: int = START,
    delays: Mapping[str, float] | None = None,
) -> None:
    """Write a recording for `load_recording(path, config)`.

    In a bag of a simulated robot with text commands, the first message of the log states the simulation.

    Args:
        path: the file; an existing one is replaced.
        config: topics, order and units of the messages. Text commands in grams-force are rounded to whole
            numbers, as the paper's robot sends them.
        poses: poses by the markers' names; the base's under "base".
        tension: measured tensions.
        command: commanded tensions.
        start: time zero on the bag's clock (s since 1970); tables begin at zero.
        delays: delay from stamp to recording (s) by topic; zero by default.

    Raises:
        RecordingError: the format is unknown, data are missing, or the file cannot be written.
        ImportError: the library for this format is not installed.
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        raise RecordingError(f"{path}: allowed is a name that ends in {', '.join(FORMATS)}")
    streams = _on_the_wire(path, config, poses, tension, command)
    try:
        if path.suffix == ".bag":
            _write_ros1(path, streams, start, delays or {})
        elif path.suffix in (".mcap", ".db3"):
            _write_ros2(path, streams, start, delays or {})
        else:
            _write_table(path, config, streams)
    except (OSError, sqlite3.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path}: cannot be written: {reason}") from None


@dataclasses.dataclass(frozen=True, eq=False)
class WireStream:
    """Numbers in the units and the order of the messages."""

    topic: str
    role: str
    time: Any
    values: Any
    source: Any = None


def _on_the_wire(
    path: Path,
    config: RecordingConfig,
    poses: Mapping[str, MocapPoses],
    tension: Pulls | None,
    command: Pulls | None,
) -> list[WireStream]:
    sources = {marker.name: marker.topic for marker in config.markers}
    if config.base is not None:
        sources["base"] = config.base.topic
    if set(poses) != set(sources):
        raise RecordingError(f"{path}: poses are given of {sorted(poses)}; required is {sorted(sources)}")
    scale = POSITION_UNITS[config.position_unit]
    streams = []
    for name, topic in sources.items():
        pose = poses[name]
        parts = [np.asarray(pose.position) / scale]
        if pose.quaternion is not None:
            parts.append(np.asarray(pose.quaternion))
        streams.append(WireStream(topic, "pose", pose.time, np.concatenate(parts, axis=1)))
    for role, source, pulls in (("tension", config.tension, tension), ("command", config.command, command)):
        if pulls is None:
            continue
        if source is None or np.shape(pulls.tension)[1:] != (len(source.order),):
            raise RecordingError(
                f"{path}: {role} of shape {np.shape(pulls.tension)}; the configuration has "
                f"{len(source.order) if source else 'no'} tendons there"
            )
        stream = WireStream(source.topic, role, pulls.time, sent_tensions(source, pulls.tension), source)
        streams.append(_saying_so(stream) if config.simulated and path.suffix in BAGS else stream)
    return streams


def _saying_so(stream: WireStream) -> WireStream:
    """Return the stream; a log gets a first row of NaN, which stands for the line on the simulation."""
    if not isinstance(stream.source, CommandSource) or stream.source.text is None or len(stream.time) == 0:
        return stream
    nothing = np.full((1, np.shape(stream.values)[1]), np.nan)
    time, values = np.concatenate([stream.time[:1], stream.time]), np.concatenate([nothing, stream.values])
    return dataclasses.replace(stream, time=time, values=values)


def sent_tensions(source: TensionSource, newtons: Any) -> Any:
    """Return tensions (N), shape (n, tendons), in the unit and the order of a source's messages."""
    sent = np.asarray(newtons)[:, np.array(source.order) - 1] / TENSION_UNITS[source.unit]
    in_text = isinstance(source, CommandSource) and source.text is not None
    return np.round(sent) if in_text and source.unit == "gf" else sent


# bags


def _write_ros1(path: Path, streams: list[WireStream], start: int, delays: Mapping[str, float]) -> None:
    store = typestore(1)
    from rosbags.rosbag1 import Writer

    with replacing(path) as temporary, Writer(temporary) as writer:
        connections = {
            each.topic: writer.add_connection(each.topic, message_type(each, 1), typestore=store)
            for each in streams
        }
        for topic, kind, received, message in _messages(streams, 1, start, delays):
            writer.write(connections[topic], received, store.serialize_ros1(message, kind))


def _write_ros2(path: Path, streams: list[WireStream], start: int, delays: Mapping[str, float]) -> None:
    store = typestore(2)
    from rosbags.rosbag2 import StoragePlugin, Writer

    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    # rosbags writes a folder with a description; the data file alone is complete
    with replacing(path) as temporary, temporary_folder(path) as folder:
        with Writer(folder / "bag", version=9, storage_plugin=plugin) as writer:
            connections = {
                each.topic: writer.add_connection(each.topic, message_type(each, 2), typestore=store)
                for each in streams
            }
            for topic, kind, received, message in _messages(streams, 2, start, delays):
                writer.write(connections[topic], received, store.serialize_cdr(message, kind))
        (folder / "bag" / f"bag{path.suffix}").replace(temporary)


def _messages(
    streams: list[WireStream], ros: int, start: int, delays: Mapping[str, float]
) -> Iterator[tuple[str, str, int, Any]]:
    """Yield topic, type, recording time (ns) and message, in the order of recording."""

    def of(stream: WireStream) -> Iterator[tuple[int, int, str, str, Any]]:
        kind, make = message_type(stream, ros), message_maker(stream, ros)
        delay = round(delays.get(stream.topic, 0.0) * 1e9)
        for row, (time, values) in enumerate(zip(stream.time, stream.values, strict=True)):
            stamp = start * 10**9 + round(float(time) * 1e9)
            yield stamp + delay, row, stream.topic, kind, make(stamp, row, values)

    for received, _, topic, kind, message in heapq.merge(*map(of, streams), key=lambda each: each[:3]):
        yield topic, kind, received, message


def message_type(stream: WireStream, ros: int) -> str:
    """Return the message type of a stream, as ROS 2 writes it, for a ROS version.

    Raises:
        RecordingError: the topic is a part of messages, or stands for several topics.
    """
    if topic_and_part(stream.topic)[1] or PLACE in stream.topic:
        raise RecordingError(
            f"topic {stream.topic} cannot be written; allowed is one topic for each body, and one for all "
            "tensions"
        )
    size = np.shape(stream.values)[1]
    if stream.role == "pose":
        return "geometry_msgs/msg/PoseStamped" if size == 7 else "geometry_msgs/msg/PointStamped"
    if stream.role == "command" and stream.source.text is not None:
        return "rosgraph_msgs/msg/Log" if ros == 1 else "rcl_interfaces/msg/Log"
    return _NUMBERS.get(size, _ARRAY)


def message_maker(stream: WireStream, ros: int) -> Callable[[int, int, Any], Any]:
    """Return a function that makes a message from a stamp (ns), a row's index and its values."""
    types, kind = typestore(ros).types, message_type(stream, ros)
    made = {name.rsplit("/", 1)[1]: types[name] for name in _PARTS}
    frame = "world" if stream.role == "pose" else ""

    def header(stamp: int, row: int) -> Any:
        time = made["Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        return made["Header"](stamp=time, frame_id=frame, **({"seq": row} if ros == 1 else {}))

    def point(values: Any) -> Any:
        return made["Point"](*map(float, values))

    def pose(stamp: int, row: int, values: Any) -> Any:
        if len(values) == 3:
            return types[kind](header=header(stamp, row), point=point(values))
        w, x, y, z = map(float, values[3:])
        turned = made["Quaternion"](x=x, y=y, z=z, w=w)
        placed = made["Pose"](position=point(values[:3]), orientation=turned)
        return types[kind](header=header(stamp, row), pose=placed)

    def spoken(stamp: int, row: int, values: Any) -> Any:
        # a row of NaN stands for the line on the simulation
        numbers = " ".join(f"{value:.10g}" for value in values if np.isfinite(value))
        said = stream.source.text.replace(PLACE, numbers) if numbers else SIMULATED
        head = header(stamp, row)
        common = {"level": 2, "name": "/motors", "msg": said, "file": "", "function": "", "line": 0}
        return (
            types[kind](header=head, topics=[], **common)
            if ros == 1
            else types[kind](stamp=head.stamp, **common)
        )

    def numbers(stamp: int, row: int, values: Any) -> Any:
        if kind == _ARRAY:
            layout = made["MultiArrayLayout"](dim=[], data_offset=0)
            return types[kind](layout=layout, data=np.ascontiguousarray(values, dtype=float))
        if len(values) == 3:
            return types[kind](header=header(stamp, row), vector=made["Vector3"](*map(float, values)))
        return types[kind](header=header(stamp, row), quaternion=made["Quaternion"](*map(float, values)))

    if stream.role == "pose":
        return pose
    return spoken if kind.endswith("/Log") else numbers


# tables


def _write_table(path: Path, config: RecordingConfig, streams: list[WireStream]) -> None:
    from knode_cosserat.recordings import table
    from knode_cosserat.recordings.formats import parquet

    columns: dict[str, Any] = {}
    for stream in streams:
        if stream.role == "pose":
            titles = table.position_titles(stream.topic, config.position_unit)
            titles += table.quaternion_titles(stream.topic) if np.shape(stream.values)[1] == 7 else []
        else:
            titles = table.tension_titles(stream.topic, stream.source.unit, len(stream.source.order))
        columns |= {
            title: (stream.time, values) for title, values in zip(titles, stream.values.T, strict=True)
        }
    said = {f"fraction {marker.topic}": repr(marker.fraction) for marker in config.markers}
    if config.description:
        said["source"] = " ".join(config.description.split())
    if config.simulated is not None:
        said["simulated"] = "true" if config.simulated else "false"
    if config.initial_tension is not None:
        said[table.INITIAL] = " ".join(map(repr, config.initial_tension))
    if config.command is not None and config.command.latency:
        said["latency"] = repr(config.command.latency)
    frame = table.frame_of(columns)
    with replacing(path) as temporary:
        if path.suffix == ".csv":
            comments = "".join(f"# {key}: {value}\n" for key, value in said.items())
            temporary.write_text(comments + frame.to_csv(index=False, lineterminator="\n"), encoding="utf-8")
        else:
            parquet.write_parquet(temporary, frame, said)
