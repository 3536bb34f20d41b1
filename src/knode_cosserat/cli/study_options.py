"""Options and output shared by the study commands."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from knode_cosserat.cli.arguments import figures, require_writable, shows_progress
from knode_cosserat.cli.output import write_output

if TYPE_CHECKING:
    from knode_cosserat.studies.report import Report

Out = Annotated[Path, typer.Option(metavar="DIR", help="Output folder; created if it does not exist.")]
Seeds = Annotated[int, typer.Option(metavar="N", min=1, help="Number of random seeds, 0 to N - 1.")]
Workers = Annotated[
    int | None,
    typer.Option(
        metavar="N", min=1, help="Worker processes on this machine.", show_default="one per four cores"
    ),
]
Dask = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS", help="Run on the Dask cluster of this scheduler, such as tcp://host:8786."
    ),
]


def prepare(out: Path, workers: int | None, dask: str | None) -> None:
    """Check options, output folder and matplotlib before a long run."""
    if workers and dask:
        raise ValueError("--workers is for this machine and --dask for a cluster; give one of them")
    require_writable(folders=[out])
    figures()


def selected_names(option: str, names: str | None, known: Iterable[str]) -> list[str]:
    """Return the selected names in the order of the table. A known name may contain a comma."""
    if names is None:
        return list(known)
    rest = f"{names},"
    selected = set()
    while rest.strip():
        # the longest match: one name may begin with another
        name = max((each for each in known if rest.startswith(f"{each},")), key=len, default=None)
        if name is None:
            wrong = rest.partition(",")[0].strip()
            raise ValueError(f"--{option}: {wrong!r} is unknown; allowed is a subset of {', '.join(known)}")
        selected.add(name)
        rest = rest.removeprefix(f"{name},").strip()
    return [name for name in known if name in selected]


def run_study(
    rerun: Callable[..., Report],
    facts: dict[str, Any],
    out: Path,
    workers: int | None,
    dask: str | None,
    progress: bool | None,
    as_json: bool,
) -> None:
    """Run a study; print its table, the files written and the computing time."""
    began = perf_counter()
    report = rerun(workers=workers, dask=dask, progress=shows_progress(progress))
    seconds = perf_counter() - began
    failed = sum("failed" in cell for cell in report.cells)
    facts |= {
        "cells": len(report.cells),
        "failed": failed,
        "computing_time": round(seconds, 2),
        "written": [str(path) for path in report.tables + report.figures],
    }
    lines = [
        report.tables[0].read_text(encoding="utf-8"),
        f"{len(report.cells)} cells ({failed} failed) in {seconds:.0f} s",
        *(f"wrote {path}" for path in report.tables),
        _figures_line(report.figures, out),
    ]
    write_output(as_json, facts, lines, out=out if as_json else None)


def _figures_line(figures: Sequence[Path], out: Path) -> str:
    return f"wrote {len(figures)} figure{'s' * (len(figures) > 1)} to {out / 'figures'}"
