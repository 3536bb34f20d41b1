"""Views of robots in space or along an axis, with obstacles, and checks of the data to draw."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knode_cosserat.evaluation.drawing import (
    AXES,
    Tips,
    equal_scales,
    one_of,
    tips_of,
)
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.trajectory import Trajectory

#: views: in space, or two axes (horizontal, vertical)
VIEWS = ("xyz", "xy", "xz", "yz")
OBSTACLE = "#C8C8C8"
#: points along each axis of the grid that samples obstacles
_GRID = 240


class PathPoints(NamedTuple):
    """Tip positions without times, such as a desired path."""

    tip_position: NDArray[np.float64]


def by_label(given: Trajectory | Tips | Mapping[str, Any], what: str = "trajectories") -> dict[str, Any]:
    """Return trajectories by label; a single trajectory gets an empty label.

    Raises:
        ValueError: there is none.
        TypeError: a value has no tip positions.
    """
    found = dict(given) if isinstance(given, Mapping) else {"": given}
    if not found:
        raise ValueError(f"there are no {what} to draw; at least one is needed")
    for label, one in found.items():
        if not hasattr(one, "tip_position"):
            allowed = "a trajectory, or a dict of trajectories by their labels"
            named = f" {label!r}" if label else ""
            raise TypeError(f"{what}{named}: {type(one).__name__} given; allowed is {allowed}")
    return found


def by_values(lines: Mapping[str, ArrayLike], count: int) -> dict[str, Any]:
    """Return curves by label after checking their sizes."""
    found = {label: np.asarray(given, dtype=float) for label, given in lines.items()}
    if not found:
        raise ValueError("there are no curves to draw; at least one is needed")
    for label, given in found.items():
        if given.shape != (count,):
            raise ValueError(f"the curve {label!r} has shape {given.shape}; x has {count} values")
    return found


def path_of(one: Tips | ArrayLike) -> NDArray[np.float64]:
    """Return the tip positions (T, d) of a trajectory, or given points."""
    if hasattr(one, "tip_position"):
        tip: Any = one
        return tips_of(tip)
    try:
        points = np.asarray(one, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(
            f"a path is a {type(one).__name__}; allowed is a trajectory, or points (points, 3) in m"
        ) from None
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(
            f"a path has shape {points.shape}; allowed is (points, 3), or (points, 2) in a plane"
        )
    return points


def curves_of(trajectory: Trajectory) -> list[NDArray[np.float64]]:
    """Return the lines (T, points, d) of a trajectory's robot."""
    curves = Drawing.of(trajectory.system).curves(one_of(trajectory).y)
    return [np.asarray(curve, dtype=float) for curve in curves]


def valid_rows(curves: list[NDArray[np.float64]]) -> NDArray[np.intp]:
    """Return the indices of the solved rows.

    Raises:
        ValueError: no row is solved.
    """
    solved = np.all([np.isfinite(curve).all(axis=(1, 2)) for curve in curves], axis=0)
    if not solved.any():
        raise ValueError("the trajectory has no valid row to draw")
    return np.flatnonzero(solved)


def spread_rows(valid: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Return up to `count` evenly spaced rows of the valid ones.

    Raises:
        ValueError: `count` is less than one.
    """
    if count < 1:
        raise ValueError(f"count is {count!r}; allowed is a number of shapes from 1 on")
    return valid[np.unique(np.linspace(0, len(valid) - 1, count).round().astype(int))]


def checked_view(view: str | None, dimension: int) -> str:
    """Return the view after a check; the default is "xyz", or "xy" for a planar system."""
    if dimension == 2:
        if view not in (None, "xy"):
            raise ValueError(f'view is {view!r}; a system in a plane is seen from "xy" only')
        return "xy"
    view = "xyz" if view is None else view
    if view not in VIEWS:
        raise ValueError(f"view is {view!r}; allowed is {', '.join(VIEWS)}")
    return view


class View:
    """Axes of one view, and the projection of points onto them."""

    def __init__(self, figure: Any, place: Any, view: str) -> None:
        self.flat = len(view) == 2
        self.index = [AXES.index(name) for name in view]
        self.axes = figure.add_subplot(place, **({} if self.flat else {"projection": "3d"}))
        self.axes.set(**{f"{at}label": f"{name} [m]" for at, name in zip("xyz", view, strict=False)})

    def of(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the drawn coordinates of points (…, d): one array per axis."""
        return np.moveaxis(points[..., self.index], -1, 0)

    def frame(self, points: NDArray[np.float64], zoom: float = 0.95) -> None:
        """Set the limits around points (n, d), with equal scales on all axes."""
        points = points[np.isfinite(points).all(axis=1)]
        if not self.flat:
            equal_scales(self.axes, points[None], zoom)
            return
        shown = points[:, self.index]
        low, high = shown.min(axis=0), shown.max(axis=0)
        centre, half = (low + high) / 2, (high - low) / 2
        half = 1.08 * np.maximum(half, max(0.12 * half.max(), 1e-6))
        self.axes.set(xlim=(centre[0] - half[0], centre[0] + half[0]))
        self.axes.set(ylim=(centre[1] - half[1], centre[1] + half[1]), aspect="equal")
        if half[1] < 0.3 * half[0]:
            self.axes.locator_params(axis="y", nbins=3)

    def obstacles(self, trajectory: Trajectory, points: NDArray[np.float64]) -> None:
        """Draw obstacles cut at the robot's mean position; nothing is drawn in a 3D view."""
        around = getattr(trajectory.system, "surroundings", ())
        if not self.flat or not around:
            return
        import jax

        limits = (self.axes.get_xlim(), self.axes.get_ylim())
        spans = (np.linspace(low, high, _GRID) for low, high in limits)
        across, up = np.meshgrid(*spans)
        grid = np.broadcast_to(np.nanmean(points, axis=0), (across.size, points.shape[1])).copy()
        grid[:, self.index[0]], grid[:, self.index[1]] = across.ravel(), up.ravel()
        for obstacle in around:
            distance, _ = jax.vmap(obstacle.distance)(grid)
            depth = np.asarray(distance).reshape(across.shape)
            if depth.min() < 0.0:
                self.axes.contourf(across, up, depth, levels=[-1e9, 0.0], colors=[OBSTACLE], zorder=0)


def flat_height(points: NDArray[np.float64], view: str, width: float, beside: float) -> float:
    """Return the height (in) of a flat view, from its width less the width `beside` the axes (in)."""
    if len(view) == 3:
        return 0.8 * width
    span = np.nanmax(points, axis=0) - np.nanmin(points, axis=0)
    across, up = (span[AXES.index(name)] for name in view)
    shape = up / across if across > 0.0 else 4.0
    return float(np.clip((width - beside) * max(shape, 0.12) + 0.85, 1.6, 1.15 * width))
