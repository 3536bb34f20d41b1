"""The paper's result table: two figures for each case and method over all seeds, and the paper's own.

A case is an imperfection under a control. A cell that could not be computed has no figures but a reason, and
is shown with it.
"""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple, NotRequired, TypedDict

#: the two figures, as in a cell and as a title
MEASURES = {"tip_dtw": "Tip DTW [m]", "pose_mse": "Pose MSE [1e-3]"}


class Cell(TypedDict):
    """The figures of one method, from one seed, in one case; None if there are none, and then the reason."""

    imperfection: str
    control: str
    method: str
    seed: int
    tip_dtw: float | None
    pose_mse: float | None
    failed: NotRequired[str]


class Published(NamedTuple):
    """Tip DTW and pose MSE of a case as the paper has them, and as one rerun of its method has."""

    baseline: tuple[float, float]
    learned: tuple[float, float]
    rerun: tuple[float, float]


class Spread(NamedTuple):
    """One figure over the seeds of a method."""

    values: tuple[float, ...]
    #: why the others have none
    failures: tuple[str, ...]

    @property
    def mean(self) -> float | None:
        """The mean; None if there is no figure."""
        return statistics.fmean(self.values) if self.values else None

    @property
    def deviation(self) -> float | None:
        """The standard deviation between seeds; None of fewer than two."""
        return statistics.stdev(self.values) if len(self.values) > 1 else None


Case = tuple[str, str]


def spreads(cells: Sequence[Cell], measure: str) -> dict[Case, dict[str, Spread]]:
    """The figures named by `measure`, for each case and method, in the order in which they come."""
    found: dict[Case, dict[str, Spread]] = {}
    for cell in cells:
        methods = found.setdefault((cell["imperfection"], cell["control"]), {})
        values, failures = methods.get(cell["method"], Spread((), ()))
        value = cell[measure]  # type: ignore[literal-required]
        if value is None:
            failures = (*failures, cell.get("failed", "no reason given"))
        else:
            values = (*values, value)
        methods[cell["method"]] = Spread(values, failures)
    return found


_COLUMNS = (
    "imperfection", "control", "measure", "method", "mean", "deviation", "least", "most", "seeds", "failed",
    "paper_baseline", "paper_knode", "rerun_knode", "ratio_to_paper_knode",
)  # fmt: skip


def as_csv(cells: Sequence[Cell], published: Mapping[Case, Published]) -> str:
    """A line for each case, method and measure: mean, deviation, the paper's figures, and the ratio to it."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for k, measure in enumerate(MEASURES):
        for case, methods in spreads(cells, measure).items():
            paper = [figures[k] for figures in published[case]] if case in published else [None] * 3
            for method, spread in methods.items():
                values, mean = spread.values, spread.mean
                ends = [min(values), max(values)] if values else [None, None]
                counts = [len(values) + len(spread.failures), len(spread.failures)]
                ratio = mean / paper[1] if mean is not None and paper[1] else None
                writer.writerow(
                    [*case, measure, method, mean, spread.deviation, *ends, *counts, *paper, ratio]
                )
    return file.getvalue()


def as_markdown(cells: Sequence[Cell], published: Mapping[Case, Published], notes: Sequence[str] = ()) -> str:
    """One table for each measure, the paper's figures beside ours, and what failed below."""
    parts = ["Mean and standard deviation over seeds. Ratios are to the paper's KNODE; less is better."]
    for k, (measure, title) in enumerate(MEASURES.items()):
        found = spreads(cells, measure)
        methods = list(dict.fromkeys(method for by_method in found.values() for method in by_method))
        heads = ["imperfection", "control", "paper: baseline", "paper: KNODE", "its rerun"]
        for method in methods:
            heads += [method] if method == "baseline" else [method, "ratio"]
        rows = []
        for case, by_method in found.items():
            paper = published.get(case)
            row = [*case, *(f"{figures[k]:.2f}" if paper else "" for figures in paper or [(0.0, 0.0)] * 3)]
            for method in methods:
                spread = by_method.get(method, Spread((), ()))
                row.append(in_words(spread))
                if method != "baseline":
                    row.append(ratio_in_words(spread.mean, paper.learned[k] if paper else 0.0))
            rows.append(row)
        parts += [f"## {title}", markdown_table(heads, rows)]
    failures = [
        f"- {case[0]}, {case[1]}, {method}: {reason}"
        for case, by_method in spreads(cells, "tip_dtw").items()
        for method, spread in by_method.items()
        for reason in spread.failures
    ]
    if failures:
        parts += ["What failed:", "\n".join(failures)]
    return "\n\n".join([*parts, *notes]) + "\n"


def in_words(spread: Spread) -> str:
    """Mean and deviation, and how many failed: `0.0123 ± 0.0004`, `1.2 (2 of 5 failed)`."""
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
    """How large a figure is beside the published one; nothing beside a published zero."""
    if value is None or published == 0.0:
        return "" if value is None else "-"
    ratio = value / published
    if not 0.0 < ratio < 0.1:
        return f"{ratio:.2f}"
    return f"1/{1.0 / ratio:,.0f}" if ratio > 1e-5 else f"1/{1.0 / ratio:.1e}"


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, its columns as wide as their widest cells."""
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |"
        for row in (heads, ["-" * width for width in widths], *rows)
    ]
    return "\n".join(lines)
