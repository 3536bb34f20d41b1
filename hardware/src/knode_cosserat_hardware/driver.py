"""Interface of drivers: states, readings with time stamps, limits, latency."""

from __future__ import annotations

import abc
import dataclasses
import enum
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat.errors import KnodeCosseratError


class HardwareError(KnodeCosseratError, RuntimeError):
    """A robot refused a command, has a fault, or does not answer: one line with the likely fix."""

    code = "hardware"


class DriverState(enum.Enum):
    """State of a robot's driver."""

    DISCONNECTED = "disconnected"
    #: connected; motors do not move
    READY = "ready"
    #: motors follow commands
    ARMED = "armed"
    #: a fault has latched; motors are released
    FAULT = "fault"


class Reading(NamedTuple):
    """Reading of a robot at one time."""

    #: time of the reading on the host's monotonic clock, the half of the latency before its arrival (s)
    time: float
    #: measured tensions (N)
    tension: Float[np.ndarray, " c"]
    #: drives of the motors, from -1 (reels out) to 1 (reels in)
    drive: Float[np.ndarray, " c"]
    state: DriverState
    #: name of the latched fault with its tendon, such as "over-tension:3"; empty without one
    fault: str = ""


class Latency(NamedTuple):
    """Time from a command to the first reading that acknowledges it (s)."""

    median: float
    p99: float
    # hides the method of tuples
    count: int  # type: ignore[assignment]


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits of commanded tensions, checked by the driver; boards check their own beside.

    Attributes:
        low: least tension of each tendon (N).
        high: greatest tension of each tendon (N).
        rate: greatest change of a tension in one second (N/s).
        total: greatest sum of all tensions (N).
    """

    low: float = 0.0
    high: float = 15.0
    rate: float = 100.0
    total: float = 60.0


class Driver(abc.ABC):
    """A connection to a robot that is commanded by tensions (N).

    Nothing moves before `arm`. A driver is a context manager that stops the robot when an error leaves it.

        with SerialBoard("/dev/ttyACM0", limits) as robot:
            robot.arm()
            robot.command([1.0, 1.0, 1.0, 1.0])
            print(robot.read())
    """

    limits: Limits
    #: number of tendons
    tendon_count: int

    @property
    @abc.abstractmethod
    def state(self) -> DriverState:
        """State of the robot at the last reading."""

    @abc.abstractmethod
    def connect(self) -> None:
        """Open the connection; the robot is ready or has a fault afterwards.

        Raises:
            HardwareError: the robot does not answer.
        """

    @abc.abstractmethod
    def tare(self) -> None:
        """Take the readings of slack tendons as zero; moves the motors. Returns when it is done."""

    @abc.abstractmethod
    def arm(self) -> None:
        """Let the motors follow commands, from zero tension on."""

    @abc.abstractmethod
    def command(self, tension: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        """Send tensions (N), and return those sent, which the limits may have reduced.

        Raises:
            HardwareError: the robot is not armed, has a fault, or the tensions are not finite.
        """

    @abc.abstractmethod
    def read(self, timeout: float = 1.0) -> Reading:
        """Return the newest reading; waits for one that was not returned before.

        Raises:
            HardwareError: none came in time.
        """

    @abc.abstractmethod
    def jog(self, tendon: int, drive: float) -> None:
        """Drive one motor for a tenth of a second; tendon from 0 on, drive from -1 to 1."""

    @abc.abstractmethod
    def disarm(self) -> None:
        """Release the tendons and stop the motors."""

    @abc.abstractmethod
    def stop(self) -> None:
        """Stop at once (emergency): release the tendons; the fault `stopped` latches. Never raises."""

    @abc.abstractmethod
    def reset(self) -> None:
        """Clear a latched fault; ready afterwards."""

    @abc.abstractmethod
    def close(self) -> None:
        """Disarm and close the connection. Never raises."""

    @property
    @abc.abstractmethod
    def latency(self) -> Latency:
        """Latency of the last commands; NaN before the first."""

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self.stop()
        self.close()
