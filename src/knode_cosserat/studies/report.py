"""What every study writes: a table as text, its cells as JSON, figures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from knode_cosserat._files import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Report(NamedTuple):
    """What a study found, and the files that tell it; the first table is in Markdown."""

    cells: Sequence[Mapping[str, Any]]
    tables: list[Path]
    figures: list[Path]


def as_json(cells: Sequence[Mapping[str, Any]]) -> str:
    """A list with one cell a line."""
    return "[\n" + ",\n".join(json.dumps(cell, allow_nan=False) for cell in cells) + "\n]\n"


def write_texts(out: Path, texts: Mapping[str, str]) -> list[Path]:
    """Files of these names, each whole or not at all."""
    for name, text in texts.items():
        with replacing(out / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return [out / name for name in texts]


def write_figures(out: Path, figures: Mapping[str, Figure]) -> list[Path]:
    """OUT/figures/NAME.png for each."""
    (out / "figures").mkdir(exist_ok=True)
    paths = [out / "figures" / f"{name}.png" for name in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        figure.savefig(path)
    return paths
