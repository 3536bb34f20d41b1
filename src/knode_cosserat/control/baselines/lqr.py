"""Linear-quadratic regulator about an equilibrium, with an estimate of the linear state and of an offset."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_discrete_are

from knode_cosserat.control.baselines.linear_model import LinearModel, linear_model
from knode_cosserat.control.baselines.static_map import PRELOAD
from knode_cosserat.control.commands import Command, Controller, ControlLimits, Status
from knode_cosserat.control.references import Reference
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.rods.system import System


class LQR(Controller):
    """Linear-quadratic regulator of a linear model, with an estimated offset of the output.

    The state and the disturbance are estimated by a stationary Kalman filter. The steady state whose output
    is the reference of the next period is the target of the regulator.
    """

    def __init__(
        self, robot: System, dt: float, target: Output, limits: ControlLimits, *, change: float = 1e-2,
        disturbance: float = 0.1,
    ):  # fmt: skip
        """Linearise the robot about the equilibrium under a quarter of the greatest controls.

        Args:
            robot: the model.
            dt: period (s).
            target: the measured and tracked output, a position.
            limits: limits of the controls: the regulator's commands are clipped.
            change: cost of a control over its whole range, relative to an error of one `noise` of the target.
            disturbance: standard deviation of the disturbance's change in one period, in `noise`.

        Raises:
            SimulationError: there is no such equilibrium.
        """
        self.dt, self.target = float(dt), target
        self.limits = limits.of(robot)
        low, high = np.asarray(self.limits.low), np.asarray(self.limits.high)
        self.model = linear_model(robot, dt, low + PRELOAD * (high - low), target)
        A, B, C = self.model[:3]
        n, p = len(A), len(C)
        Q = C.T @ C / np.mean(target.noise) ** 2
        R = np.diag(change / (high - low) ** 2)
        P = solve_discrete_are(A, B, Q + 1e-9 * np.trace(Q) / n * np.eye(n), R)
        self._gain = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        # state and disturbance together
        self._A = np.block([[A, np.zeros((n, p))], [np.zeros((p, n)), np.eye(p)]])
        self._B = np.concatenate([B, np.zeros((p, B.shape[1]))])
        self._C = np.concatenate([C, np.eye(p)], axis=1)
        noise = np.diag(target.noise**2)
        spread = 0.02 * (high - low)
        driven = self._B @ np.diag(spread**2) @ self._B.T
        driven[n:, n:] += disturbance**2 * noise
        S = solve_discrete_are(self._A.T, self._C.T, driven + 1e-12 * np.eye(n + p), noise)
        self._filter = np.linalg.solve(self._C @ S @ self._C.T + noise, self._C @ S).T
        self._steady = _steady(self.model)
        self.reset(np.asarray(self.limits.safe))

    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Start from a control that acts now, at rest."""
        self._control = np.array(control, dtype=float)
        A, B = self.model.A, self.model.B
        x = np.linalg.solve(np.eye(len(A)) - A, B @ (self._control - self.model.control))
        self._state = np.concatenate([x, np.zeros(len(self.model.C))])

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the regulator's control."""
        measured = np.asarray(measured, dtype=float)
        expected = self.model.output + self._C @ self._state
        error = np.where(np.isfinite(measured), measured - expected, 0.0)
        self._state = self._state + self._filter @ error
        n = len(self.model.A)
        x, offset = self._state[:n], self._state[n:]
        wanted = reference.expected(time, self.dt)[0] - self.model.output - offset
        known = np.isfinite(wanted)
        x_steady, u_steady = self._steady(np.where(known, wanted, 0.0), known)
        control = self.model.control + u_steady - self._gain @ (x - x_steady)
        self._control = self.limits.applied(control, self._control, self.dt)
        return Command(self._control, Status.OPTIMAL)

    def advance(self, control: Float[np.ndarray, " c"]) -> None:
        """Predict the state under the control that acts from now on."""
        self._control = np.asarray(control, dtype=float)
        self._state = self._A @ self._state + self._B @ (self._control - self.model.control)

    def fallback(self, reason: str) -> Command:
        """Return the control that acts now."""
        return Command(self._control, Status.HELD, reason)


def _steady(model: LinearModel) -> Any:
    """Return a function from wanted outputs, and which are known, to the steady state and control."""
    A, B, C = model[:3]
    states = np.linalg.solve(np.eye(len(A)) - A, B)

    def found(wanted: Any, known: Any) -> tuple[np.ndarray, np.ndarray]:
        u = np.linalg.pinv((C @ states)[known], rcond=1e-3) @ wanted[known]
        return states @ u, u

    return found
