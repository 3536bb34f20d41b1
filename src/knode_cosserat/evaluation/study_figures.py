"""Figures of a study: controls, shapes and tips by method, and the training loss."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from knode_cosserat.evaluation.drawing import (
    AXES,
    draw_tensions,
    equal_scales,
    new_figure,
    one_of,
    require_span,
    tips_of,
)
from knode_cosserat.evaluation.style import PALETTE, TWO_COLUMNS, style
from knode_cosserat.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: fixed line styles: the reference is wide and pale, so that a line on top of it remains visible
REFERENCE: dict[str, Any] = {"color": "#AAAAAA", "linewidth": 3.0, "linestyle": "-"}
METHODS: dict[str, dict[str, Any]] = {
    "baseline": {"color": PALETTE[1], "linestyle": "-", "linewidth": 1.0},
    "paper": {"color": PALETTE[0], "linestyle": "-", "linewidth": 1.0},
    "calibrated": {"color": PALETTE[3], "linestyle": (0, (1, 1.5)), "linewidth": 1.6},
    "best": {"color": PALETTE[6], "linestyle": (0, (4, 2)), "linewidth": 1.1},
}
#: styles of other labels, by their position in the figure
_OTHERS = ("baseline", "best", "paper", "calibrated")


def look_of(label: str, place: int) -> dict[str, Any]:
    """Return the line style of a prediction: fixed for methods of the studies, otherwise by position."""
    return METHODS[label if label in METHODS else _OTHERS[place % len(_OTHERS)]]


def controls(trajectories: Mapping[str, Trajectory]) -> Figure:
    """Return a figure of the tensions of several trajectories by title, one below the other.

    Raises:
        ImportError: matplotlib is not installed; from every function here.
        ValueError: there is nothing to draw, or a batch is given; from every function here.
    """
    require_some(trajectories)
    with style():
        figure = new_figure(TWO_COLUMNS, 1.8 * len(trajectories))
        rows = figure.subplots(len(trajectories), 1, squeeze=False)[:, 0]
        for axes, (title, trajectory) in zip(rows, trajectories.items(), strict=True):
            draw_tensions(axes, trajectory)
            axes.get_legend().remove()
            axes.set_title(title)
        legend_below(figure, rows)
    return figure


def shapes(reference: Trajectory, predictions: Mapping[str, Trajectory], count: int = 6) -> Figure:
    """Return a figure of shapes at `count` times and tip paths, a panel per prediction over the reference."""
    require_some(predictions)
    with style():
        columns = min(2, len(predictions))
        rows = -(-len(predictions) // columns)
        figure = new_figure(TWO_COLUMNS, 2.9 * rows + 0.3)
        grid = figure.subplots(rows, columns, subplot_kw={"projection": "3d"}, squeeze=False).ravel()
        panels = grid[: len(predictions)]
        for axes in grid[len(predictions) :]:
            axes.remove()
        for axes, (label, prediction) in zip(panels, predictions.items(), strict=True):
            _draw_shapes(axes, reference, {label: prediction}, count)
            _show_all(axes, [reference, *predictions.values()], zoom=0.85)
        legend_below(figure, panels)
    return figure


def predicted_tips(cases: Mapping[str, tuple[Trajectory, Mapping[str, Trajectory]]]) -> Figure:
    """Return a figure of the tips over time: a column per case, given by its reference and predictions."""
    require_some(cases)
    with style():
        figure = new_figure(TWO_COLUMNS, 4.0)
        grid = figure.subplots(3, len(cases), sharex="col", squeeze=False)
        for column, (title, (reference, predictions)) in zip(grid.T, cases.items(), strict=True):
            _draw_tips(column, reference, predictions)
            column[0].set_title(title)
        figure.align_ylabels()
        legend_below(figure, grid.ravel())
    return figure


def comparison(reference: Trajectory, predictions: Mapping[str, Trajectory], count: int = 6) -> Figure:
    """Return one figure of the shapes and tips of several predictions, drawn over the reference."""
    require_some(predictions)
    with style():
        figure = new_figure(TWO_COLUMNS, 3.8)
        left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.35), wspace=0.03)
        axes = left.add_subplot(projection="3d")
        _draw_shapes(axes, reference, predictions, count)
        _show_all(axes, [reference, *predictions.values()], zoom=0.87)
        column = right.subplots(3, 1, sharex=True)
        _draw_tips(column, reference, predictions)
        right.align_ylabels()
        legend_below(figure, column)
    return figure


def _draw_shapes(axes: Any, reference: Trajectory, predictions: Mapping[str, Trajectory], count: int) -> None:
    true = np.asarray(one_of(reference).position)
    rows = np.unique(np.linspace(0, len(true) - 1, count).round().astype(int))
    for row in rows:
        axes.plot(*true[row].T, **REFERENCE, solid_capstyle="round")
    axes.plot(*true[:, -1].T, **{**REFERENCE, "linewidth": 2.0}, label="reference")
    for place, (label, prediction) in enumerate(predictions.items()):
        points = np.asarray(one_of(prediction).position)
        look = {**look_of(label, place), "linestyle": "-"}
        for row in rows:
            axes.plot(*points[row].T, **look)
        axes.plot(*points[:, -1].T, **{**look, "linewidth": 0.9}, label=label)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")


def _show_all(axes: Any, trajectories: Sequence[Trajectory], zoom: float) -> None:
    points = np.concatenate([np.asarray(each.position).reshape(-1, 3) for each in trajectories])
    equal_scales(axes, points[None, np.isfinite(points).all(axis=1)], zoom)


def _draw_tips(column: Any, reference: Trajectory, predictions: Mapping[str, Trajectory]) -> None:
    true = tips_of(reference)
    for k, axes in enumerate(column):
        axes.plot(reference.time, true[:, k], label="reference", **REFERENCE)
        for place, (label, each) in enumerate(predictions.items()):
            axes.plot(each.time, tips_of(each)[:, k], label=label, **look_of(label, place))
        axes.set_ylabel(f"tip {AXES[k]} [m]")
        require_span(axes, 0.01 * float(np.nanmax(np.abs(true))))
    column[-1].set_xlabel("time [s]")


def losses(runs: Mapping[str, Sequence[ArrayLike]]) -> Figure:
    """Return a figure of the loss over epochs: median and range of the runs (seeds) for each label."""
    require_some(runs)
    with style():
        figure = new_figure(TWO_COLUMNS, 3.2)
        axes = figure.subplots()
        for k, (label, histories) in enumerate(runs.items()):
            values = np.stack([np.asarray(history, dtype=float) for history in histories])
            epochs, colour = np.arange(1, values.shape[1] + 1), PALETTE[k % len(PALETTE)]
            axes.fill_between(
                epochs, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.25, linewidth=0
            )
            axes.plot(epochs, np.median(values, axis=0), color=colour, label=label, linewidth=1.2)
        axes.set(xlabel="epoch", ylabel="loss", yscale="log")
        axes.margins(x=0.0)
        legend_below(figure, [axes])
    return figure


def legend_below(figure: Any, axes: Any) -> None:
    """Add one legend for all axes, each label once."""
    handles: dict[str, Any] = {}
    for each in axes:
        for handle, label in zip(*each.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6, handlelength=2.4)


def require_some(given: Mapping[str, Any]) -> None:
    """Raise `ValueError` if there is nothing to draw."""
    if not given:
        raise ValueError("there is nothing to draw; at least one is needed")
