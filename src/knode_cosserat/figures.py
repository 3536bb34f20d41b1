"""Figures of trajectories in one style, for a screen or a paper; they need matplotlib, the extra `viz`.

Every function returns a new `matplotlib.figure.Figure`. No window is opened and no global setting changes.
"""

from knode_cosserat.evaluation.control_figures import closed_loop
from knode_cosserat.evaluation.figures import (
    animate,
    compare,
    curves,
    error,
    overview,
    path,
    prediction_against_measurement,
    require_matplotlib,
    shape,
    spread,
    states,
    tensions,
    tips,
    workspace,
)

__all__ = [
    "animate",
    "closed_loop",
    "compare",
    "curves",
    "error",
    "overview",
    "path",
    "prediction_against_measurement",
    "require_matplotlib",
    "shape",
    "spread",
    "states",
    "tensions",
    "tips",
    "workspace",
]
