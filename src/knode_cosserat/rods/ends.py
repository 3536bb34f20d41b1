"""Boundary conditions at the two ends of a rod.

At the base, an end determines y from its unknowns. At the tip, an end returns the residual of its conditions.
An end that is held has a pose. By default the pose at the base is (0, 0, 0) and upright, and the pose at the
tip is that of the straight rod. A robot with a constrained tip starts at its equilibrium.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.parameters import ParameterError, choice, parameter, text
from knode_cosserat.rods.parts import Part
from knode_cosserat.rods.shapes import Shape, ball, bar
from knode_cosserat.rotation import conjugate, cross, dot, quaternion_of, quaternion_product, rotation_matrix

#: motions of an end that a control may drive: along a global axis, or about one
AXES = ("x", "y", "z", "rx", "ry", "rz")

#: largest difference between moves of a base by its pose and by its velocities, as part of the largest move;
#: and moves (m, rad) that are rounding
CONTRADICTION, ROUNDING = 0.2, 1e-9

_POSITION = ("p", 3, "m", "position at the tip, global frame")
_TURN = ("turn", 3, "rad", "rotation at the tip, from where it is held")
_FORCE = ("n", 3, "N", "force at the tip, global frame", "h", "N")
_MOMENT = ("m", 3, "N m", "moment at the tip, global frame", "h", "N m")


class Pose(NamedTuple):
    """Position (m) and orientation (quaternion, scalar first)."""

    p: Float[Any, "3"]
    h: Float[Any, "4"]

    def then(self, other: Pose) -> Pose:
        """Return a pose that is stated in the frame of this one."""
        return Pose(self.p + dot(rotation_matrix(self.h), other.p), quaternion_product(self.h, other.h))

    def inverse(self) -> Pose:
        """Return the pose of the origin in the frame of this pose, of unit quaternion."""
        h = conjugate(self.h)
        return Pose(-dot(rotation_matrix(h), self.p), h)


#: default pose of the base
AT_ORIGIN = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


class End(Part):
    """An end of a rod: its base or its tip."""

    #: unknown fields among p, h, n, m where this end is the rod's base; the others are prescribed
    unknowns: ClassVar[tuple[str, ...]]
    #: True if the end is constrained
    held: ClassVar[bool] = True
    #: True if the velocities of a base are the rates of its pose
    by_rates: ClassVar[bool] = True
    #: True if the end can be a rod's base as well as its tip
    anywhere: ClassVar[bool] = True
    #: True if the end can be a rod's tip
    at_tip: ClassVar[bool] = True
    #: the tip's conditions: names, sizes, units
    conditions: ClassVar[tuple[tuple[Any, ...], ...]]

    position: Any = parameter(
        "m", "where the end is held, global frame", shape="vector", low=-1e3, high=1e3, default=None
    )
    orientation: Any = parameter(
        "1", "orientation of the held end, a quaternion", shape="quaternion", low=-1e3, high=1e3, default=None
    )
    body: str = text("body of an assembly that holds the end, in whose frame it is then stated")
    #: pose of the body; the assembly states it
    frame: Pose | None = None

    def pose(self, rest: Pose, control: Any) -> Pose:
        """Return the pose in which the end is held."""
        if not self.body:
            return self.place(rest, control)
        if self.frame is None:
            raise ParameterError(f"an end is held by the body {self.body!r}; allowed is that in an assembly")
        return self.frame.then(self.place(AT_ORIGIN, control))

    def place(self, rest: Pose, control: Any) -> Pose:
        """Return the pose in the frame of the ground or of the body; by default the pose at rest."""
        p = rest.p if self.position is None else self.position
        h = rest.h if self.orientation is None else self.orientation
        return Pose(jnp.asarray(p), jnp.asarray(h) / jnp.sqrt(jnp.sum(jnp.asarray(h) ** 2)))

    def joint(self, rod: Any) -> tuple[float, float]:
        """Return the end's place as a fraction of the length, and the radius (m) of its joint's drawing."""
        return float(rod.tip_end is self), max(2.2 * float(rod.section.radius), 0.012 * float(rod.length))

    def twist(self, held: Pose, control: Any) -> Float[Any, "6"]:
        """Return q and ω (material frame) of a base held in a pose; zero unless controls give them."""
        return jnp.zeros(6)

    @abc.abstractmethod
    def residual(self, held: Pose, y: Pose, n: Any, m: Any) -> Float[Any, " k"]:
        """Return the residual of the tip's conditions, from poses, and n and m less the loads at the tip."""


class Free(End):
    """An unconstrained end."""

    kind: ClassVar[str] = "free"
    unknowns: ClassVar[tuple[str, ...]] = ("p", "h")
    held: ClassVar[bool] = False
    conditions: ClassVar[tuple[tuple[Any, ...], ...]] = (_FORCE, _MOMENT)

    def residual(self, held: Pose, y: Pose, n: Any, m: Any) -> Float[Any, " k"]:
        """Return the residual of zero force and zero moment."""
        return jnp.concatenate([-n, -m])


class Clamped(End):
    """An end with prescribed position and orientation."""

    kind: ClassVar[str] = "clamped"
    by_rates: ClassVar[bool] = False
    unknowns: ClassVar[tuple[str, ...]] = ("n", "m")
    conditions: ClassVar[tuple[tuple[Any, ...], ...]] = (_POSITION, _TURN)

    def residual(self, held: Pose, y: Pose, n: Any, m: Any) -> Float[Any, " k"]:
        """Return the position error, and twice the vector part of the rotation error."""
        turned = quaternion_product(conjugate(held.h), y.h)
        turned = turned * jnp.where(turned[0] < 0.0, -1.0, 1.0) / jnp.sqrt(jnp.sum(turned * turned))
        return jnp.concatenate([y.p - held.p, 2.0 * turned[1:]])


class Pinned(End):
    """An end with a prescribed position that rotates without resistance: a ball joint."""

    kind: ClassVar[str] = "pinned"
    unknowns: ClassVar[tuple[str, ...]] = ("h", "n")
    conditions: ClassVar[tuple[tuple[Any, ...], ...]] = (_POSITION, _MOMENT)

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return the ball of the joint."""
        return (ball("joint", "ball joint", *self.joint(rod)),)

    def residual(self, held: Pose, y: Pose, n: Any, m: Any) -> Float[Any, " k"]:
        """Return the position error, and the residual of zero moment."""
        return jnp.concatenate([y.p - held.p, -m])


class Universal(Pinned):
    """A pinned tip that cannot spin about the rod: a universal joint, whose cross lies along two hinges.

    One hinge is e₁ of the held end, the other d₂ of the rod. The cross keeps them at right angles, e₁·d₂ = 0,
    and transmits a moment about e₁ × d₂ only. Both are exact, and regular in every admissible pose.
    """

    kind: ClassVar[str] = "universal"
    anywhere: ClassVar[bool] = False
    conditions: ClassVar[tuple[tuple[Any, ...], ...]] = (
        _POSITION,
        ("turn", 1, "rad", "rotation of the hinges out of their right angle"),
        ("m", 2, "N m", "moment at the tip about the hinges"),
    )

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return the cross of the two hinges."""
        place, radius = self.joint(rod)
        axes = 2.0 * radius * np.eye(3)[:2]
        return tuple(bar("joint", "hinge", place, axis, 0.5 * radius) for axis in axes)

    def residual(self, held: Pose, y: Pose, n: Any, m: Any) -> Float[Any, " k"]:
        """Return the position error, e₁·d₂, and the residual of zero moment about both."""
        fixed, turning = rotation_matrix(held.h)[:, 0], rotation_matrix(y.h)[:, 1]
        rows = [jnp.sum(fixed * turning), -jnp.sum(m * fixed), -jnp.sum(m * turning)]
        return jnp.concatenate([y.p - held.p, jnp.stack(rows)])


class Driven(Clamped):
    """A clamped end moved by the control: along global axes (m), and about them (rad)."""

    kind: ClassVar[str] = "driven"
    by_rates: ClassVar[bool] = True

    axes: tuple[str, ...] = choice("driven axes", AXES, ("z",))

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """One control for each driven axis."""
        fields = [Field(axis, 1, "m", f"displacement along {axis}") for axis in AXES[:3]]
        fields += [Field(axis, 1, "rad", f"rotation about {axis[1]}") for axis in AXES[3:]]
        return tuple(fields[AXES.index(axis)] for axis in self.axes)

    def place(self, rest: Pose, control: Any) -> Pose:
        """Return the clamped pose, rotated by the vector (rx, ry, rz) and displaced by (x, y, z)."""
        held = super().place(rest, control)
        places = np.zeros((6, len(self.axes)))
        places[[AXES.index(axis) for axis in self.axes], np.arange(len(self.axes))] = 1.0
        motion = jnp.sum(places * jnp.asarray(control), axis=1)
        return Pose(held.p + motion[:3], quaternion_product(quaternion_of(motion[3:]), held.h))


class Sliding(Driven):
    """A driven end at the tip that slides freely along a global axis, under the loads at the tip."""

    kind: ClassVar[str] = "sliding"
    anywhere: ClassVar[bool] = False
    conditions: ClassVar[tuple[tuple[Any, ...], ...]] = (
        ("p", 2, "m", "position at the tip across the axis, global frame"),
        ("n", 1, "N", "force at the tip along the axis"),
        _TURN,
    )

    along: str = choice("the global axis that it slides along", AXES[:3], "z")

    def shapes(self, rod: Any, at: Any, control: Any) -> tuple[Shape, ...]:
        """Return the rail that the end slides along."""
        place, radius = self.joint(rod)
        half = 0.2 * float(rod.length) * np.eye(3)[AXES.index(self.along)]
        return (bar("joint", "rail", place, half, 0.15 * radius, turns=False),)

    def __check_init__(self) -> None:
        if self.body:
            raise ParameterError(
                "an end on a body cannot slide; allowed is the ground, as it slides along a global axis"
            )

    def residual(self, held: Pose, y: Pose, n: Any, m: Any) -> Float[Any, " k"]:
        """Return the clamped residual, with zero force along the axis instead of the position along it."""
        rows, k = super().residual(held, y, n, m), AXES.index(self.along)
        across = [i for i in range(3) if i != k]
        return jnp.concatenate([jnp.stack([rows[i] for i in across]), -n[k : k + 1], rows[3:]])


class Moving(Clamped):
    """A base that is clamped to a moving body, such as the flange of an arm, whose motion is the control.

    Its position and orientation are stated in the frame of that body; an orientation control of zeros is
    upright. Controls are linear from row to row. The pose places the rod, and the velocities move it: a pose
    that a time scheme differentiates twice gives no accelerations. In an equilibrium, the body has constant
    velocities: with an angular velocity, it is a steady rotation.
    """

    kind: ClassVar[str] = "moving"
    at_tip: ClassVar[bool] = False

    def check(self, rod: Any) -> None:
        """Raise `ParameterError` unless this is the base of a rod, whose n and m are its wrench there."""
        effects = [part.kind for part in rod.effects if part.gyroscopic or part.kind == "insertion"]
        if self.body or rod.base_end is not self or effects:
            found = f"has {effects[0]}" if effects else f"is on {self.body!r}" if self.body else "is a tip"
            raise ParameterError(
                f"a moving end {found}; allowed is the base of a rod without body, spinning frame, insertion"
            )

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """Pose and velocities of the body."""
        return (
            Field("position", 3, "m", "position of the body, global frame"),
            Field("orientation", 4, "1", "orientation of the body, quaternion, scalar first", moves=True),
            Field("velocity", 3, "m/s", "velocity of the body's origin, global frame", moves=True),
            Field("angular_velocity", 3, "rad/s", "angular velocity of the body, global frame", moves=True),
        )

    def place(self, rest: Pose, control: Any) -> Pose:
        """Return the pose of the rod's base on the body."""
        p, h = jnp.asarray(control)[:3], jnp.asarray(control)[3:7]
        square = jnp.sum(h * h)
        h = jnp.where(square > 0.0, h, AT_ORIGIN.h) / jnp.sqrt(jnp.where(square > 0.0, square, 1.0))
        return Pose(p, h).then(super().place(AT_ORIGIN, control))

    def twist(self, held: Pose, control: Any) -> Float[Any, "6"]:
        """Return q and ω of the rod's base on the body."""
        p, v, w = (jnp.asarray(control)[part] for part in (slice(3), slice(7, 10), slice(10, 13)))
        R = rotation_matrix(held.h)
        return jnp.concatenate([dot(R.T, v + cross(w, held.p - p)), dot(R.T, w)])

    def contradiction(self, input: Any, dt: float) -> str:
        """Return a sentence on velocities that are not the rates of the pose, or signs of quaternions."""
        p, h, v, w = np.split(np.asarray(input), [3, 7, 10])
        before, after = h[..., :-1], h[..., 1:]
        if np.any(np.sum(before * after, axis=0) < 0.0):
            return "base_orientation changes its sign from row to row; allowed is the nearer of h and -h"
        turn = before[0] * after[1:] - after[0] * before[1:] + np.cross(before[1:], after[1:], axis=0)
        turn = 2.0 * turn / np.maximum(np.sum(before * before, axis=0), np.finfo(float).tiny)
        for name, moved, rate in ("velocity", np.diff(p), v), ("angular_velocity", turn, w):
            moves = dt * (rate[..., 1:] + rate[..., :-1]) / 2.0
            size = max(float(np.max(np.abs(each), initial=0.0)) for each in (moved, moves))
            off = float(np.max(np.abs(moved - moves), initial=0.0))
            if off > CONTRADICTION * size + ROUNDING:
                return (
                    f"base_{name} is off by up to {off / dt:.3g} from the rate of the pose; allowed are "
                    "those of one motion, such as kc.controls.base_motion(robot, controls, dt, position)"
                )
        return ""


def velocities(pose: Pose, pose_t: Pose) -> tuple[Any, Any]:
    """Return q and ω (material frame) of a pose whose rates are p_t and h_t."""
    h, h_t = pose.h, pose_t.h
    turning = quaternion_product(conjugate(h), h_t) / jnp.sum(h * h)
    return dot(rotation_matrix(h).T, pose_t.p), 2.0 * turning[1:]
