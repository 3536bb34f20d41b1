"""Style of all figures: colours, widths and fonts."""

from __future__ import annotations

import contextlib
import functools
import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from knode_cosserat._files.writing import replacing

#: Okabe and Ito's colour-blind safe palette, without yellow, which is hard to see on paper
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
#: line styles by trajectory, so that overlapping lines remain distinguishable
DASHES = ("-", "--", "-.", ":")
TIME_COLOURS = "viridis"
#: width of a figure in one column of a paper, and in two (in)
ONE_COLUMN, TWO_COLUMNS = 3.5, 7.16
#: fonts, lines and file formats
STYLE = Path(__file__).with_name("figures.mplstyle")


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

    return matplotlib.rc_context(fname=STYLE)


def width_of(columns: int) -> float:
    """Return the width (in) of a figure in one or two columns of a paper.

    Raises:
        ValueError: the number of columns is not 1 or 2.
    """
    if columns not in (1, 2):
        raise ValueError(f"columns is {columns!r}; allowed is 1 or 2, the columns of a paper")
    return ONE_COLUMN if columns == 1 else TWO_COLUMNS


@contextlib.contextmanager
def new_figure(width: float, height: float) -> Iterator[Any]:
    """Give an empty figure of a size (in) to draw in, in the style of all figures."""
    with style():
        yield _styled_figure()(figsize=(width, height), layout="constrained", dpi=150)


@functools.cache
def _styled_figure() -> Any:
    """Return the class of figures that are saved in this style; matplotlib is imported on first use."""
    import matplotlib
    from matplotlib.figure import Figure

    class StyledFigure(Figure):
        """Figure with the package's fonts and resolution, which matplotlib reads only when it saves."""

        def savefig(self, fname: Any, **options: Any) -> None:
            """Save the figure in the package's style; a file is written whole or not at all."""
            with style():
                if not isinstance(fname, (str, os.PathLike)):
                    super().savefig(fname, **options)
                    return
                path, file = Path(fname), io.BytesIO()
                kind = path.suffix[1:] or str(matplotlib.rcParams["savefig.format"])
                super().savefig(file, **({"format": kind} | options))
            with replacing(path if path.suffix else path.with_suffix(f".{kind}")) as temporary:
                temporary.write_bytes(file.getvalue())

        def _repr_png_(self) -> bytes:
            """Return the PNG that a notebook displays."""
            file = io.BytesIO()
            self.savefig(file, format="png", dpi=120)
            return file.getvalue()

    return StyledFigure
