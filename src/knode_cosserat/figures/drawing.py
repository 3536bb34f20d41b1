"""Drawing functions and views shared by the figures, and checks of the data to draw; they need matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knode_cosserat.controls import labels, titles
from knode_cosserat.figures.style import DASHES, PALETTE
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.layout import Layout
from knode_cosserat.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

AXES = ("x", "y", "z")
#: views: in space, or two axes (horizontal, vertical)
VIEWS = ("xyz", "xy", "xz", "yz")
OBSTACLE = "#C8C8C8"
#: points along each axis of the grid that samples obstacles
_GRID = 240


class Tips(Protocol):
    """Protocol of data with tip positions over time: a trajectory, or a recording."""

    @property
    def time(self) -> ArrayLike:
        """Times (T,) in s."""

    @property
    def tip_position(self) -> ArrayLike:
        """Tip positions (T, 3) in m."""


def equal_scales(axes: Any, points: NDArray[np.float64], zoom: float = 0.95) -> None:
    """Set equal scales on all axes of a 3D plot, with a minimum depth of thin boxes."""
    from matplotlib.ticker import MaxNLocator

    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    centre, half = (low + high) / 2, (high - low) / 2
    half = 1.05 * np.maximum(half, 0.55 * half.max())
    axes.set(**{f"{name}lim": (c - h, c + h) for name, c, h in zip(AXES, centre, half, strict=True)})
    axes.set_box_aspect(tuple(half), zoom=zoom)
    beside = axes.get_subplotspec().get_gridspec().ncols
    inches = axes.get_figure(root=False).bbox.width / axes.get_figure(root=True).dpi / beside
    small = inches < 4.5
    pads = (("x", 4.0, -2.0 * small), ("y", 7.0, -2.0 * small), ("z", 9.5, 3.0))
    steps = 3 if small else 4
    for (name, label_pad, tick_pad), c, h in zip(pads, centre, half, strict=True):
        axis = getattr(axes, f"{name}axis")
        # no ticks near the ends, where labels of two axes collide; but at least two, for a scale
        for most in range(steps, steps + 4):
            ticks = [tick for tick in MaxNLocator(most).tick_values(c - h, c + h) if abs(tick - c) < 0.75 * h]
            if len(ticks) > 1:
                break
        axis.set_ticks(ticks)
        axis.labelpad = label_pad - 7.0 * small
        axes.tick_params(axis=name, pad=tick_pad)


def draw_tips(
    axes: Any,
    paths: Mapping[str, tuple[ArrayLike, NDArray[np.float64]]],
    looks: Mapping[str, Mapping[str, Any]] | None = None,
) -> None:
    """Draw x, y and z of paths over time, one below the other; a path is times and positions."""
    for i, (label, (time, tip)) in enumerate(paths.items()):
        look = looks[label] if looks else line(i, np.size(time))
        for axis, each in enumerate(axes):
            each.plot(time, tip[:, axis], label=label, **look)
    farthest = max((np.nanmax(np.abs(tip), initial=0.0) for _, tip in paths.values()), default=0.0)
    for name, each in zip(AXES, axes, strict=False):
        each.set_ylabel(f"tip {name} [m]")
        require_span(each, 0.01 * farthest)
    axes[-1].set_xlabel("time [s]")


def require_span(axes: Axes, span: float) -> None:
    """Widen the y axis to a minimum span, so that rounding errors do not look like a motion."""
    low, high = axes.get_ylim()
    if high - low < span:
        axes.set_ylim((low + high - span) / 2, (low + high + span) / 2)


def control_words(layout: Layout) -> tuple[list[str], str]:
    """Return the name of every control, and the title of their axis.

    The unit of all is in the title, such as `pressure [Pa]`; those that differ are beside the names.
    """
    fields, units = layout.fields, {field.unit for field in layout.fields}
    name = fields[0].name if len(fields) == 1 else "control"
    names = labels(layout) if len(units) == 1 else titles(layout)
    title = f"{name} [{units.pop()}]" if len(units) == 1 else name
    return [each.replace("_", " ") for each in names], title.replace("_", " ")


def draw_tensions(axes: Axes, trajectory: Trajectory) -> None:
    """Draw the tension of every tendon, held from row to row, or the controls of other robots."""
    values, layout = np.asarray(one_of(trajectory).control), trajectory.system.control_layout
    if "tension" in layout.names:
        values = layout.get(values, "tension")
        layout = Layout(*(field for field in layout.fields if field.name == "tension"))
    names, label = control_words(layout)
    time = np.asarray(trajectory.time)
    for k in range(values.shape[1]):
        # decreasing widths, so that equal tensions all remain visible
        width = max(0.7, 2.4 - 0.55 * k)
        style: dict[str, Any] = {"label": names[k], "color": PALETTE[k % len(PALETTE)], "linewidth": width}
        if len(time) == 1:
            axes.plot(time, values[:, k], "o", markersize=4.0 * width, **style)
        else:
            # row i has the control held from row i - 1 to row i
            axes.stairs(values[1:, k], time, baseline=None, **style)
    axes.set(xlabel="time [s]", ylabel=label)
    axes.margins(y=0.1)
    if values.shape[1]:
        legend_above(axes)


def line(i: int, rows: int = 2) -> dict[str, Any]:
    """Return the style of the i-th trajectory: a line, or a point if it has one row."""
    kind = {"linestyle": DASHES[i % len(DASHES)]} if rows > 1 else {"linestyle": "none", "marker": "o"}
    return {"color": PALETTE[i % len(PALETTE)], **kind}


def legend_above(axes: Axes) -> None:
    """Add a legend above the axes; long labels get two columns, others four."""
    _, words = axes.get_legend_handles_labels()
    columns = 2 if len(words) > 4 and max(map(len, words)) > 10 else 4
    axes.legend(
        loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=columns, columnspacing=1.2, handlelength=1.8
    )


def tips_of(trajectory: Tips) -> NDArray[np.float64]:
    """Return the tip positions (T, 3)."""
    if isinstance(trajectory, Trajectory):
        one_of(trajectory)
    return np.asarray(trajectory.tip_position, dtype=float)


def one_of(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory after checking that it is a trajectory of one robot."""
    if not isinstance(trajectory, Trajectory):
        raise TypeError(f"trajectory is a {type(trajectory).__name__}; allowed is a Trajectory")
    if np.ndim(trajectory.y) == 4:
        raise ValueError(
            f"a batch of {len(trajectory.y)} trajectories cannot be drawn in one figure; index one, batch[0]"
        )
    return trajectory


# views


def by_label(
    trajectories: Trajectory | Tips | Mapping[str, Any], what: str = "trajectories"
) -> dict[str, Any]:
    """Return trajectories by label; a single trajectory gets an empty label.

    Raises `ValueError` if there is none, and `TypeError` if a value has no tip positions.
    """
    labelled = dict(trajectories) if isinstance(trajectories, Mapping) else {"": trajectories}
    if not labelled:
        raise ValueError(f"there are no {what} to draw; at least one is needed")
    for label, one in labelled.items():
        if not hasattr(one, "tip_position"):
            allowed = "a trajectory, or a dict of trajectories by their labels"
            named = f" {label!r}" if label else ""
            raise TypeError(f"{what}{named}: {type(one).__name__} given; allowed is {allowed}")
    return labelled


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
