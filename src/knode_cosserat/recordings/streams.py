"""Raw numbers of a recording by topic, read or to be written, and their times on one clock."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from knode_cosserat._reprs import count_of
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.recordings.config import ControlSource, RecordingConfig
from knode_cosserat.recordings.findings import Finding, RecordingError, Severity, counted
from knode_cosserat.recordings.quantities import counted_quantities

#: largest disagreement of equal clocks, and smallest jump of a clock (s)
DISAGREEMENT = 0.5
JUMP = 0.1
#: smallest implausible time between poses (s): motion capture at 1 to 1,000 Hz whose times are in ms
SLOW = 1.0
#: messages separated from the largest group by a longer pause do not belong to the recording (s)
FAR = 600.0
#: smallest drift of a clock against another (s), and smallest number of stamps that show one
DRIFT, FEWEST_STAMPS = 0.01, 20


def period(time: Float[np.ndarray, " n"]) -> float:
    """Return the median time from row to row (s); zero for fewer than two rows."""
    return float(np.median(np.diff(time))) if len(time) > 1 else 0.0


@dataclasses.dataclass(frozen=True, eq=False)
class Stream:
    """Numbers of one topic, in the units and the order of its messages or columns.

    Attributes:
        stamped: measurement times (ns); -1 without a stamp.
        received: recording times (ns).
        values: poses (position and, if known, quaternion, scalar first) or controls.
        broken: number of messages that could not be decoded.
        remarks: findings on the order of its numbers.
    """

    topic: str
    stamped: Int[np.ndarray, " n"]
    received: Int[np.ndarray, " n"]
    values: Float[np.ndarray, "n size"]
    broken: int = 0
    remarks: tuple[Finding, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """Poses of a body from motion capture, at the times of its frames.

    To be written, they are in motion capture's frame and with the body's own axes. In a `Recording` they are
    in the robot's frame, orientations are those of the rod's local frame, and times begin with the recording.

    Attributes:
        time: times, increasing (s).
        position: positions (m).
        quaternion: orientations, scalar first; None if unknown.
        name: name in reports.
        topic: topic of its poses.
        fraction: its place on the rod, as a fraction of the length; NaN for the base.
    """

    time: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]
    quaternion: Float[np.ndarray, "n 4"] | None = None
    name: str = ""
    topic: str = ""
    fraction: float = float("nan")

    def __repr__(self) -> str:
        return f"Body {self.name} at {self.fraction:.4g} of the length: {count_of(len(self.time), 'pose')}"


@dataclasses.dataclass(frozen=True, eq=False)
class Sensor:
    """Sensor beside motion capture: times (s), values in SI units (NaN: none), and the output it measures."""

    time: Float[np.ndarray, " n"]
    values: Float[np.ndarray, "n p"]
    output: Output
    topic: str

    def __repr__(self) -> str:
        return f"Sensor {self.topic}: {count_of(len(self.time), 'row')}"


@dataclasses.dataclass(frozen=True, eq=False)
class ControlRows:
    """Numbers that drive a robot: times (s), and values in SI units, in the order of the configuration.

    `quantities` are names of `recordings.quantities`, each with the count of its columns.
    """

    time: Float[np.ndarray, " n"]
    values: Float[np.ndarray, "n c"]
    topic: str = ""
    quantities: tuple[tuple[str, int], ...] = ()

    def __repr__(self) -> str:
        what = counted_quantities(self.quantities)
        return f"ControlRows of {what} (topic {self.topic}): {count_of(len(self.time), 'row')}"


def merged(parts: Sequence[ControlRows], sources: Sequence[ControlSource]) -> ControlRows:
    """Return several quantities as one stream, at the times of the one with most rows.

    Held values have their last value there, others are interpolated linearly; rows beyond the first or last
    one of another stream are left out.
    """
    longest = max(parts, key=lambda part: len(part.time))
    time = longest.time
    if len(parts) > 1:
        time = time[
            (time >= max(part.time[0] for part in parts)) & (time <= min(part.time[-1] for part in parts))
        ]
    columns = []
    for part, source in zip(parts, sources, strict=True):
        if source.held:
            columns.append(part.values[np.searchsorted(part.time, time, side="right") - 1])
        else:
            columns.append(np.stack([np.interp(time, part.time, column) for column in part.values.T], axis=1))
    if not len(time):
        topics = " and ".join(part.topic for part in parts)
        raise RecordingError(f"{topics} have no time in common; required is one clock")
    quantities = tuple(count for part in parts for count in part.quantities)
    values = longest.values if len(parts) == 1 else np.concatenate(columns, axis=1)
    return ControlRows(time, values, "+".join(part.topic for part in parts), quantities)


class OutgoingStream(NamedTuple):
    """Numbers of a topic to be written: times (s), and poses, controls or commands.

    `source` is the topic's entry in the configuration; None for poses.
    """

    topic: str
    role: Literal["pose", "control", "command"]
    time: Any
    values: Any
    source: Any = None


class Outgoing(NamedTuple):
    """Recording to be written.

    `start` is time zero on a bag's clock (s since 1970); tables begin at zero. `delays` are from stamp to
    recording (s) by topic, zero by default.
    """

    config: RecordingConfig
    streams: list[OutgoingStream]
    start: int
    delays: Mapping[str, float]


def offsets(streams: Sequence[Stream]) -> dict[str, float]:
    """Return the median delay from stamp to recording (s) by topic; NaN without stamps."""
    return {stream.topic: _offset(stream) for stream in streams}


def _offset(stream: Stream) -> float:
    known = stream.stamped >= 0
    if not known.any():
        return float("nan")
    return float(np.median((stream.received - stream.stamped)[known])) * 1e-9


@dataclasses.dataclass
class Rows:
    """Rows of a topic, times (s) and numbers, from which errors are removed with findings on them."""

    topic: str
    time: Float[np.ndarray, " n"]
    values: Float[np.ndarray, "n size"]
    findings: list[Finding]

    def add(self, message: str, severity: Severity, rows: Bool[np.ndarray, " n"]) -> None:
        """Add a finding on rows."""
        self.findings.append(Finding(severity, self.topic, message, tuple(self.time[rows][:1000].tolist())))

    def keep(self, mask: Bool[np.ndarray, " n"]) -> None:
        """Remove the rows that are not in a mask."""
        self.time, self.values = self.time[mask], self.values[mask]


def rows_on_one_clock(
    streams: Mapping[str, Stream], config: RecordingConfig, findings: list[Finding]
) -> dict[str, Rows]:
    """Return the rows of each topic, by increasing times from the first pose or control, and add findings.

    Raises:
        RecordingError: there are no poses and no measured controls.
    """
    rows = rows_from_zero(streams, config, findings)[1]
    if not rows:
        raise RecordingError("no poses and no controls in this recording")
    return rows


def rows_from_zero(
    streams: Mapping[str, Stream], config: RecordingConfig, findings: list[Finding]
) -> tuple[int, dict[str, Rows]]:
    """Return the time of the first pose or control (ns), and the rows of each topic from there, if any."""
    for stream in streams.values():
        findings += stream.remarks
        if stream.broken:
            what = f"{stream.broken} messages could not be understood, and are left out"
            findings.append(Finding("warning", stream.topic, what))
    clocks: list[Finding] = []
    times = _measurement_times(list(streams.values()), config.clock, clocks)
    kept = {topic: _ordered(topic, times[topic], clocks) for topic in streams}
    # commands may start much earlier than anything is measured
    command = config.command.topic if config.command is not None and config.measured else None
    begins = {topic: times[topic][rows[0]] for topic, rows in kept.items() if len(rows)}
    zero = min((at for topic, at in begins.items() if topic != command or len(begins) == 1), default=None)
    if zero is None:
        return 0, {}
    for finding in clocks:
        seconds = tuple((time - zero) * 1e-9 for time in finding.times)
        findings.append(dataclasses.replace(finding, times=seconds))
    return int(zero), {
        topic: Rows(
            topic, np.round((times[topic][rows] - zero) * 1e-9, 9), streams[topic].values[rows], findings
        )
        for topic, rows in kept.items()
    }


def _measurement_times(
    streams: Sequence[Stream], clock: str, findings: list[Finding]
) -> dict[str, Int[np.ndarray, " n"]]:
    """Return the measurement times (ns) by topic, on the better of the two clocks, and add findings."""
    late = offsets(streams)
    known = [delay for delay in late.values() if np.isfinite(delay)]
    one_clock = not known or max(known) - min(known) <= DISAGREEMENT
    times = {}
    for stream in streams:
        times[stream.topic] = stream.received
        if clock == "received" or len(stream.received) == 0:
            continue
        # times of tables may be negative
        if np.any(stream.stamped < 0) and not np.array_equal(stream.stamped, stream.received):
            what = "messages have no stamps of their own; the times of recording are used"
            findings.append(Finding("note", stream.topic, what))
        elif not one_clock and abs(late[stream.topic]) > DISAGREEMENT:
            behind = "behind" if late[stream.topic] > 0 else "before"
            what = (
                f"the clock of its stamps is {abs(late[stream.topic]):.3f} s {behind} the recorder's, "
                "and others' are not; the times of recording are used"
            )
            findings.append(Finding("warning", stream.topic, what))
        else:
            times[stream.topic] = _without_jumps(stream, findings)
    _add_drift(streams, times, findings)
    return times


def _add_drift(
    streams: Sequence[Stream], times: Mapping[str, Int[np.ndarray, " n"]], findings: list[Finding]
) -> None:
    """Add a finding on the topic whose clock drifts most against the others'."""
    drifts: dict[str, float] = {}
    noise = 0.0
    for stream in streams:
        delay = (stream.received - times[stream.topic]) * 1e-9
        if len(delay) >= FEWEST_STAMPS:
            fifth = len(delay) // 5
            drifts[stream.topic] = float(np.median(delay[-fifth:]) - np.median(delay[:fifth]))
            noise = max(noise, float(np.median(np.abs(delay[:fifth] - np.median(delay[:fifth])))))
    if not drifts or max(drifts.values()) - min(drifts.values()) <= max(DRIFT, 3.0 * noise):
        return
    usual = float(np.median(list(drifts.values())))
    topic = max(drifts, key=lambda name: abs(drifts[name] - usual))
    off = max(abs(drifts[topic] - drift) for drift in drifts.values())
    what = (
        f"its clock drifts by {1e3 * off:.0f} ms against the others' during the recording; "
        "`clock: received` in the configuration takes the times of recording"
    )
    findings.append(Finding("warning", topic, what))


def _without_jumps(stream: Stream, findings: list[Finding]) -> Int[np.ndarray, " n"]:
    """Return the stamps; if their clock jumped, recording times less the median delay, and a finding."""
    stamps, received = np.diff(stream.stamped) * 1e-9, np.diff(stream.received) * 1e-9
    usual = np.median(stamps) if len(stamps) else 0.0
    # the clock whose step differs more from the usual step has jumped
    odd = (np.abs(stamps - received) > JUMP) & (np.abs(stamps - usual) > np.abs(received - usual))
    # a jump and back: a message out of order, or a damaged stamp
    odd[1:] &= ~odd[:-1]
    drift = (stream.stamped - stream.received) * 1e-9
    stays = []
    for row in np.flatnonzero(odd):
        # the offset between stamps and recording times stays changed for several rows
        before, after = drift[max(0, row - 4) : row + 1], drift[row + 1 : row + 6]
        if len(after) >= 3 and abs(float(np.median(after) - np.median(before))) > JUMP:
            stays.append(int(row))
    if not stays:
        return stream.stamped
    sizes = ", ".join(f"{stamps[row] - received[row]:+.3f} s" for row in stays[:3])
    more = f" and {len(stays) - 3} more" if len(stays) > 3 else ""
    when = tuple(float(stream.received[row + 1]) for row in stays)
    delay = np.int64(np.median((stream.received - stream.stamped)[: stays[0] + 1]))
    what = f"the clock of its stamps jumped ({sizes}{more}); the times of recording are used"
    findings.append(Finding("warning", stream.topic, what, when))
    return stream.received - delay


def _ordered(topic: str, time: Int[np.ndarray, " n"], findings: list[Finding]) -> Int[np.ndarray, " kept"]:
    """Return the indices of the rows to keep, in order of increasing time, and add findings."""
    order = np.argsort(time, kind="stable")
    backwards = np.diff(time) < 0
    if backwards.any():
        count = "once" if backwards.sum() == 1 else f"{backwards.sum()} times"
        what = f"{count} a stamp is before the one in front of it; the messages were sorted"
        findings.append(Finding("warning", topic, what, tuple(map(float, time[1:][backwards][:100]))))
    rising = time[order]
    fresh = np.concatenate([np.ones(len(order[:1]), dtype=bool), np.diff(rising) > 0])
    if not fresh.all():
        stamps = counted(int((~fresh).sum()), "stamp is", "stamps are")
        what = f"{stamps} there twice; the first of each was kept"
        findings.append(Finding("warning", topic, what, tuple(map(float, rising[~fresh][:100]))))
    order = order[fresh]
    # the largest group without a long pause
    group = np.concatenate([np.zeros(len(order[:1]), dtype=int), np.cumsum(np.diff(time[order]) > FAR * 1e9)])
    near = np.asarray(group == np.argmax(np.bincount(group, minlength=1)))
    if not near.all():
        messages = counted(int((~near).sum()), "message is", "messages are")
        what = f"{messages} more than {FAR:g} s from the others, and left out"
        findings.append(Finding("warning", topic, what))
    return order[near]
