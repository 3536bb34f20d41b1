"""Shapes of parts, for figures and viewer: each is a line with a radius at each of its points.

A tube is a line with its outer radius, a disk a short line with a large one, and an arrow a line whose radius
grows and then shrinks to zero. A part states its shapes (`Contribution.shapes`) by points beside its rod; a
drawing of the system (`Drawing.shapes`) has the same shapes with positions in the global frame.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Look(NamedTuple):
    """Appearance of a kind of shape."""

    #: colour; None: the robot's
    colour: str | None
    opacity: float = 1.0
    #: what a checkbox of the viewer names it; "" is always drawn
    group: str = "parts"
    #: True if the value colours it, from pale to its colour
    is_ramp: bool = False


#: looks by kind, in the order in which they are drawn
LOOKS = {
    "fluid": Look("#7FB9E0", 0.45),
    "rod": Look(None, group=""),
    "tube": Look(None, group=""),
    "guide": Look(None, 0.28, "ribs"),
    "disk": Look("#8A94A6", 0.8, "ribs"),
    "mass": Look("#8A94A6", 0.95, "ribs"),
    "stretch": Look("#D55E00", is_ramp=True),
    "chamber": Look("#D55E00", is_ramp=True),
    "tendon": Look("#D1495B", group="tendons", is_ramp=True),
    "magnet": Look("#C8102E"),
    "field": Look("#6A3D9A"),
    "force": Look("#009E73"),
    "joint": Look("#444B57"),
}
#: ratio of a disk's radius to that of the circle of the tendons
RIM = 1.3
#: distance from the axis at which tendons without a route are drawn, in radii of the rod
BESIDE = 2.5
#: points of an arrow: places along it, and radii in those of its shaft
_ARROW, _ARROW_RADII = (0.0, 0.65, 0.6501, 1.0), (1.0, 1.0, 2.6, 0.02)


class Shape(NamedTuple):
    """A line of n points with a radius; of T rows where `at`, `offset` or `value` has them."""

    #: name in `LOOKS`
    kind: str
    #: name for a reader, such as "tube 2"
    name: str
    #: fractions of the grid at which the points are, (n,) or (T, n); None: `offset` has positions
    at: Any
    #: points (n, 3) or (T, n, 3) in m, from the rod's axis
    offset: Any
    #: radius in m, one number or (n,)
    radius: Any
    #: True if the points turn with the rod; otherwise they have the directions of the global frame
    turns: bool = True
    #: value (T,) or number that colours it, such as a pressure
    value: Any = None
    unit: str = ""
    #: part of white in its colour, to tell several of a kind apart
    shade: float = 0.0

    def placed(self, position: NDArray[np.float64], rotation: NDArray[np.float64]) -> Shape:
        """Return the shape with positions (T, n, 3), from those of the nodes (T, N, 3) and (T, N, 3, 3)."""
        rows, nodes = position.shape[:2]
        offset = np.asarray(self.offset, dtype=float)
        if self.at is None:
            return self._replace(offset=np.broadcast_to(offset, (rows, *offset.shape[-2:])))
        at = np.broadcast_to(np.asarray(self.at, dtype=float), (rows, offset.shape[-2])) * (nodes - 1)
        low = np.clip(np.floor(at + 1e-9).astype(int), 0, max(0, nodes - 2))
        high, row = np.minimum(low + 1, nodes - 1), np.arange(rows)[:, None]
        part = (at - low)[..., None]
        points = (1.0 - part) * position[row, low] + part * position[row, high]
        if not self.turns:
            return self._replace(at=None, offset=points + offset)
        part = part[..., None]
        turned = (1.0 - part) * rotation[row, low] + part * rotation[row, high]
        arms = np.einsum("...ij,...j->...i", turned, np.broadcast_to(offset, points.shape))
        return self._replace(at=None, offset=points + arms)


def arrow(kind: str, name: str, at: Any, tail: Any, head: Any, radius: float, **more: Any) -> Shape:
    """Return an arrow between two points (3,) or (T, 3) in m from the axis at one place of the rod."""
    tail, head = np.broadcast_arrays(np.asarray(tail, dtype=float), np.asarray(head, dtype=float))
    along = np.array(_ARROW)[:, None]
    points = (1.0 - along) * tail[..., None, :] + along * head[..., None, :]
    at = None if at is None else np.full(len(_ARROW), float(at))
    return Shape(kind, name, at, points, radius * np.array(_ARROW_RADII), **more)


def bar(kind: str, name: str, at: float, half: Any, radius: float, **more: Any) -> Shape:
    """Return a cylinder about a place of the rod, from -half to half (3,) in m: a hinge, or a disk."""
    half = np.asarray(half, dtype=float)
    return Shape(kind, name, np.full(2, float(at)), np.stack([-half, half]), radius, **more)


def disk(kind: str, name: str, at: float, radius: float, **more: Any) -> Shape:
    """Return a disk across the rod."""
    return bar(kind, name, at, [0.0, 0.0, 0.06 * radius], radius, **more)


def ball(kind: str, name: str, at: float, radius: float, **more: Any) -> Shape:
    """Return a ball on the rod's axis."""
    angle = np.linspace(0.0, np.pi, 9)
    points = np.zeros((9, 3))
    points[:, 2] = -radius * np.cos(angle)
    return Shape(kind, name, np.full(9, float(at)), points, np.maximum(radius * np.sin(angle), 1e-9), **more)


def nodes_between(at: NDArray[np.float64], begin: float, end: float) -> NDArray[np.float64]:
    """Return the fractions within a stretch, and its ends."""
    return np.unique(np.concatenate([[begin, end], at[(at > begin) & (at < end)]]))


def rim(rod: Any) -> float | None:
    """Return the radius (m) of disks that guide the tendons of a rod; None for a rod without tendons."""
    if not hasattr(rod, "routes_at"):
        return None
    radius, routed = float(rod.section.radius), tendon_routes(rod, np.linspace(0.0, 1.0, 9))
    return RIM * max(float(np.linalg.norm(routed, axis=-1).max()), 2.0 * radius)


def tendon_routes(rod: Any, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the places (tendons, n, 3) of tendons, in m from the rod's axis, at fractions of its length."""
    if rod.moment_arm is None and not float(rod.tendon_offset):
        rod = rod.replace(tendon_offset=BESIDE * float(rod.section.radius))
    routes = [np.asarray(rod.routes_at(s * rod.length)[0], dtype=float) for s in at]
    return np.stack([np.broadcast_to(each, (rod.tendon_count, 3)) for each in routes], axis=1)
