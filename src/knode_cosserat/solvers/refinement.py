"""Grids that choose themselves: a robot is solved on finer grids until its estimated errors are small enough.

A robot whose nodes nobody stated has those that its parts need (`System.needed_nodes`). Where its shape needs
more, results are COARSE, and the robot is solved again. From the estimate and the order of the scheme follow
the nodes of the next grid; there are few different ones, and so few programs to compile.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.system import SEEN_TURN, ChosenNodes, System, is_traced
from knode_cosserat.solvers.history import COARSE_SHARE, StepRows
from knode_cosserat.solvers.result import Result, Verdict
from knode_cosserat.solvers.space import Euler, SpaceScheme
from knode_cosserat.trajectory import Trajectory

#: first segments for a position tolerance, and largest number of segments of any grid that is chosen
FIRST_SEGMENTS, MOST_SEGMENTS = 8, 512
#: largest factor of the segments from grid to grid: estimates of large errors are rough
LARGEST_FACTOR = 4.0

Found = TypeVar("Found")


class Solved(NamedTuple, Generic[Found]):
    """What was found on a grid."""

    found: Found
    #: its rows
    trajectory: Trajectory
    #: warnings of the rows, which are given on the last grid only
    warnings: tuple[Callable[[], None], ...] = ()


def refined(
    solve: Callable[[Any], Solved[Found]], robot: Any, space: SpaceScheme, tolerance: float | None = None
) -> Found:
    """Return what is found on the first grid that is fine enough, of one robot or a batch.

    Args:
        solve: function of the robot, with its nodes.
        robot: the robot, or a sequence of robots.
        space: scheme along the rod.
        tolerance: largest position error (m); None: no row may be COARSE, if the robot's nodes are chosen.
    """
    if tolerance is not None:
        robot = on_grid(robot, ChosenNodes(FIRST_SEGMENTS + 1))
    first, before = nodes_of(robot) - 1, np.inf
    while True:
        found, trajectory, said = solve(robot)
        segments, excess = nodes_of(robot) - 1, 0.0
        if not is_traced((trajectory.y, trajectory.result)) and trajectory.all_valid:
            excess = _excess(trajectory, tolerance, 2.0**space.order)
        may = tolerance is not None or (has_chosen(robot) and not isinstance(space, Euler))
        # errors that do not fall are not those of the grid
        if excess <= 1.0 or not may or segments >= MOST_SEGMENTS or not excess < before:
            break
        before = excess
        factor = np.clip(1.1 * excess ** (1.0 / space.order), 1.2, LARGEST_FACTOR)
        ladder = (math.ceil(first * 2**n * k / 4) for n in itertools.count() for k in range(4, 8))
        wanted = min(MOST_SEGMENTS, next(count for count in ladder if count >= factor * segments))
        robot = on_grid(robot, ChosenNodes(wanted + 1))
    for warn in said:
        warn()
    if tolerance is not None and excess > 1.0:
        warnings.warn(
            f"position_tolerance of {tolerance:g} m is not reached with {segments + 1} nodes, where the "
            f'estimate is {np.max(trajectory.position_error):.2g} m: use space="lobatto4", or a larger '
            "tolerance",
            stacklevel=3,
        )
    return found


def _excess(trajectory: Trajectory, tolerance: float | None, unknown: float) -> float:
    """Return the largest error of a trajectory over the allowed one; `unknown` where there is no number."""
    errors = np.asarray(trajectory.position_error)
    if tolerance is not None:
        return unknown if np.any(np.isnan(errors)) else float(np.max(errors) / tolerance)
    coarse = np.asarray(trajectory.result) == Result.COARSE
    if trajectory.stability is not None:
        coarse = coarse | (np.asarray(trajectory.stability) == Verdict.UNTESTED_GRID)
    if not np.any(coarse):
        return 0.0
    length = np.asarray(trajectory.system.length)[..., None]
    shares = np.where(coarse, errors / (COARSE_SHARE * length), 0.0)
    largest = float(np.max(shares, initial=0.0, where=~np.isnan(shares)))
    # of orientations, and of verdicts, no number is known
    return largest if largest > 1.0 else unknown


def has_chosen(robot: Any) -> bool:
    """True if nobody stated the nodes of a robot, or of any robot of a batch."""
    robots = [robot] if isinstance(robot, System) else robot
    return all(isinstance(one.nodes, ChosenNodes) and not np.ndim(one.length) for one in robots)


def nodes_of(robot: Any) -> int:
    """Return the number of nodes of a robot, or the largest of a batch."""
    return robot.nodes if isinstance(robot, System) else max(one.nodes for one in robot)


def on_grid(robot: Any, nodes: int) -> Any:
    """Return a robot, or each of a batch, with other nodes."""
    if isinstance(robot, System):
        return robot if robot.nodes == nodes else robot.replace(nodes=nodes)
    return [on_grid(one, nodes) for one in robot]


def mark_unseen(system: System, rows: StepRows) -> StepRows:
    """Return rows that are COARSE and have no estimate if parts turn too far in a segment for one.

    Rows of NumPy are changed in place.
    """
    if system.turn_of_segments <= SEEN_TURN:
        return rows
    numeric: Any = jnp if is_traced(rows) else np
    result = numeric.where(rows.result == int(Result.CONVERGED), int(Result.COARSE), rows.result)
    error = numeric.full(numeric.shape(rows.position_error), numeric.nan)
    if numeric is np and np.ndim(rows.result):
        rows.result[...], rows.position_error[...] = result, error
        return rows
    return rows._replace(result=result, position_error=error)


def is_too_coarse(space: SpaceScheme, results: Any) -> Any:
    """True for results on a grid that is too coarse for verdicts; Euler's only reproduce the paper."""
    return (np.asarray(results) == int(Result.COARSE)) & (not isinstance(space, Euler))
