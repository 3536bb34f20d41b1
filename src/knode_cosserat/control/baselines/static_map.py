"""Equilibria of a model as a map from controls to tip positions, for controllers without dynamics."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.control.commands import ControlLimits
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.statics.arguments import static_settings
from knode_cosserat.statics.response import first_solved, respond, tip_pose

#: damping of the least squares, relative to the Jacobian's largest singular value
DAMPING = 1e-2
#: preload of all controls, as a part of their range: tendons only pull, so that each needs room to let go
PRELOAD = 0.25
#: corrections of an inverse in one period, and the error (m) at which they end
CORRECTIONS, ENOUGH = 4, 1e-5


class StaticMap:
    """Tip positions of equilibria, their Jacobian, and the inverse by damped least squares."""

    def __init__(self, robot: System, limits: ControlLimits):
        """Solve the equilibrium under the preload.

        Raises:
            SimulationError: there is no equilibrium there.
        """
        self.robot, self.limits = robot, limits
        self._settings = static_settings("lobatto2", NewtonOptions())
        low, high = np.asarray(limits.low), np.asarray(limits.high)
        self.preload = low + PRELOAD * (high - low)
        self._found = first_solved(robot, self._settings, tip_pose, self.preload)

    def solved(self, control: Any) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 c"], bool]:
        """Return the tip's position (m), its Jacobian (m per control), and True if it was solved."""
        found = respond(self.robot, self._settings, tip_pose, control, self._found.y)
        if bool(found.error <= self._settings.newton.acceptable):
            self._found = found
            return np.asarray(found.position), np.asarray(found.jacobian)[:3], True
        return np.asarray(self._found.position), np.asarray(self._found.jacobian)[:3], False

    def inverse(self, position: Float[np.ndarray, "3"], control: Any) -> Float[np.ndarray, " c"]:
        """Return controls within the limits whose equilibrium has the tip nearest to a position (m).

        NaN coordinates are free. The search starts at a control and stays near the preload.
        """
        known = np.isfinite(position)
        control = np.array(control, dtype=float)
        for _ in range(CORRECTIONS):
            here, jacobian, solved = self.solved(control)
            error = (np.asarray(position) - here)[known]
            if not solved or np.max(np.abs(error), initial=0.0) < ENOUGH:
                break
            control = np.clip(
                control + self.step(error, jacobian[known], control), self.limits.low, self.limits.high
            )
        return control

    def step(self, error: Any, jacobian: Any, control: Any) -> Float[np.ndarray, " c"]:
        """Return the change of controls by damped least squares, as near to the preload as possible."""
        U, s, Vt = np.linalg.svd(jacobian, full_matrices=False)
        gains = s / (s * s + (DAMPING * s[0]) ** 2)
        null = np.eye(len(control)) - Vt.T @ Vt
        away = self.preload - control
        return Vt.T @ (gains * (U.T @ error)) + 0.5 * null @ away
