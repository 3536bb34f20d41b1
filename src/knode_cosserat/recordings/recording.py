"""Recordings: cleaned sensor data, each stream at its own rate, in SI units and in the robot's frame."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline, PPoly
from scipy.spatial.transform import Rotation, Slerp

from knode_cosserat._files.limits import MORE, scaled_limit
from knode_cosserat._reprs import count_of, wrap_lines
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.quantities import counted_quantities
from knode_cosserat.recordings.streams import Body, ControlRows, Sensor, period

if TYPE_CHECKING:
    from knode_cosserat.recordings.health import Health

#: largest number of rows of a grid: more rows are a mistake
MOST_ROWS = 10_000_000
#: tolerance of stamps (s)
_SAME = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """Recording of a robot, as read by `load_recording`.

    Times are seconds from the first pose or control. Positions are in the robot's frame: z up, origin at
    the clamped end. Lost frames are absent; `sampled` bridges them.

    Attributes:
        source: description and origin of the recording.
        config: configuration of its topics or columns.
        bodies: bodies on the rod, from base to tip.
        base: body that locates the clamped end, or None.
        control: measured numbers that drive the robot, or None.
        command: commanded ones, or None.
        rest: interval in which the robot rests (s), or None.
        simulated: True if the robot was itself a simulation; None: not stated.
        findings: errors and repairs, the gravest first.
        delays: median delay from stamp to recording (s) by topic; NaN without stamps.
        sensors: sensors beside motion capture.
        uses: use of each column of a table, or topic of a bag; empty text: it is not read.
        clock_deviation: standard deviation of the time between controls and poses (s), of several files.
        files: name and SHA-256 (as `sha256sum` prints it) of each file; of a folder, of its files in order.
    """

    source: str
    config: RecordingConfig
    bodies: tuple[Body, ...]
    base: Body | None
    control: ControlRows | None
    command: ControlRows | None
    rest: tuple[float, float] | None
    simulated: bool | None
    findings: tuple[Finding, ...]
    delays: Mapping[str, float]
    sensors: tuple[Sensor, ...] = ()
    uses: Mapping[str, str] = dataclasses.field(default_factory=dict)
    clock_deviation: float = 0.0
    files: tuple[tuple[str, str], ...] = ()

    def __repr__(self) -> str:
        origin = {True: "simulated", False: "real", None: "origin not stated"}[self.simulated]
        bodies = ", ".join(f"{body.name} at {body.fraction:.4g}" for body in self.bodies) or "none"
        sensors = "".join(f"; {sensor.topic}" for sensor in self.sensors)
        streams = [name for name in ("control", "command") if getattr(self, name) is not None]
        return wrap_lines(
            f"Recording ({origin}): {self.end:.4g} s; {self._driven_by} "
            f"({', '.join(streams)}); bodies {bodies} of the length{sensors}; "
            f"{count_of(len(self.findings), 'finding')}; source: {self.source}"
        )

    @property
    def _driven_by(self) -> str:
        stream = self.control or self.command
        return counted_quantities(stream.quantities if stream else ())

    @property
    def _times(self) -> list[Float[np.ndarray, " n"]]:
        """Times of all bodies and sensors (s)."""
        return [*(it.time for it in self.bodies), *(it.time for it in self.sensors)]

    @property
    def end(self) -> float:
        """End of the first stream to end (s): until then all poses and controls are known."""
        driver = self._driver(self.config.controls)
        ends = [time[-1] for time in self._times]
        if driver is self.control:
            ends.append(driver.time[-1] + (period(driver.time) if self._is_held(driver) else 0.0))
        # a command holds until the next
        return float(min(ends))

    def _is_held(self, driver: ControlRows) -> bool:
        """True if each value acts unchanged until the next one."""
        return driver is self.command or all(source.held for source in self.config.measured)

    def sampled(
        self,
        dt: float = 0.05,
        start: float | None = None,
        end: float | None = None,
        controls: Literal["measured", "commanded", "none"] | None = None,
        *,
        mean: bool = False,
    ) -> Measurements:
        """Return the measurements at the times `start`, `start + dt` and so on, up to `end` (s).

        Controls are the last ones at or before a row's time (zero-order hold); commands and measured ones are
        delayed by their latency. Positions are interpolated by cubic splines, orientations by spherical
        linear interpolation. A gap between frames is bridged up to the configuration's `longest_gap`, or up
        to 1.5 usual periods of the stream if that is longer; rows in a longer gap are NaN.

        Args:
            dt: time from row to row (s); a recording of equilibria keeps its own rows.
            start: time of the first row (s); None: start of the configuration's `trim` or of the recording.
            end: latest time of the last row (s); None: end of the `trim` or of the first stream to end.
            controls: "measured", "commanded" or "none"; None: the configuration's choice.
            mean: True to average the controls over dt. Held ones are averaged from each row to the
                next. Others are interpolated linearly and averaged about the next row, because
                an implicit time step is driven by the control at its end. Rows that reach into a gap too
                long to be bridged are NaN.

        Raises:
            RecordingError: there are no such controls or no such rows.
        """
        driver = self._driver(controls or self.config.controls)
        is_static = self.config.static
        time = self._own_rows(driver, start, end) if is_static else self._grid(driver, dt, start, end)
        bridged = self.config.longest_gap
        latency = 0.0
        if driver is self.command and self.config.command is not None:
            latency = self.config.command.latency
        longest = bridged if driver is self.control else math.inf
        held = _held(driver, time - latency, longest)
        if mean and not self.config.static:
            is_held = self._is_held(driver)
            straight = 0.0 if is_held else bridge(driver.time, bridged)
            begin = time - latency + (0.0 if is_held else 0.5 * dt)
            # the last row's interval is limited to the duration of the last message
            until = _held(driver, np.minimum(begin + dt, max(driver.time[-1], time[-1])), longest)
            known = np.isfinite(_held(driver, np.minimum(begin, max(driver.time[-1], time[-1])), longest))
            known &= np.isfinite(until)
            held = np.where(known, _averaged(driver, begin, dt, straight), np.nan)
        poses = [_interpolated(body, time, bridged) for body in self.bodies]

        def rows(part: int, *shape: int) -> np.ndarray:
            # without bodies, too
            return np.reshape([it[part] for it in poses], (len(poses), len(time), *shape)).swapaxes(0, 1)

        return Measurements(
            time=time,
            control=held,
            fractions=np.array([body.fraction for body in self.bodies]),
            position=rows(0, 3),
            quaternion=rows(1, 4),
            measured=rows(2).astype(bool),
            simulated=self.simulated,
            source=self.source,
            initial_control=self._initial_control(driver, float(time[0]) - latency, longest),
            static=self.config.static,
            continuous=mean and not self.config.static and not self._is_held(driver),
            sensors=tuple(
                dataclasses.replace(
                    it, time=time, values=_interpolated(Body(it.time, it.values), time, bridged)[0]
                )
                for it in self.sensors
            ),
            deviations=tuple(marker.deviation or 0.0 for marker in self.config.markers),
            quantities=driver.quantities,
            clock_deviation=0.0 if self.config.static else self.clock_deviation,
            files=self.files,
        )

    def _initial_control(
        self, driver: ControlRows, at: float, longest: float
    ) -> Float[np.ndarray, " c"] | None:
        """Return the control before a time: the stated one, the mean over the rest, or the held one."""
        if self.config.initial_control is not None and at <= driver.time[0] + _SAME:
            return np.array(self.config.initial_control)
        if self.rest is not None and self.rest[0] <= at <= self.rest[1]:
            resting = (driver.time >= self.rest[0] - _SAME) & (driver.time <= at + _SAME)
            if resting.any():
                return np.asarray(driver.values[resting].mean(axis=0))
        held = _held(driver, np.array([at]), longest)[0]
        return held if np.all(np.isfinite(held)) else None

    def health(self) -> Health:
        """Return the quality report: rates, gaps, noise, latency, errors of controls and findings."""
        # SciPy's optimisation is imported with it
        from knode_cosserat.recordings.health import health_of

        return health_of(self)

    def _driver(self, kind: str) -> ControlRows:
        if kind not in ("measured", "commanded", "none"):
            raise RecordingError(f"controls is {kind!r}; allowed is measured, commanded or none")
        if kind == "none":
            time = self._times[0]
            return ControlRows(time, np.zeros((len(time), 0)))
        driver = self.control if kind == "measured" else self.command
        if driver is None:
            raise RecordingError(f"{self.source}: there are no {kind} controls")
        return driver

    def _own_rows(
        self, driver: ControlRows, start: float | None, end: float | None
    ) -> Float[np.ndarray, " T"]:
        """Return the times of the rows of equilibria (s)."""
        low, high = -math.inf if start is None else start, math.inf if end is None else end
        time = driver.time[(driver.time >= low - _SAME) & (driver.time <= high + _SAME)]
        if not len(time):
            raise RecordingError(f"{self.source}: no rows from {start} to {end} s")
        return time

    def _grid(
        self, driver: ControlRows, dt: float, start: float | None, end: float | None
    ) -> Float[np.ndarray, " T"]:
        trim = self.config.trim
        start = start if start is not None else trim[0]
        if start is None:
            # a lost frame at the beginning does not delay the first row
            known = [*self._times, *([driver.time] if driver is self.control else [])]
            first = max(time[0] for time in known) - self.config.longest_gap
            start = max(0.0, math.ceil(first / dt - _SAME) * dt) if dt > 0 else 0.0
        last = min([self.end, *(limit for limit in (end, trim[1]) if limit is not None)])
        if not (dt > 0.0 and math.isfinite(dt)):
            raise RecordingError(f"dt is {dt}; allowed is a time step above 0 s")
        rows = math.floor((last - start) / dt + _SAME / dt) + 1 if last - start > -_SAME else 0
        most = scaled_limit(MOST_ROWS)
        if not 0 < rows <= most:
            raise RecordingError(
                f"{self.source}: no rows of {dt:g} s from {start:g} s on; everything is known from 0 to "
                f"{self.end:g} s"
                if rows <= 0
                else f"{self.source}: {rows} rows of {dt:g} s; allowed is up to {most}; {MORE}"
            )
        return np.round(start + dt * np.arange(rows), 9)


def bridge(time: Float[np.ndarray, " n"], longest: float) -> float:
    """Return the longest gap between rows of a stream that is bridged (s)."""
    return max(longest, 1.5 * period(time)) + _SAME


def _held(driver: ControlRows, time: Float[np.ndarray, " T"], longest: float) -> Float[np.ndarray, "T c"]:
    last = np.searchsorted(driver.time, time + _SAME, side="right") - 1
    # before the first message its value is used, if it is near
    age = time - driver.time[np.maximum(last, 0)]
    old = np.abs(age) > bridge(driver.time, longest)
    return np.where(old[:, None], np.nan, driver.values[np.maximum(last, 0)])


def _averaged(
    driver: ControlRows, time: Float[np.ndarray, " T"], dt: float, straight: float
) -> Float[np.ndarray, "T c"]:
    """Return means from each time to `dt` later.

    Values are interpolated linearly between messages up to `straight` (s) apart, otherwise held. They are
    constant before the first and after the last message.
    """
    known, values = driver.time, driver.values
    steps = np.diff(known)[:, None]
    rises = np.where(steps <= straight, np.diff(values, axis=0) / np.maximum(steps, _SAME), 0.0)
    # a piece of constant values before the first and after the last message
    rises, starts = np.pad(rises, ((1, 1), (0, 0))), np.concatenate([values[:1], values])
    far = dt + float(np.ptp(known)) + float(np.max(np.abs(time - known[0]), initial=0.0))
    ends = np.concatenate([[known[0] - far], known, [known[-1] + far]])
    integral = PPoly(np.stack([rises, starts]), ends).antiderivative()
    return np.asarray((integral(time + dt) - integral(time)) / dt)


def _interpolated(
    body: Body, time: Float[np.ndarray, " T"], longest: float
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 4"], Bool[np.ndarray, " T"]]:
    """Return positions, orientations, and a mask of the rows that are not bridged."""
    seen = body.time
    position, quaternion = (np.full((len(time), size), np.nan) for size in (body.position.shape[1], 4))
    limit = bridge(seen, longest)
    ends = [0, *(np.flatnonzero(np.diff(seen) > limit) + 1).tolist(), len(seen)]
    for first, last in itertools.pairwise(ends):
        # before the very first frame its pose is used
        reach = limit if first == 0 else _SAME
        inside = (time >= seen[first] - reach) & (time <= seen[last - 1] + _SAME)
        at, piece = np.clip(time[inside], seen[first], seen[last - 1]), slice(first, last)
        if last - first == 1:
            position[inside] = body.position[first]
            quaternion[inside] = np.nan if body.quaternion is None else body.quaternion[first]
            continue
        position[inside] = CubicSpline(seen[piece], body.position[piece], bc_type="natural")(at)
        if body.quaternion is not None and len(at):
            turns = Slerp(seen[piece], Rotation.from_quat(body.quaternion[piece], scalar_first=True))
            quaternion[inside] = continuous(turns(at).as_quat(scalar_first=True))
    following = np.clip(np.searchsorted(seen, time - _SAME), 0, len(seen) - 1)
    exact = np.abs(seen[following] - time) <= _SAME
    near = seen[following] - seen[np.maximum(following - 1, 0)] <= 1.5 * period(seen) + _SAME
    measured = exact | (near & (time >= seen[0] - _SAME) & (time <= seen[-1] + _SAME))
    return position, quaternion, measured & np.isfinite(position).all(axis=1)


def continuous(quaternion: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, "T 4"]:
    """Return the same rotations with the signs that are continuous from row to row."""
    flips = np.cumprod(np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0.0, -1.0, 1.0))
    sign = 1.0 if quaternion[0, 0] >= 0.0 else -1.0
    return np.asarray(quaternion * sign * np.concatenate([[1.0], flips])[:, None])
