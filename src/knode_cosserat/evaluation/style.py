"""Style of all figures: colours, widths and fonts."""

from __future__ import annotations

from typing import Any

#: Okabe and Ito's colour-blind safe palette, without yellow, which is hard to see on paper
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
#: line styles by trajectory, so that overlapping lines remain distinguishable
DASHES = ("-", "--", "-.", ":")
TIME_COLOURS = "viridis"
#: width of a figure in one column of a paper, and in two (in)
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
    # TrueType: fonts are embedded and text is searchable; journals reject Type 3
    "pdf.fonttype": 42,
    "ps.fonttype": 42,
    # letters as paths, which do not depend on installed fonts
    "svg.fonttype": "path",
    "svg.hashsalt": "knode-cosserat",
    "savefig.dpi": 220,
}


def require_matplotlib() -> None:
    """Raise `ImportError` with the installation command if matplotlib is not installed."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise ImportError("figures need matplotlib: pip install 'knode-cosserat[viz]'") from None


def style() -> Any:
    """Return the matplotlib context with the style of all figures."""
    require_matplotlib()
    import matplotlib

    return matplotlib.rc_context(STYLE)


def width_of(columns: int) -> float:
    """Return the width (in) of a figure in one or two columns of a paper.

    Raises:
        ValueError: the number of columns is not 1 or 2.
    """
    if columns not in (1, 2):
        raise ValueError(f"columns is {columns!r}; allowed is 1 or 2, the columns of a paper")
    return ONE_COLUMN if columns == 1 else TWO_COLUMNS
