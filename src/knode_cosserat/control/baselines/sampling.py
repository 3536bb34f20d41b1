"""Model-predictive path integral control: a plan from many sampled ones (Williams et al. 2017)."""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.control.commands import Command, ControlLimits
from knode_cosserat.control.planning import PlanController
from knode_cosserat.control.program import Weights
from knode_cosserat.control.references import Reference
from knode_cosserat.estimation.observer import KalmanObserver
from knode_cosserat.estimation.online import OnlineModel, errors_of
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.rods.system import System


def sampled_errors(
    model: OnlineModel, x: Any, past: Any, plans: Float[Any, "k knots c"], basis: Float[Any, "T knots"],
    reference: Float[Any, "T p"], target: Output,
) -> Any:  # fmt: skip
    """Return the errors (k, T, e) of each plan's motion, and which motions were solved."""
    system, steps = model.moved(x)[0], len(basis)
    controls = np.einsum("tn,knc->ktc", basis, plans)
    pasts = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (len(plans), *np.shape(leaf))), past)
    done, _, rows = model.task(steps).solve_many(system, controls, pasts)
    return _errors(system, target, rows.records, reference), done == steps


@functools.partial(jax.jit, static_argnames="target")
def _errors(system: System, target: Output, records: Any, reference: Any) -> Any:
    return jax.vmap(lambda each: errors_of(system, target, each, reference))(records)


class MPPI(PlanController):
    """Path integral control: the mean of random plans, weighted by the exponential of their costs."""

    def __init__(
        self, observer: KalmanObserver, target: Output, limits: ControlLimits, *, horizon: int = 20,
        knots: int = 8, weights: Weights = Weights(), samples: int = 32, deviation: float = 0.05,
        temperature: float = 0.1, seed: int = 0,
    ):  # fmt: skip
        """Set up the controller.

        Args:
            observer: estimates the state of the model.
            target: the tracked output.
            limits: limits of the controls.
            horizon: number of predicted periods.
            knots: number of controls in the plan.
            weights: of the cost.
            samples: number of random plans in each period; the plan itself is one more.
            deviation: standard deviation of a knot's control, relative to the range.
            temperature: of the weights, relative to the standard deviation of the costs.
            seed: of the random plans.
        """
        super().__init__(observer, target, limits, horizon, knots, weights)
        self.samples, self.deviation, self.temperature = samples, deviation, temperature
        self._random = np.random.default_rng(seed)

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the first control of the weighted mean of random plans."""
        self.observer.update(measured)
        belief, limits = self.observer.belief, self.limits
        spread = self.deviation * (np.asarray(limits.high) - np.asarray(limits.low))
        moves = self._random.normal(size=(self.samples, *self._plan.shape)) * spread
        plans = np.clip(np.concatenate([self._plan[None], self._plan + moves]), limits.low, limits.high)
        wanted = self.wanted(time, reference)
        errors, solved = sampled_errors(
            self.observer.model, belief.x, belief.past, self.with_acting(plans), self._basis, wanted,
            self.target,
        )  # fmt: skip
        solved = np.asarray(solved)
        if not solved.any():
            self._plan = np.tile(self._control, (self.knots.count, 1))
            return self.fallback("no sampled plan was solved")
        each = zip(np.asarray(errors)[solved], plans[solved], strict=True)
        costs = np.array([self.tracking.cost(error, plan, self._control) for error, plan in each])
        scale = max(self.temperature * float(costs.std()), 1e-12)
        share = np.exp(-(costs - costs.min()) / scale)
        return self.planned(np.tensordot(share / share.sum(), plans[solved], 1))
