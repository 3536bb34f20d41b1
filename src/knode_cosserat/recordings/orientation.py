"""Check of a body's orientations against its positions: finds quaternions in another order than stated."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from knode_cosserat.recordings.findings import Finding

if TYPE_CHECKING:
    from knode_cosserat.recordings.recording import Body

#: smallest bending (rad, root mean square) that shows how orientations are meant
SMALLEST_BEND = np.radians(3.0)
#: largest error of another reading, as a fraction of the error as read, and of the bending
BETTER, EXPLAINED = 0.5, 0.5
#: number of rows that stand for the rest, where none is known
_FIRST = 5
#: other meanings of four numbers that were read as w, x, y, z
READINGS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "scalar last (x, y, z, w) under titles of w, x, y, z": lambda q: q[:, [3, 0, 1, 2]],
    "scalar first (w, x, y, z) under titles of x, y, z, w": lambda q: q[:, [1, 2, 3, 0]],
    "the inverse rotation (from the frame to the body)": lambda q: q * [1.0, -1.0, -1.0, -1.0],
}


def misread_orientation(
    quaternion: Float[np.ndarray, "n 4"], turn: Rotation, placed: Body, still: Bool[np.ndarray, " n"]
) -> Finding | None:
    """Return a finding if a body's quaternions agree with its positions in another reading only.

    An arc that leaves the clamped end along z determines the tangent at each position. The body's rotation
    since the rest has to turn the tangent at rest to it.

    Args:
        quaternion: recorded orientations, in the frame of motion capture, read as scalar first.
        turn: rotation from motion capture's frame to the robot's.
        placed: the body, with positions in the robot's frame (m).
        still: mask of the rows at rest.
    """
    distance = np.linalg.norm(placed.position, axis=1)
    seen = distance > 1e-9
    if seen.sum() <= _FIRST:
        return None
    chord = placed.position[seen] / distance[seen, None]
    tangent = 2.0 * chord[:, 2:] * chord - [0.0, 0.0, 1.0]
    start = np.flatnonzero(still[seen])
    start = start if len(start) >= _FIRST else np.arange(_FIRST)
    first = tangent[start].mean(axis=0)
    first /= np.linalg.norm(first) or 1.0
    bend = _rms_angle(tangent, np.tile(first, (len(tangent), 1)))
    if bend < SMALLEST_BEND:
        return None

    def error(numbers: np.ndarray) -> float:
        own = turn * Rotation.from_quat(numbers, scalar_first=True)
        return _rms_angle(tangent, (own * own[start].mean().inv()).apply(first))

    as_read = error(quaternion[seen])
    errors = {words: error(read(quaternion[seen])) for words, read in READINGS.items()}
    words = min(errors, key=errors.__getitem__)
    if errors[words] > min(BETTER * as_read, EXPLAINED * bend):
        return None
    what = (
        f"its rotation contradicts its positions by {np.degrees(as_read):.0f} degrees; read as {words} it "
        f"agrees to {np.degrees(errors[words]):.0f} degrees: are its quaternions in this order?"
    )
    return Finding("problem", placed.topic, what)


def _rms_angle(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> float:
    """Return the root mean square of the angles (rad) between unit vectors."""
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))
    return float(np.sqrt(np.mean(angle**2)))
