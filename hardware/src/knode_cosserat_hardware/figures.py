"""Figure of a load cell's calibration; needs matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from knode_cosserat.figures.style import PALETTE, TWO_COLUMNS, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from knode_cosserat_hardware.calibration import LoadCellFit


def load_cell(fit: LoadCellFit) -> Figure:
    """Return a figure of a load cell's calibration: readings with the fitted line, and residuals in order.

    Raises:
        ImportError: matplotlib is not installed.
    """
    top = int(np.argmax(fit.weight))
    legs = (("loading", slice(0, top + 1), "o"), ("unloading", slice(top + 1, None), "s"))
    with new_figure(TWO_COLUMNS, 2.6) as figure:
        line, residual = figure.subplots(1, 2)
        ends = np.array([fit.weight.min(), fit.weight.max()])
        label = f"{fit.gain:.5g} ± {fit.gain_error:.1g} N per unit"
        line.plot(ends, fit.offset + ends / fit.gain, color=PALETTE[6], label=label)
        for k, (name, rows, marker) in enumerate(legs):
            if len(fit.weight[rows]):
                line.plot(fit.weight[rows], fit.reading[rows], marker, color=PALETTE[k], label=name)
                residual.plot(fit.weight[rows], 1e3 * fit.residual[rows], f"{marker}-", color=PALETTE[k])
        line.set(xlabel="weight [N]", ylabel="reading", title=f"R² = {fit.r_squared:.6f}")
        line.legend()
        residual.axhline(0.0, color=PALETTE[6], lw=0.6)
        residual.set(
            xlabel="weight [N]", ylabel="residual [mN]", title="residuals in the order of the weights"
        )
    return figure
