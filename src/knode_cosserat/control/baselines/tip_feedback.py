"""Controllers that act on the measured tip, by the statics of the robot: PID, and inverse kinematics."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.control.baselines.static_map import StaticMap
from knode_cosserat.control.commands import Command, Controller, ControlLimits, Status
from knode_cosserat.control.references import Reference
from knode_cosserat.rods.system import System


class TipFeedback(Controller):
    """Base of controllers that act on the measured position of the tip."""

    def __init__(self, robot: System, dt: float, limits: ControlLimits):
        self.robot, self.dt = robot, float(dt)
        self.limits = limits.of(robot)
        self.map = StaticMap(robot, self.limits)
        self.reset(np.asarray(self.limits.safe))

    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Start from a control that acts now."""
        self._control = np.array(control, dtype=float)
        self._sum, self._last = np.zeros(3), np.full(3, np.nan)

    def _error(self, time: float, measured: Any, reference: Reference) -> Float[np.ndarray, "3"]:
        """Return the wanted less the measured position (m); zero where either is unknown or free."""
        error = reference.at([time])[0, :3] - np.asarray(measured, dtype=float)[:3]
        return np.where(np.isfinite(error), error, 0.0)

    def _applied(self, wanted: Any) -> Command:
        """Return a command within the limits."""
        self._control = self.limits.applied(wanted, self._control, self.dt)
        return Command(self._control, Status.OPTIMAL)

    def fallback(self, reason: str) -> Command:
        """Return the control that acts now."""
        return Command(self._control, Status.HELD, reason)


class PID(TipFeedback):
    """PID control of the tip's position, through the static Jacobian of the robot under a preload.

    The error is mapped to controls by damped least squares; the integral stops where controls are limited.
    """

    def __init__(
        self, robot: System, dt: float, limits: ControlLimits, *, proportional: float = 0.4,
        integral: float = 2.0, derivative: float = 0.05,
    ):  # fmt: skip
        """Set the gains: dimensionless, in 1/s, and in s."""
        self._gains = proportional, integral, derivative
        super().__init__(robot, dt, limits)
        _, self._jacobian, _ = self.map.solved(self.map.preload)

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the control from the error of the tip."""
        error = self._error(time, measured, reference)
        known = np.isfinite(reference.at([time])[0, :3])
        change = np.where(np.isfinite(self._last), error - self._last, 0.0) / self.dt
        total = self._sum + error * self.dt
        proportional, integral, derivative = self._gains
        wanted = (proportional * error + integral * total + derivative * change)[known]
        preload = self.map.preload
        control = preload + self.map.step(wanted, self._jacobian[known], preload)
        found = self._applied(control)
        if np.allclose(found.control, control):  # no wind-up
            self._sum = total
        self._last = error
        return found


class KinematicController(TipFeedback):
    """Inverse kinematics of equilibria as feed-forward, with an integral of the tip's error."""

    def __init__(self, robot: System, dt: float, limits: ControlLimits, *, integral: float = 0.5):
        """Set the gain of the integral (1/s)."""
        self._integral = integral
        super().__init__(robot, dt, limits)

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the control whose equilibrium is the wanted position, shifted by the integral."""
        total = self._sum + self._integral * self.dt * self._error(time, measured, reference)
        wanted = reference.expected(time, self.dt)[0, :3] + total
        control = self.map.inverse(wanted, self._control)
        found = self._applied(control)
        if np.allclose(found.control, control):
            self._sum = total
        return found
