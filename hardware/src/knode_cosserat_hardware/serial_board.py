"""Driver of tension boards on a serial port: framed lines, or plain ones for the paper's board."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat_hardware.board_link import BoardLink, SerialTransport, Transport
from knode_cosserat_hardware.driver import (
    Driver,
    DriverState,
    HardwareError,
    Latency,
    Limits,
    Reading,
    TensionLimiter,
    checked_tensions,
    fault_message,
)
from knode_cosserat_hardware.lines import GRAM_FORCE, encode_tensions

#: a plain board disarms itself after a silence of 0.5 s
PLAIN_SILENCE = 0.45


def is_plain_armed(link: BoardLink) -> bool:
    """True while commands are repeated and the board has not disarmed itself."""
    return bool(link.plain_line) and link.transport.now() - link.sent_at < PLAIN_SILENCE


def arm_plain(link: BoardLink, tendons: int, timeout: float) -> None:
    """Send zero tensions until the board does not refuse them: one that tares does."""
    zeros = encode_tensions([0] * tendons)
    end = link.transport.now() + timeout
    while link.transport.now() < end:
        link.last_refusal = ""
        link.write(zeros)
        link.until(lambda: link.last_refusal or link.fault, 0.1)
        if link.fault:
            raise HardwareError(fault_message(link.fault))
        if not link.last_refusal:
            link.plain_line = zeros
            return
    raise HardwareError(
        f"{link.transport.name}: the board refused to arm ({link.last_refusal}); wait for its tare"
    )


def release_plain(link: BoardLink, tendons: int) -> None:
    """Send zero tensions once; the silence that follows disarms the board."""
    if link.plain_line:
        link.write(encode_tensions([0] * tendons))
    link.plain_line = b""


def reset_plain(link: BoardLink) -> None:
    """Ask the board to clear its fault, after its release of the tendons."""
    for _ in range(2):
        link.last_refusal = ""
        link.send_plain("reset")
        if link.until(lambda: link.last_refusal, 0.2) != "state":
            break
        link.until(lambda: None, 0.6)
    if link.last_refusal == "emergency-stop":
        raise HardwareError(fault_message("emergency-stop:0"))
    link.host_fault = link.plain_fault = ""


#: names of settings, for the hints of errors; a newer board may have more
SETTINGS = (
    *("kp", "ki", "kd", "hold", "friction", "smooth", "limit", "watchdog", "silence", "release", "jog"),
    *("tare_drive", "tare_time", "tare_rise", "tare_on_start", "estop"),
    *(f"{name}{k}" for name in ("gain", "zero") for k in range(1, 5)),
)


def ask_setting(link: BoardLink, verb: str, name: str, *value: int) -> int:
    """Return a setting that the board answers to `get NAME` or `set NAME VALUE`."""
    try:
        whole = [int(each) for each in value]
    except (TypeError, ValueError, OverflowError):
        whole = []
    if whole != list(value) or any(isinstance(each, bool) for each in value):
        raise HardwareError(f"{name} must be a whole number (got {value[0]!r:.60})")
    try:
        answer = link.request(verb, name, *whole)
    except HardwareError as error:
        hint = "" if name in SETTINGS else did_you_mean(name, SETTINGS)
        raise HardwareError(f"{error}; setting {name}{hint}") from None
    try:
        return int(answer.values[1])
    except (IndexError, ValueError):
        raise HardwareError(f"{link.transport.name}: the answer to {verb} {name} is not understood") from None


#: a board without a banner that has sent telemetry for this time is running (s). One that restarts is silent
RUNNING_TIME = 0.5
#: longest wait for a banner or telemetry (s): the boot loader of an Arduino takes up to 2 s
FIRST_LINE = 5.0


def find_board(link: BoardLink, timeout: float) -> None:
    """Wait (s) for a board's banner or a running one's telemetry: a boot loader would take other lines."""
    opened = link.transport.now()

    def is_there() -> bool:
        running = link.telemetry is not None and link.arrival - opened >= RUNNING_TIME
        return link.banner is not None or running

    link.until(is_there, min(FIRST_LINE, timeout))


def negotiate(link: BoardLink, protocol: int, tendons: int, timeout: float) -> tuple[int, float | None]:
    """Choose framed or plain lines, and wait (s) until a framed board has tared or has a fault.

    Args:
        link: the connection; its mode is set.
        protocol: 2, or 1 for plain lines.
        tendons: number of tendons of a plain board.
        timeout: longest wait for the end of taring (s).

    Returns:
        The board's number of tendons, and the greatest tension that it accepts (N; None if it states none).
    """
    offered = link.banner.protocol if link.banner else protocol
    answer = None
    if min(offered, protocol) >= 2:
        for _ in range(3):
            if answer := link.hello(2, 0.5):
                break
    if answer is None:
        if link.until(lambda: link.telemetry, 1.0) is None:
            raise HardwareError(
                f"{link.transport.name}: no answer; check that this is the board's port, its power, "
                "and that 115200 baud is its speed"
            )
        link.mode = "plain"
        _require_tendons(link, tendons)
        return tendons, None
    with link.lock:
        link.mode, link.telemetry = "framed", None
    try:
        # `2 knode-tension 1.0.0 TENDONS RATE LIMIT`
        tendons, high = int(answer.values[3]), int(answer.values[5]) * GRAM_FORCE
    except (IndexError, ValueError):
        raise HardwareError(
            f"{link.transport.name}: the answer to hello is not understood ({' '.join(answer.values)[:60]})"
        ) from None
    # taring moves the motors; the link feeds the watchdog meanwhile
    settled = ("ready", "armed", "fault")
    if not link.until(lambda: link.telemetry and link.telemetry.state in settled, timeout):
        raise HardwareError(
            f"{link.transport.name}: the board was not ready in {timeout:g} s; check the tendons, "
            "or turn off the setting tare_on_start"
        )
    _require_tendons(link, tendons)
    return tendons, high


def _require_tendons(link: BoardLink, tendons: int) -> None:
    count = len(link.telemetry.tension) if link.telemetry else 0
    if count != tendons:
        raise HardwareError(
            f"{link.transport.name}: the board sends {count} tensions (expected {tendons}); "
            "give the right tendon_count"
        )


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
                armed = is_plain_armed(link)
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
        """Open the port, wait for the board's banner and the end of its tare, and choose the protocol."""
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
        tendons, high = negotiate(link, self._protocol, self.tendon_count, self._start_timeout)
        limits = self.limits
        if high is not None and high < limits.high:
            limits = dataclasses.replace(limits, high=high)
        self._limiter = TensionLimiter(limits, tendons)
        self.limits, self.tendon_count = limits, tendons

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
        """Wait (s) while the board's watchdog is fed."""
        self._connected().until(lambda: None, seconds)

    def now(self) -> float:
        """Return the time on the transport's clock (s)."""
        return self._port.now() if isinstance(self._port, Transport) else super().now()

    def advance(self, seconds: float) -> None:
        """Let time pass (s) without a sign of life to the board."""
        if self._link is not None:
            self._link.transport.advance(seconds)

    # motion

    def arm(self) -> None:
        """Let the motors follow commands, from zero tension on; waits while the board tares or releases."""
        link = self._connected()
        if self.state is DriverState.ARMED:
            return
        if link.mode == "plain":
            arm_plain(link, self.tendon_count, self._start_timeout)
        else:
            # a board that is releasing or taring is ready soon
            self._expect(link, lambda: self._board_state(link) == "ready", 3.0, "was not ready to be armed")
            link.request("arm")
            self._expect(link, lambda: self._board_state(link) == "armed", 1.0, "did not arm")
        self._limiter.reset(link.transport.now())

    def command(self, tension: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        """Send tensions (N), and return those sent: within the limits, and in whole grams-force (9.8 mN)."""
        link = self._connected()
        wanted = checked_tensions(tension, self.tendon_count)
        with link.lock:
            link.touch()
            self._require_armed()
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
        """Return the newest reading; waits (s) for one that was not returned before."""
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
        """Take the readings of slack tendons as zero; moves the motors. Returns when it is done."""
        link = self._framed("tare")
        self._require_no_fault()
        link.request("tare")
        count = link.arrivals
        tared = lambda: link.arrivals > count and self._board_state(link) != "taring"  # noqa: E731
        self._expect(link, tared, self._start_timeout, "did not finish its tare")

    def jog(self, tendon: int, drive: float) -> None:
        """Drive one motor for a tenth of a second; tendon from 0 on, drive from -1 to 1."""
        self._check_jog(tendon, drive)
        link = self._framed("jog")
        self._require_no_fault()
        link.request("drive", int(tendon) + 1, round(255 * float(drive)))

    def disarm(self) -> None:
        """Release the tendons and stop the motors."""
        self._release(self._connected())

    def _release(self, link: BoardLink) -> None:
        if link.mode == "plain":
            release_plain(link, self.tendon_count)
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
        """Clear a latched fault; ready afterwards. A board that restarted is asked for its protocol again."""
        link = self._connected()
        if not self.fault:
            return
        if link.host_fault == "restarted:0":
            link.mode, link.host_fault, link.plain_fault, link.telemetry = "unknown", "", "", None
            self._negotiate(link)
            return
        if link.mode == "plain":
            reset_plain(link)
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
