"""The study of cables: identify, learn, predict all motions that were kept back, and report.

The protocol is that of DEFORM's authors: start from the first two frames, take the four held markers as
given, predict all other frames. The error is the mean of |difference| over coordinates, all markers (those
that are held count as zero) and frames.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.figures.style import PALETTE, TWO_COLUMNS, new_figure
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.trajectory import Trajectory
from knode_cosserat.viewer import export_scene
from studies.cables.correction import Correction, learned_correction
from studies.cables.identification import STAGES, SearchStage, identify_cable
from studies.cables.model import DT, CableModel, CableParameters, Grips
from studies.cables.places import grip_tangents, marker_places
from studies.cables.recordings import CableData, CableMotion, load_cables
from studies.cables.rollouts import Rollouts
from studies.report import Report, failures, markdown_table, write_report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METHODS = ("guess", "identified", "best")


@dataclasses.dataclass(frozen=True)
class CableOptions:
    """Numerical choices of the study."""

    #: nodes of the rod, and its scheme along the rod
    nodes: int = 31
    space: Any = "lobatto2"
    #: motions that are learned from, and how many of these choose between models only
    train: int = 10
    validation: int = 4
    stages: tuple[SearchStage, ...] = STAGES
    #: no stage of the search begins later (s of CPU time, each cable)
    seconds: float = 400.0


def mean_abs_error(free: Float[np.ndarray, "T M 3"], markers: Float[np.ndarray, "T+2 N 3"]) -> float:
    """Return the protocol's error (m) of predicted free markers, from frame 2 on."""
    return float(np.abs(free - markers[2:, 2:-2]).sum() / markers[2:].size)


def rerun(
    out: Path,
    folder: Path,
    *,
    options: CableOptions = CableOptions(),
    tell: Callable[[str], None] = lambda line: None,
) -> Report:
    """Run the study for every cable of a folder, and write cables.json, cables.md, a figure and scenes."""
    results = [study_cable(data, options, tell) for data in load_cables(folder)]
    cells = [cell for result in results for cell in result.cells]
    report = write_report(out, "cables", cells, as_markdown(results), {"cables": figure(results)})
    scenes = [scene for result in results if (scene := _scene(out, result)) is not None]
    return report._replace(tables=report.tables + scenes)


def study_cable(data: CableData, options: CableOptions, tell: Callable[[str], None]) -> CableResult:
    """Return the errors of all methods on the motions of one cable that were kept back."""
    began = time.perf_counter()
    chosen = _spread(data.train, options.train)
    motions = [motion.markers for motion in chosen]
    spare = min(options.validation, len(motions) - 1)
    validation = [motions[k] for k in np.linspace(0, len(motions) - 1, spare + 2)[1:-1].astype(int)]
    used = [each for each in motions if not any(each is other for other in validation)]
    grips = Grips.of(motions)
    places = marker_places(motions, grips)
    model = CableModel(places.along, grips, options.nodes)
    rollouts = Rollouts(model, options.space)
    notes = [f"learned from {', '.join(each.name for each in chosen)}"]

    def validate(p: CableParameters) -> float:
        return float(np.mean(_errors(rollouts, p, validation or used)))

    start = CableParameters().replace(offset=tuple(places.offset.tolist()))
    try:
        start = grip_tangents(model, start, used)
    except (ValueError, np.linalg.LinAlgError) as error:
        notes.append(f"directions in the grips were not found: {error}")
    found = identify_cable(rollouts, start, used, validate, options.stages, options.seconds)
    notes += found.notes
    tell(f"{data.name}: identified in {time.perf_counter() - began:.0f} s, {found.parameters}")
    correction, note = _correction(rollouts, found.parameters, motions)
    notes.append(note)
    cells, predictions = _evaluated(data, rollouts, found.parameters, correction)
    for method in METHODS:
        errors = [cell["mean_abs_error"] for cell in cells if cell["method"] == method]
        solved = [each for each in errors if each is not None]
        if solved:
            tell(f"{data.name}: {method} {1e3 * np.mean(solved):.2f} mm, mean of {len(solved)} motions")
    for cell in cells:
        if "failed" in cell:
            tell(f"{data.name}: {cell['method']} failed on {cell['file']}, left out: {cell['failed']}")
    notes.append(f"{time.perf_counter() - began:.0f} s")
    return CableResult(data, model, found.parameters, cells, predictions, notes)


def _errors(rollouts: Rollouts, p: CableParameters, motions: Sequence[Any]) -> list[float]:
    """The errors of motions, or that of a cable that is nowhere near where one cannot be simulated."""
    return [
        1.0 if found.markers is None else mean_abs_error(found.markers, markers)
        for found, markers in zip(rollouts.predict_all(p, motions), motions, strict=True)
    ]


def _correction(rollouts: Rollouts, p: CableParameters, motions: Any) -> tuple[Correction | None, str]:
    """The learned correction, if one helps, and a note on it."""
    found = [each.markers for each in rollouts.predict_all(p, motions)]
    solved = [(free, markers) for free, markers in zip(found, motions, strict=True) if free is not None]
    try:
        correction, gain = learned_correction([free for free, _ in solved], [each for _, each in solved])
    except (ValueError, np.linalg.LinAlgError) as error:
        return None, f"no correction was learned: {error}"
    word = "kept" if correction is not None else "not kept"
    return correction, f"correction {word}: gain {100 * gain:.1f} % on training motions left out"


def _evaluated(
    data: CableData, rollouts: Rollouts, p: CableParameters, correction: Correction | None
) -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]]]:
    """Errors of all methods on all motions that were kept back, and their predictions."""
    cells: list[dict[str, Any]] = []
    predictions: dict[str, dict[str, Any]] = {method: {} for method in METHODS}
    markers = [motion.markers for motion in data.held_out]
    all_found = [rollouts.predict_all(each, markers) for each in (CableParameters(), p)]
    for motion, guessed, identified in zip(data.held_out, *all_found, strict=True):
        best = identified
        if correction is not None and identified.markers is not None:
            best = identified._replace(markers=correction.added(identified.markers, motion.markers))
        for method, found in zip(METHODS, (guessed, identified, best), strict=True):
            cell: dict[str, Any] = {"cable": data.name, "method": method, "file": motion.name}
            if found.markers is None:
                cell |= {"mean_abs_error": None, "failed": found.failure}
            else:
                cell["mean_abs_error"] = mean_abs_error(found.markers, motion.markers)
                cell |= {name: getattr(found, name) for name in ("position_error", "divided", "restarts")}
                predictions[method][motion.name] = found.markers
            cells.append(cell)
    return cells, predictions


def _spread(motions: Sequence[CableMotion], count: int) -> list[CableMotion]:
    """So many motions, evenly over their order: recordings of one session lie together."""
    places = np.linspace(0, len(motions) - 1, min(count, len(motions)) + 2)[1:-1]
    return [motions[k] for k in np.unique(places.round().astype(int))]


class CableResult(NamedTuple):
    """Parameters and predictions of one cable."""

    data: CableData
    model: CableModel
    parameters: CableParameters
    cells: list[dict[str, Any]]
    predictions: dict[str, dict[str, Float[np.ndarray, "T M 3"]]]
    notes: list[str]


#: times that a figure shows (parts of a motion)
SHOWN = (0.1, 0.4, 0.7, 1.0)


def as_markdown(results: Sequence[CableResult]) -> str:
    """Return the tables: means of each method, then every motion, then the parameters."""
    parts = [
        "# Cables held by two grippers",
        "Motions that were not learned from, predicted open loop from their first two frames and the four\n"
        "held markers. Mean of |difference| over coordinates, all markers (those that are held count as\n"
        "zero) and frames [mm].",
    ]
    rows = []
    for result in results:
        row = [result.data.name]
        for method in METHODS:
            errors = _method_errors(result, method)
            solved = [each for each in errors if each is not None]
            text = f"{1e3 * np.mean(solved):.2f}" if solved else "-"
            row.append(text if len(solved) == len(errors) else f"{text} ({len(errors) - len(solved)} failed)")
        rows.append([*row, str(len(_method_errors(result, METHODS[0])))])
    parts.append(markdown_table(["cable", *METHODS, "motions"], rows))
    for result in results:
        names = [motion.name for motion in result.data.held_out]
        columns = [_method_errors(result, method) for method in METHODS]
        each = [
            [name, *("failed" if e is None else f"{1e3 * e:.2f}" for e in errors)]
            for name, *errors in zip(names, *columns, strict=True)
        ]
        parts += [f"## {result.data.name}", markdown_table(["motion", *METHODS], each)]
        estimates = [cell["position_error"] for cell in result.cells if "position_error" in cell]
        known = [each for each in estimates if np.isfinite(each)]
        if known:
            lost = len(estimates) - len(known)
            parts.append(
                "Discretisation error of positions by the solver's estimate, mean over a motion's frames: "
                f"{1e3 * np.median(known):.1f} mm in the median, at most {1e3 * max(known):.1f} mm"
                + (f"; no estimate for {lost} of {len(estimates)} predictions." if lost else ".")
            )
        if failed := failures(result.cells, "file", "method"):
            parts += ["Failed, and left out of the means:", "\n".join(failed)]
        hard = [cell for cell in result.cells if cell.get("divided") or cell.get("restarts")]
        if hard:
            listed = [
                f"- {cell['file']}, {cell['method']}: {cell['divided']} frames in several steps, "
                f"{cell['restarts']} restarts from a smooth shape"
                for cell in hard
            ]
            parts += ["Motions with frames that had no solution in one step:", "\n".join(listed)]
        parts += ["Identified:", _parameters(result), "; ".join(result.notes) + "."]
    return "\n\n".join(parts) + "\n"


def _method_errors(result: CableResult, method: str) -> list[float | None]:
    return [cell["mean_abs_error"] for cell in result.cells if cell["method"] == method]


def _parameters(result: CableResult) -> str:
    def shown(value: Any) -> str:
        if isinstance(value, tuple):
            return ", ".join(f"{each:.4g}" for each in value)
        return f"{value:.4g}"

    units = {
        "bending": "EI/ρA [m⁴/s²]", "torsion": "GJ/ρA [m⁴/s²]", "damping_time": "Kelvin-Voigt time [s]",
        "drag": "linear drag [1/s]", "drag_ratio": "drag along to across", "square_drag": "square drag [1/m]",
        "curvature": "curvature at rest [1/m]", "curvature_change": "its change along the cable [1/m]",
        "base_tangent": "tangent in the base's grip [rad]", "tip_tangent": "tangent in the tip's grip [rad]",
        "twist": "twist of the tip's grip [rad]", "offset": "markers beside the centreline [m]",
        "eccentric": "part of the mass beside the centreline",
        "stretch": "factor of the length",
    }  # fmt: skip
    rows = [[title, shown(getattr(result.parameters, name))] for name, title in units.items()]
    length = result.model.places[-1] * result.parameters.stretch
    return markdown_table(["parameter", "value"], [["free length [m]", f"{length:.4f}"], *rows])


def figure(results: Sequence[CableResult]) -> Figure:
    """Return a figure: errors of all motions, and the shapes of the median one over time."""
    with new_figure(TWO_COLUMNS, 2.6 * len(results)) as drawn:
        grid = drawn.subplots(len(results), 1 + len(SHOWN), squeeze=False)
        for row, result in zip(grid, results, strict=True):
            for k, method in enumerate(METHODS):
                errors = [1e3 * each for each in _method_errors(result, method) if each is not None]
                row[0].plot(np.full(len(errors), k), errors, "o", color=PALETTE[k], alpha=0.6)
            row[0].set(xticks=range(3), xticklabels=METHODS, ylabel="error [mm]", title=result.data.name)
            row[0].tick_params(axis="x", rotation=30)
            name, markers = _median(result)
            for axes, part in zip(row[1:], SHOWN, strict=True):
                k = max(2, round(part * (len(markers) - 1)))
                axes.plot(*markers[k][:, [0, 2]].T, "o-", color="#AAAAAA", linewidth=2.5, label="measured")
                found = result.predictions["best"].get(name)
                if found is not None:
                    axes.plot(*_whole(markers, found)[k - 2][:, [0, 2]].T, color=PALETTE[2], label="best")
                axes.set(title=f"{name}, {DT * k:.2f} s", xlabel="x [m]")
                axes.set_aspect("equal", adjustable="datalim")
            row[1].set_ylabel("z [m]")
        grid[0, 1].legend()
    return drawn


def _median(result: CableResult) -> tuple[str, Any]:
    """The motion with the median error of the best method."""
    errors = [np.inf if each is None else each for each in _method_errors(result, "best")]
    motion = result.data.held_out[int(np.argsort(errors)[len(errors) // 2])]
    return motion.name, motion.markers


def _whole(markers: Any, free: Any) -> Any:
    """Predicted frames (T - 2, N, 3) with the held markers as measured."""
    found = markers[2:].copy()
    found[:, 2:-2] = free
    return found


def _scene(out: Path, result: CableResult) -> Path | None:
    """A scene of prediction and measurement, if any motion was predicted."""
    name, markers = _median(result)
    free = result.predictions["best"].get(name)
    if free is None:
        return None
    both = {"measured": markers[2:], "predicted": _whole(markers, free)}
    shown = {label: _as_trajectory(points) for label, points in both.items()}
    path = out / f"{result.data.name}.html"
    return export_scene(shown, path, title=f"{result.data.name}, motion {name}: prediction and measurement")


def _as_trajectory(points: Any) -> Trajectory:
    """Markers as the nodes of a rod, for drawing only."""
    count = points.shape[1]
    length = float(np.linalg.norm(np.diff(points[0], axis=0), axis=-1).sum())
    rod = SlenderRod(length=length, radius=5e-3, density=1e3, youngs_modulus=1e6, nodes=count)
    y = np.zeros((len(points), count, rod.y_layout.size))
    y[..., :3], y[..., 3] = points, 1.0
    z = np.zeros((len(points), count, rod.z_layout.size))
    z[..., 2] = 1.0
    rows = np.zeros(len(points), dtype=int)
    time = DT * np.arange(2, len(points) + 2)
    return Trajectory(rod, None, time, y, z, np.zeros((len(points), 0)), rows, rows * 0.0, rows)
