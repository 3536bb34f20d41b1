"""A cable's model: a rod held by two grippers that move as measured, and where its markers are.

The free cable runs from marker 1 to marker N - 2. Each pair of held markers gives a gripper's direction. Its
rotation about that direction is not measured: a gripper turns by the shortest way from its mean direction,
and the cable's frame in the grip differs from that by a constant rotation, which is identified. Masses are
not measured either: stiffness, damping and drag are those over the mass per length.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.ends import AXES, Driven
from knode_cosserat.rods.loads import BodyInertia, Motion, SpreadLoad
from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.parts import Wrench
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.rods.section import Stretch
from knode_cosserat.trajectory import Trajectory
from studies.cables import frames
from studies.cables.shapes import CableGrid, CableShape, Fitter

#: time between frames (s): motion capture at 100 Hz
DT = 0.01
#: acceleration of gravity (m/s²)
GRAVITY = 9.81
#: radius of the rod (m): for its rotational inertia only
RADIUS = 5e-3
#: axial and shear stiffness over the mass per length (m²/s²): waves of 100 m/s, no visible stretch
AXIAL = 1e4


@dataclasses.dataclass(frozen=True)
class CableParameters:
    """Numbers of one cable; all stiffness, damping and drag over the mass per length.

    The defaults are guessed: a cable a few millimetres thick. They lie between DLO1 and DLO2.
    """

    #: EI/ρA and GJ/ρA (m⁴/s²)
    bending: float = 0.03
    torsion: float = 0.02
    #: Kelvin-Voigt time of bending and torsion (s)
    damping_time: float = 0.02
    #: drag in proportion to velocity (1/s), across the cable, and its ratio along to across
    drag: float = 0.5
    drag_ratio: float = 1.0
    #: drag in proportion to the square of velocity (1/m)
    square_drag: float = 0.01
    #: curvature at rest in the cable's frame (1/m), in the middle and its change from end to end
    curvature: tuple[float, float] = (0.0, 0.0)
    curvature_change: tuple[float, float] = (0.0, 0.0)
    #: rotation of the cable's frame in the grips (rad): tangents at the base and at the tip, twist at the tip
    base_tangent: tuple[float, float] = (0.0, 0.0)
    tip_tangent: tuple[float, float] = (0.0, 0.0)
    twist: float = 0.0
    #: places of markers beside the centreline, in the cable's frame (m)
    offset: tuple[float, float] = (0.0, 0.0)
    #: part of the mass that sits where the markers are, beside the centreline
    eccentric: float = 0.0
    #: factor of the length that the markers give
    stretch: float = 1.0

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other numbers."""
        return dataclasses.replace(self, **changes)


class EccentricMass(SpreadLoad):
    """Mass beside the centreline, such as markers: the mass itself is that of the rod.

    Its weight and its inertia twist the cable. It has no kind: robot files do not name it.
    """

    kind: ClassVar[str] = ""

    mass: Any = parameter("kg/m", "mass per length", low=0.0, high=1e9, default=0.0)
    offset: Any = parameter(
        "m", "its place in the cable's frame", shape="vector", low=-10.0, high=10.0, default=(0.0, 0.0, 0.0)
    )

    def wrench(self, motion: Motion, control: Any) -> Wrench:
        """Return what moving the centre of mass to the place adds."""
        offset = jnp.asarray(self.offset)
        inertia = self.mass * (jnp.sum(offset**2) * jnp.eye(3) - offset[:, None] * offset)
        return BodyInertia(0.0, self.mass * offset, inertia).wrench(motion, np.array([0.0, 0.0, -GRAVITY]))


class Grips(NamedTuple):
    """Mean directions of the held pairs, and the frames of cables with these directions."""

    directions: Float[np.ndarray, "2 3"]
    frames: Float[np.ndarray, "2 4"]

    @classmethod
    def of(cls, motions: Sequence[Float[np.ndarray, "T N 3"]]) -> Self:
        """Return the grips of several motions."""
        both = zip(*map(_pairs, motions), strict=True)
        pairs = [np.concatenate([each.reshape(-1, 3) for each in pair]) for pair in both]
        directions = np.stack([frames.unit(np.mean(each, axis=0)) for each in pairs])
        first = frames.shortest(frames.AXIS, directions[0])
        last = frames.quaternion_product(frames.shortest(directions[0], directions[1]), first)
        return cls(directions, np.stack([first, last]))


def _pairs(markers: Float[np.ndarray, "T N 3"]) -> tuple[Any, Any]:
    """Directions of both pairs of held markers."""
    return frames.unit(markers[:, 1] - markers[:, 0]), frames.unit(markers[:, -1] - markers[:, -2])


class Prepared(NamedTuple):
    """One motion, ready to be simulated: the same arrays for all motions of a cable."""

    #: poses of the ends at row 0: positions and quaternions
    base: tuple[Any, Any]
    tip: tuple[Any, Any]
    #: their motion from there (frames - 2, 12), and that of the two rows at the start
    controls: Float[Any, "T c"]
    first_controls: Float[Any, "2 c"]
    #: y and z of the two rows at the start
    y: Float[Any, "2 N y"]
    z: Float[Any, "2 N z"]
    #: free markers as seen from the cable's frame
    beside: Float[Any, "M 3"]


class CableModel:
    """Rod, controls and initial rows of one cable, for any parameters."""

    def __init__(self, places: Float[np.ndarray, " M"], grips: Grips, nodes: int = 31):
        self.places, self.grips, self.nodes = np.asarray(places, dtype=float), grips, nodes
        self._fitters: dict[float, Fitter] = {}

    def robot(self, p: Any, base: Any, tip: Any) -> SlenderRod:
        """Return the rod; `p` is a `CableParameters`, or has the same fields as JAX values."""
        bend, twist = jnp.asarray(p.bending), jnp.asarray(p.torsion)
        stiffness = jnp.stack([bend, bend, twist])
        along = jnp.asarray(p.drag_ratio)
        direction = jnp.stack([jnp.ones(()), jnp.ones(()), along])
        change = jnp.asarray(p.curvature_change)
        zero = jnp.zeros(1)
        begin = jnp.asarray(p.curvature) - 0.5 * change
        return SlenderRod(
            length=self.places[-1] * jnp.asarray(p.stretch),
            radius=RADIUS,
            density=1.0 / (np.pi * RADIUS**2),
            youngs_modulus=1e6,
            shear_stiffness=AXIAL * np.eye(3),
            bending_stiffness=jnp.diag(stiffness),
            bending_damping=jnp.diag(jnp.asarray(p.damping_time) * stiffness),
            linear_drag=jnp.diag(jnp.asarray(p.drag) * direction),
            drag=jnp.diag(jnp.asarray(p.square_drag) * direction),
            sections=(
                Stretch(
                    curvature=jnp.concatenate([begin, zero]), curvature_slope=jnp.concatenate([change, zero])
                ),
            ),
            loads=(
                # not negative, or inertia would be
                EccentricMass(
                    mass=jnp.where(jnp.asarray(p.eccentric) >= 0.0, p.eccentric, 0.0),
                    offset=jnp.concatenate([jnp.asarray(p.offset), zero]),
                ),
            ),
            base_end=Driven(axes=AXES, position=base[0], orientation=base[1]),
            tip_end=Driven(axes=AXES, position=tip[0], orientation=tip[1]),
            nodes=self.nodes,
        )

    def end_frames(self, p: CableParameters, markers: Any) -> tuple[Any, Any]:
        """Return the cable's frames (T, 4) at both ends."""
        found = []
        turns = ((np.array([*p.base_tangent, 0.0]), 0.0), (np.array([*p.tip_tangent, 0.0]), p.twist))
        for k, (directions, (tangent, twist)) in enumerate(zip(_pairs(markers), turns, strict=True)):
            gripper = frames.quaternion_product(
                frames.shortest(self.grips.directions[k], directions), self.grips.frames[k]
            )
            held = frames.quaternion_product(
                frames.from_vector(np.array([0.0, 0.0, twist])), frames.from_vector(tangent)
            )
            found.append(frames.quaternion_product(gripper, held))
        return found[0], found[1]

    def fitter(self, p: CableParameters) -> Fitter:
        """Return the fitter of shapes with this length; a few are kept."""
        key = float(p.stretch)
        found = self._fitters.get(key)
        if found is None:
            found = Fitter(CableGrid(self.places * key, 2 * (self.nodes - 1)))
            # a new dictionary, for other threads may be reading the old one
            self._fitters = {**dict(list(self._fitters.items())[-4:]), key: found}
        return found

    def shapes(
        self, p: CableParameters, markers: Any, start: Sequence[CableShape] | None = None
    ) -> tuple[CableShape, CableShape]:
        """Return the shapes of the first two frames, from those of nearly the same parameters if given."""
        offset = np.array([*p.offset, 0.0])
        fitter, (base, tip) = self.fitter(p), self.end_frames(p, markers[:2])
        rounds = 3 if start is None else 2
        first = fitter.shape(markers[0, 1:-1], (base[0], tip[0]), offset, start[0] if start else None, rounds)
        second = fitter.shape(markers[1, 1:-1], (base[1], tip[1]), offset, start[1] if start else first, 2)
        return first, second

    def prepared(
        self, p: CableParameters, markers: Any, start: Sequence[CableShape] | None = None
    ) -> tuple[Prepared, tuple[CableShape, CableShape]]:
        """Return a motion ready to be simulated, and the shapes at its start."""
        shapes = self.shapes(p, markers, start)
        beside = shapes[0].beside
        ends, controls = [], []
        for frame, held, place in zip(self.end_frames(p, markers), (1, -2), (0, -1), strict=True):
            at = markers[:, held] - frames.rotated(frame, np.broadcast_to(beside[place], (len(frame), 3)))
            turn = frames.to_vector(frames.quaternion_product(frame, frames.conjugate(frame[0])))
            ends.append((at[0], frame[0]))
            controls.append(np.concatenate([at - at[0], frames.continuous(turn)], axis=1))
        both = np.concatenate(controls, axis=1)
        y, z = self._rows(p, shapes, ends, both[:2])
        return Prepared(ends[0], ends[1], both[2:], both[:2], y, z, beside[1:-1]), shapes

    def _rows(self, p: CableParameters, shapes: Any, ends: Any, controls: Any) -> tuple[Any, Any]:
        """y and z of the first two frames; the forces are not known and are left at zero."""
        ds = self.places[-1] * p.stretch / (self.nodes - 1)
        points, turns, bent = [], [], []
        for k, shape in enumerate(shapes):
            inner = frames.mean_of_two(shape.edges[1:-2:2], shape.edges[2:-1:2])
            first, last = (
                frames.quaternion_product(frames.from_vector(controls[k, part]), end[1])
                for part, end in zip((slice(3, 6), slice(9, 12)), ends, strict=True)
            )
            h = np.concatenate([first[None], inner, last[None]])
            for i in range(1, len(h)):
                h[i] *= -1.0 if h[i] @ h[i - 1] < 0.0 else 1.0
            u = frames.to_vector(frames.quaternion_product(frames.conjugate(h[:-1]), h[1:])) / ds
            u = np.concatenate([u[:1], 0.5 * (u[1:] + u[:-1]), u[-1:]])
            points.append(shape.points[::2])
            turns.append(h)
            bent.append(u)
        velocity = (points[1] - points[0]) / DT
        spin = frames.to_vector(frames.quaternion_product(frames.conjugate(turns[0]), turns[1])) / DT
        y, z = np.zeros((2, self.nodes, 19)), np.zeros((2, self.nodes, 6))
        stiffness = np.array([p.bending, p.bending, p.torsion])
        rest = np.array([*p.curvature, 0.0])
        for k in range(2):
            y[k, :, :3], y[k, :, 3:7] = points[k], turns[k]
            y[k, :, 10:13] = frames.rotated(turns[k], stiffness * (bent[k] - rest))
            y[k, :, 13:16] = frames.rotated(frames.conjugate(turns[k]), velocity)
            y[k, :, 16:19] = spin
            z[k, :, 2], z[k, :, 3:] = 1.0, bent[k]
        return y, z

    def initial(self, robot: SlenderRod, prepared: Prepared) -> Trajectory:
        """Return the two rows from which a simulation starts."""
        none = np.zeros(2, dtype=int)
        # not from time zero: there a trajectory would be taken to start at rest
        return Trajectory(
            robot,
            None,
            DT * np.array([1.0, 2.0]),
            prepared.y,
            prepared.z,
            prepared.first_controls,
            none,
            np.zeros(2),
            none,
        )

    def free_markers(self, y: Any, beside: Any, stretch: Any = 1.0) -> Any:
        """Return positions (T, M, 3) of the free markers for states y (T, N, 19), as JAX values."""
        places = self.places[1:-1] / self.places[-1] * (self.nodes - 1)
        low = np.clip(np.floor(places).astype(int), 0, self.nodes - 2)
        part = (places - low)[:, None]
        ds = self.places[-1] * stretch / (self.nodes - 1)
        h = y[..., 3:7] / jnp.linalg.norm(y[..., 3:7], axis=-1, keepdims=True)
        a, b = y[:, low, :3], y[:, low + 1, :3]
        ha, hb = h[:, low], h[:, low + 1]
        hb = jnp.where(jnp.sum(ha * hb, axis=-1, keepdims=True) < 0.0, -hb, hb)
        axis = jnp.asarray(frames.AXIS)
        ta, tb = _turned(ha, axis) * ds, _turned(hb, axis) * ds
        square, cube = part**2, part**3
        centre = (
            (2 * cube - 3 * square + 1) * a
            + (cube - 2 * square + part) * ta
            + (3 * square - 2 * cube) * b
            + (cube - square) * tb
        )
        frame = (1.0 - part) * ha + part * hb
        frame = frame / jnp.linalg.norm(frame, axis=-1, keepdims=True)
        return centre + _turned(frame, beside)


def _turned(h: Any, vectors: Any) -> Any:
    twice = 2.0 * jnp.cross(h[..., 1:], jnp.broadcast_to(vectors, (*h.shape[:-1], 3)))
    return vectors + h[..., :1] * twice + jnp.cross(h[..., 1:], twice)
