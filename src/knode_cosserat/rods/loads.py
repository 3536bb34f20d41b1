"""Loads of a rod: distributed along its length, or at one place.

A load at a place makes n and m jump there: n(s⁺) = n(s⁻) - F, m(s⁺) = m(s⁻) - M. At the tip it is part of the
tip's conditions instead.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.parameters import Doubt, choice, parameter, place
from knode_cosserat.rods.parts import Part, RodPoint, Stretched, Wrench
from knode_cosserat.rods.shapes import Shape, arrow, ball, disk, rim
from knode_cosserat.rotation import cross, dot, rotation_matrix


def square_law_drag(C: Float[Any, "3 3"], q: Float[Any, "3"]) -> Float[Any, "3"]:
    """Return the drag C q ⊙ |q| against the velocity q, both in the material frame (N/m); C in kg/m²."""
    return dot(C, q * jnp.abs(q))


def transverse_force(tension: Float[Any, " tendons"], angles: Float[Any, " tendons"]) -> Float[Any, "3"]:
    """Return the load of the paper's crude model: f = Σ τᵢ dᵢ per metre of rod (N/m), in the global frame.

    dᵢ is the unit vector at the tendon's angle (rad) in the global x-y plane. The force does not rotate with
    the rod and there is no moment: the paper's τ·φ. Tension in N.
    """
    return jnp.stack([jnp.sum(tension * jnp.cos(angles)), jnp.sum(tension * jnp.sin(angles)), jnp.zeros(())])


class Motion(NamedTuple):
    """Pose and motion of a point of the rod: p, R in the global frame, the rest in the material frame."""

    p: Float[Any, "3"]
    R: Float[Any, "3 3"]
    q: Float[Any, "3"]
    w: Float[Any, "3"]
    q_t: Float[Any, "3"]
    w_t: Float[Any, "3"]

    @classmethod
    def of(cls, layout: Any, y: Any, y_t: Any) -> Motion:
        """Return the motion from a packed y and its rate."""
        p, h, q, w = (layout.get(y, name) for name in ("p", "h", "q", "w"))
        return cls(p, rotation_matrix(h), q, w, layout.get(y_t, "q"), layout.get(y_t, "w"))


class BodyInertia(NamedTuple):
    """A rigid body by its moments about a point of the rod, material frame; bodies at one point add up.

    A moment that is zero is None: a body with only a mass, such as most ribs, needs no equations of rotation.
    """

    mass: Any
    #: mass times the position of its centre (kg·m)
    first: Float[Any, "3"] | None
    #: moments of inertia about the point (kg·m²)
    inertia: Float[Any, "3 3"] | None

    @classmethod
    def of(cls, bodies: list[tuple[BodyInertia, Any]]) -> BodyInertia:
        """Return the weighted sum of several bodies."""
        sums = []
        for moments in zip(*(body for body, _ in bodies), strict=True):
            weights = (weight for _, weight in bodies)
            parts = [w * moment for moment, w in zip(moments, weights, strict=True) if moment is not None]
            sums.append(sum(parts) if parts else None)
        return cls(*sums)

    def wrench(self, motion: Motion, gravity: Any) -> Wrench:
        """Return weight less inertia: F = m a - ω_t × S - ω × (ω × S), M = S × a - (J ω_t + ω × J ω).

        S and J are the moments, and a the gravity less the acceleration of the point.
        """
        _, R, q, w, q_t, w_t = motion
        S, J = self.first, self.inertia
        a = dot(R.T, jnp.asarray(gravity)) - q_t - cross(w, q)
        force, moments = self.mass * a, []
        if S is not None:
            force = force - cross(w_t, S) - cross(w, cross(w, S))
            moments.append(cross(S, a))
        if J is not None:
            moments.append(-(dot(J, w_t) + cross(w, dot(J, w))))
        return Wrench(dot(R, force), dot(R, sum(moments)) if moments else jnp.zeros(3))


class Load(Part):
    """Base class of loads. Gravity and drag are parameters of every rod instead."""


class PointLoad(Load):
    """A load at one place, `at`, as a fraction of the rod's length."""

    at: float = place("where it acts", default=1.0, kw_only=True)

    @property
    def applied_at(self) -> float:  # type: ignore[override]
        """Place where it acts."""
        return self.at

    @property
    def cuts(self) -> tuple[float, ...]:
        """Place where it acts."""
        return (self.at,)

    @property
    def body(self) -> BodyInertia | None:
        """Rigid body about the rod's axis, whose weight and inertia act beside the wrench; None: none."""
        return None

    @abc.abstractmethod
    def wrench(self, motion: Motion, control: Any) -> Wrench | None:
        """Return the load on the rod (N, N·m), global frame; None if there is only that of its body."""


class SpreadLoad(Stretched, Load):
    """A load per length, between two places."""

    def load(self, point: RodPoint) -> Wrench:
        """Return the load on the rod per length, zero outside of its stretch."""
        indicator = self.indicator(point)
        return Wrench(*(indicator * term for term in self.wrench(point.motion, point.input)))

    @abc.abstractmethod
    def wrench(self, motion: Motion, control: Any) -> Wrench:
        """Return the load on the rod per length (N/m, N), global frame, within its stretch."""


class _Prescribed(Load):
    """A force and a moment: constant in the global frame, or following the material frame."""

    force: Any
    moment: Any
    follows: bool = choice("true if it rotates with the rod", (False, True), False)
    controlled: bool = choice("true if a control multiplies it", (False, True), False)

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """The factor on the load, if it is controlled."""
        return (Field("scale", 1, "1", "multiple of the load that acts"),) if self.controlled else ()

    def prescribed(self, motion: Motion, control: Any) -> Wrench:
        """Return the force and the moment, rotated with the rod if they follow it."""
        factor = control[0] if self.controlled else 1.0
        force, moment = factor * jnp.asarray(self.force), factor * jnp.asarray(self.moment)
        return Wrench(dot(motion.R, force), dot(motion.R, moment)) if self.follows else Wrench(force, moment)


class PointWrench(_Prescribed, PointLoad):
    """A force and a moment at a place: constant in the global frame, or following the material frame."""

    kind: ClassVar[str] = "point-wrench"

    force: Any = parameter("N", "force", shape="vector", low=-1e9, high=1e9, default=(0.0, 0.0, 0.0))
    moment: Any = parameter("N m", "moment", shape="vector", low=-1e9, high=1e9, default=(0.0, 0.0, 0.0))

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return an arrow that ends where the force acts."""
        force, length = np.asarray(self.force, dtype=float), float(rod.length)
        size = float(np.linalg.norm(force))
        scale = control[:, 0] if self.controlled else np.ones(len(control))
        if not size:
            return ()
        tail = -0.2 * length * scale[:, None] / (float(np.abs(scale).max()) or 1.0) * force / size
        more: dict[str, Any] = {"turns": self.follows, "value": scale * size, "unit": "N"}
        return (arrow("force", "force", self.at, tail, np.zeros(3), 0.008 * length, **more),)

    def wrench(self, motion: Motion, control: Any) -> Wrench:
        """Return the force and the moment."""
        return self.prescribed(motion, control)


class DistributedWrench(_Prescribed, SpreadLoad):
    """A force and a moment per length: constant in the global frame, or following the material frame."""

    kind: ClassVar[str] = "distributed-wrench"

    force: Any = parameter(
        "N/m", "force per length", shape="vector", low=-1e9, high=1e9, default=(0.0, 0.0, 0.0)
    )
    moment: Any = parameter(
        "N", "moment per length", shape="vector", low=-1e9, high=1e9, default=(0.0, 0.0, 0.0)
    )

    def wrench(self, motion: Motion, control: Any) -> Wrench:
        """Return the force and the moment."""
        return self.prescribed(motion, control)


class AttachedMass(PointLoad):
    """A rigid body on the rod: a rib, a gripper, a payload. At the tip it is the robot's rigid end.

    Its moments of inertia are about its own centre of mass, along the axes of the material frame.
    """

    kind: ClassVar[str] = "attached-mass"

    mass: Any = parameter("kg", "mass", low=0.0, high=1e4, default=0.0, doubt=Doubt(0.2))
    inertia: Any = parameter(
        "kg m2", "moments of inertia about its centre", shape="vector", low=0.0, high=1e6, default=None
    )
    offset: Any = parameter(
        "m",
        "its centre of mass from the rod's axis, material frame",
        shape="vector",
        low=-10.0,
        high=10.0,
        default=None,
    )

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return a rib of a rod with tendons, and a ball on another."""
        size, about = rim(rod), {"value": float(self.mass), "unit": "kg"}
        if size is None:
            radius = min(2.5 * float(rod.section.radius), 0.03 * float(rod.length))
            return (ball("mass", "attached mass", self.at, radius, **about),)
        return (disk("disk", "rib", self.at, size, **about),)

    @property
    def body(self) -> BodyInertia:
        """The rigid body about the rod's axis, in the material frame."""
        J = None if self.inertia is None else np.eye(3) * jnp.asarray(self.inertia)
        if self.offset is None:
            return BodyInertia(self.mass, None, J)
        r = jnp.asarray(self.offset)
        off_axis = self.mass * (jnp.sum(r * r) * np.eye(3) - r[:, None] * r)
        return BodyInertia(self.mass, self.mass * r, off_axis if J is None else J + off_axis)

    def wrench(self, motion: Motion, control: Any) -> None:
        """Return None: there is no load beside that of its body."""


def point_wrench(acting: list[tuple[Any, Any, Any]], motion: Motion, gravity: Any) -> Wrench:
    """Return the sum of the loads at one place: each with its weight (0 if it acts elsewhere) and control."""
    total, bodies = Wrench(jnp.zeros(3), jnp.zeros(3)), []
    for load, weight, control in acting:
        if load.body is not None:
            bodies.append((load.body, weight))
        wrench = load.wrench(motion, control)
        if wrench is not None:
            total = total + Wrench(weight * wrench.force, weight * wrench.moment)
    if bodies:
        # summed before the wrench: their equations are compiled once for any number of bodies
        total = total + BodyInertia.of(bodies).wrench(motion, gravity)
    return total
