"""Domain randomisation: parameters, delays, noise and models that differ from episode to episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from knode_cosserat.envs.errors import TaskError
from knode_cosserat.rods.parameters import ParameterError
from knode_cosserat.rods.paths import value_at
from knode_cosserat.rods.system import System

#: longest delay of commands, in periods
LONGEST_DELAY = 50


@dataclasses.dataclass(frozen=True)
class Uniform:
    """Uniform distribution of a parameter's value, in its own unit."""

    low: float
    high: float

    def ends(self, value: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the greatest value of a parameter whose nominal value is `value`."""
        return np.full(np.shape(value), self.low), np.full(np.shape(value), self.high)


@dataclasses.dataclass(frozen=True)
class Factor:
    """Uniform distribution of a factor on a parameter's nominal value; one factor for all its numbers."""

    low: float
    high: float

    def ends(self, value: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the greatest value of a parameter whose nominal value is `value`."""
        value = np.asarray(value, dtype=float)
        return self.low * value, self.high * value


@dataclasses.dataclass(frozen=True)
class Randomisation:
    """Distributions from which each episode draws its robot.

        Randomisation({"youngs_modulus": Factor(0.8, 1.2), "loads.0.mass": Uniform(0.0, 0.03)}, noise=5e-4)

    Attributes:
        parameters: distribution of each parameter, by its name in `System.replace`.
        change: probability that an episode draws the parameters again, at a random time within it.
        delay: least and greatest delay of the commands (periods).
        noise: standard deviation of measured positions (m).
        models: systems with the same structure as the robot, such as members of an ensemble with learned
            residuals; each episode has one of them instead of the robot.
    """

    parameters: Mapping[str, Uniform | Factor] = dataclasses.field(default_factory=dict)
    change: float = 0.0
    delay: tuple[int, int] = (0, 0)
    noise: float = 0.0
    models: tuple[System, ...] = ()

    def __post_init__(self) -> None:
        for name, each in self.parameters.items():
            if not isinstance(each, Uniform | Factor):
                raise TaskError(
                    f"the distribution of {name} is {each!r}; allowed is Uniform(low, high) or "
                    "Factor(low, high)"
                )
            if not np.isfinite([each.low, each.high]).all() or each.low > each.high:
                raise TaskError(f"the distribution of {name} is {each!r}; low must not exceed high")
        if not 0.0 <= self.change <= 1.0:
            raise TaskError(f"change is {self.change!r}; allowed is a probability, 0 to 1")
        least, most = self.delay
        if not 0 <= least <= most <= LONGEST_DELAY or least != int(least) or most != int(most):
            raise TaskError(
                f"delay is {self.delay!r}; allowed are two whole numbers of periods, 0 to {LONGEST_DELAY}, "
                "the least first"
            )
        if not 0.0 <= self.noise < np.inf:
            raise TaskError(f"noise is {self.noise!r}; allowed is zero or more metres")

    def ends(self, robot: System) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Return the least and the greatest value of each parameter of a robot.

        Raises:
            ParameterError: a parameter that does not exist, or a range with values that are not allowed.
        """
        low: dict[str, np.ndarray] = {}
        high: dict[str, np.ndarray] = {}
        for name, each in self.parameters.items():
            value = value_at(robot.nominal, name)
            if value is None:
                raise ParameterError(
                    f"{name} is not set for this robot, so it cannot be varied; set it with replace first"
                )
            low[name], high[name] = each.ends(value)
        for ends in (low, high):
            robot.replace(**ends)
        return low, high
