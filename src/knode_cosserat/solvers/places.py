"""Poses at arbitrary places on the rod."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.camera import Camera
from knode_cosserat.rods.strands import strand_count
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendons import Markers
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.rotation import dot, rotation_matrix


class Places(NamedTuple):
    """M places: index of the node before each, and the part of the segment after it."""

    node: Int[Any, " M"]
    part: Float[Any, " M"]


def places_at(fractions: Float[Any, " M"], nodes: int) -> Places:
    """Return the places at fractions of the rod's length; fractions are clipped to [0, 1]."""
    xp: Any = np if isinstance(fractions, np.ndarray) else jnp
    along = xp.clip(fractions, 0.0, 1.0) * (nodes - 1)
    node = xp.clip(xp.ceil(along - 1e-9).astype(int) - 1, 0, nodes - 2)
    return Places(node, along - node)


def places_on(robot: System, fractions: Iterable[float]) -> Places:
    """Return the places of bodies on a robot: identified ones (`Markers`) in place of stated ones."""
    known: dict[float, Any] = {}
    for part in getattr(nominal_model(robot), "effects", ()):
        if isinstance(part, Markers):
            known |= zip(part.stated or (), part.at, strict=True)
    along = [known.get(float(it), it) for it in fractions]
    return places_at(jnp.stack(along) if known else np.array(along), robot.nodes)


def seen_positions(
    robot: System, y: Float[Any, "T N y"], fractions: Sequence[float], z: Float[Any, "T N z"] | None = None
) -> Float[Any, "T M d"]:
    """Return the positions (m) of bodies as the robot's `Camera` measures them, if it states one."""
    places, drawing = places_on(robot, fractions), Drawing.of(robot)
    p, camera = positions_at(robot, y, places, z), camera_of(robot)
    if camera is None:
        return p
    tip = None
    if len(fractions) and fractions[-1] == 1.0:
        with contextlib.suppress(AttributeError):
            tip = drawing.attached(y[..., -1, :])
    return camera.positions(jnp.asarray(p), tip)


def seen_quaternions(
    robot: System, y: Float[Any, "T N y"], fractions: Sequence[float]
) -> Float[Any, "T M 4"]:
    """Return the orientations of bodies in the frame of the robot's `Camera`, if it states one."""
    h, camera = quaternions_at(robot, y, places_on(robot, fractions)), camera_of(robot)
    return h if camera is None else camera.quaternions(h)


def camera_of(robot: System) -> Camera | None:
    """Return the camera that a robot, or the nominal model of a learned one, states."""
    return getattr(nominal_model(robot), "camera", None)


def without_camera(robot: System) -> System:
    """Return a robot of which positions and orientations are measured in its own frame."""
    return robot if camera_of(robot) is None else robot.replace(camera=None)


class OwnFrame(NamedTuple):
    """Transformation of measured positions of the tip (m) to the tip in the robot's own frame."""

    turn: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    @classmethod
    def of(cls, robot: System) -> OwnFrame:
        """Return the inverse of the robot's `Camera`; the marker is where it is on the unstressed robot."""
        camera, shift = camera_of(robot), np.zeros(3)
        if camera is None:
            return cls(np.eye(3), shift)
        with contextlib.suppress(AttributeError):
            h = Drawing.of(robot).attached(robot.rest(jnp.asarray(robot.length))[0])
            shift = np.asarray(rotation_matrix(h)) @ np.asarray(camera.marker)
        turn = np.asarray(camera.turn()).T
        return cls(turn, -turn @ np.asarray(camera.position) - shift)

    def tip(self, measured: Float[Any, " p"]) -> Float[np.ndarray, "3"]:
        """Return the tip (m) in the robot's frame; NaN for coordinates on which a lost number bears."""
        parts = self.turn * np.asarray(measured, dtype=float)[:3]
        return np.where(self.turn == 0.0, 0.0, parts).sum(axis=1) + self.shift


def positions_at(
    robot: System, y: Float[Any, "T N y"], places: Places, z: Float[Any, "T N z"] | None = None
) -> Float[Any, "T M 3"]:
    """Return positions (m); between nodes by cubic Hermite interpolation of positions and tangents.

    Linear interpolation on a bent rod has an error of order 2. Tangents are p_s = R v. With v from the
    strains `z` the error is of order 4. Without `z`, v is the value at rest, which neglects stretch and
    shear. A system without orientations, or with several rods, has no tangents: there interpolation is
    linear.
    """
    low, high = (Drawing.of(robot).positions(y[..., places.node + k, :]) for k in (0, 1))
    part = places.part[:, None]
    line = (1.0 - part) * low + part * high
    known = {"p", "h"} <= set(robot.y_layout.names) and "v" in robot.z_layout.names
    if not known or strand_count(robot) > 1:
        return line
    step = robot.length / (robot.nodes - 1)
    left, right = (step * _tangents(robot, y, z, places.node + k) for k in (0, 1))
    chord = high - low
    return line + part * (1.0 - part) * ((1.0 - part) * (left - chord) - part * (right - chord))


def _tangents(robot: System, y: Any, z: Any, nodes: Any) -> Float[Any, "T M 3"]:
    """Return p_s = R v at nodes."""
    h = Drawing.of(robot).quaternions(y[..., nodes, :])
    if z is None:
        v = robot.z_layout.get(robot.rest(jnp.zeros(()))[1], "v")
    else:
        v = robot.z_layout.get(z[..., nodes, :], "v")
    return jnp.vectorize(lambda h, v: dot(rotation_matrix(h), v), signature="(4),(3)->(3)")(h, v)


def quaternions_at(robot: System, y: Float[Any, "T N y"], places: Places) -> Float[Any, "T M 4"]:
    """Return unit quaternions, scalar first; between nodes by normalised linear interpolation."""
    low, high = (Drawing.of(robot).quaternions(y[..., places.node + k, :]) for k in (0, 1))
    same = jnp.sum(low * high, axis=-1, keepdims=True) >= 0.0
    part = places.part[:, None]
    h = (1.0 - part) * low + part * jnp.where(same, high, -high)
    return h / jnp.sqrt(jnp.sum(h * h, axis=-1, keepdims=True))
