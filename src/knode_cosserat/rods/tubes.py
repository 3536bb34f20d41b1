"""Robots of concentric tubes: precurved tubes in one another, which are turned and pushed at their bases.

Tubes share their centreline and turn about it; clearance and dry friction are neglected (Dupont, Lock,
Itkowitz & Butler 2010; Rucker, Jones & Webster 2010). In a frame that does not twist (u_z = 0), tube i has
the angle θᵢ and the curvature κᵢ at rest, in the direction of θᵢ. With its stiffnesses EIᵢ, GJᵢ and torsion
τᵢ,

    Rᵀm = Σ EIᵢ (u - κᵢ) + τᵢ d₃,      θᵢ_s = τᵢ/GJᵢ,      τᵢ_s = EIᵢ d₃·(u × κᵢ) + torque of friction

over the tubes that are present. τ₁ follows from Rᵀm. A torque on the robot about its axis acts on the
innermost tube that is present. Each τᵢ is zero where its tube ends, but for such a torque at the tip. Behind
the plate the tubes are straight over the length dᵢ, so that θᵢ = αᵢ + dᵢ τᵢ/GJᵢ at the plate, with the
rotation αᵢ.
Neighbours resist relative rotation by a viscous torque: a snap is then a fast motion.

Insertion. A tube ends, and may begin to be curved, at lengths βᵢ and βᵢ - cᵢ that the controls move. In
order, these lengths bound intervals, each of which takes an equal part of the grid, whatever its length is.
The balance is multiplied by the rate of arclength along the grid. Inertia by the speed of insertion is
neglected.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.law import Fields, MaterialLaw
from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.parameters import (
    Doubt,
    ParameterError,
    as_number,
    known_size,
    parameter,
    place,
    slot,
)
from knode_cosserat.rods.parts import Part, RodPoint
from knode_cosserat.rods.powell import roots
from knode_cosserat.rods.rod import RodDrawing, RodEnds, RodObserved, SlenderRod
from knode_cosserat.rods.section import (
    ALONG,
    CrossSection,
    Material,
    Section,
    check_hollow,
    round_section,
    shear_modulus,
)
from knode_cosserat.rods.shapes import Shape
from knode_cosserat.rods.system import CHOSEN_TURN
from knode_cosserat.rotation import cross, dot, quaternion_product, rotation_matrix, small_inverse

#: default number of segments of each interval: of order 4, their error is below 1e-4 of the length at rest
SEGMENTS = 4
#: steps of a shot in each interval
STEPS = 5
#: number of first guesses of the angles at the tip, and corrections of each; error (rad) of an equilibrium,
#: and distance of the angles within which two are the same
TIP_ANGLES, CORRECTIONS, MET, SAME = 64, 10, 1e-9, 1e-4


class Tube(Part):
    """A tube: straight, and then curved over its last part, or curved all along."""

    kind: ClassVar[str] = "tube"

    radius: Any = parameter("m", "outer radius", low=1e-6, high=0.5)
    youngs_modulus: Any = parameter("Pa", "Young's modulus", low=1e3, high=2e12, doubt=Doubt(0.15))
    density: Any = parameter("kg/m3", "density", low=1.0, high=100e3)
    inner_radius: Any = parameter("m", "inner radius", low=0.0, high=0.5, default=0.0)
    curvature: Any = parameter(
        "1/m",
        "κ, curvature at rest of its last part",
        low=-1e3,
        high=1e3,
        default=0.0,
        doubt=Doubt(0.1),
    )
    curved: Any = parameter(
        "m",
        "c, length of the curved part; by default all of the tube",
        low=0.0,
        high=20.0,
        default=None,
        doubt=Doubt(absolute=0.002),
    )
    transmission: Any = parameter(
        "m",
        "d, length behind the plate without insertion; the tube cannot be inserted by more",
        low=0.0,
        high=20.0,
        default=0.0,
        doubt=Doubt(0.1),
    )
    shear_modulus: Any = parameter(
        "Pa",
        "shear modulus; by default E / 2.6",
        low=1e2,
        high=1e12,
        default=None,
        doubt=Doubt(0.2, of="G"),
    )
    rotation_zero: Any = parameter(
        "rad",
        "angle of the plane of its curvature where its rotation is zero",
        low=-10.0,
        high=10.0,
        default=0.0,
        doubt=Doubt(absolute=0.1),
    )
    insertion_zero: Any = parameter(
        "m",
        "displacement along the rod where its insertion is zero",
        low=-1.0,
        high=1.0,
        default=0.0,
        doubt=Doubt(absolute=0.002),
    )
    end: float = place("where it ends without insertion", low=1e-3, default=1.0, kw_only=True)

    def __check_init__(self) -> None:
        super().__check_init__()
        check_hollow(self)

    @property
    def G(self) -> Any:
        """Shear modulus (Pa): the parameter, or by default from Young's modulus."""
        return shear_modulus(self)


class _Tubes(CrossSection):
    """All tubes of a robot, as its cross-section and actuators."""

    is_homogeneous: ClassVar[bool] = False
    actuates: ClassVar[bool] = True
    is_uniform: ClassVar[bool] = False

    tubes: tuple[Tube, ...]
    friction: Any
    length: Any

    def values(self, name: str) -> Float[Any, " n"]:
        """Return a parameter of each tube."""
        return jnp.stack([jnp.asarray(getattr(tube, name), dtype=float) for tube in self.tubes])

    @property
    def sections(self) -> Section:
        """Sections of the tubes: each field has a number for each tube."""
        sections = [round_section(tube, tube.radius, tube.inner_radius) for tube in self.tubes]
        return jax.tree.map(lambda *numbers: jnp.stack(list(map(jnp.asarray, numbers))), *sections)

    @property
    def EI(self) -> Float[Any, " n"]:
        """Bending stiffness of each tube (N·m²)."""
        return self.sections.EI[0]

    @property
    def GJ(self) -> Float[Any, " n"]:
        """Torsional stiffness of each tube (N·m²)."""
        return self.sections.GJ

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """Rotation and insertion of each tube."""
        fields = []
        for k, tube in enumerate(self.tubes, 1):
            fields.append(Field(f"rotation_{k}", 1, "rad", f"rotation of tube {k} at its base"))
            field = Field(f"insertion_{k}", 1, "m", f"displacement of tube {k} along the rod, at its base")
            length, transmission = as_number(self.length), as_number(tube.transmission)
            zero = as_number(tube.insertion_zero)
            if length is not None and transmission is not None and zero is not None:
                field = field._replace(low=-tube.end * length - zero, high=transmission - zero)
            fields.append(field)
        return tuple(fields)

    def rotations(self, input: Any) -> Any:
        """Return αᵢ (rad) from the controls."""
        return input[::2] + self.values("rotation_zero")

    def insertions(self, input: Any) -> Any:
        """Return the displacements (m) of the tubes from the controls."""
        return input[1::2] + self.values("insertion_zero")

    @property
    def cuts(self) -> tuple[float, ...]:
        """Bounds of the intervals."""
        count = len(self.tubes) + sum(tube.curved is not None for tube in self.tubes)
        return tuple(k / count for k in range(1, count))

    # the grid

    def lengths(self, rod: Any, input: Any) -> tuple[list[Any], list[Any]]:
        """Return the arclengths (m) beyond the plate at which each tube begins to be curved, and ends."""
        moved = self.insertions(input)
        ends = [tube.end * rod.length + moved[k] for k, tube in enumerate(self.tubes)]
        return [
            None if tube.curved is None else jnp.maximum(end - tube.curved, 0.0)
            for tube, end in zip(self.tubes, ends, strict=True)
        ], ends

    def arclength(self, rod: Any, s: Any, input: Any) -> tuple[Any, Any]:
        """Return the arclength (m) beyond the plate at s on the grid, and its rate along the grid."""
        curved, ends = self._bounds(rod, input)
        bounds = [*curved, *ends]
        # odd-even transposition sort: the engine has no sort
        for turn in range(len(bounds)):
            for k in range(turn % 2, len(bounds) - 1, 2):
                low, high = bounds[k], bounds[k + 1]
                bounds[k], bounds[k + 1] = jnp.minimum(low, high), jnp.maximum(low, high)
        widths = jnp.diff(jnp.stack(bounds), prepend=0.0)
        at = s / rod.length * len(bounds)
        first = np.arange(len(bounds))
        # the tip belongs to the last interval
        active = jnp.where((at >= first) & ((at < first + 1) | (first == len(bounds) - 1)), 1.0, 0.0)
        progress = jnp.clip(at - first, 0.0, 1.0)
        return jnp.sum(progress * widths), jnp.sum(active * widths) * len(bounds) / rod.length

    def present(self, rod: Any, s: Any, input: Any) -> tuple[Float[Any, " n"], Float[Any, " n"]]:
        """Return 1 for each tube that is present at s on the grid, and its curvature at rest (1/m)."""
        at, _ = self.arclength(rod, s, input)
        curved, ends = self.lengths(rod, input)
        # exact at the tip, where the longest tube ends
        tips = jnp.stack(ends)
        presence = jnp.where((at < tips) | (tips >= jnp.max(tips)), 1.0, 0.0)
        bent = [1.0 if begin is None else jnp.where(at >= begin, 1.0, 0.0) for begin in curved]
        return presence, presence * self.values("curvature") * jnp.stack(bent)

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return each tube to its end, with its outer radius; the innermost is the darkest."""
        every = jax.vmap(lambda row: [jnp.stack(each) for each in self._bounds(rod, row) if each])(control)
        bounds, ends = np.concatenate(every, axis=-1), np.asarray(every[-1])
        found = []
        for k, tube in enumerate(self.tubes):
            # the grid has an interval up to each bound
            intervals = np.sum(bounds <= ends[:, k : k + 1] + 1e-12, axis=-1)
            reach = intervals[:, None] / bounds.shape[-1]
            shade = 0.55 * k / max(1, len(self.tubes) - 1)
            line, name = np.zeros((len(at), 3)), f"tube {k + 1}"
            found.append(Shape("tube", name, np.minimum(at, reach), line, float(tube.radius), shade=shade))
        return tuple(found)

    def _bounds(self, rod: Any, input: Any) -> tuple[list[Any], list[Any]]:
        """Return the bounds (m) of the grid's intervals: where tubes begin to be curved, and their ends."""
        curved, ends = self.lengths(rod, input)
        return [begin for begin in curved if begin is not None], ends

    def section(self, rod: Any, part: Any, presence: Any = 1.0) -> Section:
        """Return the sum of the tubes that are present; all of them are at the base."""
        total: Section = jax.tree.map(lambda numbers: jnp.sum(presence * numbers), self.sections)
        return total._replace(radius=jnp.max(presence * self.sections.radius))

    # the equations

    def y_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return θ, and τ of all tubes but the first."""
        n = len(self.tubes)
        torsion = (
            (("torsion", n - 1, "N m", "torsion of the tubes from the second on", "", "N"),) if n > 1 else ()
        )
        return (("angle", n, "rad", "angle of each tube about the rod", "", "rad/m"), *torsion)

    def base_fields(self, rod: Any) -> tuple[str, ...]:
        """Return the torsion's name."""
        return ("torsion",) if len(self.tubes) > 1 else ()

    def tip_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return the torsion at the tubes' ends."""
        n = len(self.tubes) - 1
        return (("torsion", n, "N m", "torsion at the ends of the tubes from the second on"),) if n else ()

    def tip_rows(self, point: RodPoint) -> Any:
        """Return the torsion at the tubes' ends, constant beyond them, less the torque at the tip."""
        if len(self.tubes) == 1:
            return None
        innermost = self.innermost(self.present(point.rod, point.s, point.input)[0])
        return innermost[1:] * self.axial_moment(point) - point.get("torsion")

    def scales(self, rod: Any, sizes: Fields) -> Fields:
        """Return the rod's moment for a torsion."""
        return {"torsion": sizes["m"]} if len(self.tubes) > 1 else {}

    def axial_moment(self, point: RodPoint) -> Float[Any, ""]:
        """Return the third component of Rᵀm (N·m): the sum of all τᵢ."""
        return dot(rotation_matrix(point.get("h")).T, point.get("m"))[2]

    def innermost(self, presence: Float[Any, " n"]) -> Float[Any, " n"]:
        """Return 1 for the innermost tube that is present, and 0 for the others."""
        absent = jnp.cumprod(1.0 - presence)
        return presence * jnp.concatenate([jnp.ones(1), absent[:-1]])

    def torsions(self, point: RodPoint) -> Float[Any, " n"]:
        """Return τᵢ (N·m): the first tube has what the others leave of Rᵀm."""
        total = self.axial_moment(point)
        if len(self.tubes) == 1:
            return total[None]
        others = point.get("torsion")
        return jnp.concatenate([total[None] - jnp.sum(others), others])

    def base_y(self, point: RodPoint) -> Fields:
        """Return the angles at the plate."""
        straight = self.values("transmission") - self.insertions(point.input)
        return {"angle": self.rotations(point.input) + straight * self.torsions(point) / self.GJ}

    def arclength_rate(self, point: RodPoint) -> Any:
        """Return the rate of arclength along the grid."""
        return self.arclength(point.rod, point.s, point.input)[1]

    def rest_curvatures(self, point: RodPoint) -> tuple[Any, Any]:
        """Return 1 for each tube that is present, and κᵢ (n, 2) in the frame of the rod."""
        presence, curvature = self.present(point.rod, point.s, point.input)
        angle = point.get("angle")
        return presence, jnp.stack([-curvature * jnp.sin(angle), curvature * jnp.cos(angle)], axis=1)

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law with the moment of the tubes' curvatures, in a frame that does not twist."""
        _, curvatures = self.rest_curvatures(point)
        u = law.strains["u"]
        moment = jnp.sum(self.EI[:, None] * curvatures, axis=0)
        stress = jnp.concatenate([u.stress[:2] + moment, jnp.zeros(1)])
        return law.with_strain("u", u._replace(stress=stress))

    def turning(self, point: RodPoint) -> tuple[Any, Any, Any]:
        """Return τᵢ of tubes that are present, d₃·(u × κᵢ), and the relative spin of present neighbours."""
        (presence, curvatures), u = self.rest_curvatures(point), point.get("u")
        torque = u[0] * curvatures[:, 1] - u[1] * curvatures[:, 0]
        spin = point.rod.y_layout.get(point.y_t, "angle")
        sliding = presence[1:] * presence[:-1] * (spin[1:] - spin[:-1])
        return presence * self.torsions(point), torque, sliding

    def rates(self, point: RodPoint) -> Fields:
        """Return θᵢ_s and τᵢ_s."""
        torsion, torque, sliding = self.turning(point)
        turned = {"angle": torsion / self.GJ}
        if len(self.tubes) == 1:
            return turned
        drag, none = self.friction * sliding, jnp.zeros(1)
        dragged = jnp.concatenate([drag, none]) - jnp.concatenate([none, drag])
        return turned | {"torsion": (self.EI * torque - dragged)[1:]}


class ConcentricTubeRobot(SlenderRod):
    """A robot of concentric tubes, the innermost first; `length` is that of the longest without insertion."""

    kind: ClassVar[str] = "concentric-tube-robot"
    alternatives: ClassVar[tuple[tuple[str, ...], ...]] = ()
    radius: ClassVar[Any] = None  # type: ignore[misc]
    density: ClassVar[Any] = None  # type: ignore[misc]
    youngs_modulus: ClassVar[Any] = None  # type: ignore[misc]
    tip_radius: ClassVar[Any] = None  # type: ignore[misc]
    shear_modulus: ClassVar[Any] = None  # type: ignore[misc]
    shear_stiffness: ClassVar[Any] = None  # type: ignore[misc]
    bending_stiffness: ClassVar[Any] = None  # type: ignore[misc]
    sections: ClassVar[Any] = ()  # type: ignore[misc]

    tubes: tuple[Tube, ...] = slot("tubes, the innermost first", Tube, many=True, default=())
    tube_friction: Any = parameter(
        "N s",
        "viscous torque between neighbouring tubes, by length and relative rate of rotation",
        low=0.0,
        high=1e3,
        default=1e-5,
    )

    def __check_init__(self) -> None:
        if not self.tubes:
            raise ParameterError("tubes is []; allowed is one or more, the innermost first")
        if max(tube.end for tube in self.tubes) < 1.0:
            raise ParameterError("no tube ends at the tip; allowed is an end of 1 for the longest")
        moved = [
            name
            for name, part in self.parts.items()
            if not isinstance(part, _Tubes) and any(cut < 1.0 for cut in part.cuts)
        ]
        if moved:
            raise ParameterError(
                f"{', '.join(moved)} within the rod; allowed on tubes, which move with their insertion, "
                "are parts at the tip or all along"
            )
        for k, (inner, outer) in enumerate(zip(self.tubes, self.tubes[1:], strict=False), 1):
            radius, hole = as_number(inner.radius), as_number(outer.inner_radius)
            if radius is not None and hole is not None and radius > hole:
                raise ParameterError(
                    f"tube {k} has a radius of {radius:g} m, and tube {k + 1} an inner_radius of {hole:g} m; "
                    "allowed are tubes in one another, the innermost first"
                )

    @property
    def needed_nodes(self) -> int:
        """Four segments, or more for strongly curved tubes, for each interval of the grid."""
        bent = [
            known_size(tube.curvature) * known_size(self.length if tube.curved is None else tube.curved)
            for tube in self.tubes
        ]
        segments = max(SEGMENTS, math.ceil(max(bent) / CHOSEN_TURN))
        return segments * (len(self.cross_section.cuts) + 1) + 1

    #: all tubes
    cross_section: ClassVar[Any] = property(  # type: ignore[misc]
        lambda robot: _Tubes(robot.tubes, robot.tube_friction, robot.length)
    )

    def balance(self, s, t, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """Return y_s; torque about the axis acts on the innermost tube that is present."""
        y_s, layout = super().balance(s, t, y, y_t, z, z_t, control), self.y_layout
        if len(self.tubes) == 1:
            return y_s
        tubes, input = self._tubes_of(control)
        R, u = rotation_matrix(layout.get(y, "h")), self.z_layout.get(z, "u")
        rate = tubes.arclength(self, s, input)[1]
        carried = dot(R.T, layout.get(y_s, "m")) - rate * cross(u, dot(R.T, layout.get(y, "m")))
        torsion = layout.get(y_s, "torsion")
        # the first tube's torque follows from Rᵀm; where it is absent, that of the states is balanced
        innermost = tubes.innermost(tubes.present(self, s, input)[0])
        changed = torsion + innermost[1:] * (carried[2] - jnp.sum(torsion))
        where = layout.slice("torsion")
        return jnp.concatenate([y_s[: where.start], changed, y_s[where.stop :]])

    def _tubes_of(self, control: Any) -> tuple[_Tubes, Any]:
        return next((part, input) for part, input in self.inputs(control) if isinstance(part, _Tubes))

    def material(self, s: Any, control: Any) -> Material:
        """Return the sum of the tubes that are present."""
        tubes, input = self._tubes_of(control)
        section = tubes.section(self, s, tubes.present(self, s, input)[0])
        return Material(
            section.Kse,
            self.shear_damping,
            section.Kbt,
            self.bending_damping,
            self.u_star,
            section.rhoA,
            section.rhoJ,
            section.radius,
        )


class _TubeEnds(RodEnds, of=ConcentricTubeRobot):
    """Ends of a robot of tubes."""

    system: ConcentricTubeRobot
    rest_is_guess = True

    def unloaded(self, y: Any, along: Any, controls: Any) -> Any:
        """Return y with the angles and torsion of the equilibrium that shooting from no torsion finds.

        Turned far, tubes have several equilibria, also unstable ones. Programs for such robots shoot from the
        plate with Powell's hybrid method, and begin without torsion (Rucker et al. 2010).
        """
        layout = self.system.y_layout
        states = np.array(np.broadcast_to(y, (len(controls), *np.shape(y))))
        if not len(controls):
            return states
        pieces, alpha = _pieces_of(self.system, np.asarray(controls, dtype=float))
        states[..., layout.slice("angle")] = np.asarray(alpha)[:, None]
        if len(self.system.tubes) == 1:
            return states
        twist, found = roots(lambda twist: np.asarray(_shoot(pieces, twist)[1][:, -1]), np.zeros_like(alpha))
        states[found] = self._with_tubes(states, along, pieces, twist)[found]
        return states

    def branches(self, y: Any, along: Any, controls: Any) -> tuple[Any, Any]:
        """Return guesses of all equilibria without loads: backwards from angles at the tip to the plate.

        Without torsion at the tip, the angles there determine those at the actuators, so that equilibria are
        zeros of a function on a torus. Newton's method starts from `TIP_ANGLES` points of a grid on it.
        """
        count, controls = len(self.system.tubes), np.asarray(controls, dtype=float)
        if count == 1 or not len(controls):
            return super().branches(y, along, controls)
        pieces = _pieces_of(self.system, controls)[0]
        grid = np.linspace(0.0, 2.0 * np.pi, round(TIP_ANGLES ** (1.0 / (count - 1))), endpoint=False)
        starts = np.stack(np.meshgrid(*[grid] * (count - 1), indexing="ij"), axis=-1).reshape(-1, count - 1)
        tip, twist, error = map(np.asarray, _meet(pieces, starts))
        # angles as points of circles
        tip = np.concatenate([np.cos(tip), np.sin(tip)], axis=-1)
        rows, chosen = list[int](), list[int]()
        for row, k in zip(*np.nonzero(error < MET), strict=True):
            same = [j for i, j in zip(rows, chosen, strict=True) if i == row]
            if all(np.linalg.norm(tip[row, k] - tip[row, j]) > SAME for j in same):
                rows.append(int(row))
                chosen.append(int(k))
        states = np.array(np.broadcast_to(y, (len(rows), *np.shape(y))))
        own = [np.asarray(part)[rows] for part in pieces]
        return np.array(rows, dtype=int), self._with_tubes(states, along, own, twist[rows, chosen])

    def _with_tubes(self, states: Any, along: Any, pieces: Any, twist: Any) -> Any:
        """Return states (K, points, y) with the angles and torsion of shots from the plate."""
        layout, states = self.system.y_layout, np.array(states)
        angles, twists = map(np.asarray, _shoot(pieces, twist))
        path = np.concatenate([angles, np.asarray(pieces[-1])[:, None] * twists], axis=-1)
        at, last = np.asarray(along) * (path.shape[1] - 1), path.shape[1] - 2
        first = np.minimum(at.astype(int), last)
        part = (at - first)[:, None]
        values = (1.0 - part) * path[:, first] + part * path[:, first + 1]
        turned, torsion = np.split(values, 2, axis=-1)
        states[..., layout.slice("angle")] = turned
        states[..., layout.slice("torsion")] = torsion[..., 1:]
        return states


@jax.jit
def _pieces_of(robot: Any, controls: Any) -> Any:
    """Return the intervals of the grid under each control, and the angles at the actuators.

    They have lengths, and of each tube presence, curvature, angle at the plate without twist, length behind
    it, and EI and GJ.
    """

    def of(control: Any) -> Any:
        tubes, input = robot._tubes_of(control)
        count = len(tubes.cuts) + 1
        middles = [(k + 0.5) / count * robot.length for k in range(count)]
        lengths = jnp.stack([tubes.arclength(robot, s, input)[1] * robot.length / count for s in middles])
        presence, curvature = map(
            jnp.stack, zip(*(tubes.present(robot, s, input) for s in middles), strict=True)
        )
        alpha = tubes.rotations(input)
        straight = tubes.values("transmission") - tubes.insertions(input)
        return (lengths, presence, curvature, alpha, straight, tubes.EI, tubes.GJ), alpha

    return jax.vmap(of)(controls)


def _shot(begin: Any, pieces: Any, EI: Any, GJ: Any) -> tuple[Any, Any]:
    """Return the last angles and twists of a shot through intervals, and all of them; lengths have signs."""

    def step(state: Any, piece: Any) -> tuple[Any, Any]:
        # leapfrog: half a step with the twist, a step of the twist, half a step
        h, there, curved = piece
        angle, twist = state
        middle = angle + 0.5 * h * there * twist
        x, y, weight = curved * jnp.cos(middle), curved * jnp.sin(middle), EI * there
        torque = (jnp.sum(weight * x) * y - jnp.sum(weight * y) * x) / jnp.sum(weight)
        after = twist + h * EI / GJ * there * torque
        new = middle + 0.5 * h * there * after, after
        return new, jnp.stack(new)

    lengths, presence, curvature = pieces
    every = tuple(jnp.repeat(part, STEPS, axis=0) for part in (lengths / STEPS, presence, curvature))
    return jax.lax.scan(step, begin, every, unroll=STEPS)


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, 0))
def _shoot(pieces: Any, twist: Any) -> tuple[Any, Any]:
    """Return angles and twists (1/m) of all tubes from the plate to the tip, without loads."""
    lengths, presence, curvature, alpha, straight, EI, GJ = pieces
    begin = alpha + straight * twist, twist
    _, states = _shot(begin, (lengths, presence, curvature), EI, GJ)
    states = jnp.concatenate([jnp.stack(begin)[None], states])
    return states[:, 0], states[:, 1]


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, None))
@functools.partial(jax.vmap, in_axes=(None, 0))
def _meet(pieces: Any, tip: Any) -> tuple[Any, Any, Any]:
    """Return relative angles at the tip, twists at the plate (1/m), and the error of the actuators (rad).

    They are found by Newton's method from relative angles (n - 1,) at the tip.
    """
    lengths, presence, curvature, alpha, straight, EI, GJ = (jnp.asarray(part) for part in pieces)
    back = -lengths[::-1], presence[::-1], curvature[::-1]

    def at_actuators(tip: Any) -> tuple[Any, Any]:
        angle = jnp.concatenate([jnp.zeros(1), tip])
        (angle, twist), _ = _shot((angle, jnp.zeros_like(angle)), back, EI, GJ)
        off = angle - straight * twist - alpha
        return off[1:] - off[0], twist

    def turned(off: Any) -> Any:
        return off - 2.0 * jnp.pi * jnp.round(off / (2.0 * jnp.pi))

    def correct(_: Any, tip: Any) -> Any:
        slopes = jax.jacfwd(lambda tip: at_actuators(tip)[0])(tip)
        step = dot(small_inverse(slopes), turned(at_actuators(tip)[0]))
        return tip - step * jnp.minimum(1.0, 1.0 / jnp.maximum(jnp.linalg.norm(step), 1e-300))

    tip = jax.lax.fori_loop(0, CORRECTIONS, correct, tip)
    off, twist = at_actuators(tip)
    return tip, twist, jnp.max(jnp.abs(turned(off)))


class _TubesDrawing(RodDrawing, of=ConcentricTubeRobot):
    """The rod, whose frame does not twist; what is attached to the tip turns with the innermost tube."""

    def attached(self, y: Any) -> Any:
        """Return the orientations of the innermost tube's tip, of states y (…, y) there."""
        layout = self.system.y_layout
        half = 0.5 * layout.get(y, "angle")[..., :1]
        none = jnp.zeros_like(half)
        turn = jnp.concatenate([jnp.cos(half), none, none, jnp.sin(half)], axis=-1)
        product = jnp.vectorize(quaternion_product, signature="(4),(4)->(4)")
        return product(layout.get(y, "h"), turn)


class _TubesObserved(RodObserved, of=ConcentricTubeRobot):
    """Motion, and bending, torsion and sliding of the tubes, from which their laws follow."""

    system: ConcentricTubeRobot
    base_law: ClassVar[tuple[str, ...]] = ("angle",)

    def _point(self, s: Any, y: Any, control: Any) -> tuple[_Tubes, RodPoint]:
        return self._tubes(RodPoint(self.system, s, None, y, None, control))

    def _tubes(self, point: RodPoint) -> tuple[_Tubes, RodPoint]:
        parts = self.system.at_parts(point._replace(rod=self.system))
        return next((part, at) for part, at in parts if isinstance(part, _Tubes))

    @property
    def layout(self) -> Layout:
        """Layout of `observables`."""
        n = len(self.system.tubes)
        sliding = (("sliding", n - 1, "rad/s", "relative rate of rotation of neighbours"),) if n > 1 else ()
        return super().layout + Layout(
            ("twisting", n, "N m", "torsion of the tubes that are present"),
            ("torque", n, "1/m2", "torque about each tube, by its bending stiffness"),
            *sliding,
        )

    def observables(self, point: RodPoint) -> Float[Any, " o"]:
        """Return those of a rod, and torsion, torque and sliding of the tubes."""
        tubes, at = self._tubes(point)
        return jnp.concatenate([super().observables(point), *tubes.turning(at)])

    @property
    def ambient_layout(self) -> Layout:
        """Layout of `ambient`: the innermost tube, which is always present, adds nothing to a constant."""
        n, meaning = len(self.system.tubes) - 1, "1 for each tube but the first that is present"
        return super().ambient_layout + Layout(*((("presence", n, "1", meaning),) if n else ()))

    def ambient(self, s: Any, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """Return the control, and 1 for each tube but the first that is present."""
        tubes, at = self._point(s, None, control)
        presence, _ = tubes.present(self.system, s, at.input)
        return jnp.concatenate([super().ambient(s, control), presence[1:]])

    @property
    def law_layout(self) -> Layout:
        """Layout of `law_inputs`."""
        n = len(self.system.tubes)
        return super().law_layout + Layout(
            ("stretched", 3 * n, "1", "shear and extension of each tube"),
            ("bent", 2 * n, "1/m", "bending of each tube, x and y"),
        )

    def law_inputs(self, s: Any, y: Float[Any, " y"], control: Any) -> Callable[[Any, Any], Any]:
        """Return the function of z and z_t: those of a rod, and the strains of each tube."""
        inputs, (tubes, at) = super().law_inputs(s, y, control), self._point(s, y, control)
        presence, curvatures = tubes.rest_curvatures(at)

        def strains(z: Any, z_t: Any) -> Any:
            v, u = self.system.z_layout.split(z)
            stretched, bent = presence[:, None] * (v - ALONG), presence[:, None] * u[:2] - curvatures
            return jnp.concatenate([inputs(z, z_t), stretched.reshape(-1), bent.reshape(-1)])

        return strains

    @property
    def base_layout(self) -> Layout:  # type: ignore[override]
        """Layout of `base_inputs`."""
        return Layout(("straight", len(self.system.tubes), "N m2", "torsion times length behind the plate"))

    def base_inputs(self, y: Float[Any, " y"], control: Any) -> Float[Any, " b"]:
        """Return the torsion of each tube times its length behind the plate."""
        tubes, at = self._point(0.0, y, control)
        return (tubes.values("transmission") - tubes.insertions(at.input)) * tubes.torsions(at)
