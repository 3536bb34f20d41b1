"""A slender rod in water, or another fluid: buoyancy, added mass, drag, and the wake of a tail.

With the fluid's density ρ, the rod's radius a, and its velocity relative to the stream, q = q⊥ + q₃ d₃ in the
material frame, the loads per length are

    buoyancy      -ρ π a² g,
    pressure      f = -R (P_t + ω × P),   l = -R (q × P),   P = m q⊥,   m = c ρ π a²,
    drag          -ρ a R (C_D |q⊥| q⊥ + C_f |q| q).

Buoyancy: n is the effective tension, that of the rod plus that of the displaced fluid. It is zero at a free
end under water.

Pressure: P is the momentum of the fluid that the section pushes aside (Lighthill 1960), and f and l are the
forces of a medium with the kinetic energy ∫ ½ m |q⊥|² ds (Kirchhoff). Their power is the rate of that energy.
The couple l is Munk's moment. In a rod without shear and extension it bends as the force per length and the
end forces of Lighthill's elongated-body theory of large amplitude (1971; Candelier, Boyer & Leroyer 2011) do,

    -(∂/∂t)(R P) + ∂/∂s (q₃ R P - ½ m |q⊥|² d₃),      ∓ (q₃ R P - ½ m |q⊥|² d₃) at both ends,

but has no derivatives along the rod: q₃ P is shifted from the force n into its moment, and the last term is
balanced by tension. Both ends are then rounded, and no force remains in a steady stream (d'Alembert). At the
sharp edge of a `Tail` the flow separates instead, and the end's force is taken back.

Drag: pressure across a rough cylinder and friction along the flow (Taylor 1952), both for the diameter 2a.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.loads import Load, Motion, PointLoad
from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.parts import RodPoint, Wrench
from knode_cosserat.rods.shapes import Shape, arrow
from knode_cosserat.rotation import cross, dot

#: diagonal of the projection across the rod
ACROSS = np.array([1.0, 1.0, 0.0])
#: speed (m/s) below which drag is linear, so that it has derivatives at rest
CREEP = 1e-6


def _speed(q: Float[Any, "3"]) -> Any:
    return jnp.sqrt(jnp.sum(q * q) + CREEP**2)


class _Immersed(Load):
    """A load by the fluid around the rod."""

    density: Any = parameter("kg/m3", "density of the fluid", low=0.0, high=25e3, default=1000.0)
    stream: Any = parameter(
        "m/s",
        "velocity of the undisturbed fluid, global frame",
        shape="vector",
        low=-100.0,
        high=100.0,
        default=(0.0, 0.0, 0.0),
    )

    def relative(self, motion: Motion) -> Float[Any, "3"]:
        """Return the velocity of the rod relative to the stream (m/s), material frame."""
        return motion.q - dot(motion.R.T, jnp.asarray(self.stream))


class Fluid(_Immersed):
    """Water, or another fluid, around the whole rod: buoyancy, added mass and drag of a round section."""

    kind: ClassVar[str] = "fluid"
    damps: ClassVar[bool] = True

    added_mass: Any = parameter(
        "",
        "c, mass that moves with the rod across its axis, over the displaced mass",
        low=0.0,
        high=100.0,
        default=1.0,
    )
    drag: Any = parameter(
        "", "C_D, coefficient of the pressure drag across the rod", low=0.0, high=100.0, default=1.1
    )
    friction: Any = parameter(
        "", "C_f, coefficient of the friction drag, for the diameter", low=0.0, high=100.0, default=0.03
    )

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return the layer of fluid that moves with the rod, and an arrow along the stream."""
        radius, length = float(rod.section.radius), float(rod.length)
        sleeve = np.sqrt(1.0 + float(self.added_mass)) * radius
        about: dict[str, Any] = {"value": float(self.density), "unit": "kg/m3"}
        found = [Shape("fluid", "fluid", at, np.zeros((len(at), 3)), sleeve, **about)]
        stream = np.asarray(self.stream, dtype=float)
        if speed := float(np.linalg.norm(stream)):
            ends = (-0.35 * length * stream / speed, -0.1 * length * stream / speed)
            more: dict[str, Any] = {"turns": False, "value": speed, "unit": "m/s"}
            found.append(arrow("fluid", "stream", 0.5, *ends, 0.012 * length, **more))
        return tuple(found)

    def load(self, point: RodPoint) -> Wrench:
        """Return the load of the fluid per length."""
        motion, radius = point.motion, point.material.radius
        displaced = self.density * np.pi * radius**2
        m, R, w, q = self.added_mass * displaced, motion.R, motion.w, self.relative(motion)
        # the stream's velocity in the material frame has the rate -ω × Rᵀ stream
        q_t = motion.q_t + cross(w, motion.q - q)
        across = ACROSS * q
        momentum, rate = m * across, m * ACROSS * q_t
        dragged = self.drag * _speed(across) * across + self.friction * _speed(q) * q
        force = -(rate + cross(w, momentum)) - self.density * radius * dragged
        weight = displaced * jnp.asarray(point.rod.gravity)
        return Wrench(dot(R, force) - weight, -dot(R, cross(q, momentum)))


class Tail(_Immersed, PointLoad):
    """A tail with a sharp trailing edge: it leaves the momentum of the fluid in its wake (Lighthill 1971).

    It exerts q₃ P - ½ m |q⊥|² d₃ with m = ρ π b²/4 on the rod, beside a `Fluid`; in small swimming motions h
    at speed U the mean thrust is ½ m (h_t² - U² h_s²). The rod moves towards its base there: a tip that leads
    has no wake.
    """

    kind: ClassVar[str] = "tail"
    damps: ClassVar[bool] = True

    span: Any = parameter(
        "m",
        "b, depth of the trailing edge across the motion; a round rod's diameter",
        low=0.0,
        high=10.0,
        default=0.0,
    )

    def wrench(self, motion: Motion, control: Any) -> Wrench:
        """Return the force at the edge."""
        q, m = self.relative(motion), self.density * np.pi * self.span**2 / 4.0
        across = ACROSS * q
        along = np.array([0.0, 0.0, 0.5]) * jnp.sum(across * across)
        return Wrench(dot(motion.R, m * (q[2] * across - along)), jnp.zeros(3))
