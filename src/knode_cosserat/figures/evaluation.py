"""Figures of an evaluation: a recording beside its prediction; they need matplotlib, the extra `viz`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from knode_cosserat.figures.drawing import AXES, control_words, curves_of, legend_above
from knode_cosserat.figures.style import PALETTE, new_figure
from knode_cosserat.rods.wrapped import nominal_model

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from knode_cosserat.identification import Comparison

#: width of a figure (in): it fits a phone, and half a page in print
WIDTH = 4.4
#: line of the measured robot: wide and pale, so that a line on top of it remains visible
MEASURED: dict[str, Any] = {"color": "#9A9A9A", "linewidth": 2.6}
PREDICTED: dict[str, Any] = {"color": PALETTE[0], "linewidth": 1.0}
ERROR, OUTSIDE = PALETTE[1], "#F5D9A8"
#: largest number of drawn points of a line; of longer ones, extremes of equal intervals are drawn
MOST_POINTS = 2400
#: largest number of controls that are named beside their lines
MOST_NAMES = 12
#: instants whose shapes are drawn, and the smallest time between two, as a part of the whole
INSTANTS, APART = 3, 0.05
#: smallest extent of a drawn shape, as a part of its largest one
THINNEST = 0.45


def length_unit(size: float) -> tuple[float, str]:
    """Return the factor and the unit in which lengths of a size (m) are read: µm, mm or m."""
    if not size > 0.0:
        return 1e3, "mm"
    if size < 1e-5:
        return 1e6, "µm"
    return (1e3, "mm") if size < 1.0 else (1.0, "m")


def over_time(it: Comparison) -> Figure:
    """Return the tip, its error, the angle between the orientations, and the controls, over the rows."""
    drawn = [_tip(it, k) for k in range(it.seen.shape[2])] if it.seen.shape[1] else []
    if np.isfinite(it.distance).any():
        drawn.append(_distance(it))
    if np.isfinite(it.angle).any():
        drawn.append(_angle(it))
    if it.control.shape[1]:
        drawn.append(_controls(it))
    with new_figure(WIDTH, 0.6 + 0.95 * len(drawn)) as figure:
        column = figure.subplots(len(drawn), 1, sharex=True, squeeze=False)[:, 0]
        for axes, draw in zip(column, drawn, strict=True):
            draw(axes)
            _mark_extrapolated(axes, it)
        column[-1].set_xlabel("row" if it.measured.static else "time [s]")
        handles = {
            label: handle
            for axes in column
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(
            handles.values(), handles.keys(), loc="outside upper center", ncols=4, columnspacing=1.2
        )
        figure.align_ylabels(column)
    return figure


def worst_instants(it: Comparison) -> Figure:
    """Return the measured and the predicted shape in the rows with the largest errors, from two sides."""
    rows = worst_rows(it)
    curves = [np.asarray(curve)[rows] for curve in curves_of(it.trajectory)]  # type: ignore[arg-type]
    seen, predicted = it.seen[rows], np.asarray(it.position)[rows]
    points = np.concatenate([each.reshape(-1, each.shape[-1]) for each in (*curves, seen, predicted)])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    centre, half = (low + high) / 2, (high - low) / 2
    views = _views(curves[0])
    # the same scale and the same extent in both views
    along = set(views[0]).intersection(*views)
    sides = [k for k in range(len(half)) if k not in along] if len(views) > 1 else []
    half[sides] = np.max(half[sides], initial=0.0)
    half = 1.1 * np.maximum(half, THINNEST * half.max())
    factor, unit = length_unit(2.0 * float(half.max()))
    across, up = half[views[0][0]], half[views[0][1]]
    gravity = np.asarray(getattr(nominal_model(it.robot), "gravity", 0.0), dtype=float)
    down = gravity if gravity.shape == half.shape else np.zeros(half.shape)
    wide = (WIDTH - 0.75) / INSTANTS
    with new_figure(WIDTH, 0.85 + len(views) * (0.22 + wide * up / across)) as figure:
        grid = figure.subplots(len(views), INSTANTS, squeeze=False, sharex="row", sharey="row")
        for column, row in enumerate(rows):
            for axes, view in zip(grid[:, column], views, strict=True):
                _draw_shape(axes, [curve[column] for curve in curves], seen[column], predicted[column], view)
                for name, k in zip("xy", view, strict=True):
                    # what hangs down is drawn so
                    towards = -half[k] if name == "y" and down[k] > 0.0 else half[k]
                    getattr(axes, f"set_{name}lim")(centre[k] - towards, centre[k] + towards)
                axes.set_aspect("equal")
                axes.set_xlabel(f"{AXES[view[0]]} [{unit}]")
                _scale(axes, factor)
                if column == 0:
                    axes.set_ylabel(f"{AXES[view[1]]} [{unit}]")
            size, size_unit = length_unit(float(np.nanmax(it.distance[row])))
            where = f"row {it.rows[row]}" if it.measured.static else f"{it.time[row]:.4g} s"
            grid[0, column].set_title(f"{where}: {size * np.nanmax(it.distance[row]):.3g} {size_unit}")
        for axes in grid[:, len(rows) :].flat:
            axes.set_visible(False)
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3)
    return figure


def along_rod(it: Comparison) -> Figure:
    """Return the errors of each body over its place on the rod."""
    place = 100.0 * it.measured.fractions
    has_angles = bool(np.isfinite(it.angle).any())
    with new_figure(WIDTH, 3.2 if has_angles else 2.2) as figure:
        column = figure.subplots(1 + has_angles, 1, sharex=True, squeeze=False)[:, 0]
        factor, unit = length_unit(float(np.nanmax(it.distance)))
        _draw_statistics(column[0], place, factor * it.distance)
        column[0].set_ylabel(f"distance [{unit}]")
        if has_angles:
            _draw_statistics(column[1], place, np.degrees(it.angle))
            column[1].set_ylabel("angle [°]")
        column[-1].set_xlabel("place on the rod [% of the length]")
        legend_above(column[0])
        figure.align_ylabels(column)
    return figure


def histogram(it: Comparison) -> Figure:
    """Return the distribution of the tip's error over the rows."""
    distance = it.distance[:, -1]
    known = np.isfinite(distance)
    factor, unit = length_unit(float(np.nanmax(distance)))
    outside = np.zeros(len(distance), bool) if it.extrapolated is None else np.asarray(it.extrapolated)
    parts = {"rows": known & ~outside, "extrapolated": known & outside}
    parts = {name: rows for name, rows in parts.items() if rows.any()}
    with new_figure(WIDTH, 2.2) as figure:
        axes = figure.subplots()
        axes.hist(
            [factor * distance[rows] for rows in parts.values()],
            bins=min(40, max(6, int(np.sqrt(known.sum())))),
            range=(0.0, factor * float(np.nanmax(distance)) or 1.0),
            stacked=True,
            color=[{"rows": PALETTE[5], "extrapolated": PALETTE[4]}[name] for name in parts],
            label=list(parts),
        )
        for name, level, dash in (("median", 50, "-"), ("95 %", 95, "--")):
            at = factor * np.nanpercentile(distance, level)
            axes.axvline(at, color="#333333", linestyle=dash, linewidth=1.0, label=name)
        axes.set(xlabel=f"distance of the tip [{unit}]", ylabel="rows")
        axes.locator_params(axis="y", integer=True)
        legend_above(axes)
    return figure


def worst_rows(it: Comparison) -> list[int]:
    """Return the rows with the largest error of any body, apart from each other, the worst first."""
    error, at = np.max(np.nan_to_num(it.distance, nan=-1.0), axis=1), _abscissa(it)
    apart = 0.0 if it.measured.static else APART * float(np.ptp(at))
    rows: list[int] = []
    while len(rows) < INSTANTS and error.max() >= 0.0:
        rows.append(int(np.argmax(error)))
        error[np.abs(at - at[rows[-1]]) <= apart] = -1.0
    return rows


# panels over time


def _abscissa(it: Comparison) -> Float[np.ndarray, " T"]:
    return it.rows.astype(float) if it.measured.static else it.time


def _plot(axes: Any, it: Comparison, values: NDArray[np.float64], **look: Any) -> None:
    """Draw values over the rows: a line, or points of separate equilibria and of a single row."""
    x = _abscissa(it)
    if it.measured.static or len(x) == 1:
        size = 1.7 * look["linewidth"]
        axes.plot(
            x, values, "o", markersize=size, markeredgewidth=0.0, color=look["color"], label=look.get("label")
        )
        return
    axes.plot(*thinned(x, values), **look)


def thinned(
    time: Float[np.ndarray, " T"], values: Float[np.ndarray, " T"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the smallest and the largest value of equal intervals, of a line of too many points."""
    if len(time) <= MOST_POINTS:
        return time, values
    kept = set[int]()
    for part in np.array_split(np.arange(len(time)), MOST_POINTS // 2):
        known = part[np.isfinite(values[part])]
        kept |= (
            {int(known[k]) for k in (values[known].argmin(), values[known].argmax())}
            if len(known)
            else {int(part[0])}
        )
    rows = np.array(sorted(kept))
    return time[rows], values[rows]


def _tip(it: Comparison, k: int) -> Any:
    def draw(axes: Any) -> None:
        seen = it.seen[:, -1, k]
        predicted = None if it.position is None else it.position[:, -1, k]
        known = np.concatenate([each for each in (seen, predicted) if each is not None])
        factor, unit = length_unit(float(np.nanmax(np.abs(known), initial=0.0)))
        if it.band is not None:
            limits = (factor * side[:, -1, k] for side in (it.band.low, it.band.high))
            axes.fill_between(
                _abscissa(it), *limits, color=PALETTE[5], alpha=0.4, linewidth=0.0,
                label=f"{100.0 * it.band.level:.0f} % band", rasterized=len(it.rows) > MOST_POINTS,
            )  # fmt: skip
        _plot(axes, it, factor * seen, label="measured", **MEASURED)
        if predicted is not None:
            _plot(axes, it, factor * predicted, label="predicted", **PREDICTED)
        axes.set_ylabel(f"tip {AXES[k]}\n[{unit}]")

    return draw


def _distance(it: Comparison) -> Any:
    def draw(axes: Any) -> None:
        factor, unit = length_unit(float(np.nanmax(it.distance[:, -1])))
        _plot(axes, it, factor * it.distance[:, -1], color=ERROR, linewidth=1.0)
        axes.set_ylabel(f"tip error\n[{unit}]")
        axes.set_ylim(0.0, None)

    return draw


def _angle(it: Comparison) -> Any:
    def draw(axes: Any) -> None:
        square = np.degrees(it.angle) ** 2
        known = np.isfinite(square)
        mean = np.nansum(square, axis=1) / np.maximum(known.sum(axis=1), 1)
        _plot(axes, it, np.where(known.any(axis=1), np.sqrt(mean), np.nan), color=PALETTE[3], linewidth=1.0)
        axes.set_ylabel("orient.\nerror [°]")
        axes.set_ylim(0.0, None)

    return draw


def _controls(it: Comparison) -> Any:
    def draw(axes: Any) -> None:
        values, layout = it.control, it.robot.control_layout
        count = values.shape[1]
        lines = []
        for k in range(count):
            look = {"color": PALETTE[k % len(PALETTE)], "linewidth": max(0.6, 1.6 - 0.3 * k)}
            if it.measured.static or len(it.rows) == 1:
                lines += axes.plot(_abscissa(it), values[:, k], ".", markersize=2.5, color=look["color"])
            else:
                lines += axes.plot(*thinned(it.time, values[:, k]), drawstyle="steps-post", **look)
        # a recording may have other controls than the robot
        names, title = control_words(layout) if layout.size == count else ([], "control")
        axes.set_ylabel(title.replace(" [", "\n["))
        if 1 < count <= MOST_NAMES:
            # numbers are enough where the axis has the unit of all
            if numbered := "[" in title or not names:
                names = [str(k + 1) for k in range(count)]
            columns = count if numbered else 3
            axes.legend(
                lines, names, loc="lower right", bbox_to_anchor=(1.0, 0.94), ncols=columns, fontsize=7,
                handlelength=0.9, columnspacing=0.8, handletextpad=0.3, borderpad=0.0,
            )  # fmt: skip

    return draw


def _mark_extrapolated(axes: Any, it: Comparison) -> None:
    """Shade the rows outside the range that the robot was identified in."""
    if it.extrapolated is None or not np.any(it.extrapolated):
        return
    x = _abscissa(it)
    step = float(np.median(np.diff(x))) if len(x) > 1 else 1.0
    label: str | None = "extrapolated"
    for first, last in spans(it.extrapolated):
        axes.axvspan(
            x[first] - step / 2, x[last] + step / 2, color=OUTSIDE, zorder=0, linewidth=0.0, label=label
        )
        label = None


def spans(mask: Bool[np.ndarray, " T"]) -> list[tuple[int, int]]:
    """Return the first and last index of each run of True."""
    ends = np.diff(np.concatenate([[False], np.asarray(mask, bool), [False]]).astype(int))
    first, last = np.flatnonzero(ends == 1), np.flatnonzero(ends == -1) - 1
    return list(zip(first.tolist(), last.tolist(), strict=True))


# shapes and statistics


def _views(curve: Float[np.ndarray, "T N d"]) -> list[tuple[int, int]]:
    """Return the axes, horizontal and vertical, of two views from the side of a rod; one in a plane."""
    if curve.shape[-1] == 2:
        return [(0, 1)]
    along = int(np.argmax(np.abs(curve[0, 1] - curve[0, 0])))
    return [(0, 2), (1, 2)] if along == 2 else [(along, 2), (along, 1 - along)]


def _draw_shape(axes: Any, curves: Any, seen: Any, predicted: Any, view: tuple[int, int]) -> None:
    a, b = view
    for k, curve in enumerate(curves):
        axes.plot(curve[:, a], curve[:, b], label=None if k else "predicted", **PREDICTED)
    for k, (one, other) in enumerate(zip(seen, predicted, strict=True)):
        pair = np.stack([one, other])
        axes.plot(pair[:, a], pair[:, b], color=ERROR, linewidth=0.9, label=None if k else "error")
    axes.plot(predicted[:, a], predicted[:, b], "o", color=PREDICTED["color"], markersize=2.2)
    axes.plot(
        seen[:, a], seen[:, b], "o:k", markersize=3.0, fillstyle="none", linewidth=0.8, label="measured"
    )


def _scale(axes: Any, factor: float) -> None:
    """Label an axis in m with numbers of another unit."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(3))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{factor * value + 0.0:.4g}"))


def _draw_statistics(axes: Any, place: Any, values: Float[np.ndarray, "T M"]) -> None:
    """Draw RMS, 95 % and maximum of each column over its place."""
    known = [column[np.isfinite(column)] for column in values.T]
    for name, statistic, look in (
        ("RMS", lambda it: np.sqrt(np.mean(it**2)), {"color": PALETTE[0], "marker": "o"}),
        ("95 %", lambda it: np.percentile(it, 95), {"color": PALETTE[4], "marker": "s", "linestyle": "--"}),
        ("maximum", np.max, {"color": PALETTE[1], "marker": "^", "linestyle": ":"}),
    ):
        axes.plot(place, [statistic(it) if len(it) else np.nan for it in known], label=name, **look)
    axes.set(xlim=(0.0, 103.0), ylim=(0.0, None))
