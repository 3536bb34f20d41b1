"""Writing of recordings, in every format that has a writer, from the configuration that reads them back."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from knode_cosserat.recordings.config import POSITION_UNITS, CommandSource, RecordingConfig, TensionSource
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.formats import formats, written_suffixes
from knode_cosserat.recordings.streams import Body, Outgoing, OutgoingStream, Tensions

#: default of time zero on the clock of a bag (s since 1970)
START = 1_720_000_000


def write_recording(
    path: str | Path,
    config: RecordingConfig,
    poses: Mapping[str, Body],
    tension: Tensions | None = None,
    command: Tensions | None = None,
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
        values = sent_tensions(source, pulls.tension)
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


def sent_tensions(source: TensionSource, newtons: Any) -> Any:
    """Return tensions (N), shape (n, tendons), in the unit and the order of a source's messages."""
    sent = np.asarray(newtons)[:, np.array(source.order) - 1] / source.factor
    in_text = isinstance(source, CommandSource) and source.text is not None
    return np.round(sent) if in_text and source.unit == "gf" else sent
