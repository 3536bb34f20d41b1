"""Figure of a workspace; it needs matplotlib, the extra `viz`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from knode_cosserat.evaluation.drawing import new_figure
from knode_cosserat.evaluation.style import TIME_COLOURS, TWO_COLUMNS, require_matplotlib, style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from knode_cosserat.statics.workspace import Workspace

#: largest number of drawn points: more only make the file larger
MOST_POINTS = 100_000


def workspace_seen(found: Workspace) -> Figure:
    """Return a figure of tips from the side and from above, coloured by the sum of the controls.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: no sample is solved, or positions do not have three coordinates.
    """
    require_matplotlib()
    if not (hasattr(found, "position") and hasattr(found, "valid")):
        raise TypeError(f"found is a {type(found).__name__}; allowed is a Workspace")
    if found.position.shape[1] != 3 or not found.valid.any():
        raise ValueError("there is no solved sample with three coordinates to draw")
    shown = np.flatnonzero(found.valid)[:MOST_POINTS]
    x, y, z = found.position[shown].T
    total = found.controls[shown].sum(axis=1)
    with style():
        figure = new_figure(TWO_COLUMNS, 3.2)
        for k, (across, up, names) in enumerate(((x, z, "xz"), (x, y, "xy"))):
            axes = figure.add_subplot(1, 2, k + 1)
            points = axes.scatter(across, up, c=total, s=1, cmap=TIME_COLOURS, rasterized=True, linewidths=0)
            axes.set(xlabel=f"{names[0]} [m]", ylabel=f"{names[1]} [m]", aspect="equal")
        figure.colorbar(points, ax=figure.axes, label=f"sum of the controls{_unit(found)}")
    return figure


def _unit(found: Workspace) -> str:
    units = {field.unit for field in found.system.control_layout.fields}
    return f" [{units.pop()}]" if len(units) == 1 else ""
