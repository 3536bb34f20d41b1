"""Robots whose motors are commanded by torque: tension = torque / reel radius."""

from __future__ import annotations

import abc
import contextlib
import dataclasses
import math
import threading
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware.driver import (
    Driver,
    DriverState,
    HardwareError,
    LatencyWindow,
    Limits,
    Reading,
    TensionLimiter,
    checked_tensions,
)

#: age of a reading at which a command takes a new one first (s)
STALE = 0.1
#: angular velocity of a motor at rest (rad/s), and longest tare (s)
AT_REST, TARE_TIME = 0.1, 10.0
#: tension of a jog at full drive (N), and its duration (s)
JOG_TENSION, JOG_TIME = 2.0, 0.1


@dataclasses.dataclass(frozen=True)
class MotorReel:
    """Motors with reels, all alike.

    Attributes:
        radius: radius of the reels, at the tendon (m).
        torque_constant: torque of the output shaft by current (N m/A). Measure it: friction of gears counts.
        directions: 1 for a motor that reels in at positive torque, -1 for others; one number for all motors.
        reel_in: longest length of tendon reeled in from the zero (m); beyond it the tendon is off or torn.
        reel_out: longest length of tendon reeled out from the zero (m).
        tare_tension: tension that tightens the tendons for their zero (N).
        measured_high: measured tension that stops the robot (N); 1.5 times `limits.high` if None.

    Raises:
        HardwareError: a value is not allowed.
    """

    radius: float = 0.01
    torque_constant: float = 1.78
    directions: tuple[int, ...] = (1,)
    reel_in: float = 0.1
    reel_out: float = 0.05
    tare_tension: float = 0.5
    measured_high: float | None = None

    def __post_init__(self) -> None:
        for name in ("radius", "torque_constant", "reel_in", "reel_out", "tare_tension"):
            value = getattr(self, name)
            if not (isinstance(value, int | float) and math.isfinite(value) and value > 0.0):
                raise HardwareError(f"{name} must be a positive number (got {value!r})")
        if not self.directions or any(each not in (1, -1) for each in self.directions):
            raise HardwareError(f"directions must be 1 or -1 for each motor (got {self.directions!r})")


class MotorSample(NamedTuple):
    """Sample of all motors; positive reels in."""

    #: time on the monotonic clock (s)
    time: float
    #: torque (N m), angle (rad) and angular velocity (rad/s) of the output shafts
    torque: Float[np.ndarray, " c"]
    angle: Float[np.ndarray, " c"]
    velocity: Float[np.ndarray, " c"]
    #: fault with its motor, counted from 1, such as "overload:2"; empty without one
    fault: str = ""


class MotorRobot(Driver):
    """Driver of motors that are commanded by torque; a subclass speaks to the bus.

    Measured tensions come from currents: friction of gears and reels is not seen in them.

    Args:
        count: number of motors.
        limits: limits of commanded tensions.
        reel: the motors and their reels.

    Raises:
        HardwareError: an argument is not allowed.
    """

    def __init__(self, count: int, limits: Limits | None, reel: MotorReel | None):
        self.limits = Limits() if limits is None else limits
        self.tendon_count = count
        self.reel = MotorReel() if reel is None else reel
        if len(self.reel.directions) not in (1, count):
            raise HardwareError(
                f"directions must be one number or {count} numbers (got {len(self.reel.directions)})"
            )
        self._limiter = TensionLimiter(self.limits, count)
        self._directions = np.broadcast_to(np.array(self.reel.directions, dtype=float), count)
        self._measured_high = self.reel.measured_high or 1.5 * self.limits.high
        self._lock = threading.RLock()
        self._state = DriverState.DISCONNECTED
        self._zero = np.zeros(count)
        self._sampled = -math.inf
        self._write_time: float | None = None
        # times of a command's and the next reading's transfer, without the program's time between them
        self._latencies = LatencyWindow()

    # the bus; all raise HardwareError if motors do not answer

    @abc.abstractmethod
    def _open(self) -> None:
        """Open the bus and set up the motors, without torque."""

    @abc.abstractmethod
    def _shut(self) -> None:
        """Close the bus."""

    @abc.abstractmethod
    def _enable(self) -> None:
        """Let the motors follow torques, from zero on."""

    @abc.abstractmethod
    def _disable(self) -> None:
        """Turn the torque of all motors off."""

    @abc.abstractmethod
    def _write(self, torque: Float[np.ndarray, " c"]) -> None:
        """Send torques (N m), positive reels in."""

    @abc.abstractmethod
    def _sample(self, timeout: float) -> MotorSample:
        """Return a new sample of all motors, within a time (s)."""

    @abc.abstractmethod
    def _clear(self) -> None:
        """Clear the faults of the motors."""

    # states

    @property
    def state(self) -> DriverState:
        """State of the robot at the last reading."""
        return self._state

    def connect(self) -> None:
        """Open the bus and set up the motors."""
        with self._lock:
            if self._state is not DriverState.DISCONNECTED:
                return
            self._fault = ""
            try:
                self._open()
                self._state = DriverState.READY
                sample = self._take(1.0)
            except BaseException:
                self._lose()
                raise
            self._zero = sample.angle

    def close(self) -> None:
        """Turn the torques off and close the bus. Never raises."""
        with self._lock, contextlib.suppress(Exception):
            if self._state is not DriverState.DISCONNECTED:
                self._disable()
        self._lose()

    def _lose(self) -> None:
        self._state = DriverState.DISCONNECTED
        with contextlib.suppress(Exception):
            self._shut()

    def arm(self) -> None:
        """Let the motors follow commands, from zero tension on."""
        with self._lock:
            self._require_connected()
            self._require_no_fault()
            if self._state is DriverState.ARMED:
                return
            self._take(1.0)
            self._require_no_fault()
            with self._guarded():
                self._enable()
            self._limiter.reset(time.monotonic())
            self._state = DriverState.ARMED

    def disarm(self) -> None:
        """Turn the torques off: gears may hold some tension."""
        with self._lock:
            self._require_connected()
            self._disable()
            if self._state is DriverState.ARMED:
                self._state = DriverState.READY

    def stop(self) -> None:
        """Turn the torques off at once (emergency); the fault `stopped` latches. Never raises."""
        if self._state is DriverState.DISCONNECTED:
            return
        for _ in range(3):
            with contextlib.suppress(Exception), self._lock:
                self._disable()
        self._latch("stopped:0")

    def reset(self) -> None:
        """Clear a latched fault; ready afterwards."""
        with self._lock:
            if self._state is not DriverState.FAULT:
                return
            self._clear()
            self._fault, self._state = "", DriverState.READY
            self._take(1.0)
            self._require_no_fault()

    # motion

    def command(self, tension: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        """Send tensions (N), and return those sent, which the limits may have reduced."""
        wanted = checked_tensions(tension, self.tendon_count)
        with self._lock:
            self._require_connected()
            self._require_armed()
            if time.monotonic() - self._sampled > STALE:
                # over-travel and faults are seen in readings only
                self._take(1.0)
                self._require_no_fault()
            start = time.monotonic()
            sent = self._limiter.reduced(wanted, start)
            with self._guarded():
                self._write(sent * self.reel.radius)
            self._write_time = time.monotonic() - start
            return sent

    def read(self, timeout: float = 1.0) -> Reading:
        """Return a new reading; its drives are the measured tensions by `limits.high`."""
        with self._lock:
            self._require_connected()
            sample = self._take(timeout)
            tension = sample.torque / self.reel.radius
            drive = np.clip(tension / self.limits.high, -1.0, 1.0)
            return Reading(sample.time, tension, drive, self._state, self._fault)

    def tare(self) -> None:
        """Tighten the tendons, and take the motors' angles as the zero of their travel."""
        with self._lock:
            self._require_connected()
            self._require_ready("tare")
            # the travel counts from here
            self._zero = self._take(1.0).angle
            self._require_no_fault()
            self._enable()
            try:
                end = time.monotonic() + TARE_TIME
                still = 0
                while still < 5:
                    self._write(np.full(self.tendon_count, self.reel.tare_tension * self.reel.radius))
                    sample = self._take(1.0)
                    self._require_no_fault()
                    still = still + 1 if np.all(np.abs(sample.velocity) < AT_REST) else 0
                    if time.monotonic() > end:
                        self._latch("tare-timeout:0")
                        self._require_no_fault()
                    time.sleep(0.02)
                self._zero = sample.angle
            finally:
                self._disable()

    def jog(self, tendon: int, drive: float) -> None:
        """Drive one motor for a tenth of a second; tendon from 0 on, drive from -1 to 1 (2 N at the reel)."""
        self._check_jog(tendon, drive)
        with self._lock:
            self._require_connected()
            self._require_ready("jog")
            torque = np.zeros(self.tendon_count)
            torque[int(tendon)] = drive * JOG_TENSION * self.reel.radius
            self._enable()
            try:
                self._write(torque)
                time.sleep(JOG_TIME)
            finally:
                self._disable()

    # helpers

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """Turn the torques off and disconnect if the bus is lost or a motor does not answer."""
        try:
            yield
        except HardwareError:
            with contextlib.suppress(Exception):
                self._disable()
            self._lose()
            raise

    def _take(self, timeout: float) -> MotorSample:
        """Return a sample; faults latch and turn the torques off."""
        start = time.monotonic()
        with self._guarded():
            sample = self._sample(timeout)
        self._sampled = time.monotonic()
        if self._write_time is not None:
            self._latencies.add(self._write_time + self._sampled - start)
            self._write_time = None
        fault = sample.fault or self._excess(sample)
        if fault and self._state is not DriverState.DISCONNECTED and not self._fault:
            with contextlib.suppress(HardwareError):
                self._disable()
            self._latch(fault)
        return sample

    def _excess(self, sample: MotorSample) -> str:
        """Return the fault of a motor beyond its travel or its greatest tension."""
        if self._state is not DriverState.ARMED:
            return ""
        travel = (sample.angle - self._zero) * self.reel.radius
        beyond = (travel > self.reel.reel_in) | (travel < -self.reel.reel_out)
        if np.any(beyond):
            return f"travel:{int(np.argmax(beyond)) + 1}"
        tension = sample.torque / self.reel.radius
        if tension.max() > self._measured_high:
            return f"measured-tension:{int(np.argmax(tension)) + 1}"
        return ""

    def _latch(self, fault: str) -> None:
        if self._state is not DriverState.DISCONNECTED:
            self._state = DriverState.FAULT
            self._fault = self._fault or fault

    def _require_connected(self) -> None:
        if self._state is DriverState.DISCONNECTED:
            raise HardwareError("the robot is not connected; call connect(), or check the cable")
