"""Figures of the recordings' study: tensions, tips by method, error over the horizon, and repetitions.

Data are given by the recordings' names. Unknown rows are NaN.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.evaluation.comparison import METHODS, REFERENCE, legend_below, require_some
from knode_cosserat.evaluation.drawing import equal_scales, new_figure
from knode_cosserat.evaluation.style import PALETTE, TWO_COLUMNS, style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: line style of each method
LINES: dict[str, dict[str, Any]] = {
    "baseline": METHODS["baseline"],
    "paper-a": {"color": PALETTE[5], "linestyle": "-", "linewidth": 1.1},
    "paper-b": METHODS["paper"],
    "best": METHODS["best"],
    "calibrated": METHODS["calibrated"],
    "no-memory": {"color": PALETTE[2], "linestyle": "-", "linewidth": 1.1},
    "no-vibration": {"color": PALETTE[4], "linestyle": "--", "linewidth": 1.1},
}
MEASURED = {**REFERENCE, "label": "measured"}
COLUMNS = 2


class Predicted(NamedTuple):
    """Recording with its measured tip, and each method's prediction with its first seed."""

    time: Float[np.ndarray, " T"]
    measured: Float[np.ndarray, "T 3"]
    predicted: Mapping[str, Float[np.ndarray, "T 3"]]
    tension: Float[np.ndarray, "T c"]
    command: Float[np.ndarray, "T c"] | None


def measured_tensions(recordings: Mapping[str, Predicted]) -> Figure:
    """Return a figure of commanded and measured tensions by tendon.

    Raises:
        ImportError: matplotlib is not installed; from every function here.
        ValueError: there is nothing to draw; from every function here.
    """
    with style():
        figure, panels = _grid(recordings, 2.3)
        for axes, (name, it) in zip(panels, recordings.items(), strict=False):
            for k in range(it.tension.shape[1]):
                colour = PALETTE[k % len(PALETTE)]
                axes.plot(it.time, it.tension[:, k], color=colour, linewidth=1.1, label=f"tendon {k + 1}")
                if it.command is not None:
                    axes.step(
                        it.time, it.command[:, k], where="post", color=colour, linewidth=0.8, alpha=0.6,
                        linestyle="--",
                    )  # fmt: skip
            axes.set(title=f"{name}: measured (solid), commanded (dashed)", ylabel="tension [N]")
        return _finished(figure, panels)


def tip_x(recordings: Mapping[str, Predicted]) -> Figure:
    """Return a figure of x of the tips over time."""
    with style():
        figure, panels = _grid(recordings, 2.3)
        # one scale for all panels, so that motions are comparable; predictions far off leave the axes
        reach = 2.5 * max(float(np.nanmax(np.abs(it.measured[:, 0]))) for it in recordings.values())
        for axes, (name, it) in zip(panels, recordings.items(), strict=False):
            axes.plot(it.time, it.measured[:, 0], **MEASURED)
            for method, tip in it.predicted.items():
                axes.plot(it.time, tip[:, 0], label=method, **LINES.get(method, {}))
            axes.set(title=name, ylabel="tip x [m]", ylim=(-reach, reach))
        return _finished(figure, panels)


def paths(recordings: Mapping[str, Predicted]) -> Figure:
    """Return a figure of the paths of the tips in space."""
    require_some(recordings)
    with style():
        columns = min(COLUMNS, len(recordings))
        rows = -(-len(recordings) // columns)
        figure = new_figure(TWO_COLUMNS, 2.6 * rows + 0.4)
        grid = figure.subplots(rows, columns, subplot_kw={"projection": "3d"}, squeeze=False).ravel()
        for axes, (name, it) in zip(grid, recordings.items(), strict=False):
            axes.plot(*it.measured.T, **MEASURED)
            for method, tip in it.predicted.items():
                axes.plot(*tip.T, label=method, **LINES.get(method, {}))
            axes.set_title(name, y=0.94)
            axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
            axes.locator_params(nbins=4)
            points = np.concatenate([it.measured, *it.predicted.values()])
            equal_scales(axes, points[None, np.isfinite(points).all(axis=1)], 0.85)
        for axes in grid[len(recordings) :]:
            axes.remove()
        legend_below(figure, grid[: len(recordings)])
    return figure


def horizon(recordings: Mapping[str, Predicted]) -> Figure:
    """Return a figure of the tip error over the horizon: RMS over the recordings, and their range."""
    require_some(recordings)
    with style():
        figure = new_figure(TWO_COLUMNS, 3.2)
        axes = figure.subplots()
        methods = list(dict.fromkeys(method for it in recordings.values() for method in it.predicted))
        for method in methods:
            several = [it for it in recordings.values() if method in it.predicted]
            length = min(len(it.time) for it in several)
            off = np.array(
                [
                    np.linalg.norm(it.predicted[method][:length] - it.measured[:length], axis=1)
                    for it in several
                ]
            )
            time = several[0].time[:length] - several[0].time[0]
            # average over the last second, for smoother lines
            means = np.array(
                [np.sqrt(np.nanmean(off[:, max(0, i - 20) : i + 1] ** 2)) for i in range(length)]
            )
            look = LINES.get(method, {})
            axes.plot(time, 100.0 * means, label=method, **look)
            axes.fill_between(
                time, 100.0 * np.nanmin(off, axis=0), 100.0 * np.nanmax(off, axis=0),
                color=look.get("color"), alpha=0.12, linewidth=0,
            )  # fmt: skip
        axes.set(
            xlabel="time since the prediction began [s]", ylabel="distance of the tips [cm]", yscale="log"
        )
        axes.set_title("Lines: root mean square of all recordings over the last second; bands: least to most")
        axes.margins(x=0.0)
        legend_below(figure, [axes])
    return figure


def consistency(groups: Mapping[str, Sequence[Float[np.ndarray, "T 3"]]], dt: float) -> Figure:
    """Return a figure of repeated recordings of one control, overlaid: the robot's repeatability."""
    with style():
        figure, panels = _grid(groups, 2.3)
        for axes, (name, several) in zip(panels, groups.items(), strict=False):
            length = min(len(tip) for tip in several)
            tips = np.stack([tip[:length] for tip in several])
            time = dt * np.arange(length)
            spread = np.linalg.norm(np.nanstd(tips, axis=0), axis=1)
            for k, tip in enumerate(tips):
                label = "" if k else "each recording"
                axes.plot(time, tip[:, 0], color=PALETTE[0], linewidth=0.8, label=label)
            axes.set(
                title=f"{name}, {len(tips)} times: {100 * np.sqrt(np.nanmean(spread**2)):.2f} cm apart",
                ylabel="tip x [m]",
            )
        return _finished(figure, panels)


def _grid(given: Mapping[str, Any], height: float) -> tuple[Any, Any]:
    require_some(given)
    columns = 1 if len(given) < 3 else 2
    rows = -(-len(given) // columns)
    figure = new_figure(TWO_COLUMNS, 0.7 * height * rows + 0.5)
    return figure, figure.subplots(rows, columns, squeeze=False).ravel()


def _finished(figure: Any, panels: Any) -> Figure:
    used = [axes for axes in panels if axes.get_lines()]
    for axes in panels:
        axes.margins(x=0.0)
        if axes not in used:
            axes.remove()
    for axes in used[-2:]:
        axes.set_xlabel("time [s]")
    legend_below(figure, used)
    return figure
