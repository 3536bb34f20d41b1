"""Magnets on a rod, in a field: uniform, or that of a dipole.

A magnet has a moment m (A m²), or a moment per length (A m), fixed in the material frame. A field B exerts on
it the force (m·∇)B and the couple m × B (Edelmann, Petruska & Nelson 2017), also per length. A uniform field
exerts no force. The field of a dipole μ, such as a permanent magnet seen from afar, at the position r from it
is (Jackson 1999, section 5.6)

    B = μ₀/4π (3 (μ·r̂) r̂ - μ) / |r|³

The rod's magnets change neither the field nor each other. Small deflections of a rod that is magnetised along
its axis, M per length, follow EI θ'' = M B∥ θ - M B⊥ with the field along and across the rod. A field against
the magnetisation buckles a cantilever at M B L²/EI = π²/4.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.loads import Load, Motion, PointLoad, SpreadLoad
from knode_cosserat.rods.parameters import Doubt, choice, parameter, slot
from knode_cosserat.rods.parts import Part, Wrench
from knode_cosserat.rods.shapes import Shape, arrow
from knode_cosserat.rotation import cross, dot

#: μ₀/4π (T m/A); CODATA 2022 differs from it by 1e-10 of it
MU_OVER_4PI = 1e-7
#: length of the arrows of a field, and of a magnet, as parts of the rod's length
FIELD_ARROW, MAGNET_ARROW = 0.25, 0.16
#: square of a distance (m²) far below any magnet's size, so that a dipole's field is finite at its place
CORE = 1e-18


class MagneticField(Part):
    """A magnetic field, in the global frame."""

    @abc.abstractmethod
    def flux(self, p: Float[Any, "3"], control: Any) -> Float[Any, "3"]:
        """Return the flux density B (T) at a position (m)."""

    def wrench(self, motion: Motion, moment: Any, control: Any) -> Wrench:
        """Return force and couple on a moment of the material frame: (m·∇)B and m × B."""
        m = dot(motion.R, jnp.asarray(moment))
        B, force = jax.jvp(lambda p: self.flux(p, control), (motion.p,), (m,))
        return Wrench(force, cross(m, B))


class UniformField(MagneticField):
    """A uniform field, as of large coils; a control may add to it."""

    kind: ClassVar[str] = "uniform"

    flux_density: Any = parameter(
        "T",
        "B, flux density, global frame",
        shape="vector",
        low=-100.0,
        high=100.0,
        default=(0.0, 0.0, 0.0),
        doubt=Doubt(0.1, absolute=2e-4),
    )
    controlled: bool = choice("true if a control adds to the flux density", (False, True), False)

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """Three components of the flux density, if it is controlled."""
        fields = tuple(Field(f"B{axis}", 1, "T", f"flux density along {axis}, added") for axis in "xyz")
        return fields if self.controlled else ()

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return an arrow from the tip along the field, as long as the field is strong."""
        flux = np.asarray(self.flux_density, dtype=float) + (control if self.controlled else 0.0)
        flux = np.broadcast_to(flux, (len(control), 3))
        size = np.linalg.norm(flux, axis=-1)
        if not self.controlled and not size.max():
            return ()
        head = FIELD_ARROW * float(rod.length) * flux / (size.max() or 1.0)
        radius = 0.012 * float(rod.length)
        more: dict[str, Any] = {"turns": False, "value": size, "unit": "T"}
        return (arrow("field", "field", 1.0, np.zeros(3), head, radius, **more),)

    def flux(self, p: Float[Any, "3"], control: Any) -> Float[Any, "3"]:
        """Return the constant and the control's part."""
        return jnp.asarray(self.flux_density) + (control if self.controlled else 0.0)


class DipoleField(MagneticField):
    """The field of a dipole, such as a permanent magnet far from the rod; controls may move and turn it."""

    kind: ClassVar[str] = "dipole"

    position: Any = parameter(
        "m",
        "position of the dipole, off the rod, global frame",
        shape="vector",
        low=-1e3,
        high=1e3,
        doubt=Doubt(absolute=0.003),
    )
    moment: Any = parameter(
        "A m2",
        "magnetic moment of the dipole, global frame",
        shape="vector",
        low=-1e6,
        high=1e6,
        doubt=Doubt(0.1),
    )
    controlled: tuple[str, ...] = choice(
        "values to which controls add: x, y, z (m) to the position, mx, my, mz (A m2) to the moment",
        ("position", "moment"),
        (),
    )

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """Three components of each controlled value: of the position, then of the moment."""
        fields = {
            "position": [
                Field(axis, 1, "m", f"position of the dipole along {axis}, added") for axis in "xyz"
            ],
            "moment": [Field(f"m{axis}", 1, "A m2", f"its moment along {axis}, added") for axis in "xyz"],
        }
        return tuple(field for name in fields if name in self.controlled for field in fields[name])

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return an arrow at the dipole along its moment."""
        position, moment = (np.asarray(each) for each in self._state(control))
        size = np.linalg.norm(moment, axis=-1, keepdims=True)
        if not self.controlled and not size.max():
            return ()
        half = 0.5 * FIELD_ARROW * float(rod.length) * moment / (size.max() or 1.0)
        radius = 0.03 * float(rod.length)
        about: dict[str, Any] = {"value": size[..., 0].max(), "unit": "A m2"}
        return (arrow("field", "dipole", None, position - half, position + half, radius, **about),)

    def _state(self, control: Any) -> tuple[Any, Any]:
        """Return position and moment (…, 3) under controls (…, k)."""
        position, moment = jnp.asarray(self.position), jnp.asarray(self.moment)
        if "position" in self.controlled:
            position = position + control[..., :3]
        if "moment" in self.controlled:
            moment = moment + control[..., -3:]
        return position, moment

    def flux(self, p: Float[Any, "3"], control: Any) -> Float[Any, "3"]:
        """Return B (T); within a nanometre of the dipole it is bounded."""
        position, moment = self._state(control)
        r = p - position
        square = jnp.sum(r * r) + CORE
        along = 3.0 * jnp.sum(moment * r) / square
        return MU_OVER_4PI * (along * r - moment) / (square * jnp.sqrt(square))


class _Magnetic(Load):
    """A magnet in its field."""

    field: MagneticField = slot("field that acts on it", MagneticField, default=UniformField())

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """Controls of the field."""
        return self.field.control_fields

    def arrows(self, rod: Any, places: Any, moment: Any) -> tuple[Shape, ...]:
        """Return arrows of a moment (material frame) at places of the rod, and none of a moment of zero."""
        moment, size = np.asarray(moment, dtype=float), float(np.linalg.norm(moment))
        if not size:
            return ()
        half = 0.5 * MAGNET_ARROW * float(rod.length) * moment / size
        radius = max(1.25 * float(rod.section.radius), 0.008 * float(rod.length))
        return tuple(arrow("magnet", "magnet", place, -half, half, radius) for place in places)


class Magnet(_Magnetic, SpreadLoad):
    """A magnetised stretch of the rod."""

    kind: ClassVar[str] = "magnet"

    magnetisation: Any = parameter(
        "A m",
        "magnetic moment per length, material frame; for a section of area A, magnetisation times A",
        shape="vector",
        low=-1e6,
        high=1e6,
        default=(0.0, 0.0, 0.0),
        doubt=Doubt(0.2),
    )

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return the field's arrow, and three along the stretch."""
        places = self.begin + (self.end - self.begin) * np.array([0.2, 0.5, 0.8])
        return (*self.field.shapes(rod, at, control), *self.arrows(rod, places, self.magnetisation))

    def wrench(self, motion: Motion, control: Any) -> Wrench:
        """Return force and couple of the field per length."""
        return self.field.wrench(motion, self.magnetisation, control)


class PointMagnet(_Magnetic, PointLoad):
    """A small magnet at one place, such as a capsule at the tip; its mass is an attached mass."""

    kind: ClassVar[str] = "point-magnet"

    moment: Any = parameter(
        "A m2",
        "magnetic moment, material frame",
        shape="vector",
        low=-1e6,
        high=1e6,
        default=(0.0, 0.0, 0.0),
        doubt=Doubt(0.2),
    )

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return the arrows of field and magnet."""
        return (*self.field.shapes(rod, at, control), *self.arrows(rod, [self.at], self.moment))

    def wrench(self, motion: Motion, control: Any) -> Wrench:
        """Return force and couple of the field."""
        return self.field.wrench(motion, self.moment, control)
