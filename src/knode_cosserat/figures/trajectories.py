"""Figures of trajectories, batches, modes, workspaces and closed loops."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knode_cosserat._arguments import check_arguments
from knode_cosserat.figures.comparison import REFERENCE
from knode_cosserat.figures.drawing import (
    AXES,
    Tips,
    View,
    by_label,
    checked_view,
    control_words,
    curves_of,
    draw_tensions,
    draw_tips,
    flat_height,
    legend_above,
    line,
    one_of,
    path_of,
    require_span,
    spread_rows,
    tips_of,
    valid_rows,
)
from knode_cosserat.figures.parts import draw_parts, move_parts, shapes_at
from knode_cosserat.figures.style import (
    PALETTE,
    TIME_COLOURS,
    TWO_COLUMNS,
    new_figure,
    require_matplotlib,
    width_of,
)
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from knode_cosserat.control import LoopLog
    from knode_cosserat.statics.modes import Modes
    from knode_cosserat.statics.workspace import Workspace

#: default fields of `states`, if the system has them
FIELDS = ("q", "w", "n", "m", "v", "u")
#: largest displacement of a drawn mode, as a part of the extent of the robot
SWING = 0.25
#: largest number of drawn points of a workspace: more only make the file larger
MOST_POINTS = 100_000


def shape(trajectory: Trajectory, *, count: int = 12, view: str | None = None, columns: int = 1) -> Figure:
    """Return a figure of the robot at `count` evenly spaced times, coloured by time, and its tip path.

    Its parts, such as tubes, chambers, tendons and magnets, are drawn at the last of these times.
    The view is in space ("xyz"), or along an axis: "xy", "xz", "yz". Views along an axis show obstacles too.
    """
    check_arguments(shape, locals())
    curves = curves_of(one_of(trajectory))
    view = checked_view(view, curves[0].shape[-1])
    points = np.concatenate([curve.reshape(-1, curve.shape[-1]) for curve in curves])
    width = width_of(columns)
    height = flat_height(points, view, width, 1.2 if len(trajectory.time) > 1 else 0.6)
    with new_figure(width, height if len(view) == 2 else 0.85 * width) as figure:
        draw_motion(figure, trajectory, count, view)
    return figure


def draw_motion(figure: Any, trajectory: Trajectory, count: int, view: str) -> None:
    """Draw shapes at evenly spaced times, the parts at the last of them, and the path of the tip."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    curves, time, path = curves_of(trajectory), np.asarray(trajectory.time), tips_of(trajectory)
    valid = valid_rows(curves)
    seen = View(figure, 111, view)
    colours = ScalarMappable(Normalize(time[0], time[-1]), TIME_COLOURS)
    shown = spread_rows(valid, count)
    for row in shown:
        for curve in curves:
            seen.axes.plot(
                *seen.of(curve[row]), color=colours.to_rgba(time[row]), linewidth=1.6, solid_capstyle="round"
            )
    parts = shapes_at(trajectory, shown)
    artists = draw_parts(seen, parts, colours.to_rgba(time[shown[-1]]))
    move_parts(seen, artists, parts, len(shown) - 1)
    label = "path of the tip" if len(time) > 1 else None
    seen.axes.plot(*seen.of(path), color="#777777", linewidth=0.8, label=label)
    bases = np.stack([curve[shown[0], 0] for curve in curves[: max(1, len(curves) - 1)]])
    seen.axes.plot(*seen.of(bases), "s", color="#333333", markersize=3.5, linestyle="none", label="base")
    points = np.concatenate([curve[valid].reshape(-1, curve.shape[-1]) for curve in curves])
    seen.frame(points, zoom=0.82)
    seen.obstacles(trajectory, points)
    if seen.flat:
        legend_above(seen.axes)
    else:
        seen.axes.legend(loc="upper left", borderaxespad=0.0)
    if len(time) > 1:
        looks = {"pad": 0.02} if seen.flat else {"shrink": 0.55, "pad": 0.1}
        figure.colorbar(colours, ax=seen.axes, label="time [s]", **looks)


def path(
    trajectories: Tips | Mapping[str, Tips | ArrayLike], *, view: str | None = None, columns: int = 1
) -> Figure:
    """Return a figure of tip paths in space ("xyz") or along an axis ("xy", "xz", "yz").

    Paths may also be arrays (points, 3) in m. A path whose label begins with "wanted" is drawn wide and pale.
    """
    check_arguments(path, locals())
    motions = dict(trajectories) if isinstance(trajectories, Mapping) else {"": trajectories}
    if not motions:
        raise ValueError("there are no trajectories to draw; at least one is needed")
    paths = {label: path_of(one) for label, one in motions.items()}
    points = np.concatenate(list(paths.values()))
    view, width = checked_view(view, points.shape[1]), width_of(columns)
    height = flat_height(points, view, width, 0.8)
    with new_figure(width, height + 0.25 if len(view) == 2 else 0.9 * width) as figure:
        seen = View(figure, 111, view)
        for i, (label, tip) in enumerate(paths.items()):
            look = {**line(i), "label": label or None}
            if label.startswith("wanted"):
                look |= {"color": "#AAAAAA", "linewidth": 4.0, "linestyle": "-"}
            seen.axes.plot(*seen.of(tip), **look)
        seen.frame(points, zoom=0.8)
        if any(paths):
            legend_above(seen.axes)
    return figure


def tips(trajectories: Tips | Mapping[str, Tips], *, columns: int = 1) -> Figure:
    """Return a figure of x, y and z of the tips over time, of trajectories or recordings."""
    check_arguments(tips, locals())
    motions = by_label(trajectories)
    paths = {label: (one.time, tips_of(one)) for label, one in motions.items()}
    size = min(tip.shape[1] for _, tip in paths.values())
    with new_figure(width_of(columns), 0.4 + 1.15 * size) as figure:
        axes = figure.subplots(size, 1, sharex=True, squeeze=False)[:, 0]
        draw_tips(axes, paths)
        figure.align_ylabels()
        if any(paths):
            legend_above(axes[0])
    return figure


def states(
    trajectories: Trajectory | Mapping[str, Trajectory],
    fields: Sequence[str] | None = None,
    *,
    node: int = -1,
    columns: int = 2,
) -> Figure:
    """Return a figure of the state's fields at one node over time: a panel per field, a colour per component.

    `fields` are names of y, z or the controls (`Trajectory.part`); by default velocities, loads and strains.
    Several trajectories differ by their dashes.

    Raises:
        KeyError: a field does not exist.
        ValueError: the node does not exist.
    """
    check_arguments(states, locals())
    motions = by_label(trajectories)
    first = one_of(next(iter(motions.values())))
    layouts = (first.system.y_layout, first.system.z_layout, first.system.control_layout)
    known = {field.name: field for layout in layouts for field in layout.fields}
    names = [name for name in FIELDS if name in known] if fields is None else list(fields)
    names = names or list(known)
    # `part` also accepts fields of several rods together, which one panel cannot show
    for name in set(names) - set(known):
        raise KeyError(f"no field {name!r}; there are {', '.join(known)}")
    if not -first.y.shape[1] <= node < first.y.shape[1]:
        raise ValueError(f"node is {node}; the trajectory has {first.y.shape[1]} nodes")
    across = min(columns, 2, len(names))
    rows = -(-len(names) // across)
    with new_figure(width_of(columns), 0.5 + 1.5 * rows) as figure:
        grid = figure.subplots(rows, across, sharex=True, squeeze=False).ravel()
        for axes, name in zip(grid, names, strict=False):
            for i, (label, one) in enumerate(motions.items()):
                values = np.asarray(one_of(one).part(name))
                values = values[:, node] if values.ndim == 3 else values
                for k in range(values.shape[1]):
                    colour = PALETTE[k % len(PALETTE)]
                    component = AXES[k] if values.shape[1] == 3 else f"{k + 1}"
                    said = f"{component}, {label}" if label else component
                    axes.plot(one.time, values[:, k], **{**line(i), "color": colour}, label=said)
            sizes = [np.nanmax(np.abs(np.asarray(one.part(name))), initial=0.0) for one in motions.values()]
            require_span(axes, 0.01 * max(sizes))
            unit = f" [{known[name].unit}]" if known[name].unit else ""
            axes.set(ylabel=f"{name}{unit}", title=known[name].meaning)
        for axes in grid[len(names) :]:
            axes.remove()
        for axes in grid[max(0, len(names) - across) : len(names)]:
            axes.set_xlabel("time [s]")
            axes.tick_params(labelbottom=True)
        figure.align_ylabels()
        handles, labels = grid[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=6 if columns == 2 else 3)
    return figure


def error(truth: Tips, predictions: Tips | Mapping[str, Tips], *, columns: int = 1) -> Figure:
    """Return a figure of the distance of predicted tips from the true tip over time, on a log scale.

    Raises:
        ValueError: a prediction's rows differ from the truth's.
    """
    check_arguments(error, locals())
    motions, true = by_label(predictions, "predictions"), tips_of(truth)
    with new_figure(width_of(columns), 2.4) as figure:
        axes = figure.subplots()
        for i, (label, one) in enumerate(motions.items()):
            tip = tips_of(one)
            if tip.shape != true.shape or not np.allclose(one.time, truth.time, rtol=0.0, atol=1e-9):
                raise ValueError(
                    f"the prediction{f' {label!r}' if label else ''} has {len(tip)} rows and the truth "
                    f"{len(true)}; both must have the same times"
                )
            distance = np.linalg.norm(tip - true, axis=1)
            # the initial distance may be zero, which a logarithmic axis cannot show
            axes.plot(truth.time, np.where(distance > 0.0, distance, np.nan), label=label or None, **line(i))
        axes.set(xlabel="time [s]", ylabel="distance of the tips [m]", yscale="log")
        axes.margins(x=0.02)
        if any(motions):
            legend_above(axes)
    return figure


def tensions(trajectory: Trajectory, *, columns: int = 1) -> Figure:
    """Return a figure of every tendon's tension over time, held from row to row; or of the controls."""
    check_arguments(tensions, locals())
    one_of(trajectory)
    with new_figure(width_of(columns), 2.4) as figure:
        draw_tensions(figure.subplots(), trajectory)
    return figure


def overview(trajectory: Trajectory, count: int = 12) -> Figure:
    """Return one figure of shapes, tip path and tensions of a trajectory, two columns wide."""
    check_arguments(overview, locals())
    curves = curves_of(one_of(trajectory))
    with new_figure(TWO_COLUMNS, 4.2) as figure:
        left, right = figure.subfigures(1, 2, width_ratios=(1.1, 1.0))
        draw_motion(left, trajectory, count, checked_view(None, curves[0].shape[-1]))
        size = curves[0].shape[-1]
        axes = right.subplots(size + 1, 1, sharex=True, height_ratios=(*[1.0] * size, 1.5))
        draw_tips(axes[:size], {"": (trajectory.time, tips_of(trajectory))})
        axes[size - 1].set_xlabel("")
        draw_tensions(axes[size], trajectory)
        right.align_ylabels()
    return figure


def spread(batch: Trajectory, *, columns: int = 1) -> Figure:
    """Return a figure of a batch's tips over time: the median, the band of 90 % and the full range.

    Raises:
        ValueError: the trajectory is not a batch.
    """
    check_arguments(spread, locals())
    if np.ndim(batch.y) != 4:
        raise ValueError("the trajectory is of one robot; allowed is a batch")
    tip = np.asarray(batch.tip_position)
    with new_figure(width_of(columns), 0.4 + 1.15 * tip.shape[2]) as figure:
        rows = figure.subplots(tip.shape[2], 1, sharex=True, squeeze=False)[:, 0]
        for k, axes in enumerate(rows):
            for (low, high), strength, label in (((0, 100), 0.18, "all"), ((5, 95), 0.4, "nine tenths")):
                edges = np.nanpercentile(tip[:, :, k], [low, high], axis=0)
                axes.fill_between(
                    batch.time, *edges, color=PALETTE[0], alpha=strength, linewidth=0, label=label
                )
            axes.plot(batch.time, np.nanmedian(tip[:, :, k], axis=0), color=PALETTE[-1], label="median")
            axes.set_ylabel(f"tip {AXES[k]} [m]")
            require_span(axes, 0.01 * float(np.nanmax(np.abs(tip))))
        rows[-1].set_xlabel("time [s]")
        figure.align_ylabels()
        legend_above(rows[0])
    return figure


def curves(
    x: ArrayLike,
    lines: Mapping[str, ArrayLike],
    xlabel: str,
    ylabel: str,
    *,
    log: str = "",
    marker: str = "",
    columns: int = 1,
) -> Figure:
    """Return a figure of curves over x by label; `log` names the logarithmic axes ("", "x", "y" or "xy").

    Raises:
        ValueError: a curve's number of values differs from x's, or `log` is not allowed.
    """
    check_arguments(curves, locals())
    if log not in ("", "x", "y", "xy"):
        raise ValueError(f"log is {log!r}; allowed is '', 'x', 'y' or 'xy'")
    at = np.asarray(x, dtype=float)
    if not lines:
        raise ValueError("there are no curves to draw; at least one is needed")
    for label, values in lines.items():
        if np.shape(values) != at.shape:
            raise ValueError(f"the curve {label!r} has shape {np.shape(values)}; x has {len(at)} values")
    with new_figure(width_of(columns), 2.4) as figure:
        axes = figure.subplots()
        for i, (label, values) in enumerate(lines.items()):
            look = {**line(i), "marker": marker or None, "label": label or None}
            axes.plot(at, np.asarray(values, dtype=float), **look)
        axes.set(xlabel=xlabel, ylabel=ylabel, **{f"{name}scale": "log" for name in log})
        if "x" in log and len(at) <= 8:
            axes.set_xticks(at, [f"{each:g}" for each in at])
            axes.set_xticks([], minor=True)
        if any(lines):
            legend_above(axes)
    return figure


def vibration(modes: Modes, *, count: int = 6, columns: int = 2) -> Figure:
    """Return a figure of the first modes of `kc.statics.modes`: both extremes about the equilibrium.

    The largest displacement is drawn as a quarter of the robot's extent. Titles have frequency and damping,
    or the growth rate of a motion without oscillation.
    """
    check_arguments(vibration, locals())
    if count < 1 or not len(modes.values):
        raise ValueError(f"count is {count} of {len(modes.values)} modes; allowed is 1 or more")
    still = modes.position.reshape(len(modes.position), -1, 3)
    size = SWING * float(np.max(np.ptp(still, axis=(0, 1))))
    shown = modes.shapes[:count].reshape(-1, *still.shape)
    across = min(len(shown), 3 if columns == 2 else 2)
    rows = -(-len(shown) // across)
    width = width_of(columns)
    with new_figure(width, rows * (width / across + 0.2)) as figure:
        grid = figure.add_gridspec(rows, across)
        for k, shape in enumerate(shown):
            seen = View(figure, grid[divmod(k, across)], "xyz")
            ends = (still + size * shape, still - size * shape)
            for points, look in (
                (still, {"color": "#999999", "linewidth": 1.0}),
                (ends[0], {"color": PALETTE[0], "linewidth": 1.8}),
                (ends[1], {"color": PALETTE[1], "linewidth": 1.2, "linestyle": "--"}),
            ):
                for curve in np.swapaxes(points, 0, 1):
                    seen.axes.plot(*seen.of(curve), **look)
            seen.frame(np.concatenate([*ends, still]).reshape(-1, 3), zoom=0.8)
            title = f"{modes.frequency[k]:.4g} Hz, damping {modes.damping[k]:.2g}"
            if not modes.frequency[k]:
                title = f"growth rate {modes.values[k].real:.3g} 1/s"
            seen.axes.set_title(f"{k + 1}: {title}")
    return figure


def workspace(samples: Workspace, colour: str | ArrayLike = "controls", *, label: str = "") -> Figure:
    """Return a figure of a workspace: its volume in space, and its points from the side and from above.

    Args:
        samples: workspace, of `kc.statics.workspace`.
        colour: "controls" (their sum), "reach" (distance from the base), the name of a strain (its largest
            change from rest along the rod), or values (B,), one for each sample, such as a stiffness, or 1
            where an equilibrium is stable and 0 elsewhere. NaN is not drawn.
        label: title of the colour bar of values.

    Raises:
        ValueError: no sample is solved, positions do not have three coordinates, or an unknown colour.
    """
    check_arguments(workspace, locals())
    require_matplotlib()
    values, label = _workspace_values(samples, colour, label)
    drawn = samples.valid & np.isfinite(values)
    if samples.position.shape[1] != 3 or not drawn.any():
        raise ValueError("there is no solved sample with three coordinates to draw")
    shown = np.flatnonzero(drawn)[:MOST_POINTS]
    points, values = samples.position[shown], values[shown]
    look: dict[str, Any] = {"c": values, "s": 1, "cmap": TIME_COLOURS, "linewidths": 0, "rasterized": True}
    look |= {"vmin": values.min(), "vmax": values.max()}
    with new_figure(TWO_COLUMNS, 2.9) as figure:
        # an empty column, because the layout leaves no room for the labels of an axis in space
        grid = figure.add_gridspec(1, 4, width_ratios=(1.2, 0.2, 1.0, 1.0))
        for k, view in ((0, "xyz"), (2, "xz"), (3, "xy")):
            seen = View(figure, grid[0, k], view)
            dots = seen.axes.scatter(*seen.of(points), **look)
            if seen.flat:
                seen.axes.set_aspect("equal")
            else:
                _draw_hull(seen.axes, points)
                seen.frame(points, zoom=0.8)
        figure.colorbar(dots, ax=figure.axes, label=label, shrink=0.8)
    return figure


def _workspace_values(
    samples: Workspace, colour: str | ArrayLike, label: str
) -> tuple[NDArray[np.float64], str]:
    """Return the values (B,) that colour a workspace, and the title of their bar."""
    if not isinstance(colour, str):
        try:
            values = np.asarray(colour, dtype=float)
        except (TypeError, ValueError):
            raise ValueError(
                f"colour is a {type(colour).__name__}; allowed is a name, or one number for each sample"
            ) from None
        if values.shape != samples.result.shape:
            raise ValueError(
                f"colour has shape {values.shape}; allowed is {samples.result.shape}, one a sample"
            )
        return values, label
    strains = {field.name: field.unit for field in samples.system.z_layout.fields}
    if colour == "controls":
        units = {field.unit for field in samples.system.control_layout.fields}
        unit = f" [{units.pop()}]" if len(units) == 1 else ""
        return samples.controls.sum(axis=1), f"sum of the controls{unit}"
    if colour == "reach":
        base = np.asarray(Drawing.of(samples.system).positions(np.asarray(samples.system.rest(0.0)[0])))
        return np.linalg.norm(samples.position - base, axis=1), "distance from the base [m]"
    if colour not in strains:
        names = ", ".join(("controls", "reach", *strains))
        raise ValueError(f"colour is {colour!r}; allowed is {names}, or an array of values")
    return samples.peak(colour), f"largest change of {colour} [{strains[colour]}]"


def _draw_hull(axes: Any, points: NDArray[np.float64]) -> None:
    """Draw the convex hull of points, and title it with its volume; points in a plane have none."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except QhullError:
        return
    axes.plot_trisurf(*points.T, triangles=hull.simplices, color="#8899AA", alpha=0.12, linewidth=0)
    axes.set_title(f"convex hull {1e6 * hull.volume:.3g} cm³", pad=0.0)


def closed_loop(log: LoopLog) -> Figure:
    """Return a figure of a closed loop: path of the tip from above, error, controls, adapted parameters.

    Periods without a solution are marked. Without adapted parameters the last panel has the times of the
    computation.
    """
    check_arguments(closed_loop, locals())
    wanted, tip = log.reference[:, :2], log.tip[:, :2]
    fallback = np.array([status != "optimal" for status in log.status])
    with new_figure(TWO_COLUMNS, 4.2) as figure:
        path, error, control, last = figure.subplots(2, 2).ravel()
        path.plot(*wanted.T, label="reference", **REFERENCE)
        path.plot(*tip.T, color=PALETTE[0], label="tip")
        path.set(xlabel="x [m]", ylabel="y [m]", title="path of the tip, from above", aspect="equal")
        path.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0))
        error.semilogy(log.time, 1e3 * np.maximum(log.tip_distance, 1e-6), color=PALETTE[0])
        for each in log.time[fallback]:
            error.axvspan(each, each + log.time[1] - log.time[0], color=PALETTE[1], alpha=0.3, lw=0)
        error.set(xlabel="time [s]", ylabel="distance [mm]", title="distance from the reference")
        names, title = [str(k + 1) for k in range(log.control.shape[1])], "control"
        if log.control_layout is not None:
            names, title = control_words(log.control_layout)
        for k, column in enumerate(log.control.T):
            control.step(log.time, column, where="post", color=PALETTE[k % len(PALETTE)], label=names[k])
        control.set(xlabel="time [s]", ylabel=title)
        legend_above(control)
        if log.parameters:
            for k, (name, values) in enumerate(log.parameters.items()):
                unit = np.max(np.abs(values)) or 1.0
                last.plot(log.time, values / unit, color=PALETTE[k], label=f"{name} / {unit:.3g}")
            last.set(xlabel="time [s]", title="adapted parameters, relative to their largest values")
        else:
            for k, (name, seconds) in enumerate(
                (("feedback", log.feedback), ("preparation", log.preparation))
            ):
                last.semilogy(log.time, 1e3 * seconds, color=PALETTE[k], label=name)
            last.set(xlabel="time [s]", ylabel="time [ms]", title="computation")
        last.legend()
    return figure
