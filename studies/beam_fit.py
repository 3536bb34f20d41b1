"""Identification of the beam: parameters by least squares through rollouts of training recordings."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

from studies.beam_model import DEFAULT, Beam, Numerics, predict_markers, tip_height
from studies.beam_recordings import BeamRecording

#: Young's modulus published with the recordings (Pa); the other parameters are initial values
NOMINAL = Beam(youngs_modulus=263_824.0, damping_time=5e-3)
#: from a branch of 0.1 and 0.1 s the search stops in a flat valley, with 0.697 mm on the training recordings
#: instead of 0.685
START = dataclasses.replace(NOMINAL, damping_time=2e-3, branch_stiffness=0.3, relaxation_time=0.05)
#: positive numbers are searched by their logarithms, between these factors of where the search begins
POSITIVE = {
    "youngs_modulus": 30.0,
    "damping_time": 300.0,
    "branch_stiffness": 100.0,
    "relaxation_time": 30.0,
}
#: others are searched in these units, so far at most to both sides
FREE = {"tilt": (0.05, 0.3), "level": (1e-3, 0.01)}
#: residuals are in millimetres; a row that cannot be predicted counts so much
LOST = 100.0
#: step of the difference quotients, in the units of the search; its tolerances
STEP, TOLERANCE = 1e-3, 3e-3


class IdentifiedBeam(NamedTuple):
    """Identified beam, and the number of evaluations."""

    beam: Beam
    #: predictions of all training recordings for one set of numbers
    evaluations: int


def errors(predicted: Float[np.ndarray, "T 3 3"], recording: BeamRecording) -> Float[np.ndarray, "T 3"]:
    """Return the distances (m) between predicted and measured tip markers after the release, row by row."""
    released = np.isfinite(predicted).all(axis=(1, 2))
    return np.asarray(np.linalg.norm((predicted - recording.tip)[released], axis=2))


def marker_rmse(predicted: Float[np.ndarray, "T 3 3"], recording: BeamRecording) -> float:
    """Return the root mean square (m) of the distances over rows after the release and tip markers."""
    return float(np.sqrt(np.nanmean(errors(predicted, recording) ** 2)))


def identify_beam(
    recordings: Sequence[BeamRecording],
    steps: int,
    numerics: Numerics = DEFAULT,
    progress: Callable[[str], None] = lambda line: None,
) -> IdentifiedBeam:
    """Return the beam whose parameters fit the training recordings best.

    Each recording has the same weight, independent of its number of rows.
    """
    start = dataclasses.replace(START, level=float(np.mean([tip_height(each) for each in recordings])))
    names = (*POSITIVE, *FREE)
    calls = 0

    def residuals(x: Float[np.ndarray, " k"]) -> Float[np.ndarray, " r"]:
        nonlocal calls
        calls += 1
        beam = _moved(start, x)
        return np.concatenate([_residual(beam, each, steps, numerics) for each in recordings])

    def jacobian(x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "r k"]:
        here = residuals(x)
        progress(f"evaluation {calls}: {np.sqrt(np.sum(here**2) / len(recordings)):.3f} mm RMSE")
        return np.stack([(residuals(x + step) - here) / STEP for step in STEP * np.eye(len(x))], axis=1)

    most = np.array([*np.log(list(POSITIVE.values())), *(most / unit for unit, most in FREE.values())])
    found = scipy.optimize.least_squares(
        residuals, np.zeros(len(names)), jacobian, bounds=(-most, most), xtol=TOLERANCE, ftol=TOLERANCE
    )
    return IdentifiedBeam(_moved(start, found.x), calls)


def _moved(start: Beam, x: Float[np.ndarray, " k"]) -> Beam:
    """Return the beam at a point of the search, which begins at zero."""
    changes: dict[str, float] = dict(zip((*POSITIVE, *FREE), x.tolist(), strict=True))
    values = {name: getattr(start, name) * math.exp(changes[name]) for name in POSITIVE}
    values |= {name: getattr(start, name) + unit * changes[name] for name, (unit, _) in FREE.items()}
    return dataclasses.replace(start, **values)


def _residual(
    beam: Beam, recording: BeamRecording, steps: int, numerics: Numerics
) -> Float[np.ndarray, " r"]:
    """Return the scaled residuals (mm) of rows from the threshold on; their squares sum to the MSE."""
    rows = recording.time >= recording.crossing
    left = 1e3 * (predict_markers(beam, recording, steps, numerics) - recording.tip)[rows]
    seen = np.isfinite(recording.tip[rows])
    left = np.where(seen, np.nan_to_num(left, nan=LOST), 0.0)
    return np.asarray(left.ravel()) / math.sqrt(max(int(np.count_nonzero(seen.all(axis=2))), 1))
