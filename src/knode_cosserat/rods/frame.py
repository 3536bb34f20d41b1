"""A spinning frame: a rod whose base rotates at a constant rate, seen from a frame that rotates with it.

A point r of the frame, measured from a point c of the axis, is at c + Q r in the global frame, Q = exp(Ω̂ t).
With the constant Ω in both frames, the absolute motion of a section in its material frame is

    q + Rᵀ(Ω × r)          q_t - ω × Rᵀ(Ω × r) + Rᵀ(Ω × R q)
    ω + RᵀΩ                ω_t - ω × RᵀΩ

The balance of momentum takes it in place of q, ω and their rates, and so do all parts. Centrifugal, Coriolis
and gyroscopic terms are therefore exact, and the air, obstacles, gravity and dead loads are those of the
global frame (S. S. Rao, Vibration of Continuous Systems, 2007, section 11.11, has the whirl of shafts).
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Float

from knode_cosserat.rods.loads import Motion
from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.parts import Effect, RodPoint
from knode_cosserat.rotation import cross, dot, quaternion_of, rotation_matrix


class SpinningFrame(Effect):
    """A frame that rotates at a constant rate about an axis, from which the robot is seen.

    Positions, velocities, forces and held ends are those of this frame. It is the global frame at time 0.
    """

    kind: ClassVar[str] = "spinning-frame"
    gyroscopic: ClassVar[bool] = True

    rate: Any = parameter("rad/s", "rate of rotation", low=-1e5, high=1e5)
    axis: Any = parameter(
        "1",
        "direction of the axis, of any length",
        shape="direction",
        low=-1e3,
        high=1e3,
        default=(0.0, 0.0, 1.0),
    )
    point: Any = parameter(
        "m", "a point of the axis", shape="vector", low=-1e3, high=1e3, default=(0.0, 0.0, 0.0)
    )

    @property
    def spin(self) -> Float[Any, "3"]:
        """Ω (rad/s)."""
        axis = jnp.asarray(self.axis)
        return self.rate * axis / jnp.sqrt(jnp.sum(axis * axis))

    def turn(self, t: Any) -> Float[Any, "3 3"]:
        """Return Q at time t (s)."""
        return rotation_matrix(quaternion_of(t * self.spin))

    def absolute(self, point: RodPoint, motion: Motion) -> Motion:
        """Return the motion in the global frame."""
        p, R, q, w, q_t, w_t = motion
        Q, r = self.turn(point.t), p - self.point
        carried, spin = dot(R.T, cross(self.spin, r)), dot(R.T, self.spin)
        return Motion(
            self.point + dot(Q, r),
            Q @ R,
            q + carried,
            w + spin,
            q_t - cross(w, carried) + cross(spin, q),
            w_t - cross(w, spin),
        )

    def seen(self, t: Any, vector: Float[Any, "3"]) -> Float[Any, "3"]:
        """Return a vector of the global frame in this frame."""
        return dot(self.turn(t).T, vector)
