"""Obstacles for contact with a rod: planes, spheres and cylinders, fixed in the global frame.

The contact is smooth. With the gap g from the rod's surface to the obstacle's and the smoothing δ, an
obstacle pushes with the force per length

    f = k δ log(1 + exp(-g/δ)),

This is a spring of stiffness k where the rod is pressed in by more than δ; the force decays over δ outside
the obstacle. Friction is Coulomb's with its jump smoothed over slow sliding: -μ f v/√(|v|² + ε²), v the
velocity of the rod's surface along the obstacle's. It therefore creeps instead of sticking, at a speed below
ε. An equilibrium, with all velocities zero, has no friction.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.loads import Motion
from knode_cosserat.rods.parameters import choice, parameter
from knode_cosserat.rods.parts import Part, RodPoint, Wrench
from knode_cosserat.rotation import cross, dot


class ContactLaw(Part):
    """The law of a contact: its force by the gap and the velocity of one surface relative to the other."""

    stiffness: Any = parameter(
        "N/m2", "k, contact force per length and depth", low=0.0, high=1e12, default=1e4
    )
    smoothing: Any = parameter("m", "δ, depth over which contact sets in", low=1e-9, high=1.0, default=1e-4)
    damping: Any = parameter(
        "s/m",
        "d, relative increase of the contact force by the speed of approach",
        low=0.0,
        high=1e4,
        default=0.0,
    )
    friction: Any = parameter("", "μ, coefficient of friction", low=0.0, high=10.0, default=0.0)
    slip: Any = parameter(
        "m/s", "ε, speed of sliding at which friction is full", low=1e-9, high=1e3, default=1e-3
    )

    def force(self, gap: Any, normal: Float[Any, "3"], velocity: Float[Any, "3"]) -> Float[Any, "3"]:
        """Return the force per length on a surface that has this normal and velocity off the other (N/m)."""
        approach = -jnp.sum(velocity * normal)
        pressed = self.stiffness * self.smoothing * jax.nn.softplus(-gap / self.smoothing)
        pressed = pressed * jnp.maximum(1.0 + self.damping * approach, 0.0)
        sliding = velocity + approach * normal
        held = self.friction * pressed / jnp.sqrt(jnp.sum(sliding**2) + self.slip**2)
        return pressed * normal - held * sliding

    def eased(self, part: float) -> Self:
        """Return the law with contact and sliding smoothed over 1/part of the depth and the speed."""
        return dataclasses.replace(
            self, smoothing=np.minimum(self.smoothing / part, 1.0), slip=np.minimum(self.slip / part, 1e3)
        )


class Obstacle(ContactLaw):
    """An obstacle that a rod touches and does not penetrate."""

    held: ClassVar[bool] = True
    damps: ClassVar[bool] = True

    @abc.abstractmethod
    def distance(self, p: Float[Any, "3"]) -> tuple[Any, Float[Any, "3"]]:
        """Return the distance (m) to the obstacle's surface, negative inside, and the outward unit vector."""

    def load(self, point: RodPoint) -> Wrench:
        """Return the contact's load on the rod per length."""
        return self.wrench(point.motion, point.material.radius)

    def wrench(self, motion: Motion, radius: Any) -> Wrench:
        """Return the load on a rod of this radius (m) at a point, per length (N/m, N), global frame."""
        distance, normal = self.distance(motion.p)
        arm = -radius * normal
        force = self.force(distance - radius, normal, velocity_at(motion, arm))
        return Wrench(force, cross(arm, force))


def velocity_at(motion: Motion, arm: Float[Any, "3"]) -> Float[Any, "3"]:
    """Return the velocity of a point of a rod's cross-section (m/s), global frame."""
    return dot(motion.R, motion.q) + cross(dot(motion.R, motion.w), arm)


def _unit(vector: Any) -> Any:
    """Return a direction as a unit vector."""
    vector = jnp.asarray(vector)
    return vector / jnp.sqrt(jnp.sum(vector * vector))


def _length(vector: Any) -> Any:
    """Return the length, regularised so that it has a derivative at zero, such as at a sphere's centre."""
    return jnp.sqrt(jnp.sum(vector * vector) + 1e-24)


_INSIDE = "true if the rod is inside it"


class Plane(Obstacle):
    """A plane; the rod is on the side to which its normal points."""

    kind: ClassVar[str] = "plane"

    point: Any = parameter("m", "a point of it", shape="vector", low=-1e3, high=1e3, default=(0.0, 0.0, 0.0))
    normal: Any = parameter(
        "1", "its normal, of any length", shape="direction", low=-1e3, high=1e3, default=(0.0, 0.0, 1.0)
    )

    def distance(self, p: Float[Any, "3"]) -> tuple[Any, Float[Any, "3"]]:
        """Return distance and unit vector; see `Obstacle.distance`."""
        normal = _unit(self.normal)
        return jnp.sum((p - self.point) * normal), normal


class Sphere(Obstacle):
    """A ball, or with `inside` a hollow sphere."""

    kind: ClassVar[str] = "sphere"

    center: Any = parameter("m", "its centre", shape="vector", low=-1e3, high=1e3, default=(0.0, 0.0, 0.0))
    radius: Any = parameter("m", "its radius", low=1e-6, high=1e3, default=0.1)
    inside: bool = choice(_INSIDE, (False, True), False)

    def distance(self, p: Float[Any, "3"]) -> tuple[Any, Float[Any, "3"]]:
        """Return distance and unit vector; see `Obstacle.distance`."""
        away = p - self.center
        return _round(away, self.radius, self.inside)


class Cylinder(Obstacle):
    """An infinite round bar, or with `inside` a pipe."""

    kind: ClassVar[str] = "cylinder"

    point: Any = parameter(
        "m", "a point of its axis", shape="vector", low=-1e3, high=1e3, default=(0.0, 0.0, 0.0)
    )
    axis: Any = parameter(
        "1",
        "direction of its axis, of any length",
        shape="direction",
        low=-1e3,
        high=1e3,
        default=(0.0, 1.0, 0.0),
    )
    radius: Any = parameter("m", "its radius", low=1e-6, high=1e3, default=0.1)
    inside: bool = choice(_INSIDE, (False, True), False)

    def distance(self, p: Float[Any, "3"]) -> tuple[Any, Float[Any, "3"]]:
        """Return distance and unit vector; see `Obstacle.distance`."""
        axis = _unit(self.axis)
        away = p - self.point
        return _round(away - jnp.sum(away * axis) * axis, self.radius, self.inside)


def _round(away: Any, radius: Any, inside: bool) -> tuple[Any, Any]:
    length = _length(away)
    if inside:
        return radius - length, -away / length
    return length - radius, away / length
