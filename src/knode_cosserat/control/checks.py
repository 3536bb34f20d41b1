"""Checks of a closed loop before it starts: reference within reach, horizon within memory."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.control.commands import ControlLimits
from knode_cosserat.control.references import Reference, ReferenceFormatError
from knode_cosserat.estimation.outputs import BodyPoses, BodyPositions
from knode_cosserat.rods.system import System
from knode_cosserat.statics.workspace import workspace

#: seconds of a reference that are checked, and the time between two of them (s)
CHECKED, SAMPLING = 60.0, 0.02
#: distance from the base, in lengths of the rod, which a rod that stretches or a moving base may reach
STRETCH = 1.5
#: controls whose equilibria bound the workspace
SAMPLES = 256
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
    """Return how far a reference is outside the workspace at most (m), and at which time (s).

    The workspace is the convex hull of the tip's positions in equilibria under sampled controls within the
    limits, so the distance is a lower bound at rest; a moving robot may swing further.

    Args:
        robot: the model.
        limits: of its controls.
        reference: positions (m); coordinates that are free (NaN) in the first row do not count.
        seconds: checked duration (s).
    """
    bounds = limits.of(robot)
    corners = np.stack(np.meshgrid(*zip(bounds.low, bounds.high, strict=True)), axis=-1)
    corners = corners.reshape(-1, robot.control_size)[:SAMPLES]
    inside = np.random.default_rng(0).uniform(bounds.low, bounds.high, (SAMPLES, robot.control_size))
    found = workspace(robot, np.concatenate([corners, inside]))
    tips = np.asarray(found.position)[found.valid]
    times = np.arange(0.0, seconds, SAMPLING)
    wanted = reference.at(times)[:, :3]
    known = np.isfinite(wanted[0])
    apart = _outside(tips[:, known], wanted[:, known])
    k = int(np.argmax(apart))
    return float(apart[k]), float(times[k])


def _outside(points: Float[np.ndarray, "n d"], wanted: Float[np.ndarray, "T d"]) -> Float[np.ndarray, " T"]:
    """Return distances outside the convex hull of points, at least 0; NaN do not count."""
    if points.shape[1] == 0:
        return np.zeros(len(wanted))
    if points.shape[1] == 1:
        beyond = np.maximum(points.min() - wanted[:, 0], wanted[:, 0] - points.max())
    else:
        from scipy.spatial import ConvexHull

        planes = ConvexHull(points).equations
        beyond = np.max(wanted @ planes[:, :-1].T + planes[:, -1], axis=1)
    return np.nan_to_num(np.maximum(beyond, 0.0))


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
    return np.asarray(robot.positions(np.asarray(y)[None]))[0]
