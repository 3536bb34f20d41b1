"""A figure that is written in our style, whatever the user's own settings are. It needs matplotlib."""

from __future__ import annotations

import io
from typing import Any

from matplotlib.figure import Figure

from knode_cosserat.evaluation.style import style


class StyledFigure(Figure):
    """Also fonts and resolution, which matplotlib takes from its settings only when it writes."""

    def savefig(self, *args: Any, **options: Any) -> None:
        """As matplotlib's, in our style."""
        with style():
            super().savefig(*args, **options)

    def _repr_png_(self) -> bytes:
        """What a notebook shows of the figure that a cell ends with."""
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=120)
        return file.getvalue()
