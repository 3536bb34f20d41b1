"""Controllers that act on the measured tip, by the statics of the robot: PID, and inverse kinematics."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.control.commands import Command, Controller, ControlLimits, register_controller
from knode_cosserat.control.lqr import PRELOAD
from knode_cosserat.control.references import Reference
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.settings import NewtonOptions
from knode_cosserat.solvers.places import OwnFrame
from knode_cosserat.statics.arguments import static_settings
from knode_cosserat.statics.response import first_solved, respond, tip_pose

#: damping of the least squares, relative to the Jacobian's largest singular value
DAMPING = 1e-2
#: corrections of an inverse in one period, and the error (m) at which they end
CORRECTIONS, ENOUGH = 4, 1e-5


class _TipFeedback(Controller):
    """Base of controllers that act on the measured position of the tip, by tip positions of equilibria."""

    def __init__(self, robot: System, dt: float, limits: ControlLimits):
        """Solve the equilibrium under the preload.

        Raises:
            SimulationError: there is no equilibrium there.
        """
        self.robot, self.dt = robot, float(dt)
        self.limits, self._frame = limits.of(robot), OwnFrame.of(robot)
        self._settings = static_settings("lobatto2", NewtonOptions())
        low, high = np.asarray(self.limits.low), np.asarray(self.limits.high)
        self.preload = low + PRELOAD * (high - low)
        self._response = first_solved(robot, self._settings, tip_pose, self.preload)
        self.reset(np.asarray(self.limits.safe))

    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Start from a control that acts now."""
        self._control = np.array(control, dtype=float)
        self._sum, self._last = np.zeros(3), np.full(3, np.nan)

    def _solved(self, control: Any) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 c"], bool]:
        """Return the tip's position (m), its Jacobian (m per control), and True if it was solved.

        Without a solution they are those of the last one.
        """
        response = respond(self.robot, self._settings, tip_pose, control, self._response.y)
        solved = bool(response.error <= self._settings.newton.acceptable)
        if solved:
            self._response = response
        return np.asarray(self._response.position), np.asarray(self._response.jacobian)[:3], solved

    def _step(self, error: Any, jacobian: Any, control: Any) -> Float[np.ndarray, " c"]:
        """Return the change of controls by damped least squares, as near to the preload as possible."""
        U, s, Vt = np.linalg.svd(jacobian, full_matrices=False)
        gains = s / (s * s + (DAMPING * s[0]) ** 2)
        null = np.eye(len(control)) - Vt.T @ Vt
        return Vt.T @ (gains * (U.T @ error)) + 0.5 * null @ (self.preload - control)

    def _error(self, time: float, measured: Any, reference: Reference) -> Float[np.ndarray, "3"]:
        """Return the wanted less the measured position (m); zero where either is unknown or free."""
        error = reference.at([time])[0, :3] - self._frame.tip(measured)
        return np.where(np.isfinite(error), error, 0.0)

    def _applied(self, control: Any, total: Float[np.ndarray, "3"]) -> Command:
        """Return a command within the limits; the integral becomes `total` unless they clip the control."""
        self._control = self.limits.applied(control, self._control, self.dt)
        if np.allclose(self._control, control):  # no wind-up
            self._sum = total
        return Command(self._control)


@register_controller("pid", "PID of the tip's error, through the static Jacobian")
class PID(_TipFeedback):
    """PID control of the tip's position, through the static Jacobian of the robot under a preload.

    The error is mapped to controls by damped least squares; the integral stops where controls are limited.
    """

    def __init__(
        self,
        robot: System,
        dt: float,
        limits: ControlLimits,
        *,
        proportional: float = 0.4,
        integral: float = 2.0,
        derivative: float = 0.05,
    ):
        """Set the gains: dimensionless, in 1/s, and in s."""
        self._gains = proportional, integral, derivative
        super().__init__(robot, dt, limits)
        _, self._jacobian, _ = self._solved(self.preload)

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the control from the error of the tip."""
        error = self._error(time, measured, reference)
        known = np.isfinite(reference.at([time])[0, :3])
        change = np.where(np.isfinite(self._last), error - self._last, 0.0) / self.dt
        total = self._sum + error * self.dt
        proportional, integral, derivative = self._gains
        wanted = (proportional * error + integral * total + derivative * change)[known]
        self._last = error
        step = self._step(wanted, self._jacobian[known], self.preload)
        return self._applied(self.preload + step, total)


@register_controller("kinematic", "inverse kinematics of equilibria, with an integral")
class KinematicController(_TipFeedback):
    """Inverse kinematics of equilibria as feed-forward, with an integral of the tip's error."""

    def __init__(self, robot: System, dt: float, limits: ControlLimits, *, integral: float = 0.5):
        """Set the gain of the integral (1/s)."""
        self._integral = integral
        super().__init__(robot, dt, limits)

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the control whose equilibrium is the wanted position, shifted by the integral."""
        total = self._sum + self._integral * self.dt * self._error(time, measured, reference)
        wanted = reference.expected(time, self.dt)[0, :3] + total
        return self._applied(self._inverse(wanted), total)

    def _inverse(self, position: Float[np.ndarray, "3"]) -> Float[np.ndarray, " c"]:
        """Return controls within the limits whose equilibrium has the tip nearest to a position (m).

        NaN coordinates are free. The search starts at the control that acts and stays near the preload.
        """
        known = np.isfinite(position)
        control = self._control
        for _ in range(CORRECTIONS):
            tip, jacobian, solved = self._solved(control)
            error = (position - tip)[known]
            if not solved or np.max(np.abs(error), initial=0.0) < ENOUGH:
                break
            step = self._step(error, jacobian[known], control)
            control = np.clip(control + step, self.limits.low, self.limits.high)
        return control
