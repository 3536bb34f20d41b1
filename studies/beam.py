"""Study of a real silicone beam: identified from training recordings, tested on held-out ones."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.evaluation.comparison import REFERENCE, legend_below
from knode_cosserat.evaluation.drawing import new_figure
from knode_cosserat.evaluation.style import PALETTE, TWO_COLUMNS, style
from knode_cosserat.recordings.findings import RecordingError
from studies.beam_model import (
    DEFAULT,
    NOMINAL,
    Beam,
    Numerics,
    identify_beam,
    marker_rmse,
    predict_markers,
    step_count,
)
from studies.beam_recordings import BeamRecording, read_beam, tip_drop
from studies.report import Report, as_json, write_figures, write_texts
from studies.tables import markdown_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: names of the files
PATTERN = "beam_*.csv"
#: the default training recordings, if they are there
TRAIN = ("beam_gravity_V2_b", "beam_load52_V2_a")
#: the numbers of a beam as the table has them: title, factor, unit
QUANTITIES = {
    "youngs_modulus": ("Young's modulus at rest", 1e-3, "kPa"),
    "damping_time": ("Kelvin-Voigt damping over stiffness", 1e3, "ms"),
    "branch_stiffness": ("stiffness of the Maxwell branch over that at rest", 1.0, ""),
    "relaxation_time": ("relaxation time of the Maxwell branch", 1.0, "s"),
    "tilt": ("downward tilt of the clamp", 1e3, "mrad"),
    "level": ("height of the unloaded tip over the base's markers", 1e3, "mm"),
}

Predictions = Mapping[str, Mapping[str, Float[np.ndarray, "T 3 3"]]]


def read_folder(folder: Path, loads: Mapping[str, float] | None = None) -> list[BeamRecording]:
    """Read all recordings of a folder, in the order of their names.

    Args:
        folder: has `beam_*.csv`.
        loads: masses (kg) by file name without suffix, for names that do not state the load.

    Raises:
        RecordingError: there is no recording, or one is invalid.
    """
    loads = loads or {}
    paths = sorted(folder.glob(PATTERN)) if folder.is_dir() else []
    if not paths:
        raise RecordingError(f"{folder}: no recordings found; allowed is a folder with {PATTERN}")
    unknown = [name for name in loads if name not in {path.stem for path in paths}]
    if unknown:
        raise RecordingError(_no_such(folder, "--load", unknown[0], [path.stem for path in paths]))
    return [read_beam(path, loads.get(path.stem)) for path in paths]


def training_names(recordings: Sequence[BeamRecording]) -> list[str]:
    """Return the default training recordings: `TRAIN`, or the first with each of the two lightest loads."""
    if set(TRAIN) <= {each.name for each in recordings}:
        return list(TRAIN)
    found: dict[float, str] = {}
    for each in recordings:
        found.setdefault(each.load, each.name)
    return [found[load] for load in sorted(found)[:2]]


def rerun(
    out: Path,
    folder: Path,
    train: Sequence[str] | None = None,
    loads: Mapping[str, float] | None = None,
    numerics: Numerics = DEFAULT,
    tell: Callable[[str], None] = lambda line: None,
) -> Report:
    """Identify the beam from the training recordings, predict all, and write errors, a table and a figure.

    Args:
        out: the output folder.
        folder: the folder of recordings.
        train: names of the training recordings, without suffixes; None: `training_names`.
        loads: masses (kg) by name, for names that do not state the load.
        numerics: nodes and time step of every rollout.
        tell: callback that receives a line for each iteration.

    Raises:
        RecordingError: a recording is invalid, or does not exist.
    """
    recordings = read_folder(folder, loads)
    by_name = {each.name: each for each in recordings}
    names = training_names(recordings) if train is None else list(dict.fromkeys(train))
    for name in names:
        if name not in by_name:
            raise RecordingError(_no_such(folder, "--train", name, list(by_name)))
    if not names:
        raise RecordingError("--train names no recording; at least one is needed")
    steps = step_count(recordings, numerics.dt)
    found = identify_beam([by_name[name] for name in names], steps, numerics, tell)
    beams = {"nominal": NOMINAL, "identified": found.beam}
    predictions = {
        each.name: {method: predict_markers(beam, each, steps, numerics) for method, beam in beams.items()}
        for each in recordings
    }
    cells = _cells(recordings, names, predictions)
    out.mkdir(parents=True, exist_ok=True)
    texts = {"beam.md": as_markdown(cells, found.beam), "beam.json": as_json(cells)}
    figure = drops(recordings, predictions, names)
    return Report(cells, write_texts(out, texts), write_figures(out, {"beam": figure}))


def _no_such(folder: Path, option: str, name: str, known: Sequence[str]) -> str:
    return f"{option}: there is no recording {name!r} in {folder}; there are {', '.join(known)}"


def _cells(
    recordings: Sequence[BeamRecording], train: Sequence[str], predictions: Predictions
) -> list[dict[str, Any]]:
    """Return a cell for each recording and method."""
    cells: list[dict[str, Any]] = []
    for each in recordings:
        for method, predicted in predictions[each.name].items():
            rmse = marker_rmse(predicted, each)
            about = {"file": f"{each.name}.csv", "method": method}
            solved = {"rmse": rmse} if np.isfinite(rmse) else {"rmse": None, "failed": "the rollout diverged"}
            released = np.flatnonzero(np.isfinite(predicted).all(axis=(1, 2)))
            window = [float(each.time[k]) for k in released[[0, -1]]] if len(released) else None
            use = "train" if each.name in train else "held out"
            cells.append({**about, **solved, "use": use, "load": each.load, "window": window})
    return cells


def as_markdown(cells: Sequence[Mapping[str, Any]], beam: Beam) -> str:
    """Return Markdown with the errors of every recording and the identified parameters."""
    methods = list(dict.fromkeys(cell["method"] for cell in cells))
    rows = []
    for name in dict.fromkeys(cell["file"] for cell in cells):
        own = {cell["method"]: cell for cell in cells if cell["file"] == name}
        first = own[methods[0]]
        window = "" if first["window"] is None else "{:.2f} to {:.2f}".format(*first["window"])
        said = ["failed" if own[it]["rmse"] is None else f"{1e3 * own[it]['rmse']:.2f}" for it in methods]
        rows.append([name, f"{1e3 * first['load']:g}", first["use"], window, *said])
    heads = ["recording", "load [g]", "use", "window [s]", *(f"{method} [mm]" for method in methods)]
    numbers = [
        [title, f"{factor * value:.4g} {unit}".strip()]
        for (title, factor, unit), value in zip(
            QUANTITIES.values(), (getattr(beam, name) for name in QUANTITIES), strict=True
        )
    ]
    return (
        "\n\n".join(
            [
                "# A real beam of silicone, let go by hand",
                "RMSE of the tip markers: the root mean square of the distances between predicted and\n"
                "measured markers, over three markers and all rows from the release to the end of the\n"
                "recording. `nominal` has the Young's modulus of the recordings' authors, 263,824 Pa, and a\n"
                "damping time of 5 ms; `identified` has the numbers below, from the recordings that are\n"
                "marked train.",
                markdown_table(heads, rows),
                "## Identified numbers",
                markdown_table(["quantity", "value"], numbers),
            ]
        )
        + "\n"
    )


#: line styles of predictions, by method
LINES: dict[str, dict[str, Any]] = {
    "nominal": {"color": PALETTE[1], "linewidth": 0.8},
    "identified": {"color": PALETTE[0], "linewidth": 1.0},
}
#: duration of the enlarged motion after the release (s)
SHOWN = 1.5


def drops(
    recordings: Sequence[BeamRecording],
    predictions: Mapping[str, Mapping[str, Float[np.ndarray, "T 3 3"]]],
    train: Collection[str],
) -> Figure:
    """Return a figure of the tip drop over time, a row per recording: first 1.5 s left, all right.

    Raises:
        ImportError: matplotlib is not installed.
    """
    with style():
        figure = new_figure(TWO_COLUMNS, 1.7 * len(recordings) + 0.4)
        grid = figure.subplots(len(recordings), 2, squeeze=False, width_ratios=(1.6, 1.0), sharey="row")
        for row, each in zip(grid, recordings, strict=True):
            time = each.time - each.crossing
            for axes in row:
                axes.plot(time, 1e3 * each.drop, label="measured", **REFERENCE)
                for method, predicted in predictions[each.name].items():
                    axes.plot(time, 1e3 * tip_drop(predicted), label=method, **LINES[method])
                axes.invert_yaxis()
            use = "training" if each.name in train else "held out"
            row[0].set(ylabel="tip drop [mm]", xlim=(-0.1, SHOWN))
            row[0].set_title(f"load {1e3 * each.load:g} g, {use} ({each.name})")
            row[1].set_xlim(-0.1, float(time[-1]))
        for axes in grid[-1]:
            axes.set_xlabel("time from the release [s]")
        legend_below(figure, grid[:1, 0])
    return figure
