"""Tendons as parts of a robot: their drive, and their action on the rod. Symbols as in `elastic_rod`.

n and m include rod and tendons, so the balance equations contain no tendon forces. n and m do not jump where
a tendon is anchored. The tendons' part is in the material's law (Till 2019, after Rucker & Webster 2011;
`tendon_law`), with tendon i at rᵢ(s) and ṗᵢ = v + u × rᵢ + rᵢ′:

    Rᵀn = Kse (v - v*) + Bse v_t + Σ τᵢ ṗᵢ/|ṗᵢ|        Rᵀm = Kbt (u - u*) + Bbt u_t + Σ τᵢ rᵢ × ṗᵢ/|ṗᵢ|

Drive. Tendons are pulled with a tension, or by a reel. A reel that has taken in dᵢ leaves a tendon the
length ℓᵢ* - dᵢ + C Tᵢ, with its length ℓᵢ* in the unloaded robot and the compliance C. The path length
through the robot is ℓᵢ = ∫|ṗᵢ| ds. Either the tendon is taut and they are equal, or it is slack and Tᵢ = 0:

    0 ≤ Tᵢ  ⊥  ℓᵢ* - dᵢ + C Tᵢ - ℓᵢ ≥ 0
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.law import Fields, MaterialLaw
from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.load_cells import LoadCells
from knode_cosserat.rods.parts import Contribution, RodPoint
from knode_cosserat.rods.reels import Reels
from knode_cosserat.rods.routing import path_lengths
from knode_cosserat.rods.tendon_law import Tendons, stretches
from knode_cosserat.rotation import dot

#: fraction of the rod's length over which slack and taut are blended, so that Newton's method has a slope
BLEND = 1e-7


class TendonContribution(Contribution):
    """Contribution of a part that changes the tendons' tension; by default it does not."""

    def transmitted(self, point: RodPoint, tension: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return the tensions τ (N) at a point with this part's friction."""
        return tension

    def running(self, point: RodPoint, values: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return values of the tendons at a point, less those of tendons that this part ends before it."""
        return values

    def mobilised(self, point: RodPoint, friction: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return the mobilised fraction of the friction with this part."""
        return friction


def running(point: RodPoint, values: Float[Any, " c"]) -> Float[Any, " c"]:
    """Return the tendons' values at a point, less those of tendons that end before it."""
    for part in point.rod.parts.values():
        values = part.running(point, values) if isinstance(part, TendonContribution) else values
    return values


def base_tension(point: RodPoint) -> Float[Any, " c"]:
    """Return the tensions T (N) at the base."""
    return point.rod.parts["tendons"].base_tension(point)


def tension(point: RodPoint) -> Float[Any, " c"]:
    """Return the tensions τ (N) at a point: reduced by friction, and zero beyond a tendon's end."""
    T = base_tension(point)
    for part in point.rod.parts.values():
        T = part.transmitted(point, T) if isinstance(part, TendonContribution) else T
    return running(point, T)


@dataclasses.dataclass(frozen=True)
class PulledTendons(TendonContribution):
    """Controls of tendons that are pulled with a tension."""

    count: int

    actuates: ClassVar[bool] = True

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """One tension per tendon."""
        return (Field("tension", self.count, "N", "tendon tension"),)


@dataclasses.dataclass(frozen=True)
class RoutedTendons(PulledTendons):
    """Tendons beside the rod, pulled with a tension: they couple its strains v and u."""

    #: fractions of the length at which the tendons are anchored
    ends: tuple[float, ...]
    #: corrections of the controls; None: they are tensions
    cells: LoadCells | None

    @property
    def cuts(self) -> tuple[float, ...]:
        """Places of the tendons' anchors."""
        return self.ends

    def base_tension(self, point: RodPoint) -> Float[Any, " c"]:
        """Return the tensions T (N) at the base."""
        given = point.control[: self.count]
        return given if self.cells is None else self.cells.tension(given)

    def running(self, point: RodPoint, values: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return the values with zero beyond the tendons' anchors."""
        if min(self.ends) >= 1.0:
            return values
        return jnp.where(point.s < np.array(self.ends) * point.rod.length, values, 0.0)

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law with the tendons' coupling of v and u."""
        r, r_s = point.rod.routes_at(point.s)
        nominal = running(point, self.base_tension(point))
        return law._replace(coupling=Tendons(r, r_s, tension(point), nominal))

    def actuation(self, rod: Any, control: Any) -> Any:
        """Return Σ Tᵢ d₃ × rᵢ of straight tendons (N·m), material frame; otherwise the control."""
        if not rod.paths.straight or rod.control_layout.size > self.count:
            return control
        T = self.base_tension(RodPoint(rod, 0.0, None, None, None, control))
        return rod.tendon_offset * dot(rod.bending_directions(0.0).T, T)


@dataclasses.dataclass(frozen=True)
class ReeledTendons(RoutedTendons):
    """Tendons that are taken in by reels: their tensions and path lengths are fields of y."""

    #: C (m/N), without the springs of `reels`
    own_compliance: Any
    #: motors of the reels; None: a control for each tendon
    reels: Reels | None

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """Lengths taken in by the reels, or the motors' angles."""
        count = self.count if self.reels is None else self.reels.motor_count(self.count)
        if self.reels is not None and self.reels.radius is not None:
            return (Field("motor", count, "rad", "angle of the motor"),)
        return (Field("reel", count, "m", "length of tendon that the reel has taken in"),)

    def taken_in(self, control: Any) -> Float[Any, " c"]:
        """Return dᵢ (m), the length of each tendon that the reels have taken in."""
        return control if self.reels is None else self.reels.lengths(control)

    @property
    def compliance(self) -> Any:
        """C (m/N) of each tendon, including its spring."""
        springs = None if self.reels is None else self.reels.compliance
        return self.own_compliance if springs is None else self.own_compliance + jnp.asarray(springs)

    def base_tension(self, point: RodPoint) -> Float[Any, " c"]:
        """Return the tensions in y."""
        return point.get("tension")

    def y_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return tension and path length."""
        return (
            ("tension", self.count, "N", "tendon tension at the base"),
            ("path", self.count, "m", "way of the tendons through the robot"),
        )

    def base_fields(self, rod: Any) -> tuple[str, ...]:
        """Return the tension's name."""
        return ("tension",)

    def tip_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return the complementarity of tension and slack."""
        return (("slack", self.count, "m", "slack or tension"),)

    def scales(self, rod: Any, sizes: Fields) -> Fields:
        """Return the rod's force for a tension, and its length for a path."""
        return {"tension": sizes["n"], "path": sizes["p"], "slack": sizes["p"]}

    def rest_y(self, rod: Any, s: Any) -> Fields:
        """Return the tendons' lengths in the unloaded robot from the base to s."""
        still = np.zeros(rod.control_layout.size)
        routings = rod.paths.routings
        return {"path": path_lengths(routings, s, rod.length, lambda at: rod.material(at, still).u_star)}

    def rates(self, point: RodPoint) -> Fields:
        """Return the rate of the path length."""
        routes = map(jnp.asarray, point.rod.routes_at(point.s))
        return {"path": running(point, stretches(point.get("v"), point.get("u"), *routes))}

    def tip_rows(self, point: RodPoint) -> Float[Any, " c"]:
        """Return the residual of tension or slack being zero (Fischer-Burmeister)."""
        rod, T = point.rod, point.get("tension")
        length = self.rest_y(rod, rod.length)["path"] - self.taken_in(point.input) + self.compliance * T
        # tension and slack are compared by the tendon's compliance plus a part of the rod's
        slack = length - point.get("path")
        pulled = (self.compliance + 1e-3 * rod.length**3 / rod.Kbt[0, 0]) * T
        blend = BLEND * rod.length
        return slack + pulled - jnp.sqrt(slack**2 + pulled**2 + 2.0 * blend**2)

    def actuation(self, rod: Any, control: Any) -> Any:
        """Return the control."""
        return control
