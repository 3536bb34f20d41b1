"""Tendons as parts of a robot: drive, action on the rod, friction, ribs. Symbols as in `rod`.

n and m include rod and tendons, so the balance equations contain no tendon forces. n and m do not jump where
a tendon is anchored. The tendons' part is in the material's law (Till 2019, after Rucker & Webster 2011;
`tendon_law`), with tendon i at rᵢ(s) and ṗᵢ = v + u × rᵢ + rᵢ′:

    Rᵀn = Kse (v - v*) + Bse v_t + Σ τᵢ ṗᵢ/|ṗᵢ|        Rᵀm = Kbt (u - u*) + Bbt u_t + Σ τᵢ rᵢ × ṗᵢ/|ṗᵢ|

Drive. Tendons are pulled with a tension, or by a reel. A reel that has taken in dᵢ leaves a tendon the
length ℓᵢ* - dᵢ + C Tᵢ, with its length ℓᵢ* in the unloaded robot and the compliance C. The path length
through the robot is ℓᵢ = ∫|ṗᵢ| ds. Either the tendon is taut and they are equal, or it is slack and Tᵢ = 0:

    0 ≤ Tᵢ  ⊥  ℓᵢ* - dᵢ + C Tᵢ - ℓᵢ ≥ 0

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

Ribs. Tendons are straight between two ribs, a distance d apart, and press on the bent rod with the sum P of
their tensions. The rotation from rib to rib is that of a beam-column (Timoshenko & Gere 1961), with the
effective bending stiffness EI x cot x, x = d/2 √(P/EI). The loss is P d²/12 to leading order; the stiffness
is zero where the rod between two ribs buckles.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.law import Evolution, Fields, MaterialLaw
from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.parameters import ParameterError, parameter, place, places
from knode_cosserat.rods.parts import Contribution, Effect, Part, RodPoint
from knode_cosserat.rods.routing import path_lengths
from knode_cosserat.rods.section import ABOUT_X, ABOUT_Y, ACROSS, COUPLED
from knode_cosserat.rods.shapes import Shape, disk, rim, tendon_routes
from knode_cosserat.rods.tendon_law import Tendons, stretches
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.rotation import dot


class Reels(Part):
    """Reels of a robot whose controls are motors' angles, or lengths, instead of tensions.

    A motor at the angle φ has wound up the length R (φ - φ₀) of each of its tendons. It has let out the same
    length of the tendons on the other side of its reel: an antagonistic pair has one motor. Tendon i, at the
    motor m on the side σ = ±1, is taken in by

        dᵢ = σ R_m (φ_m - φ₀_m) + tᵢ

    tᵢ is the length taken in at the motors' zeros: its pretension, or its slack if negative. `compliance` is
    that of springs in series with the tendons.
    """

    kind: ClassVar[str] = "reels"

    motors: Any = parameter(
        "",
        "motor of each tendon, from 1 on; negative if its angle lets the tendon out",
        shape="list",
        low=-1e3,
        high=1e3,
    )
    radius: Any = parameter(
        "m",
        "R of each motor's reel; without it controls are lengths in m",
        shape="list",
        low=1e-6,
        high=1.0,
        default=None,
    )
    zero: Any = parameter(
        "rad",
        "φ₀, angle of each motor at which its reel has taken in nothing",
        shape="list",
        low=-1e3,
        high=1e3,
        default=None,
    )
    taken_in: Any = parameter(
        "m",
        "t, length of each tendon that is taken in at the motors' zeros",
        shape="list",
        low=-1.0,
        high=1.0,
        default=None,
    )
    compliance: Any = parameter(
        "m/N", "of a spring in series with each tendon", shape="list", low=0.0, high=1.0, default=None
    )

    def __check_init__(self) -> None:
        super().__check_init__()
        if isinstance(self.motors, jax.core.Tracer):
            return
        motors = np.abs(np.asarray(self.motors))
        count = int(motors.max())
        if not np.array_equal(np.unique(motors), np.arange(1, count + 1)):
            raise ParameterError(
                f"Reels: motors is {np.asarray(self.motors).tolist()}; allowed is one whole number for each "
                "tendon, that of its motor from 1 on, negative on the side that lets out"
            )
        if self.radius is None and self.zero is None and count != len(motors):
            raise ParameterError("Reels: radius is missing; it is required where tendons share a motor")
        sizes = {"radius": count, "zero": count, "taken_in": len(motors), "compliance": len(motors)}
        for name, size in sizes.items():
            value = getattr(self, name)
            if value is not None and np.shape(value)[-1:] != (size,):
                raise ParameterError(
                    f"Reels: {name} has {np.size(value)} numbers; allowed is {size}, one for each "
                    f"{'motor' if name in ('radius', 'zero') else 'tendon'}; "
                    f"motors, {motors.astype(int).tolist()}, has one number for each tendon"
                )

    @property
    def tendon_count(self) -> int:
        """Number of tendons."""
        return int(np.shape(self.motors)[-1])

    def motor_count(self, tendons: int) -> int:
        """Return the number of motors, which equals the number of controls."""
        for value in (self.radius, self.zero):
            if value is not None:
                return int(np.shape(value)[-1])
        return tendons

    def lengths(self, control: Float[Any, " motors"]) -> Float[Any, " tendons"]:
        """Return the length of each tendon that the reels have taken in (m)."""
        turned = jnp.asarray(control)
        if self.zero is not None:
            turned = turned - self.zero
        if self.radius is not None:
            turned = turned * self.radius
        motors = jnp.asarray(self.motors)
        numbers = np.arange(1.0, turned.shape[-1] + 1.0)
        sides = jnp.where(jnp.abs(motors)[:, None] == numbers, jnp.sign(motors)[:, None], 0.0)
        taken_in = jnp.sum(sides * turned, axis=1)
        return taken_in if self.taken_in is None else taken_in + jnp.asarray(self.taken_in)


class Markers(Effect):
    """Identified places of tracked bodies; they do not change the motion."""

    kind: ClassVar[str] = "markers"

    at: Any = parameter("", "places as parts of the length", shape="list", low=0.0, high=1.0)
    stated: tuple[float, ...] | None = places("places in the recordings")

    def __check_init__(self) -> None:
        super().__check_init__()
        if np.size(self.at) != len(self.stated or ()):
            raise ParameterError("markers have not as many places `at` as `stated`; allowed is one for each")


class LoadCells(Part):
    """Correction of measured tensions: true tension = gain * measured + offset, for each tendon.

    A tendon only pulls: a negative result is set to zero. `simulate` ignores the latency and applies the
    controls without a delay; `remove_delay` corrects a recording for it.
    """

    kind: ClassVar[str] = "load-cells"

    gain: Any = parameter(
        "",
        "true over measured tension, one for each tendon",
        shape="list",
        low=1e-3,
        high=1e3,
        default=(1.0, 1.0, 1.0, 1.0),
    )
    offset: Any = parameter(
        "N",
        "true tension where none is measured, one for each tendon",
        shape="list",
        low=-1e3,
        high=1e3,
        default=(0.0, 0.0, 0.0, 0.0),
    )

    latency: Any = parameter(
        "s", "delay of the readings behind the poses of a recording", low=-10.0, high=10.0, default=0.0
    )

    def undelayed(
        self, measured: Float[np.ndarray, "T c"], dt: float, before: Float[np.ndarray, " c"] | None = None
    ) -> Float[np.ndarray, "T c"]:
        """Return the readings (N) at the times of the poses: each row's reading from `latency` later.

        `dt` and `before` as in `rows_later`.
        """
        return rows_later(measured, float(self.latency), dt, before)

    def tension(self, measured: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return true tensions (N)."""
        return jnp.maximum(self.gain * measured + self.offset, 0.0)


def rows_later(
    measured: Float[np.ndarray, "T c"], late: float, dt: float, before: Float[np.ndarray, " c"] | None = None
) -> Float[np.ndarray, "T c"]:
    """Return each row's value from `late` (s) later.

    Rows are means over steps of `dt` (s), with linear interpolation between them. The last row holds beyond
    the end. Before the first row the value is `before`, or by default the first row.
    """
    first = measured[0] if before is None else before
    rows = np.concatenate([[first], measured, measured[-1:]])
    at = np.clip(np.arange(1, len(measured) + 1) + late / dt, 0, len(measured) + 1)
    low = np.minimum(at.astype(int), len(measured))
    part = (at - low)[:, None]
    return np.asarray((1.0 - part) * rows[low] + part * rows[low + 1])


def remove_delay(
    system: Any, measured: Float[np.ndarray, "T c"], dt: float, before: Float[np.ndarray, " c"] | None = None
) -> Float[np.ndarray, "T c"]:
    """Return the controls that acted on a system, from measured ones that are held for `dt` (s) each.

    They are equal unless the robot's load cells have a delay. `before` acted before the first row.
    """
    cells = getattr(nominal_model(system), "load_cells", None)
    return measured if cells is None else cells.undelayed(measured, dt, before)


#: fraction of the rod's length over which slack and taut are blended, so that Newton's method has a slope
BLEND = 1e-7


def running(point: RodPoint, values: Float[Any, " c"]) -> Float[Any, " c"]:
    """Return the tendons' values at a point, less those of tendons that end before it."""
    for part in point.rod.parts.values():
        values = part.running(point, values)
    return values


def base_tension(point: RodPoint) -> Float[Any, " c"]:
    """Return the tensions T (N) at the base."""
    return point.rod.parts["tendons"].base_tension(point)


def tension(point: RodPoint) -> Float[Any, " c"]:
    """Return the tensions τ (N) at a point: reduced by friction, and zero beyond a tendon's end."""
    T = base_tension(point)
    for part in point.rod.parts.values():
        T = part.transmitted(point, T)
    return running(point, T)


#: most guides that are drawn of a robot without ribs
GUIDES = 21


@dataclasses.dataclass(frozen=True)
class PulledTendons(Contribution):
    """Controls of tendons that are pulled with a tension."""

    count: int

    actuates: ClassVar[bool] = True

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """One tension per tendon."""
        return (Field("tension", self.count, "N", "tendon tension"),)

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return the tendons along their routes, and thin guides at the nodes of a robot without ribs."""
        # thin beside a thick body
        radius, found = min(0.22 * float(rod.section.radius), 0.004 * float(rod.length)), []
        (field,) = self.control_fields
        routes = tendon_routes(rod, at)
        for k, (end, route) in enumerate(zip(rod.tendon_ends, routes, strict=True)):
            count = max(2, round(end * (len(at) - 1)) + 1)
            value = control[:, k] if field.size == self.count else None
            found.append(
                Shape(
                    "tendon", f"tendon {k + 1}", at[:count], route[:count], radius,
                    value=value, unit=field.unit,
                )
            )  # fmt: skip
        if any(isinstance(load, AttachedMass) for load in rod.loads):
            return tuple(found)
        count, size = min(len(at), GUIDES), rim(rod) or radius
        guides = (disk("guide", "guide", k / (count - 1), size) for k in range(1, count))
        return (*found, *guides)


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
        tension = point.control[: self.count]
        return tension if self.cells is None else self.cells.tension(tension)

    def running(self, point: RodPoint, values: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return the values with zero beyond the tendons' anchors."""
        if min(self.ends) >= 1.0:
            return values
        return jnp.where(point.material_place < np.array(self.ends) * point.rod.length, values, 0.0)

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law with the tendons' coupling of v and u."""
        r, r_s = point.rod.routes_at(point.material_place)
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
        return {"path": path_lengths(rod.paths.routings, s, rod.length, rod.strains_at_rest)}

    def rates(self, point: RodPoint) -> Fields:
        """Return the rate of the path length."""
        routes = map(jnp.asarray, point.rod.routes_at(point.material_place))
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


class EarlyAnchors(Part):
    """A place with early anchors: beyond it each tendon keeps a part of its tension, 0 if anchored there."""

    kind: ClassVar[str] = "early-anchors"

    at: float = place("where tendons are anchored")
    share: Any = parameter(
        "",
        "part of each tendon's tension beyond that place",
        shape="list",
        low=-1.0,
        high=2.0,
        default=(1.0, 1.0, 1.0, 1.0),
    )

    @property
    def cuts(self) -> tuple[float, ...]:
        """Place of the anchors."""
        return (self.at,)

    def running(self, point: RodPoint, values: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return each tendon's share of the values beyond that place."""
        return values * jnp.where(point.material_place < self.at * point.rod.length, 1.0, self.share)


#: curvature (1/m) of the regularisation of |u| in friction, so that it has a derivative everywhere
STRAIGHT = 1e-2


class TendonFriction(Part):
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
        "",
        "part of the friction of a motion from the unloaded rod that acts in an equilibrium",
        low=-1.0,
        high=1.0,
        default=0.0,
    )

    def y_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return λ."""
        return (("loss", rod.tendon_count, "1", "logarithm of tension lost by friction"),)

    def z_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return f."""
        return (("f", rod.tendon_count, "1", "part of the friction that holds a tendon, and which way"),)

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law with that of fᵢ; in an equilibrium the bending determines it."""

        def evolutions(strains: Fields, rates: Fields) -> dict[str, Evolution]:
            directions = point.rod.bending_directions(point.material_place)
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
            f = part.mobilised(point, f)
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


class Vibration(Part):
    """Loss of friction and of bending stiffness by vibration under high tensions."""

    kind: ClassVar[str] = "vibration"

    tension: Any = parameter(
        "N", "T_v, tension of all tendons together above which vibration grows", low=0.0, high=1e6
    )
    rate: Any = parameter("1/(N s)", "k_v, rate of growth", low=0.0, high=1e3)
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


#: below this the series of √w cot √w is exact to rounding
SMALL_PRESSURE = 1e-3
#: argument of `stiffness_under_pressure` at which a beam-column buckles
BUCKLED = 0.25 * np.pi**2


class RibSpacing(Part):
    """Loss of bending stiffness under tension, because tendons are straight between ribs."""

    kind: ClassVar[str] = "rib-spacing"

    softening: Any = parameter(
        "m2",
        "loss of bending stiffness by small tensions, the same everywhere; d²/12 for ribs at a distance d",
        low=0.0,
        high=1e4,
        default=0.0,
    )
    at: tuple[float, ...] | None = places("where the ribs are, in order")
    share: Any = parameter(
        "",
        "loss between ribs at these places, over that of tendons that are straight there",
        low=0.0,
        high=10.0,
        default=1.0,
    )

    def __check_init__(self) -> None:
        super().__check_init__()
        if self.at is not None and not all(np.diff((0.0, *self.at)) > 0.0):
            raise ParameterError(
                f"at is {list(self.at)}; allowed is ribs in order, each beyond the one before"
            )

    def softening_at(self, sigma: Any) -> Any:
        """Return d²/12 over the squared length at σ, of the span between two ribs, times `share`.

        There are no tendons beyond the last rib.
        """
        if self.at is None:
            return 0.0
        ribs = np.array([0.0, *self.at])
        spans = np.append(np.diff(ribs) ** 2 / 12.0, 0.0)
        return self.share * jnp.asarray(spans)[jnp.sum(sigma >= ribs[1:])]

    @property
    def cuts(self) -> tuple[float, ...]:
        """Places of the ribs."""
        return self.at or ()

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law with the loss of bending stiffness, about each principal axis its own.

        Tendons press on the bent rod, including its curvature at rest.
        """
        Kbt, length = law.strains["u"].softened, point.rod.length
        mean, half = 0.5 * (Kbt[0, 0] + Kbt[1, 1]), 0.5 * (Kbt[0, 0] - Kbt[1, 1])
        # apart by more than rounding, for the derivative of equal ones
        separation = jnp.sqrt(half**2 + Kbt[0, 1] ** 2 + (1e-8 * mean) ** 2)
        principal = mean + separation * np.array([1.0, -1.0])
        softening = self.softening + self.softening_at(point.material_place / length) * length**2
        lost = principal * (
            1.0 - stiffness_under_pressure(3.0 * softening * jnp.sum(tension(point)) / principal)
        )
        deviator = half * (ABOUT_X - ABOUT_Y) + Kbt[0, 1] * COUPLED
        loss = 0.5 * jnp.sum(lost) * ACROSS + 0.5 * (lost[0] - lost[1]) / separation * deviator
        return law.with_strain("u", law.strains["u"].soften(loss))


def stiffness_under_pressure(w: Any) -> Any:
    """Return √w cot √w for w ≥ 0: the remaining fraction of a beam-column's stiffness under pressure.

    Beyond π²/4, where it buckles, the fraction continues below zero along the tangent.
    """
    small, buckled = w < SMALL_PRESSURE, w > BUCKLED
    root = jnp.sqrt(jnp.where(small | buckled, 1.0, w))
    series = 1.0 - w / 3.0 - w * w / 45.0 - 2.0 * w**3 / 945.0
    return jnp.where(small, series, jnp.where(buckled, 0.5 * (BUCKLED - w), root / jnp.tan(root)))
