"""Bridges to other programs: readings and poses out; commands in, only if fresh and complete."""

from __future__ import annotations

import abc
from collections import Counter
from collections.abc import Sequence
from typing import Any, Protocol, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware.driver import Driver, DriverState, HardwareError, HostClock, Reading
from knode_cosserat_hardware.middleware.mocap import MotionCapture, PoseFrame

#: age from which a command is stale, and greatest advance of its stamp (s)
LARGEST_AGE, LARGEST_ADVANCE = 0.2, 0.05
#: silence after a command until the robot is disarmed (s)
SILENCE = 0.5


def tendon_names(count: int) -> list[str]:
    """Return the names of tendons in messages, from tendon_1 on."""
    return [f"tendon_{k + 1}" for k in range(count)]


class CommandGate:
    """Gate for commands of other programs to a driver.

    A command is refused, and counted by reason, if it is stale, out of order, incomplete, or the robot is
    not armed; the driver applies its limits to the others. After a silence of 0.5 s the robot is disarmed:
    a program that died leaves no tension.

    Args:
        driver: the robot.
        clock: clock of the stamps.
        largest_age: age from which a command is stale (s).
    """

    def __init__(self, driver: Driver, clock: HostClock, largest_age: float = LARGEST_AGE):
        self.driver = driver
        self.clock = clock
        self.largest_age = largest_age
        #: number of accepted commands, and of refused ones by reason
        self.accepted, self.refused = 0, Counter[str]()
        #: message of the last refusal of the driver
        self.problem = ""
        self._names = tendon_names(driver.tendon_count)
        self._stamp = 0
        self._commanded: float | None = None

    def pass_on(
        self, names: Sequence[str], tension: Sequence[float], stamp: int
    ) -> Float[np.ndarray, " c"] | None:
        """Send tensions (N) to the driver, and return those sent; None if they are refused.

        Args:
            names: names of the tendons, in any order; empty for tendon_1, tendon_2 …
            tension: of each tendon (N).
            stamp: time of the command (ns since 1970).
        """
        reason, values = self._checked(names, tension, stamp)
        if reason:
            self.refused[reason] += 1
            return None
        try:
            sent = self.driver.command(values)
        except HardwareError as error:
            self.refused["refused by the driver"] += 1
            self.problem = str(error)
            return None
        self.accepted += 1
        self._stamp, self._commanded = stamp, self.clock.now()
        return sent

    def watch(self) -> bool:
        """Disarm the robot if commands have stopped; True if it was disarmed now."""
        if self._commanded is None or self.clock.now() - self._commanded <= SILENCE:
            return False
        self._commanded = None
        if self.driver.state is not DriverState.ARMED:
            return False
        self.driver.disarm()
        return True

    def _checked(self, names: Sequence[str], tension: Sequence[float], stamp: int) -> tuple[str, Any]:
        age = self.clock.age(stamp)
        if age > self.largest_age or age < -LARGEST_ADVANCE:
            return "stale", None
        if stamp <= self._stamp:
            return "out of order", None
        values = np.array(tension, dtype=float)
        if values.shape != (len(self._names),):
            return "wrong number of tensions", None
        if not np.all(np.isfinite(values)):
            return "not finite", None
        if len(names):
            if sorted(names) != sorted(self._names):
                return "unknown names of tendons", None
            values = values[[list(names).index(name) for name in self._names]]
        if self.driver.state is not DriverState.ARMED:
            return "not armed", None
        return "", values


class Source(Protocol):
    """Source of readings, such as a driver."""

    tendon_count: int

    def read(self, timeout: float = 1.0) -> Reading:
        """Return the newest reading."""
        ...


class Bridge(abc.ABC):
    """Publisher of readings and poses, and, if chosen, subscriber of commands; a context manager.

    Args:
        source: a connected driver, or another source of readings.
        commands: True accepts commands; the source must be a driver.
        capture: motion capture, whose frames are published too.
        clock: clock of the stamps; a program's recorders and bridges share it.

    Raises:
        HardwareError: commands without a driver.
    """

    def __init__(
        self, source: Source, commands: bool, capture: MotionCapture | None, clock: HostClock | None
    ):
        if commands and not isinstance(source, Driver):
            raise HardwareError(f"commands need a driver (got {type(source).__name__})")
        self.source, self.capture = source, capture
        self.clock = HostClock() if clock is None else clock
        #: gate of commands, with counts; None without commands
        self.gate = CommandGate(source, self.clock) if commands and isinstance(source, Driver) else None

    @abc.abstractmethod
    def publish(self, reading: Reading) -> None:
        """Publish the tensions of a reading."""

    @abc.abstractmethod
    def publish_poses(self, frame: PoseFrame) -> None:
        """Publish the poses of all bodies."""

    @abc.abstractmethod
    def handle_commands(self) -> Any:
        """Send the newest command to the driver."""

    @abc.abstractmethod
    def close(self) -> None:
        """Leave the network. The driver is left as it is."""

    @property
    def is_open(self) -> bool:
        """True until another program ends the bridge."""
        return True

    def step(self, timeout: float = 1.0) -> Reading:
        """Read, publish the reading and new poses, and handle commands; return the reading.

        A command waits for the next reading: 20 ms at most with the paper's board.

        Raises:
            HardwareError: the robot or motion capture does not answer.
        """
        self.handle_commands()
        reading = self.source.read(timeout)
        self.publish(reading)
        self.handle_commands()
        for frame in self.capture.frames() if self.capture is not None else ():
            self.publish_poses(frame)
        return reading

    def run(self, duration: float = float("inf")) -> int:
        """Step for a time (s, on the bridge's clock) while it is open, and return the number of readings.

        Raises:
            HardwareError: the robot or motion capture does not answer.
        """
        end, count = self.clock.now() + duration, 0
        while self.clock.now() < end and self.is_open:
            self.step()
            count += 1
        return count

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
