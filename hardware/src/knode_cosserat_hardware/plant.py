"""Robot behind a driver as the plant of a closed loop."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from knode_cosserat.control import Plant
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.places import OwnFrame
from knode_cosserat_hardware.driver import Driver, DriverState, HardwareError, Reading, fault_message
from knode_cosserat_hardware.safety import EmergencyStop, SafeRegion

#: source of measurements: time on the driver's clock (s), and numbers (p,) such as positions (m)
Source = Callable[[], tuple[float, Float[np.ndarray, " p"]]]
#: part of a period by which it may begin late without being counted
TOLERANCE = 0.2
#: difference of a sent and a commanded tension that counts as a reduction (N): twice a gram-force
RESOLUTION = 0.02
#: time for which a reading is awaited at the begin of a period (s)
SOON = 1e-3


class HardwarePlant(Plant):
    """A robot that a loop moves through a driver and measures by motion capture.

    Commands are sent at once; the wait for the end of a period is in `measure`, so that the controller
    prepares the next period meanwhile. The robot is armed by the first command: a program may compile after
    `start`. Faults, a violated region and an emergency stop end the loop with a `HardwareError`, after the
    driver has stopped the robot; the error has the log until then as its attribute `log`.

    Args:
        driver: a connected driver.
        source: returns the time (s) and the numbers (size,) of the newest measurement; None: not measured.
        dt: period (s).
        size: number of measured numbers; the last three are the tip's position (m).
        region: region of the tip; None: not checked.
        emergency: emergency stop that is checked in each period.
        robot: robot whose `Camera` states the frame of the measurements; None: its own frame.

    Raises:
        HardwareError: the period is not a positive number.
    """

    def __init__(
        self,
        driver: Driver,
        source: Source | None,
        dt: float,
        *,
        size: int = 3,
        region: SafeRegion | None = None,
        emergency: EmergencyStop | None = None,
        robot: System | None = None,
    ):
        if not 0.0 < dt < math.inf:
            raise HardwareError(f"dt must be a positive number of seconds (got {dt!r})")
        self.driver, self.dt = driver, float(dt)
        self._source: Source | None = source
        self._size, self._region, self._emergency = size, region, emergency
        self._frame = None if robot is None else OwnFrame.of(robot)
        self._clock = driver.now
        #: number of commands that the driver's limits reduced
        self.reduced = 0
        #: readings during the loop, at most one a period
        self.readings: list[Reading] = []
        self._begin, self._count = math.nan, 0
        self._last: tuple[float, Float[np.ndarray, " p"]] | None = None

    def start(self) -> Float[np.ndarray, " c"]:
        """Release the tendons, and return the acting control, zero tensions; the first command arms."""
        if self.driver.state is DriverState.ARMED:
            self.driver.disarm()
        self._check()
        self._begin, self._count, self._last = math.nan, 0, None
        self.missed = self.reduced = 0
        self.readings.clear()
        return np.zeros(self.driver.tendon_count)

    def rehearsal(self) -> Plant:
        """Return a plant with this one's measurements that moves nothing, to compile a loop."""
        return _Rehearsal(self)

    def measure(self) -> Float[np.ndarray, " p"]:
        """Wait for the begin of the period, and return its measurement; NaN if it is older than a period."""
        try:
            self._wait_for_period()
            self._check()
            stamp, measured = self.newest()
        except HardwareError:
            self.driver.stop()
            raise
        if self._region is not None:
            before = None if self._last is None else self._last[1][-3:]
            elapsed = np.inf if self._last is None else max(stamp - self._last[0], 1e-3)
            problem = self._region.violation(measured[-3:], before, elapsed)
            if problem:
                self.driver.stop()
                raise HardwareError(
                    f"{problem}; the robot was stopped. Enlarge the region, or reduce tensions"
                )
        if np.isfinite(measured).all():
            self._last = stamp, measured
        return measured

    def newest(self) -> tuple[float, Float[np.ndarray, " p"]]:
        """Return the newest measurement and its time (s), without waiting; NaN if it is too old."""
        nothing = np.full(self._size, np.nan)
        if self._source is None:
            return self._clock(), nothing
        stamp, values = self._source()
        measured = np.asarray(values, dtype=float).ravel()
        if measured.shape != (self._size,):
            raise HardwareError(f"a measurement must have {self._size} numbers (got {measured.size})")
        return stamp, measured if self._clock() - stamp <= self.dt else nothing

    def apply(self, control: Float[np.ndarray, " c"]) -> None:
        """Send a command (N); the first one arms the robot."""
        try:
            if self._emergency is not None:
                self._emergency.check()
            if self._count == 0:
                self.driver.arm()
            sent = self.driver.command(control)
        except HardwareError:
            self.driver.stop()
            raise
        self.reduced += bool(np.max(np.abs(np.asarray(control) - sent)) > RESOLUTION)
        self._count += 1

    def acting(self) -> tuple[Float[np.ndarray, " c"], float] | None:
        """Return the tensions (N) of the newest reading and their age (s); None if it is too old."""
        if not self.readings:
            return None
        age = self._clock() - self.readings[-1].time
        return (self.readings[-1].tension, age) if 0.0 <= age <= self.dt else None

    def tip(self) -> Float[np.ndarray, "3"]:
        """Return the last measured position of the tip (m), robot's frame; NaN if there is none."""
        if self._last is None:
            return np.full(3, np.nan)
        measured = self._last[1][-3:]
        return measured if self._frame is None else self._frame.tip(measured)

    def _wait_for_period(self) -> None:
        if math.isnan(self._begin):
            self._begin = self._clock()
            return
        rest = self._begin + self._count * self.dt - self._clock()
        if rest > 0.0:
            self.driver.wait(rest)
        elif -rest > TOLERANCE * self.dt:
            self.missed += 1
            self._begin -= rest
        # a lost reading is no fault; a lost connection is one of the next command
        with contextlib.suppress(HardwareError):
            self.readings.append(self.driver.read(timeout=SOON))

    def _check(self) -> None:
        if self._emergency is not None:
            self._emergency.check()
        if self.driver.state is DriverState.FAULT:
            # before the fault is read: a board that restarted sends no readings
            self.driver.stop()
            fault = self.driver.fault or self.driver.read().fault
            raise HardwareError(fault_message(fault))


class _Rehearsal(Plant):
    """Plant that moves nothing."""

    def __init__(self, plant: HardwarePlant):
        self.dt, self._plant = plant.dt, plant

    def start(self) -> Float[np.ndarray, " c"]:
        return np.zeros(self._plant.driver.tendon_count)

    def measure(self) -> Float[np.ndarray, " p"]:
        return self._plant.newest()[1]

    def apply(self, control: Float[np.ndarray, " c"]) -> None:
        pass
