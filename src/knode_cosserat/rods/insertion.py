"""Insertion: a rod that is fed through a hole at its base, so that the length beyond the hole changes.

A place of the material is measured from the base of the rod that is not fed, of length L. With the exposed
length ℓ, it is X_h = L - ℓ at the hole and L at the tip. Sections, shape at rest, routing and loads along the
rod belong to the material. The grid's places are those of the unfed rod. But the first stretch between two
discontinuities that is exposed begins at the hole, and those before it have no length. At the fraction ξ of
that stretch, the material moves along the grid at the speed c = ℓ_t (1 - ξ). Beyond it the grid moves with
the material, c = 0. Rates along the grid are multiplied by X_s. With q and ω of the grid's places,

    q_a = q + c v,     ω_a = ω + c u                                      motion of the material
    q_s = v_t + γ v - u × q + ω × v,     ω_s = u_t + γ u - u × ω          compatibility, γ = -c_X

Momentum and angular momentum per length, P = ρA q_a and H = ρJ ω_a, are carried along. The states n and m are
the force and the moment of the rod less c R P and c R H, so that no strain is differentiated along the rod:

    n_s = R (P_t + ω × P + γ P) - f,     m_s = R (H_t + ω × H + γ H) - p_s × (n + c R P) - l
    (K - c² ρA) v + … = Rᵀn + K v* + c ρA q,     (Kbt - c² ρJ) u + … = Rᵀm + Kbt u* + c ρJ ω

P_t and H_t include the rates of ρA and ρJ at the grid's places, which are -c times their derivatives by X.
This is the balance of an axially moving beam (Stylianou & Tabarrok 1994) at large deflection. The rates of
strain in the material's damping, and accelerations in loads along the rod, such as the added mass of water,
are those of the grid's places. Their relative error is γ times the time in which they change. A control that
is linear from row to row has steps of its rate there; "bdf2" resolves the force of acceleration in a row.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.ends import Clamped
from knode_cosserat.rods.law import Fields, MaterialLaw
from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.loads import Motion
from knode_cosserat.rods.parameters import Doubt, ParameterError, as_number, parameter
from knode_cosserat.rods.parts import Effect, RodPoint
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.rotation import cross, dot, rotation_matrix


class _FedPlace(NamedTuple):
    """A place of the grid under a control."""

    #: X, place of the material (m)
    place: Any
    #: X_s
    rate: Any
    #: 1 - ξ, the speed of the material along the grid over that at the hole
    share: Any
    #: γ over ℓ_t (1/m)
    growth: Any


class Insertion(Effect):
    """A hole at the base, through which a control feeds the rod; it is gripped there.

    The exposed length is the robot's `length` plus the control. Material behind the base is as that at the
    base; only routing continues there.
    """

    kind: ClassVar[str] = "insertion"
    actuates: ClassVar[bool] = True

    reserve: Any = parameter(
        "m",
        "length behind the hole without insertion; the rod cannot be inserted by more",
        low=0.0,
        high=20.0,
        default=0.0,
        doubt=Doubt(0.05),
    )
    retraction: Any = parameter(
        "m",
        "largest length to draw back into the hole, less than the robot's length",
        low=0.0,
        high=20.0,
        default=0.0,
    )

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """Length fed through the hole."""
        field = Field("insertion", 1, "m", "length fed through the hole, beyond the robot's length")
        low, high = as_number(self.retraction), as_number(self.reserve)
        return (field if low is None or high is None else field._replace(low=-low, high=high),)

    def check(self, rod: Any) -> None:
        """Raise `ParameterError` for parts that are bound to places of the material."""
        parts = {name: part for name, part in rod.parts.items() if part is not self}
        moved = [name for name, part in parts.items() if part.z_fields(rod)]
        within = [name for name, part in parts.items() if (part.applied_at or 1.0) < 1.0]
        retraction, length = as_number(self.retraction), as_number(rod.length)
        laws = ((type(rod), SlenderRod, name) for name in ("constitutive", "balance", "material"))
        for wrong, reason in (
            (
                retraction is not None and length is not None and retraction >= length,
                f"retraction is {retraction} m; allowed is less than the robot's length, {length} m",
            ),
            (not isinstance(rod.base_end, Clamped), "allowed is a clamped or driven base_end"),
            (
                moved,
                f"{', '.join(moved)} with states along the rod; allowed are parts without internal variables",
            ),
            (within, f"{', '.join(within)} at a place within the rod; allowed are point loads at the tip"),
            (
                any(getattr(own, name) is not getattr(base, name) for own, base, name in laws),
                f"a {rod.kind} has a law of its own; allowed are slender and tendon robots",
            ),
            (
                any(part.gyroscopic for part in rod.effects[rod.effects.index(self) :]),
                "allowed is a spinning-frame before it in effects",
            ),
        ):
            if wrong:
                raise ParameterError(f"insertion: {reason}")

    def y_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return the exposed length and its rate, constant along the rod."""
        return (
            ("exposed", 1, "m", "length of the rod beyond the hole"),
            ("feed", 1, "m/s", "rate of the exposed length"),
        )

    def base_y(self, point: RodPoint) -> Fields:
        """Return the exposed length."""
        return {"exposed": point.rod.length + point.input}

    def base_rates(self, point: RodPoint) -> Fields:
        """Return its rate."""
        return {"feed": point.rod.y_layout.get(point.y_t, "exposed")}

    def rest_y(self, rod: Any, s: Any) -> Fields:
        """Return the robot's length."""
        return {"exposed": jnp.reshape(rod.length, 1)}

    def scales(self, rod: Any, sizes: Fields) -> Fields:
        """Return those of positions and velocities."""
        return {"exposed": sizes["p"], "feed": sizes["q"]}

    def _grid(self, rod: Any, s: Any, fed: Any) -> _FedPlace:
        """Return a place of the grid with this length (m) fed beyond the robot's length."""
        edges, hole = np.array([0.0, *rod._places, 1.0]), -fed
        first, last, at = edges[:-1], edges[1:], s / rod.length
        # the tip belongs to the last stretch
        active = jnp.where((at >= first) & ((at < last) | (last == 1.0)), 1.0, 0.0)
        progress = jnp.clip((at - first) / (last - first), 0.0, 1.0)
        ends = jnp.maximum(edges[1:] * rod.length, hole)
        # material before the base belongs to the first stretch
        begins = jnp.concatenate([jnp.reshape(hole, 1), ends[:-1]])
        moving = jnp.where((begins <= hole) & (ends > hole), 1.0, 0.0)
        widths = ends - begins
        return _FedPlace(
            # rounding must not lead beyond the tip
            jnp.minimum(hole + jnp.sum(progress * widths), rod.length),
            jnp.sum(active * widths / (last - first)) / rod.length,
            1.0 - jnp.sum(progress * moving),
            jnp.sum(active * moving / jnp.where(widths > 0.0, widths, 1.0)),
        )

    def material_place(self, rod: Any, s: Any, input: Any) -> Any:
        """Return the place of the material (m), from -reserve to L."""
        return self._grid(rod, s, input[0]).place

    def speed(self, point: RodPoint, rates: Any) -> Any:
        """Return the speed c of the material along the grid (m/s) from y, or its rate from y_t."""
        # the control is that of this part only where it is asked
        fed = point.get("exposed")[0] - point.rod.length
        return point.rod.y_layout.get(rates, "feed") * self._grid(point.rod, point.s, fed).share

    def absolute(self, point: RodPoint, motion: Motion) -> Motion:
        """Return the motion of the material; in the law, where no strains are known, that of the grid."""
        if point.z is None:
            return motion
        c, c_t, layout = self.speed(point, point.y), self.speed(point, point.y_t), point.rod.z_layout
        (v, u), (v_t, u_t) = ([layout.get(z, name) for name in "vu"] for z in (point.z, point.z_t))
        return motion._replace(
            q=motion.q + c * v,
            w=motion.w + c * u,
            q_t=motion.q_t + c_t * v + c * v_t,
            w_t=motion.w_t + c_t * u + c * u_t,
        )

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law of the strains from n and m less the momentum that is carried along."""
        c, motion = self.speed(point, point.y), point.motion
        for name, mass, velocity in (
            ("v", point.material.rhoA * np.eye(3), motion.q),
            ("u", point.material.rhoJ, motion.w),
        ):
            strain = law.strains[name]
            carried = strain._replace(stress=strain.stress + c * dot(mass, velocity))
            law = law.with_strain(name, carried.soften(c * c * mass))
        return law

    def _mass_rates(self, point: RodPoint) -> tuple[Any, Any]:
        """Return the rates of ρA and ρJ at a place of the grid, through which the material moves."""
        rod = point.rod
        if rod.is_uniform:
            return 0.0, np.zeros((3, 3))
        feeds = [
            point.get("feed") if part is self else 0.0 * input for part, input in rod.inputs(point.control)
        ]

        def masses(control: Any) -> tuple[Any, Any]:
            material = rod.material(point.s, control)
            return material.rhoA, material.rhoJ

        return jax.jvp(masses, (point.control,), (jnp.concatenate(feeds),))[1]

    def arclength_rate(self, point: RodPoint) -> Any:
        """Return X_s."""
        return self._grid(point.rod, point.s, point.input[0]).rate

    def rates(self, point: RodPoint) -> Fields:
        """Return the terms of the material that moves along the grid."""
        feed, v, u = (point.get(name) for name in ("feed", "v", "u"))
        motion, c = point.motion, self.speed(point, point.y)
        growth = feed * self._grid(point.rod, point.s, point.input[0]).growth
        R, P = rotation_matrix(point.get("h")), point.material.rhoA * motion.q
        H = dot(point.material.rhoJ, motion.w)
        rhoA_t, rhoJ_t = self._mass_rates(point)
        # in the balance ω × P has the motion of the material, here c u too much
        return {
            "n": dot(R, growth * P - c * cross(u, P) + rhoA_t * motion.q),
            "m": dot(R, growth * H - c * (cross(u, H) + cross(v, P)) + dot(rhoJ_t, motion.w)),
            "q": growth * v,
            "w": growth * u,
        }
