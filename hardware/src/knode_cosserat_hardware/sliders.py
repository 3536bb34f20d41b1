"""Window with a slider for each tendon, a button that stops, and the robot's readings."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware.driver import HardwareError, Reading

#: colours: of the stop, of a robot that moves, rests, or has a fault
STOP, COLOURS = "#c62828", {"armed": "#2e7d32", "ready": "#455a64", "fault": "#c62828"}
#: height of a slider (pixels)
HEIGHT = 260


class SliderWindow:
    """Window of sliders for `teleoperate`. Space, Escape and closing the window stop the robot too.

    Its map from wishes to tensions is itself: a wish is the tensions (N) of the sliders.

        window = SliderWindow(driver.tendon_count, 0.2, 5.0)
        with EmergencyStop(driver) as emergency, contextlib.closing(window):
            teleoperate(driver, window, window, emergency, shown=window.show)

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
            root, text="STOP", font=("TkDefaultFont", 28, "bold"), fg="white", bg=STOP, takefocus=0,
            activebackground=STOP, activeforeground="white", command=lambda: self._stop("STOP was pressed"),
        )  # fmt: skip
        self._button.pack(fill="both", padx=12, pady=12, ipady=14)
        root.update()

    def _add_tendon(self, tk: Any, parent: Any, k: int) -> None:
        column = tk.Frame(parent)
        column.grid(row=0, column=k, padx=10)
        tk.Label(column, text=f"tendon {k + 1}", font=("TkDefaultFont", 11, "bold")).pack()
        scale = tk.Scale(
            column, from_=self.high, to=self.low, resolution=0.05, length=HEIGHT, width=26, orient="vertical",
            showvalue=True,
        )  # fmt: skip
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

    def tensions(self, wish: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        """Return the tensions of a wish: they are the same."""
        return np.asarray(wish, dtype=float)

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
