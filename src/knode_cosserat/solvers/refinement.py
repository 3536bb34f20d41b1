"""Grids that choose themselves: a robot is solved on finer grids until its estimated errors are small enough.

A robot whose nodes nobody stated has those that its parts need (`System.needed_nodes`). Where its shape needs
more, results are COARSE, and the robot is solved again. From the estimate and the order of the scheme follow
the nodes of the next grid; there are few different ones, and so few programs to compile.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import warnings
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.system import SEEN_TURN, ChosenNodes, System, array_module, is_traced
from knode_cosserat.schemes.grid import turn_of_segments
from knode_cosserat.schemes.history import COARSE_SHARE, StepRows
from knode_cosserat.schemes.result import Result, SimulationError, Verdict
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.trajectory import Trajectory

#: first segments for a position tolerance, and largest number of segments of any grid that is chosen
FIRST_SEGMENTS, MOST_SEGMENTS = 8, 512
#: largest factor of the segments from grid to grid: estimates of large errors are rough
LARGEST_FACTOR = 4.0

Found = TypeVar("Found")


class Solved(NamedTuple, Generic[Found]):
    """Solution on a grid, with the results of its rows and their estimated errors of positions (m)."""

    found: Found
    result: Any
    position_error: Any
    #: warnings of the rows, which are given on the last grid only
    warnings: tuple[Callable[[], None], ...] = ()
    #: True if a verdict needs a finer grid
    undecided: bool = False

    @classmethod
    def of(cls, found: Trajectory, warnings: tuple[Callable[[], None], ...] = ()) -> Solved[Trajectory]:
        """Return a trajectory."""
        known = found.stability is not None and not is_traced(found.stability)
        undecided = known and bool(np.any(np.asarray(found.stability) == Verdict.UNTESTED_GRID))
        return Solved(found, found.result, found.position_error, warnings, undecided)


def refine(
    solve: Callable[[Any], Solved[Found]],
    robot: Any,
    space: SpaceScheme,
    tolerance: float | None = None,
    stays: bool = False,
) -> Found:
    """Return what is found on the first grid that is fine enough, of one robot or a batch.

    Args:
        solve: function of the robot, with its nodes.
        robot: the robot, or a sequence of robots.
        space: scheme along the rod.
        tolerance: largest position error (m); None: no row may be COARSE, if the robot's nodes are chosen.
        stays: True if the robot must stay on its grid.
    """
    if tolerance is not None:
        robot = on_grid(robot, ChosenNodes(FIRST_SEGMENTS + 1))
    may = tolerance is not None or (has_chosen(robot) and not space.is_reproduction and not stays)
    first, before = nodes_of(robot) - 1, None
    while True:
        segments = nodes_of(robot) - 1
        try:
            solved = solve(robot)
        except SimulationError as failure:
            # an equilibrium may exist on a finer grid only; a motion fails for other reasons
            if not may or failure.step or segments > first:
                raise
            robot = on_grid(robot, ChosenNodes(2 * segments + 1))
            continue
        if not may:
            break
        excess, error = _excess(solved, robot, tolerance, 2.0**space.order)
        # errors that do not fall are not those of the grid
        falls = tolerance is not None or before is None or error < before
        if excess <= 1.0 or segments >= MOST_SEGMENTS or not falls:
            break
        before = error
        factor = np.clip(1.1 * excess ** (1.0 / space.order), 1.2, LARGEST_FACTOR)
        ladder = (math.ceil(first * 2**n * k / 4) for n in itertools.count() for k in range(4, 8))
        wanted = min(MOST_SEGMENTS, next(count for count in ladder if count >= factor * segments))
        robot = on_grid(robot, ChosenNodes(wanted + 1))
    for warn in solved.warnings:
        warn()
    if tolerance is not None and excess > 1.0:
        warnings.warn(
            f"position_tolerance of {tolerance:g} m is not reached with {segments + 1} nodes, where the "
            f'estimate is {np.max(solved.position_error):.2g} m: use space="lobatto4", or a larger '
            "tolerance",
            stacklevel=3,
        )
    return solved.found


def _excess(solved: Solved[Any], robot: Any, tolerance: float | None, unknown: float) -> tuple[float, float]:
    """Return the largest error over the allowed one, and that of positions in lengths; zero if all are fine.

    The first is `unknown` where no number is known, of orientations and verdicts. The second is infinite
    where there is no estimate.
    """
    if is_traced((solved[1:3], robot)) or np.any(np.asarray(solved.result) < 0):
        return 0.0, 0.0
    coarse = np.asarray(solved.result) == Result.COARSE
    if tolerance is None and not np.any(coarse) and not solved.undecided:
        return 0.0, 0.0
    robots = [robot] if isinstance(robot, System) else robot
    lengths = np.concatenate([np.ravel(one.length) for one in robots])
    errors = np.asarray(solved.position_error)
    errors = np.nan_to_num(errors, nan=np.inf) / np.reshape(lengths, (-1, *[1] * (errors.ndim - 1)))
    if tolerance is not None:
        allowed, counts = tolerance / lengths[0], np.ones(errors.shape, dtype=bool)
    else:
        allowed, counts = COARSE_SHARE, coarse
    error = float(np.max(errors, initial=0.0, where=counts | solved.undecided))
    excess = error / allowed
    known = excess < np.inf and (tolerance is not None or excess > 1.0)
    return (excess if known else unknown), error


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
        same = robot.nodes == nodes and isinstance(nodes, ChosenNodes) == isinstance(robot.nodes, ChosenNodes)
        return robot if same else robot.replace(nodes=nodes)
    return [on_grid(one, nodes) for one in robot]


def fix_grid(system: System) -> System:
    """Return a system whose nodes stay, for functions that keep to its grid."""
    return on_grid(system, int(system.nodes)) if has_chosen(system) else system


def resample(initial: Trajectory, system: System) -> Trajectory:
    """Return the last row of a trajectory, as a guess on the grid of a system."""
    nodes = initial.y.shape[-2]
    if nodes == system.nodes:
        return initial
    at, known = np.linspace(0.0, 1.0, system.nodes), np.linspace(0.0, 1.0, nodes)
    last = initial[-1:]
    y, z = (
        jnp.stack([jnp.interp(at, known, column) for column in packed[0].T], axis=1)[None]
        for packed in (last.y, last.z)
    )
    return dataclasses.replace(last, y=y, z=z, initial_state=None, final_state=None, stages=None)


def as_seen(system: System, result: Any, position_error: Any) -> tuple[Any, Any]:
    """Return results that are COARSE, without an estimate, if parts turn too far in a segment for one.

    The system's own numbers must be known, not traced.
    """
    if turn_of_segments(system) <= SEEN_TURN:
        return result, position_error
    numeric = array_module((result, position_error))
    result = numeric.where(result == int(Result.CONVERGED), int(Result.COARSE), result)
    return result, numeric.full(numeric.shape(position_error), numeric.nan)


def mark_unseen(system: System, rows: StepRows) -> StepRows:
    """Return rows with the results of `as_seen`; those of NumPy are changed in place."""
    result, error = as_seen(system, rows.result, rows.position_error)
    if isinstance(rows.result, np.ndarray) and rows.result.ndim:
        rows.result[...], rows.position_error[...] = result, error
        return rows
    return rows._replace(result=result, position_error=error)


def is_too_coarse(space: SpaceScheme, results: Any) -> Any:
    """True for results on a grid that is too coarse for verdicts; not of schemes that only reproduce."""
    return (np.asarray(results) == int(Result.COARSE)) & (not space.is_reproduction)
