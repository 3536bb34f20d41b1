"""Output of every study: a table as text, its cells as JSON, and figures."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from knode_cosserat._files.writing import replacing
from studies.tables import markdown_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Report(NamedTuple):
    """Results of a study and its files; the first table is in Markdown."""

    cells: Sequence[Mapping[str, Any]]
    tables: list[Path]
    figures: list[Path]


def as_json(cells: Sequence[Mapping[str, Any]]) -> str:
    """Return a JSON list with one cell per line; numbers that are not finite are null."""

    def known(cell: Mapping[str, Any]) -> dict[str, Any]:
        unknown = {name for name, each in cell.items() if isinstance(each, float) and not math.isfinite(each)}
        return {name: None if name in unknown else each for name, each in cell.items()}

    return "[\n" + ",\n".join(json.dumps(known(cell), allow_nan=False) for cell in cells) + "\n]\n"


def check_row(name: str, value: float, limit: float, least: bool = False) -> dict[str, Any]:
    """Return a checked figure: check, value, limit, ok. `limit` is the greatest value, or the least one."""
    return {
        "check": name,
        "value": value,
        "limit": limit,
        "ok": bool(value >= limit if least else value <= limit),
    }


def checks_table(made: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of checked figures in Markdown."""
    rows = [
        [each["check"], f"{each['value']:.3g}", f"{each['limit']:g}", "yes" if each["ok"] else "no"]
        for each in made
    ]
    return markdown_table(["check", "value", "limit", "met"], rows)


def write_texts(out: Path, texts: Mapping[str, str]) -> list[Path]:
    """Write texts to files by name, each atomically, and return their paths."""
    for name, text in texts.items():
        with replacing(out / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return [out / name for name in texts]


def write_figures(out: Path, figures: Mapping[str, Figure]) -> list[Path]:
    """Write each figure to OUT/figures/NAME.png and return the paths."""
    (out / "figures").mkdir(exist_ok=True)
    paths = [out / "figures" / f"{name}.png" for name in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        figure.savefig(path)
    return paths
