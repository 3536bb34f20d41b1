"""Checks of a closed loop before it starts: reference within reach, horizon within memory."""

from __future__ import annotations

import functools
import os
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.control.commands import ControlLimits
from knode_cosserat.control.references import Reference, ReferenceFormatError
from knode_cosserat.estimation.outputs import BodyPoses, BodyPositions
from knode_cosserat.rods.system import System
from knode_cosserat.statics.reach import inverse_kinematics

#: seconds of a reference that are checked, and the time between two of them (s)
CHECKED, SAMPLING = 60.0, 0.02
#: distance from the base, in lengths of the rod, which a rod that stretches or a moving base may reach
STRETCH = 1.5
#: points of a reference whose nearest tips are searched, initial controls of each search, and the part of the
#: length within which a point is reached
POINTS, STARTS, REACHED = 12, 2, 1e-4
#: part of the memory that predictions may take
SHARE = 0.5


def check_reference(controller: Any, reference: Reference, seconds: float = CHECKED) -> None:
    """Raise a `ReferenceFormatError` if a controller of positions cannot reach a reference at all.

    Controllers of other outputs, such as curvatures, are not checked.
    """
    robot, target = getattr(controller, "robot", None), getattr(controller, "target", None)
    if robot is not None and (target is None or isinstance(target, BodyPositions | BodyPoses)):
        check_within_length(robot, reference, seconds)


def check_within_length(robot: System, reference: Reference, seconds: float = CHECKED) -> None:
    """Raise an error if a reference of tip positions is much further from the base than the rod is long.

    Args:
        robot: the model; the check does not apply to robots of several rods.
        reference: positions (m), perhaps followed by other numbers.
        seconds: checked duration (s).

    Raises:
        ReferenceFormatError: a position that no rod of this length reaches, even if it stretches or its base
            moves.
    """
    length = getattr(robot.nominal, "length", None)
    if length is None or robot.strands > 1 or reference.size < 3:
        return
    base, length, times = _base(robot), float(length), np.arange(0.0, seconds, SAMPLING)
    apart = np.sqrt(np.nansum((reference.at(times)[:, :3] - base) ** 2, axis=1))
    k = int(np.argmax(apart))
    if apart[k] > STRETCH * length:
        raise ReferenceFormatError(
            f"the {reference.name} is {apart[k]:.4g} m from the base at t = {times[k]:.4g} s, and the robot "
            f"is {length:.4g} m long; are the positions in metres, in the robot's frame?"
        )


def distance_out_of_reach(
    robot: System, limits: ControlLimits, reference: Reference, seconds: float = CHECKED
) -> tuple[float, float]:
    """Return the largest distance (m) from a reference to the nearest tip at rest, and its time (s).

    Inverse kinematics within the limits gives the nearest tip of some points spread over the reference, so
    the distance is a lower bound of the largest one. A moving robot may swing further.

    Args:
        robot: the model.
        limits: of its controls.
        reference: positions (m); coordinates that are free (NaN) in the first row do not count.
        seconds: checked duration (s).
    """
    bounds = limits.of(robot)
    times = np.arange(0.0, seconds, SAMPLING)
    wanted = reference.at(times)[:, :3]
    known = tuple(np.flatnonzero(np.isfinite(wanted[0])).tolist())
    if not known:
        return 0.0, 0.0
    wanted = wanted[:, known]
    chosen = _spread(wanted, POINTS)
    found = inverse_kinematics(
        robot, wanted[chosen], low=bounds.low, high=bounds.high, tolerance=REACHED, starts=STARTS,
        pose=_coordinates(known),
    )  # fmt: skip
    apart = np.where(found.converged, 0.0, np.nan_to_num(found.position_error))
    k = int(np.argmax(apart))
    return float(apart[k]), float(times[chosen[k]])


@functools.cache
def _coordinates(known: tuple[int, ...]) -> Any:
    """Return the pose function of some of the tip's coordinates; the same one each time, for compilation."""

    def pose(system: System, y: Any) -> tuple[Any, None]:
        return system.drawing.positions(y)[np.array(known)], None

    return pose


def _spread(points: Float[np.ndarray, "T d"], count: int) -> list[int]:
    """Return the rows of points that are far from each other, in the order of time."""
    centre = np.nanmean(points, axis=0)
    chosen = [int(np.nanargmax(np.linalg.norm(points - centre, axis=1)))]
    apart = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count and np.nanmax(apart) > 0.0:
        chosen.append(int(np.nanargmax(apart)))
        apart = np.minimum(apart, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return sorted(chosen)


def check_memory(robot: System, horizon: int, columns: int) -> None:
    """Raise an error if the derivatives of a prediction do not fit in memory.

    Args:
        robot: the model.
        horizon: number of predicted periods.
        columns: number of derivatives.

    Raises:
        ValueError: the horizon is too long; the message has the longest one.
    """
    record = 2 * robot.y_layout.size + robot.z_layout.size
    # rows and their copies in the robot's grid
    each = 3 * 8 * robot.nodes * record * columns
    most = int(SHARE * _memory() / each)
    if horizon > most:
        raise ValueError(
            f"horizon is {horizon}; its derivatives need {1e-9 * each * horizon:.3g} GB; allowed are at most "
            f"{most} periods on this machine"
        )


def _memory() -> float:
    """Return the machine's memory (bytes); infinity if it is not known."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return np.inf


def _base(robot: Any) -> Float[np.ndarray, "3"]:
    """Return the position of the base at rest (m)."""
    y, _ = robot.rest(0.0)
    return np.asarray(robot.drawing.positions(np.asarray(y)[None]))[0]
