"""Plants: robots that a loop moves and measures. Simulated ones are here; hardware has its own drivers."""

from __future__ import annotations

import abc
import dataclasses
from collections import deque
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.outputs import Output, final_output
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.stepper import Stepper
from knode_cosserat.trajectory import Trajectory


@dataclasses.dataclass(frozen=True)
class Sensor:
    """Sensor of a simulated plant.

    Attributes:
        output: the measured output.
        noise: multiple of the output's standard deviations; 0 for exact measurements.
        latency: age of a measurement in periods.
        dropout: probability that a measurement is lost.
        seed: of the noise.
    """

    output: Output
    noise: float = 0.0
    latency: int = 0
    dropout: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.dropout < 1.0:
            raise ValueError(f"dropout is {self.dropout}; allowed is 0 to less than 1")
        if self.latency < 0 or self.noise < 0.0:
            raise ValueError("latency and noise must not be negative")


class Readings:
    """Readings of a sensor in a running loop: values with noise, some lost, delayed by the latency."""

    def __init__(self, sensor: Sensor):
        self.sensor, self.random = sensor, np.random.default_rng(sensor.seed)
        self._queue: deque[Any] = deque(maxlen=sensor.latency + 1)

    def add(self, value: Any) -> None:
        """Take a true value of the output, at the time of a period."""
        sensor, value = self.sensor, np.array(value)
        if sensor.noise and len(sensor.output.noise) == len(value):
            value = value + sensor.noise * sensor.output.noise * self.random.normal(size=len(value))
        if self.random.uniform() < sensor.dropout:
            value = np.full(len(value), np.nan)
        self._queue.append(value)

    def current(self) -> Float[np.ndarray, " p"]:
        """Return the reading of this time, or an older one if the sensor has latency."""
        return np.array(self._queue[0])


class Plant(abc.ABC):
    """A robot that moves by one period at a time."""

    #: period (s)
    dt: float
    #: number of periods that began late, counted by plants that keep the time
    missed: int = 0

    def rehearsal(self) -> Plant:
        """Return the plant that a loop is compiled with before it starts: by default this one; it moves."""
        return self

    @abc.abstractmethod
    def start(self) -> Float[np.ndarray, " c"]:
        """Go to the start, and return the control that acts there."""

    @abc.abstractmethod
    def measure(self) -> Float[np.ndarray, " p"]:
        """Return the measurement of this time; NaN if it was lost."""

    @abc.abstractmethod
    def apply(self, control: Float[np.ndarray, " c"]) -> None:
        """Move on by one period under a control."""

    def acting(self) -> tuple[Float[np.ndarray, " c"], float] | None:
        """Return the newest measured controls (c,) and their age (s); None if they are not measured."""
        return None

    def tip(self) -> Float[np.ndarray, "3"]:
        """Return the true position of the tip (m, robot's frame), for the report; NaN if it is not known."""
        return np.full(3, np.nan)


class SimulatedPlant(Plant):
    """A simulated robot, which may differ from the controller's model, with a sensor."""

    def __init__(
        self,
        robot: System,
        dt: float,
        sensor: Sensor,
        *,
        substeps: int = 1,
        control_noise: float = 0.0,
        initial: Trajectory | Literal["equilibrium", "unstressed"] = "equilibrium",
    ):
        """Set up the robot at rest, under zero control, or at the last row of a trajectory.

        Args:
            robot: the true robot.
            dt: period (s).
            sensor: what is measured, and how well.
            substeps: steps of the simulation in each period.
            control_noise: standard deviation by which acting controls differ from commanded ones, in their
                unit, independent in each period.
            initial: where it starts, as in `simulate`.
        """
        self.robot, self.dt, self.sensor = robot, float(dt), sensor
        if control_noise < 0.0:
            raise ValueError(f"control_noise is {control_noise}; allowed is zero or more")
        self._substeps, self._initial, self._control_noise = substeps, initial, control_noise
        self.start()

    def start(self) -> Float[np.ndarray, " c"]:
        """Go to the start, and return the control that acts there."""
        self._stepper = Stepper(self.robot, self.dt / self._substeps, initial=self._initial)
        self._readings = Readings(self.sensor)
        self._sense()
        return np.asarray(self._stepper.state.control[-1])

    def apply(self, control: Float[np.ndarray, " c"]) -> None:
        """Move on by one period under a control."""
        control = np.asarray(control, dtype=float)
        if self._control_noise:
            control = control + self._control_noise * self._readings.random.normal(size=len(control))
        for _ in range(self._substeps):
            self._stepper.step(control)
        self._sense()

    def _sense(self) -> None:
        self._readings.add(final_output(self.robot, self._stepper.state, self.sensor.output))

    def measure(self) -> Float[np.ndarray, " p"]:
        """Return the measurement of this time, or an older one if the sensor has latency."""
        return self._readings.current()

    @property
    def state(self) -> Trajectory:
        """True state, a trajectory of one row."""
        return self._stepper.state

    def tip(self) -> Float[np.ndarray, "3"]:
        """Return the true position of the tip (m)."""
        y = np.asarray(self._stepper.state.y[-1, -1:])
        return np.asarray(Drawing.of(self.robot).positions(y))[-1]
