"""Cross-sections, with their stiffness and inertia."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.ends import Pose
from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.parameters import ParameterError, choice, parameter
from knode_cosserat.rods.parts import Stretched
from knode_cosserat.rotation import cross, mean_turned, quaternion_of, quaternion_product, turned

#: d₃: along the rod
ALONG = np.array([0.0, 0.0, 1.0])
#: diagonal matrices of the axes across and along the rod
ACROSS, AXIAL = np.diag([1.0, 1.0, 0.0]), np.diag(ALONG)
#: equal steps for integrating the shape of a rod that is curved at rest; section edges split them further
REST_STEPS = 50
#: points are moved into an interval by this fraction of it, so that one-sided values are used at its ends
INWARD = 1e-9
#: the paper's G = E / (2 (1 + 0.3)), for a robot without a shear modulus
POISSON_RATIO = 0.3


class CircularSection(NamedTuple):
    """A solid round section of the given radius (m)."""

    radius: Any

    @property
    def area(self) -> Any:
        """Area, πr² (m²)."""
        return np.pi * self.radius**2

    @property
    def second_moment(self) -> Any:
        """Second moment of area about a diameter, πr⁴/4 (m⁴)."""
        return np.pi * self.radius**4 / 4.0

    @property
    def inertia(self) -> Float[Any, "3 3"]:
        """J = diag(I, I, 2I): second moments about the material axes (m⁴)."""
        return self.second_moment * np.diag([1.0, 1.0, 2.0])

    def shear_stiffness(self, youngs_modulus: Any, shear_modulus: Any) -> Float[Any, "3 3"]:
        """Return Kse = diag(GA, GA, EA): shear and extension (N)."""
        return self.area * (shear_modulus * ACROSS + youngs_modulus * AXIAL)

    def bending_stiffness(self, youngs_modulus: Any, shear_modulus: Any) -> Float[Any, "3 3"]:
        """Return Kbt = diag(EI, EI, 2GI): bending and twisting (N·m²)."""
        return self.second_moment * (youngs_modulus * ACROSS + 2.0 * shear_modulus * AXIAL)


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


class Differences(NamedTuple):
    """Local changes of the rod: factors of radius and stiffness, and curvature (1/m) added at rest."""

    radius: Any = 1.0
    stiffness: Any = 1.0
    curvature: Any = 0.0


class SectionChange(Stretched):
    """A section of the rod with a cross-section that differs from the rod's parameters."""

    @abc.abstractmethod
    def differences(self, part: Any, control: Any) -> Differences:
        """Return the changes at a fraction, 0 to 1, of the way from `begin` to `end`."""


class Stretch(SectionChange):
    """A section of the rod with another radius, stiffness or curvature at rest, along it and by control.

    With ξ from 0 to 1 along the section, the radius is multiplied by a + b ξ + c ξ² … with the given
    coefficients. The stiffness is multiplied by a polynomial in the same way. A control c, if there is one,
    multiplies the stiffness by another 1 + gain·c and adds gain·c to the curvature.
    """

    kind: ClassVar[str] = "stretch"

    radius: Any = parameter(
        "", "factor of the radius, coefficients in ξ", shape="list", low=-1e3, high=1e3, default=(1.0,)
    )
    stiffness: Any = parameter(
        "", "factor of the stiffness, coefficients in ξ", shape="list", low=-1e6, high=1e6, default=(1.0,)
    )
    curvature: Any = parameter(
        "1/m", "curvature at rest, material frame", shape="vector", low=-1e4, high=1e4,
        default=(0.0, 0.0, 0.0),
    )  # fmt: skip
    curvature_slope: Any = parameter(
        "1/m", "increase of that curvature from its beginning to its end", shape="vector", low=-1e4, high=1e4,
        default=(0.0, 0.0, 0.0),
    )  # fmt: skip
    controlled: bool = choice("true if a control acts on it", (False, True), False)
    stiffness_gain: Any = parameter(
        "", "increase of the stiffness factor by a control of 1", low=-1e6, high=1e6, default=0.0
    )
    curvature_gain: Any = parameter(
        "1/m", "increase of the curvature at rest by a control of 1", shape="vector", low=-1e4, high=1e4,
        default=(0.0, 0.0, 0.0),
    )  # fmt: skip

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
        """One control, if the section is controlled; its limit leaves some stiffness."""
        field, gain = Field("input", 1, "1", "control of the section"), self.stiffness_gain
        # the gain of a batch, or of a traced robot, gives no limit
        if not (isinstance(gain, jax.core.Tracer) or np.ndim(gain) or gain == 0.0):
            # at the limit itself the stiffness is zero
            limit = -1.0 / float(gain)
            if gain > 0.0:
                field = field._replace(low=float(np.nextafter(limit, np.inf)))
            else:
                field = field._replace(high=float(np.nextafter(limit, -np.inf)))
        return (field,) if self.controlled else ()

    def differences(self, part: Any, control: Any) -> Differences:
        """Return the polynomial factors, with the control's changes."""
        input = control[0] if self.controlled else 0.0
        stiffness = _polynomial(self.stiffness, part) * (1.0 + self.stiffness_gain * input)
        curvature = (
            jnp.asarray(self.curvature)
            + jnp.asarray(self.curvature_slope) * part
            + jnp.asarray(self.curvature_gain) * input
        )
        return Differences(_polynomial(self.radius, part), stiffness, curvature)


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
    """Return the changes at a fraction of the rod's length: factors multiplied, curvatures added."""
    total = Differences(1.0, 1.0, jnp.zeros(3))
    for change, control in zip(changes, controls, strict=True):
        radius, stiffness, curvature = change.differences(
            (part - change.begin) / (change.end - change.begin), control
        )
        within = (part >= change.begin) & (part <= change.end)
        total = Differences(
            total.radius * jnp.where(within, radius, 1.0),
            total.stiffness * jnp.where(within, stiffness, 1.0),
            total.curvature + jnp.where(within, curvature, 0.0),
        )
    return total


def shape_at_rest(
    base: Pose, s: Any, curvature: Callable[[Any], Any], length: Any, edges: Float[np.ndarray, " edges"]
) -> Pose:
    """Return the pose at s of a rod without strain, from its base's and its curvature.

    `edges` are parts of the length, from 0 to 1, with a smooth curvature (1/m) between them. The
    integration is Magnus' series of order 4 on poses: a constant curvature gives an exact helix for any step.
    """
    bounds = length * np.sort(np.concatenate([np.arange(1, REST_STEPS) / REST_STEPS, edges]))
    # all steps beyond s have zero length
    passed = jnp.concatenate([bounds[:1], jnp.minimum(bounds[1:-1], s), jnp.reshape(s, 1)])
    ds = jnp.diff(passed)
    at = passed[:-1] + (0.5 + np.array([[-1.0], [1.0]]) / np.sqrt(12.0)) * ds
    margin = INWARD * jnp.diff(bounds)
    inside = jnp.clip(at, bounds[:-1] + margin, bounds[1:] - margin)
    seen = jax.vmap(curvature)(inside.ravel())

    def step(ds: Any, u: Any, v: Any) -> tuple[Any, Any]:
        more = ds * ds / np.sqrt(48.0)
        turn = 0.5 * ds * (u + v) + more * cross(u, v)
        along = ds * ALONG + more * cross(u - v, ALONG)
        return quaternion_of(turn), mean_turned(turn, along)

    def advance(pose: Pose, step: tuple[Any, Any]) -> tuple[Pose, None]:
        turn, way = step
        return Pose(pose.p + turned(pose.h, way), quaternion_product(pose.h, turn)), None

    return jax.lax.scan(advance, base, jax.vmap(step)(ds, *seen.reshape(2, -1, 3)))[0]
