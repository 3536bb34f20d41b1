"""Output of every study: tables as text, cells as JSON, and figures; the paper's result table.

A cell that could not be computed has a reason in place of values, and is shown with it.
"""

from __future__ import annotations

import csv
import io
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from knode_cosserat._files.writing import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: metrics: key in a cell, title, and factor of the cell's value; the first two are the paper's
MEASURES = {
    "tip_dtw": ("Tip DTW [m]", 1.0),
    "pose_mse": ("Pose MSE [1e-3]", 1.0),
    "rotation_rmse": ("Angle between orientations, RMS [degrees]", math.degrees(1.0)),
}
PAPER_MEASURES = ("tip_dtw", "pose_mse")
#: cells: metrics of one method with one seed in one case; if they are None, `failed` has the reason
Cells = Sequence[Mapping[str, Any]]


class Published(NamedTuple):
    """Published tip DTW and pose MSE of a case, and those of one rerun of the paper's method."""

    baseline: tuple[float, float]
    learned: tuple[float, float]
    rerun: tuple[float, float]


class Spread(NamedTuple):
    """One metric over the seeds of a method."""

    values: tuple[float, ...]
    #: reasons of the failed seeds
    failures: tuple[str, ...]

    @property
    def mean(self) -> float | None:
        """Mean over seeds; None without values."""
        return statistics.fmean(self.values) if self.values else None

    @property
    def deviation(self) -> float | None:
        """Standard deviation between seeds; None for fewer than two."""
        return statistics.stdev(self.values) if len(self.values) > 1 else None


#: values of the keys of a case
Case = tuple[Any, ...]
#: keys of a cell that are its case in the paper's table
CASE = ("imperfection", "control")


def spreads(
    cells: Cells, measure: str, factor: float = 1.0, by: Sequence[str] = CASE
) -> dict[Case, dict[str, Spread]]:
    """Return the values of a metric, times a factor, by case and method, in the order of the cells.

    Args:
        cells: cells of one or more methods and seeds.
        measure: key of the metric.
        factor: factor of its values.
        by: keys of the cells whose values are a case.
    """
    found: dict[Case, dict[str, Spread]] = {}
    for cell in cells:
        methods = found.setdefault(tuple(cell[key] for key in by), {})
        values, failures = methods.get(cell["method"], Spread((), ()))
        value = cell[measure]
        if value is None:
            failures = (*failures, cell.get("failed", "no reason given"))
        else:
            values = (*values, factor * value)
        methods[cell["method"]] = Spread(values, failures)
    return found


_COLUMNS = (
    "imperfection",
    "control",
    "measure",
    "method",
    "mean",
    "deviation",
    "least",
    "most",
    "seeds",
    "failed",
    "paper_baseline",
    "paper_knode",
    "rerun_knode",
    "ratio_to_paper_knode",
)


def as_csv(cells: Cells, published: Mapping[Case, Published]) -> str:
    """Return CSV with a line per case, method and metric: mean, deviation, published values and ratio."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for k, measure in enumerate(MEASURES):
        for case, methods in spreads(cells, measure).items():
            known = case in published and measure in PAPER_MEASURES
            paper = [figures[k] for figures in published[case]] if known else [None] * 3
            for method, spread in methods.items():
                values, mean = spread.values, spread.mean
                ends = [min(values), max(values)] if values else [None, None]
                counts = [len(values) + len(spread.failures), len(spread.failures)]
                ratio = mean / paper[1] if mean is not None and paper[1] else None
                writer.writerow(
                    [*case, measure, method, mean, spread.deviation, *ends, *counts, *paper, ratio]
                )
    return file.getvalue()


def as_markdown(cells: Cells, published: Mapping[Case, Published], notes: Sequence[str] = ()) -> str:
    """Return Markdown with one table per metric, with published values beside ours, and the failures.

    The paper has no angles between orientations, so that table has no columns of it.
    """
    ratios = " Ratios are to the paper's KNODE; less is better." if published else ""
    parts = [f"Mean and standard deviation over seeds.{ratios}"]
    for k, (measure, (title, factor)) in enumerate(MEASURES.items()):
        found = spreads(cells, measure, factor)
        known = bool(published) and measure in PAPER_MEASURES
        methods = list(dict.fromkeys(method for by_method in found.values() for method in by_method))
        heads = ["imperfection", "control"]
        heads += ["paper: baseline", "paper: KNODE", "its rerun"] if known else []
        for method in methods:
            heads += [method, "ratio"] if known and method != "baseline" else [method]
        rows = []
        for case, by_method in found.items():
            paper = published.get(case)
            row = list(case)
            if known:
                row += [f"{figures[k]:.2f}" for figures in paper] if paper else [""] * 3
            for method in methods:
                spread = by_method.get(method, Spread((), ()))
                row.append(in_words(spread))
                if known and method != "baseline":
                    row.append(ratio_in_words(spread.mean, paper.learned[k] if paper else 0.0))
            rows.append(row)
        parts += [f"## {title}", markdown_table(heads, rows)]
    if failed := failures(cells, "imperfection", "control", "method"):
        parts += ["What failed:", "\n".join(failed)]
    return "\n\n".join([*parts, *notes]) + "\n"


def in_words(spread: Spread) -> str:
    """Return mean, deviation and failures as text: `0.0123 ± 0.0004`, `1.2 (2 of 5 failed)`."""
    total = len(spread.values) + len(spread.failures)
    if total == 0:
        return ""
    if spread.mean is None:
        return "failed" if total == 1 else f"failed ({total} of {total})"
    text = f"{spread.mean:.3g}"
    if spread.deviation is not None:
        text += f" ± {spread.deviation:.1g}"
    return f"{text} ({len(spread.failures)} of {total} failed)" if spread.failures else text


def ratio_in_words(value: float | None, published: float) -> str:
    """Return the ratio of a value to the published one as text; `-` for a published zero."""
    if value is None or published == 0.0:
        return "" if value is None else "-"
    ratio = value / published
    if not 0.0 < ratio < 0.1:
        return f"{ratio:.2f}"
    return f"1/{1.0 / ratio:,.0f}" if ratio > 1e-5 else f"1/{1.0 / ratio:.1e}"


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with columns as wide as their widest cells."""
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |"
        for row in (heads, ["-" * width for width in widths], *rows)
    ]
    return "\n".join(lines)


class Report(NamedTuple):
    """Results of a study and its files; the first table is in Markdown."""

    cells: Cells
    tables: list[Path]
    figures: list[Path]


def as_json(cells: Cells) -> str:
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


def write_report(
    out: Path,
    name: str,
    cells: Cells,
    text: str,
    figures: Mapping[str, Figure] = MappingProxyType({}),
    others: Mapping[str, str] = MappingProxyType({}),
) -> Report:
    """Write a study's table, its cells, figures by name and other texts by file name, and return all."""
    out.mkdir(parents=True, exist_ok=True)
    tables = write_texts(out, {f"{name}.md": text, f"{name}.json": as_json(cells), **others})
    return Report(cells, tables, write_figures(out, figures))


def failures(cells: Cells, *keys: str) -> list[str]:
    """Return a line of text for each cell that failed: these values of it, and the reason."""

    def words(cell: Mapping[str, Any]) -> str:
        return ", ".join(f"seed {cell[key]}" if key == "seed" else str(cell[key]) for key in keys)

    return [f"- {words(cell)}: {cell['failed']}" for cell in cells if "failed" in cell]


def write_texts(out: Path, texts: Mapping[str, str]) -> list[Path]:
    """Write texts to files by name, each atomically, and return their paths."""
    for name, text in texts.items():
        with replacing(out / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return [out / name for name in texts]


def write_figures(out: Path, figures: Mapping[str, Figure]) -> list[Path]:
    """Write each figure to OUT/figures/NAME.png and return the paths."""
    paths = [out / "figures" / f"{name}.png" for name in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        path.parent.mkdir(exist_ok=True)
        figure.savefig(path)
    return paths
