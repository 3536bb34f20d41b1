"""Types of a recording's quality report."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.recordings.findings import Finding


def period(time: Float[np.ndarray, " n"]) -> float:
    """Return the median time from row to row (s); zero for fewer than two rows."""
    return float(np.median(np.diff(time))) if len(time) > 1 else 0.0


@dataclasses.dataclass(frozen=True)
class StreamHealth:
    """Quality of one topic.

    Attributes:
        topic: name of the topic.
        what: the body's name, or "measured tensions", or "commands".
        rows: number of usable rows.
        rate: usual rate of rows (Hz); None for commands, which are irregular.
        jitter: standard deviation of the time from row to row, without gaps (s); None for commands.
        missing: fraction of missing rows; None for commands.
        gaps: number of gaps; None for commands.
        longest_gap: longest time from row to row (s).
        delay: median delay from stamp to recording (s); None without stamps.
        noise: standard deviation of a coordinate (m), or of a tension (N); None if it cannot be estimated.
        turn_noise: standard deviation of orientation about an axis (rad); None without orientations.
    """

    topic: str
    what: str
    rows: int
    rate: float | None
    jitter: float | None
    missing: float | None
    gaps: int | None
    longest_gap: float
    delay: float | None
    noise: float | None
    turn_noise: float | None


@dataclasses.dataclass(frozen=True)
class Latency:
    """Latency of tensions after commands.

    Attributes:
        shift: delay of commands that fits the measured tensions best (s).
        delay: dead time of a fitted model with dead time and first-order lag (s).
        lag: time constant of that lag (s).
    """

    shift: float
    delay: float
    lag: float

    @property
    def total(self) -> float:
        """Mean delay of a change of commands: dead time plus lag (s)."""
        return self.delay + self.lag


@dataclasses.dataclass(frozen=True)
class TensionError:
    """Measured minus commanded tension of one tendon (N), with commands delayed by their latency."""

    tendon: int
    bias: float
    rms: float


@dataclasses.dataclass(frozen=True)
class Health:
    """Quality report of a recording.

    Attributes:
        source: description of the recording.
        simulated: True if the robot was a simulation; None: not stated.
        duration: time from the start for which all poses and tensions are known (s).
        rest: interval in which the robot rests (s), or None.
        rod_length: estimates (m) from each body away from the clamped end, at rest; none from bodies that
            lean by more than 10 degrees, and none without a rest.
        streams: quality of each topic.
        latency: latency of tensions after commands, or None if it cannot be estimated.
        tension_errors: errors of each tendon; empty without both tensions.
        findings: errors and repairs, the gravest first.
    """

    source: str
    simulated: bool | None
    duration: float
    rest: tuple[float, float] | None
    rod_length: tuple[float, ...]
    streams: tuple[StreamHealth, ...]
    latency: Latency | None
    tension_errors: tuple[TensionError, ...]
    findings: tuple[Finding, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain values for JSON."""
        return dataclasses.asdict(self)
