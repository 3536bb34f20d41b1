"""Input of the estimation: unbroken parts of a recording, their poses at full rate, and rows to estimate."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from knode_cosserat.recordings.estimation.curvature import BodyPoses
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Body, Recording
from knode_cosserat.rods.system import System

#: margin of poses used before the first row and after the last (s)
AROUND = 0.5
#: tolerance of stamps of one frame (s)
_SAME = 1e-4
#: smallest number of bodies away from the clamped end, and of rows
FEWEST_BODIES, FEWEST_ROWS = 2, 4


@dataclasses.dataclass(frozen=True, eq=False)
class RecordingPart:
    """An unbroken part of a recording.

    Attributes:
        rows: measurements at the times to estimate.
        poses: poses of the bodies away from the clamped end, at the full rate.
        fractions: places of these bodies, as fractions of the rod's length.
    """

    rows: Measurements
    poses: BodyPoses
    fractions: Float[np.ndarray, " M"]


def parts_of(
    recording: Recording | Measurements, robot: System, dt: float, start: float | None, end: float | None
) -> list[RecordingPart]:
    """Return the parts with enough rows for an estimation.

    Raises:
        RecordingError: the recording does not fit the robot, or has too few data.
    """
    if isinstance(recording, Recording):
        rows = recording.sampled(dt, start, end)
    elif isinstance(recording, Measurements):
        rows = recording
        if start is not None or end is not None:
            rows = rows.between(-np.inf if start is None else start, np.inf if end is None else end + 1e-9)
        if abs(rows.dt - dt) > 1e-6 * dt:
            raise RecordingError(
                f"{rows.source}: its rows are {rows.dt:g} s apart and dt is {dt:g} s; allowed is the same"
            )
    else:
        raise RecordingError(
            f"recording is a {type(recording).__name__}; allowed is a Recording or Measurements"
        )
    _check(rows, robot)
    pieces = rows.parts(shortest=(FEWEST_ROWS - 1) * dt)
    if not pieces:
        raise RecordingError(
            f"{rows.source}: no {FEWEST_ROWS} rows of {dt:g} s one after the other "
            "with all positions and tensions"
        )
    used = rows.fractions > 0.0
    made = []
    for piece in pieces:
        poses = (
            _frames([body for body, use in zip(recording.bodies, used, strict=True) if use], piece.time)
            if isinstance(recording, Recording)
            else _of_rows(piece, used)
        )
        made.append(RecordingPart(piece, poses, rows.fractions[used]))
    return made


def _check(rows: Measurements, robot: System) -> None:
    tendons = rows.tension.shape[1]
    if tendons != robot.control_size:
        raise RecordingError(
            f"{rows.source}: the recording has {tendons} tendons and the robot {robot.control_size} "
            "controls; allowed is the same number"
        )
    away = rows.fractions > 0.0
    if away.sum() < FEWEST_BODIES:
        raise RecordingError(
            f"{rows.source}: {int(away.sum())} bodies on the rod away from its clamped end; "
            f"required is {FEWEST_BODIES} or more"
        )
    if not np.isfinite(rows.quaternion[:, away]).all(axis=2).any():
        raise RecordingError(
            f"{rows.source}: no body has orientations; required for states is one or more (see the "
            "recording's findings, the markers' `rotation` and `rest` in its configuration)"
        )


def _of_rows(rows: Measurements, used: np.ndarray) -> BodyPoses:
    position, quaternion = rows.position[:, used], rows.quaternion[:, used]
    turned = np.isfinite(quaternion).all(axis=2)
    filled = np.where(turned[..., None], quaternion, [1.0, 0.0, 0.0, 0.0])
    # bridged poses are not observations
    seen = rows.measured[:, used]
    return BodyPoses(rows.time, position, filled, seen, turned & seen)


def _frames(bodies: list[Body], time: Float[np.ndarray, " T"]) -> BodyPoses:
    """Return the poses of all bodies, grouped by frame."""
    first, last = time[0] - AROUND, time[-1] + AROUND
    inside = [body.time[(body.time >= first) & (body.time <= last)] for body in bodies]
    stamps = np.unique(np.concatenate(inside))
    frames = stamps[np.concatenate([[True], np.diff(stamps) > _SAME])]
    count = (len(frames), len(bodies))
    position, quaternion = np.zeros((*count, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (*count, 1))
    placed, turned = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    for k, body in enumerate(bodies):
        mine = np.flatnonzero((body.time >= first) & (body.time <= last))
        row = np.searchsorted(frames, body.time[mine] + _SAME / 2, side="right") - 1
        position[row, k], placed[row, k] = body.position[mine], True
        if body.quaternion is not None:
            quaternion[row, k], turned[row, k] = body.quaternion[mine], True
    return BodyPoses(frames, position, quaternion, placed, turned)
