"""Figure of a released beam: measured and predicted tip drop."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.evaluation.comparison import REFERENCE
from knode_cosserat.evaluation.drawing import new_figure
from knode_cosserat.evaluation.style import PALETTE, TWO_COLUMNS, style
from studies.beam_recordings import BeamRecording, tip_drop

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: line styles of predictions, by method
METHODS: dict[str, dict[str, Any]] = {
    "nominal": {"color": PALETTE[1], "linewidth": 0.8},
    "identified": {"color": PALETTE[0], "linewidth": 1.0},
}
#: duration of the enlarged motion after the release (s)
SHOWN = 1.5


def drops(
    recordings: Sequence[BeamRecording],
    predictions: Mapping[str, Mapping[str, Float[np.ndarray, "T 3 3"]]],
    train: Collection[str],
) -> Figure:
    """Return a figure of the tip drop over time, a row per recording: first 1.5 s left, all right.

    Raises:
        ImportError: matplotlib is not installed.
    """
    with style():
        figure = new_figure(TWO_COLUMNS, 1.7 * len(recordings) + 0.4)
        grid = figure.subplots(len(recordings), 2, squeeze=False, width_ratios=(1.6, 1.0), sharey="row")
        for row, each in zip(grid, recordings, strict=True):
            time = each.time - each.crossing
            for axes in row:
                axes.plot(time, 1e3 * each.drop, label="measured", **REFERENCE)
                for method, predicted in predictions[each.name].items():
                    axes.plot(time, 1e3 * tip_drop(predicted), label=method, **METHODS[method])
                axes.invert_yaxis()
            use = "training" if each.name in train else "held out"
            row[0].set(ylabel="tip drop [mm]", xlim=(-0.1, SHOWN))
            row[0].set_title(f"load {1e3 * each.load:g} g, {use} ({each.name})")
            row[1].set_xlim(-0.1, float(time[-1]))
        for axes in grid[-1]:
            axes.set_xlabel("time from the release [s]")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure
