"""Geared DC motors with reels, and load cells."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware.lines import GRAM_FORCE


@dataclasses.dataclass(frozen=True)
class MotorParameters:
    """Geared DC motor with a reel; all values are at the reel's surface unless stated.

    The defaults are nominal values of a JGA25-371 with a gear of 1:34 and a reel of 10 mm radius. They are
    typical for this size; no motor was measured.

    Attributes:
        voltage: supply (V).
        resistance: of winding and bridge (ohm).
        inductance: of the winding (H).
        speed: without load at the supply's voltage (m/s).
        force: of the stalled motor at this voltage (N).
        mass: rotor and gear, moved along with the tendon (kg).
        friction: of the gear (N).
        backlash: of the gear (m).
        pull: force that the reel needs to move through the backlash, per speed (N s/m).
    """

    voltage: float = 12.0
    resistance: float = 5.5
    inductance: float = 2.0e-3
    speed: float = 0.29
    force: float = 42.0
    mass: float = 2.3
    friction: float = 3.0
    backlash: float = 1.5e-4
    pull: float = 60.0


class Motors:
    """Motors of all tendons, moved by implicit steps: `position` is the length that each reel took in (m)."""

    def __init__(self, count: int, parameters: MotorParameters):
        self.parameters = parameters
        self.current, self.speed = np.zeros(count), np.zeros(count)
        self.rotor, self.position = np.zeros(count), np.zeros(count)

    def step(
        self, drive: Float[np.ndarray, " c"], tension: Float[np.ndarray, " c"], h: float, powered: bool = True
    ) -> None:
        """Move on by `h` (s) under duty cycles and tensions (N). Without power the motors turn freely."""
        p = self.parameters
        back_emf, force_per_current = p.voltage / p.speed, p.force * p.resistance / p.voltage
        # current at the end of the step: a - b v
        divisor = 1.0 + h * p.resistance / p.inductance
        a = (self.current + h / p.inductance * p.voltage * drive) / divisor
        b = h / p.inductance * back_emf / divisor
        if not powered:
            a, b = np.zeros_like(a), 0.0
        inertia = p.mass / h + force_per_current * b
        free = (p.mass / h * self.speed + force_per_current * a - tension) / inertia
        self.speed = np.sign(free) * np.maximum(np.abs(free) - p.friction / inertia, 0.0)
        self.current = a - b * self.speed
        self.rotor = self.rotor + h * self.speed
        half = 0.5 * p.backlash
        moved = self.position - h * tension / p.pull
        self.position = np.clip(moved, self.rotor - half, self.rotor + half)


@dataclasses.dataclass(frozen=True)
class LoadCellParameters:
    """Load cells with their amplifiers.

    Attributes:
        offset: voltage of a slack tendon (V).
        sensitivity: voltage per force (V/N). By default a gram-force is a quarter of a converter's step.
        spread: standard deviation of the cells' relative sensitivity and of their relative offset.
        noise: standard deviation of a conversion (V).
    """

    offset: float = 0.5
    sensitivity: float = 0.25 * 5.0 / 1023.0 / GRAM_FORCE
    spread: float = 0.0
    noise: float = 2.0e-3


class LoadCells:
    """Load cells of all tendons, with noise, and faults that are injected."""

    def __init__(self, count: int, parameters: LoadCellParameters, random: np.random.Generator):
        self._random, self._noise = random, parameters.noise
        spread = parameters.spread * random.normal(size=(2, count))
        self.offset = parameters.offset * (1.0 + spread[0])
        self.sensitivity = parameters.sensitivity * (1.0 + spread[1])
        #: voltage at which a cell is stuck (V); NaN: it works
        self.stuck = np.full(count, np.nan)
        self._last = self.offset.copy()

    def millivolts(self, tension: Float[np.ndarray, " c"]) -> list[int]:
        """Return the voltages (mV) of one conversion."""
        volts = (
            self.offset + self.sensitivity * tension + self._noise * self._random.normal(size=len(tension))
        )
        self._last = np.where(np.isnan(self.stuck), volts, self.stuck)
        return [int(value) for value in np.clip(np.rint(1e3 * self._last), 0, 5000)]

    def freeze(self, tendon: int) -> None:
        """Let a cell repeat its last voltage."""
        self.stuck[tendon] = self._last[tendon]
