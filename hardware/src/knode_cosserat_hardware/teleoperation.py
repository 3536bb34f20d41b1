"""Teleoperation: tensions from a gamepad, the keyboard's arrows, a window of sliders, or another device."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import struct
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware.driver import Driver, HardwareError, Limits, Reading
from knode_cosserat_hardware.safety import EmergencyStop

#: events of Linux' joystick devices: time (ms), value, type, number
_EVENT = struct.Struct("<IhBB")
BUTTON, AXIS, INITIAL = 1, 2, 128
#: axes of the left stick and of the right trigger; button that stops (B, circle)
STICK, TRIGGER, STOP_BUTTON = (0, 1), 5, 1
#: part of an axis around its middle that counts as zero
DEAD_ZONE = 0.1
#: change by one key, as part of the range
KEY_STEP = 0.1
_KEYS = {
    b"\x1b[C": (1, 0, 0),
    b"\x1b[D": (-1, 0, 0),
    b"\x1b[A": (0, 1, 0),
    b"\x1b[B": (0, -1, 0),
    b"+": (0, 0, 1),
    b"-": (0, 0, -1),
}


class Wish(NamedTuple):
    """Wanted bending in two directions, each from -1 to 1, and co-contraction from 0 to 1."""

    x: float
    y: float
    contraction: float


class InputDevice(Protocol):
    """Device that a person moves the robot with."""

    def wish(self) -> Any:
        """Return the present wish. Raises `HardwareError` if the device is lost or its stop is pressed."""

    def close(self) -> None:
        """Close the device."""


class Gamepad:
    """A gamepad on Linux. The left stick bends, the right trigger contracts all tendons, button 1 stops.

    Args:
        path: device file, such as "/dev/input/js0".
        axes: numbers of the axes for x, y (down is positive) and contraction (-1 to 1).
        stop_button: number of the button that stops the robot.

    Raises:
        HardwareError: the device cannot be opened.
    """

    def __init__(
        self, path: str, axes: tuple[int, int, int] = (*STICK, TRIGGER), stop_button: int = STOP_BUTTON
    ):
        self.path, self._axes, self._stop_button = path, axes, stop_button
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise HardwareError(
                f"{path}: the gamepad cannot be opened ({error.strerror}); plug it in, see ls /dev/input/js*"
            ) from None
        self._rest = b""
        self._values = dict.fromkeys(axes, 0.0)
        self._values[axes[2]] = -1.0

    def wish(self) -> Wish:
        """Return the present wish.

        Raises:
            HardwareError: the gamepad is lost, or its stop button was pressed.
        """
        for _, value, kind, number in self._events():
            if kind & ~INITIAL == AXIS and number in self._values:
                self._values[number] = value / 32767.0
            elif kind == BUTTON and number == self._stop_button and value:
                raise HardwareError(f"{self.path}: the stop button {number} was pressed")
        x, y, contraction = (self._values[axis] for axis in self._axes)
        return Wish(_outside(x), _outside(-y), min(max(0.5 * (contraction + 1.0), 0.0), 1.0))

    def close(self) -> None:
        """Close the device."""
        os.close(self._file)

    def _events(self) -> list[tuple[int, int, int, int]]:
        data, ended = self._rest, False
        while not ended:
            try:
                read = os.read(self._file, 64 * _EVENT.size)
            except BlockingIOError:
                break
            except OSError as error:
                reason = "it was unplugged" if error.errno == errno.ENODEV else error.strerror
                raise HardwareError(f"{self.path}: the gamepad is lost ({reason})") from None
            data, ended = data + read, not read
        if ended and len(data) < _EVENT.size:
            raise HardwareError(f"{self.path}: the gamepad is lost (end of the device)")
        whole = len(data) // _EVENT.size * _EVENT.size
        self._rest = data[whole:]
        return list(_EVENT.iter_unpack(data[:whole]))


class Keyboard:
    """Arrows bend by steps, + and - change the co-contraction, 0 releases. `press` takes the keys' bytes."""

    def __init__(self) -> None:
        self._keys: deque[bytes] = deque(maxlen=100)
        self._wish = np.zeros(3)

    def press(self, keys: bytes) -> None:
        """Take bytes from a terminal, from any thread."""
        self._keys.append(keys)

    def wish(self) -> Wish:
        """Return the present wish."""
        while self._keys:
            data = self._keys.popleft()
            while data:
                known = next((key for key in _KEYS if data.startswith(key)), data[:1])
                data = data[len(known) :]
                if known == b"0":
                    self._wish[:] = 0.0
                self._wish += KEY_STEP * np.array(_KEYS.get(known, (0, 0, 0)))
            self._wish = np.clip(self._wish, (-1.0, -1.0, 0.0), 1.0)
        x, y, contraction = (float(value) for value in self._wish)
        return Wish(x, y, contraction)

    def close(self) -> None:
        """Do nothing: the terminal belongs to the emergency stop."""


def _outside(value: float) -> float:
    """Return an axis without its dead zone, from -1 to 1."""
    size = max(0.0, abs(value) - DEAD_ZONE) / (1.0 - DEAD_ZONE)
    return float(np.copysign(min(size, 1.0), value)) if size else 0.0


@dataclasses.dataclass(frozen=True)
class TensionMap:
    """Map from bending and co-contraction to tensions.

    Tendon k pulls towards its angle a_k. Its tension is low + (high - low) (c + x cos a_k + y sin a_k),
    within low and high, with the co-contraction c.

    Attributes:
        angles: angles of the tendons (rad).
        low: least tension (N).
        high: greatest tension (N).
    """

    angles: tuple[float, ...]
    low: float
    high: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.low < self.high < np.inf:
            raise HardwareError(
                f"low must be 0 or more and below high (got {self.low:g} and {self.high:g} N)"
            )

    @classmethod
    def of(cls, limits: Limits, count: int) -> TensionMap:
        """Return the map of evenly spaced tendons, the first one in the x direction, and of limits.

        The greatest tension is reduced so that all tendons together keep the greatest sum.
        """
        angles = tuple(2.0 * np.pi * k / count for k in range(count))
        return cls(angles, limits.low, min(limits.high, limits.total / count))

    def tensions(self, wish: Wish) -> Float[np.ndarray, " c"]:
        """Return the tensions (N) of a wish."""
        bend = np.array([wish.x, wish.y])
        # a stick in a corner is longer than 1
        bend = bend / max(1.0, float(np.linalg.norm(bend)))
        part = wish.contraction + bend[0] * np.cos(self.angles) + bend[1] * np.sin(self.angles)
        return np.asarray(self.low + (self.high - self.low) * np.clip(part, 0.0, 1.0))


def teleoperate(
    driver: Driver,
    device: InputDevice,
    mapping: TensionMap | None,
    emergency: EmergencyStop,
    *,
    seconds: float = np.inf,
    dt: float = 0.04,
    shown: Callable[[Any, Sequence[float], Reading], Any] | None = None,
) -> int:
    """Move a robot by an input device until a time or a stop, and return the number of commands.

    Args:
        driver: a connected driver; it is armed, and disarmed at the end.
        device: gamepad, keyboard or window of sliders.
        mapping: map from wishes to tensions; None for sliders, whose wishes are tensions.
        emergency: emergency stop around it.
        seconds: duration (s).
        dt: time between commands (s).
        shown: called with wish, sent tensions (N) and reading after each command.

    Raises:
        HardwareError: the robot has a fault, or the device is lost; the robot was stopped.
    """
    count = 0
    try:
        driver.arm()
        while count * dt < seconds:
            emergency.check()
            wish = device.wish()
            sent = driver.command(wish if mapping is None else mapping.tensions(wish))
            reading = driver.read()
            if shown is not None:
                shown(wish, list(sent), reading)
            count += 1
            driver.wait(dt)
    except HardwareError:
        emergency.stop("an error")
        raise
    driver.disarm()
    return count


#: colours: of the stop, of a robot that moves, rests, or has a fault
STOP, COLOURS = "#c62828", {"armed": "#2e7d32", "ready": "#455a64", "fault": "#c62828"}
#: height of a slider (pixels)
HEIGHT = 260


class SliderWindow:
    """Window of sliders for `teleoperate`. Space, Escape and closing the window stop the robot too.

    A wish is the tensions (N) of the sliders.

        window = SliderWindow(driver.tendon_count, 0.2, 5.0)
        with EmergencyStop(driver) as emergency, contextlib.closing(window):
            teleoperate(driver, window, None, emergency, shown=window.show)

    All calls must come from the main thread.

    Args:
        tendons: number of tendons.
        low: least tension (N).
        high: greatest tension (N).
        title: title of the window.

    Raises:
        HardwareError: there is no display, or no Tkinter.
    """

    def __init__(self, tendons: int, low: float, high: float, title: str = "robot"):
        if not 0.0 <= low < high < np.inf:
            raise HardwareError(f"low must be 0 or more and below high (got {low:g} and {high:g} N)")
        try:
            import tkinter as tk
        except ImportError:
            raise HardwareError("sliders need Tkinter: on Debian, apt-get install python3-tk") from None
        try:
            self._root = root = tk.Tk()
        except tk.TclError as error:
            raise HardwareError(f"sliders need a display ({error!s:.60})") from None
        self.low, self.high = float(low), float(high)
        self._stopped = ""
        root.title(title)
        root.protocol("WM_DELETE_WINDOW", lambda: self._stop("the window was closed"))
        for key in ("<space>", "<Escape>"):
            # for the whole window, before a widget that has the focus acts on the key
            root.bind_all(key, lambda _: self._stop("a key was pressed in the window"))
        self._state = tk.Label(root, text="ready", font=("TkDefaultFont", 16, "bold"), fg="white", bg="black")
        self._state.pack(fill="x", ipady=6)
        columns = tk.Frame(root)
        columns.pack(padx=12, pady=8)
        self._scales: list[Any] = []
        self._readings: list[Any] = []
        for k in range(tendons):
            self._add_tendon(tk, columns, k)
        tk.Button(root, text="Release all", command=self.release).pack(fill="x", padx=12)
        self._button = tk.Button(
            root,
            text="STOP",
            font=("TkDefaultFont", 28, "bold"),
            fg="white",
            bg=STOP,
            takefocus=0,
            activebackground=STOP,
            activeforeground="white",
            command=lambda: self._stop("STOP was pressed"),
        )
        self._button.pack(fill="both", padx=12, pady=12, ipady=14)
        root.update()

    def _add_tendon(self, tk: Any, parent: Any, k: int) -> None:
        column = tk.Frame(parent)
        column.grid(row=0, column=k, padx=10)
        tk.Label(column, text=f"tendon {k + 1}", font=("TkDefaultFont", 11, "bold")).pack()
        scale = tk.Scale(
            column,
            from_=self.high,
            to=self.low,
            resolution=0.05,
            length=HEIGHT,
            width=26,
            orient="vertical",
            showvalue=True,
        )
        scale.set(self.low)
        scale.pack()
        reading = tk.Label(column, text="measured\n- N", width=11)
        reading.pack()
        self._scales.append(scale)
        self._readings.append(reading)

    def wish(self) -> Float[np.ndarray, " c"]:
        """Return the tensions (N) of the sliders, after what the person did.

        Raises:
            HardwareError: STOP was pressed, or the window was closed.
        """
        if not self._stopped:
            self._root.update()
        if self._stopped:
            raise HardwareError(f"{self._stopped}; the robot was stopped")
        return np.clip([float(scale.get()) for scale in self._scales], self.low, self.high)

    def show(self, wish: Any, sent: Any, reading: Reading) -> None:
        """Show the state and the measured tensions of a reading."""
        state = reading.state.value
        text = f"{state}: {reading.fault}" if reading.fault else state
        self._state.configure(text=text, bg=COLOURS.get(state, "black"))
        for label, value in zip(self._readings, reading.tension, strict=True):
            label.configure(text=f"measured\n{value:.2f} N")

    def release(self) -> None:
        """Set all sliders to the least tension."""
        for scale in self._scales:
            scale.set(self.low)

    def close(self) -> None:
        """Close the window. A second call does nothing."""
        with contextlib.suppress(Exception):
            self._root.destroy()

    def _stop(self, reason: str) -> None:
        self._stopped = self._stopped or reason
