"""Linear predictive control in lifted coordinates: a Koopman model by extended dynamic mode decomposition.

The state is the last two outputs and the last control, lifted by all their products up to the second degree
(Bruder et al. 2021). The linear model is fitted to motions that the robot's model simulates under random
controls.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.control import qp
from knode_cosserat.control.commands import Command, Controller, ControlLimits, apply_lag, register_controller
from knode_cosserat.control.planning import Knots, Tracking, Weights
from knode_cosserat.control.references import Reference
from knode_cosserat.estimation.outputs import Output, TipPosition
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.places import OwnFrame, without_camera
from knode_cosserat.solvers.refinement import fix_grid
from knode_cosserat.solvers.simulate import simulate

#: training motions: their number and duration (s), and the time for which a random control is approached (s)
MOTIONS, SECONDS, HELD = 8, 12.0, 0.4
#: ridge of the least squares, relative to the mean square of the lifted coordinates
RIDGE = 1e-8
#: part of the unexpected output that counts as a lasting offset, in each period
OFFSET = 0.2


class _LiftedModel:
    """Linear model ψ⁺ = A ψ + B u of lifted coordinates, whose first ones are the scaled output."""

    def __init__(self, outputs: Float[np.ndarray, "B T p"], controls: Float[np.ndarray, "B T c"]):
        """Fit to motions: the control of row k is held from row k to row k + 1."""
        both = [part.reshape(-1, part.shape[-1]) for part in (outputs, controls)]
        (self.middle, self.size), (self._middle_u, self._size_u) = (
            (part.mean(axis=0), np.maximum(part.std(axis=0), 1e-9)) for part in both
        )
        lifted = np.array(list(map(self._motion, outputs, controls)))
        u = (controls[:, 1:-1] - self._middle_u) / self._size_u
        count = lifted.shape[-1]
        now = np.concatenate([lifted[:, :-1], u], axis=-1).reshape(-1, count + u.shape[-1])
        later = lifted[:, 1:].reshape(-1, count)
        ridge = RIDGE * len(now) * np.eye(now.shape[1])
        AB = np.linalg.solve(now.T @ now + ridge, now.T @ later).T
        self.A, self.B = AB[:, :count], AB[:, count:] / self._size_u
        self._offset = -self.B @ self._middle_u

    def _motion(self, outputs: Any, controls: Any) -> Float[np.ndarray, "T-1 lifted"]:
        rows = range(1, len(outputs))
        return np.array([self.lifted(outputs[k], outputs[k - 1], controls[k - 1]) for k in rows])

    def lifted(self, output: Any, before: Any, control: Any) -> Float[np.ndarray, " lifted"]:
        """Return the coordinates of the last two outputs and the control between them."""
        y, last = (output - self.middle) / self.size, (before - self.middle) / self.size
        x = np.concatenate([y, last, (control - self._middle_u) / self._size_u])
        products = [x[i] * x[j] for i, j in itertools.combinations_with_replacement(range(len(x)), 2)]
        return np.concatenate([x, products, [1.0]])

    def predicted(
        self, lifted: Float[np.ndarray, " lifted"], controls: Float[np.ndarray, "T c"]
    ) -> Float[np.ndarray, "T p"]:
        """Return the outputs after each control."""
        outputs = []
        for u in controls:
            lifted = self.A @ lifted + self.B @ u + self._offset
            outputs.append(lifted[: len(self.middle)])
        return self.middle + self.size * np.array(outputs)

    def slopes(self, basis: Float[np.ndarray, "T knots"]) -> Float[np.ndarray, "n T p"]:
        """Return the derivatives of predicted outputs by the numbers of a plan."""
        steps, c, p = len(basis), self.B.shape[1], len(self.middle)
        responses, power = [], self.B
        for _ in range(steps):
            responses.append(self.size[:, None] * power[:p])
            power = self.A @ power
        slopes = np.zeros((basis.shape[1], c, steps, p))
        for t in range(steps):
            for k in range(t + 1):
                slopes[:, :, t] += np.einsum("n,pc->ncp", basis[k], responses[t - k])
        return slopes.reshape(-1, steps, p)


@register_controller("koopman", "predictive control by a lifted linear model, fitted to simulated motions")
class KoopmanController(Controller):
    """Predictive control of the tip by a lifted linear model and one quadratic program a period."""

    def __init__(
        self,
        robot: System,
        dt: float,
        limits: ControlLimits,
        *,
        horizon: int = 20,
        knots: int = 8,
        weights: Weights = Weights(),
        seed: int = 0,
    ):
        """Simulate random motions of the robot and fit the lifted model.

        Args:
            robot: the model.
            dt: period (s).
            limits: hard limits of the controls and their rates.
            horizon: number of predicted periods.
            knots: number of controls in the plan.
            weights: of the cost.
            seed: of the random motions.

        Raises:
            SimulationError: a motion cannot be simulated.
            ImportError: DAQP is not installed.
        """
        qp.require_daqp()
        self.dt, self.limits, self.target = float(dt), limits.of(robot), TipPosition()
        self._frame, robot = OwnFrame.of(robot), without_camera(robot)
        self.knots = Knots.spaced(horizon, knots)
        self._tracking = Tracking(self.knots, self.limits, weights, self.target.noise, self.dt)
        self.model = _LiftedModel(*_training_motions(robot, self.dt, self.target, self.limits, seed))
        self._slopes = self.model.slopes(self.knots.basis)
        self.reset(np.asarray(self.limits.safe))

    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Start from a control that acts now."""
        self._control = np.array(control, dtype=float)
        self._plan = np.tile(self._control, (self.knots.count, 1))
        self._last: Any = None
        self._now: Any = None
        self._expected: Any = None
        self._offset = np.zeros(self.target.size)

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the first control of a new plan."""
        measured = self._frame.tip(measured)
        if not np.all(np.isfinite(measured)):
            if self._expected is None:
                return self.fallback("nothing was measured yet")
            measured = self._expected
        elif self._expected is not None:
            self._offset = self._offset + OFFSET * (measured - self._offset - self._expected)
        self._last, self._now = (measured if self._now is None else self._now), measured
        lifted = self.model.lifted(measured, self._last, self._control)
        later = self.dt * (1.0 + np.arange(self.knots.horizon))
        error = self.model.predicted(lifted, self.knots.controls(self._plan)) + self._offset
        error = error - reference.expected(time, later)
        x = qp.solve(self._tracking.program(error, self._slopes, self._plan, self._control))
        if x is None:
            return self.fallback("the quadratic program was not solved")
        self._plan = self._plan + x.reshape(self._plan.shape)
        return Command(self.limits.applied(self._plan[0], self._control, self.dt))

    def advance(self, control: Float[np.ndarray, " c"]) -> None:
        """Take over the control that acts from now on, and expect the next output."""
        self._control = np.asarray(control, dtype=float)
        self._plan = self.knots.shifted(self._plan)
        if self._now is not None:
            lifted = self.model.lifted(self._now, self._last, self._control)
            self._expected = self.model.predicted(lifted, self._control[None])[0]


def _training_motions(
    robot: System, dt: float, target: Output, limits: ControlLimits, seed: int
) -> tuple[Float[np.ndarray, "B T p"], Float[np.ndarray, "B T c"]]:
    """Return outputs and commands of simulated motions under random commands within limits and rates."""
    steps = round(SECONDS / dt)
    rng = np.random.default_rng(seed)
    low, high = np.asarray(limits.low), np.asarray(limits.high)
    controls = np.zeros((MOTIONS, steps, len(low)))
    for motion in controls:
        # small motions too: most references are slow and near the middle
        wide = rng.uniform(0.2, 1.0)
        control = wanted = np.asarray(limits.safe)
        for k in range(steps):
            if k % max(1, round(HELD / dt)) == 0:
                wanted = low + wide * rng.uniform(size=len(low)) * (high - low)
            control = motion[k] = limits.applied(control + 0.3 * (wanted - control), control, dt)
    acting = np.array([apply_lag(motion, dt, limits.lag, limits.safe) for motion in controls])
    motions = simulate(fix_grid(robot), acting, dt)
    y, z = np.asarray(motions.y)[:, :-1], np.asarray(motions.z)[:, :-1]
    outputs = [
        [np.asarray(target.value(robot, *state)) for state in zip(ys, zs, strict=True)]
        for ys, zs in zip(y, z, strict=True)
    ]
    return np.array(outputs), controls
