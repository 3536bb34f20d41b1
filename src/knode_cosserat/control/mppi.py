"""Model-predictive path integral control: a plan from many sampled ones (Williams et al. 2017)."""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.control.commands import Command, ControlLimits, register_controller
from knode_cosserat.control.planning import Knots, PlanController, Weights
from knode_cosserat.control.references import Reference
from knode_cosserat.estimation.observer import KalmanObserver
from knode_cosserat.estimation.online import errors_of
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.places import without_camera


@functools.partial(jax.jit, static_argnames="target")
def _errors(system: System, target: Output, records: Any, reference: Any) -> Any:
    system = without_camera(system)  # references are in the robot's frame
    return jax.vmap(lambda record: errors_of(system, target, record, reference))(records)


@register_controller("mppi", "weighted mean of 32 random plans")
class MPPI(PlanController):
    """Path integral control: the mean of random plans, weighted by the exponential of their costs."""

    def __init__(
        self,
        observer: KalmanObserver,
        target: Output,
        limits: ControlLimits,
        *,
        horizon: int = 20,
        knots: int = 8,
        weights: Weights = Weights(),
        samples: int = 32,
        deviation: float = 0.05,
        temperature: float = 0.1,
        seed: int = 0,
    ):
        """Set up the controller as `PredictiveController`, with more settings.

        `samples` is the number of random plans in each period (the plan itself is one more), `deviation` the
        standard deviation of a knot's control, relative to the range. `temperature` (of weights) is relative
        to the standard deviation of the costs, and `seed` is that of the random plans.
        """
        super().__init__(observer, target, limits, Knots.spaced(horizon, knots), weights)
        self.samples, self.deviation, self.temperature = samples, deviation, temperature
        self._random = np.random.default_rng(seed)

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the first control of the weighted mean of random plans."""
        self.observer.update(measured)
        limits = self.limits
        spread = self.deviation * (np.asarray(limits.high) - np.asarray(limits.low))
        moves = self._random.normal(size=(self.samples, *self._plan.shape)) * spread
        plans = np.clip(np.concatenate([self._plan[None], self._plan + moves]), limits.low, limits.high)
        errors, solved = self._sampled(plans, self.wanted(time, reference))
        if not solved.any():
            self._hold()
            return self.fallback("no sampled plan was solved")
        costs = np.array(
            [
                self.tracking.cost(error, plan, self._control)
                for error, plan in zip(errors[solved], plans[solved], strict=True)
            ]
        )
        scale = max(self.temperature * float(costs.std()), 1e-12)
        share = np.exp(-(costs - costs.min()) / scale)
        return self.planned(np.tensordot(share / share.sum(), plans[solved], 1))

    def _sampled(
        self, plans: Float[np.ndarray, "k knots c"], wanted: Float[np.ndarray, "T p"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors (k, T, e) of each plan's motion, and True for solved motions."""
        model, belief, steps = self.observer.model, self.observer.belief, len(self._basis)
        system = model.moved(belief.x).system
        controls = np.einsum("tn,knc->ktc", self._basis, self.with_acting(plans))
        histories = jax.tree.map(
            lambda leaf: np.broadcast_to(leaf, (len(plans), *np.shape(leaf))), belief.past
        )
        done, _, rows = model.task(steps).solve(system, controls, histories)
        return np.asarray(_errors(system, self.target, rows.records, wanted)), np.asarray(done == steps)
