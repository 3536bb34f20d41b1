"""Quadratic program of tracking: predicted errors, changes and effort of a plan, and its limits."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.control.commands import ControlLimits
from knode_cosserat.control.plans import Knots
from knode_cosserat.control.qp import QuadraticProgram


@dataclasses.dataclass(frozen=True)
class Weights:
    """Weights of the cost, beside the tracked errors in units of their `noise`.

    Attributes:
        change: of the squared change of controls in one period, relative to the range of the controls.
        effort: of the squared distance from the preferred controls, relative to the range.
        preferred: preferred controls; None: the safe ones.
    """

    change: float = 10.0
    effort: float = 1e-4
    preferred: Any = None


class SoftRows(NamedTuple):
    """Linearised outputs (m,) with soft limits, and their derivatives by the plan (n, m)."""

    value: Float[np.ndarray, " m"]
    by_plan: Float[np.ndarray, "n m"]
    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]


class Tracking(NamedTuple):
    """Cost and limits of a plan, without the predicted errors.

    The cost is the sum of squared errors, each divided by its acceptable size (`noise`), of the changes of
    controls in one period, and of their distances from the preferred ones, both relative to their range.
    """

    knots: Knots
    limits: ControlLimits
    weights: Weights
    noise: Float[np.ndarray, " e"]
    dt: float

    @property
    def _spread(self) -> Float[np.ndarray, " c"]:
        return np.asarray(self.limits.high) - np.asarray(self.limits.low)

    def _changes(self, plan: np.ndarray, control: np.ndarray) -> Float[np.ndarray, "knots c"]:
        """Return the change of every control per period, from knot to knot."""
        moved = self.knots.changes @ plan
        moved[0] -= control
        return moved

    def _away(self, plan: np.ndarray) -> Float[np.ndarray, "knots c"]:
        given = self.weights.preferred
        return plan - np.asarray(self.limits.safe if given is None else given)

    def cost(self, error: Float[np.ndarray, "T e"], plan: np.ndarray, control: np.ndarray) -> float:
        """Return the cost of a plan with these errors, after a control; free errors are NaN."""
        w, spread = self.weights, self._spread
        changed, away = self._changes(plan, control) / spread, self._away(plan) / spread
        tracked = np.nansum((error / self.noise) ** 2)
        return float(tracked + w.change * np.sum(changed**2) + w.effort * np.sum(away**2))

    def program(
        self, error: Float[np.ndarray, "T e"], by_plan: Float[np.ndarray, "n T e"], plan: np.ndarray,
        control: np.ndarray, soft: SoftRows | None = None,
    ) -> QuadraticProgram:  # fmt: skip
        """Return the program whose unknowns are the changes (n,) of a plan.

        Args:
            error: predicted errors of the plan; NaN: free.
            by_plan: their derivatives by the plan's numbers.
            plan: (knots, c).
            control: the control that acts before the plan (c,).
            soft: limited outputs.
        """
        limits, w, c = self.limits, self.weights, len(control)
        scale = np.where(np.isfinite(error), 1.0 / self.noise, 0.0)
        e = np.where(scale > 0.0, error, 0.0) * scale
        S = (np.where(scale > 0.0, by_plan, 0.0) * scale).reshape(len(by_plan), -1)
        spread = self._spread
        A = np.kron(self.knots.changes, np.eye(c))
        # a wanted error of one `noise` counts like a change over the whole range
        changes = A / np.tile(spread, self.knots.count)[:, None]
        moved, away = self._changes(plan, control), self._away(plan)
        effort = np.tile(1.0 / spread, self.knots.count)
        H = S @ S.T + w.change * changes.T @ changes + w.effort * np.diag(effort**2)
        g = S @ e.ravel() + w.change * changes.T @ (moved / spread).ravel()
        g = g + w.effort * effort * (away / spread).ravel()
        most = np.tile(np.asarray(limits.rate) * self.dt, self.knots.count)
        below, above = -most - moved.ravel(), most - moved.ravel()
        low, high = (
            np.tile(np.asarray(end), self.knots.count) - plan.ravel() for end in (limits.low, limits.high)
        )
        count = 0
        if soft is not None:
            count = len(soft.value)
            A = np.concatenate([A, soft.by_plan.T])
            below = np.concatenate([below, soft.low - soft.value])
            above = np.concatenate([above, soft.high - soft.value])
        return QuadraticProgram(H, g, low, high, A, below, above, count)


def applied_changes(plan: np.ndarray, found: Any) -> Float[np.ndarray, "knots c"]:
    """Return the plan after the changes of a program's solution."""
    return plan + np.asarray(found).reshape(plan.shape)
