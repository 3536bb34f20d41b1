"""Assembly of raw streams into a recording: one clock, cleaned, in the robot's frame."""

from __future__ import annotations

import numpy as np

from knode_cosserat.recordings import clocks
from knode_cosserat.recordings.cleaned import cleaned_poses, cleaned_tensions
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.findings import SEVERITIES, Finding, RecordingError
from knode_cosserat.recordings.frame import bodies_in_robot_frame
from knode_cosserat.recordings.messages import Stream
from knode_cosserat.recordings.plausibility import implausible_times, implausible_units
from knode_cosserat.recordings.recording import Recording


def assembled(
    path: str, name: str, config: RecordingConfig, found: dict[str, Stream], findings: list[Finding]
) -> Recording:
    """Return the recording assembled from raw streams.

    Args:
        path: the file's name in error messages.
        name: name of the recording.
        config: meaning of the topics or columns.
        found: raw streams by topic.
        findings: findings from reading the file.

    Raises:
        RecordingError: a required stream has no usable data.
    """
    for stream in found.values():
        findings.extend(stream.remarks)
        if stream.broken:
            what = f"{stream.broken} messages could not be understood, and are left out"
            findings.append(Finding("warning", stream.topic, what))
    times, about_clocks = clocks.measurement_times(list(found.values()), config.clock)
    rows = {}
    for topic in found:
        rows[topic], about_order = clocks.ordered(topic, times[topic])
        about_clocks += about_order
    zero = _zero(config, times, rows)
    if zero is None:
        raise RecordingError(f"{path}: no poses and no tensions in this recording")
    seconds = {topic: np.round((times[topic][rows[topic]] - zero) * 1e-9, 9) for topic in found}
    findings += [
        Finding(each.severity, each.topic, each.message, tuple((t - zero) * 1e-9 for t in each.times))
        for each in about_clocks
    ]
    values = {topic: stream.values[rows[topic]] for topic, stream in found.items()}

    poses, about_poses = cleaned_poses(config, seconds, values, path)
    *bodies, base = poses
    tension, command, about_tensions = cleaned_tensions(config, seconds, values, path)
    assert all(body is not None for body in bodies)
    in_frame, base, rest, about_frame = bodies_in_robot_frame(
        [body for body in bodies if body is not None], base, config
    )
    findings += about_poses + about_tensions + about_frame
    findings += implausible_units(in_frame, None if config.motors else tension, command, rest)
    if not config.static:
        findings += implausible_times(in_frame)
    if config.simulated:
        findings.append(Finding("note", "", "the robot was itself a simulation, and not a physical one"))
    description = f"{name}: {config.description}" if config.description else name
    return Recording(
        source=description,
        config=config,
        bodies=tuple(in_frame),
        base=base,
        tension=tension,
        command=command,
        rest=rest,
        simulated=config.simulated,
        findings=tuple(sorted(findings, key=lambda each: SEVERITIES.index(each.severity))),
        delays=clocks.offsets(list(found.values())),
    )


def _zero(
    config: RecordingConfig, times: dict[str, np.ndarray], rows: dict[str, np.ndarray]
) -> np.int64 | None:
    """Return the time of the first pose or measured tension (ns); commands may start much earlier."""
    later = {config.command.topic} if config.command is not None and config.measured is not None else set()
    first = [times[topic][kept[0]] for topic, kept in rows.items() if len(kept) and topic not in later]
    return np.int64(min(first)) if first else None
