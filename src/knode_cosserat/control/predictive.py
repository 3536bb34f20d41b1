"""Model-predictive control by a real-time iteration (Diehl, Bock & Schlöder 2005).

In each period one quadratic program is solved. Before the measurement arrives, the model is simulated over
the horizon under the shifted plan, and linearised by the plan and by the directions in which the observer's
state is uncertain (`prepare`). The measurement then corrects the state and the program (`command`), which
takes less than a millisecond.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.control.commands import Command, ControlLimits
from knode_cosserat.control.planning import PlanController
from knode_cosserat.control.prediction import Prediction, linearised_prediction
from knode_cosserat.control.program import SoftRows, Weights, applied_changes
from knode_cosserat.control.qp import QPSolver, soft_violations, solved_program, solver_named
from knode_cosserat.control.references import Reference
from knode_cosserat.estimation.observer import KalmanObserver
from knode_cosserat.estimation.outputs import Output


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


class PredictiveController(PlanController):
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
        self.soft, self.solver = tuple(soft), solver_named(solver)
        super().__init__(observer, target, limits, horizon, knots, weights)
        self._low = _at_samples([(each.low, each.output) for each in self.soft], horizon)
        self._high = _at_samples([(each.high, each.output) for each in self.soft], horizon)

    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Forget the plan; the control acts now. The observer keeps its state."""
        super().reset(control)
        self._prediction: Prediction | None = None

    # the two phases

    def prepare(self, time: float, reference: Reference) -> None:
        """Predict the motion over the horizon that begins at `time`, and linearise it."""
        wanted = self.wanted(time, reference)
        observer, limited = self.observer, tuple(soft.output for soft in self.soft)
        found = linearised_prediction(
            observer.model, observer.belief, self.with_acting(self._plan), self._basis, wanted, self.target,
            limited,
        )  # fmt: skip
        if found.solved:
            self._prediction = found.of_plan(self._plan.size)
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
        error = prediction.error + np.tensordot(coordinates, prediction.by_state, 1)
        soft = self._soft_rows(prediction, coordinates)
        problem = self.tracking.program(error, prediction.by_plan, self._plan, self._control, soft)
        found = solved_program(self.solver, problem)
        if not found.solved:
            return self.fallback("the quadratic program was not solved")
        violation = max(float(np.max(each, initial=0.0)) for each in soft_violations(problem, found.x))
        return self.planned(applied_changes(self._plan, found.x), prediction.path, violation)

    def advance(self, control: Float[np.ndarray, " c"]) -> None:
        """Take over the control that acts from now on: shift the plan and predict the observer's state."""
        self._prediction = None
        super().advance(control)

    def _soft_rows(self, prediction: Prediction, coordinates: Any) -> SoftRows | None:
        if not self.soft:
            return None
        value = prediction.limited + np.tensordot(coordinates, prediction.limited_by_state, 1)
        slopes = prediction.limited_by_plan.reshape(len(prediction.limited_by_plan), -1)
        return SoftRows(value.ravel(), slopes, self._low, self._high)


def _at_samples(ends: Sequence[tuple[Any, Output]], horizon: int) -> Float[np.ndarray, " m"]:
    """Return ends of soft limits at every sample of the horizon, one sample after the other."""
    parts = [np.broadcast_to(np.asarray(end, dtype=float), (output.size,)) for end, output in ends]
    return np.tile(np.concatenate([np.zeros(0), *parts]), horizon)
