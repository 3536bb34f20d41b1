"""Connection to a tension board: serial port, lines in and out, numbers, acknowledgements, watchdog."""

from __future__ import annotations

import abc
import contextlib
import functools
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Literal, TypeVar

import serial
from serial.tools.list_ports import comports

from knode_cosserat_hardware.driver import HardwareError, LatencyWindow, short_reason
from knode_cosserat_hardware.lines import (
    GRAM_FORCE,
    Answer,
    Banner,
    FaultNotice,
    LineSplitter,
    Message,
    Refusal,
    Telemetry,
    decode,
    decode_framed,
    decode_plain,
    encode_framed,
    encode_plain,
    is_newer,
)


class Transport(abc.ABC):
    """Bytes to and from a board, and its clock."""

    #: True if time passes by itself; False if `read` advances a simulated time
    real_time: bool = True
    #: name in error messages
    name: str = "board"

    @abc.abstractmethod
    def write(self, data: bytes) -> None:
        """Send bytes.

        Raises:
            HardwareError: the connection is lost.
        """

    @abc.abstractmethod
    def read(self, timeout: float) -> bytes:
        """Return the bytes that have arrived; waits for the first of them, empty after the timeout (s).

        Raises:
            HardwareError: the connection is lost.
        """

    @abc.abstractmethod
    def now(self) -> float:
        """Return the time (s) on a clock that never goes back."""

    def advance(self, seconds: float) -> None:
        """Let time pass (s) without reading."""
        time.sleep(seconds)

    @abc.abstractmethod
    def close(self) -> None:
        """Close the connection. Never raises."""


class SerialTransport(Transport):
    """A serial port, opened for this program alone.

    Args:
        port: name of the port, such as "/dev/ttyACM0" or "COM3", or a URL that pyserial knows.
        baud: bits per second.

    Raises:
        HardwareError: the port cannot be opened.
    """

    real_time = True

    def __init__(self, port: str, baud: int = 115200):
        self.name = port
        try:
            self._port = serial.serial_for_url(port, baudrate=baud, write_timeout=1.0, exclusive=True)
            # bytes of before belong to no session
            self._port.reset_input_buffer()
        except (OSError, ValueError) as error:
            raise HardwareError(_refusal(port, error)) from None

    def write(self, data: bytes) -> None:
        """Send bytes. Raises `HardwareError` if the connection is lost."""
        try:
            self._port.write(data)
        except Exception as error:  # the port may be closed by another thread, which pyserial does not expect
            raise self._lost(error) from None

    def read(self, timeout: float) -> bytes:
        """Return the bytes that have arrived within the timeout (s). Raises `HardwareError` if it is lost."""
        try:
            self._port.timeout = timeout
            first: bytes = self._port.read(1)
            return first + self._port.read(self._port.in_waiting) if first else first
        except Exception as error:
            raise self._lost(error) from None

    def now(self) -> float:
        """Return the time on the monotonic clock (s)."""
        return time.monotonic()

    def close(self) -> None:
        """Close the port. Never raises."""
        # an unplugged port cannot be closed properly
        with contextlib.suppress(Exception):
            self._port.close()

    def _lost(self, error: Exception) -> HardwareError:
        return HardwareError(
            f"{self.name}: the connection is lost ({short_reason(error)}); check the USB cable, then connect "
            "again"
        )


def _refusal(port: str, error: Exception) -> str:
    """Return the error message for a port that cannot be opened."""
    text = str(error).lower()
    ports = sorted(port.device for port in comports())[:10]
    found = f"ports here: {', '.join(ports)}" if ports else "no serial ports are here"
    if "permission" in text or "access is denied" in text:
        fix = "on Linux add yourself to the group dialout (sudo usermod -aG dialout $USER) and log in again"
        return f"{port}: no permission to open this port; {fix}"
    if "lock" in text or "busy" in text or "temporarily unavailable" in text:
        return f"{port}: another program uses this port; close it (a serial monitor, another driver)"
    if "no such file" in text or "filenotfound" in text or "could not open" in text:
        return f"{port}: no such serial port; {found}"
    return f"{port}: cannot be opened ({short_reason(error)}); {found}"


#: time between lines that feed the board's watchdog (60 ms), and its silence in plain mode (500 ms) (s)
KEEP_INTERVAL, PLAIN_INTERVAL = 0.02, 0.1
#: silence of a board after which its watchdog is fed no longer (s): 12 lines were lost
SILENT_BOARD = 0.25
#: longest wait in one step (s)
SLICE = 0.005
#: meaning of refusals, where it is not the name
REASONS = {
    "checksum": "the line was damaged; check the cable",
    "frame": "the line was damaged; check the cable",
    "order": "its number was not newer than the last",
    "verb": "the board does not know this command; update its program",
    "arguments": "wrong arguments for this version of the board's program",
    "range": "a value is outside the board's range",
    "state": "not possible in the board's present state",
    "name": "the board has no setting of this name",
    "emergency-stop": "release the emergency stop first; without one, turn off the setting estop",
    "busy": "the board is busy; try again",
}
#: plain telemetry lines in a row from which on a framed board must have restarted
PLAIN_LINES = 3
#: reasons for which a line is sent again
DAMAGED = ("checksum", "frame")
T = TypeVar("T")


class BoardLink:
    """Connection to a board. With a real-time transport, a thread reads and feeds the board's watchdog.

    The watchdog is fed only while the user's program is alive, for `host_timeout` after its last call, and
    while the board sends telemetry.

    Args:
        transport: bytes to and from the board.
        host_timeout: longest time between calls of the user's program (s).
        measured_high: measured tension at which the robot is stopped (N).
    """

    def __init__(self, transport: Transport, host_timeout: float, measured_high: float):
        self.transport = transport
        self.host_timeout = host_timeout
        self.measured_high = measured_high
        #: notified whenever something arrived
        self.lock = threading.Condition(threading.RLock())
        self.mode: Literal["unknown", "plain", "framed"] = "unknown"
        #: why the connection was lost
        self.error: HardwareError | None = None
        self.banner: Banner | None = None
        self.telemetry: Telemetry | None = None
        #: number of telemetry lines, and arrival of the last (s)
        self.arrivals, self.arrival = 0, -float("inf")
        #: fault that the driver found, or that a plain board sent
        self.host_fault, self.plain_fault = "", ""
        #: command that is repeated in plain mode
        self.plain_line = b""
        #: time of the last line to the board (s)
        self.sent_at = -float("inf")
        self.latencies = LatencyWindow()
        #: lines that were damaged, lost or refused, by name
        self.counts: Counter[str] = Counter()
        self.last_refusal = ""
        self._replies: dict[int, Answer | Refusal] = {}
        self._timed: deque[tuple[int, float]] = deque(maxlen=256)
        self._round_trips: deque[float] = deque(maxlen=100)
        self._splitter = LineSplitter()
        self._number = self._plain_lines = 0
        self._called = transport.now()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def delay(self) -> float:
        """Time of a line on its way (s): half of the shortest time from a line to its acknowledgement."""
        return min(self._round_trips) / 2.0 if self._round_trips else 0.0

    @property
    def fault(self) -> str:
        """Latched fault with its tendon, counted from 1, such as "over-tension:3"; empty without one."""
        return self.host_fault or self.sent_fault

    @property
    def sent_fault(self) -> str:
        """Fault that the board sent; empty without one."""
        if self.mode == "plain":
            return self.plain_fault
        return self.telemetry.fault if self.telemetry else ""

    def start(self) -> None:
        """Start the thread of a real-time transport."""
        if self.transport.real_time:
            self._thread = threading.Thread(
                target=self._run, name=f"board {self.transport.name}", daemon=True
            )
            self._thread.start()

    def close(self) -> None:
        """End the thread and close the transport. Never raises."""
        self._closing.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(2.0)
        self.transport.close()

    def check(self) -> None:
        """Raise the error of a lost connection."""
        if self.error is not None:
            raise HardwareError(str(self.error))

    def touch(self) -> None:
        """Note that the user's program is alive."""
        with self.lock:
            self.check()
            self._is_left()
            self._called = self.transport.now()

    def pump(self, timeout: float) -> None:
        """Process messages for a time (s), at most `SLICE`."""
        with self.lock:
            self.touch()
            if self._thread is not None:
                self.lock.wait(min(timeout, SLICE))
                self.check()
                return
            try:
                data = self.transport.read(min(timeout, SLICE))
            except HardwareError as error:
                self._lose(error)
                raise
            self._receive(data)
            self._keep()

    def until(self, condition: Callable[[], T | None], timeout: float) -> T | None:
        """Return the first value of a condition that is true or not empty; None after a time (s)."""
        with self.lock:
            end = self.transport.now() + timeout
            while not (value := condition()):
                remaining = end - self.transport.now()
                if remaining < 1e-6:
                    return None
                self.pump(remaining)
            return value

    # lines to the board

    def send(self, verb: str, *arguments: int | str, timed: bool = False) -> int:
        """Send a framed line, and return its number; a timed one counts for the latency."""
        with self.lock:
            # 0 stands for a line without a number
            self._number = self._number % 65535 + 1
            self.write(encode_framed(self._number, verb, *arguments))
            if timed:
                self._timed.append((self._number, self.sent_at))
            return self._number

    def send_plain(self, text: str) -> None:
        """Send a line without number and checksum."""
        self.write(encode_plain(text))

    def write(self, data: bytes) -> None:
        """Send bytes."""
        with self.lock:
            self.check()
            try:
                self.transport.write(data)
            except HardwareError as error:
                self._lose(error)
                raise
            self.sent_at = self.transport.now()

    def request(self, verb: str, *arguments: int | str, timeout: float = 0.5, attempts: int = 5) -> Answer:
        """Send a framed line and return the board's answer; sent again if none comes."""
        for attempt in range(attempts):
            self._replies.pop(0, None)
            number = self.send(verb, *arguments)
            sent = self.sent_at
            reply = self.until(functools.partial(self._reply, number), timeout)
            if isinstance(reply, Answer):
                self._round_trips.append(self.transport.now() - sent)
                return reply
            if isinstance(reply, Refusal) and reply.reason not in DAMAGED:
                if reply.reason == "state" and attempt > 0:
                    # the answer to an earlier attempt may have been lost; the caller checks the state
                    return Answer(number, verb)
                raise HardwareError(f"{self.transport.name}: {self._refused(verb, reply.reason)}")
        raise HardwareError(
            f"{self.transport.name}: no answer to {verb}; check the cable, then close and connect again"
        )

    def _reply(self, number: int) -> Answer | Refusal | None:
        unread = self._replies.pop(0, None)
        if isinstance(unread, Refusal) and unread.reason in DAMAGED:
            return self._replies.pop(number, unread)
        return self._replies.pop(number, None)

    def hello(self, version: int, timeout: float) -> Answer | None:
        """Ask the board for a version of the protocol, and return its answer; None if it does not answer."""
        with self.lock:
            self._replies.clear()
            sent = self.transport.now()
            self.send_plain(f"hello {version}")

            def replied() -> Answer | None:
                reply = self._replies.pop(0, None)
                return reply if isinstance(reply, Answer) and reply.verb == "hello" else None

            answer = self.until(replied, timeout)
            if answer:
                self._round_trips.append(self.transport.now() - sent)
            return answer

    def _refused(self, verb: str, reason: str) -> str:
        state = self.telemetry.state if self.telemetry else ""
        where = f" (state: {state})" if state and reason == "state" else ""
        return (
            f"{verb} was refused as {reason}: {REASONS.get(reason, 'see the board’s documentation')}{where}"
        )

    # messages from the board; the caller holds the lock

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                data = self.transport.read(2 * SLICE)
                with self.lock:
                    self._receive(data)
                    self._keep()
                    if data:
                        self.lock.notify_all()
            except Exception as error:  # an error in a thread would be lost
                if not self._closing.is_set():
                    with self.lock:
                        self._lose(error)
                return

    def _lose(self, error: Exception) -> None:
        if self.error is None:
            if not isinstance(error, HardwareError):
                error = HardwareError(f"{self.transport.name}: {error!r:.150}")
            self.error = error
        self.lock.notify_all()

    def _is_left(self) -> bool:
        """True if the user's program was silent for too long; its tensions are then not repeated any more."""
        left = self.transport.now() - self._called > self.host_timeout
        if left:
            self.plain_line = b""
        return left

    def _keep(self) -> None:
        """Feed the board's watchdog while the user's program is alive."""
        now = self.transport.now()
        if self._is_left() or self.error is not None:
            return
        if self.mode == "framed" and now - self.arrival > SILENT_BOARD:
            # it cannot be supervised, or it starts again: its boot loader would take the lines
            return
        if self.mode == "framed" and now - self.sent_at >= KEEP_INTERVAL:
            self.send("keep")
        elif self.mode == "plain" and self.plain_line and now - self.sent_at >= PLAIN_INTERVAL:
            self.write(self.plain_line)

    def _receive(self, data: bytes) -> None:
        decoder = {"unknown": decode, "plain": decode_plain, "framed": decode_framed}[self.mode]
        now = self.transport.now()
        for line in self._splitter.feed(data):
            message = decoder(line)
            if message is None:
                self.counts["damaged"] += 1
                if self.mode == "framed":
                    self._look_for_plain(line)
            else:
                self._take(message, now)

    def _look_for_plain(self, line: bytes) -> None:
        """Notice a board that restarted, and whose banner was damaged or follows a line that was cut off."""
        self._plain_lines += isinstance(decode_plain(line), Telemetry)
        if self._plain_lines >= PLAIN_LINES:
            self.host_fault, self.plain_line = "restarted:0", b""

    def _take(self, message: Message, now: float) -> None:
        match message:
            case Telemetry():
                self._take_telemetry(message, now)
            case Answer():
                self._note(message.number, message)
            case Refusal():
                self.counts[f"refused as {message.reason}"] += 1
                self.last_refusal = message.reason
                self._note(message.number, message)
            case FaultNotice():
                self.plain_fault = message.fault
            case Banner():
                if self.mode != "unknown":
                    # the supply broke down, for example
                    self.host_fault, self.plain_line = "restarted:0", b""
                self.banner = message
            case _:
                self.counts["remarks"] += 1

    def _note(self, number: int, reply: Answer | Refusal) -> None:
        if len(self._replies) > 100:
            self._replies.clear()
        self._replies[number] = reply

    def _take_telemetry(self, message: Telemetry, now: float) -> None:
        last = self.telemetry
        if last is not None and last.number is not None and message.number is not None:
            self.counts["lost telemetry"] += (message.number - last.number - 1) % 65536
        self.telemetry, self.arrival, self._plain_lines = message, now, 0
        self.arrivals += 1
        while self._timed and message.acknowledged is not None:
            number, sent = self._timed[0]
            if is_newer(number, message.acknowledged):
                break
            self._timed.popleft()
            self.latencies.add(now - sent)
            self._round_trips.append(now - sent)
        armed = message.state == "armed" if self.mode == "framed" else bool(self.plain_line)
        highest = max(message.tension)
        if armed and highest * GRAM_FORCE > self.measured_high:
            self.host_fault = f"measured-tension:{message.tension.index(highest) + 1}"
            self.plain_line = b""
            self.send_plain("stop")
