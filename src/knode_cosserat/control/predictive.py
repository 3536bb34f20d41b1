"""Model-predictive control by a real-time iteration (Diehl, Bock & Schlöder 2005).

In each period one quadratic program is solved. Before the measurement arrives, the model is simulated over
the horizon under the shifted plan, and linearised by the plan and by the directions in which the observer's
state is uncertain (`prepare`). The measurement then corrects the state and the program (`command`), which
takes less than a millisecond.
"""

from __future__ import annotations

import copy
import dataclasses
import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.control import qp
from knode_cosserat.control.commands import Command, ControlLimits, register_controller
from knode_cosserat.control.planning import Knots, PlanController, PredictedOutputs, Weights
from knode_cosserat.control.realtime import SHARE, ChosenSize, Size, choose_size, seconds_in_period
from knode_cosserat.control.references import Reference
from knode_cosserat.estimation.observer import KalmanObserver
from knode_cosserat.estimation.outputs import Output

log = logging.getLogger(__name__)


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


@register_controller("predictive", "real-time iteration with hard limits")
class PredictiveController(PlanController):
    """Model-predictive controller of any robot whose model is a System.

    robot = kc.load_robot("delrin-tendon-robot")
    observer = kc.estimation.KalmanObserver(robot, 0.05, TipPosition())
    controller = kc.control.PredictiveController(observer, TipPosition(), ControlLimits(0.0, 10.0, 40.0))
    """

    def __init__(
        self,
        observer: KalmanObserver,
        target: Output,
        limits: ControlLimits,
        *,
        horizon: int = 20,
        knots: int = 8,
        stride: int = 1,
        realtime: bool | float = 0.0,
        weights: Weights = Weights(),
        soft: Sequence[SoftLimit] = (),
    ):
        """Set up the controller around an observer of the model; `realtime` compiles and measures, too.

        Args:
            observer: estimates the state of the model, which is also the model of the predictions.
            target: the tracked output; references are its values.
            limits: hard limits of the controls and their rates.
            horizon: number of predicted steps.
            knots: number of controls in the plan; between them it is linear.
            stride: number of periods in a predicted step.
            realtime: part of a period that the computations may take, or True for 0.6. `horizon`, `knots`
                and `stride` are then chosen by the time that they take on this computer. `settings` has
                them: give these to use them again. 0: nothing is chosen.
            weights: of the cost.
            soft: limits of outputs.

        Raises:
            ValueError: limits or sizes that are not allowed.
            RealtimeError: no prediction is fast enough.
            ImportError: DAQP is not installed.
        """
        qp.require_daqp()
        self.soft = tuple(soft)
        #: the choice by the time of the computations; None if the sizes were given
        self.choice: ChosenSize | None = None
        if realtime:
            if (horizon, knots, stride) != (20, 8, 1):
                raise ValueError(
                    "realtime chooses horizon, knots and stride; give either realtime or these numbers"
                )

            def seconds(size: Size) -> float:
                own: dict[str, Any] = size._asdict() | {"weights": weights, "soft": soft}
                return seconds_in_period(type(self)(copy.copy(observer), target, limits, **own))

            share = SHARE if realtime is True else float(realtime)
            self.choice = choose_size(seconds, observer.dt, share)
            horizon, knots, stride = self.choice.size
            log.info("%s", self.choice)
        super().__init__(observer, target, limits, Knots.spaced(horizon, knots, stride), weights)
        ends = np.concatenate(
            [
                np.zeros((2, 0)),
                *(
                    [np.full(limit.output.size, end) for end in (limit.low, limit.high)]
                    for limit in self.soft
                ),
            ],
            axis=1,
        )
        # at every sample of the horizon, one sample after the other
        self._low, self._high = np.tile(ends, horizon)

    @property
    def settings(self) -> dict[str, int]:
        """Size of the prediction: arguments that make such a controller again."""
        return {"horizon": self.knots.steps, "knots": self.knots.count, "stride": self.knots.stride}

    def __repr__(self) -> str:
        said = Size(**self.settings).described(self.dt) if self.choice is None else str(self.choice)
        return f"{type(self).__name__}: {said}"

    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Forget the plan; the control acts now. The observer keeps its state."""
        super().reset(control)
        self._prediction: PredictedOutputs | None = None

    # the two phases

    def prepare(self, time: float, reference: Reference) -> None:
        """Predict the motion over the horizon that begins at `time`, and linearise it."""
        limited = tuple(soft.output for soft in self.soft)
        self._prediction = self.predicted(self._plan, self.wanted(time, reference), limited)
        if self._prediction is None:
            self._reason = "the prediction was not solved"
            self._hold()

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the control from the prepared prediction, corrected by the measurement."""
        coordinates = self.observer.update(measured)
        prediction = self._prediction
        if prediction is None:
            return self.fallback(self._reason)
        error = prediction.error + np.tensordot(coordinates, prediction.by_state, 1)
        problem = self.tracking.program(error, prediction.by_plan, self._plan, self._control)
        if self.soft:
            value = prediction.limited + np.tensordot(coordinates, prediction.limited_by_state, 1)
            slopes = prediction.limited_by_plan.reshape(len(prediction.limited_by_plan), -1)
            problem = problem.with_soft_rows(slopes.T, self._low - value.ravel(), self._high - value.ravel())
        x = qp.solve(problem)
        if x is None:
            return self.fallback("the quadratic program was not solved")
        violation = max(float(np.max(part, initial=0.0)) for part in qp.soft_violations(problem, x))
        return self.planned(self._plan + x.reshape(self._plan.shape), prediction.path, violation)

    def advance(self, control: Float[np.ndarray, " c"]) -> None:
        """Take over the control that acts from now on: shift the plan and predict the observer's state."""
        self._prediction = None
        super().advance(control)
