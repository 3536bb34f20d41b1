"""Figure of a closed loop: path, error, controls and times."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from knode_cosserat.evaluation.comparison import REFERENCE
from knode_cosserat.evaluation.drawing import new_figure
from knode_cosserat.evaluation.style import PALETTE, TWO_COLUMNS, style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from knode_cosserat.control import LoopLog


def closed_loop(log: LoopLog) -> Figure:
    """Return a figure of a closed loop: path of the tip from above, error, controls, adapted parameters.

    Periods without a solution are marked. Without adapted parameters the last panel has the times of the
    computation.

    Raises:
        ImportError: matplotlib is not installed.
    """
    wanted, tip = log.reference[:, :2], log.tip[:, :2]
    fallback = np.array([status != "optimal" for status in log.status])
    with style():
        figure = new_figure(TWO_COLUMNS, 4.2)
        path, error, control, last = figure.subplots(2, 2).ravel()
        path.plot(*wanted.T, label="reference", **REFERENCE)
        path.plot(*tip.T, color=PALETTE[0], label="tip")
        path.set(xlabel="x [m]", ylabel="y [m]", title="path of the tip, from above", aspect="equal")
        path.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0))
        error.semilogy(log.time, 1e3 * np.maximum(log.tip_distance, 1e-6), color=PALETTE[0])
        for each in log.time[fallback]:
            error.axvspan(each, each + log.time[1] - log.time[0], color=PALETTE[1], alpha=0.3, lw=0)
        error.set(xlabel="time [s]", ylabel="distance [mm]", title="distance from the reference")
        for k, column in enumerate(log.control.T):
            control.step(log.time, column, where="post", color=PALETTE[k % len(PALETTE)], label=f"{k + 1}")
        low, high = float(log.control.min()), float(log.control.max())
        # room for the legend
        control.set(xlabel="time [s]", title="controls", ylim=(low, high + 0.25 * (high - low or 1.0)))
        control.legend(ncols=4, loc="upper left")
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
