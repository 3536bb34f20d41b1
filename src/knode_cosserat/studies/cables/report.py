"""The report of the study of cables: errors as JSON and as a table, a figure, and scenes for the viewer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat.evaluation.drawing import new_figure
from knode_cosserat.evaluation.style import PALETTE, TWO_COLUMNS, style
from knode_cosserat.evaluation.tables import markdown_table
from knode_cosserat.rods.slender_rod import SlenderRod
from knode_cosserat.studies.cables.model import DT
from knode_cosserat.studies.cables.result import CableResult
from knode_cosserat.studies.report import Report, as_json, write_figures, write_texts
from knode_cosserat.trajectory import Trajectory
from knode_cosserat.viewer import export_scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METHODS = ("guess", "identified", "best")
#: times that a figure shows (parts of a motion)
SHOWN = (0.1, 0.4, 0.7, 1.0)


def write_report(out: Path, results: Sequence[CableResult]) -> Report:
    """Write all of the report into a folder."""
    cells = [cell for result in results for cell in result.cells]
    texts = {"cables.md": as_markdown(results), "cables.json": as_json(cells)}
    tables = write_texts(out, texts)
    scenes = [scene for result in results if (scene := _scene(out, result)) is not None]
    return Report(cells, tables + scenes, write_figures(out, {"cables": figure(results)}))


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
            errors = _errors(result, method)
            solved = [each for each in errors if each is not None]
            text = f"{1e3 * np.mean(solved):.2f}" if solved else "-"
            row.append(text if len(solved) == len(errors) else f"{text} ({len(errors) - len(solved)} failed)")
        rows.append([*row, str(len(_errors(result, METHODS[0])))])
    parts.append(markdown_table(["cable", *METHODS, "motions"], rows))
    for result in results:
        names = [motion.name for motion in result.data.held_out]
        columns = [_errors(result, method) for method in METHODS]
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
        failed = [cell for cell in result.cells if "failed" in cell]
        if failed:
            listed = [f"- {cell['file']}, {cell['method']}: {cell['failed']}" for cell in failed]
            parts += ["Failed, and left out of the means:", "\n".join(listed)]
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


def _errors(result: CableResult, method: str) -> list[float | None]:
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
    with style():
        drawn = new_figure(TWO_COLUMNS, 2.6 * len(results))
        grid = drawn.subplots(len(results), 1 + len(SHOWN), squeeze=False)
        for row, result in zip(grid, results, strict=True):
            for k, method in enumerate(METHODS):
                errors = [1e3 * each for each in _errors(result, method) if each is not None]
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
    errors = [np.inf if each is None else each for each in _errors(result, "best")]
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
