"""Hysteretic friction of tendons, and its loss by vibration: two internal variables.

Friction. A sliding tendon loses tension along its path, like a rope on a capstan: τᵢ = Tᵢ exp(-λᵢ) with λᵢ_s
= fᵢ (k + μ |u|), the wobble coefficient k and the curvature friction coefficient μ. fᵢ, from -1 to 1, is the
mobilised fraction of the friction, with its direction. It is a part of z and causes the hysteresis. It grows
as the rod bends in the tendon's direction eᵢ, until the tendon slides (an elastic, perfectly plastic element:
Prandtl 1928)

    fᵢ_t = eᵢ·u_t / κ₀    while |fᵢ| < 1

A robot at rest therefore stays at rest under noisy tensions. (Dahl's smooth law lets it creep: with that law
the prediction of a step of 10 s had three times the error.) An equilibrium, with all rates zero, has no
friction, except for the part `at_rest` of the friction that the motion from the unloaded rod would have built
up.

Vibration. Above some total tension of all tendons robots begin to shake, and vibration removes friction: x,
from 0 to 1, is the removed part. It is an internal variable too, x_t = k_v (Σ Tᵢ - T_v), and reduces the
rod's bending stiffness by c x Σ Tᵢ.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.law import Evolution, Fields, MaterialLaw
from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.parts import Part, RodPoint
from knode_cosserat.rods.tendon_parts import TendonContribution, base_tension
from knode_cosserat.rotation import dot

#: curvature (1/m) of the regularisation of |u| in friction, so that it has a derivative everywhere
STRAIGHT = 1e-2


class TendonFriction(TendonContribution, Part):
    """Capstan friction of the tendons, by their length and by the angle they turn, with hysteresis."""

    kind: ClassVar[str] = "tendon-friction"

    wobble: Any = parameter(
        "1/m", "k, friction by the length of a tendon in the robot", low=0.0, high=100.0, default=0.0
    )
    curvature: Any = parameter(
        "1/rad", "μ, friction by the angle that a tendon turns", low=0.0, high=10.0, default=0.0
    )
    reach: Any = parameter(
        "1/m", "κ₀, change of curvature that builds friction up", low=1e-4, high=100.0, default=0.1
    )
    at_rest: Any = parameter(
        "", "part of the friction of a motion from the unloaded rod that acts in an equilibrium", low=-1.0,
        high=1.0, default=0.0,
    )  # fmt: skip

    def y_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return λ."""
        return (("loss", rod.tendon_count, "1", "logarithm of tension lost by friction"),)

    def z_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return f."""
        return (("f", rod.tendon_count, "1", "part of the friction that holds a tendon, and which way"),)

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law with that of fᵢ; in an equilibrium the bending determines it."""

        def evolutions(strains: Fields, rates: Fields) -> dict[str, Evolution]:
            directions = point.rod.bending_directions(point.s)
            return {"f": self.evolution(directions, rates["u"], strains["u"] - point.material.u_star)}

        return law.with_internal(evolutions)

    def evolution(
        self, directions: Float[Any, "c 3"], u_t: Float[Any, "3"], bent: Float[Any, "3"]
    ) -> Evolution:
        """Return the law of fᵢ of tendons that bend the rod in these directions.

        Args:
            directions: eᵢ.
            u_t: rate of the curvature (1/(m s)).
            bent: curvature relative to the unloaded rod (1/m), for an equilibrium.
        """
        along = directions / self.reach
        return Evolution(dot(along, u_t), self.at_rest * dot(along, bent), -1.0, 1.0)

    def rates(self, point: RodPoint) -> Fields:
        """Return λᵢ_s (1/m)."""
        f = point.get("f")
        for part in point.rod.parts.values():
            f = part.mobilised(point, f) if isinstance(part, TendonContribution) else f
        return {"loss": self.loss_rates(point.get("u"), f)}

    def loss_rates(self, u: Float[Any, "3"], f: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return λᵢ_s (1/m) at the curvature u (1/m), with the mobilised fraction f of the friction."""
        turn = jnp.sqrt(u[0] * u[0] + u[1] * u[1] + STRAIGHT**2) - STRAIGHT
        return (self.wobble + self.curvature * turn) * f

    def transmitted(self, point: RodPoint, tension: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return the tensions less the loss."""
        return tension * jnp.exp(-point.get("loss"))

    def eased(self, part: float) -> Self:
        """Return friction that builds up over a longer change of curvature."""
        return dataclasses.replace(self, reach=np.minimum(self.reach / part, 100.0))


class Vibration(TendonContribution, Part):
    """Loss of friction and of bending stiffness by vibration under high tensions."""

    kind: ClassVar[str] = "vibration"

    tension: Any = parameter(
        "N", "T_v, tension of all tendons together above which vibration grows", low=0.0, high=1e6
    )
    rate: Any = parameter("1/(N s)", "k_v, how fast it grows", low=0.0, high=1e3)
    softening: Any = parameter(
        "m2", "c, loss of bending stiffness by vibration, by tension", low=0.0, high=1.0, default=0.0
    )

    def z_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return x."""
        return (("x", 1, "1", "part of the friction that vibration has taken away"),)

    def evolutions(self, point: RodPoint) -> dict[str, Evolution]:
        """Return the law of x."""
        return {"x": self.evolution(jnp.sum(base_tension(point)))}

    def evolution(self, total: Any) -> Evolution:
        """Return the law of x under a total tension (N) of all tendons: at rest it is 0 or 1."""
        growth = jnp.reshape(self.rate * (total - self.tension), (1,))
        return Evolution(growth, jnp.sign(growth), 0.0, 1.0)

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law with the loss of bending stiffness."""
        u = law.strains["u"]
        softening = self.softening * jnp.sum(base_tension(point)) * np.diag([1.0, 1.0, 0.0])
        loss = internal["x"][0] * softening
        stress = u.stress - dot(loss, point.material.u_star)
        return law.with_strain("u", u.soften(loss)._replace(stress=stress))

    def mobilised(self, point: RodPoint, friction: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return the fraction of the friction that vibration has left."""
        return friction * (1.0 - point.get("x"))
