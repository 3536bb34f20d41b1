"""Drawing of a robot's parts in a view: lines as wide as the parts are, at the scale of the axes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knode_cosserat.figures.drawing import View, one_of
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.shapes import LOOKS, Shape
from knode_cosserat.trajectory import Trajectory

#: colours of tubes, of a rod with chambers in it, and of a part whose control is zero
BODY, PALE_ROD, IDLE = "#0072B2", "#C3CCDA", "#E4D9D2"
#: narrowest line, narrowest of several tubes (points), and points of a ring
THIN, THIN_TUBE, RING = 0.7, 1.4, 33


def shapes_at(trajectory: Trajectory, rows: ArrayLike) -> list[Shape]:
    """Return the shapes of a trajectory's robot in these rows; none of a system that states no parts."""
    one, rows = one_of(trajectory), np.asarray(rows)
    return Drawing.of(one.system).shapes(np.asarray(one.y)[rows], np.asarray(one.control)[rows])


def draw_parts(view: View, shapes: list[Shape], colour: Any = None) -> list[Any]:
    """Add the parts to a view and return their artists, which show nothing before `move_parts`."""
    order = list(LOOKS)
    parts = []
    tubes = [float(np.max(shape.radius)) for shape in shapes if shape.kind == "tube"]
    for shape in shapes:
        artist = _wide_lines(view.flat)([], zorder=3.0 + 0.05 * order.index(shape.kind), capstyle="butt")
        artist.colour = colour
        artist.least = min(tubes) if shape.kind == "tube" else 0.0
        parts.append(view.axes.add_collection(artist))
    if not view.flat:
        view.axes.computed_zorder = False
    return parts


def move_parts(view: View, artists: list[Any], shapes: list[Shape], row: int) -> None:
    """Move the artists of `draw_parts` to the shapes of a row."""
    inside = {shape.kind for shape in shapes}
    for artist, shape in zip(artists, shapes, strict=True):
        points, radii = _line(shape, row)
        ends = np.moveaxis(view.of(points), 0, -1)
        # one line without seams, unless its width changes
        one = np.ndim(radii) == 0 or np.ptp(radii) == 0.0
        radii = np.max(radii) if one else radii
        # pieces of different widths overlap, so that no seam is seen
        pieces = np.stack([ends[:-1], ends[1:] + 0.4 * (ends[1:] - ends[:-1])], axis=1)
        pieces[-1, 1] = ends[-1]
        artist.set_segments([ends] if one else pieces if np.ptp(ends, axis=0).any() else [])
        artist.metres = radii
        artist.set_color(_colour(shape, row, artist.colour, "chamber" in inside))


def _line(shape: Shape, row: int) -> tuple[NDArray[np.float64], Any]:
    """Return the points (n, 3) of a shape in a row, and its segments' radii; a disk is a ring without one."""
    points = np.asarray(shape.offset, dtype=float)[row]
    axis = points[-1] - points[0]
    length, radius = float(np.linalg.norm(axis)), float(np.max(shape.radius))
    if len(points) == 2 and length < radius:
        across = np.linalg.svd(axis[None])[2][1:]
        turn = np.linspace(0.0, 2.0 * np.pi, RING)
        ring = np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1]
        return points.mean(axis=0) + radius * ring, 0.0
    radii = np.broadcast_to(np.asarray(shape.radius, dtype=float), len(points))
    kept = np.append(True, np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9 * max(length, 1e-9))
    if np.ptp(radii) > 0.0 and len(points) == 4:
        # the head of an arrow narrows in steps
        fine = np.append(np.linspace(0.0, 2.0, 3), np.linspace(2.0, 3.0, 9)[1:])
        nodes = np.arange(4.0)
        points = np.stack([np.interp(fine, nodes, each) for each in points.T], axis=-1)
        radii, kept = np.interp(fine, nodes, radii), np.ones(len(fine), dtype=bool)
    points, radii = points[kept], radii[kept]
    return points, 0.5 * (radii[1:] + radii[:-1])


def _colour(shape: Shape, row: int, colour: Any, open_rod: bool) -> Any:
    """Return the colour of a shape: that of its kind, paler by its shade, or by a small value."""
    from matplotlib.colors import to_rgb

    look = LOOKS[shape.kind]
    full = np.array(to_rgb(look.colour or (BODY if shape.kind == "tube" else colour) or BODY))
    if shape.kind == "rod" and open_rod:
        full = np.array(to_rgb(PALE_ROD))
    if shape.kind == "guide":
        return (*full, 0.35)
    if np.ndim(shape.value) == 1 and look.is_ramp:
        most = float(np.max(np.abs(shape.value))) or 1.0
        level = abs(float(shape.value[row])) / most
        full = level * full + (1.0 - level) * np.array(to_rgb(IDLE))
    pale = shape.shade if look.opacity == 1.0 or shape.kind in ("disk", "mass") else 1.0 - look.opacity
    return (1.0 - pale) * full + pale


_WIDE: dict[bool, Any] = {}


def _wide_lines(flat: bool) -> Any:
    """Return the class of collections of lines whose widths are radii in metres."""
    if flat not in _WIDE:
        from matplotlib.collections import LineCollection
        from mpl_toolkits.mplot3d.art3d import Line3DCollection

        class WideLines(LineCollection if flat else Line3DCollection):  # type: ignore[misc]
            """Lines with a radius (m) for each segment, or one."""

            metres: Any = 0.0
            colour: Any = None
            #: radius (m) of the thinnest of the tubes, which are all magnified until it is seen
            least: float = 0.0

            def draw(self, renderer: Any) -> None:
                scale = _scale(self.axes) * 72.0 / self.get_figure(root=True).dpi
                if self.least:
                    scale = max(scale, 0.5 * THIN_TUBE / self.least)
                points = 2.0 * np.asarray(self.metres) * scale
                self.set_linewidths(np.maximum(np.atleast_1d(points), THIN))
                super().draw(renderer)

        _WIDE[flat] = WideLines
    return _WIDE[flat]


def _scale(axes: Any) -> float:
    """Return the pixels of a metre at the centre of the axes."""
    if not hasattr(axes, "get_proj"):
        ends = axes.transData.transform([[0.0, 0.0], [1.0, 0.0]])
        return float(np.linalg.norm(ends[1] - ends[0]))
    from mpl_toolkits.mplot3d import proj3d

    limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
    centre, size = limits.mean(axis=1), 0.1 * np.ptp(limits, axis=1).max()
    points = np.vstack([centre, centre + size * np.eye(3)]).T
    x, y, _ = proj3d.proj_transform(*points, axes.get_proj())
    seen = axes.transData.transform(np.stack([x, y], axis=-1))
    # the squares of the lengths of three orthogonal metres add up to two in any parallel projection
    return float(np.sqrt(np.sum((seen[1:] - seen[0]) ** 2) / 2.0) / size)
