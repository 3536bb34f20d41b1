"""Transports: bytes to and from a board, over a serial port or an emulation."""

from __future__ import annotations

import abc
import contextlib
import time
from typing import Any

from knode_cosserat_hardware.driver import HardwareError


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

    @abc.abstractmethod
    def close(self) -> None:
        """Close the connection. Never raises."""


class SerialTransport(Transport):
    """A serial port, opened for this program alone.

    Args:
        port: name of the port, such as "/dev/ttyACM0" or "COM3", or a URL that pyserial knows.
        baud: bits per second.

    Raises:
        HardwareError: pyserial is not installed, or the port cannot be opened.
    """

    real_time = True

    def __init__(self, port: str, baud: int = 115200):
        serial = _pyserial()
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
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        return HardwareError(
            f"{self.name}: the connection is lost ({reason}); check the USB cable, then connect again"
        )


def _pyserial() -> Any:
    try:
        import serial
    except ImportError:
        raise HardwareError(
            "serial ports need pyserial; install it with: pip install knode-cosserat-hardware"
        ) from None
    return serial


def _refusal(port: str, error: Exception) -> str:
    """Return the error message for a port that cannot be opened."""
    text = str(error).lower()
    ports = _ports()
    found = f"ports here: {', '.join(ports)}" if ports else "no serial ports are here"
    if "permission" in text or "access is denied" in text:
        fix = "on Linux add yourself to the group dialout (sudo usermod -aG dialout $USER) and log in again"
        return f"{port}: no permission to open this port; {fix}"
    if "lock" in text or "busy" in text or "temporarily unavailable" in text:
        return f"{port}: another program uses this port; close it (a serial monitor, another driver)"
    if "no such file" in text or "filenotfound" in text or "could not open" in text:
        return f"{port}: no such serial port; {found}"
    return f"{port}: cannot be opened ({' '.join(str(error).split())[:120]}); {found}"


def _ports() -> list[str]:
    try:
        from serial.tools.list_ports import comports

        return sorted(port.device for port in comports())[:10]
    except Exception:
        return []
