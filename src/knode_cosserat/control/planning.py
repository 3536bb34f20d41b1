"""Base of controllers that plan controls over a horizon, from an observer's estimate of the state."""

from __future__ import annotations

import copy
from typing import Any, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat.control.checks import check_memory
from knode_cosserat.control.commands import Command, Controller, ControlLimits, Status
from knode_cosserat.control.lag import lag_weights, mean_part, remaining_part
from knode_cosserat.control.plans import Knots
from knode_cosserat.control.program import Tracking, Weights
from knode_cosserat.control.references import Reference
from knode_cosserat.estimation.observer import KalmanObserver, ObserverError
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.rods.system import System

#: periods in which an old plan goes on, and then the last control is held, before the robot goes safe
SHIFTS, HOLDS = 5, 5


class PlanController(Controller):
    """Controller with a plan: controls at knots of the horizon, shifted by one period after each period.

    A period without a new plan continues the old one, then holds the last control, then goes safe.
    """

    def __init__(
        self, observer: KalmanObserver, target: Output, limits: ControlLimits, horizon: int, knots: int,
        weights: Weights,
    ):  # fmt: skip
        self.observer, self.target, self.dt = observer, target, observer.dt
        self.limits = limits.of(observer.robot)
        check_memory(observer.robot, horizon, knots * observer.robot.control_size + observer.columns)
        self.knots = Knots.spaced(horizon, knots)
        self.tracking = Tracking(self.knots, self.limits, weights, target.noise, self.dt)
        self._basis = self.knots.basis
        if self.limits.lag:
            self._basis = lag_weights(self._basis, self.limits.lag, self.dt)
        self.reset(np.asarray(self.limits.safe))

    @property
    def robot(self) -> System:
        """The model."""
        return self.observer.robot

    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Forget the plan; the control acts now. The observer keeps its state."""
        self._plan = np.tile(np.asarray(control, dtype=float), (self.knots.count, 1))
        self._control = np.array(control, dtype=float)
        self._acting = self._control
        self._reason = "no prediction is prepared"
        self._failures = 0

    def copied(self) -> Self:
        """Return a copy, with a copy of the observer."""
        found = super().copied()
        found.observer = copy.copy(self.observer)
        return found

    def take_acting(self, measured: Float[np.ndarray, " c"], age: float) -> None:
        """Take over measured controls (c,) of an age (s); since then they followed the last command."""
        if self.limits.lag and np.all(np.isfinite(measured)):
            remaining = remaining_part(self.limits.lag, age)
            self._acting = self._control + (np.asarray(measured) - self._control) * remaining

    def advance(self, control: Float[np.ndarray, " c"]) -> None:
        """Take over the control that acts from now on: shift the plan and predict the observer's state."""
        self._control = np.asarray(control, dtype=float)
        away, lag = self._acting - self._control, self.limits.lag
        self._acting = self._control + away * remaining_part(lag, self.dt)
        self._plan = self.knots.shifted(self._plan)
        self._reason = "no prediction is prepared"
        try:
            self.observer.predict(self._control + away * mean_part(lag, self.dt))
        except ObserverError as error:
            self._reason = str(error)
            self.observer.wait()

    def with_acting(self, plan: Float[np.ndarray, "... knots c"]) -> Float[np.ndarray, "... more c"]:
        """Return a plan with the acting controls as one more knot, if motors lag.

        `_basis` times the result are the mean acting controls of the horizon's periods.
        """
        if not self.limits.lag:
            return plan
        acting = np.broadcast_to(self._acting, (*plan.shape[:-2], 1, plan.shape[-1]))
        return np.concatenate([plan, acting], axis=-2)

    def wanted(self, time: float, reference: Reference) -> Float[np.ndarray, "T p"]:
        """Return the reference at the ends of the periods of the horizon that begins at `time` (s).

        Raises:
            ValueError: a reference of another size than the target.
        """
        found = reference.expected(time, self.dt * (1.0 + np.arange(self.knots.horizon)))
        if found.shape[1] != self.target.size:
            raise ValueError(
                f"the reference has {found.shape[1]} numbers; the target has {self.target.size}: "
                f"{', '.join(self.target.labels)}"
            )
        return found

    def planned(
        self, plan: Float[np.ndarray, "knots c"], path: Any = None, violation: float = 0.0
    ) -> Command:
        """Take over a new plan, and return the command of its first control, within the limits."""
        # rounding errors of a solver must not exceed hard limits
        control = self.limits.applied(plan[0], self._control, self.dt)
        self._plan, self._failures = plan, 0
        return Command(control, Status.OPTIMAL, "", path, violation)

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
