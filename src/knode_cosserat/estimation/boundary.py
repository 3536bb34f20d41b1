"""Boundary observer: a model that is pulled to the measured tip by a virtual spring and damper."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.outputs import TipPosition, final_output
from knode_cosserat.rods.loads import PointWrench
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.solvers.places import OwnFrame
from knode_cosserat.solvers.stepper import Stepper
from knode_cosserat.trajectory import Trajectory


class BoundaryObserver:
    """Observer by a virtual wrench at the tip, from the measured position of the tip (Zheng et al. 2023).

    The wrench is a spring and a damper between the measured and the estimated tip. It acts one period after
    the measurement, so that the estimate converges only for gains that are small for the period. There is no
    covariance.
    """

    def __init__(
        self,
        robot: System,
        dt: float,
        *,
        stiffness: float | None = None,
        damping: float | None = None,
        initial: Trajectory | Literal["equilibrium", "unstressed"] = "equilibrium",
    ):
        """Start at rest under zero control, or at the last row of a trajectory.

        Args:
            robot: the model: a rod with `loads`.
            dt: period (s).
            stiffness: of the virtual spring (N/m); by default ten times that of the rod's tip, 30 EI/L³.
            damping: of the virtual damper (N s/m); by default √(k m) with the rod's mass m.
            initial: where it starts, as in `simulate`.
        """
        base: Any = robot
        if not hasattr(nominal_model(base), "loads"):
            raise ValueError(f"robot is a {type(robot).__name__}; allowed is a rod with loads")
        self._index = len(nominal_model(base).loads)
        loads = (*nominal_model(base).loads, PointWrench())
        self.robot = robot.replace(loads=loads)
        length, bending = float(nominal_model(base).length), float(nominal_model(base).Kbt[0, 0])
        mass = float(nominal_model(base).mass_per_length) * length
        self.stiffness = 30.0 * bending / length**3 if stiffness is None else float(stiffness)
        self.damping = np.sqrt(self.stiffness * mass) if damping is None else float(damping)
        # the wrench acts a period late: BDF2 damps the fast modes that it would excite
        self._stepper = Stepper(self.robot, dt, time="bdf2", initial=initial)
        #: rotation from the frame of the measurements to the robot's
        self._turn = OwnFrame.of(robot).turn
        self._measured: Any = None
        self._force = np.zeros(3)

    def predict(self, control: Float[np.ndarray, " c"]) -> None:
        """Advance the estimate by one period under a control and the virtual wrench."""
        self._stepper.robot = self.robot.replace(**{f"loads.{self._index}.force": self._force})
        self._stepper.step(control)

    def update(self, measured: Float[np.ndarray, "3"]) -> None:
        """Set the wrench of the next period from a measured tip (m); a lost measurement (NaN) sets none."""
        tip, dt = final_output(self.robot, self._stepper.state, TipPosition()), self._stepper.dt
        error = self._turn @ (np.asarray(measured, dtype=float)[:3] - tip)
        if not np.all(np.isfinite(error)):
            self._force, self._measured = np.zeros(3), None
            return
        rate = np.zeros(3) if self._measured is None else (error - self._measured) / dt
        self._force, self._measured = self.stiffness * error + self.damping * rate, error

    @property
    def state(self) -> Trajectory:
        """Current estimate, a trajectory of one row."""
        return self._stepper.state
