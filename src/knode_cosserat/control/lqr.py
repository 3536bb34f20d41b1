"""Linear-quadratic regulator about an equilibrium, with an estimate of the linear state and of an offset.

The linear model is found from impulse responses, which are exact derivatives of a simulation, by the
eigensystem realization algorithm (Juang & Pappa 1985).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_discrete_are

from knode_cosserat.control.commands import Command, Controller, ControlLimits, register_controller
from knode_cosserat.control.references import Reference
from knode_cosserat.estimation.observer import KalmanObserver
from knode_cosserat.estimation.online import Belief, Spread, errors_along
from knode_cosserat.estimation.outputs import Output, TipPosition
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.places import OwnFrame, without_camera
from knode_cosserat.solvers.refinement import fix_grid

#: preload of all controls, as a part of their range: tendons only pull, so that each needs room to let go
PRELOAD = 0.25
#: steps of the impulse responses
STEPS = 80
#: singular values below this part of the largest one are left out, and the largest order
LEAST, ORDER = 1e-3, 16


def linear_model(
    robot: System, dt: float, control: Float[np.ndarray, " c"], output: Output
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, C and y₀ of x⁺ = A x + B (u - u₀), y = y₀ + C x⁺ about the equilibrium under a control u₀.

    y is the output one period after the control u.

    Raises:
        SimulationError: there is no such equilibrium.
    """
    count = len(control)
    observer = KalmanObserver(robot, dt, output, initial=equilibrium(fix_grid(robot), control))
    used, size = observer.belief.spread.rate.shape[1:]
    rows = np.zeros((count, 2, used, size))
    belief = Belief(np.zeros(0), observer.belief.past, Spread(rows, rows[:, 0], np.zeros((count, 0))))
    # each control's impulse in the first period
    pulses = np.zeros((count, STEPS, count))
    pulses[:, 0] = np.eye(count)
    columns = observer.model.columns(output)
    moved, motion = observer.model.rollout(belief, np.tile(control, (STEPS, 1)), pulses, columns)
    if motion is None:
        raise RuntimeError("the motion about the equilibrium was not solved")
    zero = np.zeros((STEPS, output.size))
    values, slopes = errors_along(
        moved.system, output, motion.records, motion.d_records, zero, columns=columns
    )
    return *realize(np.moveaxis(np.asarray(slopes), 0, -1)), np.asarray(values[-1])


def realize(
    responses: Float[np.ndarray, "T p c"], least: float = LEAST, most: int = ORDER
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, C with C Aᵏ B equal to the responses k = 0, 1, … as well as a state of low order can."""
    count, p, c = responses.shape
    half = range(count // 2)
    first, later = (np.block([[responses[i + j + shift] for j in half] for i in half]) for shift in (0, 1))
    U, s, Vt = np.linalg.svd(first, full_matrices=False)
    order = min(most, int(np.sum(s > least * s[0])))
    root = np.sqrt(s[:order])
    U, Vt = U[:, :order], Vt[:order]
    A = (U.T @ later @ Vt.T) / root[:, None] / root[None, :]
    return A, root[:, None] * Vt[:, :c], U[:p] * root


@register_controller("lqr", "regulator of a linear model about an equilibrium, with an estimated offset")
class LQR(Controller):
    """Linear-quadratic regulator of the tip's position by a linear model, with an estimated offset.

    The state and the disturbance are estimated by a stationary Kalman filter. The steady state whose output
    is the reference of the next period is the target of the regulator.
    """

    def __init__(
        self,
        robot: System,
        dt: float,
        limits: ControlLimits,
        *,
        change: float = 1e-2,
        disturbance: float = 0.1,
    ):
        """Linearise the robot about the equilibrium under a quarter of the greatest controls.

        Args:
            robot: the model.
            dt: period (s).
            limits: limits of the controls: the regulator's commands are clipped.
            change: cost of a control over its whole range, relative to an error of one `noise` of the target.
            disturbance: standard deviation of the disturbance's change in one period, in `noise`.

        Raises:
            SimulationError: there is no such equilibrium.
        """
        self.dt, self.limits, self.target = float(dt), limits.of(robot), TipPosition()
        self._frame, robot = OwnFrame.of(robot), without_camera(robot)
        low, high = np.asarray(self.limits.low), np.asarray(self.limits.high)
        #: control and output of the equilibrium
        self._control_0 = low + PRELOAD * (high - low)
        A, B, C, self._output_0 = linear_model(robot, dt, self._control_0, self.target)
        n, p = len(A), len(C)
        Q = C.T @ C / np.mean(self.target.noise) ** 2
        R = np.diag(change / (high - low) ** 2)
        P = solve_discrete_are(A, B, Q + 1e-9 * np.trace(Q) / n * np.eye(n), R)
        self._gain = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        # state and disturbance together
        self._A = np.block([[A, np.zeros((n, p))], [np.zeros((p, n)), np.eye(p)]])
        self._B = np.concatenate([B, np.zeros((p, B.shape[1]))])
        self._C = np.concatenate([C, np.eye(p)], axis=1)
        noise = np.diag(self.target.noise**2)
        spread = 0.02 * (high - low)
        driven = self._B @ np.diag(spread**2) @ self._B.T
        driven[n:, n:] += disturbance**2 * noise
        S = solve_discrete_are(self._A.T, self._C.T, driven + 1e-12 * np.eye(n + p), noise)
        self._filter = np.linalg.solve(self._C @ S @ self._C.T + noise, self._C @ S).T
        # states of steady controls, in which all of them are linear
        self._states = np.linalg.solve(np.eye(n) - A, B)
        self._outputs = C @ self._states
        self.reset(np.asarray(self.limits.safe))

    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Start from a control that acts now, at rest."""
        self._control = np.array(control, dtype=float)
        x = self._states @ (self._control - self._control_0)
        self._state = np.concatenate([x, np.zeros(len(self._output_0))])

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the regulator's control."""
        measured = self._frame.tip(measured)
        expected = self._output_0 + self._C @ self._state
        error = np.where(np.isfinite(measured), measured - expected, 0.0)
        self._state = self._state + self._filter @ error
        n = len(self._states)
        x, offset = self._state[:n], self._state[n:]
        wanted = reference.expected(time, self.dt)[0] - self._output_0 - offset
        known = np.isfinite(wanted)
        # the steady control whose known outputs are the wanted ones
        steady = np.linalg.pinv(self._outputs[known], rcond=1e-3) @ wanted[known]
        control = self._control_0 + steady - self._gain @ (x - self._states @ steady)
        self._control = self.limits.applied(control, self._control, self.dt)
        return Command(self._control)

    def advance(self, control: Float[np.ndarray, " c"]) -> None:
        """Predict the state under the control that acts from now on."""
        self._control = np.asarray(control, dtype=float)
        self._state = self._A @ self._state + self._B @ (self._control - self._control_0)
