"""Report of the simulation study: the table as Markdown, CSV and JSON, and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from knode_cosserat.evaluation import study_figures
from knode_cosserat.evaluation.tables import Cell, as_csv, as_markdown
from knode_cosserat.loading import load_trajectory
from knode_cosserat.studies import runner, simulation
from knode_cosserat.studies.report import Report, as_json, write_figures, write_texts
from knode_cosserat.trajectory import Trajectory

Facts = Mapping[str, Mapping[str, Any]]


def rerun(
    out: Path,
    *,
    seeds: Sequence[int],
    methods: Sequence[str],
    workers: int | None = None,
    dask: str | None = None,
    progress: bool = False,
) -> Report:
    """Run the study's pending jobs and write its table and figures into the folder.

    Args:
        out: the folder; an earlier run in it is continued.
        seeds: whole numbers.
        methods: some of those in `methods.METHODS`.
        workers: see `runner.run`.
        dask: see `runner.run`.
        progress: show a progress bar.

    Raises:
        StudyError: see `runner.run`.
    """
    jobs = simulation.jobs(seeds, methods)
    facts = runner.run(jobs, out, workers=workers, dask=dask, progress=progress)
    cells = cells_of(facts)
    return Report(cells, write_table(cells, out), draw(facts, methods, out))


def cells_of(facts: Facts) -> list[Cell]:
    """Return all cells of the jobs in the order of the paper's table: control, imperfection, method, seed."""
    cells = [cell for each in facts.values() for cell in each["cells"]]
    controls, imperfections = list(simulation.CONTROLS), list(simulation.IMPERFECTIONS)
    return sorted(
        cells, key=lambda it: (controls.index(it["control"]), imperfections.index(it["imperfection"]))
    )


def write_table(cells: Sequence[Cell], out: Path) -> list[Path]:
    """Write `table1.md`, `table1.csv` and `table1.json`."""
    return write_texts(
        out,
        {
            "table1.md": as_markdown(cells, simulation.PUBLISHED, simulation.NOTES),
            "table1.csv": as_csv(cells, simulation.PUBLISHED),
            "table1.json": as_json(cells),
        },
    )


def draw(facts: Facts, methods: Sequence[str], out: Path) -> list[Path]:
    """Write figures to OUT/figures: controls, shapes and tips of the first seed, losses of all."""
    truths = _trajectories(facts[simulation.REFERENCE], out)
    drawn = {"controls": study_figures.controls(truths)}
    for imperfection in simulation.IMPERFECTIONS:
        found = {method: _trajectories(facts[f"{imperfection}-{method}"], out) for method in methods}
        cases = {
            control: (truth, {method: each[control] for method, each in found.items() if control in each})
            for control, truth in truths.items()
        }
        drawn[f"tips-{imperfection}"] = study_figures.predicted_tips(cases)
        for control, (truth, predictions) in cases.items():
            if predictions:
                drawn[f"shapes-{imperfection}-{control}"] = study_figures.shapes(truth, predictions)
    losses = {
        imperfection: list(facts[f"{imperfection}-{method}"]["loss"].values())
        for method in methods
        for imperfection in simulation.IMPERFECTIONS
        if facts[f"{imperfection}-{method}"]["loss"]
    }
    if losses:
        drawn["loss"] = study_figures.losses(losses)
    return write_figures(out, drawn)


def _trajectories(facts: Mapping[str, Any], out: Path) -> dict[str, Trajectory]:
    return {control: load_trajectory(out / name) for control, name in facts["trajectories"].items()}
