"""Recordings to be written: numbers by topic, in the units and the order of their messages or columns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from knode_cosserat.recordings.config import RecordingConfig


class OutgoingStream(NamedTuple):
    """Numbers of a topic to be written.

    Attributes:
        topic: name of the topic.
        role: role of the numbers.
        time: times (s).
        values: poses (position, and quaternion if known), tensions or commands.
        source: the topic's entry in the configuration; None for poses.
    """

    topic: str
    role: Literal["pose", "tension", "command"]
    time: Any
    values: Any
    source: Any = None


class Outgoing(NamedTuple):
    """Recording to be written.

    Attributes:
        config: configuration of its topics.
        streams: numbers of the topics.
        start: time zero on a bag's clock (s since 1970); tables begin at zero.
        delays: delay from stamp to recording (s) by topic; zero by default.
    """

    config: RecordingConfig
    streams: list[OutgoingStream]
    start: int
    delays: Mapping[str, float]
