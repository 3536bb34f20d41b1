"""The command that reruns the paper's studies."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer

from knode_cosserat.cli.arguments import Json, Progress, figures, wanted
from knode_cosserat.cli.program import app, examples, studies
from knode_cosserat.cli.telling import tell

app.add_typer(studies, name="study")


@studies.command(
    epilog=examples(
        "study simulation --out results",
        "study simulation --out results --methods baseline,best --seeds 1",
        "study simulation --out results --dask tcp://scheduler:8786",
    )
)
def simulation(
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for what is written; made if it is not there.")
    ],
    seeds: Annotated[int, typer.Option(metavar="N", min=1, help="How many seeds: 0 to N - 1.")] = 5,
    methods: Annotated[
        str | None,
        typer.Option(metavar="A,B,…", help="Some of baseline, paper, calibrated, best.", show_default="all"),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=1, help="Processes on this machine.", show_default="one for every four cores"
        ),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Run the jobs on the Dask cluster with this scheduler."),
    ] = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Rerun the paper's simulation study: four imperfect models, learned from two short sines each.

    Writes Table I beside the paper's figures (table1.md, .csv, .json), figures, trajectories and models. It
    goes on where an earlier run on the same folder stopped.
    """
    if workers and dask:
        raise ValueError("--workers is for this machine and --dask for a cluster; give one of them")
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: this is a file; allowed is a folder")
    figures()
    from knode_cosserat.studies.simulation_report import rerun

    chosen = _chosen(methods)
    began = perf_counter()
    report = rerun(
        out, seeds=range(seeds), methods=chosen, workers=workers, dask=dask, progress=wanted(progress)
    )
    seconds = perf_counter() - began
    table = next(path for path in report.tables if path.suffix == ".md")
    failed = sum("failed" in cell for cell in report.cells)
    facts = {
        "methods": chosen, "seeds": seeds, "cells": len(report.cells), "failed": failed,
        "computing_time": round(seconds, 2),
        "written": [str(path) for path in report.tables + report.figures],
    }  # fmt: skip
    lines = [
        table.read_text(encoding="utf-8"),
        f"{len(report.cells)} cells, {failed} of them failed, in {seconds:.0f} s",
        *(f"wrote {path}" for path in report.tables),
        f"wrote {len(report.figures)} figures to {out / 'figures'}, models to {out / 'models'}",
    ]
    tell(as_json, facts, lines, out=out if as_json else None)


def _chosen(methods: str | None) -> list[str]:
    """The methods asked for, in the order of the table."""
    from knode_cosserat.studies.methods import METHODS

    if methods is None:
        return list(METHODS)
    given = [name.strip() for name in methods.split(",")]
    for name in given:
        if name not in METHODS:
            raise ValueError(f"--methods: {name!r} is unknown; allowed is some of {', '.join(METHODS)}")
    return [name for name in METHODS if name in given]
