"""Removal of errors from streams of poses and tensions, with findings on each removal."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.recordings import cleaning
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.findings import Finding, RecordingError, Severity
from knode_cosserat.recordings.plausibility import implausible_tensions
from knode_cosserat.recordings.quality import period
from knode_cosserat.recordings.recording import Body, Tensions, bridge
from knode_cosserat.recordings.sources import (
    MOTOR_UNITS,
    POSITION_UNITS,
    TENSION_UNITS,
    MotorSource,
    TensionSource,
)

#: smallest jumps that are removed (m, rad, N)
SMALLEST_SHIFT, SMALLEST_TURN, SMALLEST_PULL = 5e-3, np.radians(8.0), 0.5
#: longest spike of a load cell (s): spikes last one or two messages, a longer change can be a command
LONGEST_SPIKE = 0.04
#: smallest number of frames of a body
FEWEST_FRAMES = 2

_UNITS = {**TENSION_UNITS, **MOTOR_UNITS}

Seconds = Mapping[str, Float[np.ndarray, " n"]]
Values = Mapping[str, Float[np.ndarray, "n size"]]


def cleaned_poses(
    config: RecordingConfig, seconds: Seconds, values: Values, path: str
) -> tuple[list[Body | None], list[Finding]]:
    """Return the bodies in the order of the configuration, then the base or None, and the findings.

    Poses are in the recording's own frame.

    Raises:
        RecordingError: a body has fewer than two usable frames.
    """
    bodies: list[Body | None] = []
    findings: list[Finding] = []
    for marker in config.markers:
        body, found = _body(config, marker.name, marker.topic, marker.fraction, seconds, values, path)
        bodies.append(body)
        findings += found
    if config.base is None:
        return [*bodies, None], findings
    base, found = _body(config, "base", config.base.topic, float("nan"), seconds, values, path)
    return [*bodies, base], findings + found


def _body(
    config: RecordingConfig,
    name: str,
    topic: str,
    fraction: float,
    seconds: Seconds,
    values: Values,
    path: str,
) -> tuple[Body, list[Finding]]:
    time, pose = seconds[topic], values[topic]
    findings: list[Finding] = []
    good = _usable(pose)
    if pose.shape[1] == 7:
        # some drivers send a zero quaternion while the body is not seen
        good[good] &= np.abs(np.linalg.norm(pose[good, 3:], axis=1) - 1.0) < 0.05
    _drop(findings, topic, time[~good], "pose is", "poses are", "not finite, or no rotation", "warning")
    time, pose = time[good], pose[good]
    if config.repeats == "drop":
        again = np.concatenate([[False], np.all(np.diff(pose, axis=0) == 0.0, axis=1)])[: len(time)]
        _drop(findings, topic, time[again], "pose repeats", "poses repeat", "the one before", "note")
        time, pose = time[~again], pose[~again]
    if len(time) < FEWEST_FRAMES:
        raise RecordingError(
            f"{path}: topic {topic}: {len(time)} usable poses of {name}; required is {FEWEST_FRAMES} or more"
        )
    if pose.shape[1] == 7:
        pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
        pose[:, 3:], swaps, unclear = cleaning.swaps_undone(time, pose[:, 3:])
        for swap in swaps:
            when = float(time[swap.row])
            what = f"its axes were swapped at {when:.3f} s, by {swap.angle:.0f} degrees about {swap.axis}"
            what += "; undone"
            findings.append(Finding("warning", topic, what, (when,)))
    wrong = np.zeros(len(time), dtype=bool) if config.static else _jumping(time, pose, config)
    if pose.shape[1] == 7:
        left = [row for row in unclear if not wrong[row - 1 : row + 1].any()]
        if left:
            turns = _count(len(left), "turn", "turns")
            what = f"{turns} too large for a motion, and no swap of axes; left as seen"
            findings.append(Finding("warning", topic, what, tuple(time[left].tolist())))
    _drop(findings, topic, time[wrong], "pose jumps", "poses jump", "out of the motion and back", "note")
    time, pose = time[~wrong], pose[~wrong]
    quaternion = pose[:, 3:] if pose.shape[1] == 7 else None
    findings += _pauses(topic, time, config.longest_gap)
    return Body(name, topic, fraction, time, pose[:, :3], quaternion), findings


def _jumping(
    time: Float[np.ndarray, " n"], pose: Float[np.ndarray, "n size"], config: RecordingConfig
) -> Bool[np.ndarray, " n"]:
    # as many rows as can be bridged, but not most of the filter's window
    usual = float(np.median(np.diff(time))) or 1.0
    longest = int(np.clip(config.longest_gap / usual, 1, 4))
    floor = SMALLEST_SHIFT / POSITION_UNITS[config.position_unit]
    steps = cleaning.position_steps(pose[:, :3])
    wrong = cleaning.outliers(steps, time, floor=floor, longest=longest)
    if pose.shape[1] == 7:
        turns = cleaning.rotation_steps(pose[:, 3:])
        wrong |= cleaning.outliers(turns, time, floor=SMALLEST_TURN, longest=longest)
    return wrong


def cleaned_tensions(
    config: RecordingConfig, seconds: Seconds, values: Values, path: str
) -> tuple[Tensions | None, Tensions | None, list[Finding]]:
    """Return measured and commanded tensions (N, tendon 1 first; None if absent), and the findings.

    Raises:
        RecordingError: messages have another number of tendons, or required tensions have no usable row.
    """
    findings: list[Finding] = []
    both: list[Tensions | None] = []
    for kind, source in (("measured", config.measured), ("commanded", config.command)):
        if source is None or source.topic not in seconds:
            both.append(None)
            continue
        found = _tensions(source, seconds[source.topic], values[source.topic], findings, path, kind)
        if found is None and config.tensions == kind:
            raise RecordingError(f"{path}: topic {source.topic}: no usable {kind} tension")
        if found is not None and kind == "measured":
            findings += _pauses(source.topic, found.time, config.longest_gap)
        both.append(found)
    return both[0], both[1], findings


def _tensions(
    source: TensionSource | MotorSource, time: np.ndarray, sent: np.ndarray, findings: list[Finding],
    path: str, kind: str,
) -> Tensions | None:  # fmt: skip
    if len(sent) == 0:
        findings.append(Finding("warning", source.topic, f"there are no {kind} tensions"))
        return None
    if sent.shape[1] != len(source.order):
        raise RecordingError(
            f"{path}: topic {source.topic}: a message has {sent.shape[1]} tensions; "
            f"the configuration's order has {len(source.order)} tendons"
        )
    newtons = sent[:, np.argsort(source.order)] * _UNITS[source.unit]
    good = _usable(newtons)
    _drop(findings, source.topic, time[~good], "tension is", "tensions are", "not finite", "warning")
    time, newtons = time[good], newtons[good]
    measured = kind == "measured" and isinstance(source, TensionSource) and not source.held
    if isinstance(source, TensionSource):
        wrong = implausible_tensions(newtons)
        _about_implausible(findings, source.topic, time, newtons, wrong, "left out" if measured else "kept")
        if measured:
            time, newtons = time[~wrong], newtons[~wrong]
    if measured and 0.0 < period(time) <= LONGEST_SPIKE:
        spikes = np.zeros(len(time), dtype=bool)
        longest = min(2, int(LONGEST_SPIKE / period(time)))
        for tendon in newtons.T:
            steps = np.diff(tendon)[:, None]
            spikes |= cleaning.outliers(steps, time, floor=SMALLEST_PULL, longest=longest)
        _drop(
            findings,
            source.topic,
            time[spikes],
            "tension jumps",
            "tensions jump",
            "up or down and back",
            "note",
        )
        time, newtons = time[~spikes], newtons[~spikes]
    return Tensions(source.topic, time, newtons) if len(time) else None


def _about_implausible(
    findings: list[Finding], topic: str, time: np.ndarray, newtons: np.ndarray, wrong: np.ndarray, fate: str
) -> None:
    """Add a finding on implausible tensions; held ones are kept, because they last until the next row."""
    if not wrong.any():
        return
    usual, worst = float(np.median(np.abs(newtons))), newtons[wrong].ravel()
    most = float(worst[np.argmax(np.abs(worst))])
    what = (
        f"{_count(int(wrong.sum()), 'row has', 'rows have')} a tension that is not plausible, {most:.4g} N "
        f"among tensions of {usual:.3g} N; {fate}"
    )
    severity: Severity = "warning" if fate == "left out" else "problem"
    findings.append(Finding(severity, topic, what, tuple(time[wrong][:1000].tolist())))


def _drop(
    findings: list[Finding],
    topic: str,
    times: np.ndarray,
    one: str,
    several: str,
    why: str,
    severity: Severity,
) -> None:
    if len(times):
        what = f"{_count(len(times), one, several)} {why}; left out"
        findings.append(Finding(severity, topic, what, tuple(times[:1000].tolist())))


def _usable(rows: Float[np.ndarray, "n size"]) -> Bool[np.ndarray, " n"]:
    """Return a mask of the rows with finite numbers of a plausible size."""
    return np.asarray(np.all(np.abs(np.nan_to_num(rows, nan=np.inf)) < 1e9, axis=1))


def _pauses(topic: str, time: np.ndarray, longest: float) -> list[Finding]:
    """Return findings on pauses that are too long to be bridged."""
    steps = np.diff(time)
    long = steps > bridge(time, longest)
    if not long.any():
        return []
    where = time[:-1][long]
    listed = ", ".join(
        f"{a:.2f} to {a + step:.2f} s" for a, step in zip(where[:3], steps[long][:3], strict=True)
    )
    more = f" and {int(long.sum()) - 3} more" if long.sum() > 3 else ""
    pauses = _count(int(long.sum()), "pause", "pauses")
    what = f"{pauses} too long to be bridged ({listed}{more}): the recording is in parts"
    return [Finding("warning", topic, what, tuple(where.tolist()))]


def _count(count: int, one: str, several: str) -> str:
    return f"{count} {one if count == 1 else several}"
