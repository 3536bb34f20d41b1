"""Figures of trajectories in one style, for a screen or a paper; they need matplotlib, the extra `viz`.

Every function returns a new `matplotlib.figure.Figure`; `animate` and `evaluation_page` write a file. No
window is opened and no global setting changes. `figure.savefig("it.pdf")` (or .svg, .png) embeds the fonts.
The colours are Okabe and Ito's, and every axis has its unit. `columns` sets the width: one column of a paper
(3.5 in) or two (7.16 in). `trajectories` is one trajectory, or a dict of several by label, which are
overlaid. Each is of one robot; unsolved rows stay empty.

Raises, from every function here:
    ImportError: matplotlib is not installed.
    ValueError: there is nothing to draw, or a batch is given where one robot is required.
"""

from knode_cosserat.figures.animation import animate
from knode_cosserat.figures.comparison import compare
from knode_cosserat.figures.page import evaluation_page
from knode_cosserat.figures.recordings import health, prediction_against_measurement
from knode_cosserat.figures.residuals import residual
from knode_cosserat.figures.summary import summary
from knode_cosserat.figures.trajectories import (
    closed_loop,
    curves,
    error,
    overview,
    path,
    shape,
    spread,
    states,
    tensions,
    tips,
    vibration,
    workspace,
)

__all__ = [
    "animate", "closed_loop", "compare", "curves", "error", "evaluation_page", "health", "overview", "path",
    "prediction_against_measurement", "residual", "shape", "spread", "states", "summary", "tensions",
    "tips", "vibration", "workspace",
]  # fmt: skip
