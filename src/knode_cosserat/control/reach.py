"""Inverse kinematics: the controls under which a robot at rest has a wanted pose.

With u the controls between their limits (0 to 1) and r the pose's error in natural units,

    minimise |r(u)|² + ε² |u|²,     0 ≤ u ≤ 1

by Levenberg's method, each of whose steps is a bounded linear least-squares problem, solved exactly. ε goes
down in stages to 1e-7: of all controls that reach a pose it finds those nearest to the lower limits, and
what is left of it in the pose is of the size ε². Slopes are exact, by the implicit function theorem.
"""

from __future__ import annotations

import dataclasses
import enum
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.control.asked import (
    checked_control,
    checked_limits,
    checked_numbers,
    checked_system,
    static_settings,
)
from knode_cosserat.control.statics import Pose, Response, first_solved, respond, rest_guess, tip_pose
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.result import SimulationError
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import SpaceScheme

#: ε in turn: a strong one first, so that controls do not run off along what the pose hardly feels
STAGES = (3e-2, 1e-3, 1e-5, 1e-7)
#: equilibria that one search looks at in a stage, at most
MOST_TRIALS = 80
#: in natural units: a residual beyond this may be so far that its own curvature counts
FAR = 1e-4
#: part of the way between the limits by which curvature is differenced
DIFFERENCE = 1e-4
#: slope of the distance, in parts of what it could be, that counts as none
FLAT = 1e-6
#: rounding, in parts of what is minimised
ROUNDING = 1e-13


class Reach(enum.IntEnum):
    """What came of a wanted pose. Zero: reached. Below zero: not, and the pose is another."""

    REACHED = 0
    UNREACHABLE = -1
    NOT_CONVERGED = -2
    NO_EQUILIBRIUM = -3

    @property
    def message(self) -> str:
        """The result in words."""
        return {
            Reach.REACHED: "reached",
            Reach.UNREACHABLE: "not reachable from there: the nearest pose that was found",
            Reach.NOT_CONVERGED: "stopped before it was certain that nothing is nearer",
            Reach.NO_EQUILIBRIUM: "no equilibrium to begin with",
        }[self]


@dataclasses.dataclass(frozen=True)
class InverseKinematics:
    """Controls that reach a pose, or come nearest; with several poses every array has their axis in front.

    Only where `result` is `Reach.REACHED` (`converged`) is the pose the wanted one.
    """

    #: a `Reach`
    result: Any
    #: (c,)
    control: Any
    #: where the pose is then: (3,) in m, and (4,) or None of a robot without orientation
    position: Any
    quaternion: Any
    #: how far that is from what was wanted (m), and how turned from it (rad); zero for what was not asked
    position_error: Any
    angle_error: Any
    #: which controls are at their limits (c,)
    at_low: Any
    at_high: Any
    #: whether `kc.equilibrium`, which begins at the unloaded robot, finds the same shape; where it does not
    #: the robot has several, and has to be led here
    from_rest: Any
    #: equilibria that were looked at
    iterations: Any

    @property
    def converged(self) -> Any:
        """Whether the pose was reached."""
        return self.result == Reach.REACHED


class _Wanted(NamedTuple):
    """A pose, with what its errors are divided by."""

    position: np.ndarray | None
    quaternion: np.ndarray | None
    length: float
    weights: tuple[float, float]
    tolerance: float

    def errors(self, found: Response) -> tuple[np.ndarray, np.ndarray]:
        """Of position (m) and of orientation (a rotation vector, rad); empty for what is not wanted."""
        position = turned = np.zeros(0)
        if self.position is not None:
            position = np.asarray(found.position) - self.position
        if self.quaternion is not None:
            turned = rotation_between(self.quaternion, np.asarray(found.quaternion))
        return position, turned

    def residual(self, found: Response) -> np.ndarray:
        position, turned = self.errors(found)
        return np.concatenate([position / self.length * self.weights[0], turned * self.weights[1]])

    def slope(self, found: Response) -> np.ndarray:
        """∂residual/∂control.

        Of a rotation vector θ the angular velocity stands for its rate: Jᵀθ, and so where the least is, is
        exact; the rest is for small θ.
        """
        J, count = np.asarray(found.jacobian), len(found.position)
        moved = J[:count] / self.length * self.weights[0] if self.position is not None else J[:0]
        turned = J[count:] * self.weights[1] if self.quaternion is not None else J[:0]
        return np.concatenate([moved, turned])

    def reached(self, found: Response) -> bool:
        position, turned = self.errors(found)
        off = np.linalg.norm(position) / self.length
        return bool(max(off, np.linalg.norm(turned)) <= self.tolerance)


def rotation_between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The rotation vector (rad, global axes, at most π long) that turns `one` into `other`."""
    (w, *v), (a, *b) = one / np.linalg.norm(one), other / np.linalg.norm(other)
    v, b = np.asarray(v), np.asarray(b)
    scalar, vector = a * w + b @ v, w * b - a * v - np.cross(b, v)
    if scalar < 0.0:
        scalar, vector = -scalar, -vector
    sine = np.linalg.norm(vector)
    return vector * (2.0 if sine < 1e-9 else 2.0 * np.arctan2(sine, scalar) / sine)


class _Search:
    """Searches of one call: the robot, the limits, and the equilibria that were looked at."""

    def __init__(self, system: System, settings: Settings, pose: Pose, low: np.ndarray, high: np.ndarray):
        self.system, self.settings, self.pose = system, settings, pose
        self.low, self.high, self.span = low, high, high - low
        self.free = self.span > 0.0
        self.trials = 0

    def control(self, u: np.ndarray) -> np.ndarray:
        """Controls within their limits, and exactly at them for u = 0 and 1."""
        return np.where(u >= 1.0, self.high, np.minimum(self.low + u * self.span, self.high))

    def at(self, u: np.ndarray, guess: Response) -> Response | None:
        """The equilibrium near another, or None."""
        self.trials += 1
        found = respond(self.system, self.settings, self.pose, self.control(u), guess.y, guess.unknowns)
        return found if found.error <= self.settings.newton.acceptable else None

    def descend(self, wanted: _Wanted, u: np.ndarray, found: Response) -> tuple[np.ndarray, Response, bool]:
        """The nearest pose from there, and whether the search ended for that reason."""
        for epsilon in STAGES:
            u, found = self._stage(wanted, u, found, epsilon)
        J, r = wanted.slope(found) * self.span, wanted.residual(found)
        slope = J.T @ r
        # what points out of the limits is no way to go
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
            # what is minimised says no more, but steps still tell: as long as each is shorter than the last
            below_rounding = bool(merit - predicted <= ROUNDING * merit)
            if below_rounding and size > 0.9 * last:
                return u, found
            slow, last = bool(size > 0.3 * last), size
            tried = np.clip(u + step, 0.0, 1.0)
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
        """Rows B with BᵀB the part of Σ rᵢ ∇²rᵢ that is positive, by differences of Jᵀr.

        Far from what is wanted it outweighs JᵀJ, of which Gauss and Newton's method alone knows.
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
        """The change of u that is best by the slopes at hand, within the limits."""
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
    space: str | SpaceScheme = "euler",
    newton: NewtonOptions = NewtonOptions(),
    pose: Pose = tip_pose,
) -> InverseKinematics:
    """The controls under which a robot at rest has its tip at a position, in an orientation, or both.

    Of all controls that reach a pose those nearest to `low` are taken (least squares, in parts of the way
    from `low` to `high`). A pose that cannot be reached gives the nearest that was found, by weights, and
    says so. The search is local: it begins at `initial`, then, as long as the pose is not reached, at up to
    `starts` other controls. Shapes are followed from there: of a robot with several equilibria the one found
    may not be the one of `kc.equilibrium` (see `from_rest`).

    Args:
        robot: one robot or model.
        position: wanted position (3,) in m, or (B, 3): a path, each pose looked for from the last.
        quaternion: wanted orientation (4,) or (B, 4), scalar first, of any length.
        low: lower limits of the controls, a number or (c,).
        high: upper limits.
        initial: (c,), where to begin; by default half-way between the limits.
        weights: of the errors of position, in parts of the robot's length, and of orientation (rad).
        tolerance: a pose is reached when it is off by no more than this part of the robot's length, and
            turned from it by no more than this (rad).
        starts: how many beginnings are tried before a pose is called unreachable.
        space: "euler", "rk4", or a scheme.
        newton: tolerances and limits of the solve.
        pose: whose pose, as for `kc.configuration`.

    Raises:
        ValueError: arguments of a wrong shape, not finite, or low above high.
    """
    system = checked_system(robot)
    settings = static_settings(space, newton)
    limits = checked_limits(system, low, high)
    wanted, single = _checked_wanted(system, pose, position, quaternion, (weights, tolerance))
    begin = None
    if initial is not None:
        begin = checked_control(system, initial, "initial")
        if np.any((begin < limits[0]) | (begin > limits[1])):
            raise ValueError(f"initial is {begin.tolist()}; it must be between low and high")
    if not _whole(starts):
        raise ValueError(f"starts is {starts!r}; allowed is a whole number from 1")
    search = _Search(system, settings, pose, *limits)
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
    none = {name: None for name in names if columns[name][0] is None}
    return InverseKinematics(**{name: np.array(columns[name]) for name in names if name not in none}, **none)


def _whole(number: Any) -> bool:
    return isinstance(number, int | np.integer) and bool(number >= 1)


def _one(
    search: _Search, wanted: _Wanted, begin: np.ndarray, shape: Response | None, starts: int
) -> tuple[InverseKinematics, np.ndarray, Response | None]:
    """One pose, from a beginning and the equilibrium there (None: from rest), then from others."""
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
    from knode_cosserat.control.workspace import sample

    return np.where(free, sample(np.zeros(size), np.ones(size), max(count, 1))[:count], 0.0)


def _told(
    search: _Search, wanted: _Wanted, u: np.ndarray, found: Response, result: Reach
) -> InverseKinematics:
    control = search.control(u)
    position, turned = wanted.errors(found)
    cold = respond(search.system, search.settings, search.pose, control, *rest_guess(search.system))
    scale = np.asarray(search.system.scales().y)
    same = float(np.max(np.abs(np.asarray(cold.y) - np.asarray(found.y)) / scale)) < 1e-6
    return InverseKinematics(
        result, control, np.asarray(found.position),
        None if found.quaternion is None else np.asarray(found.quaternion),
        float(np.linalg.norm(position)), float(np.linalg.norm(turned)),
        control <= search.low, control >= search.high, same, search.trials,
    )  # fmt: skip


def _nothing(search: _Search, u: np.ndarray) -> InverseKinematics:
    control = search.control(u)
    position, quaternion = search.pose(search.system, np.full(search.system.y_layout.size, np.nan))
    return InverseKinematics(
        Reach.NO_EQUILIBRIUM, control, np.asarray(position),
        None if quaternion is None else np.asarray(quaternion), np.nan, np.nan,
        control <= search.low, control >= search.high, False, search.trials,
    )  # fmt: skip


def _checked_wanted(
    system: System, pose: Pose, position: Any, quaternion: Any, measured_by: Any
) -> tuple[list[_Wanted], bool]:
    """The wanted poses, and whether one was given rather than several."""
    here, turned = pose(system, system.rest(system.length)[0])
    given: dict[str, np.ndarray] = {}
    if position is not None:
        size = len(here)
        given["position"] = checked_numbers("position", position, size, f"({size},) or (B, {size}) in m")
    if quaternion is not None:
        if turned is None:
            raise ValueError(f"quaternion is given, but {type(system).__name__} has no orientation")
        given["quaternion"] = checked_numbers("quaternion", quaternion, 4, "(4,) or (B, 4), scalar first")
        if np.any(np.linalg.norm(given["quaternion"], axis=-1) < 1e-9):
            raise ValueError("quaternion is zero; allowed is any other length")
    if not given:
        raise ValueError("neither position nor quaternion is given; give one or both")
    tolerance = float(checked_numbers("tolerance", np.atleast_1d(measured_by[1]), 1, "a number", most=1)[0])
    if tolerance <= 0.0:
        raise ValueError(f"tolerance is {tolerance:g}; allowed is above 0")
    weights = checked_numbers("weights", measured_by[0], 2, "(2,): of position and of orientation", most=1)
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
        _Wanted(row("position", i), row("quaternion", i), length, weight, tolerance) for i in range(count)
    ], single
