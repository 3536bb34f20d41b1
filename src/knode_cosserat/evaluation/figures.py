"""Figures of trajectories, all in one style; they need matplotlib, the extra `viz`.

Every function returns a `matplotlib.figure.Figure` of its own: no window is opened, nothing global changes,
and `figure.savefig(path)` writes it. A trajectory is of one robot; rows that were not solved stay empty.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knode_cosserat.evaluation.metrics import dtw_distance, rms_distance
from knode_cosserat.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from knode_cosserat.recordings.table import TipRecording

#: Okabe and Ito's colours, which the colour-blind can tell apart, without the yellow that vanishes on paper
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
#: the second trajectory and so on, which may lie on the first
DASHES = ("-", "--", "-.", ":")
TIME_COLOURS = "viridis"
STYLE: Any = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
}
AXES = ("x", "y", "z")


class Tips(Protocol):
    """What has tip positions over time: a trajectory, or a recording."""

    @property
    def time(self) -> ArrayLike:
        """(T,) s."""

    @property
    def tip_position(self) -> ArrayLike:
        """(T, 3) m."""


def rod_shapes(trajectory: Trajectory, count: int = 12) -> Figure:
    """The rod at `count` times, evenly spread and coloured by time, and the path of its tip.

    Raises:
        ImportError: matplotlib is not installed; from every function here.
        ValueError: a batch is given, or no row is valid; from every function of a trajectory.
    """
    with _style():
        figure = _figure(6.0, 5.2)
        _draw_rods(figure, figure.add_subplot(projection="3d"), trajectory, count)
    return figure


def tip_path(trajectories: Mapping[str, Tips]) -> Figure:
    """x, y and z of the tips over time, several trajectories (or recordings) by their labels in each."""
    with _style():
        figure = _figure(7.0, 5.6)
        axes = figure.subplots(3, 1, sharex=True)
        _draw_tips(axes, {label: (one.time, _tips(one)) for label, one in trajectories.items()})
        if len(trajectories) > 1:
            _legend_above(axes[0])
    return figure


def tensions(trajectory: Trajectory) -> Figure:
    """The tension of every tendon over time, as it was held from row to row."""
    with _style():
        figure = _figure(7.0, 3.2)
        _draw_tensions(figure.subplots(), trajectory)
    return figure


def overview(trajectory: Trajectory, count: int = 12) -> Figure:
    """Rod shapes, tip path and tensions of one trajectory in one picture."""
    with _style():
        figure = _figure(11.0, 5.6)
        left, right = figure.subfigures(1, 2, width_ratios=(1.1, 1.0))
        _draw_rods(left, left.add_subplot(projection="3d"), trajectory, count)
        axes = right.subplots(4, 1, sharex=True, height_ratios=(1.0, 1.0, 1.0, 1.5))
        _draw_tips(axes[:3], {"": (trajectory.time, _tips(trajectory))})
        axes[2].set_xlabel("")
        _draw_tensions(axes[3], trajectory)
    return figure


def prediction_against_measurement(prediction: Tips, recording: TipRecording) -> Figure:
    """Two tip paths row by row: over the recording's time, seen from above, and how far apart they are.

    The title gives their DTW distance, and the root mean square of their distance in each row. A recording of
    a simulated robot is named as one.

    Raises:
        ValueError: the numbers of rows differ, or a position is not finite.
    """
    predicted, measured = _tips(prediction), _tips(recording)
    if len(predicted) != len(measured):
        raise ValueError(
            f"the prediction has {len(predicted)} rows and the recording {len(measured)}; "
            "both must have the same number"
        )
    error = np.linalg.norm(predicted - measured, axis=-1)
    dtw, rmse = dtw_distance(predicted, measured), float(rms_distance(predicted, measured))
    robot = "simulated stand-in robot" if recording.simulated else "robot"
    time = recording.time
    with _style():
        figure = _figure(11.0, 6.0)
        figure.suptitle(
            f"Tip, predicted and measured: DTW {dtw:.2f} m over {len(error)} rows, RMSE {100 * rmse:.1f} cm"
        )
        left, right = figure.subfigures(1, 2, width_ratios=(1.25, 1.0))
        axes = left.subplots(4, 1, sharex=True)
        _draw_tips(axes[:3], {f"measured on a {robot}": (time, measured), "predicted": (time, predicted)})
        axes[2].set_xlabel("")
        _legend_above(axes[0])
        axes[3].plot(time, error, color=PALETTE[-1])
        axes[3].set(xlabel="time [s]", ylabel="distance [m]", ylim=(0.0, None))
        above = right.subplots()
        for i, tip in enumerate((measured, predicted)):
            above.plot(tip[:, 0], tip[:, 1], **_line(i))
        above.set(xlabel="tip x [m]", ylabel="tip y [m]", title="seen from above")
        above.set_aspect("equal", adjustable="datalim")
    return figure


# what the figures are made of


def _draw_rods(figure: Any, axes: Any, trajectory: Trajectory, count: int) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    position, time = _one(trajectory).position, np.asarray(trajectory.time)
    position = np.asarray(position)
    valid = np.flatnonzero(np.isfinite(position).all(axis=(1, 2)))
    if len(valid) == 0:
        raise ValueError("the trajectory has no valid row to draw")
    shown = valid[np.unique(np.linspace(0, len(valid) - 1, count).round().astype(int))]
    colours = ScalarMappable(Normalize(time[0], time[-1]), TIME_COLOURS)
    for row in shown:
        axes.plot(*position[row].T, color=colours.to_rgba(time[row]), linewidth=2.0, solid_capstyle="round")
    label = "path of the tip" if len(time) > 1 else None
    axes.plot(*position[:, -1].T, color="#777777", linewidth=0.9, label=label)
    axes.plot(*position[shown[0], :1].T, "s", color="#333333", markersize=5, label="base")
    _equal_scales(axes, position[valid])
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.legend(loc="upper left")
    if len(time) > 1:
        figure.colorbar(colours, ax=axes, label="time [s]", shrink=0.6, pad=0.1)


def _equal_scales(axes: Any, points: NDArray[np.float64]) -> None:
    """A metre is as long in every direction, and a thin box is still deep enough to see."""
    from matplotlib.ticker import MaxNLocator

    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    centre, half = (low + high) / 2, (high - low) / 2
    half = 1.05 * np.maximum(half, 0.55 * half.max())
    axes.set(**{f"{name}lim": (c - h, c + h) for name, c, h in zip(AXES, centre, half, strict=True)})
    axes.set_box_aspect(tuple(half), zoom=0.95)
    for axis, c, h in zip((axes.xaxis, axes.yaxis, axes.zaxis), centre, half, strict=True):
        # not near the ends: where two axes meet, their labels would too
        axis.set_ticks([tick for tick in MaxNLocator(4).tick_values(c - h, c + h) if abs(tick - c) < 0.9 * h])
    axes.tick_params(axis="z", pad=6.0)
    axes.zaxis.labelpad = 10.0


def _draw_tips(axes: Any, paths: Mapping[str, tuple[ArrayLike, NDArray[np.float64]]]) -> None:
    """x, y and z, one below the other, of paths given as times and positions."""
    for i, (label, (time, tip)) in enumerate(paths.items()):
        for axis in range(3):
            axes[axis].plot(time, tip[:, axis], label=label, **_line(i, np.size(time)))
    farthest = max((np.nanmax(np.abs(tip), initial=0.0) for _, tip in paths.values()), default=0.0)
    for axis, name in enumerate(AXES):
        axes[axis].set_ylabel(f"tip {name} [m]")
        _require_span(axes[axis], 0.01 * farthest)
    axes[2].set_xlabel("time [s]")


def _require_span(axes: Axes, span: float) -> None:
    """Rounding errors are not to look like a motion."""
    low, high = axes.get_ylim()
    if high - low < span:
        axes.set_ylim((low + high - span) / 2, (low + high + span) / 2)


def _draw_tensions(axes: Axes, trajectory: Trajectory) -> None:
    values, time = np.asarray(_one(trajectory).tension), np.asarray(trajectory.time)
    for k in range(values.shape[1]):
        # thinner and thinner: where tensions are equal, all of them are still to be seen
        width = max(0.9, 3.2 - 0.75 * k)
        style: dict[str, Any] = {
            "label": f"tendon {k + 1}",
            "color": PALETTE[k % len(PALETTE)],
            "linewidth": width,
        }
        if len(time) == 1:
            axes.plot(time, values[:, k], "o", markersize=4.0 * width, **style)
        else:
            # row i holds what acted from row i - 1 on
            axes.stairs(values[1:, k], time, baseline=None, **style)
    axes.set(xlabel="time [s]", ylabel="tension [N]")
    axes.margins(y=0.1)
    _legend_above(axes)


def _line(i: int, rows: int = 2) -> dict[str, Any]:
    """How the i-th trajectory is drawn: as a line, or as a point if it has one row."""
    kind = {"linestyle": DASHES[i % len(DASHES)]} if rows > 1 else {"linestyle": "none", "marker": "o"}
    return {"color": PALETTE[i % len(PALETTE)], **kind}


def _legend_above(axes: Axes) -> None:
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, columnspacing=1.2, handlelength=1.8)


def _tips(trajectory: Tips) -> NDArray[np.float64]:
    if isinstance(trajectory, Trajectory):
        _one(trajectory)
    return np.asarray(trajectory.tip_position, dtype=float)


def _one(trajectory: Trajectory) -> Trajectory:
    if np.ndim(trajectory.y) == 4:
        raise ValueError(
            f"a batch of {len(trajectory.y)} trajectories cannot be drawn in one figure; index one, batch[0]"
        )
    return trajectory


# matplotlib


def require_matplotlib() -> None:
    """Raise `ImportError`, saying how to install it, if matplotlib is not there."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise ImportError("figures need matplotlib: pip install 'knode-cosserat[viz]'") from None


def _style() -> Any:
    require_matplotlib()
    import matplotlib

    return matplotlib.rc_context(STYLE)


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained", dpi=150)
