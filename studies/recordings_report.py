"""Report of the recordings' study: Table II and figures."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from studies import figures, recordings, runner, table_two_figures
from studies.recordings import DT, RecordingsOptions
from studies.report import Report, as_json, write_figures, write_texts
from studies.table_two_figures import Predicted
from studies.tables import Spread, in_words, markdown_table

Facts = Mapping[str, Mapping[str, Any]]
Cells = Sequence[Mapping[str, Any]]

#: the metrics: key in a cell, title, and factor of the cell's value
MEASURES = {
    "tip_dtw": ("Tip DTW [m]", 1.0),
    "pose_mse": ("Pose MSE [1e-3]", 1.0),
    "tip_rmse": ("Tip RMSE [cm]", 100.0),
    "rotation_rmse": ("Angle between orientations, RMS [degrees]", 180.0 / np.pi),
}
#: the two that the paper improves by so many percent on average, on its own robot, from Dataset B
PAPER_MEASURES, PAPER_GAIN = ("tip_dtw", "pose_mse"), 58.7
#: tensions of one control differ by less than this (N, root mean square) from one recording to another
SAME = 0.15


def rerun(
    out: Path,
    folder: Path,
    *,
    train: Sequence[str] | None,
    methods: Sequence[str],
    options: RecordingsOptions,
    simulated: bool | None = None,
    workers: int | None = None,
    dask: str | None = None,
    progress: bool = False,
) -> Report:
    """Learn from some recordings of a folder, predict the others, and write Table II and its figures.

    Args:
        out: the output folder; an earlier run in it is continued.
        folder: the folder of bags and tables.
        train: names (without suffixes) of the training recordings; None: the paper's.
        methods: some of `recordings.METHODS`.
        options: see `recordings.RecordingsOptions`.
        simulated: True if the robot was simulated; None: as stated by the recordings.
        workers: see `runner.run`.
        dask: see `runner.run`.
        progress: show a progress bar.

    Raises:
        StudyError: recordings are not there, or as in `runner.run`.
        RecordingError: a recording cannot be read.
    """
    paths = recordings.recordings_in(folder)
    learned, rest = recordings.recording_split(list(paths), train)
    ordered = {name: paths[name] for name in (*rest, *learned)}
    jobs = recordings.jobs(ordered, learned, methods, options)
    facts = runner.run(jobs, out, workers=workers, dask=dask, progress=progress)
    every = [cell for method in methods for cell in facts[method]["cells"]]
    cells = [cell for name in rest for cell in every if cell["recording"] == name]
    seen = [cell for name in learned for cell in every if cell["recording"] == name]
    said = _said(facts["measured"], simulated)
    texts = {
        "table2.md": as_markdown(cells, seen, facts, methods, said),
        "table2.json": as_json(cells),
        "training.json": as_json(seen),
    }
    return Report(cells, write_texts(out, texts), draw(facts, methods, rest, out))


def _said(measured: Mapping[str, Any], simulated: bool | None) -> str:
    """Return a sentence that states if the recordings are of a simulated or a physical robot."""
    said = {it["simulated"] for it in measured.values()} if simulated is None else {simulated}
    if said == {True}:
        return "**These recordings are of a simulated robot, not of a physical one.**"
    if said == {False}:
        return "These recordings are of a physical robot."
    if said == {None}:
        return (
            "**It is not stated whether these recordings are of a physical or of a simulated robot** "
            "(state it with `--simulated`, `--physical`, or `simulated` in their configuration)."
        )
    return "**Some of these recordings are of a simulated robot.**"


# the table


def as_markdown(cells: Cells, seen: Cells, facts: Facts, methods: Sequence[str], said: str) -> str:
    """Return a table for each metric, the improvements, and the reports of the fits."""
    trained = ", ".join(dict.fromkeys(cell["recording"] for cell in seen))
    parts = [
        "# Table II: recordings that were not learned from",
        said,
        f"Learned from {trained}. Each recording is predicted from rest by its measured tensions alone, "
        f"compared every {DT:g} s.\npaper-a and paper-b: the paper's network and training, without and with "
        "the random recordings.\nMean and standard deviation over seeds; in brackets, how much less than the "
        "baseline.",
    ]
    for measure, (title, factor) in MEASURES.items():
        parts += [f"## {title}", table_of(cells, measure, factor, methods)]
    gains = _gains(cells, methods)
    if gains:
        listed = "\n".join(f"- {method}: {gain:.1f} %" for method, gain in gains.items())
        parts += [
            "## Average improvement of tip DTW and pose MSE on the baseline",
            f"{listed}\n\nThe paper's, on its own robot: {PAPER_GAIN} %.",
        ]
    parts += ["## The recordings that were learned from: tip RMSE [cm]"]
    parts.append(table_of(seen, "tip_rmse", 100.0, methods))
    told = facts.get("best", {}).get("told")
    if told:
        parts += ["## What `best` found", f"```\n{told}\n```"]
    for title, lines in (("What failed", _failures([*cells, *seen])), ("What was mended", _mended(facts))):
        if lines:
            parts += [f"## {title}", "\n".join(lines)]
    return "\n\n".join(parts) + "\n"


def _spread(cells: Cells, recording: str, method: str, measure: str, factor: float = 1.0) -> Spread:
    own = [cell for cell in cells if (cell["recording"], cell["method"]) == (recording, method)]
    values = tuple(factor * cell[measure] for cell in own if cell[measure] is not None)
    return Spread(values, tuple(cell["failed"] for cell in own if "failed" in cell))


def table_of(cells: Cells, measure: str, factor: float, methods: Sequence[str]) -> str:
    """Return a Markdown table of one metric for all recordings and methods."""
    rows = []
    for name in dict.fromkeys(cell["recording"] for cell in cells):
        base = _spread(cells, name, "baseline", measure, factor).mean
        row = [name]
        for method in methods:
            spread = _spread(cells, name, method, measure, factor)
            less = ""
            if method != "baseline" and base and spread.mean is not None:
                less = f" ({_in_percent(1.0 - spread.mean / base)})"
            row.append(in_words(spread) + less)
        rows.append(row)
    return markdown_table(["recording", *methods], rows)


def _in_percent(part: float) -> str:
    """Return a fraction as text in whole percent, with one decimal above 99.5 %."""
    return f"{100.0 * part:.0f} %" if part < 0.995 else f"{100.0 * part:.1f} %"


def _gains(cells: Cells, methods: Sequence[str]) -> dict[str, float]:
    """Return each method's mean improvement over recordings and both metrics; failed methods have none."""
    found: dict[str, float] = {}
    names = list(dict.fromkeys(cell["recording"] for cell in cells))
    for method in methods:
        gains = []
        for name, measure in itertools.product(names, PAPER_MEASURES):
            base = _spread(cells, name, "baseline", measure).mean
            mine = _spread(cells, name, method, measure)
            if base and mine.mean is not None and not mine.failures:
                gains.append(100.0 * (1.0 - mine.mean / base))
        if method != "baseline" and len(gains) == len(names) * len(PAPER_MEASURES):
            found[method] = float(np.mean(gains))
    return found


def _failures(cells: Cells) -> list[str]:
    return [
        f"- {cell['recording']}, {cell['method']}, seed {cell['seed']}: {cell['failed']}"
        for cell in cells
        if "failed" in cell
    ]


def _mended(facts: Facts) -> list[str]:
    return [f"- {name}: {line}" for name, it in facts["measured"].items() for line in it["findings"]]


# the figures


def draw(facts: Facts, methods: Sequence[str], names: Sequence[str], out: Path) -> list[Path]:
    """Write figures of tensions, paths, tip x, error over the horizon, and losses and repetitions if any."""
    seen = {name: _predicted(facts, methods, name) for name in names}
    drawn = {
        "tensions": table_two_figures.measured_tensions(seen),
        "paths": table_two_figures.paths(seen),
        "tip-x": table_two_figures.tip_x(seen),
        "horizon": table_two_figures.horizon(seen),
    }
    losses = {method: list(facts[method]["loss"].values()) for method in methods if facts[method]["loss"]}
    if losses:
        drawn["loss"] = figures.losses(losses)
    repeated = repetitions({name: _predicted(facts, (), name) for name in facts["measured"]})
    if repeated:
        drawn["consistency"] = table_two_figures.consistency(repeated, DT)
    return write_figures(out, drawn)


def _predicted(facts: Facts, methods: Sequence[str], name: str) -> Predicted:
    it = facts["measured"][name]
    tips = {
        method: np.array(facts[method]["tips"][name], dtype=float)
        for method in methods
        if name in facts[method]["tips"]
    }
    command = None if it["command"] is None else np.array(it["command"], dtype=float)
    time, tip, tension = (np.array(it[key], dtype=float) for key in ("time", "tip", "tension"))
    return Predicted(time, tip, tips, tension, command)


def repetitions(recordings: Mapping[str, Predicted]) -> dict[str, list[np.ndarray]]:
    """Return the tips of recordings with equal commands, by the first recording's name."""
    groups: list[list[str]] = []
    for name, it in recordings.items():
        for group in groups:
            if _alike(recordings[group[0]], it):
                group.append(name)
                break
        else:
            groups.append([name])
    return {
        group[0]: [np.asarray(recordings[name].measured) for name in group] for group in groups if group[1:]
    }


def _alike(one: Predicted, other: Predicted) -> bool:
    a, b = (it.tension if it.command is None else it.command for it in (one, other))
    if a.shape[1] != b.shape[1]:
        return False
    length = min(len(a), len(b))
    return bool(np.sqrt(np.nanmean((a[:length] - b[:length]) ** 2)) < SAME)
