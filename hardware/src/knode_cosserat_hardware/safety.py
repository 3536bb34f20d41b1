"""Emergency stop by key, signal or a lost terminal; region that the tip must not leave."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import select
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware.driver import Driver, HardwareError

#: keys that stop the robot: space, Enter, q, Escape's byte alone, Ctrl-C and Ctrl-D in raw mode
STOP_KEYS = frozenset(b" \r\nqQ\x03\x04")
#: signals that stop the robot, where the system has them
SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")
#: longest wait for the end of a stop (s)
LONGEST_STOP = 5.0


class StoppedError(HardwareError):
    """The robot was stopped by a key, a signal or a lost terminal."""

    code = "stopped"


class EmergencyStop:
    """Context in which a key, a signal or a lost terminal stops the robot.

    A thread calls `driver.stop()` at once, also while the program computes; it is called once. The first
    signal then raises `StoppedError` in the program; later ones do not interrupt its end, except SIGQUIT.
    After a key the driver's commands fail, and `check` raises. The terminal is restored at the end. An error
    that leaves the context stops the robot too.

        with SerialBoard("/dev/ttyACM0") as robot, EmergencyStop(robot) as emergency:
            robot.arm()
            while True:
                emergency.check()
                robot.command(tensions())

    Args:
        driver: driver whose `stop` may be called from another thread.
        other_keys: called with the bytes of all other keys, by the thread.
        terminal: file descriptor of the terminal; None: the standard input, if it is a terminal.
    """

    def __init__(
        self,
        driver: Driver,
        *,
        other_keys: Callable[[bytes], None] | None = None,
        terminal: int | None = None,
    ):
        self.driver, self.reason = driver, ""
        self._other_keys, self._terminal = other_keys, terminal
        self._lock, self._stopped, self._done = threading.Lock(), False, threading.Event()
        self._thread: threading.Thread | None = None
        self._handlers: dict[int, Any] = {}
        self._mode: Any = None
        self._leaving = self._raised = False

    @property
    def is_stopped(self) -> bool:
        """True after a stop."""
        return self._stopped

    @property
    def has_keys(self) -> bool:
        """True if keys of a terminal stop the robot."""
        return self._mode is not None

    def check(self) -> None:
        """Raise `StoppedError` if the robot was stopped."""
        if self._stopped:
            raise StoppedError(f"stopped by {self.reason}; the tendons are released. Then reset()")

    def stop(self, reason: str) -> None:
        """Stop the robot, once; the reason is kept."""
        with self._lock:
            if self._stopped:
                return
            # a signal's handler may have noted the reason before
            self._stopped, self.reason = True, self.reason or reason
        try:
            self.driver.stop()
        finally:
            self._done.set()

    def __enter__(self) -> Self:
        if self._terminal is None:
            self._terminal = _terminal()
        if self._terminal is not None:
            self._mode = _without_lines(self._terminal)
        self._wakeup, self._wakeup_end = os.pipe()
        os.set_blocking(self._wakeup_end, False)
        self._previous_fd: int | None = None
        self._previous_hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
        with contextlib.suppress(ValueError):  # only the main thread has signals
            self._previous_fd = signal.set_wakeup_fd(self._wakeup_end, warn_on_full_buffer=False)
            for name in SIGNALS:
                number = getattr(signal, name, None)
                if number is not None:
                    self._handlers[number] = signal.signal(number, self._handle)
        self._thread = threading.Thread(target=self._watch, name="emergency stop", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._leaving = True
        sys.unraisablehook = self._previous_hook
        if kind is not None:
            self.stop(f"an error ({kind.__name__})")
        if self._stopped:
            self._done.wait(LONGEST_STOP)
        with contextlib.suppress(OSError):
            os.write(self._wakeup_end, b"\0")
        if self._thread is not None:
            self._thread.join(LONGEST_STOP)
        for number, handler in self._handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        if self._previous_fd is not None:
            signal.set_wakeup_fd(self._previous_fd)
        if self._mode is not None and self._terminal is not None:
            _restore(self._terminal, self._mode)
        for end in (self._wakeup, self._wakeup_end):
            os.close(end)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        # the thread stops the robot: here the driver's lock may be held
        if self._thread is None or not self._thread.is_alive():
            self.stop(signal.Signals(number).name)
        elif not self._stopped:
            self.reason = signal.Signals(number).name
        if number == getattr(signal, "SIGQUIT", None) or not (self._leaving or self._raised):
            self._raised = True
            raise StoppedError(f"stopped by {signal.Signals(number).name}; the tendons are released")

    def _unraisable(self, unraisable: sys.UnraisableHookArgs) -> None:
        # during a destructor or a garbage collection Python drops the error; `check` raises it again
        if not isinstance(unraisable.exc_value, StoppedError):
            self._previous_hook(unraisable)

    def _watch(self) -> None:
        """Wait for keys and signals."""
        watched = [self._wakeup] if self._terminal is None else [self._wakeup, self._terminal]
        while True:
            ready, _, _ = select.select(watched, [], [])
            if self._wakeup in ready:
                numbers = os.read(self._wakeup, 100)
                names = [signal.Signals(number).name for number in numbers if number in self._handlers]
                if names:
                    self.stop(names[0])
                if 0 in numbers:
                    return
            if self._terminal in ready and self._keys() == b"":
                watched = [self._wakeup]

    def _keys(self) -> bytes:
        """Process keys, and return them; empty after the end of the terminal."""
        assert self._terminal is not None
        try:
            keys = os.read(self._terminal, 100)
        except OSError:
            keys = b""
        if not keys:
            self.stop("a lost terminal")
        elif STOP_KEYS & set(keys) or keys == b"\x1b":
            self.stop("a key")
        elif self._other_keys is not None:
            self._other_keys(keys)
        return keys


def _terminal() -> int | None:
    """Return the descriptor of the standard input if it is a terminal that this program may read."""
    try:
        if not sys.stdin.isatty():
            return None
        descriptor = sys.stdin.fileno()
    except (OSError, ValueError, AttributeError):
        return None
    try:
        # a program in the background would be suspended
        return descriptor if os.tcgetpgrp(descriptor) == os.getpgrp() else None
    except OSError:
        # another terminal than the one that controls this program
        return descriptor


def _without_lines(terminal: int) -> Any:
    """Let a terminal give each key at once, and return its mode from before; None if it is no terminal."""
    import termios
    import tty

    try:
        mode = termios.tcgetattr(terminal)
        tty.setcbreak(terminal)
    except termios.error:
        return None
    return mode


def _restore(terminal: int, mode: Any) -> None:
    import termios

    with contextlib.suppress(termios.error):
        termios.tcsetattr(terminal, termios.TCSADRAIN, mode)


@dataclasses.dataclass(frozen=True)
class SafeRegion:
    """Region around the rod's axis at rest, and greatest speed, that the tip must keep.

    Attributes:
        radius: greatest distance from the vertical axis through the base (m).
        low: least height (m).
        high: greatest height (m).
        speed: greatest speed (m/s).
    """

    radius: float = np.inf
    low: float = -np.inf
    high: float = np.inf
    speed: float = np.inf

    def __post_init__(self) -> None:
        if not (self.radius > 0.0 and self.low < self.high and self.speed > 0.0):
            raise HardwareError(
                f"a safe region needs radius and speed above 0, and low below high (got {self})"
            )

    def violation(
        self,
        position: Float[np.ndarray, "3"],
        before: Float[np.ndarray, "3"] | None = None,
        dt: float = np.inf,
    ) -> str:
        """Return the violated limit in words; empty if there is none. NaN violates nothing.

        Args:
            position: of the tip (m).
            before: earlier position (m), `dt` (s) before; None: the speed is not checked.
            dt: time between the two (s).
        """
        away = float(np.hypot(position[0], position[1]))
        if away > self.radius:
            return f"the tip is {away:.3g} m from the axis (allowed: {self.radius:.3g} m)"
        if position[2] < self.low or position[2] > self.high:
            return f"the tip's height is {position[2]:.3g} m (allowed: {self.low:.3g} to {self.high:.3g} m)"
        if before is not None:
            speed = float(np.linalg.norm(position - before)) / dt
            if speed > self.speed:
                return f"the tip moves at {speed:.3g} m/s (allowed: {self.speed:.3g} m/s)"
        return ""
