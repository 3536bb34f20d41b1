"""Recordings: what sensors saw, each at its own rate, cleaned, in SI units and in the robot's frame."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.measurements import Measurements

if TYPE_CHECKING:
    from knode_cosserat.recordings.health import Health

#: more rows than this are a mistake, and not a recording
MOST_ROWS = 10_000_000
#: stamps are exact to a microsecond at best
_SAME = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """Poses of a body that motion capture saw, at the times of its frames.

    Attributes:
        name: what reports call it.
        topic: where it was recorded.
        fraction: where it sits on the rod; NaN for the base.
        time: from the recording's start, rising (s).
        position: in the robot's frame (m).
        quaternion: of the rod's frame there, scalar first; None if it is not known.
    """

    name: str
    topic: str
    fraction: float
    time: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]
    quaternion: Float[np.ndarray, "n 4"] | None


@dataclasses.dataclass(frozen=True, eq=False)
class Tensions:
    """Tensions of all tendons (N), tendon 1 first, at the times of their messages (s)."""

    topic: str
    time: Float[np.ndarray, " n"]
    tension: Float[np.ndarray, "n tendons"]


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """A recording as `load_recording` reads it.

    Times are seconds from the first pose or tension on. Positions are in the robot's frame: z up, origin at
    the clamped end. Frames that were lost are not there; `sampled` bridges them.

    Attributes:
        source: what the recording is and where it comes from.
        config: what it was read by.
        bodies: on the rod, from base to tip.
        base: the body that tells where the clamped end is, or None.
        tension: as measured, or None.
        command: as commanded, or None.
        rest: from when to when the robot rests (s), or None if it never does.
        simulated: whether the robot was itself a simulation; None: not stated.
        findings: what was wrong or mended, the gravest first.
        delays: by topic, how long after its stamp a message was recorded (s, the median); NaN without stamps.
    """

    source: str
    config: RecordingConfig
    bodies: tuple[Body, ...]
    base: Body | None
    tension: Tensions | None
    command: Tensions | None
    rest: tuple[float, float] | None
    simulated: bool | None
    findings: tuple[Finding, ...]
    delays: Mapping[str, float]

    @property
    def tendons(self) -> int:
        """How many tendons there are."""
        return self.config.tendons

    @property
    def end(self) -> float:
        """When the first of the poses and tensions ends, and so everything is known (s)."""
        driver = self._driver(self.config.tensions)
        ends = [body.time[-1] for body in self.bodies]
        # a command holds until the next
        return float(min([*ends, driver.time[-1]] if driver is self.tension else ends))

    def sampled(
        self,
        dt: float = 0.05,
        start: float | None = None,
        end: float | None = None,
        tensions: Literal["measured", "commanded"] | None = None,
        *,
        mean: bool = False,
    ) -> Measurements:
        """The measurements at the times `start`, `start + dt` and so on, up to `end` (s).

        Tensions are the last ones at or before a row's time (zero-order hold), commanded ones as of their
        latency before. Poses are interpolated: positions by cubic splines, orientations on the shortest way.
        A pause between frames is bridged up to the configuration's `longest_gap`, or to one and a half of the
        stream's usual period if that is longer; rows in a longer one are NaN.

        Args:
            dt: from row to row (s).
            start: the first row; None: where the configuration's `trim` begins, or the recording.
            end: the last row at most; None: where the `trim` or the first stream ends.
            tensions: which ones; None: what the configuration says.
            mean: tensions are means from each row to the next instead, of measured ones on the lines between
                messages: what a simulation with a fine time step should be driven by. Rows that reach into a
                pause that is not bridged are NaN.

        Raises:
            RecordingError: there are no such tensions or no such rows.
        """
        driver = self._driver(tensions or self.config.tensions)
        time = self._grid(dt, start, end)
        bridged = self.config.longest_gap
        latency = 0.0
        if driver is self.command and self.config.command is not None:
            latency = self.config.command.latency
        longest = bridged if driver is self.tension else math.inf
        held = _held(driver, time - latency, longest)
        if mean:
            straight = bridge(driver.time, bridged) if driver is self.tension else 0.0
            # the last row's goes on for as long as the last message holds
            until = _held(driver, np.minimum(time - latency + dt, max(driver.time[-1], time[-1])), longest)
            known = np.isfinite(held) & np.isfinite(until)
            held = np.where(known, _averaged(driver, time - latency, dt, straight), np.nan)
        poses = [_interpolated(body, time, bridged) for body in self.bodies]
        return Measurements(
            time=time,
            tension=held,
            fractions=np.array([body.fraction for body in self.bodies]),
            position=np.stack([position for position, _, _ in poses], axis=1),
            quaternion=np.stack([quaternion for _, quaternion, _ in poses], axis=1),
            measured=np.stack([measured for _, _, measured in poses], axis=1),
            simulated=self.simulated,
            source=self.source,
        )

    def health(self) -> Health:
        """The report on this recording: rates, gaps, noise, latency, tension errors and findings."""
        from knode_cosserat.recordings.health import health_of

        return health_of(self)

    def _driver(self, kind: str) -> Tensions:
        if kind not in ("measured", "commanded"):
            raise RecordingError(f"tensions is {kind!r}; allowed is measured or commanded")
        driver = self.tension if kind == "measured" else self.command
        if driver is None:
            raise RecordingError(f"{self.source}: there are no {kind} tensions")
        return driver

    def _grid(self, dt: float, start: float | None, end: float | None) -> Float[np.ndarray, " T"]:
        trim = self.config.trim
        start = start if start is not None else trim[0]
        if start is None:
            # a frame that was lost in the beginning is no reason to begin later
            first = max(body.time[0] for body in self.bodies) - self.config.longest_gap
            start = max(0.0, math.ceil(first / dt - _SAME) * dt) if dt > 0 else 0.0
        last = min([self.end, *(limit for limit in (end, trim[1]) if limit is not None)])
        if not (dt > 0.0 and math.isfinite(dt)):
            raise RecordingError(f"dt is {dt}; allowed is a time step above 0 s")
        rows = math.floor((last - start) / dt + _SAME / dt) + 1 if last - start > -_SAME else 0
        if not 0 < rows <= MOST_ROWS:
            raise RecordingError(
                f"{self.source}: no rows of {dt:g} s from {start:g} s on; everything is known from 0 to "
                f"{self.end:g} s"
                if rows <= 0
                else f"{self.source}: {rows} rows of {dt:g} s; allowed is up to {MOST_ROWS}"
            )
        return np.round(start + dt * np.arange(rows), 9)


def bridge(time: Float[np.ndarray, " n"], longest: float) -> float:
    """The longest pause between rows of a stream that is bridged (s)."""
    return max(longest, 1.5 * period(time)) + _SAME


def period(time: Float[np.ndarray, " n"]) -> float:
    """The usual time from row to row (s); zero for fewer than two rows."""
    return float(np.median(np.diff(time))) if len(time) > 1 else 0.0


def _held(driver: Tensions, time: Float[np.ndarray, " T"], longest: float) -> Float[np.ndarray, "T tendons"]:
    last = np.searchsorted(driver.time, time + _SAME, side="right") - 1
    # before the first, that one, if it is near
    age = time - driver.time[np.maximum(last, 0)]
    old = np.abs(age) > bridge(driver.time, longest)
    return np.where(old[:, None], np.nan, driver.tension[np.maximum(last, 0)])


def _averaged(
    driver: Tensions, time: Float[np.ndarray, " T"], dt: float, straight: float
) -> Float[np.ndarray, "T tendons"]:
    """Means from each time to `dt` later: on lines between messages up to `straight` (s) apart, else held."""
    known, values = driver.time, driver.tension
    steps = np.diff(known)[:, None]
    rises = np.where(steps <= straight, np.diff(values, axis=0) / np.maximum(steps, _SAME), 0.0)
    each = values[:-1] + 0.5 * steps * rises
    integral = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps * each, axis=0)])

    def until(at: np.ndarray) -> np.ndarray:
        inside = np.clip(at, known[0], known[-1])
        last = np.clip(np.searchsorted(known, inside, side="right") - 1, 0, max(len(known) - 2, 0))
        since = (inside - known[last])[:, None]
        rise = rises[last] if len(known) > 1 else 0.0
        whole = integral[last] + since * (values[last] + 0.5 * since * rise)
        # before the first and after the last, those
        return np.asarray(
            whole + (at - inside)[:, None] * np.where(at[:, None] < known[0], values[0], values[-1])
        )

    return np.asarray((until(time + dt) - until(time)) / dt)


def _interpolated(
    body: Body, time: Float[np.ndarray, " T"], longest: float
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 4"], Bool[np.ndarray, " T"]]:
    """Positions, orientations, and which of them are not bridged."""
    seen = body.time
    position, quaternion = np.full((len(time), 3), np.nan), np.full((len(time), 4), np.nan)
    limit = bridge(seen, longest)
    for first, last in _runs(seen, limit):
        reach = limit if first == 0 else _SAME
        # before the first frame of all: as in that one
        inside = (time >= seen[first] - reach) & (time <= seen[last - 1] + _SAME)
        at = np.clip(time[inside], seen[first], seen[last - 1])
        position[inside] = _curve(seen[first:last], body.position[first:last], at)
        if body.quaternion is not None:
            quaternion[inside] = _turned(seen[first:last], body.quaternion[first:last], at)
    following = np.clip(np.searchsorted(seen, time - _SAME), 0, len(seen) - 1)
    exact = np.abs(seen[following] - time) <= _SAME
    near = seen[following] - seen[np.maximum(following - 1, 0)] <= 1.5 * period(seen) + _SAME
    measured = exact | (near & (time >= seen[0] - _SAME) & (time <= seen[-1] + _SAME))
    return position, quaternion, measured & np.isfinite(position).all(axis=1)


def _runs(time: Float[np.ndarray, " n"], limit: float) -> list[tuple[int, int]]:
    """First and last (exclusive) rows of the pieces without a longer pause."""
    breaks = np.flatnonzero(np.diff(time) > limit) + 1
    ends = [0, *breaks.tolist(), len(time)]
    return [(first, last) for first, last in itertools.pairwise(ends) if last > first]


def _curve(
    time: Float[np.ndarray, " n"], position: Float[np.ndarray, "n 3"], at: Float[np.ndarray, " T"]
) -> Float[np.ndarray, "T 3"]:
    from scipy.interpolate import CubicSpline

    if len(time) == 1:
        return np.broadcast_to(position[0], (len(at), 3))
    return np.asarray(CubicSpline(time, position, bc_type="natural")(at))


def _turned(
    time: Float[np.ndarray, " n"], quaternion: Float[np.ndarray, "n 4"], at: Float[np.ndarray, " T"]
) -> Float[np.ndarray, "T 4"]:
    from scipy.spatial.transform import Rotation, Slerp

    if len(time) == 1 or len(at) == 0:
        return np.broadcast_to(quaternion[0], (len(at), 4))
    turned = Slerp(time, Rotation.from_quat(quaternion, scalar_first=True))(at).as_quat(scalar_first=True)
    # of the two quaternions of a rotation, the one that goes on from row to row
    flips = np.cumprod(np.where(np.sum(turned[1:] * turned[:-1], axis=1) < 0.0, -1.0, 1.0))
    sign = 1.0 if turned[0, 0] >= 0.0 else -1.0
    return np.asarray(turned * sign * np.concatenate([[1.0], flips])[:, None])
