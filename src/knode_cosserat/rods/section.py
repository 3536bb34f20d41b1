"""Cross-sections, with their stiffness and inertia, and their changes along a rod.

Kse = diag(GA, GA, EA), and Kbt has E times the second moments of area about two axes and G times the torsion
constant J. J is the polar moment for round sections only (Saint-Venant 1855). The inertia has ρ times the
second moments, about the rod's axis their sum.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.ends import Pose
from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.parameters import ParameterError, as_number, choice, known_size, parameter, places
from knode_cosserat.rods.parts import Part, Stretched
from knode_cosserat.rods.shapes import Shape, nodes_between
from knode_cosserat.rods.system import is_traced
from knode_cosserat.rotation import cross, mean_turned, quaternion_of, quaternion_product, rotate

#: d₃: along the rod
ALONG = np.array([0.0, 0.0, 1.0])
#: diagonal matrices of the axes across and along the rod
ACROSS, AXIAL = np.diag([1.0, 1.0, 0.0]), np.diag(ALONG)
#: matrices of bending about x, about y, and of their coupling
ABOUT_X, ABOUT_Y = np.diag([1.0, 0.0, 0.0]), np.diag([0.0, 1.0, 0.0])
COUPLED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
#: equal steps for integrating the shape of a rod that is curved at rest; section edges split them further
REST_STEPS = 50
#: points are moved into an interval by this fraction of it, so that one-sided values are used at its ends
INWARD = 1e-9
#: the paper's G = E / (2 (1 + 0.3)), for a robot without a shear modulus
POISSON_RATIO = 0.3
#: sum of 1/n⁵ over odd n, with ζ(5)
ODD_FIFTH_POWERS = 31.0 / 32.0 * 1.0369277551433699


def _angle() -> Any:
    """Return a field for the direction of principal axes."""
    return parameter("rad", "angle about the rod from x to its x axis", low=-10.0, high=10.0, default=0.0)


def _table_field(unit: str, meaning: str, low: float, high: float, default: Any = dataclasses.MISSING) -> Any:
    """Return a field for values along the rod."""
    return parameter(unit, meaning, shape="list", low=low, high=high, default=default)


class Section(NamedTuple):
    """Stiffness and inertia of a cross-section at one place."""

    #: stiffness of shear, and of extension (N)
    GA: Any
    EA: Any
    #: bending stiffness about x and y, and their coupling (N·m²)
    EI: tuple[Any, Any, Any]
    #: torsional stiffness (N·m²)
    GJ: Any
    #: mass per length (kg/m)
    rhoA: Any
    #: inertia per length about x and y, and their coupling (kg·m)
    rhoI: tuple[Any, Any, Any]
    #: radius of the circle around it (m)
    radius: Any

    @property
    def Kse(self) -> Float[Any, "3 3"]:
        """Kse = diag(GA, GA, EA): shear and extension (N)."""
        return self.GA * ACROSS + self.EA * AXIAL

    @property
    def Kbt(self) -> Float[Any, "3 3"]:
        """Kbt: bending about two axes and twisting, diag(EI, EI, GJ) for a round section (N·m²)."""
        return _tensor(self.EI, self.GJ)

    @property
    def rhoJ(self) -> Float[Any, "3 3"]:
        """Inertia per length about the material axes (kg·m)."""
        return _tensor(self.rhoI, self.rhoI[0] + self.rhoI[1])


def _tensor(across: tuple[Any, Any, Any], axial: Any) -> Float[Any, "3 3"]:
    """Return a symmetric matrix from its entries xx, yy, xy and zz; the rod is along a principal axis."""
    xx, yy, xy = across
    return xx * ABOUT_X + yy * ABOUT_Y + xy * COUPLED + axial * AXIAL


def homogeneous(rod: Any, area: Any, moments: tuple[Any, Any, Any], torsion: Any, radius: Any) -> Section:
    """Return a section of the rod's material.

    Args:
        rod: the rod, with its moduli and density.
        area: area (m²).
        moments: second moments of area about x and y, and their coupling (m⁴).
        torsion: torsion constant (m⁴).
        radius: radius of the circle around it (m).
    """
    E, G, rho = rod.youngs_modulus, rod.G, rod.density
    xx, yy, xy = moments
    return Section(
        G * area,
        E * area,
        (E * xx, E * yy, E * xy),
        G * torsion,
        rho * area,
        (rho * xx, rho * yy, rho * xy),
        radius,
    )


def round_section(rod: Any, radius: Any, inner_radius: Any = 0.0) -> Section:
    """Return a solid or hollow round section: A = π(r² - rᵢ²), I = π(r⁴ - rᵢ⁴)/4, J = 2I."""
    I = np.pi * (radius**4 - inner_radius**4) / 4.0
    return homogeneous(rod, np.pi * (radius**2 - inner_radius**2), (I, I, 0.0), 2.0 * I, radius)


def turned_axes(about_x: Any, about_y: Any, angle: Any) -> tuple[Any, Any, Any]:
    """Return the entries xx, yy, xy of a tensor with principal axes at an angle (rad) from x and y."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return (
        c * c * about_x + s * s * about_y,
        s * s * about_x + c * c * about_y,
        c * s * (about_x - about_y),
    )


def rectangle_torsion(width: Any, height: Any) -> Any:
    """Return the torsion constant of a rectangle (m⁴), by Saint-Venant's series (Timoshenko & Goodier 1951).

    With the sides a ≥ b,

        J = a b³ (1/3 - 64/π⁵ b/a Σ tanh(nπa/2b) / n⁵),    n = 1, 3, 5, …

    The limit 1 of each tanh has a known sum, 31/32 ζ(5). The rest decays as exp(-nπa/b).
    """
    a, b = jnp.maximum(width, height), jnp.minimum(width, height)
    n, ratio = np.arange(1.0, 12.0, 2.0), jnp.expand_dims(a / b, -1)
    rest = jnp.sum((1.0 - jnp.tanh(0.5 * np.pi * n * ratio)) / n**5, axis=-1)
    return a * b**3 * (1.0 / 3.0 - 64.0 / np.pi**5 * (b / a) * (ODD_FIFTH_POWERS - rest))


def shear_modulus(material: Any) -> Any:
    """Return the shear modulus of a rod or a tube (Pa): the parameter, or by default by Poisson's ratio."""
    if material.shear_modulus is not None:
        return material.shear_modulus
    return material.youngs_modulus / (2.0 * (1.0 + POISSON_RATIO))


def check_hollow(tube: Any) -> None:
    """Raise `ParameterError` unless a tube's inner radius is less than its outer one."""
    if not is_traced(tube) and not np.all(np.less(tube.inner_radius, tube.radius)):
        raise ParameterError(
            f"{type(tube).__name__}: inner_radius is {tube.inner_radius:g}; allowed is less than radius, "
            f"{tube.radius:g}"
        )


class CrossSection(Part):
    """A cross-section of a rod, in place of a solid round one of the rod's `radius`."""

    #: True if it has the density and the moduli of the rod
    is_homogeneous: ClassVar[bool] = True
    #: True if the rod may have a `tip_radius`
    tapers: ClassVar[bool] = False

    @property
    def is_uniform(self) -> bool:
        """True if it is the same along the rod."""
        return True

    @abc.abstractmethod
    def section(self, rod: Any, part: Any) -> Section:
        """Return stiffness and inertia at a fraction of the length."""


class HollowSection(CrossSection):
    """A tube."""

    kind: ClassVar[str] = "hollow"
    tapers: ClassVar[bool] = True

    radius: Any = parameter("m", "outer radius", low=1e-6, high=0.5)
    inner_radius: Any = parameter("m", "inner radius, less than the outer one", low=0.0, high=0.5)

    def __check_init__(self) -> None:
        super().__check_init__()
        check_hollow(self)

    def section(self, rod: Any, part: Any) -> Section:
        """Return the section of a tube."""
        return round_section(rod, self.radius, self.inner_radius)


class EllipticSection(CrossSection):
    """A solid ellipse: I = πab³/4 about the semi-axis a, J = πa³b³/(a² + b²)."""

    kind: ClassVar[str] = "elliptic"

    semi_axis_x: Any = parameter("m", "semi-axis along x", low=1e-6, high=0.5)
    semi_axis_y: Any = parameter("m", "semi-axis along y", low=1e-6, high=0.5)
    angle: Any = _angle()

    def section(self, rod: Any, part: Any) -> Section:
        """Return the section of an ellipse."""
        a, b = self.semi_axis_x, self.semi_axis_y
        area = np.pi * a * b
        moments = turned_axes(area * b**2 / 4.0, area * a**2 / 4.0, self.angle)
        torsion = area * a**2 * b**2 / (a**2 + b**2)
        return homogeneous(rod, area, moments, torsion, jnp.maximum(a, b))


class RectangularSection(CrossSection):
    """A solid rectangle: I = bh³/12, and the torsion constant of Saint-Venant."""

    kind: ClassVar[str] = "rectangular"

    width: Any = parameter("m", "side along x", low=1e-6, high=1.0)
    height: Any = parameter("m", "side along y", low=1e-6, high=1.0)
    angle: Any = _angle()

    def section(self, rod: Any, part: Any) -> Section:
        """Return the section of a rectangle."""
        w, h = self.width, self.height
        moments = turned_axes(w * h**3 / 12.0, h * w**3 / 12.0, self.angle)
        return homogeneous(rod, w * h, moments, rectangle_torsion(w, h), 0.5 * jnp.sqrt(w * w + h * h))


class TabulatedSection(CrossSection):
    """Measured stiffness and mass per length, with linear interpolation along the rod.

    Each list has one value for each place in `at`, or one value for the whole rod. A homogeneous section
    with the same E I and E A gives the inertia about the axes, ρI = ρA EI/EA.
    """

    kind: ClassVar[str] = "tabulated"
    is_homogeneous: ClassVar[bool] = False

    bending_stiffness: Any = _table_field("N m2", "E I about x", 1e-15, 1e9)
    torsional_stiffness: Any = _table_field("N m2", "G J", 1e-15, 1e9)
    axial_stiffness: Any = _table_field("N", "E A", 1e-9, 1e15)
    mass_per_length: Any = _table_field("kg/m", "mass per length", 1e-9, 1e6)
    at: tuple[float, ...] | None = places("where the values are, in order")
    bending_stiffness_y: Any = _table_field("N m2", "E I about y; by default as about x", 1e-15, 1e9, None)
    shear_stiffness: Any = _table_field("N", "G A; by default E A / 2.6", 1e-9, 1e15, None)
    angle: Any = _angle()
    radius: Any = parameter(
        "m",
        "outer radius, for contact and drawings; by default of a round section with its E I and E A",
        low=1e-6,
        high=0.5,
        default=None,
    )

    def __check_init__(self) -> None:
        super().__check_init__()
        at = self.at or (0.0,)
        if not all(np.diff(at) > 0.0):
            raise ParameterError(f"TabulatedSection: at is {list(at)}; allowed is places in order")
        for name, stated in self.parameters().items():
            count = 1 if stated.shape != "list" or name == "at" else np.size(getattr(self, name))
            if count not in (1, len(at)):
                raise ParameterError(
                    f"TabulatedSection: {name} has {count} values; allowed is 1, or one for each of the "
                    f"{len(at)} places in at"
                )

    @property
    def is_uniform(self) -> bool:
        """True if there is one place only."""
        return len(self.at or ()) < 2

    @property
    def cuts(self) -> tuple[float, ...]:
        """Kinks of the interpolation."""
        return tuple(place for place in self.at or () if 0.0 < place < 1.0)

    def _value(self, values: Any, part: Any) -> Any:
        """Return the linear interpolation at a fraction of the length, constant beyond the table."""
        if np.shape(values)[-1] == 1:
            return values[..., 0]
        at = np.array(self.at)
        rises = jnp.diff(values) * jnp.clip((part - at[:-1]) / np.diff(at), 0.0, 1.0)
        return values[..., 0] + jnp.sum(rises, axis=-1)

    def section(self, rod: Any, part: Any) -> Section:
        """Return the table's values at a fraction of the length."""
        about_x, GJ, EA, rhoA = (
            self._value(values, part)
            for values in (
                self.bending_stiffness,
                self.torsional_stiffness,
                self.axial_stiffness,
                self.mass_per_length,
            )
        )
        about_y = about_x if self.bending_stiffness_y is None else self._value(self.bending_stiffness_y, part)
        GA = EA / (2.0 * (1.0 + POISSON_RATIO))
        if self.shear_stiffness is not None:
            GA = self._value(self.shear_stiffness, part)
        EI = turned_axes(about_x, about_y, self.angle)
        xx, yy, xy = EI
        per_area = rhoA / EA
        radius = 2.0 * jnp.sqrt(jnp.maximum(about_x, about_y) / EA) if self.radius is None else self.radius
        return Section(GA, EA, EI, GJ, rhoA, (per_area * xx, per_area * yy, per_area * xy), radius)


class Material(NamedTuple):
    """The rod's section and material at one place: the law K (z - z*) + B z_t and the inertia."""

    Kse: Float[Any, "3 3"]
    Bse: Float[Any, "3 3"]
    Kbt: Float[Any, "3 3"]
    Bbt: Float[Any, "3 3"]
    u_star: Float[Any, "3"]
    #: ρA (kg/m)
    rhoA: Any
    #: ρJ (kg·m)
    rhoJ: Float[Any, "3 3"]
    radius: Any
    v_star: Float[Any, "3"] = ALONG


class Differences(NamedTuple):
    """Local changes of the rod: factors of radius and stiffness, and strains at rest that are added."""

    radius: Any = 1.0
    stiffness: Any = 1.0
    #: curvature (1/m) per reference length
    curvature: Any = 0.0
    #: relative extension
    extension: Any = 0.0


class SectionChange(Stretched):
    """A section of the rod with a cross-section that differs from the rod's parameters."""

    @abc.abstractmethod
    def differences(self, part: Any, control: Any) -> Differences:
        """Return the changes at a fraction, 0 to 1, of the way from `begin` to `end`."""


class Stretch(SectionChange):
    """A section of the rod with another radius, stiffness or shape at rest, along it and by control.

    With ξ from 0 to 1 along the section, the radius is multiplied by a + b ξ + c ξ² … with the given
    coefficients. The stiffness is multiplied by a polynomial in the same way. A control c, if there is one,
    multiplies the stiffness by another 1 + gain·c and adds gain·c to the curvature and to the extension.
    Curvatures and extensions of sections at one place add up: three of them, with a control each for two
    curvatures and the extension, are a segment with three parameters, an arc of the length (1 + ε) L.
    Curvature, mass and stiffness are per reference length.
    """

    kind: ClassVar[str] = "stretch"

    radius: Any = parameter(
        "", "factor of the radius, coefficients in ξ", shape="list", low=-1e3, high=1e3, default=(1.0,)
    )
    stiffness: Any = parameter(
        "", "factor of the stiffness, coefficients in ξ", shape="list", low=-1e6, high=1e6, default=(1.0,)
    )
    curvature: Any = parameter(
        "1/m",
        "curvature at rest, material frame",
        shape="vector",
        low=-1e4,
        high=1e4,
        default=(0.0, 0.0, 0.0),
    )
    curvature_slope: Any = parameter(
        "1/m",
        "increase of that curvature from its beginning to its end",
        shape="vector",
        low=-1e4,
        high=1e4,
        default=(0.0, 0.0, 0.0),
    )
    extension: Any = parameter("", "ε, relative extension at rest", low=-0.9, high=10.0, default=0.0)
    controlled: bool = choice("true if a control acts on it", (False, True), False)
    stiffness_gain: Any = parameter(
        "", "increase of the stiffness factor by a control of 1", low=-1e6, high=1e6, default=0.0
    )
    curvature_gain: Any = parameter(
        "1/m",
        "increase of the curvature at rest by a control of 1",
        shape="vector",
        low=-1e4,
        high=1e4,
        default=(0.0, 0.0, 0.0),
    )
    extension_gain: Any = parameter(
        "", "increase of the extension at rest by a control of 1", low=-10.0, high=10.0, default=0.0
    )

    def __check_init__(self) -> None:
        super().__check_init__()
        for name in ("radius", "stiffness"):
            coefficients = getattr(self, name)
            if isinstance(coefficients, jax.core.Tracer) or np.ndim(coefficients) != 1:
                continue
            least, where = _least(np.asarray(coefficients, dtype=float))
            if not least > 0.0:
                raise ParameterError(
                    f"{type(self).__name__}: {name} is {np.asarray(coefficients).tolist()}, which is "
                    f"{least:.3g} at ξ = {where:.3g}; allowed are factors above 0 along the whole stretch"
                )

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """One control, if the section is controlled; its limits leave some stiffness and some length."""
        field = Field("input", 1, "1", "control of the section")
        extension = as_number(self.extension)
        for gain, least in ((self.stiffness_gain, -1.0), (self.extension_gain, -1.0 - (extension or 0.0))):
            gain = as_number(gain)
            # at the limit itself stiffness or length is zero
            if gain and gain > 0.0:
                field = field._replace(low=max(field.low, float(np.nextafter(least / gain, np.inf))))
            elif gain:
                field = field._replace(high=min(field.high, float(np.nextafter(least / gain, -np.inf))))
        return (field,) if self.controlled else ()

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return the stretch as a skin of the rod, coloured by its control; none without one."""
        if not self.controlled:
            return ()
        at, radius = nodes_between(at, self.begin, self.end), 1.02 * float(rod.section.radius)
        (field,) = self.control_fields
        line = np.zeros((len(at), 3))
        return (Shape("stretch", "stretch", at, line, radius, value=control[:, 0], unit=field.unit),)

    def winding(self, rod: Any) -> float:
        """Return the angle of a rod with its curvature all along."""
        return (known_size(self.curvature) + known_size(self.curvature_slope)) * known_size(rod.length)

    def differences(self, part: Any, control: Any) -> Differences:
        """Return the polynomial factors, with the control's changes."""
        input = control[0] if self.controlled else 0.0
        stiffness = _polynomial(self.stiffness, part) * (1.0 + self.stiffness_gain * input)
        curvature = (
            jnp.asarray(self.curvature)
            + jnp.asarray(self.curvature_slope) * part
            + jnp.asarray(self.curvature_gain) * input
        )
        extension = self.extension + self.extension_gain * input
        return Differences(_polynomial(self.radius, part), stiffness, curvature, extension)


class Sleeve(SectionChange):
    """A sleeve at the beginning of a section: it multiplies the stiffness by 1 + a exp(-(ξ / ℓ)⁴).

    ξ runs from 0 to 1 along the section.
    """

    kind: ClassVar[str] = "sleeve"

    stiffening: Any = parameter(
        "", "a, relative increase of stiffness where the stretch begins", low=0.0, high=1e4, default=0.0
    )
    length: Any = parameter(
        "", "ℓ, where the sleeve ends, as a part of the stretch", low=1e-3, high=10.0, default=0.1
    )

    def differences(self, part: Any, control: Any) -> Differences:
        """Return the sleeve's factor of the stiffness."""
        return Differences(stiffness=1.0 + self.stiffening * jnp.exp(-((part / self.length) ** 4)))


class FunctionSection(SectionChange):
    """A section with any function of the fraction of the way along it, for use from Python.

    `function` maps the fraction of the way, 0 to 1, and the section's control to `Differences`. `inputs` is
    the size of that control. The function must be traceable by JAX, and no file can hold it.
    """

    function: Callable[[Any, Any], Differences] = eqx.field(
        static=True, default=lambda part, control: Differences()
    )
    inputs: int = eqx.field(static=True, default=0)

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """One field of `inputs` numbers."""
        return (Field("input", self.inputs, "1", "control of the section"),) if self.inputs else ()

    def differences(self, part: Any, control: Any) -> Differences:
        """Return the function's value."""
        return self.function(part, control)


def _least(coefficients: Float[np.ndarray, " k"]) -> tuple[float, float]:
    """Return the minimum of a polynomial on [0, 1], and its place."""
    polynomial = np.polynomial.Polynomial(coefficients)
    turns = np.asarray(polynomial.deriv().roots(), dtype=complex)
    at = np.concatenate([[0.0, 1.0], np.clip(turns[turns.imag == 0.0].real, 0.0, 1.0)])
    values = polynomial(at)
    return float(values.min()), float(at[np.argmin(values)])


def _polynomial(coefficients: Any, at: Any) -> Any:
    value = 0.0
    for k in reversed(range(np.shape(coefficients)[0])):
        value = value * at + coefficients[k]
    return value


def differences_at(changes: tuple[SectionChange, ...], part: Any, controls: list[Any]) -> Differences:
    """Return the changes at a fraction of the rod's length: factors multiplied, strains added."""
    total = Differences(1.0, 1.0, jnp.zeros(3))
    for change, control in zip(changes, controls, strict=True):
        radius, stiffness, curvature, extension = change.differences(
            (part - change.begin) / (change.end - change.begin), control
        )
        within = (part >= change.begin) & (part <= change.end)
        total = Differences(
            total.radius * jnp.where(within, radius, 1.0),
            total.stiffness * jnp.where(within, stiffness, 1.0),
            total.curvature + jnp.where(within, curvature, 0.0),
            total.extension + jnp.where(within, extension, 0.0),
        )
    return total


def shape_at_rest(
    base: Pose, s: Any, strains: Callable[[Any], Any], length: Any, edges: Float[np.ndarray, " edges"]
) -> Pose:
    """Return the pose at s of a rod without stress, from its base's and its strains v and u.

    `edges` are parts of the length, from 0 to 1, with smooth strains between them. The integration is
    Magnus' series of order 4 on poses: constant strains give an exact helix for any step.
    """
    bounds = length * np.sort(np.concatenate([np.arange(1, REST_STEPS) / REST_STEPS, edges]))
    # all steps beyond s have zero length
    passed = jnp.concatenate([bounds[:1], jnp.minimum(bounds[1:-1], s), jnp.reshape(s, 1)])
    ds = jnp.diff(passed)
    at = passed[:-1] + (0.5 + np.array([[-1.0], [1.0]]) / np.sqrt(12.0)) * ds
    margin = INWARD * jnp.diff(bounds)
    inside = jnp.clip(at, bounds[:-1] + margin, bounds[1:] - margin)
    v, u = (jnp.broadcast_to(each, (inside.size, 3)) for each in jax.vmap(strains)(inside.ravel()))

    def step(ds: Any, v: Any, u: Any) -> tuple[Any, Any]:
        more = ds * ds / np.sqrt(48.0)
        turn = 0.5 * ds * (u[0] + u[1]) + more * cross(u[0], u[1])
        along = 0.5 * ds * (v[0] + v[1]) + more * (cross(u[0], v[1]) - cross(u[1], v[0]))
        return quaternion_of(turn), mean_turned(turn, along)

    def advance(pose: Pose, step: tuple[Any, Any]) -> tuple[Pose, None]:
        turn, way = step
        return Pose(pose.p + rotate(pose.h, way), quaternion_product(pose.h, turn)), None

    pairs = (each.reshape(2, -1, 3).swapaxes(0, 1) for each in (v, u))
    return jax.lax.scan(advance, base, jax.vmap(step)(ds, *pairs))[0]
