"""Writing of recordings, in every format that has a writer, from the configuration that reads them back."""

from __future__ import annotations

import dataclasses
import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.recordings.config import (
    POSITION_UNITS,
    TENSION_UNITS,
    CommandSource,
    RecordingConfig,
    TensionSource,
)
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.formats import formats, written_suffixes
from knode_cosserat.recordings.messages import encoder_of, message_type
from knode_cosserat.recordings.streams import Outgoing, OutgoingStream

#: default of time zero on the clock of a bag (s since 1970)
START = 1_720_000_000


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
    """Write a recording for `load_recording(path, config)`, in the format that the name's end selects.

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
    write = writer_of(path)
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
        streams.append(OutgoingStream(topic, "pose", pose.time, np.concatenate(parts, axis=1)))
    for role, source, pulls in (("tension", config.tension, tension), ("command", config.command, command)):
        if pulls is None:
            continue
        if source is None or np.shape(pulls.tension)[1:] != (len(source.order),):
            raise RecordingError(
                f"{path}: {role} of shape {np.shape(pulls.tension)}; the configuration has "
                f"{len(source.order) if source else 'no'} tendons there"
            )
        values = _sent(source, pulls.tension)
        streams.append(OutgoingStream(source.topic, role, pulls.time, values, source))  # type: ignore[arg-type]
    try:
        write(path, Outgoing(config, streams, start, delays or {}))
    except (OSError, sqlite3.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path}: cannot be written: {reason}") from None


def writer_of(path: Path) -> Any:
    """Return the writer of the format that a name's end selects. Raises `RecordingError` without one."""
    writers = {suffix: kind.write for kind in formats() for suffix in kind.written}
    if path.suffix not in writers:
        raise RecordingError(f"{path}: allowed is a name that ends in {', '.join(written_suffixes())}")
    return writers[path.suffix]


def _sent(source: TensionSource, newtons: Any) -> Any:
    """Return tensions (N), shape (n, tendons), in the unit and the order of a source's messages."""
    sent = np.asarray(newtons)[:, np.array(source.order) - 1] / TENSION_UNITS[source.unit]
    in_text = isinstance(source, CommandSource) and source.text is not None
    return np.round(sent) if in_text and source.unit == "gf" else sent


# single messages


class BagTopic(NamedTuple):
    """Topic of a ROS 1 bag with its message type, such as geometry_msgs/msg/PoseStamped."""

    name: str
    type: str


class Encoded(NamedTuple):
    """Encoded message of a topic."""

    topic: str
    data: bytes


class MessageEncoder:
    """Encoder of poses, tensions and commands (SI units) as ROS 1 messages of a configuration's topics.

    Args:
        config: topics, order and units of the messages.

    Raises:
        RecordingError: the configuration has motors in place of tensions.
        ImportError: rosbags is not installed.
    """

    def __init__(self, config: RecordingConfig):
        if config.motors is not None:
            raise RecordingError("motors cannot be recorded; required is a configuration with tensions")
        self.config = config
        #: names of the bodies, in the order of poses: the base, where there is one, then the markers
        self.bodies: tuple[str, ...] = tuple(marker.name for marker in config.markers)
        topics = [marker.topic for marker in config.markers]
        if config.base is not None:
            self.bodies, topics = ("base", *self.bodies), [config.base.topic, *topics]
        self._poses = [OutgoingStream(topic, "pose", [], np.zeros((0, 7))) for topic in topics]
        self._numbers = {
            role: OutgoingStream(source.topic, role, [], np.zeros((0, len(source.order))), source)  # type: ignore[arg-type]
            for role, source in (("tension", config.tension), ("command", config.command))
            if source is not None
        }
        streams = [*self._poses, *self._numbers.values()]
        self._encode = {stream.topic: encoder_of(stream, 1) for stream in streams}
        #: topics of all messages
        self.topics = [BagTopic(stream.topic, message_type(stream, 1)) for stream in streams]

    @property
    def command_topic(self) -> str | None:
        """Topic of commands; None without commands."""
        return self.config.command.topic if self.config.command else None

    def poses(
        self, stamp: int, position: Float[np.ndarray, "bodies 3"], quaternion: Float[np.ndarray, "bodies 4"]
    ) -> list[Encoded]:
        """Return the messages of all bodies with finite values: a lost body has no message.

        Args:
            stamp: time of the measurement (ns since 1970).
            position: positions (m), in the order of `bodies`.
            quaternion: orientations, scalar first.

        Raises:
            RecordingError: the number of bodies is wrong.
        """
        scale = POSITION_UNITS[self.config.position_unit]
        values = np.concatenate([np.asarray(position) / scale, np.asarray(quaternion)], axis=1)
        if values.shape != (len(self.bodies), 7):
            raise RecordingError(
                f"poses must be of {len(self.bodies)} bodies: {', '.join(self.bodies)} (got {len(values)})"
            )
        pairs = zip(self._poses, values, strict=True)
        return [self._message(stream, stamp, row) for stream, row in pairs if np.all(np.isfinite(row))]

    def tension(self, stamp: int, tension: Float[np.ndarray, " tendons"]) -> list[Encoded]:
        """Return the message of measured tensions (N).

        There is none if one is not finite, as without a measurement, or without a topic for tensions.

        Raises:
            RecordingError: the number of tensions is wrong.
        """
        return self._tensions("tension", stamp, tension) if np.all(np.isfinite(tension)) else []

    def command(self, stamp: int, tension: Float[np.ndarray, " tendons"]) -> list[Encoded]:
        """Return the message of commanded tensions (N); none if the configuration has no topic for it.

        Text commands in grams-force are rounded to whole numbers.

        Raises:
            RecordingError: the number of tensions is wrong, or one is not finite.
        """
        return self._tensions("command", stamp, tension)

    def simulation(self, stamp: int) -> list[Encoded]:
        """Return the line of the log on a simulated robot; none if commands are not text."""
        source, stream = self.config.command, self._numbers.get("command")
        if source is None or stream is None or source.text is None:
            return []
        return [self._message(stream, stamp, np.full(len(source.order), np.nan))]

    def _tensions(self, role: str, stamp: int, tension: Any) -> list[Encoded]:
        stream = self._numbers.get(role)
        if stream is None:
            return []
        values = np.asarray(tension, dtype=float)
        if values.shape != (len(stream.source.order),):
            raise RecordingError(
                f"topic {stream.topic} has {len(stream.source.order)} tendons (got tensions of shape "
                f"{values.shape})"
            )
        if not np.all(np.isfinite(values)):
            raise RecordingError(f"topic {stream.topic}: tensions must be finite (got {values.tolist()})")
        return [self._message(stream, stamp, _sent(stream.source, values[None])[0])]

    def _message(self, stream: OutgoingStream, stamp: int, values: Any) -> Encoded:
        return Encoded(stream.topic, self._encode[stream.topic](stamp, 0, values))
