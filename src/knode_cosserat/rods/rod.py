"""A Cosserat rod with loads, boundary conditions and contact: the base of all single-rod robots.

    p  position (m)            h  orientation, quaternion, scalar first     R  its rotation matrix
    n  internal force (N)      m  internal moment (N·m), both in the global frame
    q  velocity (m/s)          w  angular velocity ω (1/s), both in the material frame
    v  rate of p along s       u  curvature (1/m), both in the material frame

as in the paper's table of notations. `tendon_robots` adds tendons.
"""

from __future__ import annotations

import functools
import math
import warnings
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.aspects import Drawing, Ends, Observed
from knode_cosserat.rods.camera import Camera
from knode_cosserat.rods.ends import AT_ORIGIN, Clamped, End, Free, Pose, velocities
from knode_cosserat.rods.law import Fields, InternalState, MaterialLaw, Viscoelastic
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.loads import Load, Motion, point_wrench, square_law_drag
from knode_cosserat.rods.parameters import Doubt, ParameterError, parameter, slot, text
from knode_cosserat.rods.parts import Contribution, Effect, RodPoint, Wrench
from knode_cosserat.rods.section import (
    ALONG,
    INWARD,
    CrossSection,
    Differences,
    FunctionSection,
    Material,
    Section,
    SectionChange,
    differences_at,
    round_section,
    shape_at_rest,
    shear_modulus,
)
from knode_cosserat.rods.shapes import Shape
from knode_cosserat.rods.surroundings import Obstacle
from knode_cosserat.rods.system import Discontinuities, Scales, System, is_traced
from knode_cosserat.rotation import cross, dot, quaternion_rate, rotation_matrix

#: layouts of a rod without further parts
Y_LAYOUT = Layout(
    ("p", 3, "m", "position, global frame"),
    ("h", 4, "1", "orientation, quaternion, scalar first"),
    ("n", 3, "N", "internal force, global frame", "h", "N/m"),
    ("m", 3, "N m", "internal moment, global frame", "h", "N"),
    ("q", 3, "m/s", "velocity, material frame"),
    ("w", 3, "rad/s", "angular velocity, material frame"),
)
Z_LAYOUT = Layout(
    ("v", 3, "1", "rate of position along the rod, material frame", "", "N"),
    ("u", 3, "1/m", "curvature, material frame", "", "N m"),
)

#: first root of cos(x) cosh(x) = -1, the frequency equation of a cantilever
FIRST_ROOT = 1.875104068711961
#: drag × length over mass per length, below which drag is weak: the damping ratio at an amplitude of a
#: tenth of the length is then below 0.2 %
WEAK_DRAG = 0.05
#: control of a part that has none
NO_CONTROL = np.zeros(0)


class SlenderRod(System):
    """A rod that is driven by its ends, loads and sections, and in contact with its surroundings.

    With controlled curvature or stiffness of its `sections` it is a variable-curvature robot. With a driven
    base and obstacles it is the soft slender robot of Xun, Zheng & Kruszewski (2024).

    All other terms of its equations are contributions of its `parts`. A subclass adds parts of its own, such
    as actuators.
    """

    kind: ClassVar[str] = "slender-rod"
    mixed: ClassVar[bool] = False
    alternatives: ClassVar[tuple[tuple[str, ...], ...]] = (
        ("radius", "density", "youngs_modulus"),
        ("cross_section",),
    )

    length: Any = parameter("m", "length of the rod", low=1e-3, high=20.0, doubt=Doubt(0.02))
    # required, unless the cross-section states them
    radius: Any = parameter("m", "radius of the rod", low=1e-6, high=0.5, default=None)
    density: Any = parameter(
        "kg/m3",
        "density of the rod, ribs spread over it included",
        low=1.0,
        high=100e3,
        default=None,
        doubt=Doubt(0.1),
    )
    youngs_modulus: Any = parameter(
        "Pa", "Young's modulus", low=1e3, high=2e12, default=None, doubt=Doubt(0.5, basic=True)
    )
    tip_radius: Any = parameter(
        "m", "radius at the tip, to which a round rod tapers linearly", low=1e-6, high=0.5, default=None
    )
    shear_modulus: Any = parameter(
        "Pa",
        "shear modulus; by default E / 2.6",
        low=1e2,
        high=1e12,
        default=None,
        doubt=Doubt(0.3, of="usual_shear_modulus"),
    )
    shear_damping: Any = parameter(
        "N s", "Bse, damping of shear and extension", shape="matrix", low=0.0, high=1e6, default=0.0
    )
    bending_damping: Any = parameter(
        "N m2 s", "Bbt, damping of bending and twisting", shape="matrix", low=0.0, high=1e4, default=0.0
    )
    shear_stiffness: Any = parameter(
        "N",
        "Kse; by default diag(GA, GA, EA)",
        shape="matrix",
        low=1e-9,
        high=1e15,
        default=None,
        doubt=Doubt(0.3, of="usual_shear_stiffness"),
    )
    bending_stiffness: Any = parameter(
        "N m2",
        "Kbt; by default diag(EI, EI, GJ)",
        shape="matrix",
        low=1e-15,
        high=1e9,
        default=None,
        doubt=Doubt(0.5, basic=True),
    )
    cross_section: CrossSection | None = slot(
        "cross-section; none: solid and round, with the radius", CrossSection, default=None
    )
    sections: tuple[SectionChange, ...] = slot(
        "sections that differ from the rod", SectionChange, many=True, default=()
    )

    drag: Any = parameter("kg/m2", "C, square-law drag", shape="matrix", low=0.0, high=1e3, default=0.0)
    linear_drag: Any = parameter(
        "kg/(m s)", "drag in proportion to velocity", shape="matrix", low=0.0, high=1e4, default=None
    )
    gravity: Any = parameter(
        "m/s2",
        "gravitational acceleration, global frame",
        shape="vector",
        low=-100.0,
        high=100.0,
        default=(0.0, 0.0, -9.81),
        doubt=Doubt(absolute=0.3),
    )
    loads: tuple[Load, ...] = slot("loads beside gravity and drag", Load, many=True, default=())
    surroundings: tuple[Obstacle, ...] = slot("obstacles that it may touch", Obstacle, many=True, default=())
    effects: tuple[Effect, ...] = slot("further physics", Effect, many=True, default=())
    base_end: End = slot("end at s = 0", End, default=Clamped())
    tip_end: End = slot("end at s = length", End, default=Free())
    camera: Camera | None = slot("frame and tip marker of measured positions", Camera, default=None)
    name: str = text("name in an assembly")

    def __check_init__(self) -> None:
        if not self.base_end.anywhere:
            raise ParameterError(f"base_end is {self.base_end.kind}; that is allowed as tip_end only")
        form = self.cross_section
        homogeneous = getattr(form, "is_homogeneous", True)
        for name, applies, other in (
            ("radius", form is None, "cross_section"),
            ("density", homogeneous, "tabulated cross_section"),
            ("youngs_modulus", homogeneous, "tabulated cross_section"),
            ("shear_modulus", homogeneous, "tabulated cross_section"),
        ):
            value = getattr(self, name)
            if applies and value is None and name != "shear_modulus":
                raise ParameterError(f"{name} is missing; required is {name}, or a {other}")
            if value is not None and not applies:
                raise ParameterError(f"{name} and a {other} are given; allowed is one of them")
        if self.tip_radius is not None and isinstance(form, CrossSection) and not form.tapers:
            raise ParameterError(
                f"tip_radius is given with a {form.kind} cross_section; allowed is a round or hollow one. "
                "Use sections with a stretch, such as {kind: stretch, radius: [1, -0.5]}"
            )
        for part in self.parts.values():
            # what is no part is refused afterwards
            if isinstance(part, Contribution):
                part.check(self)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other parameters, by name (`System.replace`).

        It warns of a modulus that changes nothing, because the robot states the stiffness.
        """
        changed = super().replace(**changes)
        moduli = [name for name in ("youngs_modulus", "shear_modulus") if changes.get(name) is not None]
        stiffness = changed.bending_stiffness
        stated = stiffness is not None and changes.get("bending_stiffness") is None
        if moduli and stated and not is_traced(changes):
            both = changed.shear_stiffness is not None
            warnings.warn(
                f"{' and '.join(moduli)} {'have' if len(moduli) > 1 else 'has'} no effect"
                f"{'' if both else ' on bending and twisting'}: the robot states its bending_stiffness"
                f"{' and shear_stiffness; set these' if both else '; set it'}",
                stacklevel=2,
            )
        return changed

    # parts

    @functools.cached_property
    def parts(self) -> dict[str, Contribution]:
        """Parts of the robot (`list_parts`)."""
        return self.list_parts()

    def list_parts(self) -> dict[str, Contribution]:
        """Return the parts by the prefix of their controls, in the order of their fields in y, z and control.

        A subclass adds its own to these.
        """
        lists: dict[str, tuple[Contribution, ...]] = {
            "section": self.sections,
            "obstacle": self.surroundings,
            "load": self.loads,
            "effect": self.effects,
        }
        present: dict[str, Contribution] = {"base": self.base_end, "tip": self.tip_end}
        if self.cross_section is not None:
            present["cross_section"] = self.cross_section
        if self.tip_radius is not None:
            present["taper"] = FunctionSection(
                function=lambda part, _: Differences(
                    1.0 + (self.tip_radius / self.section.radius - 1.0) * part
                )
            )
        return present | {f"{name}{k}": part for name, parts in lists.items() for k, part in enumerate(parts)}

    @functools.cached_property
    def y_layout(self) -> Layout:  # type: ignore[override]
        """Layout of y: that of the rod, then the parts' fields."""
        return _join_layouts(Y_LAYOUT, *(part.y_fields(self) for part in self.parts.values()))

    @functools.cached_property
    def z_layout(self) -> Layout:  # type: ignore[override]
        """Layout of z: that of the rod, then the parts' fields."""
        return _join_layouts(Z_LAYOUT, *(part.z_fields(self) for part in self.parts.values()))

    @functools.cached_property
    def base_unknowns(self) -> tuple[str, ...]:  # type: ignore[override]
        """Unknown fields of y at the base: those of its end, then of the parts."""
        others = (name for part in self.parts.values() for name in part.base_fields(self))
        return (*self.base_end.unknowns, *others)

    @functools.cached_property
    def control_layout(self) -> Layout:  # type: ignore[override]
        """Layout of the parts' controls."""
        fields = [
            (name, part.actuates, field) for name, part in self.parts.items() for field in part.control_fields
        ]
        actuators = [field.name for _, actuates, field in fields if actuates]
        return Layout(
            *(
                field
                if actuators.count(field.name) == 1 and actuates
                else field._replace(name=f"{name}_{field.name}")
                for name, actuates, field in fields
            )
        )

    @property
    def winding(self) -> float:
        """Largest angle (rad) through which a part turns along the rod."""
        return max((part.winding(self) for part in self.parts.values()), default=0.0)

    def inputs(self, control: Any) -> list[tuple[Contribution, Any]]:
        """Return the parts, each with its control."""
        inputs: list[tuple[Contribution, Any]] = []
        first = 0
        for part in self.parts.values():
            last = first + sum(field.size for field in part.control_fields)
            # an empty slice would only be traced
            inputs.append((part, control[first:last] if last > first else NO_CONTROL))
            first = last
        return inputs

    def at_parts(self, point: RodPoint) -> list[tuple[Contribution, RodPoint]]:
        """Return the parts, each with the point and its control."""
        return [(part, point._replace(input=input)) for part, input in self.inputs(point.control)]

    def section_controls(self, control: Any) -> list[Any]:
        """Return the control of each section."""
        return [input for part, input in self.inputs(control) if isinstance(part, SectionChange)]

    def end_controls(self, control: Any) -> list[Any]:
        """Return the controls of the ends."""
        return [input for part, input in self.inputs(control) if isinstance(part, End)]

    # derived quantities

    @property
    def section(self) -> Section:
        """The rod's cross-section at the base, outside `sections`."""
        return self.section_at(0.0)

    def section_at(self, part: Any) -> Section:
        """Return the cross-section at a fraction of the length, without its changes by `sections`."""
        form = self.cross_section
        return round_section(self, self.radius) if form is None else form.section(self, part)

    @functools.cached_property
    def changes(self) -> tuple[SectionChange, ...]:
        """Changes of the cross-section along the rod: `sections`, and the taper."""
        return tuple(part for part in self.parts.values() if isinstance(part, SectionChange))

    @property
    def is_uniform(self) -> bool:
        """True if section and material are the same along the rod."""
        return not self.changes and (self.cross_section is None or self.cross_section.is_uniform)

    @property
    def mass_per_length(self) -> Any:
        """ρA (kg/m) at the base."""
        return self.section.rhoA

    @property
    def G(self) -> Any:
        """Shear modulus (Pa): the parameter, or by default from Young's modulus."""
        return shear_modulus(self)

    @property
    def usual_shear_modulus(self) -> Any:
        """Shear modulus (Pa) without the parameter; None if a cross-section states stiffnesses."""
        return self.G if getattr(self.cross_section, "is_homogeneous", True) else None

    @property
    def usual_shear_stiffness(self) -> Any:
        """Stiffness of shear and extension (N) without the parameter; None if that varies with a table."""
        return self.Kse if getattr(self.cross_section, "is_homogeneous", True) else None

    def Kse_at(self, part: Any) -> Float[Any, "3 3"]:
        """Return the stiffness of shear and extension (N): the parameter, or by default the section's."""
        return self.section_at(part).Kse if self.shear_stiffness is None else self.shear_stiffness

    def Kbt_at(self, part: Any) -> Float[Any, "3 3"]:
        """Return the stiffness of bending and twisting (N·m²): the parameter, or by default the section's."""
        return self.section_at(part).Kbt if self.bending_stiffness is None else self.bending_stiffness

    @property
    def Kse(self) -> Float[Any, "3 3"]:
        """Stiffness of shear and extension (N) at the base."""
        return self.Kse_at(0.0)

    @property
    def Kbt(self) -> Float[Any, "3 3"]:
        """Stiffness of bending and twisting (N·m²) at the base."""
        return self.Kbt_at(0.0)

    @property
    def v_star(self) -> np.ndarray:
        """v of the unloaded rod: along z, unstretched."""
        return ALONG

    @property
    def u_star(self) -> np.ndarray:
        """u of the unloaded rod (1/m) outside `sections`: straight."""
        return np.zeros(3)

    def material(self, s: Any, control: Any) -> Material:
        """Return section and material at s (m) of the grid."""
        part = self._part(s, control)
        section = self.section_at(part)
        plain = Material(
            self.Kse_at(part),
            self.shear_damping,
            self.Kbt_at(part),
            self.bending_damping,
            self.u_star,
            section.rhoA,
            section.rhoJ,
            section.radius,
        )
        if not self.changes:
            return plain
        radius, stiffness, curvature, extension = self.differences(s, control)
        area = radius * radius
        return Material(
            plain.Kse * (area * stiffness),
            plain.Bse * area,
            plain.Kbt * (area * area * stiffness),
            plain.Bbt * (area * area),
            curvature,
            plain.rhoA * area,
            plain.rhoJ * (area * area),
            plain.radius * radius,
            plain.v_star * (1.0 + extension),
        )

    def differences(self, s: Any, control: Any) -> Differences:
        """Return the sections' changes at s (m) of the grid."""
        return differences_at(self.changes, self._part(s, control), self.section_controls(control))

    def material_place(self, s: Any, control: Any) -> Any:
        """Return the place (m) of the material at s of the grid: s itself unless the rod is fed."""
        for part, input in self.inputs(control):
            s = part.material_place(self, s, input)
        return s

    def _part(self, s: Any, control: Any) -> Any:
        """Return the place of the material as a fraction of the length; before the base it is as there."""
        place = self.material_place(s, control)
        return place / self.length if place is s else jnp.maximum(place, 0.0) / self.length

    # the law of the strains

    def stresses(self, y: Float[Any, " y"]) -> tuple[Float[Any, "3"], Float[Any, "3"]]:
        """Return Rᵀn (N) and Rᵀm (N·m)."""
        R = rotation_matrix(self.y_layout.get(y, "h"))
        return dot(R.T, self.y_layout.get(y, "n")), dot(R.T, self.y_layout.get(y, "m"))

    @property
    def is_undamped(self) -> bool:
        """True if no parameter, part or internal variable damps a motion; weak drag does not count."""
        values = (self.bending_damping, self.shear_damping, self.linear_drag)
        damped = any(value is not None and np.any(np.asarray(value)) for value in values)
        parts = self.parts.values()
        if damped or any(part.damps or part.z_fields(self) for part in parts):
            return False
        drag = np.max(np.asarray(self.drag)) * np.max(self.length)
        return bool(drag < WEAK_DRAG * np.min(self.mass_per_length))

    @property
    def bending_frequency(self) -> Any:
        """First bending frequency (Hz) of the bare uniform rod, clamped at the base, by beam theory."""
        EI = np.linalg.eigvalsh(np.asarray(self.Kbt)[..., :2, :2])[..., 0]
        mass = self.mass_per_length * self.length
        return FIRST_ROOT**2 / (2 * np.pi) * np.sqrt(EI / (mass * self.length**3))

    # the equations

    def linear_law(self, s: Any, y: Float[Any, " y"], control: Any) -> MaterialLaw:
        """Return the linear law of v and u (paper eq. 12, constitutive law of the rod).

        K (z - z*) + B z_t = Rᵀ (n, m), for each of shear and extension, bending and twisting.
        """
        material = self.material(s, control)
        n, m = self.stresses(y)
        bent = m if not self.sections else m + dot(material.Kbt, material.u_star)
        v = Viscoelastic(material.Kse, material.Bse, n + material.Kse @ material.v_star)
        return MaterialLaw({"v": v, "u": Viscoelastic(material.Kbt, material.Bbt, bent)})

    def absolute(self, point: RodPoint, motion: Motion) -> RodPoint:
        """Return a point with the material's motion in the global frame, from the states' motion."""
        for part in self.parts.values():
            motion = part.absolute(point, motion)
        return point._replace(motion=motion)

    def seen(self, t: Any, vector: Float[Any, "3"]) -> Float[Any, "3"]:
        """Return a vector of the global frame in the frame of the states."""
        for part in reversed(self.parts.values()):
            vector = part.seen(t, vector)
        return vector

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """Return the law of v and u, linear but for the parts, and of internal variables."""
        point = RodPoint(self, s, t, y, y_t, control, material=self.material(s, control))
        parts = self.at_parts(self.absolute(point, Motion.of(self.y_layout, y, y_t)))
        evolutions = {name: law for part, point in parts for name, law in part.evolutions(point).items()}

        def law(internal: Fields) -> MaterialLaw:
            total = self.linear_law(s, y, control)
            for part, point in parts:
                total = part.law(point, total, internal)
                if not isinstance(total, MaterialLaw):
                    raise TypeError(
                        f"{type(part).__name__}.law returns a {type(total).__name__}; allowed is the law with"
                        " the part, such as law.with_strain(name, strain)"
                    )
            return total

        return InternalState(evolutions, law) if evolutions else law({})

    def balance(self, s, t, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """Return y_s (paper eq. 10, spatial derivatives of the rod)."""
        h, n = self.y_layout.get(y, "h"), self.y_layout.get(y, "n")
        relative, material = Motion.of(self.y_layout, y, y_t), self.material(s, control)
        point = RodPoint(self, s, t, y, y_t, control, None, material, z, z_t)
        point = self.absolute(point, relative)
        R, (_, _, q, w, q_t, w_t) = relative.R, point.motion
        v, u = self.z_layout.get(z, "v"), self.z_layout.get(z, "u")
        v_t, u_t = self.z_layout.get(z_t, "v"), self.z_layout.get(z_t, "u")
        rhoA, rhoJ = material.rhoA, material.rhoJ
        dragged = square_law_drag(self.drag, q)
        if self.linear_drag is not None:
            dragged = dragged + dot(self.linear_drag, q)

        p_s = dot(R, v)
        n_s = dot(R, rhoA * (cross(w, q) + q_t) + dragged) - rhoA * self.seen(t, self.gravity)
        m_s = dot(R, cross(w, dot(rhoJ, w)) + dot(rhoJ, w_t)) - cross(p_s, n)
        rates: Fields = {
            "p": p_s,
            "h": quaternion_rate(h, u),
            "n": n_s,
            "m": m_s,
            "q": v_t - cross(u, relative.q) + cross(relative.w, v),
            "w": u_t - cross(u, relative.w),
        }
        parts = self.at_parts(point)
        for part, at in parts:
            load = part.load(at)
            if load is not None:
                rates["n"] = rates["n"] - self.seen(t, load.force)
                rates["m"] = rates["m"] - self.seen(t, load.moment)
            for name, rate in part.rates(at).items():
                rates[name] = rates[name] + rate if name in rates else rate
        y_s = jnp.concatenate(_order_fields(rates, self.y_layout, 0))
        return y_s * math.prod(part.arclength_rate(at) for part, at in parts)

    # discontinuities: places where something begins, ends or pulls

    @functools.cached_property
    def _places(self) -> tuple[float, ...]:
        """Places before the tip where parts begin or end, or loads act."""
        return tuple(sorted({cut for part in self.parts.values() for cut in part.cuts if cut < 1.0}))

    @property
    def discontinuities(self) -> Discontinuities:  # type: ignore[override]
        """Places before the tip where parts begin or end, or loads act; n and m jump by point loads."""
        jumps = any(part.applied_at in self._places for part in self.parts.values())
        return Discontinuities(self._places, self._jump if jumps else None)

    def _jump(
        self, acting: Float[Any, " cuts"], t: Any, y: Float[Any, " y"], y_t: Float[Any, " y"], control: Any
    ) -> Float[Any, " y"]:
        """Return y on the far side of the acting cuts: n and m less the point loads there."""
        point = RodPoint(self, None, t, y, y_t, control)
        wrench = self._point_wrench(dict(zip(self._places, acting, strict=True)), point)
        change = jnp.concatenate([np.zeros(7), wrench.force, wrench.moment])
        return y - jnp.concatenate([change, np.zeros(self.y_layout.size - 13)])

    def _point_wrench(self, weights: Any, point: RodPoint) -> Wrench:
        """Return the sum of the point loads, each times the weight of its place."""
        motion = self.absolute(point, Motion.of(self.y_layout, point.y, point.y_t)).motion
        acting = [
            (part, weights[part.applied_at], input)
            for part, input in self.inputs(point.control)
            if part.applied_at in weights
        ]
        return Wrench(*(self.seen(point.t, each) for each in point_wrench(acting, motion, self.gravity)))

    # the two ends, and rest

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return y and z of the unloaded rod at rest: straight, or with the sections' curvature."""
        s = jnp.asarray(s, dtype=float)
        still, _ = self.end_controls(np.zeros(self.control_layout.size))
        (p, h), v, u = self._rest_shape(self.base_end.pose(AT_ORIGIN, still), s)
        more: Fields = {}
        for part in self.parts.values():
            more |= part.rest_y(self, s)
        y = jnp.concatenate([p, h, np.zeros(12), *_order_fields(more, self.y_layout)])
        return y, self.with_internal(jnp.concatenate([v, u]))

    def with_internal(self, strains: Float[Any, "6"]) -> Float[Any, " z"]:
        """Return z with these strains without stress, and the internal variables of the parts at rest."""
        z: Fields = {}
        for part in self.parts.values():
            z |= part.rest_z(self, strains)
        return jnp.concatenate([strains, *_order_fields(z, self.z_layout, 2)])

    def _rest_shape(self, base: Pose, s: Any) -> tuple[Any, Any, Any]:
        if not self.sections:
            along = dot(rotation_matrix(base.h), jnp.stack([jnp.zeros(()), jnp.zeros(()), s]))
            return Pose(base.p + along, base.h), self.v_star, self.u_star
        ends = {place for section in self.sections for place in (section.begin, section.end)}
        edges = np.array(sorted({0.0, *ends, 1.0}))
        # z at a node is the far-side value, and where two sections meet both curvatures act; the margin is
        # less than the distance that moves places away from that side
        margin = 0.2 * INWARD * self.length / (self.nodes - 1)
        beyond = jnp.minimum(s + margin, self.length - margin)
        shape = shape_at_rest(base, s, self.strains_at_rest, self.length, edges)
        return shape, *self.strains_at_rest(beyond)

    def strains_at_rest(self, s: Any) -> tuple[Float[Any, "3"], Float[Any, "3"]]:
        """Return v and u without stress at s (m), without control."""
        material = self.material(s, np.zeros(self.control_layout.size))
        return material.v_star, material.u_star

    def base(self, t: Any, control: Any, unknowns: Float[Any, " k"]) -> Float[Any, " y"]:
        """Return y at s = 0: the pose of the base's end, with the unknowns."""
        own = self.end_controls(control)[0]
        held = self.base_end.pose(AT_ORIGIN, own)
        twist = self.base_end.twist(held, own)
        y = jnp.concatenate([held.p, held.h, np.zeros(6), twist, np.zeros(self.y_layout.size - 19)])
        y = self.y_layout.replaced(y, self.base_unknowns, unknowns)
        place = self.material_place(0.0, control)
        for part in () if isinstance(place, float) else self.parts.values():
            # lengths and volumes of the material before the base
            for name, value in part.rest_y(self, place).items():
                y = self.y_layout.replaced(y, (name,), value)
        for part, point in self.at_parts(RodPoint(self, 0.0, t, y, None, control)):
            for name, value in part.base_y(point).items():
                y = self.y_layout.replaced(y, (name,), value)
        return y

    def pose(self, y: Any) -> Pose:
        """Return the pose in a packed y."""
        return Pose(self.y_layout.get(y, "p"), self.y_layout.get(y, "h"))

    def tip_wrench(self, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Wrench:
        """Return n and m at the tip less the loads there: the wrench of the support on the rod."""
        n, m = self.y_layout.get(y, "n"), self.y_layout.get(y, "m")
        if any(part.applied_at == 1.0 for part in self.parts.values()):
            loaded = self._point_wrench({1.0: 1.0}, RodPoint(self, self.length, t, y, y_t, control))
            n, m = n - loaded.force, m - loaded.moment
        return Wrench(n, m)

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the residual of the tip's conditions with the loads there, and of the quaternion's norm."""
        n, m = self.tip_wrench(t, control, y, y_t)
        if type(self.tip_end) is Free:
            rows = [-n, -m]
        else:
            rest = self.pose(self.rest(self.length)[0])
            held = self.tip_end.pose(rest, self.end_controls(control)[1])
            rows = [self.tip_end.residual(held, self.pose(y), n, m)]
        if "h" in self.base_unknowns:
            h = self.y_layout.get(y, "h")
            rows.append(jnp.sum(h * h)[None] - 1.0)
        here = RodPoint(self, self.length, t, y, y_t, control)
        point = self.absolute(here, Motion.of(self.y_layout, y, y_t))
        others = (part.tip_rows(at) for part, at in self.at_parts(point))
        return jnp.concatenate([*rows, *(row for row in others if row is not None)])

    def scales(self) -> Scales:
        """Return the scales of a beam: length L, force EI/L², moment EI/L, time L² √(ρA/EI)."""
        L, EI = self.length, jnp.minimum(self.Kbt[0, 0], self.Kbt[1, 1])
        T = L * L * jnp.sqrt(self.mass_per_length / EI)
        sizes: Fields = {"p": L, "n": EI / (L * L), "m": EI / L, "q": L / T, "w": 1.0 / T}
        for part in self.parts.values():
            sizes |= part.scales(self, sizes)

        def of(layout: Layout) -> Any:
            return jnp.concatenate([jnp.full(f.size, sizes.get(f.name, 1.0)) for f in layout.fields])

        return Scales(of(self.y_layout), of(Ends.of(self).layout))


class RodEnds(Ends, of=SlenderRod):
    """Ends of a rod, and the conditions of its parts."""

    system: SlenderRod

    @property
    def held(self) -> bool:
        """True if an end is constrained, or there is an obstacle on which the rod may lie."""
        return any(part.held for part in self.system.parts.values())

    @property
    def rest_is_guess(self) -> bool:
        """True if the tip is constrained: the unloaded rod need not meet that constraint."""
        return self.system.tip_end.held

    @property
    def layout(self) -> Layout:
        """Layout of the tip's conditions: force and moment, or the constrained pose; then the parts'."""
        rod = self.system
        norm = ("norm", 1, "1", "square of the length of the quaternion, less one")
        fields = [*rod.tip_end.conditions, *((norm,) if "h" in rod.base_unknowns else ())]
        return Layout(*fields, *(field for part in rod.parts.values() for field in part.tip_fields(rod)))

    def poses(self, control: Any) -> tuple[Pose | None, Pose | None]:
        """Return the clamped poses of the two ends under a control; None for an end that is not clamped."""
        rod = self.system
        ends = (rod.base_end, AT_ORIGIN), (rod.tip_end, rod.pose(rod.rest(rod.length)[0]))
        base, tip = (
            end.pose(rest, input) if isinstance(end, Clamped) else None
            for (end, rest), input in zip(ends, rod.end_controls(control), strict=True)
        )
        return base, tip

    def placed(self, y: Any, control: Any) -> Any:
        """Return the unloaded shape on a body that carries a rod with a free tip."""
        rod = self.system
        if rod.base_end.by_rates or not rod.base_end.control_fields or rod.tip_end.held:
            return y
        still, own = (rod.end_controls(each)[0] for each in (np.zeros(np.shape(control)), control))
        moved = rod.base_end.pose(AT_ORIGIN, own).then(rod.base_end.pose(AT_ORIGIN, still).inverse())
        poses = jax.vmap(lambda each: jnp.concatenate(moved.then(rod.pose(each))))(jnp.asarray(y))
        return np.concatenate([poses, y[:, 7:]], axis=1)

    def moving_base(self, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " y"]:
        """Return y at s = 0 with the velocities of the base's pose, unless its end states them."""
        rod = self.system
        if rod.base_end.by_rates or rod.base_end.body:
            q, w = velocities(rod.pose(y), rod.pose(y_t))
            y = jnp.concatenate([y[:13], q, w, y[19:]])
        point = RodPoint(rod, 0.0, None, y, y_t)
        for part in rod.parts.values():
            for name, value in part.base_rates(point).items():
                y = rod.y_layout.replaced(y, (name,), value)
        return y


class RodDrawing(Drawing, of=SlenderRod):
    """The rod, and the shapes of its parts."""

    system: SlenderRod

    def parts(self, at: Any, control: Any) -> list[Shape]:
        """Return the shapes of rod and parts; tubes replace the rod."""
        rod, control = self.system, np.asarray(control, dtype=float)
        inputs = rod.inputs(control.T)
        shapes = [
            shape
            for part, input in inputs
            for shape in part.shapes(rod, at, np.asarray(input).T.reshape(len(control), -1))
        ]
        if any(shape.kind == "tube" for shape in shapes):
            return shapes
        return [Shape("rod", "rod", at, np.zeros((len(at), 3)), self._radii(at)), *shapes]

    def _radii(self, at: Any) -> Any:
        rod = self.system
        if rod.is_uniform:
            return np.full(len(at), float(rod.section.radius))
        none = np.zeros(rod.control_layout.size)
        return np.asarray(jax.vmap(lambda s: rod.material(s, none).radius + 0.0 * s)(at * rod.length))


class RodObserved(Observed, of=SlenderRod):
    """Motion and bending of a rod, in the material frame, and the controls of its parts."""

    system: SlenderRod
    velocities: ClassVar[tuple[str, ...]] = ("q", "w", "u_t")

    @property
    def layout(self) -> Layout:
        """Layout of `observables`."""
        return Layout(
            ("acceleration", 3, "m/s2", "acceleration of the centreline"),
            ("spin", 3, "1/s2", "rate of the angular momentum over ρI"),
            ("q", 3, "m/s", "velocity"),
            ("w", 3, "rad/s", "angular velocity"),
            ("u", 3, "1/m", "curvature"),
            ("u_t", 3, "1/(m s)", "rate of the curvature"),
        )

    def observables(self, point: RodPoint) -> Float[Any, " o"]:
        """Return acceleration, spin, q, w, curvature and its rate; see `layout`."""
        _, s, _, y, y_t, control, *_ = point
        layout, strains = self.system.y_layout, self.system.z_layout
        (q, w), (q_t, w_t) = ([layout.get(state, name) for name in ("q", "w")] for state in (y, y_t))
        material = self.system.material(s, control)
        J = material.rhoJ / material.rhoJ[0, 0]
        acceleration, spin = cross(w, q) + q_t, cross(w, dot(J, w)) + dot(J, w_t)
        bent = strains.get(point.z, "u") - material.u_star
        return jnp.concatenate([acceleration, spin, q, w, bent, strains.get(point.z_t, "u")])

    def load_factor(self, s: Any, control: Any) -> Any:
        """Return the rate of arclength along the grid."""
        parts = self.system.at_parts(RodPoint(self.system, s, None, None, None, control))
        return math.prod(part.arclength_rate(point) for part, point in parts)

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """Return the controls of the parts in the form in which they enter the equations."""
        rod = self.system
        return jnp.concatenate([part.actuation(rod, input) for part, input in rod.inputs(control)])

    @property
    def has_actuation(self) -> bool:
        """True if a part has another form of its control."""
        plain = Contribution.actuation
        return any(type(part).actuation is not plain for part in self.system.parts.values())

    def unstressed(self, s: Any, control: Any) -> Float[Any, " z"]:
        """Return z of the unstressed rod at s: with the sections' curvature, intrinsic and controlled."""
        rod = self.system
        strains = rod.material(s, control) if rod.sections else rod
        return rod.with_internal(jnp.concatenate([strains.v_star, strains.u_star]))

    def law_factors(self, s: Any, control: Any) -> tuple[Any, Any] | None:
        """Return stiffness and damping relative to the base's; None for a uniform rod."""
        rod = self.system
        if rod.is_uniform:
            return None
        material, radius = rod.material(s, control), rod.differences(s, control).radius
        area = radius * radius
        stiffness = [
            jnp.sum(K * np.eye(3), axis=1) / jnp.sum(base * np.eye(3), axis=1)
            for K, base in ((material.Kse, rod.Kse), (material.Kbt, rod.Kbt))
        ]
        others = jnp.ones(rod.z_layout.size - 6)
        damping = [jnp.full(3, 1.0) * area, jnp.full(3, 1.0) * area * area]
        return jnp.concatenate([*stiffness, others]), jnp.concatenate([*damping, others])


def _join_layouts(layout: Layout, *parts: tuple[Any, ...]) -> Layout:
    """Return a layout with the fields of the parts. Raises `ParameterError` if two have the same name."""
    joined = Layout(*layout.fields, *(field for fields in parts for field in fields))
    for name in joined.names:
        if joined.names.count(name) > 1:
            raise ParameterError(f"two parts have a field {name!r}; allowed is one part of its kind")
    return joined


def _order_fields(values: Fields, layout: Layout, first: int = 6) -> list[Any]:
    """Return the values of a layout's fields from the `first` on, zero without one; `KeyError` for others."""
    for name in values:
        layout.slice(name)
    return [values.get(field.name, np.zeros(field.size)) for field in layout.fields[first:]]
