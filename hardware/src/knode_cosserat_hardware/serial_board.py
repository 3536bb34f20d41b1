"""Driver of tension boards on a serial port: framed lines, or plain ones for the paper's board."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware import board_plain
from knode_cosserat_hardware.board_link import BoardLink
from knode_cosserat_hardware.board_settings import ask_setting
from knode_cosserat_hardware.board_start import find_board, negotiate
from knode_cosserat_hardware.driver import Driver, DriverState, HardwareError, Latency, Limits, Reading
from knode_cosserat_hardware.faults import fault_message
from knode_cosserat_hardware.limits import TensionLimiter, checked_tensions
from knode_cosserat_hardware.lines import GRAM_FORCE, encode_tensions
from knode_cosserat_hardware.transport import SerialTransport, Transport

#: age of telemetry at which a command is refused (s): 25 lines were lost
STALE = 0.5


class SerialBoard(Driver):
    """Robot with a tension board on a serial port.

    The board is asked for framed lines with checksums; a board that does not answer is the paper's, and is
    commanded by plain lines. While the robot is armed, call `command`, `read` or `wait` at least every
    `host_timeout`: otherwise the board's watchdog is fed no longer, and the board releases the tendons.

    Args:
        port: serial port, such as "/dev/ttyACM0" or "COM3", or a transport.
        limits: limits of commanded tensions. The board's own limit reduces `high`.
        protocol: 2, or 1 for plain lines without asking.
        tendon_count: number of tendons; a framed board states its own.
        host_timeout: longest time between calls while armed (s).
        start_timeout: longest time from opening the port to the end of taring (s).
        measured_high: measured tension that stops the robot (N); 1.5 times `limits.high` if None.

    Raises:
        HardwareError: an argument is not allowed.
    """

    def __init__(
        self,
        port: str | Transport,
        limits: Limits | None = None,
        *,
        protocol: int = 2,
        tendon_count: int = 4,
        host_timeout: float = 0.25,
        start_timeout: float = 30.0,
        measured_high: float | None = None,
    ):
        if protocol not in (1, 2):
            raise HardwareError(f"protocol must be 1 (plain) or 2 (framed) (got {protocol!r})")
        self.limits = Limits() if limits is None else limits
        self.tendon_count = tendon_count
        self._limiter = TensionLimiter(self.limits, tendon_count)
        self._port = port
        self._protocol = protocol
        self._host_timeout = host_timeout
        self._start_timeout = start_timeout
        self._measured_high = 1.5 * self.limits.high if measured_high is None else measured_high
        self._link: BoardLink | None = None
        self._returned = 0
        self._last_latency = Latency(float("nan"), float("nan"), 0)

    # state

    @property
    def state(self) -> DriverState:
        """State of the robot at the last telemetry; disconnected after a lost connection."""
        link = self._link
        if link is None or link.error is not None:
            return DriverState.DISCONNECTED
        with link.lock:
            if self.fault:
                return DriverState.FAULT
            if link.mode == "framed":
                armed = link.telemetry is not None and link.telemetry.state == "armed"
            else:
                armed = board_plain.is_armed(link)
            return DriverState.ARMED if armed else DriverState.READY

    @property
    def fault(self) -> str:
        """Latched fault with its tendon, counted from 1, such as "over-tension:3"; empty without one."""
        return self._link.fault if self._link else ""

    @property
    def is_framed(self) -> bool:
        """True if lines have checksums; False for the paper's board."""
        return self._link is not None and self._link.mode == "framed"

    @property
    def line_counts(self) -> dict[str, int]:
        """Numbers of lines that were damaged, lost or refused, by name."""
        return dict(self._link.counts) if self._link else {}

    @property
    def latency(self) -> Latency:
        """Latency of the last commands; NaN before the first, and in plain mode."""
        return self._link.latencies.summary() if self._link else self._last_latency

    @property
    def loop_time(self) -> float:
        """Longest time between two steps of the board's control (s), of the last telemetry; NaN without."""
        telemetry = self._link.telemetry if self._link else None
        return float("nan") if telemetry is None else 1e-3 * telemetry.loop_time

    # connection

    def connect(self) -> None:
        """Open the port, wait for the board's banner and the end of its tare, and choose the protocol.

        Raises:
            HardwareError: the port cannot be opened, or no board answers.
        """
        if self._link is not None and self._link.error is None:
            return
        self.close()
        transport = SerialTransport(self._port) if isinstance(self._port, str) else self._port
        link = BoardLink(transport, self._host_timeout, self._measured_high)
        self._link, self._returned = link, 0
        try:
            link.start()
            find_board(link, self._start_timeout)
            self._negotiate(link)
        except BaseException:
            self._link = None
            link.close()
            raise

    def _negotiate(self, link: BoardLink) -> None:
        started = negotiate(link, self._protocol, self.tendon_count, self._start_timeout)
        limits = self.limits
        if started.high is not None and started.high < limits.high:
            limits = dataclasses.replace(limits, high=started.high)
        self._limiter = TensionLimiter(limits, started.tendons)
        self.limits, self.tendon_count = limits, started.tendons

    def close(self) -> None:
        """Release the tendons and close the port. Never raises."""
        link = self._link
        if link is None:
            return
        with contextlib.suppress(Exception):
            self._release(link)
            if link.mode == "framed":
                link.send_plain("hello 1")
        self._last_latency = link.latencies.summary()
        self._link = None
        link.close()

    def wait(self, seconds: float) -> None:
        """Wait (s) while the board's watchdog is fed.

        Raises:
            HardwareError: the connection is lost.
        """
        self._connected().until(lambda: None, seconds)

    # motion

    def arm(self) -> None:
        """Let the motors follow commands, from zero tension on; waits while the board tares or releases.

        Raises:
            HardwareError: the robot has a fault, or does not arm.
        """
        link = self._connected()
        if self.state is DriverState.ARMED:
            return
        if link.mode == "plain":
            board_plain.arm(link, self.tendon_count, self._start_timeout)
        else:
            # a board that is releasing or taring is ready soon
            self._expect(link, lambda: self._board_state(link) == "ready", 3.0, "was not ready to be armed")
            link.request("arm")
            self._expect(link, lambda: self._board_state(link) == "armed", 1.0, "did not arm")
        self._limiter.reset(link.transport.now())

    def command(self, tension: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        """Send tensions (N), and return those sent: within the limits, and in whole grams-force (9.8 mN).

        Raises:
            HardwareError: the robot is not armed, has a fault, sends no telemetry, or the tensions are not
                finite.
        """
        link = self._connected()
        wanted = checked_tensions(tension, self.tendon_count)
        with link.lock:
            link.touch()
            self._require_no_fault()
            if self.state is not DriverState.ARMED:
                raise HardwareError("the robot is not armed; call arm() before command()")
            now = link.transport.now()
            if now - link.arrival > STALE:
                raise HardwareError(
                    f"{link.transport.name}: no telemetry for {now - link.arrival:.1f} s; check the cable"
                )
            grams = _rounded(self._limiter.reduced(wanted, now), self.limits)
            if link.mode == "framed":
                link.send("tension", *grams, timed=True)
            else:
                link.plain_line = encode_tensions(grams)
                link.write(link.plain_line)
        return np.array(grams) * GRAM_FORCE

    def read(self, timeout: float = 1.0) -> Reading:
        """Return the newest reading; waits (s) for one that was not returned before.

        Raises:
            HardwareError: none came in time, or the connection is lost.
        """
        link = self._connected()
        telemetry: Any = link.until(
            lambda: link.telemetry if link.arrivals > self._returned else None, timeout
        )
        if telemetry is None:
            raise HardwareError(
                f"{link.transport.name}: no reading in {timeout:g} s; check cable, supply and baud"
            )
        with link.lock:
            telemetry, self._returned = link.telemetry, link.arrivals
            return Reading(
                link.arrival - link.delay,
                np.array(telemetry.tension, dtype=float) * GRAM_FORCE,
                np.clip(np.array(telemetry.drive, dtype=float) / 255.0, -1.0, 1.0),
                self.state,
                self.fault,
            )

    def tare(self) -> None:
        """Take the readings of slack tendons as zero; moves the motors. Returns when it is done.

        Raises:
            HardwareError: the board failed, is armed, or is a plain one, which tares on its start only.
        """
        link = self._framed("tare")
        self._require_no_fault()
        link.request("tare")
        count = link.arrivals
        tared = lambda: link.arrivals > count and self._board_state(link) != "taring"  # noqa: E731
        self._expect(link, tared, self._start_timeout, "did not finish its tare")

    def jog(self, tendon: int, drive: float) -> None:
        """Drive one motor for a tenth of a second; tendon from 0 on, drive from -1 to 1.

        Raises:
            HardwareError: the robot is armed or has a fault, or the drive is above the setting `jog`.
        """
        if tendon not in range(self.tendon_count):
            raise HardwareError(
                f"tendon must be a whole number from 0 to {self.tendon_count - 1} (got {tendon!r})"
            )
        if not -1.0 <= drive <= 1.0:
            raise HardwareError(f"drive must be between -1 and 1 (got {drive!r})")
        link = self._framed("jog")
        self._require_no_fault()
        link.request("drive", int(tendon) + 1, round(255 * float(drive)))

    def disarm(self) -> None:
        """Release the tendons and stop the motors."""
        self._release(self._connected())

    def _release(self, link: BoardLink) -> None:
        if link.mode == "plain":
            board_plain.release(link, self.tendon_count)
        elif self.state is DriverState.ARMED:
            link.request("disarm")
            link.until(lambda: self.fault or self._board_state(link) == "ready", 3.0)

    def stop(self) -> None:
        """Stop at once (emergency): release the tendons; the fault `stopped` latches. Never raises."""
        link = self._link
        if link is None:
            return
        with contextlib.suppress(Exception):
            link.plain_line = b""
            if link.mode == "plain":
                # the paper's board does not know stop
                link.write(encode_tensions([0] * self.tendon_count))
                link.host_fault = link.host_fault or "stopped:0"
            for attempt in range(5):
                # the end of a line that was cut off comes first
                link.write(b"stop\n" if attempt == 0 else b"\nstop\n")
                if link.until(lambda: link.sent_fault, 0.05):
                    break

    def reset(self) -> None:
        """Clear a latched fault; ready afterwards. A board that restarted is asked for its protocol again.

        Raises:
            HardwareError: the board keeps its fault.
        """
        link = self._connected()
        if not self.fault:
            return
        if link.host_fault == "restarted:0":
            link.mode, link.host_fault, link.plain_fault, link.telemetry = "unknown", "", "", None
            self._negotiate(link)
            return
        if link.mode == "plain":
            board_plain.reset(link)
            return
        released = lambda: self._board_state(link) in ("fault", "ready")  # noqa: E731
        self._expect(link, released, 3.0, "did not end its release", check=False)
        if self._board_state(link) == "fault":
            link.request("reset")
        link.host_fault = ""
        self._expect(link, lambda: self._board_state(link) == "ready", 1.0, "kept its fault", check=False)

    # settings

    def setting(self, name: str) -> int:
        """Return a setting of the board, such as "kp", in the units of the protocol.

        Raises:
            HardwareError: the board has no such setting, or no settings (plain mode).
        """
        return ask_setting(self._framed("settings"), "get", name)

    def set_setting(self, name: str, value: int) -> int:
        """Change a setting of the board until its next start, and return it; `save_settings` keeps it.

        Raises:
            HardwareError: name or value are not allowed, or the robot is armed.
        """
        return ask_setting(self._framed("settings"), "set", name, value)

    def save_settings(self) -> None:
        """Write settings and zeros to the board's EEPROM.

        Raises:
            HardwareError: the robot is armed, or the board does not answer.
        """
        self._framed("settings").request("save", timeout=2.0)

    # helpers

    def _connected(self) -> BoardLink:
        if self._link is None:
            raise HardwareError(
                "the robot is not connected; call connect(), or use the driver in a with statement"
            )
        self._link.touch()
        return self._link

    def _framed(self, purpose: str) -> BoardLink:
        link = self._connected()
        if link.mode != "framed":
            raise HardwareError(
                f"{purpose} needs protocol 2, which this board does not speak; load the package's firmware"
            )
        return link

    def _board_state(self, link: BoardLink) -> str:
        return link.telemetry.state if link.telemetry else ""

    def _require_no_fault(self) -> None:
        if self.fault:
            raise HardwareError(fault_message(self.fault))

    def _expect(
        self, link: BoardLink, condition: Callable[[], bool], timeout: float, problem: str, check: bool = True
    ) -> bool:
        """Wait until a condition is true; a fault or the end of the time (s) are errors."""
        found = link.until(lambda: condition() or (check and bool(self.fault)), timeout)
        if check:
            self._require_no_fault()
        if not found:
            state = self._board_state(link)
            raise HardwareError(
                f"{link.transport.name}: the board {problem} in {timeout:g} s (state: {state})"
            )
        return True


def _rounded(tension: Float[np.ndarray, " c"], limits: Limits) -> list[int]:
    """Return tensions in whole grams-force that exceed neither the greatest tension nor the greatest sum."""
    exact = tension / GRAM_FORCE
    grams = np.minimum(np.rint(exact), np.floor(limits.high / GRAM_FORCE + 1e-9))
    if grams.sum() * GRAM_FORCE > limits.total:
        grams = np.floor(exact)
    return [int(value) for value in grams]
