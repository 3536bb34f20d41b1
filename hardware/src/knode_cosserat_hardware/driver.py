"""Interface of drivers: states, readings with time stamps, faults, limits of tensions, latency, clock."""

from __future__ import annotations

import abc
import csv
import dataclasses
import enum
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.yaml_text import excerpt
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

    Raises:
        HardwareError: a limit is not allowed, or they contradict each other.
    """

    low: float = 0.0
    high: float = 15.0
    rate: float = 100.0
    total: float = 60.0

    def __post_init__(self) -> None:
        for name, unit in {"low": "N", "high": "N", "rate": "N/s", "total": "N"}.items():
            low = 0.0 if name == "low" else 0.001
            require_number(name, getattr(self, name), {"low": low, "high": 1e5, "unit": unit})
        if self.low >= self.high:
            raise HardwareError(f"low must be below high, {self.high:g} N (got {self.low:g})")
        if self.total < self.low:
            raise HardwareError(f"total must be at least low, {self.low:g} N (got {self.total:g})")


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
    _latencies: LatencyWindow
    _fault = ""

    @property
    def fault(self) -> str:
        """Latched fault with its tendon, counted from 1, such as "over-tension:3"; empty without one."""
        return self._fault

    @property
    def latency(self) -> Latency:
        """Latency of the last commands; NaN before the first."""
        return self._latencies.summary()

    def now(self) -> float:
        """Return the time on the robot's clock (s)."""
        return time.monotonic()

    def wait(self, seconds: float) -> None:
        """Wait (s), with the robot's watchdog fed.

        Raises:
            HardwareError: the connection is lost.
        """
        end = time.monotonic() + seconds
        while (rest := end - time.monotonic()) > 0.1:
            time.sleep(0.1)
            self.read()
        time.sleep(max(rest, 0.0))

    def advance(self, seconds: float) -> None:
        """Let time pass (s) without a sign of life to the robot: armed, its watchdog reacts."""
        time.sleep(seconds)

    # what is checked before a call; all raise HardwareError

    def _require_no_fault(self) -> None:
        if self.fault:
            raise HardwareError(fault_message(self.fault))

    def _require_armed(self) -> None:
        self._require_no_fault()
        if self.state is not DriverState.ARMED:
            raise HardwareError("the robot is not armed; call arm() before command()")

    def _require_ready(self, purpose: str) -> None:
        self._require_no_fault()
        if self.state is not DriverState.READY:
            raise HardwareError(f"{purpose} moves the motors by itself; call disarm() first")

    @property
    @abc.abstractmethod
    def state(self) -> DriverState:
        """State of the robot at the last reading."""

    @abc.abstractmethod
    def connect(self) -> None:
        """Open the connection; the robot is ready or has a fault afterwards.

        Raises:
            HardwareError: the connection cannot be opened, or the robot does not answer.
        """

    @abc.abstractmethod
    def tare(self) -> None:
        """Take the readings of slack tendons as zero; moves the motors. Returns when it is done.

        Raises:
            HardwareError: the robot is armed, has a fault, or its tare fails or cannot be commanded.
        """

    @abc.abstractmethod
    def arm(self) -> None:
        """Let the motors follow commands, from zero tension on.

        Raises:
            HardwareError: the robot has a fault, or does not arm.
        """

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
            HardwareError: none came in time, or the connection is lost.
        """

    @abc.abstractmethod
    def jog(self, tendon: int, drive: float) -> None:
        """Drive one motor for a tenth of a second; tendon from 0 on, drive from -1 to 1.

        Raises:
            HardwareError: an argument is not allowed, or the robot is armed or has a fault.
        """

    def _check_jog(self, tendon: int, drive: float, largest: float = 1.0) -> None:
        if tendon not in range(self.tendon_count):
            raise HardwareError(
                f"tendon must be a whole number from 0 to {self.tendon_count - 1} (got {tendon!r})"
            )
        if not abs(drive) <= largest + 1e-9:
            raise HardwareError(f"drive must be between {-largest:.3g} and {largest:.3g} (got {drive!r})")

    @abc.abstractmethod
    def disarm(self) -> None:
        """Release the tendons and stop the motors."""

    @abc.abstractmethod
    def stop(self) -> None:
        """Stop at once (emergency): release the tendons; the fault `stopped` latches. Never raises."""

    @abc.abstractmethod
    def reset(self) -> None:
        """Clear a latched fault; ready afterwards.

        Raises:
            HardwareError: the fault is still there.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Disarm and close the connection. Never raises."""

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self.stop()
        self.close()


#: longest time between commands that a rate counts (s): a pause allows no jump; and that of the first command
LONGEST_STEP, FIRST_STEP = 0.1, 0.02


def require_number(name: str, value: Any, stated: Any, whole: bool = False) -> None:
    """Check a number's type and range."""
    low, high, unit = stated["low"], stated["high"], stated["unit"]
    kinds = int if whole else (int, float)
    # the comparison is false for NaN
    if isinstance(value, kinds) and not isinstance(value, bool) and low <= value <= high:
        return
    kind = "a whole number " if whole else ""
    message = (
        f"{name} must be {kind}between {low:g} and {high:g} {unit}".rstrip() + f" (got {excerpt(value)})"
    )
    if unit == "m" and isinstance(value, int | float) and low <= value / 1000 <= high:
        message += f". Did you mean {value / 1000:.12g} ({value:g} mm)?"
    raise HardwareError(message)


def short_reason(error: Exception) -> str:
    """Return the message of another library's error in one line, or its kind if it has none."""
    return " ".join(str(error).split())[:120] or type(error).__name__


class TensionLimiter:
    """Reduces commanded tensions to limits of size, rate and sum.

    Args:
        limits: the limits.
        count: number of tendons.

    Raises:
        HardwareError: all tendons at their low limit exceed the total.
    """

    def __init__(self, limits: Limits, count: int):
        if limits.low * count > limits.total:
            raise HardwareError(
                f"total must be at least {count} times low, {limits.low * count:g} N (got {limits.total:g})"
            )
        self.limits = limits
        self.count = count
        self.reset(-np.inf)

    def reset(self, now: float) -> None:
        """Start at zero tension, at a time (s)."""
        self._last = np.zeros(self.count)
        self._time = now - FIRST_STEP

    def reduced(self, tension: Float[np.ndarray, " c"], now: float) -> Float[np.ndarray, " c"]:
        """Return tensions (N) within the limits, and remember them as the last ones.

        Rates are limited against the last tensions and the time since (0.1 s at most). A rising tendon is
        held back further if the sum would be too large.

        Args:
            tension: wanted tensions (N).
            now: time (s).
        """
        limits, wanted = self.limits, checked_tensions(tension, self.count)
        step = limits.rate * min(max(now - self._time, 0.0), LONGEST_STEP)
        target = np.clip(wanted, limits.low, limits.high)
        excess = target.sum() - limits.total
        if excess > 0.0:
            # reduced in proportion above the low limit
            above = target - limits.low
            target = target - above * (excess / above.sum())
        change = np.clip(target - self._last, -step, step)
        rise, fall = np.maximum(change, 0.0), np.minimum(change, 0.0)
        # rounding makes the room of a full sum slightly negative
        room = max(limits.total - self._last.sum() - fall.sum(), 0.0)
        if rise.sum() > room:
            rise *= room / rise.sum()
        self._last = np.maximum(self._last + rise + fall, 0.0)
        self._time = now
        result: Float[np.ndarray, " c"] = self._last.copy()
        return result


def checked_tensions(tension: Float[np.ndarray, " c"], count: int) -> Float[np.ndarray, " c"]:
    """Return tensions (N) as an array of floats."""
    try:
        wanted = np.asarray(tension, dtype=float)
    except (TypeError, ValueError):
        raise HardwareError(f"tensions must be {count} numbers in N (got {str(tension)[:60]})") from None
    if wanted.shape != (count,):
        raise HardwareError(f"tensions must be {count} numbers in N (got an array of shape {wanted.shape})")
    if not np.all(np.isfinite(wanted)):
        raise HardwareError(
            f"tensions must be finite (got {wanted.tolist()}); the last command stays in force"
        )
    return wanted


class LatencyWindow:
    """Latencies of the last commands (s)."""

    def __init__(self, size: int = 1000):
        self._values: deque[float] = deque(maxlen=size)

    def add(self, latency: float) -> None:
        """Add the latency of one command (s)."""
        self._values.append(latency)

    def summary(self) -> Latency:
        """Return median, 99th percentile and number; NaN without any."""
        if not self._values:
            return Latency(float("nan"), float("nan"), 0)
        values = np.array(self._values)
        return Latency(float(np.median(values)), float(np.quantile(values, 0.99)), len(values))


with Path(__file__).with_name("faults.csv").open(encoding="utf-8", newline="") as _file:
    #: by name: meaning, and the likely fix
    FAULTS = {name: (meaning, fix) for name, meaning, fix in list(csv.reader(_file))[1:]}


def fault_message(fault: str) -> str:
    """Return the error message for a fault such as "over-tension:3": its meaning and the likely fix."""
    name, _, tendon = fault.partition(":")
    meaning, fix = FAULTS.get(name, ("unknown to this version", "see the board's documentation"))
    place = f" at tendon {tendon} (counted from 1)" if tendon not in ("", "0") else ""
    last = "" if "reset()" in fix else "; then reset()"
    return f"fault {name}{place}: {meaning}; {fix}{last}"


class HostClock:
    """Conversion of monotonic times (s) to ROS stamps (ns since 1970); the offset is measured once.

    A change of the system's time during a run does not move the stamps. Programs that stamp the same
    readings share one clock.

    Args:
        monotonic: clock of readings and poses (s); that of the transport for an emulated robot.
    """

    def __init__(self, monotonic: Callable[[], float] = time.monotonic):
        self._monotonic = monotonic
        self._offset = time.time_ns() - round(monotonic() * 1e9)

    def now(self) -> float:
        """Return the monotonic time (s)."""
        return self._monotonic()

    def stamp(self, time: float) -> int:
        """Return the stamp (ns since 1970) of a monotonic time (s)."""
        return self._offset + round(time * 1e9)

    def age(self, stamp: int) -> float:
        """Return the time since a stamp (s); negative for one in the future."""
        return (self.stamp(self.now()) - stamp) * 1e-9
