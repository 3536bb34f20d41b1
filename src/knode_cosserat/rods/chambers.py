"""Pressure chambers along a rod, and the hyperelastic axial law of the soft materials they are made in.

A fluid at the gauge pressure p does the work p dV on the walls of its chamber. With the chamber's centres at
r(s), its stretch λ = |ṗ|, ṗ = v + u × r + r′, and its area A, it has the volume A λ per length of rod. n and
m include rod and fluid. The law of the strains is then that of a tendon that pushes (`tendon_law`), with

    T = -∂/∂λ ∫ A λ dp,      A = A₀ (1 + α (λ/λ* - 1) + β p),      λ* the stretch of the unloaded rod

For a constant area T = -p A₀: a straight chamber lengthens the rod by p A₀/EA, bends it by p A₀ r/EI, and a
helix twists it. End plates need no force of their own: n and m do not jump there.

Supply. The control is the pressure, or the volume V_c that a pump delivers. A liquid fills the chamber and
the line, which takes up C p. A gas was enclosed at the atmosphere's pressure p_a with a dead volume D, and
keeps p V (Boyle):

    V - V₀ + C p = V_c,        (p_a + p) (D + V - V_c) = p_a (D + V₀)

Source: the virtual work of pressure, e.g. Renda et al. (2020), "A geometric variable-strain approach for
static modeling of soft manipulators with tendon and fluidic actuation".
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.law import Fields, MaterialLaw
from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.parameters import Doubt, ParameterError, as_number, choice, known_size, parameter
from knode_cosserat.rods.parts import Effect, RodPoint, Stretched
from knode_cosserat.rods.routing import OffsetPaths, path_lengths
from knode_cosserat.rods.shapes import Shape, nodes_between
from knode_cosserat.rods.tendon_law import Stretching, Tendons, stretches

#: standard pressure of the atmosphere (Pa)
ATMOSPHERE = 101325.0


class Chambers(Stretched, Effect):
    """Chambers alike around the axis, from `begin` to `end`, each with a control."""

    kind: ClassVar[str] = "chambers"
    actuates: ClassVar[bool] = True

    angles: Any = parameter(
        "rad",
        "angles of the chambers about the rod",
        shape="list",
        low=-10.0,
        high=10.0,
        doubt=Doubt(absolute=0.05),
    )
    offset: Any = parameter(
        "m", "distance of their centres from the rod's axis", low=0.0, high=1.0, doubt=Doubt(0.1)
    )
    radius: Any = parameter(
        "m", "radius of round chambers", low=1e-6, high=1.0, default=None, doubt=Doubt(0.1)
    )
    area: Any = parameter(
        "m2", "A₀, area of chambers of another shape", low=1e-12, high=1.0, default=None, doubt=Doubt(0.2)
    )
    area_factors: Any = parameter(
        "",
        "area of each chamber over A₀; by default they are alike",
        shape="list",
        low=1e-3,
        high=1e3,
        default=None,
        doubt=Doubt(absolute=0.05, of="alike", common=False),
    )
    offset_factors: Any = parameter(
        "",
        "distance of each from the axis over the offset; by default they are alike",
        shape="list",
        low=1e-3,
        high=1e3,
        default=None,
        doubt=Doubt(absolute=0.05, of="alike", common=False),
    )
    twist: Any = parameter(
        "rad",
        "angle by which they turn about the rod from base to tip; by default they are straight",
        low=-1e3,
        high=1e3,
        default=None,
    )
    area_by_stretch: Any = parameter(
        "",
        "α, relative change of the area by the stretch",
        low=-10.0,
        high=10.0,
        default=None,
        doubt=Doubt(absolute=1.0, of="no_change"),
    )
    area_by_pressure: Any = parameter(
        "1/Pa",
        "β, relative change of the area by the pressure",
        low=0.0,
        high=1e-2,
        default=0.0,
        doubt=Doubt(absolute=3e-6, begin=0.1),
    )
    drive: str = choice(
        "control: pressure (Pa), or volume that a pump delivers (m3), of a liquid or of a gas",
        ("pressure", "liquid", "gas"),
        "pressure",
    )
    lowest: Any = parameter("Pa", "lowest pressure that a control may have", low=-1e9, high=0.0, default=None)
    highest: Any = parameter(
        "Pa", "highest pressure that a control may have", low=0.0, high=1e9, default=None
    )
    compliance: Any = parameter(
        "m3/Pa", "C, of the line of a liquid", low=0.0, high=1.0, default=0.0, doubt=Doubt(0.5)
    )
    dead_volume: Any = parameter(
        "m3", "D, of pump and line of a gas", low=0.0, high=1.0, default=0.0, doubt=Doubt(0.3)
    )
    atmosphere: Any = parameter(
        "Pa", "p_a, at which a gas was enclosed", low=1e3, high=1e9, default=ATMOSPHERE
    )

    def __check_init__(self) -> None:
        super().__check_init__()
        if (self.radius is None) == (self.area is None):
            raise ParameterError("Chambers: allowed is either radius, of round chambers, or area")
        values = (self.angles, self.offset, self.radius)
        for name in ("area_factors", "offset_factors"):
            given = np.shape(getattr(self, name))
            if given and given[-1] != self.count:
                raise ParameterError(
                    f"Chambers: {name} has {given[-1]} numbers; allowed is one for each of "
                    f"{self.count} angles"
                )
        if self.radius is None or any(isinstance(one, jax.core.Tracer) or np.ndim(one) > 1 for one in values):
            return
        angles = np.sort(np.mod(self.angles, 2.0 * np.pi))
        if len(angles) > 1:
            nearest = np.min(np.diff([*angles, angles[0] + 2.0 * np.pi]))
            if 2.0 * self.radius > (gap := 2.0 * self.offset * np.sin(min(nearest, np.pi) / 2.0)):
                raise ParameterError(
                    f"Chambers overlap: radius is {self.radius:g} m, and centres are {gap:.3g} m apart; "
                    f"allowed is up to {gap / 2.0:.3g} m, or the area of chambers of another shape"
                )

    def winding(self, rod: Any) -> float:
        """Return the angle by which they turn about the rod."""
        return known_size(self.twist)

    @property
    def count(self) -> int:
        """Number of chambers."""
        return int(np.shape(self.angles)[-1])

    @property
    def no_change(self) -> float:
        """Change of an area that stays."""
        return 0.0

    @property
    def alike(self) -> Float[Any, " c"]:
        """One for each chamber."""
        return np.ones(self.count)

    @property
    def rest_area(self) -> Any:
        """A₀ (m²), of each chamber if they are not alike."""
        area = np.pi * self.radius**2 if self.area is None else self.area
        return area if self.area_factors is None else area * self.area_factors

    @property
    def offsets(self) -> Any:
        """Distance (m) from the axis, of each chamber if they are not alike."""
        return self.offset if self.offset_factors is None else self.offset * self.offset_factors

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """One pressure or volume for each chamber."""
        if self.drive != "pressure":
            return (Field("volume", self.count, "m3", f"volume of {self.drive} that the pump delivers"),)
        low, high = as_number(self.lowest), as_number(self.highest)
        limits = (-np.inf if low is None else low, np.inf if high is None else high)
        meaning = "gauge pressure of the chamber"
        return (Field("pressure", self.count, "Pa", meaning, low=limits[0], high=limits[1]),)

    def usual_control(self, rod: Any, field: Field) -> float:
        """Return the pressure by which one chamber bends the rod by a radian, or a fifth of its volume."""
        if self.drive != "pressure":
            return float(0.2 * np.mean(self.rest_area) * rod.length)
        lever, area = max(float(self.offset), 1e-6), float(np.mean(self.rest_area))
        return min(float(rod.Kbt[0, 0] / (rod.length * area * lever)), field.high)

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return a line of each chamber's radius along its centres, coloured by its control."""
        at, paths, (field,) = nodes_between(at, self.begin, self.end), self.paths(rod), self.control_fields
        centres = np.stack([np.asarray(paths.routes(s * rod.length)[0]) for s in at], axis=1)
        radii = np.sqrt(np.broadcast_to(self.rest_area, self.count) / np.pi)
        return tuple(
            Shape(
                "chamber", f"chamber {k + 1}", at, centres[k], radii[k], value=control[:, k], unit=field.unit
            )
            for k in range(self.count)
        )  # fmt: skip

    def _name(self, rod: Any, field: str) -> str:
        """Return the name of one of the part's fields, which other chambers of the rod may have too."""
        return next(f"{name}_{field}" for name, part in rod.parts.items() if part is self)

    def paths(self, rod: Any) -> OffsetPaths:
        """Return the paths of the chambers' centres."""
        return OffsetPaths(self.offsets, self.angles, self.twist, rod.length)

    def pressure(self, point: RodPoint) -> Float[Any, " c"]:
        """Return p (Pa)."""
        return point.input if self.drive == "pressure" else point.get(self._name(point.rod, "pressure"))

    def _area_changes(self, point: RodPoint, r: Any, r_s: Any) -> tuple[Any, Any]:
        """Return α and α/λ*."""
        if self.area_by_stretch is None:
            return 0.0, 0.0
        strains = point.material.v_star, point.material.u_star
        rest = stretches(*map(jnp.asarray, (*strains, r, r_s)))
        return self.area_by_stretch, self.area_by_stretch / rest

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law with the chambers' push."""
        r, r_s = self.paths(point.rod).routes(point.material_place)
        p, (by_stretch, slope) = self.pressure(point), self._area_changes(point, r, r_s)
        pushed = self.indicator(point) * self.rest_area * p
        tension = -pushed * (1.0 - by_stretch + 0.5 * self.area_by_pressure * p)
        stretching = None
        if self.area_by_stretch is not None:
            nothing = jnp.zeros_like(pushed)
            stretching = Stretching(-2.0 * slope * pushed, nothing, nothing, nothing)
        return law._replace(coupling=Tendons(r, r_s, tension, tension, stretching).joined(law.coupling))

    def actuation(self, rod: Any, control: Any) -> Any:
        """Return Σ pᵢ A₀ (N) and Σ pᵢ A₀ rᵢ × d₃ (N·m, two) of straight chambers; otherwise the control."""
        if self.twist is not None or self.drive != "pressure":
            return control
        x, y = jnp.cos(self.angles), jnp.sin(self.angles)
        force = self.rest_area * control
        moment = jnp.stack([jnp.sum(self.offsets * force * y), -jnp.sum(self.offsets * force * x)])
        return jnp.concatenate([jnp.sum(force)[None], moment])

    # a pump's volume: the pressure is unknown, and the chambers' volume is summed up along the rod

    def y_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return pressure and volume, unless the pressure is the control."""
        if self.drive == "pressure":
            return ()
        return (
            (self._name(rod, "pressure"), self.count, "Pa", "gauge pressure of the chamber"),
            (self._name(rod, "volume"), self.count, "m3", "volume of the chamber up to here"),
        )

    def base_fields(self, rod: Any) -> tuple[str, ...]:
        """Return the pressure's name."""
        return () if self.drive == "pressure" else (self._name(rod, "pressure"),)

    def tip_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return the balance of volume."""
        if self.drive == "pressure":
            return ()
        return ((self._name(rod, "supply"), self.count, "m3", "volume of the fluid less that of the supply"),)

    def scales(self, rod: Any, sizes: Fields) -> Fields:
        """Return the rod's force over the area for a pressure, and area times length for a volume."""
        volume = self.rest_area * sizes["p"]
        return {
            self._name(rod, "pressure"): sizes["n"] / self.rest_area,
            self._name(rod, "volume"): volume,
            self._name(rod, "supply"): volume,
        }

    def rest_y(self, rod: Any, s: Any) -> Fields:
        """Return the volume in the unloaded robot from the base to s."""
        return {} if self.drive == "pressure" else {self._name(rod, "volume"): self._rest_volume(rod, s)}

    def _rest_volume(self, rod: Any, s: Any) -> Float[Any, " c"]:
        def path(at: Any) -> Float[Any, " c"]:
            return path_lengths(self.paths(rod).routings, at, rod.length, rod.strains_at_rest)

        begin, end = self.begin * rod.length, self.end * rod.length
        # what begins at the base continues before it, in a rod that is fed
        s = jnp.clip(s, begin, end) if self.begin else jnp.minimum(s, end)
        return self.rest_area * (path(s) - path(begin))

    def rates(self, point: RodPoint) -> Fields:
        """Return the rate of the volume."""
        if self.drive == "pressure":
            return {}
        r, r_s = map(jnp.asarray, self.paths(point.rod).routes(point.material_place))
        stretch = stretches(point.get("v"), point.get("u"), r, r_s)
        by_stretch, slope = self._area_changes(point, r, r_s)
        area = 1.0 - by_stretch + slope * stretch + self.area_by_pressure * self.pressure(point)
        return {self._name(point.rod, "volume"): self.indicator(point) * self.rest_area * area * stretch}

    def tip_rows(self, point: RodPoint) -> Any:
        """Return the residual of the balance of volume."""
        if self.drive == "pressure":
            return None
        volume, p = point.get(self._name(point.rod, "volume")), self.pressure(point)
        rest = self._rest_volume(point.rod, point.rod.length)
        if self.drive == "liquid":
            return volume - rest - point.input + self.compliance * p
        held = self.dead_volume + rest
        return (1.0 + p / self.atmosphere) * (self.dead_volume + volume - point.input) - held


class Hyperelastic(Effect):
    """Hyperelastic axial law of an incompressible material: neo-Hookean, or Yeoh's.

    The axial force of the stretch λ is EA (λ - λ⁻²)/3 (1 + 2 c₂ J + 3 c₃ J²) with J = λ² + 2/λ - 3, and the
    ratios c₂ and c₃ of Yeoh's constants C₂ and C₃ to C₁ = E/6 (Yeoh 1993). Bending and twisting stay linear.
    """

    kind: ClassVar[str] = "hyperelastic"

    second: Any = parameter(
        "",
        "c₂, C₂ over C₁ of Yeoh's law; 0 is neo-Hookean",
        low=0.0,
        high=1e3,
        default=0.0,
        doubt=Doubt(absolute=0.3),
    )
    third: Any = parameter("", "c₃, C₃ over C₁ of Yeoh's law", low=0.0, high=1e3, default=0.0)
    share: Any = parameter(
        "", "part of the difference from linear elasticity; 0 is linear", low=0.0, high=10.0, default=1.0
    )

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law with the difference from linear elasticity, along the axis."""
        one, axis = jnp.ones(1), np.zeros((1, 3))
        EA = self.share * law.strains["v"].stiffness[2, 2]
        excess = Stretching(0.0 * one, EA * one, self.second * one, self.third * one)
        return law._replace(coupling=Tendons(axis, axis, 0.0 * one, 0.0 * one, excess).joined(law.coupling))
