"""Simulated load cells with settings, by the names and units of the wire protocol."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.lines import GRAM_FORCE

#: settings and their first values, in the units of the wire protocol
SETTINGS = {"kp": 64, "ki": 256, "kd": 0, "limit": 2300, "jog": 80, "watchdog": 60, "release": 500}
#: gain of each load cell (1/4096 gf per count)
GAIN = 1024
#: number of conversions of a tare
CONVERSIONS = 25


@dataclasses.dataclass(frozen=True)
class MachineParameters:
    """Parameters of a simulated machine around the rod.

    Attributes:
        lag: time constant of the tensions (s).
        noise: standard deviation of the load cells (N).
        offset: of the load cells before they are tared (N).
        gain_error: relative error of the load cells' calibration.
        seed: of the noise.
    """

    lag: float = 0.05
    noise: float = 0.02
    offset: float = 0.3
    gain_error: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (self.lag >= 0.0 and self.noise >= 0.0):
            raise HardwareError(
                f"lag and noise must be zero or more (got {self.lag:g} s and {self.noise:g} N)"
            )


class SimulatedLoadCells:
    """Load cells with noise, offset and an error of their gain, and the settings of their board.

    Args:
        machine: errors of the cells.
        count: number of tendons.
    """

    def __init__(self, machine: MachineParameters, count: int):
        self.machine, self.count = machine, count
        self._random = np.random.default_rng(machine.seed)
        self.settings = dict(SETTINGS)
        for k in range(1, count + 1):
            self.settings |= {f"gain{k}": GAIN, f"zero{k}": 0}

    def counts(self, force: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        """Return one conversion of true forces (N), in counts."""
        machine = self.machine
        noise = machine.noise * self._random.normal(size=self.count)
        return (force * (1.0 + machine.gain_error) + machine.offset + noise) / GRAM_FORCE * 4096.0 / GAIN

    def measured(self, force: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        """Return one measurement of true forces (N), by the settings (N)."""
        zero, gain = (
            np.array([self.settings[f"{name}{k + 1}"] for k in range(self.count)], dtype=float)
            for name in ("zero", "gain")
        )
        return (self.counts(force) - zero) * gain / 4096.0 * GRAM_FORCE

    def tare(self, force: Float[np.ndarray, " c"]) -> None:
        """Take the present readings as zero."""
        counts = np.mean([self.counts(force) for _ in range(CONVERSIONS)], axis=0)
        for k, zero in enumerate(counts):
            self.settings[f"zero{k + 1}"] = round(zero)

    def setting(self, name: str) -> int:
        """Return a setting. Raises `HardwareError` if there is none of this name."""
        if name not in self.settings:
            raise HardwareError(f"the setting {name!r} is unknown{did_you_mean(name, list(self.settings))}")
        return self.settings[name]

    def change(self, name: str, value: int) -> int:
        """Change a setting, and return it. Raises `HardwareError` if name or value are not allowed."""
        self.setting(name)
        if isinstance(value, bool) or value != int(value):
            raise HardwareError(f"{name} must be a whole number (got {value!r})")
        self.settings[name] = int(value)
        return self.settings[name]
