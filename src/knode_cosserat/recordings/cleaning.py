"""Single jumps out of a course, and swapped axes of bodies: found, and taken out or undone."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

#: a jump is larger than so many standard deviations of the steps around it
SIGMAS = 12.0
#: steps around one that say how much the motion itself varies, on each side: just there, and in general
_AROUND = (10, 50)
#: the standard deviation of a normal distribution with this median of absolute values
_NORMAL = 1.4826


def outliers(
    steps: Float[np.ndarray, "m size"], time: Float[np.ndarray, " n"], *, floor: float, longest: int
) -> Bool[np.ndarray, " n"]:
    """Which rows jump out of a course, and back again after `longest` rows or fewer.

    A step that the steps around it do not explain is a jump; two that cancel have something wrong between
    them. Motion, however fast, does not come back to where it would have been in one step.

    Args:
        steps: what changed from each row to the next (m = n - 1).
        time: of the rows (s), rising.
        floor: the smallest jump that counts.
        longest: the most rows that are wrong in a row.
    """
    found = np.zeros(len(time), dtype=bool)
    # no jump is larger than two steps
    if len(steps) < 5 or 2.0 * np.max(np.linalg.norm(steps, axis=1)) < floor:
        return found
    dt = np.diff(time)[:, None]
    # by the rate, because some frames are missing
    expected = scipy.ndimage.median_filter(steps / dt, size=(9, 1), mode="nearest") * dt
    jump = steps - expected
    size = np.linalg.norm(jump, axis=1)
    usual = np.max([_running_median(size, around) for around in _AROUND], axis=0) * _NORMAL
    jumps = np.flatnonzero(size > np.maximum(floor, SIGMAS * usual))
    for out, back in itertools.pairwise(jumps):
        returns = np.linalg.norm(jump[out] + jump[back]) < 0.5 * min(size[out], size[back])
        if back - out <= longest and returns and not found[out]:
            found[out + 1 : back + 1] = True
    return found


def _running_median(values: Float[np.ndarray, " m"], around: int) -> Float[np.ndarray, " m"]:
    size = min(2 * around + 1, len(values))
    return np.asarray(scipy.ndimage.median_filter(values, size=size, mode="nearest"))


def position_steps(position: Float[np.ndarray, "n size"]) -> Float[np.ndarray, "m size"]:
    """What changes from row to row."""
    return np.diff(position, axis=0)


def rotation_steps(quaternion: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "m 3"]:
    """Rotation vectors from row to row (rad)."""
    rotation = _rotation(quaternion)
    return (rotation[:-1].inv() * rotation[1:]).as_rotvec()


# swapped axes


class Swap(NamedTuple):
    """A body's axes became others, from a row on."""

    row: int
    #: the turn by which they did (degrees), and about which of the body's axes
    angle: float
    axis: tuple[int, ...]


#: no motion between two frames turns a body further than this (rad): it would not be told from a swap
_LARGEST_TURN = np.radians(45.0)
#: how far from a multiple of 90 degrees a swap may look, at least, for what the body moved meanwhile (rad)
_MOVED = np.radians(15.0)
#: the rotations that take a cube to itself, the one that leaves it first
_CUBE = Rotation.create_group("O")


def swaps_undone(
    time: Float[np.ndarray, " n"], quaternion: Float[np.ndarray, "n 4"]
) -> tuple[Float[np.ndarray, "n 4"], list[Swap], list[int]]:
    """Orientations without swaps of the body's axes, the swaps, and rows of jumps that are no swaps.

    Between two frames a swap turns a body by one of the 23 rotations of a cube, and by what it moved; the
    turns around it say how much that can be. A turn that is large, but no multiple of 90 degrees or too fast
    a motion to say, is left as it is.

    Args:
        time: of the rows (s), rising.
        quaternion: of the body, scalar first.
    """
    if len(time) < 2:
        return quaternion, [], []
    rotation = _rotation(quaternion)
    turn = rotation[:-1].inv() * rotation[1:]
    angle = np.asarray(turn.magnitude())
    large = np.flatnonzero(angle > _LARGEST_TURN)
    rate = np.where(angle > _LARGEST_TURN, 0.0, angle / np.diff(time))
    undo = Rotation.identity()
    undone: list[Rotation] = []
    swaps: list[Swap] = []
    unclear: list[int] = []
    begin = 0
    for step in large:
        # what the body can have turned: the fastest of the turns nearby, for as long as nobody looked
        moved = np.max(rate[max(0, step - 10) : step + 11], initial=0.0) * (time[step + 1] - time[step])
        left = np.asarray((_CUBE.inv() * turn[step]).magnitude())
        nearest = int(np.argmin(left))
        is_identity = _CUBE[nearest].magnitude() < 1e-6
        if is_identity or left[nearest] > max(_MOVED, 1.5 * moved) or moved > _LARGEST_TURN:
            unclear.append(int(step) + 1)
            continue
        undone.append(rotation[begin : step + 1] * undo)
        begin = int(step) + 1
        # turns are seen in the swapped axes: back to the first ones, in the reverse order
        undo = _CUBE[nearest].inv() * undo
        axis = np.sign(np.round(_CUBE[nearest].as_rotvec(), 6)).astype(int).tolist()
        swaps.append(Swap(begin, float(np.degrees(_CUBE[nearest].magnitude())), tuple(axis)))
    if not swaps:
        return quaternion, [], unclear
    undone.append(rotation[begin:] * undo)
    return Rotation.concatenate(undone).as_quat(scalar_first=True), swaps, unclear


def _rotation(quaternion: Float[np.ndarray, "n 4"]) -> Rotation:
    return Rotation.from_quat(quaternion, scalar_first=True)
