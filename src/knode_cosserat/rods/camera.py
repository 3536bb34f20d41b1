"""The camera, or motion capture, that measures a robot: its frame, and its marker at the tip."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Float

from knode_cosserat.rods.parameters import Doubt, parameter
from knode_cosserat.rods.parts import Part
from knode_cosserat.rotation import dot, quaternion_of, quaternion_product, rotation_matrix


class Camera(Part):
    """Frame and tip marker of what measures a robot; they do not change its motion.

    A point at p in the robot's frame is measured at C p + c, with the rotation C of the vector `rotation`,
    and c the `position`. Gravity stays with the robot. What is measured at the tip is `marker` beyond it.
    """

    kind: ClassVar[str] = "camera"

    rotation: Any = parameter(
        "rad",
        "rotation vector from the robot's frame to that of the measurements",
        shape="vector",
        low=-4.0,
        high=4.0,
        default=(0.0, 0.0, 0.0),
        doubt=Doubt(absolute=0.03),
    )
    position: Any = parameter(
        "m",
        "origin of the robot's frame in that of the measurements",
        shape="vector",
        low=-1e3,
        high=1e3,
        default=(0.0, 0.0, 0.0),
        doubt=Doubt(absolute=0.003),
    )
    marker: Any = parameter(
        "m",
        "marker of the tip beyond the tip, in the frame of the tip",
        shape="vector",
        low=-1.0,
        high=1.0,
        default=(0.0, 0.0, 0.0),
        doubt=Doubt(absolute=0.003),
    )

    def positions(self, p: Float[Any, "... M 3"], tip: Float[Any, "... 4"] | None) -> Float[Any, "... M 3"]:
        """Return measured positions from those in the robot's frame, the last that of the tip's marker.

        `tip` is the orientation there; None: the last place is not the tip, or has no orientation.
        """
        if tip is not None:
            turned = jnp.vectorize(lambda h: dot(rotation_matrix(h), self.marker), signature="(4)->(3)")(tip)
            p = jnp.concatenate([p[..., :-1, :], p[..., -1:, :] + turned[..., None, :]], axis=-2)
        turn = self.turn()
        return jnp.vectorize(lambda at: dot(turn, at), signature="(3)->(3)")(p) + self.position

    def turn(self) -> Float[Any, "3 3"]:
        """Return the matrix C of the rotation."""
        return rotation_matrix(quaternion_of(jnp.asarray(self.rotation)))

    def quaternions(self, h: Float[Any, "... 4"]) -> Float[Any, "... 4"]:
        """Return measured orientations from those in the robot's frame."""
        turn = quaternion_of(jnp.asarray(self.rotation))
        return jnp.vectorize(lambda own: quaternion_product(turn, own), signature="(4)->(4)")(h)
