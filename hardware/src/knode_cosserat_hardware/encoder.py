"""Encoder of single ROS 1 messages from a recording's configuration, for recorders and nodes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.messages import typestore
from knode_cosserat.recordings.sources import POSITION_UNITS, TensionSource
from knode_cosserat.recordings.write import WireStream, message_maker, message_type, sent_tensions


class BagTopic(NamedTuple):
    """Topic of a ROS 1 bag with its message type, such as geometry_msgs/msg/PoseStamped."""

    name: str
    type: str


class Encoded(NamedTuple):
    """Encoded message of a topic."""

    topic: str
    data: bytes


@dataclasses.dataclass(frozen=True, eq=False)
class _Coder:
    topic: BagTopic
    encode: Callable[[int, Any], Encoded]


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
        sources = [marker.topic for marker in config.markers]
        if config.base is not None:
            self.bodies, sources = ("base", *self.bodies), [config.base.topic, *sources]
        self._scale = POSITION_UNITS[config.position_unit]
        self._poses = [_coder(WireStream(topic, "pose", [], np.zeros((0, 7)))) for topic in sources]
        self._tension, self._command = (
            None if source is None else _coder(_numbers(role, source))
            for role, source in (("tension", config.tension), ("command", config.command))
        )

    @property
    def topics(self) -> list[BagTopic]:
        """Topics of all messages."""
        return [coder.topic for coder in (*self._poses, self._tension, self._command) if coder]

    @property
    def command_topic(self) -> str | None:
        """Topic of commands; None without commands."""
        return self._command.topic.name if self._command else None

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
        values = np.concatenate([np.asarray(position) / self._scale, np.asarray(quaternion)], axis=1)
        if values.shape != (len(self.bodies), 7):
            raise RecordingError(
                f"poses must be of {len(self.bodies)} bodies: {', '.join(self.bodies)} (got {len(values)})"
            )
        pairs = zip(self._poses, values, strict=True)
        return [coder.encode(stamp, row) for coder, row in pairs if np.all(np.isfinite(row))]

    def tension(self, stamp: int, tension: Float[np.ndarray, " tendons"]) -> list[Encoded]:
        """Return the message of measured tensions (N).

        There is none if one is not finite, as without a measurement, or without a topic for tensions.

        Raises:
            RecordingError: the number of tensions is wrong.
        """
        if not np.all(np.isfinite(tension)):
            return []
        return self._encoded(self._tension, self.config.tension, stamp, tension)

    def command(self, stamp: int, tension: Float[np.ndarray, " tendons"]) -> list[Encoded]:
        """Return the message of commanded tensions (N); none if the configuration has no topic for it.

        Text commands in grams-force are rounded to whole numbers.

        Raises:
            RecordingError: the number of tensions is wrong, or one is not finite.
        """
        return self._encoded(self._command, self.config.command, stamp, tension)

    def simulation(self, stamp: int) -> list[Encoded]:
        """Return the line of the log on a simulated robot; none if commands are not text."""
        source = self.config.command
        if self._command is None or source is None or source.text is None:
            return []
        return [self._command.encode(stamp, np.full(len(source.order), np.nan))]

    @staticmethod
    def _encoded(
        coder: _Coder | None, source: TensionSource | None, stamp: int, tension: Any
    ) -> list[Encoded]:
        if coder is None or source is None:
            return []
        values = np.asarray(tension, dtype=float)
        if values.shape != (len(source.order),):
            raise RecordingError(
                f"topic {source.topic} has {len(source.order)} tendons (got tensions of shape {values.shape})"
            )
        if not np.all(np.isfinite(values)):
            raise RecordingError(f"topic {source.topic}: tensions must be finite (got {values.tolist()})")
        return [coder.encode(stamp, sent_tensions(source, values[None])[0])]


def _numbers(role: str, source: TensionSource) -> WireStream:
    return WireStream(source.topic, role, [], np.zeros((0, len(source.order))), source)


def _coder(stream: WireStream) -> _Coder:
    kind, make, store = message_type(stream, 1), message_maker(stream, 1), typestore(1)

    def encode(stamp: int, values: Any) -> Encoded:
        return Encoded(stream.topic, bytes(store.serialize_ros1(make(stamp, 0, values), kind)))

    return _Coder(BagTopic(stream.topic, kind), encode)
