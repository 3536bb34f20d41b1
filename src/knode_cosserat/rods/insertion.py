"""Insertion: a rod that is fed through a hole at its base, so that the length beyond the hole changes.

The grid spans the exposed length ℓ. A place of the grid at s of the robot's length L is at the arclength
s ℓ/L from the hole, and all rates along the grid are multiplied by ℓ/L. Material moves along the grid at the
speed c = ℓ_t (1 - s/L), which is ℓ_t at the hole and zero at the tip. With q and ω of the grid's places,

    q_a = q + c v,     ω_a = ω + c u                                      motion of the material
    q_s = v_t + γ v - u × q + ω × v,     ω_s = u_t + γ u - u × ω          compatibility, γ = ℓ_t/ℓ

Momentum and angular momentum per length, P = ρA q_a and H = ρJ ω_a, are carried along. The states n and m are
the force and the moment of the rod less c R P and c R H, so that no strain is differentiated along the rod:

    n_s = R (P_t + ω × P + γ P) - f,     m_s = R (H_t + ω × H + γ H) - p_s × (n + c R P) - l
    (K - c² ρA) v + … = Rᵀn + K v* + c ρA q,     (Kbt - c² ρJ) u + … = Rᵀm + Kbt u* + c ρJ ω

This is the balance of an axially moving beam (Stylianou & Tabarrok 1994) at large deflection. The rates of
strain in the material's damping, and accelerations in loads along the rod, such as the added mass of water,
are those of the grid's places. Their relative error is γ times the time in which they change. A control that
is linear from row to row has steps of its rate there; "bdf2" resolves the force of acceleration in a row.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.ends import Clamped
from knode_cosserat.rods.law import Fields, MaterialLaw
from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.loads import Motion
from knode_cosserat.rods.parameters import ParameterError, as_number, parameter
from knode_cosserat.rods.parts import Effect, RodPoint
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.rotation import cross, dot, rotation_matrix


class Insertion(Effect):
    """A hole at the base, through which a control feeds the rod; it is gripped there.

    The exposed length is the robot's `length` plus the control. Loads along the rod act on the exposed rod.
    """

    kind: ClassVar[str] = "insertion"
    actuates: ClassVar[bool] = True

    reserve: Any = parameter(
        "m", "length behind the hole without insertion; the rod cannot be inserted by more", low=0.0,
        high=20.0, default=0.0,
    )  # fmt: skip
    retraction: Any = parameter(
        "m", "largest length to draw back into the hole, less than the robot's length", low=0.0, high=20.0,
        default=0.0,
    )  # fmt: skip

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """Length fed through the hole."""
        field = Field("insertion", 1, "m", "length fed through the hole, beyond the robot's length")
        low, high = as_number(self.retraction), as_number(self.reserve)
        return (field if low is None or high is None else field._replace(low=-low, high=high),)

    def check(self, rod: Any) -> None:
        """Raise `ParameterError` for parts that are bound to places of the material."""
        parts = {name: part for name, part in rod.parts.items() if part is not self}
        moved = [name for name, part in parts.items() if part.y_fields(rod) or part.z_fields(rod)]
        within = [name for name, part in parts.items() if any(cut < 1.0 for cut in part.cuts)]
        retraction, length = as_number(self.retraction), as_number(rod.length)
        laws = ((type(rod), SlenderRod, name) for name in ("constitutive", "balance", "material"))
        for wrong, reason in (
            (
                retraction is not None and length is not None and retraction >= length,
                f"retraction is {retraction} m; allowed is less than the robot's length, {length} m",
            ),
            (not isinstance(rod.base_end, Clamped), "allowed is a clamped or driven base_end"),
            (moved, f"{', '.join(moved)} with states along the rod; allowed are parts without states"),
            (within, f"{', '.join(within)} within the rod; allowed are loads at the tip or all along"),
            (
                any(getattr(own, name) is not getattr(base, name) for own, base, name in laws)
                or not rod.is_uniform,
                "allowed is a rod of one section all along, without changes in sections",
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

    def speed(self, point: RodPoint, rates: Any) -> Any:
        """Return the speed c of the material along the grid (m/s) from y, or its rate from y_t."""
        return point.rod.y_layout.get(rates, "feed") * (1.0 - point.s / point.rod.length)

    def absolute(self, point: RodPoint, motion: Motion) -> Motion:
        """Return the motion of the material; in the law, where no strains are known, that of the grid."""
        if point.z is None:
            return motion
        c, c_t, layout = self.speed(point, point.y), self.speed(point, point.y_t), point.rod.z_layout
        (v, u), (v_t, u_t) = ([layout.get(z, name) for name in "vu"] for z in (point.z, point.z_t))
        return motion._replace(
            q=motion.q + c * v, w=motion.w + c * u,
            q_t=motion.q_t + c_t * v + c * v_t, w_t=motion.w_t + c_t * u + c * u_t,
        )  # fmt: skip

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law of the strains from n and m less the momentum that is carried along."""
        c, motion = self.speed(point, point.y), point.motion
        for name, mass, velocity in (
            ("v", point.material.rhoA * np.eye(3), motion.q), ("u", point.material.rhoJ, motion.w)
        ):  # fmt: skip
            strain = law.strains[name]
            carried = strain._replace(stress=strain.stress + c * dot(mass, velocity))
            law = law.with_strain(name, carried.soften(c * c * mass))
        return law

    def arclength_rate(self, point: RodPoint) -> Any:
        """Return ℓ/L."""
        return 1.0 + point.input[0] / point.rod.length

    def rates(self, point: RodPoint) -> Fields:
        """Return the terms of the material that moves along the grid."""
        exposed, feed, v, u = (point.get(name) for name in ("exposed", "feed", "v", "u"))
        motion, c, growth = point.motion, self.speed(point, point.y), feed / exposed
        R, P = rotation_matrix(point.get("h")), point.material.rhoA * motion.q
        H = dot(point.material.rhoJ, motion.w)
        # in the balance ω × P has the motion of the material, here c u too much
        return {
            "n": dot(R, growth * P - c * cross(u, P)),
            "m": dot(R, growth * H - c * (cross(u, H) + cross(v, P))),
            "q": growth * v,
            "w": growth * u,
        }
