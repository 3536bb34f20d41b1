"""A virtual robot that differs from the paper's model like real ones, for virtual recordings.

Tendons run at a distance from the axis and bend the rod by their moment, with friction in the holes of its
ribs. Ribs have masses. A sleeve stiffens the rod at the base.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.law import MaterialLaw, Viscoelastic
from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.tendon_parts import PulledTendons
from knode_cosserat.rods.tendon_rod import TendonRod
from knode_cosserat.rotation import cross, dot, rotation_matrix

#: standard deviation of the distribution of a rib's mass along the rod (m)
RIB_WIDTH = 0.02
#: the nine ribs, as fractions of the length
RIBS = tuple((k + 1) / 9 for k in range(9))


class VirtualTendons(PulledTendons):
    """Controls of a virtual robot's tendons."""

    def actuation(self, rod: Any, control: Float[Any, " c"]) -> Float[Any, "3"]:
        """Return the total tension, and its moment about the axis (N, N·m, N·m)."""
        angles = rod.tendon_angles
        moment = jnp.stack([jnp.sum(control * jnp.sin(angles)), -jnp.sum(control * jnp.cos(angles))])
        return jnp.concatenate([jnp.sum(control)[None], rod.tendon_offset * moment])


class VirtualRobot(TendonRod):
    """A rod with tendons in ribs: n and m include rod and tendons.

    With the tendons at r_i, and d₃ the third axis of the material frame,

        Rᵀn = Kse (v - v*) + Σ T_i d₃            Rᵀm = Kbt (u - u*) + Bbt u_t + Σ T_i r_i × d₃
        T_i(s) = τ_i (1 - μ s/L tanh(ρ_i/ρ₀)),    ρ_i = d₃ · (r_i × u_t)

    where ρ_i is the rate at which the tendon is pulled in per metre of rod. A tendon that is pulled in loses
    tension towards the tip, and a tendon that is let out gains tension. Near the base Kbt is multiplied. Ribs
    are masses, each distributed over a part of the length. The balance of n and m is that of a rod without
    tendons, because the tendons act within the section. At the tip, where they end, n and m are zero.
    """

    friction: Any = parameter(
        "", "μ, part of a tendon's tension lost to the tip", low=0.0, high=0.9, default=0.1
    )
    sliding: Any = parameter(
        "1/s", "ρ₀, rate of sliding per length from which friction is full", low=1e-6, high=10.0, default=0.02
    )
    sleeve_length: Any = parameter("m", "length of the sleeve at the base", low=0.0, high=1.0, default=0.08)
    sleeve_factor: Any = parameter("", "what the sleeve multiplies Kbt by", low=1.0, high=100.0, default=4.0)
    rib_mass: Any = parameter("kg", "mass of one of the nine ribs", low=0.0, high=1.0, default=0.0015)

    @property
    def tendons(self) -> VirtualTendons:
        """Controls of the tendons."""
        return VirtualTendons(self.tendon_count)

    def stiffness(self, s: Any) -> Float[Any, "3 3"]:
        """Return Kbt at s (N·m²), increased within the sleeve."""
        inside = jnp.exp(-((s / self.sleeve_length) ** 2))
        return self.Kbt * (1.0 + (self.sleeve_factor - 1.0) * inside)

    def tendon_moment(self, s: Any, u_t: Float[Any, "3"], control: Any) -> Float[Any, "3"]:
        """Return Σ T_i r_i × d₃ (N·m) at s, material frame, at the rate of curvature u_t."""
        x, y = jnp.cos(self.tendon_angles), jnp.sin(self.tendon_angles)
        pulled_in = self.tendon_offset * (x * u_t[1] - y * u_t[0])
        loss = self.friction * s / self.length * jnp.tanh(pulled_in / self.sliding)
        T = jnp.asarray(control) * (1.0 - loss)
        return self.tendon_offset * jnp.stack([jnp.sum(T * y), -jnp.sum(T * x), jnp.zeros(())])

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """Return the law of v and u with the tendons."""
        n, m = self.stresses(y)
        pulled = n - jnp.sum(jnp.asarray(control)) * np.array([0.0, 0.0, 1.0])
        moment = jax.tree_util.Partial(_tendon_moment, self, s, jnp.asarray(control))
        v = Viscoelastic(self.Kse, self.shear_damping, pulled + self.Kse @ self.v_star)
        u = Viscoelastic(self.stiffness(s), self.bending_damping, m, moment=moment)
        return MaterialLaw({"v": v, "u": u})

    def balance(self, s, t, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """Return y_s of a rod without tendons, with the ribs' masses."""
        away = (s / self.length - np.array(RIBS)) * self.length / RIB_WIDTH
        # a Gaussian, with half of the last one beyond the tip
        lump = jnp.exp(-0.5 * away**2) / (RIB_WIDTH * np.sqrt(2.0 * np.pi))
        mass = self.rib_mass * jnp.sum(lump)
        y_s = super().balance(s, t, y, y_t, z, z_t, control)
        R = rotation_matrix(self.y_layout.get(y, "h"))
        q, w, q_t = self.y_layout.get(y, "q"), self.y_layout.get(y, "w"), self.y_layout.get(y_t, "q")
        more = mass * (dot(R, cross(w, q) + q_t) - self.gravity)
        return y_s.at[self.y_layout.slice("n")].add(more)


def _tendon_moment(robot: VirtualRobot, s: Any, control: Any, u: Any, u_t: Any) -> Float[Any, "3"]:
    return robot.tendon_moment(s, u_t, control)
