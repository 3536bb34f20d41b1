"""Options and output that the commands of studies share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from knode_cosserat.cli.arguments import figures, require_writable, wanted
from knode_cosserat.cli.telling import tell

if TYPE_CHECKING:
    from knode_cosserat.studies.report import Report

Out = Annotated[
    Path, typer.Option(metavar="DIR", help="Folder for what is written; made if it is not there.")
]
Seeds = Annotated[int, typer.Option(metavar="N", min=1, help="How many seeds: 0 to N - 1.")]
Workers = Annotated[
    int | None,
    typer.Option(
        metavar="N", min=1, help="Processes on this machine.", show_default="one for every four cores"
    ),
]
Dask = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Run the jobs on the Dask cluster with this scheduler."),
]


def prepare(out: Path, workers: int | None, dask: str | None) -> None:
    """Whatever would only be noticed at the end is said at the beginning."""
    if workers and dask:
        raise ValueError("--workers is for this machine and --dask for a cluster; give one of them")
    require_writable(folders=[out])
    figures()


def chosen_of(option: str, given: str | None, known: Iterable[str]) -> list[str]:
    """Return the requested names, in the order of the table. A known name may contain a comma."""
    if given is None:
        return list(known)
    rest = f"{given},"
    found = set()
    while rest.strip():
        # the longest, for one name may begin with another
        name = max((each for each in known if rest.startswith(f"{each},")), key=len, default=None)
        if name is None:
            wrong = rest.partition(",")[0].strip()
            raise ValueError(f"--{option}: {wrong!r} is unknown; allowed is some of {', '.join(known)}")
        found.add(name)
        rest = rest.removeprefix(f"{name},").strip()
    return [name for name in known if name in found]


def run_study(
    rerun: Callable[..., Report],
    facts: dict[str, Any],
    out: Path,
    workers: int | None,
    dask: str | None,
    progress: bool | None,
    as_json: bool,
) -> None:
    """Run a study and tell what came out: its table, where things are, how long it took."""
    began = perf_counter()
    report = rerun(workers=workers, dask=dask, progress=wanted(progress))
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
        f"{len(report.cells)} cells, {failed} of them failed, in {seconds:.0f} s",
        *(f"wrote {path}" for path in report.tables),
        _told(report.figures, out),
    ]
    tell(as_json, facts, lines, out=out if as_json else None)


def _told(figures: Sequence[Path], out: Path) -> str:
    return f"wrote {len(figures)} figure{'s' * (len(figures) > 1)} to {out / 'figures'}"
