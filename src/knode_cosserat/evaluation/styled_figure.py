"""Figure that is saved in the package's style, independent of the user's settings. It needs matplotlib."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from knode_cosserat._files.writing import replacing
from knode_cosserat.evaluation.style import style


class StyledFigure(Figure):
    """Figure with the package's fonts and resolution, which matplotlib reads only when it saves."""

    def savefig(self, fname: Any, **options: Any) -> None:
        """Save the figure in the package's style; a file is written whole or not at all."""
        if not isinstance(fname, (str, os.PathLike)):
            with style():
                super().savefig(fname, **options)
            return
        path = Path(fname)
        file = io.BytesIO()
        with style():
            kind = path.suffix[1:] or str(matplotlib.rcParams["savefig.format"])
            super().savefig(file, **({"format": kind} | options))
        with replacing(path if path.suffix else path.with_suffix(f".{kind}")) as temporary:
            temporary.write_bytes(file.getvalue())

    def _repr_png_(self) -> bytes:
        """Return the PNG that a notebook displays."""
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=120)
        return file.getvalue()
