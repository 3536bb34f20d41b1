"""Identifiable effects: each is one physical cause with its numbers, units and prior ranges.

An effect changes parameters of a robot. At their nominal values it changes nothing, so one compiled program
serves any selection of effects: unselected parameters stay nominal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

#: change of a robot by the values of an effect's parameters; equal for all robots of the same parts
Change = Callable[[Any, list[Any]], Any]


class Number(NamedTuple):
    """One number of an effect: its nominal value, and the standard deviation of its prior.

    The search moves x = (value - nominal) / width, or log(value / nominal) / width if `logarithmic`. It
    starts at `begin`, in these coordinates: for example, friction has no derivative at zero.
    """

    label: str
    unit: str
    nominal: float
    width: float
    low: float = -np.inf
    high: float = np.inf
    logarithmic: bool = False
    begin: float = 0.0

    def value(self, x: Any) -> Any:
        """Return the value at a coordinate; it may be traced."""
        if self.logarithmic:
            return self.nominal * jnp.exp(self.width * x)
        return self.nominal + self.width * x

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value: the inverse of `value`."""
        moved = np.log(value / self.nominal) if self.logarithmic else value - self.nominal
        return float(moved / self.width)

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest coordinate."""
        if self.logarithmic:
            with np.errstate(divide="ignore"):
                low, high = (
                    np.log(max(end, 0.0) / self.nominal) / self.width for end in (self.low, self.high)
                )
        else:
            low, high = ((end - self.nominal) / self.width for end in (self.low, self.high))
        return float(low), float(high)


@dataclasses.dataclass(frozen=True)
class Effect:
    """A physical cause, its parameters, and the change that it makes to a robot.

    `needs` names effects that it requires. A `basic` effect is always identified. A search with few effects
    starts with the `usual` ones. An effect `of_recordings` belongs to the recordings, not to the robot.
    """

    name: str
    meaning: str
    numbers: tuple[Number, ...]
    apply: Change
    needs: tuple[str, ...] = ()
    basic: bool = False
    usual: bool = False
    of_recordings: bool = False


@dataclasses.dataclass(frozen=True)
class Replace:
    """Replaces parameters of a robot; equal to another by their names, so that programs are shared."""

    parameters: tuple[str, ...]

    def __call__(self, robot: Any, values: list[Any]) -> Any:
        """Return the robot with these values."""
        return robot.replace(**dict(zip(self.parameters, values, strict=True)))


@dataclasses.dataclass(frozen=True)
class ReplaceInPart:
    """Replaces parameters of one of the robot's parts."""

    part: str
    parameters: tuple[str, ...]

    def __call__(self, robot: Any, values: list[Any]) -> Any:
        """Return the robot with these values."""
        changes = dict(zip(self.parameters, values, strict=True))
        return robot.replace(**{self.part: dataclasses.replace(getattr(robot, self.part), **changes)})


@dataclasses.dataclass(frozen=True)
class ReplaceMasses:
    """Replaces the masses of a robot's loads, by their numbers in `loads`."""

    loads: tuple[int, ...]

    def __call__(self, robot: Any, values: list[Any]) -> Any:
        """Return the robot with these masses (kg)."""
        loads = list(robot.loads)
        for k, mass in zip(self.loads, values, strict=True):
            loads[k] = dataclasses.replace(loads[k], mass=mass)
        return robot.replace(loads=tuple(loads))


def along_axes(label: str, unit: str, width: float, axes: str = "xyz", **more: Any) -> tuple[Number, ...]:
    """Return one number for each axis, nominally zero."""
    return tuple(Number(f"{label}.{axis}", unit, 0.0, width, **more) for axis in axes)
