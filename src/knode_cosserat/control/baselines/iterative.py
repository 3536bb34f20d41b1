"""Iterative linear-quadratic regulator: Gauss-Newton steps of the whole plan (Li & Todorov 2004)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from knode_cosserat.control.commands import Command, ControlLimits
from knode_cosserat.control.planning import PlanController
from knode_cosserat.control.prediction import linearised_prediction
from knode_cosserat.control.program import Weights, applied_changes
from knode_cosserat.control.references import Reference
from knode_cosserat.estimation.observer import KalmanObserver
from knode_cosserat.estimation.outputs import Output

#: parts of a step that are tried, the whole one first
TRIED = (1.0, 0.5, 0.25)


class ILQR(PlanController):
    """Iterative linear-quadratic regulator over a horizon, after each measurement.

    The linear-quadratic problem of an iteration is solved for all controls of the plan at once, without
    limits; this is the step of the Riccati recursion. The plan is then clipped to its limits. A step is
    taken if it lowers the cost.
    """

    def __init__(
        self, observer: KalmanObserver, target: Output, limits: ControlLimits, *, horizon: int = 20,
        knots: int = 8, weights: Weights = Weights(), iterations: int = 2,
    ):  # fmt: skip
        """Set up the controller; arguments as those of `PredictiveController`.

        Args:
            observer: estimates the state of the model.
            target: the tracked output.
            limits: limits of the controls.
            horizon: number of predicted periods.
            knots: number of controls in the plan.
            weights: of the cost.
            iterations: steps in each period.
        """
        super().__init__(observer, target, limits, horizon, knots, weights)
        self.iterations = iterations

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the first control of the plan after some iterations."""
        self.observer.update(measured)
        wanted = self.wanted(time, reference)
        best = self._linearised(self._plan, wanted)
        if best is None:
            self._plan = np.tile(self._control, (self.knots.count, 1))
            return self.fallback("the prediction was not solved")
        plan, path = self._plan, best[2]
        cost = self.tracking.cost(best[0], plan, self._control)
        for _ in range(self.iterations):
            problem = self.tracking.program(best[0], best[1], plan, self._control)
            step = -np.linalg.solve(problem.H, problem.g)
            for part in TRIED:
                there = np.clip(applied_changes(plan, part * step), self.limits.low, self.limits.high)
                found = self._linearised(there, wanted)
                lower = np.inf if found is None else self.tracking.cost(found[0], there, self._control)
                if found is not None and lower < cost:
                    plan, path, best, cost = there, found[2], found, lower
                    break
            else:
                break
        return self.planned(plan, path)

    def _linearised(
        self, plan: Float[np.ndarray, "knots c"], wanted: Float[np.ndarray, "T p"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return errors, derivatives by the plan, and the path of the tip; None if it was not solved."""
        observer = self.observer
        found = linearised_prediction(
            observer.model, observer.belief, self.with_acting(plan), self._basis, wanted, self.target, ()
        ).of_plan(plan.size)
        if not bool(found.solved):
            return None
        return np.asarray(found.error), np.asarray(found.by_plan), np.asarray(found.path)
