"""Figure that is saved in the package's style, independent of the user's settings. It needs matplotlib."""

from __future__ import annotations

import io
from typing import Any

from matplotlib.figure import Figure

from knode_cosserat.evaluation.style import style


class StyledFigure(Figure):
    """Figure with the package's fonts and resolution, which matplotlib reads only when it saves."""

    def savefig(self, *args: Any, **options: Any) -> None:
        """Save the figure as matplotlib does, in the package's style."""
        with style():
            super().savefig(*args, **options)

    def _repr_png_(self) -> bytes:
        """Return the PNG that a notebook displays."""
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=120)
        return file.getvalue()
