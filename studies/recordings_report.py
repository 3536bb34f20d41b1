"""Report of the recordings' study: Table II and figures."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.evaluation.comparison import METHODS, REFERENCE, legend_below, require_some
from knode_cosserat.evaluation.drawing import equal_scales, new_figure
from knode_cosserat.evaluation.style import PALETTE, TWO_COLUMNS, style
from studies import figures, recordings, runner
from studies.recordings import DT, RecordingsOptions
from studies.report import Report, as_json, write_figures, write_texts
from studies.tables import Spread, in_words, markdown_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    **how: Any,
) -> Report:
    """Learn from some recordings of a folder, predict the others, and write Table II and its figures.

    Args:
        out: the output folder; an earlier run in it is continued.
        folder: the folder of bags and tables.
        train: names (without suffixes) of the training recordings; None: the paper's.
        methods: some of `recordings.METHODS`.
        options: see `recordings.RecordingsOptions`.
        simulated: True if the robot was simulated; None: as stated by the recordings.
        how: `workers`, `dask`, `progress` as `runner.run` has them.

    Raises:
        StudyError: recordings are not there, or as in `runner.run`.
        RecordingError: a recording cannot be read.
    """
    paths = recordings.recordings_in(folder)
    learned, rest = recordings.recording_split(list(paths), train)
    ordered = {name: paths[name] for name in (*rest, *learned)}
    jobs = recordings.jobs(ordered, learned, methods, options)
    facts = runner.run(jobs, out, **how)
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
        "tensions": measured_tensions(seen),
        "paths": paths(seen),
        "tip-x": tip_x(seen),
        "horizon": horizon(seen),
    }
    losses = {method: list(facts[method]["loss"].values()) for method in methods if facts[method]["loss"]}
    if losses:
        drawn["loss"] = figures.losses(losses)
    repeated = repetitions({name: _predicted(facts, (), name) for name in facts["measured"]})
    if repeated:
        drawn["consistency"] = consistency(repeated, DT)
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


#: line style of each method
LINES: dict[str, dict[str, Any]] = {
    "baseline": METHODS["baseline"],
    "paper-a": {"color": PALETTE[5], "linestyle": "-", "linewidth": 1.1},
    "paper-b": METHODS["paper"],
    "best": METHODS["best"],
    "calibrated": METHODS["calibrated"],
    "no-memory": {"color": PALETTE[2], "linestyle": "-", "linewidth": 1.1},
    "no-vibration": {"color": PALETTE[4], "linestyle": "--", "linewidth": 1.1},
}
MEASURED = {**REFERENCE, "label": "measured"}
COLUMNS = 2


class Predicted(NamedTuple):
    """Recording with its measured tip, and each method's prediction with its first seed."""

    time: Float[np.ndarray, " T"]
    measured: Float[np.ndarray, "T 3"]
    predicted: Mapping[str, Float[np.ndarray, "T 3"]]
    tension: Float[np.ndarray, "T c"]
    command: Float[np.ndarray, "T c"] | None


def measured_tensions(recordings: Mapping[str, Predicted]) -> Figure:
    """Return a figure of commanded and measured tensions by tendon.

    Raises:
        ImportError: matplotlib is not installed; from every function here.
        ValueError: there is nothing to draw; from every function here.
    """
    with style():
        figure, panels = _grid(recordings, 2.3)
        for axes, (name, it) in zip(panels, recordings.items(), strict=False):
            for k in range(it.tension.shape[1]):
                colour = PALETTE[k % len(PALETTE)]
                axes.plot(it.time, it.tension[:, k], color=colour, linewidth=1.1, label=f"tendon {k + 1}")
                if it.command is not None:
                    axes.step(
                        it.time, it.command[:, k], where="post", color=colour, linewidth=0.8, alpha=0.6,
                        linestyle="--",
                    )  # fmt: skip
            axes.set(title=f"{name}: measured (solid), commanded (dashed)", ylabel="tension [N]")
        return _finished(figure, panels)


def tip_x(recordings: Mapping[str, Predicted]) -> Figure:
    """Return a figure of x of the tips over time."""
    with style():
        figure, panels = _grid(recordings, 2.3)
        # one scale for all panels, so that motions are comparable; predictions far off leave the axes
        reach = 2.5 * max(float(np.nanmax(np.abs(it.measured[:, 0]))) for it in recordings.values())
        for axes, (name, it) in zip(panels, recordings.items(), strict=False):
            axes.plot(it.time, it.measured[:, 0], **MEASURED)
            for method, tip in it.predicted.items():
                axes.plot(it.time, tip[:, 0], label=method, **LINES.get(method, {}))
            axes.set(title=name, ylabel="tip x [m]", ylim=(-reach, reach))
        return _finished(figure, panels)


def paths(recordings: Mapping[str, Predicted]) -> Figure:
    """Return a figure of the paths of the tips in space."""
    require_some(recordings)
    with style():
        columns = min(COLUMNS, len(recordings))
        rows = -(-len(recordings) // columns)
        figure = new_figure(TWO_COLUMNS, 2.6 * rows + 0.4)
        grid = figure.subplots(rows, columns, subplot_kw={"projection": "3d"}, squeeze=False).ravel()
        for axes, (name, it) in zip(grid, recordings.items(), strict=False):
            axes.plot(*it.measured.T, **MEASURED)
            for method, tip in it.predicted.items():
                axes.plot(*tip.T, label=method, **LINES.get(method, {}))
            axes.set_title(name, y=0.94)
            axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
            axes.locator_params(nbins=4)
            points = np.concatenate([it.measured, *it.predicted.values()])
            equal_scales(axes, points[None, np.isfinite(points).all(axis=1)], 0.85)
        for axes in grid[len(recordings) :]:
            axes.remove()
        legend_below(figure, grid[: len(recordings)])
    return figure


def horizon(recordings: Mapping[str, Predicted]) -> Figure:
    """Return a figure of the tip error over the horizon: RMS over the recordings, and their range."""
    require_some(recordings)
    with style():
        figure = new_figure(TWO_COLUMNS, 3.2)
        axes = figure.subplots()
        methods = list(dict.fromkeys(method for it in recordings.values() for method in it.predicted))
        for method in methods:
            several = [it for it in recordings.values() if method in it.predicted]
            length = min(len(it.time) for it in several)
            off = np.array(
                [
                    np.linalg.norm(it.predicted[method][:length] - it.measured[:length], axis=1)
                    for it in several
                ]
            )
            time = several[0].time[:length] - several[0].time[0]
            # average over the last second, for smoother lines
            means = np.array(
                [np.sqrt(np.nanmean(off[:, max(0, i - 20) : i + 1] ** 2)) for i in range(length)]
            )
            look = LINES.get(method, {})
            axes.plot(time, 100.0 * means, label=method, **look)
            axes.fill_between(
                time, 100.0 * np.nanmin(off, axis=0), 100.0 * np.nanmax(off, axis=0),
                color=look.get("color"), alpha=0.12, linewidth=0,
            )  # fmt: skip
        axes.set(
            xlabel="time since the prediction began [s]", ylabel="distance of the tips [cm]", yscale="log"
        )
        axes.set_title("Lines: root mean square of all recordings over the last second; bands: least to most")
        axes.margins(x=0.0)
        legend_below(figure, [axes])
    return figure


def consistency(groups: Mapping[str, Sequence[Float[np.ndarray, "T 3"]]], dt: float) -> Figure:
    """Return a figure of repeated recordings of one control, overlaid: the robot's repeatability."""
    with style():
        figure, panels = _grid(groups, 2.3)
        for axes, (name, several) in zip(panels, groups.items(), strict=False):
            length = min(len(tip) for tip in several)
            tips = np.stack([tip[:length] for tip in several])
            time = dt * np.arange(length)
            spread = np.linalg.norm(np.nanstd(tips, axis=0), axis=1)
            for k, tip in enumerate(tips):
                label = "" if k else "each recording"
                axes.plot(time, tip[:, 0], color=PALETTE[0], linewidth=0.8, label=label)
            axes.set(
                title=f"{name}, {len(tips)} times: {100 * np.sqrt(np.nanmean(spread**2)):.2f} cm apart",
                ylabel="tip x [m]",
            )
        return _finished(figure, panels)


def _grid(given: Mapping[str, Any], height: float) -> tuple[Any, Any]:
    require_some(given)
    columns = 1 if len(given) < 3 else 2
    rows = -(-len(given) // columns)
    figure = new_figure(TWO_COLUMNS, 0.7 * height * rows + 0.5)
    return figure, figure.subplots(rows, columns, squeeze=False).ravel()


def _finished(figure: Any, panels: Any) -> Figure:
    used = [axes for axes in panels if axes.get_lines()]
    for axes in panels:
        axes.margins(x=0.0)
        if axes not in used:
            axes.remove()
    for axes in used[-2:]:
        axes.set_xlabel("time [s]")
    legend_below(figure, used)
    return figure
