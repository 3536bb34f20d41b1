"""Writing of recordings, in every format that has a writer, from the configuration that reads them back."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from knode_cosserat.recordings.config import ControlSource, RecordingConfig
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.formats import formats, written_suffixes
from knode_cosserat.recordings.streams import Body, ControlRows, Outgoing, OutgoingStream

#: default of time zero on the clock of a bag (s since 1970)
START = 1_720_000_000


def write_recording(
    path: str | Path,
    config: RecordingConfig,
    poses: Mapping[str, Body],
    control: ControlRows | None = None,
    command: ControlRows | None = None,
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
        control: measured numbers that drive the robot, in SI units and in the order of `config.measured`.
        command: commanded ones.
        start: time zero on the bag's clock (s since 1970); tables begin at zero.
        delays: delay from stamp to recording (s) by topic; zero by default.

    Raises:
        RecordingError: the format is unknown, data are missing, or the file cannot be written.
        ImportError: the library for this format is not installed.
    """
    path = Path(path)
    write = writer_of(path)
    topics = {marker.name: marker.topic for marker in config.markers}
    if config.base is not None:
        topics["base"] = config.base.topic
    if set(poses) != set(topics):
        raise RecordingError(f"{path}: poses are given of {sorted(poses)}; required is {sorted(topics)}")
    scale = config.position_factor
    streams = []
    for name, topic in topics.items():
        pose = poses[name]
        parts = [np.asarray(pose.position) / scale]
        if pose.quaternion is not None:
            parts.append(np.asarray(pose.quaternion))
        streams.append(OutgoingStream(topic, "pose", pose.time, np.concatenate(parts, axis=1)))
    sent = (config.command,) if config.command else ()
    for role, sources, rows in (("control", config.measured, control), ("command", sent, command)):
        if rows is None:
            continue
        counts = [len(source.order) for source in sources]
        if np.shape(rows.values)[1:] != (sum(counts),):
            raise RecordingError(
                f"{path}: {role} of shape {np.shape(rows.values)}; the configuration has "
                f"{sum(counts) or 'no'} numbers there"
            )
        parts = np.split(rows.values, np.cumsum(counts)[:-1], axis=1)
        streams += [
            OutgoingStream(source.topic, role, rows.time, sent_numbers(source, part), source)  # type: ignore[arg-type]
            for source, part in zip(sources, parts, strict=True)
        ]
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


def sent_numbers(source: ControlSource, values: Any) -> Any:
    """Return numbers in SI units, shape (n, c), in the unit and the order of a source's messages."""
    sent = np.asarray(values)[:, np.array(source.order) - 1] / source.factor
    return np.round(sent) if source.text is not None and source.unit == "gf" else sent
