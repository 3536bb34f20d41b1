"""The search of inverse kinematics: bounded least squares over equilibria.

With u the controls between their limits (0 to 1) and r the pose's error in natural units,

    minimise |r(u)|² + ε² |u|²,     0 ≤ u ≤ 1

by Levenberg's method. Each step is a bounded linear least-squares problem, solved exactly. ε decreases in
stages to 1e-7: among the controls that reach a pose the result is nearest to the lower limits, and the
remaining pose error is of the size ε². Derivatives are exact, by the implicit function theorem.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.statics.response import Pose, Response, respond

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


class Wanted(NamedTuple):
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


class EquilibriumSearch:
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

    def descend(self, wanted: Wanted, u: np.ndarray, found: Response) -> tuple[np.ndarray, Response, bool]:
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
        self, wanted: Wanted, u: np.ndarray, found: Response, epsilon: float
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

    def _bending(self, wanted: Wanted, u: np.ndarray, found: Response, J: np.ndarray) -> np.ndarray:
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
