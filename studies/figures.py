"""Figures of a study: controls, shapes and tips by method, and the training loss."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from knode_cosserat.figures.comparison import draw_shapes, draw_tips, legend_below, require_some, show_all
from knode_cosserat.figures.drawing import draw_tensions
from knode_cosserat.figures.style import PALETTE, TWO_COLUMNS, new_figure
from knode_cosserat.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def controls(trajectories: Mapping[str, Trajectory]) -> Figure:
    """Return a figure of the tensions of several trajectories by title, one below the other.

    Raises:
        ImportError: matplotlib is not installed; from every function here.
        ValueError: there is nothing to draw, or a batch is given; from every function here.
    """
    require_some(trajectories)
    with new_figure(TWO_COLUMNS, 1.8 * len(trajectories)) as figure:
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
    columns = min(2, len(predictions))
    rows = -(-len(predictions) // columns)
    with new_figure(TWO_COLUMNS, 2.9 * rows + 0.3) as figure:
        grid = figure.subplots(rows, columns, subplot_kw={"projection": "3d"}, squeeze=False).ravel()
        panels = grid[: len(predictions)]
        for axes in grid[len(predictions) :]:
            axes.remove()
        for axes, (label, prediction) in zip(panels, predictions.items(), strict=True):
            draw_shapes(axes, reference, {label: prediction}, count)
            show_all(axes, [reference, *predictions.values()], zoom=0.85)
        legend_below(figure, panels)
    return figure


def predicted_tips(cases: Mapping[str, tuple[Trajectory, Mapping[str, Trajectory]]]) -> Figure:
    """Return a figure of the tips over time: a column per case, given by its reference and predictions."""
    require_some(cases)
    with new_figure(TWO_COLUMNS, 4.0) as figure:
        grid = figure.subplots(3, len(cases), sharex="col", squeeze=False)
        for column, (title, (reference, predictions)) in zip(grid.T, cases.items(), strict=True):
            draw_tips(column, reference, predictions)
            column[0].set_title(title)
        figure.align_ylabels()
        legend_below(figure, grid.ravel())
    return figure


def losses(runs: Mapping[str, Sequence[ArrayLike]]) -> Figure:
    """Return a figure of the loss over epochs: median and range of the runs (seeds) for each label."""
    require_some(runs)
    with new_figure(TWO_COLUMNS, 3.2) as figure:
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
