"""Inverse kinematics: controls for a wanted pose of a robot at rest, by least squares over equilibria.

With u the controls between their limits (0 to 1) and r the pose's error in natural units,

    minimise |r(u)|² + ε² |u|²,     0 ≤ u ≤ 1

by Levenberg's method. Each step is a bounded linear least-squares problem, solved exactly. ε decreases in
stages to 1e-7: among the controls that reach a pose the result is nearest to the lower limits, and the
remaining pose error is of the size ε². Derivatives are exact, by the implicit function theorem.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import numpy as np

from knode_cosserat._arguments import check_arguments, numbers_of
from knode_cosserat._reprs import packed_text, quantity, wrap_lines
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.strands import in_strands, strand_of
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.result import Code, Codes, Result, SimulationError
from knode_cosserat.schemes.settings import NewtonOptions, Settings
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.refinement import Solved, is_too_coarse, refine
from knode_cosserat.statics.arguments import (
    checked_control,
    checked_limits,
    checked_vectors,
    static_settings,
)
from knode_cosserat.statics.response import (
    Pose,
    Response,
    first_solved,
    node_values,
    respond,
    tip_pose,
)
from knode_cosserat.trajectory import Trajectory

#: fields of a trajectory with one entry per row
OF_A_ROW = ("y", "z", "control", "result", "residual", "iterations", "position_error")
#: tolerance of the equilibria, in natural units. The search compares distances to rounding; the residual at
#: Newton's own tolerance would hide an optimum from it
EXACT = 1e-13
#: tolerance for equal shapes: largest difference in fractions of the length, and in rad
SAME_SHAPE = 1e-5

#: ε of the stages: large first, so that controls do not drift along directions with little effect on the pose
STAGES = (3e-2, 1e-3, 1e-5, 1e-7)
#: largest number of equilibria in one stage
MOST_TRIALS = 80
#: residual in natural units beyond which the curvature of r may matter
FAR = 1e-4
#: step of finite differences for the curvature, as a fraction of the way between the limits
DIFFERENCE = 1e-4
#: gradient of the distance, relative to its bound, below which it counts as zero
FLAT = 1e-6
#: relative rounding error of the objective
ROUNDING = 1e-13
#: distance from a limit, as a fraction of the way between the limits, below which a control is at it
AT_LIMIT = 1e-12


class Reach(Code):
    """Result of inverse kinematics. Zero: reached. Below zero: not reached; the pose is another."""

    REACHED = 0
    UNREACHABLE = -1
    NOT_CONVERGED = -2
    NO_EQUILIBRIUM = -3
    COARSE = -4

    @property
    def message(self) -> str:
        """Description of the result."""
        return {
            Reach.REACHED: "reached",
            Reach.UNREACHABLE: "not reachable from there: the nearest pose that was found",
            Reach.NOT_CONVERGED: "stopped before it was certain that nothing is nearer",
            Reach.NO_EQUILIBRIUM: "no equilibrium to begin with",
            Reach.COARSE: "not tested: the grid is too coarse for the shape; use more nodes",
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
        return wrap_lines(
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
    several equilibria the result may differ from that of `kc.equilibrium` (see `from_rest`). On a grid that
    is too coarse for the shape nothing is said to be reached or unreachable: nodes that were not stated are
    refined, and otherwise the result is COARSE.

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
    check_arguments(inverse_kinematics, locals())
    settings = static_settings(space, dataclasses.replace(newton, tolerance=min(newton.tolerance, EXACT)))
    limits = checked_limits(robot, low, high)
    begin = None
    if initial is not None:
        begin = checked_control(robot, initial, "initial")
        if np.any((begin < limits[0]) | (begin > limits[1])):
            raise ValueError(f"initial is {begin.tolist()}; it must be between low and high")
    if not _whole(starts):
        raise ValueError(f"starts is {starts!r}; allowed is a whole number from 1")
    wanted, single = _checked_wanted(robot, pose, position, quaternion, (weights, tolerance))

    def solve(robot: System) -> Solved[InverseKinematics]:
        search = _ReachSearch(robot, settings, pose, *limits)
        free = np.where(search.free, search.span, 1.0)
        last = np.where(search.free, 0.5, 0.0) if begin is None else (begin - limits[0]) / free
        rows, shape = [], None
        for each in wanted:
            row, last, shape = _one(search, each, last, shape, int(starts))
            rows.append(row)
        rests = [row.equilibrium for row in rows]
        found = rows[0] if single else _path(rows)
        results, errors = (
            np.concatenate([getattr(rest, name) for rest in rests]) for name in ("result", "position_error")
        )
        return Solved(found, results, errors)

    return refine(solve, robot, settings.space)


def _path(rows: list[InverseKinematics]) -> InverseKinematics:
    """Return the results of several poses as one."""
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
    search: _ReachSearch, wanted: _Wanted, begin: np.ndarray, shape: Response | None, starts: int
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
        return _outcome(search, wanted, begin, None, Reach.NO_EQUILIBRIUM), begin, None
    _, u, found, settled = best
    result = Reach.UNREACHABLE if settled else Reach.NOT_CONVERGED
    if is_too_coarse(search.settings.space, found.result):
        result = Reach.COARSE
    elif wanted.reached(found):
        result = Reach.REACHED
    return _outcome(search, wanted, u, found, result), u, found


def _others(size: int, count: int, free: np.ndarray) -> np.ndarray:
    from knode_cosserat.statics.workspace import sample

    return np.where(free, sample(np.zeros(size), np.ones(size), max(count, 1))[:count], 0.0)


def _outcome(
    search: _ReachSearch, wanted: _Wanted, u: np.ndarray, found: Response | None, result: Reach
) -> InverseKinematics:
    """Return the result for an equilibrium, or for none: NaN."""
    system, control = search.system, search.control(u)
    errors, same, code, residual = (np.nan, np.nan), False, Result.NO_CONVERGENCE, np.inf
    off = np.nan
    if found is None:
        position, quaternion = search.pose(system, np.full(system.y_layout.size, np.nan))
        y, z = (np.full((system.nodes, each.size), np.nan) for each in (system.y_layout, system.z_layout))
    else:
        position, quaternion, residual = found.position, found.quaternion, float(found.error)
        code, off = Result(max(int(found.result), 0)), float(found.position_error)
        errors = tuple(float(np.linalg.norm(each)) for each in wanted.errors(found))  # type: ignore[assignment]
        same = _from_rest(search, control, found)
        y, z = node_values(system, search.settings, control, found.y)
    rest = Trajectory(
        system=system,
        settings=search.settings,
        time=np.zeros(1),
        control=control[None],
        y=np.asarray(y)[None],
        z=np.asarray(z)[None],
        result=np.array([int(code)]),
        residual=np.array([residual]),
        iterations=np.zeros(1, int),
        position_error=np.array([off]),
    )
    return InverseKinematics(
        result,
        control,
        np.asarray(position),
        None if quaternion is None else np.asarray(quaternion),
        *errors,
        control <= search.low,
        control >= search.high,
        same,
        search.trials,
        rest,
    )


def _from_rest(search: _ReachSearch, control: np.ndarray, found: Response) -> bool:
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
        p, q = (np.asarray(Drawing.of(strand_of(system)).positions(y)) for y in states)
    except AttributeError:
        # a system without positions: compare all of y
        return float(np.max(np.abs(one - other) / np.asarray(system.scales().y))) <= SAME_SHAPE
    off = float(np.max(np.abs(p - q))) / float(system.length)
    try:
        g, h = (np.asarray(Drawing.of(strand_of(system)).quaternions(y)) for y in states)
    except AttributeError:
        return off <= SAME_SHAPE
    g, h = (each / np.linalg.norm(each, axis=-1, keepdims=True) for each in (g, h))
    # the distance of unit quaternions, up to sign, is half the angle between them
    turned = 2.0 * np.minimum(np.linalg.norm(g - h, axis=-1), np.linalg.norm(g + h, axis=-1))
    return max(off, float(np.max(turned))) <= SAME_SHAPE


def _checked_wanted(
    system: System, pose: Pose, position: Any, quaternion: Any, measured_by: Any
) -> tuple[list[_Wanted], bool]:
    """Return the wanted poses, and True if a single one was given."""
    if position is None and quaternion is None:
        raise ValueError("neither position nor quaternion is given; give one or both")
    if position is not None:
        position = numbers_of("position", position, "(3,) or (B, 3) in m")
    if quaternion is not None:
        quaternion = numbers_of("quaternion", quaternion, "(4,) or (B, 4), scalar first")
    state = jax.ShapeDtypeStruct((system.y_layout.size,), float)
    here, turned = jax.eval_shape(functools.partial(pose, system), state)
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
    free: Any = [None] * len(next(iter(poses.values())))
    pairs = zip(poses.get("position", free), poses.get("quaternion", free), strict=True)
    return [_Wanted(*pair, length, weight, tolerance) for pair in pairs], single


# the search


class _Wanted(NamedTuple):
    """A wanted pose, with the scales and weights of its errors."""

    position: np.ndarray | None
    quaternion: np.ndarray | None
    length: float
    weights: tuple[float, float]
    tolerance: float

    def errors(self, found: Response) -> tuple[np.ndarray, np.ndarray]:
        """Return errors of position (m) and orientation (rotation vector, rad); empty if not wanted."""
        position = turned = np.zeros(0)
        if self.position is not None:
            position = np.asarray(found.position) - self.position
        if self.quaternion is not None:
            turned = rotation_between(self.quaternion, np.asarray(found.quaternion))
        return position, turned

    def residual(self, found: Response) -> np.ndarray:
        """Return the weighted errors in natural units, the residual of the least-squares problem."""
        position, turned = self.errors(found)
        return np.concatenate([position / self.length * self.weights[0], turned * self.weights[1]])

    def slope(self, found: Response) -> np.ndarray:
        """Return ∂residual/∂control.

        The rate of a rotation vector θ is approximated by the angular velocity. Jᵀθ, and therefore the
        minimum, is exact; the rest holds for small θ.
        """
        J, count = np.asarray(found.jacobian), len(found.position)
        moved = J[:count] / self.length * self.weights[0] if self.position is not None else J[:0]
        turned = J[count:] * self.weights[1] if self.quaternion is not None else J[:0]
        return np.concatenate([moved, turned])

    def reached(self, found: Response) -> bool:
        """True if the pose is within the tolerance."""
        position, turned = self.errors(found)
        off = np.linalg.norm(position) / self.length
        return bool(max(off, np.linalg.norm(turned)) <= self.tolerance)


def rotation_between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the rotation vector (rad, global axes, at most π long) from `one` to `other`."""
    (w, *v), (a, *b) = one / np.linalg.norm(one), other / np.linalg.norm(other)
    v, b = np.asarray(v), np.asarray(b)
    scalar, vector = a * w + b @ v, w * b - a * v - np.cross(b, v)
    if scalar < 0.0:
        scalar, vector = -scalar, -vector
    sine = np.linalg.norm(vector)
    return vector * (2.0 if sine < 1e-9 else 2.0 * np.arctan2(sine, scalar) / sine)


def at_limits(u: np.ndarray) -> np.ndarray:
    """Return controls in [0, 1], moved to a limit that only rounding separates: u + (1 - u) may not be 1."""
    return np.where(u < AT_LIMIT, 0.0, np.where(u > 1.0 - AT_LIMIT, 1.0, u))


class _ReachSearch:
    """State of the searches of one call: the robot, the limits, and the number of equilibria computed."""

    def __init__(self, system: System, settings: Settings, pose: Pose, low: np.ndarray, high: np.ndarray):
        self.system, self.settings, self.pose = system, settings, pose
        self.low, self.high, self.span = low, high, high - low
        self.free = self.span > 0.0
        self.trials = 0

    def control(self, u: np.ndarray) -> np.ndarray:
        """Return controls within their limits, and exactly at them for u = 0 and 1."""
        return np.where(u >= 1.0, self.high, np.minimum(self.low + u * self.span, self.high))

    def at(self, u: np.ndarray, guess: Response) -> Response | None:
        """Return the equilibrium near another, or None."""
        self.trials += 1
        found = respond(self.system, self.settings, self.pose, self.control(u), guess.y)
        return found if found.error <= self.settings.newton.acceptable else None

    def descend(self, wanted: _Wanted, u: np.ndarray, found: Response) -> tuple[np.ndarray, Response, bool]:
        """Return the locally nearest pose, and True if the search converged to it."""
        u = at_limits(u)
        for epsilon in STAGES:
            u, found = self._stage(wanted, u, found, epsilon)
        J, r = wanted.slope(found) * self.span, wanted.residual(found)
        slope = J.T @ r
        # gradient components that point out of the limits do not count
        slope = np.where(((u <= 0.0) & (slope > 0.0)) | ((u >= 1.0) & (slope < 0.0)), 0.0, slope)
        steepest = np.linalg.norm(r) * np.max(np.linalg.norm(J, axis=0))
        return u, found, bool(np.max(np.abs(slope)) <= FLAT * steepest + 1e-12)

    def _stage(
        self, wanted: _Wanted, u: np.ndarray, found: Response, epsilon: float
    ) -> tuple[np.ndarray, Response]:
        damping, enough = 0.0, 1e-3 if epsilon > STAGES[-1] else 1e-10
        slow = False
        last, bent = np.inf, np.zeros((0, len(u)))
        r = wanted.residual(found)
        merit = r @ r + epsilon**2 * u @ u
        for _ in range(MOST_TRIALS):
            J = wanted.slope(found) * self.span
            if slow and np.linalg.norm(r) > FAR:
                bent = self._bending(wanted, u, found, J)
            step = self._step(J, r, u, (bent, epsilon, damping))
            size = float(np.max(np.abs(step), initial=0.0))
            if size <= enough:
                return u, found
            predicted = (
                np.sum((r + J @ step) ** 2)
                + np.sum((bent @ step) ** 2)
                + epsilon**2 * np.sum((u + step) ** 2)
            )
            # the objective is at rounding, but steps are informative while each is shorter than the last
            below_rounding = bool(merit - predicted <= ROUNDING * merit)
            if below_rounding and size > 0.9 * last:
                return u, found
            slow, last = bool(size > 0.3 * last), size
            tried = at_limits(u + step)
            there = self.at(tried, found)
            new = np.inf
            if there is not None:
                r_there = wanted.residual(there)
                new = r_there @ r_there + epsilon**2 * tried @ tried
            if there is None or not (new < merit or (below_rounding and new < merit * (1 + 1e-9))):
                damping, slow = max(10.0 * damping, 1e-4), not len(bent)
                continue
            if below_rounding or merit - new > 0.5 * (merit - predicted):
                damping = damping / 10.0 if damping > 1e-6 else 0.0
            u, found, r, merit = tried, there, r_there, new
        return u, found

    def _bending(self, wanted: _Wanted, u: np.ndarray, found: Response, J: np.ndarray) -> np.ndarray:
        """Return rows B with BᵀB the positive part of Σ rᵢ ∇²rᵢ, by differences of Jᵀr.

        Far from the wanted pose it outweighs JᵀJ, the only term of the Gauss-Newton method.
        """
        gradient, columns = J.T @ wanted.residual(found), []
        for i in range(len(u)):
            h = DIFFERENCE if u[i] < 0.5 else -DIFFERENCE
            there = self.at(u + h * np.eye(len(u))[i], found) if self.free[i] else None
            if there is None:
                columns.append((J.T @ J)[i])
                continue
            slope = wanted.slope(there) * self.span
            columns.append((slope.T @ wanted.residual(there) - gradient) / h)
        S = np.stack(columns) - J.T @ J
        values, directions = np.linalg.eigh((S + S.T) / 2)
        kept = values > 1e-4 * np.max(np.abs(values))
        return np.sqrt(values[kept])[:, None] * directions[:, kept].T

    def _step(self, J: np.ndarray, r: np.ndarray, u: np.ndarray, quadratic: Any) -> Any:
        """Return the change of u that minimises the quadratic model, within the limits."""
        # imported here: it would double this package's import time
        from scipy.optimize import lsq_linear

        bent, epsilon, damping = quadratic
        free, size = self.free, len(u)
        if not np.any(free):
            return np.zeros(size)
        damped = np.sqrt(damping) * np.linalg.norm(J, axis=0).max(initial=0.0)
        A = np.concatenate([J, bent, epsilon * np.eye(size), damped * np.eye(size)])[:, free]
        b = -np.concatenate([r, np.zeros(len(bent)), epsilon * u, np.zeros(size)])
        step = np.zeros(size)
        step[free] = lsq_linear(A, b, (-u[free], 1.0 - u[free]), method="bvls", tol=1e-14).x
        return np.clip(step, -u, 1.0 - u)
