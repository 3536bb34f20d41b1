"""What holds a rod at its two ends.

At its base an end says what y is there, given what it leaves unknown; at its tip, what is left of its
conditions. An end that is held has a pose: at the base (0, 0, 0) and upright unless it is given, at the tip
by default the one that the rod has there while it is straight. A robot whose tip is held starts at its
equilibrium.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.parameters import choice, parameter
from knode_cosserat.rods.parts import Part
from knode_cosserat.rotation import conjugate, dot, quaternion_of, quaternion_product, rotation_matrix

#: where an end may be moved by control: along a global axis, or about one
AXES = ("x", "y", "z", "rx", "ry", "rz")

_POSITION = ("p", 3, "m", "position at the tip, global frame")
_TURN = ("turn", 3, "rad", "rotation at the tip, from where it is held")
_FORCE = ("n", 3, "N", "force at the tip, global frame", "h", "N")
_MOMENT = ("m", 3, "N m", "moment at the tip, global frame", "h", "N m")


class Pose(NamedTuple):
    """Position (m) and orientation (quaternion, scalar first)."""

    p: Float[Any, "3"]
    h: Float[Any, "4"]


class End(Part):
    """An end of a rod, of its base or of its tip."""

    #: what of p, h, n, m is unknown where this end is the rod's base; the rest is given
    unknowns: ClassVar[tuple[str, ...]]
    #: whether anything holds it in its place
    held: ClassVar[bool] = True
    #: whether it can be a rod's base as well as its tip
    anywhere: ClassVar[bool] = True
    #: of the tip's conditions: names, sizes, units
    conditions: ClassVar[tuple[tuple[Any, ...], ...]]

    position: Any = parameter(
        "m", "where the end is held, global frame", shape="vector", low=-1e3, high=1e3, default=None
    )
    orientation: Any = parameter(
        "1", "how the end is held: a quaternion", shape="quaternion", low=-1e3, high=1e3, default=None
    )

    def pose(self, rest: Pose, control: Any) -> Pose:
        """Where the end is held; as at rest where nothing else is given."""
        p = rest.p if self.position is None else self.position
        h = rest.h if self.orientation is None else self.orientation
        return Pose(jnp.asarray(p), jnp.asarray(h) / jnp.sqrt(jnp.sum(jnp.asarray(h) ** 2)))

    @abc.abstractmethod
    def left(self, held: Pose, y: Pose, n: Any, m: Any) -> Float[Any, " k"]:
        """What is left of the tip's conditions: poses, and n and m less what loads the tip there."""


class Free(End):
    """An end that nothing holds."""

    kind: ClassVar[str] = "free"
    unknowns: ClassVar[tuple[str, ...]] = ("p", "h")
    held: ClassVar[bool] = False
    conditions: ClassVar[tuple[tuple[Any, ...], ...]] = (_FORCE, _MOMENT)

    def left(self, held: Pose, y: Pose, n: Any, m: Any) -> Float[Any, " k"]:
        """No force and no moment."""
        return jnp.concatenate([-n, -m])


class Clamped(End):
    """An end whose position and orientation are held."""

    kind: ClassVar[str] = "clamped"
    unknowns: ClassVar[tuple[str, ...]] = ("n", "m")
    conditions: ClassVar[tuple[tuple[Any, ...], ...]] = (_POSITION, _TURN)

    def left(self, held: Pose, y: Pose, n: Any, m: Any) -> Float[Any, " k"]:
        """Position, and twice the vector part of the rotation that is left."""
        turned = quaternion_product(conjugate(held.h), y.h)
        turned = turned * jnp.where(turned[0] < 0.0, -1.0, 1.0) / jnp.sqrt(jnp.sum(turned * turned))
        return jnp.concatenate([y.p - held.p, 2.0 * turned[1:]])


class Pinned(End):
    """An end whose position is held, and that turns without resistance: a ball joint."""

    kind: ClassVar[str] = "pinned"
    unknowns: ClassVar[tuple[str, ...]] = ("h", "n")
    conditions: ClassVar[tuple[tuple[Any, ...], ...]] = (_POSITION, _MOMENT)

    def left(self, held: Pose, y: Pose, n: Any, m: Any) -> Float[Any, " k"]:
        """Position, and no moment."""
        return jnp.concatenate([y.p - held.p, -m])


class Driven(Clamped):
    """A clamped end that the control moves: along global axes (m), and about them (rad)."""

    kind: ClassVar[str] = "driven"

    axes: tuple[str, ...] = choice("what is driven, of", AXES, ("z",))

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """One number for each axis."""
        return tuple(
            Field(axis, 1, "rad", f"rotation about {axis[1]}")
            if axis.startswith("r")
            else Field(axis, 1, "m", f"displacement along {axis}")
            for axis in self.axes
        )

    def pose(self, rest: Pose, control: Any) -> Pose:
        """Moved from where it would be held: rotated by the vector (rx, ry, rz), displaced by (x, y, z)."""
        held = super().pose(rest, control)
        places = np.zeros((6, len(self.axes)))
        places[[AXES.index(axis) for axis in self.axes], np.arange(len(self.axes))] = 1.0
        motion = jnp.sum(places * jnp.asarray(control), axis=1)
        return Pose(held.p + motion[:3], quaternion_product(quaternion_of(motion[3:]), held.h))


class Sliding(Driven):
    """A driven end at the tip that slides freely along a global axis, under whatever pulls it there."""

    kind: ClassVar[str] = "sliding"
    anywhere: ClassVar[bool] = False
    conditions: ClassVar[tuple[tuple[Any, ...], ...]] = (
        ("p", 2, "m", "position at the tip across the axis, global frame"),
        ("n", 1, "N", "force at the tip along the axis"),
        _TURN,
    )

    along: str = choice("the global axis that it slides along", AXES[:3], "z")

    def left(self, held: Pose, y: Pose, n: Any, m: Any) -> Float[Any, " k"]:
        """As clamped, but with no force along the axis instead of a place on it."""
        left, k = super().left(held, y, n, m), AXES.index(self.along)
        across = [i for i in range(3) if i != k]
        return jnp.concatenate([jnp.stack([left[i] for i in across]), -n[k : k + 1], left[3:]])


def velocities(pose: Pose, pose_t: Pose) -> tuple[Any, Any]:
    """q and ω (material frame) of what is at a pose, whose rates are p_t and h_t."""
    h, h_t = pose.h, pose_t.h
    turning = quaternion_product(conjugate(h), h_t) / jnp.sum(h * h)
    return dot(rotation_matrix(h).T, pose_t.p), 2.0 * turning[1:]
