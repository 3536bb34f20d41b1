"""Outputs of a robot that are measured by sensors, or tracked by a controller."""

from __future__ import annotations

import abc
import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.system import System
from knode_cosserat.rotation import conjugate, quaternion_product
from knode_cosserat.solvers.places import places_at, positions_at, quaternions_at
from knode_cosserat.trajectory import Trajectory


@dataclasses.dataclass(frozen=True)
class Output(abc.ABC):
    """A vector of numbers that follows from the state of a robot at one time.

    NaN in a measurement or a reference means: not measured, or not tracked.
    """

    @property
    @abc.abstractmethod
    def labels(self) -> tuple[str, ...]:
        """Name and unit of every number of a value."""

    @property
    @abc.abstractmethod
    def noise(self) -> Float[np.ndarray, " e"]:
        """Standard deviation of every number of an error: a sensor's noise, or an acceptable error."""

    @abc.abstractmethod
    def value(self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"]) -> Float[Any, " p"]:
        """Return the output of a state, from y and z at the nodes."""

    def error(
        self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"], reference: Float[Any, " p"]
    ) -> Float[Any, " e"]:
        """Return the output of a state less a reference; NaN where the reference is NaN."""
        return self.value(system, y, z) - reference

    @property
    def size(self) -> int:
        """Number of numbers in a value."""
        return len(self.labels)


def _checked_fractions(fractions: Any) -> tuple[float, ...]:
    given = tuple(float(part) for part in np.atleast_1d(fractions))
    if not given or not all(0.0 <= part <= 1.0 for part in given):
        raise ValueError(f"fractions are {given}; allowed are parts of the length from 0 to 1")
    return given


def _xyz(name: str, unit: str) -> tuple[str, ...]:
    return tuple(f"{name}.{axis} ({unit})" for axis in "xyz")


@dataclasses.dataclass(frozen=True)
class BodyPositions(Output):
    """Positions (m) of points on the rod at fractions of its length, global frame."""

    fractions: tuple[float, ...]
    #: standard deviation (m)
    sigma: float = 2e-4

    def __post_init__(self) -> None:
        object.__setattr__(self, "fractions", _checked_fractions(self.fractions))

    @property
    def labels(self) -> tuple[str, ...]:
        """Name and unit of every number of a value."""
        return tuple(label for part in self.fractions for label in _xyz(f"position[{part:g}]", "m"))

    @property
    def noise(self) -> Float[np.ndarray, " e"]:
        """Standard deviation of every number of an error."""
        return np.full(self.size, self.sigma)

    def value(self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"]) -> Float[Any, " p"]:
        """Return the positions, one after the other."""
        places = places_at(np.asarray(self.fractions), system.nodes)
        return positions_at(system, y[None], places, z[None])[0].ravel()


@dataclasses.dataclass(frozen=True)
class TipPosition(BodyPositions):
    """Position (m) of the tip, global frame."""

    fractions: tuple[float, ...] = (1.0,)


@dataclasses.dataclass(frozen=True)
class BodyPoses(Output):
    """Positions (m) and unit quaternions (scalar first) at fractions of the length.

    An error of an orientation is the rotation vector (rad) from the reference, in its own frame.
    """

    fractions: tuple[float, ...]
    #: standard deviations of positions (m) and of rotations (rad)
    sigma: float = 2e-4
    sigma_rotation: float = 2e-3

    def __post_init__(self) -> None:
        object.__setattr__(self, "fractions", _checked_fractions(self.fractions))

    @property
    def labels(self) -> tuple[str, ...]:
        """Name and unit of every number of a value."""
        found: list[str] = []
        for part in self.fractions:
            found += [*_xyz(f"position[{part:g}]", "m"), *(f"quaternion[{part:g}].{k}" for k in "wxyz")]
        return tuple(found)

    @property
    def noise(self) -> Float[np.ndarray, " e"]:
        """Standard deviation of every number of an error."""
        one = np.repeat([self.sigma, self.sigma_rotation], 3)
        return np.tile(one, len(self.fractions))

    def value(self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"]) -> Float[Any, " p"]:
        """Return position and quaternion of each place."""
        places = places_at(np.asarray(self.fractions), system.nodes)
        p, h = positions_at(system, y[None], places, z[None])[0], quaternions_at(system, y[None], places)[0]
        return jnp.concatenate([p, h], axis=1).ravel()

    def error(
        self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"], reference: Float[Any, " p"]
    ) -> Float[Any, " e"]:
        """Return differences of positions (m) and rotation vectors (rad)."""
        now, wanted = (each.reshape(-1, 7) for each in (self.value(system, y, z), reference))
        parts = []
        for k in range(len(self.fractions)):
            turned = quaternion_product(conjugate(wanted[k, 3:]), now[k, 3:])
            shorter = jnp.where(turned[0] < 0.0, -1.0, 1.0)
            parts += [now[k, :3] - wanted[k, :3], 2.0 * shorter * turned[1:]]
        return jnp.concatenate(parts)


@dataclasses.dataclass(frozen=True)
class TipPose(BodyPoses):
    """Position (m) and unit quaternion of the tip."""

    fractions: tuple[float, ...] = (1.0,)


@dataclasses.dataclass(frozen=True)
class Curvatures(Output):
    """Curvatures u (1/m) about the material x and y axes at fractions of the length (Bragg gratings)."""

    fractions: tuple[float, ...]
    #: standard deviation (1/m)
    sigma: float = 0.02

    def __post_init__(self) -> None:
        object.__setattr__(self, "fractions", _checked_fractions(self.fractions))

    @property
    def labels(self) -> tuple[str, ...]:
        """Name and unit of every number of a value."""
        return tuple(f"curvature[{part:g}].{axis} (1/m)" for part in self.fractions for axis in "xy")

    @property
    def noise(self) -> Float[np.ndarray, " e"]:
        """Standard deviation of every number of an error."""
        return np.full(self.size, self.sigma)

    def value(self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"]) -> Float[Any, " p"]:
        """Return the curvatures, interpolated linearly between nodes."""
        places = places_at(np.asarray(self.fractions), system.nodes)
        u = system.z_layout.get(z, "u")[..., :2]
        part = jnp.asarray(places.part)[:, None]
        return ((1.0 - part) * u[places.node] + part * u[places.node + 1]).ravel()


@dataclasses.dataclass(frozen=True)
class BaseWrench(Output):
    """Force (N) and moment (N m) that the base exerts on the rod, global frame: a force sensor there."""

    #: standard deviations of the force (N) and of the moment (N m)
    sigma: float = 0.02
    sigma_moment: float = 2e-3

    @property
    def labels(self) -> tuple[str, ...]:
        """Name and unit of every number of a value."""
        return (*_xyz("force", "N"), *_xyz("moment", "N m"))

    @property
    def noise(self) -> Float[np.ndarray, " e"]:
        """Standard deviation of every number of an error."""
        return np.repeat([self.sigma, self.sigma_moment], 3)

    def value(self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"]) -> Float[Any, " p"]:
        """Return the internal force and moment at the base."""
        return jnp.concatenate([system.y_layout.get(y[0], "n"), system.y_layout.get(y[0], "m")])


def final_output(system: System, trajectory: Trajectory, output: Output) -> Float[np.ndarray, " p"]:
    """Return an output (p,) at the last row of a trajectory, by one compiled program for each output."""
    return np.asarray(_value(system, np.asarray(trajectory.y[-1]), np.asarray(trajectory.z[-1]), output))


@functools.partial(jax.jit, static_argnames="output")
def _value(system: System, y: Any, z: Any, output: Output) -> Any:
    return output.value(system, y, z)
