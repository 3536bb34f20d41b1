"""Parts of a robot: sections, loads, ends, obstacles, tendons, friction, further effects.

A part is a small class of a family, with its own parameters. A family is an abstract class. Its subclasses
with a `kind` can be named in a robot's file. A part contributes to the robot (`Contribution`): fields of y
and z, terms of the material's law and of the balance, conditions at the tip, discontinuities, controls. A rod
asks its parts in their order (`SlenderRod.parts`), and knows nothing else about them. A new effect is
therefore one class: an `Effect` for any rod, or a load, a section, an obstacle.
"""

from __future__ import annotations

import functools
from typing import Any, ClassVar, NamedTuple, Self

import jax.numpy as jnp
from jaxtyping import Float

from knode_cosserat.rods.law import Evolution, Fields, MaterialLaw
from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.parameters import ParameterError, Parametrised, check_fields, place, slots_of
from knode_cosserat.rods.shapes import Shape


class Wrench(NamedTuple):
    """A force (N, or N/m) and a moment (N·m, or N) about the axis, global frame."""

    force: Float[Any, "3"]
    moment: Float[Any, "3"]

    def __add__(self, other: Any) -> Wrench:
        return Wrench(self.force + other.force, self.moment + other.moment)


class RodPoint(NamedTuple):
    """A point of a rod, where its parts are asked for their terms."""

    #: the robot, with its parameters and layouts
    rod: Any
    #: arclength (m) and time (s)
    s: Any
    t: Any
    y: Float[Any, " y"]
    y_t: Float[Any, " y"]
    #: control of the robot; None where rates of the base are asked for
    control: Any = None
    #: pose and velocities (`loads.Motion`)
    motion: Any = None
    #: section and material (`section.Material`); None at the tip
    material: Any = None
    #: strains and internal variables, and their rates; None in the law and at the tip
    z: Any = None
    z_t: Any = None
    #: control of the part that is asked
    input: Any = None

    @property
    def material_place(self) -> Any:
        """Place of the material (m), as `s` of the rod that is not fed; see `Contribution.material_place`."""
        return self.rod.material_place(self.s, self.control)

    def get(self, name: str) -> Any:
        """Return a field of y or z by its name."""
        layout = self.rod.y_layout
        return layout.get(self.y, name) if name in layout.names else self.rod.z_layout.get(self.z, name)


class Contribution:
    """Terms of a part in the equations of its robot; by default there are none.

    A field is stated as (name, size, unit, meaning, …), see `layout.Field`. Each field of y requires its rate
    along the rod (`rates`). Each field of z requires its law (`evolutions`, or a part of `law`). Each unknown
    at the base (`base_fields`) requires a condition at the tip (`tip_fields`, `tip_rows`).
    """

    #: True for the robot's actuators: the names of their controls have no prefix, unless two are the same
    actuates: ClassVar[bool] = False
    #: True if the part may hold the robot against loads
    held: ClassVar[bool] = False
    #: True if the part damps a motion; parts with internal variables need not state it
    damps: ClassVar[bool] = False
    #: True if the part's loads on a robot at rest change with its velocity without damping it
    gyroscopic: ClassVar[bool] = False
    #: place at which a point load acts (`PointLoad`); None for other parts
    applied_at: ClassVar[float | None] = None

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """Fields of the robot's control that drive this part; the robot prefixes their names."""
        return ()

    @property
    def cuts(self) -> tuple[float, ...]:
        """Places of discontinuity, as fractions of the length."""
        return ()

    def winding(self, rod: Any) -> float:
        """Return the angle (rad) through which the part turns along the rod (`System.winding`)."""
        return 0.0

    def check(self, rod: Any) -> None:
        """Raise `ParameterError` if the part and others of its robot exclude each other."""

    def y_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return the part's fields of y."""
        return ()

    def z_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return the part's fields of z."""
        return ()

    def base_fields(self, rod: Any) -> tuple[str, ...]:
        """Return the names of the fields of y that are unknown at the base; the part's others are zero."""
        return ()

    def base_y(self, point: RodPoint) -> Fields:
        """Return the part's fields of y at the base that follow from the unknowns there, in `point.y`."""
        return {}

    def base_rates(self, point: RodPoint) -> Fields:
        """Return the part's fields of y at the base that follow from the rates there, in `point.y_t`."""
        return {}

    def tip_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return the fields of the part's conditions at the tip."""
        return ()

    def rest_y(self, rod: Any, s: Any) -> Fields:
        """Return the part's fields of y at s (m) of the unloaded robot; zero without an entry."""
        return {}

    def rest_z(self, rod: Any, strains: Float[Any, "6"]) -> Fields:
        """Return the part's fields of z where v and u are these strains without stress; zero without one."""
        return {}

    def scales(self, rod: Any, sizes: Fields) -> Fields:
        """Return the natural sizes of the part's fields of y and of the tip; 1 without an entry.

        `sizes` has those of the rod by name, such as a force's `n` and a length's `p`.
        """
        return {}

    def evolutions(self, point: RodPoint) -> dict[str, Evolution]:
        """Return the laws of the internal variables that depend on y and control only."""
        return {}

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law of the strains with this part; `internal` has the values of all `evolutions`."""
        return law

    def load(self, point: RodPoint) -> Wrench | None:
        """Return the load on the rod per length (N/m, N), global frame; None if there is none."""
        return None

    def rates(self, point: RodPoint) -> Fields:
        """Return the rates along the rod of the part's fields of y, and terms in the rod's own, such as n."""
        return {}

    def arclength_rate(self, point: RodPoint) -> Any:
        """Return the rate of arclength along the grid, from the controls."""
        return 1.0

    def material_place(self, rod: Any, s: Any, input: Any) -> Any:
        """Return the place (m) of the material at s of the grid, measured from the base of the unfed rod.

        All that belongs to the material depends on it: section, shape at rest, routing, loads.
        """
        return s

    def tip_rows(self, point: RodPoint) -> Any:
        """Return the residuals of the part's conditions at the tip, one number a row; None without any."""
        return None

    def actuation(self, rod: Any, control: Any) -> Any:
        """Return the form in which the part's control enters the equations; by default the control."""
        return control

    def contradiction(self, input: Float[Any, "k *batch T"], dt: float) -> str:
        """Return a sentence on controls of this part, in rows dt (s) apart, that contradict each other."""
        return ""

    def usual_control(self, rod: Any, field: Field) -> float | None:
        """Return a high value of a control, for sliders that begin at zero; None if the unit decides it."""
        return None

    def shapes(self, rod: Any, at: Float[Any, " n"], control: Float[Any, "rows k"]) -> tuple[Shape, ...]:
        """Return the part's shapes for figures and viewer, under its control in each row; by default none.

        Their number and sizes must not depend on the control's values: the live page fills them step by step.
        `at` are the nodes, as fractions of the grid.
        """
        return ()

    # the frame of the robot's states; that of its parts, loads and gravity is the global one

    def absolute(self, point: RodPoint, motion: Any) -> Any:
        """Return the material's motion (`loads.Motion`) in the global frame from the states' motion."""
        return motion

    def seen(self, t: Any, vector: Float[Any, "3"]) -> Float[Any, "3"]:
        """Return a vector of the global frame at t (s) in the frame of the states."""
        return vector

    # the tendons of its robot

    def transmitted(self, point: RodPoint, tension: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return the tensions τ (N) at a point with this part's friction."""
        return tension

    def running(self, point: RodPoint, values: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return values of the tendons at a point, less those of tendons that this part ends before it."""
        return values

    def mobilised(self, point: RodPoint, friction: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return the mobilised fraction of the friction with this part."""
        return friction


class Part(Contribution, Parametrised):
    """Base class of parts with parameters."""

    def eased(self, part: float) -> Self:
        """Return the part with near-discontinuities spread over 1/part of their width; by default itself."""
        return self

    def __check_init__(self) -> None:
        try:
            check_fields(self)
        except ParameterError as error:
            raise ParameterError(f"{type(self).__name__}: {error}") from None


class Effect(Part):
    """Further physics of a rod, such as an added mass or a layer with internal variables."""


@functools.singledispatch
def ease(system: Any, part: float) -> Any:
    """Return a system whose parts have near-discontinuities spread over 1/part of their width.

    Solvers use it as an intermediate problem when the direct solution fails. It is the system itself if no
    part has any. A system that is not a list of parts registers its own function.
    """
    changes: dict[str, Any] = {}
    for name in slots_of(type(system)):
        value = getattr(system, name)
        parts = value if isinstance(value, tuple) else (value,)
        easier = tuple(one.eased(part) if isinstance(one, Part) else one and ease(one, part) for one in parts)
        if any(new is not old for new, old in zip(easier, parts, strict=True)):
            changes[name] = easier if isinstance(value, tuple) else easier[0]
    return system.replace(**changes) if changes else system


class Stretched(Part):
    """A part along a stretch of the rod, by fractions of its length."""

    begin: float = place("where it begins", default=0.0, kw_only=True)
    end: float = place("where it ends", default=1.0, kw_only=True)

    def __check_init__(self) -> None:
        super().__check_init__()
        if not self.end > self.begin:
            raise ParameterError(
                f"{type(self).__name__}: end is {self.end:g}; allowed is a place beyond begin, {self.begin:g}"
            )

    @property
    def cuts(self) -> tuple[float, ...]:
        """Places where it begins and ends."""
        return tuple(end for end in (self.begin, self.end) if end > 0.0)

    def indicator(self, point: RodPoint) -> Any:
        """Return 1 at a point of its stretch, 0 elsewhere."""
        if (self.begin, self.end) == (0.0, 1.0):
            return 1.0
        place, length = point.material_place, point.rod.length
        within = place <= self.end * length
        # what begins at the base also covers the material that is fed behind it
        return jnp.where(within & (place >= self.begin * length) if self.begin else within, 1.0, 0.0)
