"""Model-predictive control by a real-time iteration (Diehl, Bock & Schlöder 2005).

In each period one quadratic program is solved. Before the measurement arrives, the model is simulated over
the horizon under the shifted plan, and linearised by the plan and by the directions in which the observer's
state is uncertain (`prepare`). The measurement then corrects the state and the program (`command`), which
takes less than a millisecond.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat.control.commands import Command, Controller, ControlLimits, Status
from knode_cosserat.control.plans import Knots
from knode_cosserat.control.prediction import Prediction, linearised_prediction
from knode_cosserat.control.qp import QPSolver, QuadraticProgram, solver_named
from knode_cosserat.control.references import Reference
from knode_cosserat.estimation.observer import KalmanObserver, ObserverError
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.rods.system import System

#: periods in which an old plan goes on, and then the last control is held, before the robot goes safe
SHIFTS, HOLDS = 5, 5


@dataclasses.dataclass(frozen=True)
class SoftLimit:
    """Limits of an output along the prediction: kept if possible, and the violation is reported.

    Attributes:
        output: the limited output.
        low: least value, or values (p,).
        high: greatest value, or values (p,).
    """

    output: Output
    low: Any = -np.inf
    high: Any = np.inf


@dataclasses.dataclass(frozen=True)
class Weights:
    """Weights of the cost, beside the tracked errors in units of their `noise`.

    Attributes:
        change: of the squared change of controls in one period, relative to the range of the controls.
        effort: of the squared distance from the preferred controls, relative to the range.
        preferred: preferred controls; None: the safe ones.
    """

    change: float = 1e-2
    effort: float = 1e-4
    preferred: Any = None


class PredictiveController(Controller):
    """Model-predictive controller of any robot whose model is a System.

    robot = kc.load_robot("delrin-tendon-robot")
    observer = kc.estimation.KalmanObserver(robot, 0.05, TipPosition())
    controller = kc.control.PredictiveController(observer, TipPosition(), ControlLimits(0.0, 10.0, 40.0))
    """

    def __init__(
        self, observer: KalmanObserver, target: Output, limits: ControlLimits, *, horizon: int = 20,
        knots: int = 8, weights: Weights = Weights(), soft: Sequence[SoftLimit] = (),
        solver: str | QPSolver = "daqp",
    ):  # fmt: skip
        """Set up the controller around an observer of the model; `reset` compiles it.

        Args:
            observer: estimates the state of the model, which is also the model of the predictions.
            target: the tracked output; references are its values.
            limits: hard limits of the controls and their rates.
            horizon: number of predicted periods.
            knots: number of controls in the plan; between them it is linear.
            weights: of the cost.
            soft: limits of outputs.
            solver: of the quadratic programs; "daqp".

        Raises:
            ValueError: limits or sizes that are not allowed.
        """
        self.observer, self.target, self.dt = observer, target, observer.dt
        self.limits = limits.of(observer.robot)
        self.knots = Knots.spaced(horizon, knots)
        self.weights, self.soft, self.solver = weights, tuple(soft), solver_named(solver)
        self._low, self._high = (
            np.concatenate([np.zeros(0), *(np.broadcast_to(end, (s.output.size,)) for s, end in pairs)])
            for pairs in ([(s, s.low) for s in self.soft], [(s, s.high) for s in self.soft])
        )
        self.reset(np.asarray(self.limits.safe))

    @property
    def robot(self) -> System:
        """The model."""
        return self.observer.robot

    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Forget the plan; the control acts now. The observer keeps its state."""
        self._plan = np.tile(np.asarray(control, dtype=float), (self.knots.count, 1))
        self._control = np.array(control, dtype=float)
        self._prediction: Prediction | None = None
        self._reason = "no prediction is prepared"
        self._failures = 0

    def copied(self) -> Self:
        """Return a copy, with a copy of the observer."""
        found = super().copied()
        found.observer = copy.copy(self.observer)
        return found

    # the two phases

    def prepare(self, time: float, reference: Reference) -> None:
        """Predict the motion over the horizon that begins at `time`, and linearise it."""
        times = time + self.dt * (1.0 + np.arange(self.knots.horizon))
        wanted = reference.at(times)
        if wanted.shape[1] != self.target.size:
            raise ValueError(
                f"the reference has {wanted.shape[1]} numbers; the target has {self.target.size}: "
                f"{', '.join(self.target.labels)}"
            )
        observer, limited = self.observer, tuple(soft.output for soft in self.soft)
        found = linearised_prediction(
            observer.model, observer.belief, self._plan, self.knots.basis, wanted, self.target, limited
        )
        if bool(found.solved):
            self._prediction = Prediction(*(np.asarray(part) for part in found))
        else:
            self._prediction, self._reason = None, "the prediction was not solved"
            # a constant plan is the easiest to predict
            self._plan = np.tile(self._control, (self.knots.count, 1))

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the control from the prepared prediction, corrected by the measurement."""
        coordinates = self.observer.update(measured)
        prediction = self._prediction
        if prediction is None:
            return self.fallback(self._reason)
        problem = self._problem(prediction, coordinates)
        found = self.solver.solve(problem)
        if not found.solved:
            return self.fallback("the quadratic program was not solved")
        plan = self._plan + found.x.reshape(self._plan.shape)
        # rounding errors of the solver must not exceed hard limits
        control = self.limits.applied(plan[0], self._control, self.dt)
        self._plan, self._failures = plan, 0
        limited = self._limited(prediction, coordinates) + np.tensordot(
            found.x, prediction.limited_by_plan, 1
        )
        beyond = np.maximum(limited - self._high, self._low - limited)
        violation = max(0.0, float(np.max(beyond, initial=0.0)))
        return Command(control, Status.OPTIMAL, "", prediction.path, violation)

    def advance(self, control: Float[np.ndarray, " c"]) -> None:
        """Take over the control that acts from now on: shift the plan and predict the observer's state."""
        self._control = np.asarray(control, dtype=float)
        self._plan = self.knots.shifted(self._plan)
        self._prediction, self._reason = None, "no prediction is prepared"
        try:
            self.observer.predict(self._control)
        except ObserverError as error:
            self._reason = str(error)
            self.observer.wait()

    def fallback(self, reason: str) -> Command:
        """Return a command without a solution: the shifted plan, then the last control, then a safe one."""
        self._failures += 1
        if self._failures <= SHIFTS:
            wanted, status = self._plan[0], Status.SHIFTED
        elif self._failures <= SHIFTS + HOLDS:
            wanted, status = self._control, Status.HELD
        else:
            wanted, status = np.asarray(self.limits.safe), Status.SAFE
        return Command(self.limits.applied(wanted, self._control, self.dt), status, reason)

    # the quadratic program

    def _limited(self, prediction: Prediction, coordinates: Any) -> Any:
        return prediction.limited + np.tensordot(coordinates, prediction.limited_by_state, 1)

    def _problem(self, prediction: Prediction, coordinates: Any) -> QuadraticProgram:
        knots, limits, c = self.knots, self.limits, len(self._control)
        error = prediction.error + np.tensordot(coordinates, prediction.by_state, 1)
        scale = np.where(np.isfinite(error), 1.0 / self.target.noise, 0.0)
        e = np.where(scale > 0.0, error, 0.0) * scale
        S = np.where(scale > 0.0, prediction.by_plan, 0.0) * scale
        S = S.reshape(len(S), -1)
        # a wanted error of one `noise` counts like a change over the whole range
        spread = np.asarray(limits.high) - np.asarray(limits.low)
        changes = np.kron(knots.changes, np.diag(1.0 / spread))
        first = np.zeros((knots.count, c))
        first[0] = self._control / spread
        now = changes @ self._plan.ravel() - first.ravel()
        w = self.weights
        preferred = np.asarray(limits.safe if w.preferred is None else w.preferred)
        away = ((self._plan - preferred) / spread).ravel()
        effort = np.tile(1.0 / spread, knots.count)
        H = S @ S.T + w.change * changes.T @ changes + w.effort * np.diag(effort**2)
        g = S @ e.ravel() + w.change * changes.T @ now + w.effort * effort * away
        most = np.tile(np.asarray(limits.rate) * self.dt, knots.count)
        A = np.kron(knots.changes, np.eye(c))
        moved = A @ self._plan.ravel() - (first * spread).ravel()
        below, above = -most - moved, most - moved
        low, high = (
            np.tile(np.asarray(end), knots.count) - self._plan.ravel() for end in (limits.low, limits.high)
        )
        soft = 0
        if self.soft:
            limited = self._limited(prediction, coordinates)
            rows = prediction.limited_by_plan.reshape(len(S), -1).T
            soft = len(rows)
            A = np.concatenate([A, rows])
            below = np.concatenate([below, (self._low - limited).ravel()])
            above = np.concatenate([above, (self._high - limited).ravel()])
        return QuadraticProgram(H, g, low, high, A, below, above, soft)
