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
from typing import Any

import numpy as np
from jaxtyping import Float

from studies.cables import report
from studies.cables.correction import Correction, learned_correction
from studies.cables.identification import STAGES, SearchStage, identify_cable
from studies.cables.model import CableModel, CableParameters, Grips
from studies.cables.places import grip_tangents, marker_places
from studies.cables.recordings import CableData, CableMotion, load_cables
from studies.cables.result import CableResult
from studies.cables.rollouts import Rollouts
from studies.report import Report

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
    cables = load_cables(folder)
    out.mkdir(parents=True, exist_ok=True)
    return report.write_report(out, [study_cable(data, options, tell) for data in cables])


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
