"""Iterative linear-quadratic regulator: Gauss-Newton steps of the whole plan (Li & Todorov 2004)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from knode_cosserat.control.commands import Command, ControlLimits, register_controller
from knode_cosserat.control.planning import Knots, PlanController, Weights
from knode_cosserat.control.references import Reference
from knode_cosserat.estimation.observer import KalmanObserver
from knode_cosserat.estimation.outputs import Output

#: parts of a step that are tried, the whole one first
TRIED = (1.0, 0.5, 0.25)


@register_controller("ilqr", "Gauss-Newton steps of the whole plan, clipped to the limits")
class ILQR(PlanController):
    """Iterative linear-quadratic regulator over a horizon, after each measurement.

    The linear-quadratic problem of an iteration is solved for all controls of the plan at once, without
    limits; this is the step of the Riccati recursion. The plan is then clipped to its limits. A step is
    taken if it lowers the cost.
    """

    def __init__(
        self,
        observer: KalmanObserver,
        target: Output,
        limits: ControlLimits,
        *,
        horizon: int = 20,
        knots: int = 8,
        weights: Weights = Weights(),
        iterations: int = 2,
    ):
        """Set up the controller as `PredictiveController`; `iterations` are the steps in a period."""
        super().__init__(observer, target, limits, Knots.spaced(horizon, knots), weights)
        self.iterations = iterations

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the first control of the plan after some iterations."""
        self.observer.update(measured)
        wanted, plan = self.wanted(time, reference), self._plan
        best = self.predicted(plan, wanted)
        if best is None:
            self._hold()
            return self.fallback("the prediction was not solved")
        cost = self.tracking.cost(best.error, plan, self._control)
        for _ in range(self.iterations):
            problem = self.tracking.program(best.error, best.by_plan, plan, self._control)
            step = -np.linalg.solve(problem.H, problem.g).reshape(plan.shape)
            for part in TRIED:
                candidate = np.clip(plan + part * step, self.limits.low, self.limits.high)
                prediction = self.predicted(candidate, wanted)
                if prediction is None:
                    continue
                lower = self.tracking.cost(prediction.error, candidate, self._control)
                if lower < cost:
                    plan, best, cost = candidate, prediction, lower
                    break
            else:
                break
        return self.planned(plan, best.path)
