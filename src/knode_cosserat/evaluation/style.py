"""The one style of all figures: colours, widths, fonts."""

from __future__ import annotations

from typing import Any

#: Okabe and Ito's colours, which the colour-blind can tell apart, without the yellow that vanishes on paper
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
#: the second trajectory and so on, which may lie on the first
DASHES = ("-", "--", "-.", ":")
TIME_COLOURS = "viridis"
#: inches: the width of a figure in one column of a paper, and in both
ONE_COLUMN, TWO_COLUMNS = 3.5, 7.16
STYLE: Any = {
    "font.size": 8,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "mathtext.fontset": "dejavusans",
    "axes.titlesize": 8,
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.titlesize": 9,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "lines.linewidth": 1.3,
    "lines.markersize": 4,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    # TrueType: fonts are part of the file and its text can be searched; journals turn down Type 3
    "pdf.fonttype": 42,
    "ps.fonttype": 42,
    # letters as shapes: they look the same where the font is missing
    "svg.fonttype": "path",
    "svg.hashsalt": "knode-cosserat",
    "savefig.dpi": 220,
}


def require_matplotlib() -> None:
    """Raise `ImportError`, saying how to install it, if matplotlib is not there."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise ImportError("figures need matplotlib: pip install 'knode-cosserat[viz]'") from None


def style() -> Any:
    """The context in which all figures are made."""
    require_matplotlib()
    import matplotlib

    return matplotlib.rc_context(STYLE)


def width_of(columns: int) -> float:
    """Inches of a figure that is as wide as one column of a paper, or as two.

    Raises:
        ValueError: another number.
    """
    if columns not in (1, 2):
        raise ValueError(f"columns is {columns!r}; allowed is 1 or 2, the columns of a paper")
    return ONE_COLUMN if columns == 1 else TWO_COLUMNS
