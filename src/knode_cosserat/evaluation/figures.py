"""Figures of trajectories, all in one style; they need matplotlib, the extra `viz`.

Every function returns a `matplotlib.figure.Figure` of its own: no window is opened, nothing global changes,
and `figure.savefig(path)` writes it. A trajectory is of one robot; rows that were not solved stay empty.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from knode_cosserat.evaluation.drawing import (
    PALETTE,
    Tips,
    draw_rods,
    draw_tensions,
    draw_tips,
    legend_above,
    line,
    new_figure,
    require_matplotlib,
    style,
    tips_of,
)
from knode_cosserat.evaluation.metrics import dtw_distance, rms_distance
from knode_cosserat.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from knode_cosserat.recordings.measurements import Measurements

__all__ = [
    "overview",
    "prediction_against_measurement",
    "require_matplotlib",
    "rod_shapes",
    "tensions",
    "tip_path",
]


def rod_shapes(trajectory: Trajectory, count: int = 12) -> Figure:
    """The rod at `count` times, evenly spread and coloured by time, and the path of its tip.

    Raises:
        ImportError: matplotlib is not installed; from every function here.
        ValueError: a batch is given, or no row is valid; from every function of a trajectory.
    """
    with style():
        figure = new_figure(6.0, 5.2)
        draw_rods(figure, figure.add_subplot(projection="3d"), trajectory, count)
    return figure


def tip_path(trajectories: Mapping[str, Tips]) -> Figure:
    """x, y and z of the tips over time, several trajectories (or recordings) by their labels in each."""
    with style():
        figure = new_figure(7.0, 5.6)
        axes = figure.subplots(3, 1, sharex=True)
        draw_tips(axes, {label: (one.time, tips_of(one)) for label, one in trajectories.items()})
        if len(trajectories) > 1:
            legend_above(axes[0])
    return figure


def tensions(trajectory: Trajectory) -> Figure:
    """The tension of every tendon over time, as it was held from row to row."""
    with style():
        figure = new_figure(7.0, 3.2)
        draw_tensions(figure.subplots(), trajectory)
    return figure


def overview(trajectory: Trajectory, count: int = 12) -> Figure:
    """Rod shapes, tip path and tensions of one trajectory in one picture."""
    with style():
        figure = new_figure(11.0, 5.6)
        left, right = figure.subfigures(1, 2, width_ratios=(1.1, 1.0))
        draw_rods(left, left.add_subplot(projection="3d"), trajectory, count)
        axes = right.subplots(4, 1, sharex=True, height_ratios=(1.0, 1.0, 1.0, 1.5))
        draw_tips(axes[:3], {"": (trajectory.time, tips_of(trajectory))})
        axes[2].set_xlabel("")
        draw_tensions(axes[3], trajectory)
    return figure


def prediction_against_measurement(prediction: Tips, recording: Measurements) -> Figure:
    """Two tip paths row by row: over the recording's time, seen from above, and how far apart they are.

    The title gives their DTW distance, and the root mean square of their distance in each row. A recording of
    a simulated robot is named as one.

    Raises:
        ValueError: the numbers of rows differ, or a position is not finite.
    """
    predicted, measured = tips_of(prediction), tips_of(recording)
    if len(predicted) != len(measured):
        raise ValueError(
            f"the prediction has {len(predicted)} rows and the recording {len(measured)}; "
            "both must have the same number"
        )
    error = np.linalg.norm(predicted - measured, axis=-1)
    dtw, rmse = dtw_distance(predicted, measured), float(rms_distance(predicted, measured))
    robot = "simulated stand-in robot" if recording.simulated else "robot"
    time = recording.time
    with style():
        figure = new_figure(11.0, 6.0)
        figure.suptitle(
            f"Tip, predicted and measured: DTW {dtw:.2f} m over {len(error)} rows, RMSE {100 * rmse:.1f} cm"
        )
        left, right = figure.subfigures(1, 2, width_ratios=(1.25, 1.0))
        axes = left.subplots(4, 1, sharex=True)
        draw_tips(axes[:3], {f"measured on a {robot}": (time, measured), "predicted": (time, predicted)})
        axes[2].set_xlabel("")
        legend_above(axes[0])
        axes[3].plot(time, error, color=PALETTE[-1])
        axes[3].set(xlabel="time [s]", ylabel="distance [m]", ylim=(0.0, None))
        above = right.subplots()
        for i, tip in enumerate((measured, predicted)):
            above.plot(tip[:, 0], tip[:, 1], **line(i))
        above.set(xlabel="tip x [m]", ylabel="tip y [m]", title="seen from above")
        above.set_aspect("equal", adjustable="datalim")
    return figure
