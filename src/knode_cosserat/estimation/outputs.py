"""Outputs of a robot that are measured by sensors, or tracked by a controller."""

from __future__ import annotations

import abc
import dataclasses
import re
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.system import System
from knode_cosserat.rotation import conjugate, quaternion_product, rotation_matrix
from knode_cosserat.solvers.places import places_on, quaternions_at, seen_positions, seen_quaternions
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

    def errors(
        self, system: System, y: Float[Any, "T N y"], z: Float[Any, "T N z"], references: Float[Any, "T p"]
    ) -> Float[Any, "T e"]:
        """Return the errors of consecutive rows; an output may compare rows with the first one."""
        return jax.vmap(lambda *row: self.error(system, *row))(y, z, references)

    @property
    def size(self) -> int:
        """Number of numbers in a value."""
        return len(self.labels)

    @property
    def fields(self) -> tuple[str, ...]:
        """Kind of every number of an error; by default all are of one kind, with the name of the class."""
        words = re.sub(r"(?<!^)(?=[A-Z])", " ", type(self).__name__)
        return (words.lower(),) * len(self.noise)


def _xyz(name: str, unit: str) -> tuple[str, ...]:
    return tuple(f"{name}.{axis} ({unit})" for axis in "xyz")


_product = jnp.vectorize(quaternion_product, signature="(4),(4)->(4)")


def _rotation_vectors(a: Float[Any, "... M 4"], b: Float[Any, "... M 4"]) -> Float[Any, "... e"]:
    """Return the rotation vectors (rad) of a ∘ b, which are small, one after the other."""
    off = _product(a, b)
    return (2.0 * off[..., 1:] * jnp.where(off[..., :1] < 0.0, -1.0, 1.0)).reshape(*off.shape[:-2], -1)


@dataclasses.dataclass(frozen=True)
class _AtFractions(Output):
    """Output at fractions of the length, with numbers of one standard deviation."""

    fractions: tuple[float, ...]
    sigma: float

    def __post_init__(self) -> None:
        fractions = tuple(float(part) for part in np.atleast_1d(self.fractions))
        if not fractions or not all(0.0 <= part <= 1.0 for part in fractions):
            raise ValueError(f"fractions are {fractions}; allowed are parts of the length from 0 to 1")
        object.__setattr__(self, "fractions", fractions)

    @property
    def noise(self) -> Float[np.ndarray, " e"]:
        """Standard deviation of every number of an error."""
        return np.full(self.size, self.sigma)


@dataclasses.dataclass(frozen=True)
class BodyPositions(_AtFractions):
    """Positions (m) of points on the rod at fractions of its length.

    They are in the frame of the robot's `Camera`, if it states one; controllers track and limit them in the
    robot's own frame.
    """

    #: standard deviation (m)
    sigma: float = 2e-4

    @property
    def labels(self) -> tuple[str, ...]:
        """Name and unit of every number of a value."""
        return tuple(label for part in self.fractions for label in _xyz(f"position[{part:g}]", "m"))

    def value(self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"]) -> Float[Any, " p"]:
        """Return the positions, one after the other."""
        return seen_positions(system, y[None], self.fractions, z[None])[0].ravel()


@dataclasses.dataclass(frozen=True)
class TipPosition(BodyPositions):
    """Position (m) of the tip; see `BodyPositions`."""

    fractions: tuple[float, ...] = (1.0,)


@dataclasses.dataclass(frozen=True)
class Orientations(_AtFractions):
    """Unit quaternions (scalar first) at fractions of the length, such as those of an inertial sensor.

    An error is a rotation vector (rad) from the reference, in its own frame. Rows are compared by rotations
    since the first one that was seen, in the global frame: the sensor's mounting need not be known.
    """

    #: standard deviation of a rotation (rad)
    sigma: float = 5e-3

    @property
    def labels(self) -> tuple[str, ...]:
        """Name and unit of every number of a value."""
        return tuple(f"quaternion[{part:g}].{k}" for part in self.fractions for k in "wxyz")

    @property
    def noise(self) -> Float[np.ndarray, " e"]:
        """Standard deviation of every number of an error."""
        return np.full(3 * len(self.fractions), self.sigma)

    def value(self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"]) -> Float[Any, " p"]:
        """Return the orientations, one after the other."""
        return seen_quaternions(system, y[None], self.fractions)[0].ravel()

    def error(
        self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"], reference: Float[Any, " p"]
    ) -> Float[Any, " e"]:
        """Return rotation vectors from the reference."""
        return _rotation_vectors(conjugate(reference.reshape(-1, 4)), self.value(system, y, z).reshape(-1, 4))

    def errors(
        self, system: System, y: Float[Any, "T N y"], z: Float[Any, "T N z"], references: Float[Any, "T p"]
    ) -> Float[Any, "T e"]:
        """Return differences of the rotations since the first row that was seen."""
        h = seen_quaternions(system, y, self.fractions)
        wanted = references.reshape(h.shape)
        wanted /= jnp.linalg.norm(wanted, axis=-1, keepdims=True)
        known = jnp.isfinite(wanted[..., :1])
        row = jnp.argmax(known, axis=0)[None]

        def since(turns: Any) -> Any:
            return _product(turns, conjugate(jnp.take_along_axis(turns, row, 0)))

        off = _rotation_vectors(since(h), conjugate(since(jnp.where(known, wanted, 1.0))))
        return jnp.where(jnp.repeat(known[..., 0], 3, axis=1), off, jnp.nan)


@dataclasses.dataclass(frozen=True)
class BodyPoses(_AtFractions):
    """Positions (m) and unit quaternions (scalar first) at fractions of the length.

    An error of an orientation is the rotation vector (rad) from the reference, in its own frame.
    """

    #: standard deviations of positions (m) and of rotations (rad)
    sigma: float = 2e-4
    sigma_rotation: float = 2e-3

    @property
    def labels(self) -> tuple[str, ...]:
        """Name and unit of every number of a value."""
        labels: list[str] = []
        for part in self.fractions:
            labels += [*_xyz(f"position[{part:g}]", "m"), *(f"quaternion[{part:g}].{k}" for k in "wxyz")]
        return tuple(labels)

    @property
    def noise(self) -> Float[np.ndarray, " e"]:
        """Standard deviation of every number of an error."""
        return np.tile(np.repeat([self.sigma, self.sigma_rotation], 3), len(self.fractions))

    def value(self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"]) -> Float[Any, " p"]:
        """Return position and quaternion of each place."""
        p = seen_positions(system, y[None], self.fractions, z[None])[0]
        h = seen_quaternions(system, y[None], self.fractions)[0]
        return jnp.concatenate([p, h], axis=1).ravel()

    def error(
        self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"], reference: Float[Any, " p"]
    ) -> Float[Any, " e"]:
        """Return differences of positions (m) and rotation vectors (rad)."""
        value, wanted = (it.reshape(-1, 7) for it in (self.value(system, y, z), reference))
        turned = _rotation_vectors(conjugate(wanted[:, 3:]), value[:, 3:]).reshape(-1, 3)
        return jnp.concatenate([value[:, :3] - wanted[:, :3], turned], axis=1).ravel()


@dataclasses.dataclass(frozen=True)
class TipPose(BodyPoses):
    """Position (m) and unit quaternion of the tip."""

    fractions: tuple[float, ...] = (1.0,)


@dataclasses.dataclass(frozen=True)
class BodyMotions(BodyPoses):
    """Positions (m), and rotations since the first row as unit quaternions, at fractions of the length.

    The mounting of the bodies on the rod need not be known.
    """

    def errors(
        self, system: System, y: Float[Any, "T N y"], z: Float[Any, "T N z"], references: Float[Any, "T p"]
    ) -> Float[Any, "T e"]:
        """Return differences of positions (m), and of rotations since the first row (rad, global frame)."""
        count, reference = len(references), references.reshape(len(references), -1, 7)
        moved = seen_positions(system, y, self.fractions, z) - reference[..., :3]
        turned = Orientations(self.fractions).errors(system, y, z, reference[..., 3:].reshape(count, -1))
        return jnp.concatenate([moved, turned.reshape(count, -1, 3)], axis=-1).reshape(count, -1)


@dataclasses.dataclass(frozen=True)
class BendingAngles(_AtFractions):
    """Bending angle of the rod's axis from the z axis, times the cosine and the sine of its direction (rad).

    The direction is the angle about z from x. A product has no singularity where the rod is straight.
    """

    #: standard deviation (rad)
    sigma: float = 5e-3

    @property
    def labels(self) -> tuple[str, ...]:
        """Name and unit of every number of a value."""
        return tuple(f"bending[{part:g}].{axis} (rad)" for part in self.fractions for axis in "xy")

    def value(self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"]) -> Float[Any, " p"]:
        """Return the angles, one pair after the other."""
        h = quaternions_at(system, y[None], places_on(system, self.fractions))[0]
        axis = jax.vmap(rotation_matrix)(h)[:, :, 2]
        # the root of zero has no derivative
        sine = jnp.sqrt(jnp.sum(axis[:, :2] ** 2, axis=1, keepdims=True) + 1e-30)
        return (axis[:, :2] * jnp.arctan2(sine, axis[:, 2:]) / sine).ravel()


@dataclasses.dataclass(frozen=True)
class States(Output):
    """All numbers of y and z at the nodes, as in a trajectory: y of node 0, 1, …, then z.

    `names` are the fields of y and z with their sizes; the sign of a quaternion does not matter.
    """

    nodes: int
    y_names: tuple[tuple[str, int], ...]
    z_names: tuple[tuple[str, int], ...]

    @classmethod
    def of(cls, system: System) -> Self:
        """Return the states of a system."""
        layouts = system.y_layout, system.z_layout
        return cls(system.nodes, *(tuple((it.name, it.size) for it in layout.fields) for layout in layouts))

    @property
    def labels(self) -> tuple[str, ...]:
        """Field of every number of a value."""
        fields = self.y_names, self.z_names
        parts = ([name for name, size in names for _ in range(size)] for names in fields)
        return tuple(label for part in parts for label in part * self.nodes)

    @property
    def fields(self) -> tuple[str, ...]:
        """Field of y or z of every number."""
        return self.labels

    @property
    def noise(self) -> Float[np.ndarray, " e"]:
        """Ones: the noise of states is estimated from the differences."""
        return np.ones(self.size)

    def value(self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"]) -> Float[Any, " p"]:
        """Return all numbers."""
        return jnp.concatenate([y.ravel(), z.ravel()])

    def error(
        self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"], reference: Float[Any, " p"]
    ) -> Float[Any, " e"]:
        """Return the differences; quaternions are normalised, and the reference has the nearer sign."""
        target = reference[: y.size].reshape(y.shape)
        if "h" in system.y_layout.names:
            where = system.y_layout.slice("h")
            unit, turn = (
                h / jnp.linalg.norm(h, axis=-1, keepdims=True)
                for h in (rows[:, where].reshape(len(y), -1, 4) for rows in (y, target))
            )
            turn = turn * jnp.where(jnp.sum(turn * unit, axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
            y = y.at[:, where].set(unit.reshape(len(y), -1))
            target = target.at[:, where].set(turn.reshape(len(y), -1))
        return self.value(system, y, z) - jnp.concatenate([target.ravel(), reference[y.size :]])


@dataclasses.dataclass(frozen=True)
class Curvatures(_AtFractions):
    """Curvatures u (1/m) about the material x and y axes at fractions of the length (Bragg gratings)."""

    #: standard deviation (1/m)
    sigma: float = 0.02

    @property
    def labels(self) -> tuple[str, ...]:
        """Name and unit of every number of a value."""
        return tuple(f"curvature[{part:g}].{axis} (1/m)" for part in self.fractions for axis in "xy")

    def value(self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"]) -> Float[Any, " p"]:
        """Return the curvatures, interpolated linearly between nodes."""
        places = places_on(system, self.fractions)
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


@dataclasses.dataclass(frozen=True)
class Several(Output):
    """Several outputs, one after the other."""

    outputs: tuple[Output, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """Name and unit of every number of a value."""
        return tuple(label for it in self.outputs for label in it.labels)

    @property
    def fields(self) -> tuple[str, ...]:
        """Kind of every number of an error."""
        return tuple(field for it in self.outputs for field in it.fields)

    @property
    def noise(self) -> Float[np.ndarray, " e"]:
        """Standard deviation of every number of an error."""
        return np.concatenate([it.noise for it in self.outputs])

    def value(self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"]) -> Float[Any, " p"]:
        """Return all values."""
        return jnp.concatenate([it.value(system, y, z) for it in self.outputs])

    def parts(self, values: Float[Any, "... p"]) -> list[Float[Any, "... q"]]:
        """Return the values of each output."""
        return jnp.split(values, np.cumsum([it.size for it in self.outputs])[:-1], axis=-1)

    def error(
        self, system: System, y: Float[Any, "N y"], z: Float[Any, "N z"], reference: Float[Any, " p"]
    ) -> Float[Any, " e"]:
        """Return all differences."""
        pairs = zip(self.outputs, self.parts(reference), strict=True)
        return jnp.concatenate([it.error(system, y, z, part) for it, part in pairs])

    def errors(
        self, system: System, y: Float[Any, "T N y"], z: Float[Any, "T N z"], references: Float[Any, "T p"]
    ) -> Float[Any, "T e"]:
        """Return the errors of consecutive rows."""
        pairs = zip(self.outputs, self.parts(references), strict=True)
        return jnp.concatenate([it.errors(system, y, z, part) for it, part in pairs], axis=-1)


def final_output(system: System, trajectory: Trajectory, output: Output) -> Float[np.ndarray, " p"]:
    """Return an output (p,) at the last row of a trajectory, by one compiled program for each output."""
    return np.asarray(_value(output, system, np.asarray(trajectory.y[-1]), np.asarray(trajectory.z[-1])))


_value = jax.jit(lambda output, system, y, z: output.value(system, y, z), static_argnums=0)
