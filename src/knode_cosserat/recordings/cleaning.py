"""Detection of outliers in a signal, and detection and correction of swapped body axes."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

#: threshold of a jump, in standard deviations of the steps around it
SIGMAS = 12.0
#: numbers of steps on each side that measure the variation of the motion: locally, and over a wider window
_AROUND = (10, 50)
#: ratio of a normal distribution's standard deviation to its median absolute value
_NORMAL = 1.4826


def outliers(
    steps: Float[np.ndarray, "m size"], time: Float[np.ndarray, " n"], *, floor: float, longest: int
) -> Bool[np.ndarray, " n"]:
    """Return a mask of rows that jump out of a signal and back again within `longest` rows.

    A jump is a step that differs from the steps around it. The rows between two jumps that cancel are
    outliers. Even fast motion does not return to its expected position in one step.

    Args:
        steps: change from each row to the next (m = n - 1).
        time: times of the rows (s), increasing.
        floor: smallest size of a jump.
        longest: largest number of consecutive outliers.
    """
    found = np.zeros(len(time), dtype=bool)
    # no jump is larger than two steps
    if len(steps) < 5 or 2.0 * np.max(np.linalg.norm(steps, axis=1)) < floor:
        return found
    dt = np.diff(time)[:, None]
    # filter the rate, because some frames are missing
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
    """Return the differences from row to row."""
    return np.diff(position, axis=0)


def rotation_steps(quaternion: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "m 3"]:
    """Return the rotation vectors from row to row (rad)."""
    rotation = _rotation(quaternion)
    return (rotation[:-1].inv() * rotation[1:]).as_rotvec()


# swapped axes


class Swap(NamedTuple):
    """Swap of a body's axes at a row; it also applies to all later rows."""

    row: int
    #: angle of the swap (degrees), and its rotation axis in the body's axes
    angle: float
    axis: tuple[int, ...]


#: largest rotation by motion between two frames (rad): a larger one cannot be distinguished from a swap
_LARGEST_TURN = np.radians(45.0)
#: smallest tolerance of a swap about a multiple of 90 degrees, for motion between the two frames (rad)
_MOVED = np.radians(15.0)
#: rotation group of the cube, the identity first
_CUBE = Rotation.create_group("O")


def swaps_undone(
    time: Float[np.ndarray, " n"], quaternion: Float[np.ndarray, "n 4"]
) -> tuple[Float[np.ndarray, "n 4"], list[Swap], list[int]]:
    """Return orientations without swapped axes, the swaps, and the rows of other large rotations.

    Between two frames a swap rotates a body by one of the 23 rotations of a cube, plus its motion. The
    neighbouring rotations bound that motion. A large rotation is left unchanged if it is not a multiple of
    90 degrees, or if the motion is too fast to decide.

    Args:
        time: times of the rows (s), increasing.
        quaternion: orientation of the body, scalar first.
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
        # bound on the body's own rotation: the fastest rate nearby, over the time between the two frames
        moved = np.max(rate[max(0, step - 10) : step + 11], initial=0.0) * (time[step + 1] - time[step])
        left = np.asarray((_CUBE.inv() * turn[step]).magnitude())
        nearest = int(np.argmin(left))
        is_identity = _CUBE[nearest].magnitude() < 1e-6
        if is_identity or left[nearest] > max(_MOVED, 1.5 * moved) or moved > _LARGEST_TURN:
            unclear.append(int(step) + 1)
            continue
        undone.append(rotation[begin : step + 1] * undo)
        begin = int(step) + 1
        # rotations are measured in the swapped axes: undo the swaps in reverse order
        undo = _CUBE[nearest].inv() * undo
        axis = np.sign(np.round(_CUBE[nearest].as_rotvec(), 6)).astype(int).tolist()
        swaps.append(Swap(begin, float(np.degrees(_CUBE[nearest].magnitude())), tuple(axis)))
    if not swaps:
        return quaternion, [], unclear
    undone.append(rotation[begin:] * undo)
    return Rotation.concatenate(undone).as_quat(scalar_first=True), swaps, unclear


def _rotation(quaternion: Float[np.ndarray, "n 4"]) -> Rotation:
    return Rotation.from_quat(quaternion, scalar_first=True)
