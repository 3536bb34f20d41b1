"""Inverse kinematics: controls for a wanted pose of a robot at rest."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from knode_cosserat._reprs import packed_text, quantity, wrapped
from knode_cosserat.rods.strands import in_strands
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.history import rest_record
from knode_cosserat.solvers.result import Code, Codes, Result, SimulationError
from knode_cosserat.solvers.settings import NewtonOptions
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.statics.arguments import (
    checked_control,
    checked_limits,
    checked_system,
    checked_vectors,
    static_settings,
)
from knode_cosserat.statics.response import Pose, Response, first_solved, node_values, poses_of, tip_pose
from knode_cosserat.statics.search import EquilibriumSearch, Wanted
from knode_cosserat.trajectory import Trajectory

#: fields of a trajectory with one entry per row
OF_A_ROW = ("y", "z", "control", "result", "residual", "iterations")
#: tolerance of the equilibria, in natural units. The search compares distances to rounding; the residual at
#: Newton's own tolerance would hide an optimum from it
EXACT = 1e-13
#: tolerance for equal shapes: largest difference in fractions of the length, and in rad
SAME_SHAPE = 1e-5


class Reach(Code):
    """Result of inverse kinematics. Zero: reached. Below zero: not reached; the pose is another."""

    REACHED = 0
    UNREACHABLE = -1
    NOT_CONVERGED = -2
    NO_EQUILIBRIUM = -3

    @property
    def message(self) -> str:
        """Description of the result."""
        return {
            Reach.REACHED: "reached",
            Reach.UNREACHABLE: "not reachable from there: the nearest pose that was found",
            Reach.NOT_CONVERGED: "stopped before it was certain that nothing is nearer",
            Reach.NO_EQUILIBRIUM: "no equilibrium to begin with",
        }[self]


class ReachCodes(Codes):
    """Array of `Reach` codes."""

    members = Reach


@dataclasses.dataclass(frozen=True)
class InverseKinematics:
    """Controls of a wanted pose, or of the nearest one; with several poses every array has a leading axis.

    The pose is the wanted one only if `result` is `Reach.REACHED` (`converged`).
    """

    #: a `Reach`
    result: Any
    #: (c,)
    control: Any
    #: resulting pose: (3,) in m, and (4,) or None for a robot without orientation
    position: Any
    quaternion: Any
    #: distance to the wanted position (m), and angle to the wanted orientation (rad); zero if not wanted
    position_error: Any
    angle_error: Any
    #: True for controls at their limits (c,)
    at_low: Any
    at_high: Any
    #: True if `kc.equilibrium`, which starts at the unloaded robot, finds the same shape; otherwise the robot
    #: has several equilibria, and has to be moved to this one
    from_rest: Any
    #: number of equilibria computed
    iterations: Any
    #: the equilibrium, a `Trajectory` as from `kc.equilibrium`: for `kc.statics.stability`, or as an initial
    #: state
    equilibrium: Any

    def __repr__(self) -> str:
        if np.ndim(self.result):
            codes, counts = np.unique(np.asarray(self.result), return_counts=True)
            results = ", ".join(f"{n} {Reach(int(code))}" for code, n in zip(codes, counts, strict=True))
            largest = quantity(1e3 * np.max(self.position_error), "mm")
            return f"InverseKinematics of {len(self.result)} poses: {results}; largest error {largest}"
        layout = self.equilibrium.system.control_layout
        return wrapped(
            f"InverseKinematics: {self.result}; {packed_text(layout, self.control)}; tip at "
            f"{quantity(self.position, 'm')}; error {quantity(1e3 * self.position_error, 'mm')}, "
            f"{quantity(self.angle_error, 'rad')}"
        )

    @property
    def converged(self) -> Any:
        """True if the pose was reached."""
        return self.result == Reach.REACHED


def inverse_kinematics(
    robot: System,
    position: Any = None,
    quaternion: Any = None,
    *,
    low: Any,
    high: Any,
    initial: Any = None,
    weights: tuple[float, float] = (1.0, 1.0),
    tolerance: float = 1e-9,
    starts: int = 6,
    space: str | SpaceScheme = "lobatto2",
    newton: NewtonOptions = NewtonOptions(),
    pose: Pose = tip_pose,
) -> InverseKinematics:
    """Return the controls under which the tip at rest has a wanted position, orientation, or both.

    If several controls reach a pose, the result is nearest to `low` (least squares, with each control as a
    fraction of the way from `low` to `high`). For an unreachable pose the result is the nearest pose found,
    by weights, and `result` says so. The search is local. It starts at `initial`; if the pose is not reached,
    it restarts from other controls, up to `starts` in total. It follows shapes continuously: for a robot with
    several equilibria the result may differ from that of `kc.equilibrium` (see `from_rest`).

    Args:
        robot: one robot or model.
        position: wanted position (3,) in m, or (B, 3): a path; each search starts from the previous result.
        quaternion: wanted orientation (4,) or (B, 4), scalar first, of any length.
        low: lower limits of the controls, a number or (c,).
        high: upper limits.
        initial: initial controls (c,); by default half-way between the limits.
        weights: weights of the position error, as a fraction of the robot's length, and of the angle (rad).
        tolerance: largest position error, as a fraction of the robot's length, and largest angle (rad), of a
            reached pose.
        starts: number of initial controls to try before a pose counts as unreachable.
        space: "lobatto2", "lobatto4", "euler", or a scheme.
        newton: tolerances and limits of the solve.
        pose: pose function, as for `kc.statics.configuration`.

    Raises:
        ValueError: arguments of a wrong shape, not finite, or low above high.
    """
    system = checked_system(robot)
    settings = static_settings(space, dataclasses.replace(newton, tolerance=min(newton.tolerance, EXACT)))
    limits = checked_limits(system, low, high)
    wanted, single = _checked_wanted(system, pose, position, quaternion, (weights, tolerance))
    begin = None
    if initial is not None:
        begin = checked_control(system, initial, "initial")
        if np.any((begin < limits[0]) | (begin > limits[1])):
            raise ValueError(f"initial is {begin.tolist()}; it must be between low and high")
    if not _whole(starts):
        raise ValueError(f"starts is {starts!r}; allowed is a whole number from 1")
    search = EquilibriumSearch(system, settings, pose, *limits)
    free = np.where(search.free, search.span, 1.0)
    last = np.where(search.free, 0.5, 0.0) if begin is None else (begin - limits[0]) / free
    rows, shape = [], None
    for each in wanted:
        row, last, shape = _one(search, each, last, shape, int(starts))
        rows.append(row)
    if single:
        return rows[0]
    names = [field.name for field in dataclasses.fields(InverseKinematics)]
    columns = {name: [getattr(row, name) for row in rows] for name in names}
    rests = columns.pop("equilibrium")
    numbers = {name: None if column[0] is None else np.array(column) for name, column in columns.items()}
    numbers["result"] = ReachCodes.of(numbers["result"])
    arrays = {name: np.stack([getattr(rest, name) for rest in rests]) for name in OF_A_ROW}
    return InverseKinematics(**numbers, equilibrium=dataclasses.replace(rests[0], **arrays))


def _whole(number: Any) -> bool:
    return isinstance(number, int | np.integer) and bool(number >= 1)


def _one(
    search: EquilibriumSearch, wanted: Wanted, begin: np.ndarray, shape: Response | None, starts: int
) -> tuple[InverseKinematics, np.ndarray, Response | None]:
    """Solve for one pose, from `begin` and its equilibrium (None: from rest), then from other controls."""
    best: tuple[float, np.ndarray, Response, bool] | None = None
    search.trials = 0
    for u in (begin, *_others(len(begin), starts - 1, search.free)):
        found = shape
        if best is not None or shape is None:
            try:
                found = first_solved(search.system, search.settings, search.pose, search.control(u))
            except SimulationError:
                continue
            search.trials += 1
        assert found is not None
        u, found, settled = search.descend(wanted, u, found)
        merit = float(np.sum(wanted.residual(found) ** 2))
        if best is None or merit < best[0]:
            best = (merit, u, found, settled)
        if wanted.reached(found):
            break
    if best is None:
        return _nothing(search, begin), begin, None
    _, u, found, settled = best
    result = Reach.UNREACHABLE if settled else Reach.NOT_CONVERGED
    return _told(search, wanted, u, found, Reach.REACHED if wanted.reached(found) else result), u, found


def _others(size: int, count: int, free: np.ndarray) -> np.ndarray:
    from knode_cosserat.statics.workspace import sample

    return np.where(free, sample(np.zeros(size), np.ones(size), max(count, 1))[:count], 0.0)


def _told(
    search: EquilibriumSearch, wanted: Wanted, u: np.ndarray, found: Response, result: Reach
) -> InverseKinematics:
    control = search.control(u)
    position, turned = wanted.errors(found)
    same = _from_rest(search, control, found)
    y, z = node_values(search.system, search.settings, control, found.y)
    return InverseKinematics(
        result, control, np.asarray(found.position),
        None if found.quaternion is None else np.asarray(found.quaternion),
        float(np.linalg.norm(position)), float(np.linalg.norm(turned)),
        control <= search.low, control >= search.high, same, search.trials,
        _rest(search, control, (y, z), Result.CONVERGED, float(found.error)),
    )  # fmt: skip


def _from_rest(search: EquilibriumSearch, control: np.ndarray, found: Response) -> bool:
    """True if the equilibrium found from the unloaded robot has the same shape."""
    try:
        cold = first_solved(search.system, search.settings, search.pose, control)
    except SimulationError:
        return False
    solved = bool(cold.error <= search.settings.newton.acceptable)
    return solved and _same_shape(search.system, np.asarray(cold.y), np.asarray(found.y))


def _same_shape(system: System, one: np.ndarray, other: np.ndarray) -> bool:
    """True if positions and orientations agree at all points, of every rod.

    Forces are not compared: if reels or actuators prescribe lengths, a small residual changes the forces much
    more than the shape.
    """
    states = [in_strands(system, y) for y in (one, other)]
    try:
        p, q = (np.asarray(system.strand.drawing.positions(y)) for y in states)
    except AttributeError:
        # a system without positions: compare all of y
        return float(np.max(np.abs(one - other) / np.asarray(system.scales().y))) <= SAME_SHAPE
    off = float(np.max(np.abs(p - q))) / float(system.length)
    try:
        g, h = (np.asarray(system.strand.drawing.quaternions(y)) for y in states)
    except AttributeError:
        return off <= SAME_SHAPE
    g, h = (each / np.linalg.norm(each, axis=-1, keepdims=True) for each in (g, h))
    # the distance of unit quaternions, up to sign, is half the angle between them
    turned = 2.0 * np.minimum(np.linalg.norm(g - h, axis=-1), np.linalg.norm(g + h, axis=-1))
    return max(off, float(np.max(turned))) <= SAME_SHAPE


def _nothing(search: EquilibriumSearch, u: np.ndarray) -> InverseKinematics:
    control = search.control(u)
    system = search.system
    position, quaternion = search.pose(system, np.full(system.y_layout.size, np.nan))
    nothing = [np.full((system.nodes, layout.size), np.nan) for layout in (system.y_layout, system.z_layout)]
    return InverseKinematics(
        Reach.NO_EQUILIBRIUM, control, np.asarray(position),
        None if quaternion is None else np.asarray(quaternion), np.nan, np.nan,
        control <= search.low, control >= search.high, False, search.trials,
        _rest(search, control, nothing, Result.NO_CONVERGENCE, np.inf),
    )  # fmt: skip


def _rest(
    search: EquilibriumSearch, control: np.ndarray, state: Any, result: Result, residual: float
) -> Trajectory:
    y, z = (np.asarray(part)[None] for part in state)
    return Trajectory(
        system=search.system, settings=search.settings, time=np.zeros(1), y=y, z=z, control=control[None],
        result=np.array([int(result)]), residual=np.array([residual]), iterations=np.zeros(1, int),
    )  # fmt: skip


def _checked_wanted(
    system: System, pose: Pose, position: Any, quaternion: Any, measured_by: Any
) -> tuple[list[Wanted], bool]:
    """Return the wanted poses, and True if a single one was given."""
    here, turned = poses_of(system, pose, rest_record(system)[-1:, : system.y_layout.size])
    given: dict[str, np.ndarray] = {}
    if position is not None:
        size = here.shape[-1]
        given["position"] = checked_vectors("position", position, size, f"({size},) or (B, {size}) in m")
    if quaternion is not None:
        if turned is None:
            raise ValueError(f"quaternion is given, but {type(system).__name__} has no orientation")
        given["quaternion"] = checked_vectors("quaternion", quaternion, 4, "(4,) or (B, 4), scalar first")
        if np.any(np.linalg.norm(given["quaternion"], axis=-1) < 1e-9):
            raise ValueError("quaternion is zero; allowed is any other length")
    if not given:
        raise ValueError("neither position nor quaternion is given; give one or both")
    tolerance = float(checked_vectors("tolerance", np.atleast_1d(measured_by[1]), 1, "a number", most=1)[0])
    if tolerance <= 0.0:
        raise ValueError(f"tolerance is {tolerance:g}; allowed is above 0")
    weights = checked_vectors("weights", measured_by[0], 2, "(2,): of position and of orientation", most=1)
    if np.any(weights <= 0.0):
        raise ValueError(f"weights are {weights.tolist()}; allowed is above 0")
    if len({array.shape[:-1] for array in given.values()}) > 1:
        shapes = [array.shape for array in given.values()]
        raise ValueError(f"position and quaternion have shapes {shapes}; give as many of both")
    single = next(iter(given.values())).ndim == 1
    poses = {name: np.atleast_2d(array) for name, array in given.items()}
    length, weight = float(system.length), (float(weights[0]), float(weights[1]))
    count = len(next(iter(poses.values())))

    def row(name: str, i: int) -> np.ndarray | None:
        return poses[name][i] if name in poses else None

    return [
        Wanted(row("position", i), row("quaternion", i), length, weight, tolerance) for i in range(count)
    ], single
