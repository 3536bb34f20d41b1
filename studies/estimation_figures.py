"""Figure of estimated and true states."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from knode_cosserat.evaluation.comparison import METHODS, REFERENCE
from knode_cosserat.evaluation.drawing import new_figure
from knode_cosserat.evaluation.style import TWO_COLUMNS, style
from knode_cosserat.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: quantity, component, node and title of each panel
_SHOWN = (
    ("q", 0, -1, "tip: q along x [m/s]"),
    ("w", 1, -1, "tip: ω about y [rad/s]"),
    ("n", 0, 0, "base: n along x [N]"),
    ("m", 1, 0, "base: m about y [N m]"),
)


def estimated_states(
    truth: Trajectory, estimates: Mapping[str, Trajectory], span: tuple[float, float]
) -> Figure:
    """Return a figure of tip velocities, base force and base moment over a time span (s), with their errors.

    Raises:
        ImportError: matplotlib is not installed.
    """
    with style():
        figure = new_figure(TWO_COLUMNS, 6.2)
        grid = figure.subplots(4, 2, sharex=True, height_ratios=(2, 1, 2, 1))
        for k, (name, component, node, title) in enumerate(_SHOWN):
            above, below = grid[2 * (k // 2), k % 2], grid[2 * (k // 2) + 1, k % 2]
            true = np.asarray(truth.part(name))[:, node, component]
            above.plot(truth.time, true, label="truth", **REFERENCE)
            for method, estimate in estimates.items():
                found = np.asarray(estimate.part(name))[:, node, component]
                above.plot(estimate.time, found, label=method, **METHODS[method])
                at_rows = np.interp(np.asarray(estimate.time), np.asarray(truth.time), true)
                below.plot(estimate.time, found - at_rows, label=method, **METHODS[method])
            inside = (np.asarray(truth.time) >= span[0]) & (np.asarray(truth.time) <= span[1])
            low, high = true[inside].min(), true[inside].max()
            room = 0.1 * (high - low)
            above.set(title=title, xlim=span, ylim=(low - room, high + room))
            below.set(ylabel="error", ylim=(-1.5 * room, 1.5 * room))
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure
