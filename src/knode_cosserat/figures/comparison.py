"""Comparison of predictions with a reference: shapes and tips by label, and the line styles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat.figures import drawing
from knode_cosserat.figures.drawing import equal_scales, one_of, tips_of
from knode_cosserat.figures.style import PALETTE, TWO_COLUMNS, new_figure
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


def looks_of(labels: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return the line styles of predictions: fixed for methods of the studies, otherwise by position."""
    places = enumerate(labels)
    return {label: METHODS.get(label) or METHODS[_OTHERS[k % len(_OTHERS)]] for k, label in places}


def compare(reference: Trajectory, predictions: Mapping[str, Trajectory], count: int = 6) -> Figure:
    """Return one figure of the shapes and tips of several predictions, drawn over the reference.

    The shapes are `count`, evenly in time, and that at the largest distance of each prediction's tip.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: there is nothing to draw, or a batch is given.
    """
    check_arguments(compare, locals())
    require_some(predictions)
    with new_figure(TWO_COLUMNS, 3.8) as figure:
        left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.35), wspace=0.03)
        axes = left.add_subplot(projection="3d")
        draw_shapes(axes, reference, predictions, count)
        show_all(axes, [reference, *predictions.values()], zoom=0.87)
        column = right.subplots(3, 1, sharex=True)
        draw_tips(column, reference, predictions)
        right.align_ylabels()
        legend_below(figure, column)
    return figure


def draw_shapes(axes: Any, reference: Trajectory, predictions: Mapping[str, Trajectory], count: int) -> None:
    """Draw `count` shapes, those at the largest distances, and tip paths of reference and predictions."""
    true = np.asarray(one_of(reference).position)
    rows = np.linspace(0, len(true) - 1, count).round().astype(int)
    rows = np.unique(np.append(rows, [farthest_row(reference, each) for each in predictions.values()]))
    for row in rows:
        axes.plot(*true[row].T, **REFERENCE, solid_capstyle="round")
    axes.plot(*true[:, -1].T, **{**REFERENCE, "linewidth": 2.0}, label="reference")
    for label, look in looks_of(predictions).items():
        points, look = np.asarray(one_of(predictions[label]).position), {**look, "linestyle": "-"}
        for row in rows:
            axes.plot(*points[row].T, **look)
        axes.plot(*points[:, -1].T, **{**look, "linewidth": 0.9}, label=label)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")


def farthest_row(reference: Trajectory, prediction: Trajectory) -> int:
    """Return the row of the largest distance of the tips; 0 if there is none, or other rows."""
    true, tip = tips_of(one_of(reference)), tips_of(one_of(prediction))
    if tip.shape != true.shape:
        return 0
    return int(np.argmax(np.nan_to_num(np.linalg.norm(tip - true, axis=1))))


def show_all(axes: Any, trajectories: Sequence[Trajectory], zoom: float) -> None:
    """Scale the axes so that all trajectories are within them."""
    points = np.concatenate([np.asarray(each.position).reshape(-1, 3) for each in trajectories])
    equal_scales(axes, points[None, np.isfinite(points).all(axis=1)], zoom)


def draw_tips(column: Any, reference: Trajectory, predictions: Mapping[str, Trajectory]) -> None:
    """Draw the tip's x, y and z over time, one below the other."""
    motions = {"reference": reference, **predictions}
    paths = {label: (motion.time, tips_of(motion)) for label, motion in motions.items()}
    drawing.draw_tips(column, paths, {"reference": REFERENCE, **looks_of(predictions)})


def legend_below(figure: Any, axes: Any, columns: int = 6) -> None:
    """Add one legend for all axes, each label once."""
    handles: dict[str, Any] = {}
    for each in axes:
        for handle, label in zip(*each.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=columns, handlelength=2.4
    )


def require_some(given: Mapping[str, Any]) -> None:
    """Raise `ValueError` if there is nothing to draw."""
    if not given:
        raise ValueError("there is nothing to draw; at least one is needed")
