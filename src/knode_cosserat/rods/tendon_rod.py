"""A clamped rod that tendons bend: what all models of its tendons have in common.

`tendon_robot` and `routed_robot` add what tendons do. Symbols follow the paper's table of notations:

    p  position (m)            h  orientation, quaternion, scalar first     R  its rotation matrix
    n  internal force (N)      m  internal moment (N·m), both in the global frame
    q  velocity (m/s)          w  angular velocity ω (1/s), both in the material frame
    v  rate of p along s       u  curvature (1/m), both in the material frame
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.loads import square_law_drag
from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.section import CircularSection, shear_modulus
from knode_cosserat.rods.system import History, Layout, Scales, System
from knode_cosserat.rotation import cross, dot, quaternion_rate, rotation_matrix

#: angles of the paper's four tendons about the rod, π/4 + iπ/2
FOUR_TENDONS = tuple(np.pi / 4 + i * np.pi / 2 for i in range(4))


class TendonRod(System):
    """A clamped, round, straight rod with gravity, drag and material damping (paper eqs. 13-15).

    A subclass says what its tendons do: `tendon_force` along the rod, and `strains`.
    """

    y_layout: ClassVar[Layout] = Layout(
        ("p", 3, "m", "position, global frame"),
        ("h", 4, "1", "orientation, quaternion, scalar first"),
        ("n", 3, "N", "internal force, global frame", "h", "N/m"),
        ("m", 3, "N m", "internal moment, global frame", "h", "N"),
        ("q", 3, "m/s", "velocity, material frame"),
        ("w", 3, "rad/s", "angular velocity, material frame"),
    )
    z_layout: ClassVar[Layout] = Layout(
        ("v", 3, "1", "rate of position along the rod, material frame", "", "N"),
        ("u", 3, "1/m", "curvature, material frame", "", "N m"),
    )
    base_unknowns: ClassVar[tuple[str, ...]] = ("n", "m")
    mixed: ClassVar[bool] = False
    velocities: ClassVar[tuple[str, ...]] = ("q", "w", "u_t")

    length: Any = parameter("m", "length of the rod", low=1e-3, high=20.0)
    radius: Any = parameter("m", "radius of the rod", low=1e-6, high=0.5)
    density: Any = parameter("kg/m3", "density of the rod", low=1.0, high=30e3)
    youngs_modulus: Any = parameter("Pa", "Young's modulus", low=1e3, high=2e12)
    shear_modulus: Any = parameter(
        "Pa", "shear modulus; by default E / 2.6", low=1e2, high=1e12, default=None
    )
    shear_damping: Any = parameter(
        "N s", "Bse, damping of shear and extension", shape="matrix", low=0.0, high=1e6, default=0.0
    )
    bending_damping: Any = parameter(
        "N m2 s", "Bbt, damping of bending and twisting", shape="matrix", low=0.0, high=1e4, default=0.0
    )
    drag: Any = parameter("kg/m2", "C, square-law drag", shape="matrix", low=0.0, high=1e3, default=0.0)
    gravity: Any = parameter(
        "m/s2",
        "gravitational acceleration, global frame",
        shape="vector",
        low=-100.0,
        high=100.0,
        default=(0.0, 0.0, -9.81),
    )
    tendon_offset: Any = parameter(
        "m", "distance of the tendons from the rod's axis; of no use to the crude model", low=0.0, high=1.0,
        default=0.0,
    )  # fmt: skip
    tendon_angles: Any = parameter(
        "rad", "angles of the tendons about the rod", shape="list", low=-10.0, high=10.0, default=FOUR_TENDONS
    )
    shear_stiffness: Any = parameter(
        "N", "Kse; by default diag(GA, GA, EA)", shape="matrix", low=1e-9, high=1e15, default=None
    )
    bending_stiffness: Any = parameter(
        "N m2", "Kbt; by default diag(EI, EI, 2GI)", shape="matrix", low=1e-15, high=1e9, default=None
    )

    # what follows from the parameters

    @property
    def control_layout(self) -> Layout:  # type: ignore[override]
        """One tension per tendon."""
        return Layout(("tension", np.shape(self.tendon_angles)[-1], "N", "tendon tension"))

    @property
    def section(self) -> CircularSection:
        """The rod's cross-section."""
        return CircularSection(self.radius)

    @property
    def mass_per_length(self) -> Any:
        """ρA (kg/m)."""
        return self.density * self.section.area

    @property
    def G(self) -> Any:
        """Shear modulus (Pa): as given, or from Young's."""
        return shear_modulus(self.youngs_modulus) if self.shear_modulus is None else self.shear_modulus

    @property
    def Kse(self) -> Float[Any, "3 3"]:
        """Stiffness of shear and extension (N): as given, or from moduli and section."""
        if self.shear_stiffness is not None:
            return self.shear_stiffness
        return self.section.shear_stiffness(self.youngs_modulus, self.G)

    @property
    def Kbt(self) -> Float[Any, "3 3"]:
        """Stiffness of bending and twisting (N·m²): as given, or from moduli and section."""
        if self.bending_stiffness is not None:
            return self.bending_stiffness
        return self.section.bending_stiffness(self.youngs_modulus, self.G)

    @property
    def v_star(self) -> np.ndarray:
        """v of the unloaded rod: straight along z, unstretched."""
        return np.array([0.0, 0.0, 1.0])

    @property
    def u_star(self) -> np.ndarray:
        """u of the unloaded rod (1/m): straight."""
        return np.zeros(3)

    # what learning looks at

    @abc.abstractmethod
    def tendon_force(self, control: Float[Any, " c"]) -> Float[Any, "3"]:
        """What the tendons add to the rate of n: a force per length (N/m), global frame."""

    @property
    def observable_layout(self) -> Layout:
        """Motion and bending, as seen from the material."""
        return Layout(
            ("acceleration", 3, "m/s2", "acceleration of the centreline"),
            ("spin", 3, "1/s2", "rate of the angular momentum over ρI"),
            ("q", 3, "m/s", "velocity"),
            ("w", 3, "rad/s", "angular velocity"),
            ("u", 3, "1/m", "curvature"),
            ("u_t", 3, "1/(m s)", "rate of the curvature"),
        )

    def observables(self, s: Any, y: Any, y_t: Any, z: Any, z_t: Any, control: Any) -> Float[Any, " o"]:
        """See `observable_layout`."""
        q, w = self.y_layout.get(y, "q"), self.y_layout.get(y, "w")
        q_t, w_t = self.y_layout.get(y_t, "q"), self.y_layout.get(y_t, "w")
        u, u_t = self.z_layout.get(z, "u"), self.z_layout.get(z_t, "u")
        J = np.diag([1.0, 1.0, 2.0])
        acceleration, spin = cross(w, q) + q_t, cross(w, dot(J, w)) + dot(J, w_t)
        return jnp.concatenate([acceleration, spin, q, w, u - self.u_star, u_t])

    # the equations, as the paper gives them

    def rates(
        self, s: Any, t: Any, y: Float[Any, " y"], z: Float[Any, " z"], control: Any, history: History
    ) -> Float[Any, " y"]:
        """y_s (paper eqs. 13 and 14)."""
        y_t, z_t = history.c0 * y + history.y, history.c0 * z + history.z
        return self._spatial_rates(y, y_t, z, z_t, control)

    def _spatial_rates(self, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """The right-hand side of paper eq. 13, once y_t, z and z_t are known."""
        _, h, n, _, q, w = self.y_layout.split(y)
        R = rotation_matrix(h)
        q_t, w_t = self.y_layout.get(y_t, "q"), self.y_layout.get(y_t, "w")
        v, u = self.z_layout.get(z, "v"), self.z_layout.get(z, "u")
        v_t, u_t = self.z_layout.get(z_t, "v"), self.z_layout.get(z_t, "u")
        rhoA, rhoJ = self.mass_per_length, self.density * self.section.inertia
        g, C = self.gravity, self.drag
        f_tendon = self.tendon_force(control)

        p_s = dot(R, v)
        h_s = quaternion_rate(h, u)
        n_s = dot(R, rhoA * (cross(w, q) + q_t) + square_law_drag(C, q)) - rhoA * g - f_tendon
        m_s = dot(R, cross(w, dot(rhoJ, w)) + dot(rhoJ, w_t)) - cross(p_s, n)
        q_s = v_t - cross(u, q) + cross(w, v)
        w_s = u_t - cross(u, w)
        return jnp.concatenate([p_s, h_s, n_s, m_s, q_s, w_s])

    # the two ends, and rest

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Straight up along z, unloaded, at rest."""
        p = jnp.stack([jnp.zeros(()), jnp.zeros(()), jnp.asarray(s, dtype=float)])
        h = np.array([1.0, 0.0, 0.0, 0.0])
        y = jnp.concatenate([p, h, np.zeros(12)])
        return y, jnp.concatenate([self.v_star, self.u_star])

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], history: History) -> Float[Any, " k"]:
        """The tip is free: n = m = 0 there."""
        return jnp.concatenate([-self.y_layout.get(y, "n"), -self.y_layout.get(y, "m")])

    @property
    def tip_layout(self) -> Layout:
        """Force and moment at the tip, global frame."""
        return Layout(
            ("n", 3, "N", "force at the tip, global frame", "h", "N"),
            ("m", 3, "N m", "moment at the tip, global frame", "h", "N m"),
        )

    def scales(self) -> Scales:
        """Of a beam: length L, force EI/L², moment EI/L, time L² √(ρA/EI)."""
        L, EI = self.length, self.Kbt[0, 0]
        T = L * L * jnp.sqrt(self.mass_per_length / EI)
        force, moment = EI / (L * L), EI / L
        sizes = ((L, 3), (1.0, 4), (force, 3), (moment, 3), (L / T, 3), (1.0 / T, 3))
        y = jnp.concatenate([jnp.full(count, size) for size, count in sizes])
        return Scales(y, jnp.concatenate([jnp.full(3, force), jnp.full(3, moment)]))
