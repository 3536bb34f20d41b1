"""Controllers that plan: knots of a horizon, predictions of a model, and their quadratic program."""

from __future__ import annotations

import copy
import dataclasses
import functools
import os
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.control.commands import (
    Command,
    Controller,
    ControlLimits,
    Status,
    apply_lag,
    mean_part,
    remaining_part,
)
from knode_cosserat.control.qp import QuadraticProgram
from knode_cosserat.control.references import Reference
from knode_cosserat.estimation.observer import KalmanObserver, ObserverError
from knode_cosserat.estimation.online import Structure, errors_along, split_record
from knode_cosserat.estimation.outputs import Output, TipPosition
from knode_cosserat.estimation.parameters import Adapted
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.places import without_camera

#: periods in which an old plan goes on, and then the last control is held, before the robot goes safe
SHIFTS, HOLDS = 5, 5
#: part of the memory that predictions may take
SHARE = 0.5


# plans


@dataclasses.dataclass(frozen=True)
class Knots:
    """Knots of a plan: the samples at which controls are chosen; in between they change linearly.

    A sample is a period of control. The prediction may take longer steps, of several periods.

    Attributes:
        samples: indices of the knots, from 0 to the last step's first sample.
        steps: number of predicted steps.
        stride: number of samples in a step.
    """

    samples: tuple[int, ...]
    steps: int
    stride: int = 1

    @classmethod
    def spaced(cls, steps: int, count: int, stride: int = 1) -> Knots:
        """Return knots that are dense at the beginning and sparse at the end, at beginnings of steps.

        Raises:
            ValueError: more knots than steps, fewer than two, or steps shorter than a sample.
        """
        if not 2 <= count <= steps:
            raise ValueError(f"knots is {count}; allowed are 2 to the horizon, {steps}")
        if stride < 1:
            raise ValueError(f"stride is {stride}; allowed is at least 1")
        power = 1.0 if count == steps else 1.6
        wanted = np.round((steps - 1) * (np.arange(count) / (count - 1)) ** power).astype(int)
        for k in range(1, count):  # no two at one sample
            wanted[k] = max(wanted[k], wanted[k - 1] + 1)
        samples = stride * np.minimum(wanted, steps - count + np.arange(count))
        return cls(tuple(samples.tolist()), steps, stride)

    @property
    def count(self) -> int:
        """Number of knots."""
        return len(self.samples)

    @property
    def horizon(self) -> int:
        """Number of samples."""
        return self.steps * self.stride

    @property
    def basis(self) -> Float[np.ndarray, "samples knots"]:
        """Weights of the knots' values in every sample's control."""
        rows = np.arange(self.horizon)
        return np.stack([np.interp(rows, self.samples, one) for one in np.eye(self.count)], axis=1)

    def means(self, of_samples: Float[np.ndarray, "samples ..."]) -> Float[np.ndarray, "T ..."]:
        """Return the means of samples over the steps: a step holds its control."""
        return of_samples.reshape(self.steps, self.stride, *of_samples.shape[1:]).mean(axis=1)

    @property
    def changes(self) -> Float[np.ndarray, "knots knots"]:
        """Weights of the knots' values in the change of the control per sample.

        Row 0 is the first control itself: its change is from the one before the plan. Row k is the change in
        every sample from knot k - 1 to knot k.
        """
        spans = np.diff(self.samples)
        rows = np.diff(np.eye(self.count), axis=0) / spans[:, None]
        return np.concatenate([np.eye(self.count)[:1], rows])

    def shifted(self, plan: Float[np.ndarray, "knots c"]) -> Float[np.ndarray, "knots c"]:
        """Return the plan one sample later, with its last control held."""
        later: Int[np.ndarray, " knots"] = np.minimum(np.array(self.samples) + 1, self.horizon - 1)
        return self.controls(plan)[later]

    def controls(self, plan: Any) -> Float[np.ndarray, "samples c"]:
        """Return the controls of all samples."""
        return self.basis @ np.asarray(plan)


def lag_weights(basis: Float[np.ndarray, "T knots"], lag: float, dt: float) -> Float[np.ndarray, "T more"]:
    """Return the weights of a plan's knots, and of the controls before it, in the mean controls of periods.

    Args:
        basis: weights of the knots in the commands of the horizon.
        lag: time constant of the motors (s).
        dt: period (s).
    """
    before = np.zeros(basis.shape[1] + 1)
    before[-1] = 1.0
    commands = np.concatenate([basis, np.zeros((len(basis), 1))], axis=1)
    starts = np.concatenate([before[None], apply_lag(commands, dt, lag, before)[:-1]])
    return commands + (starts - commands) * mean_part(lag, dt)


# cost


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


class Tracking:
    """Cost and limits of a plan, without the predicted errors.

    The cost is the sum of squared errors, each divided by its acceptable size (`noise`), of the changes of
    controls in one period, and of their distances from the preferred ones, both relative to their range.
    """

    def __init__(
        self, knots: Knots, limits: ControlLimits, weights: Weights, noise: Float[np.ndarray, " e"], dt: float
    ):
        #: an error counts in each sample of its step
        self.limits, self.weights, self.noise = limits, weights, noise / np.sqrt(knots.stride)
        self._spread = np.asarray(limits.high) - np.asarray(limits.low)
        self._preferred = np.asarray(limits.safe if weights.preferred is None else weights.preferred)
        self._changes, count = knots.changes, knots.count
        self._by_plan = np.kron(self._changes, np.eye(len(self._spread)))
        # a wanted error of one `noise` counts like a change over the whole range
        scaled = self._by_plan / np.tile(self._spread, count)[:, None]
        self._by_change = weights.change * scaled.T
        self._effort = weights.effort * np.tile(1.0 / self._spread, count)
        self._H = self._by_change @ scaled + np.diag(self._effort * np.tile(1.0 / self._spread, count))
        self._most = np.tile(np.asarray(limits.rate) * dt, count)
        self._low, self._high = (np.tile(np.asarray(end), count) for end in (limits.low, limits.high))

    def _moves(self, plan: np.ndarray, control: np.ndarray) -> tuple[Any, Any]:
        """Return the changes from knot to knot, and the distances from the preferred controls."""
        changes = self._changes @ plan
        changes[0] -= control
        return changes, plan - self._preferred

    def cost(self, error: Float[np.ndarray, "T e"], plan: np.ndarray, control: np.ndarray) -> float:
        """Return the cost of a plan with these errors, after a control; free errors are NaN."""
        weights, (changes, away) = self.weights, self._moves(plan, control)
        cost = np.nansum((error / self.noise) ** 2) + weights.change * np.sum((changes / self._spread) ** 2)
        return float(cost + weights.effort * np.sum((away / self._spread) ** 2))

    def program(
        self,
        error: Float[np.ndarray, "T e"],
        by_plan: Float[np.ndarray, "n T e"],
        plan: np.ndarray,
        control: np.ndarray,
    ) -> QuadraticProgram:
        """Return the program whose unknowns are the changes (n,) of a plan.

        Args:
            error: predicted errors of the plan; NaN: free.
            by_plan: their derivatives by the plan's numbers.
            plan: (knots, c).
            control: the control that acts before the plan (c,).
        """
        scale = np.where(np.isfinite(error), 1.0 / self.noise, 0.0)
        e = np.where(scale > 0.0, error, 0.0) * scale
        S = (np.where(scale > 0.0, by_plan, 0.0) * scale).reshape(len(by_plan), -1)
        changes, away = self._moves(plan, control)
        g = S @ e.ravel() + self._by_change @ (changes / self._spread).ravel()
        g = g + self._effort * (away / self._spread).ravel()
        below, above = -self._most - changes.ravel(), self._most - changes.ravel()
        low, high = self._low - plan.ravel(), self._high - plan.ravel()
        return QuadraticProgram(S @ S.T + self._H, g, low, high, self._by_plan, below, above)


# predictions


class PredictedOutputs(NamedTuple):
    """Outputs of a predicted motion and their derivatives."""

    #: error of the tracked output from the reference
    error: Float[Any, "T e"]
    by_plan: Float[Any, "n T e"]
    by_state: Float[Any, "m T e"]
    #: constrained outputs
    limited: Float[Any, "T q"]
    limited_by_plan: Float[Any, "n T q"]
    limited_by_state: Float[Any, "m T q"]
    #: positions of the tip (m)
    path: Float[Any, "T 3"]


@functools.partial(jax.jit, static_argnames=("structure", "target", "limited", "columns"))
def _outputs(
    structure: Structure,
    target: Output,
    limited: tuple[Output, ...],
    columns: tuple[int, ...],
    numbers: Any,
    records: Any,
    d_records: Any,
    reference: Any,
) -> Any:
    """Return errors of the target and the limited outputs, with their tangents, and the tip's path.

    All are in the robot's frame, whatever measures it.
    """
    system, (steps, *_, count) = without_camera(structure.system(numbers)), d_records.shape
    error, slopes = errors_along(system, target, records, d_records, reference, columns=columns)
    values, moved = [jnp.zeros((steps, 0))], [jnp.zeros((count, steps, 0))]
    for output in limited:
        zero = jnp.zeros((steps, output.size))
        value, slope = errors_along(system, output, records, d_records, zero, columns=columns)
        values.append(value)
        moved.append(slope)
    path = Drawing.of(system).positions(split_record(system, records[:, -1])[0])
    return error, slopes, jnp.concatenate(values, axis=-1), jnp.concatenate(moved, axis=-1), path


def _check_memory(robot: System, horizon: int, columns: int) -> None:
    """Raise `ValueError`, with the longest horizon, if its derivatives do not fit in memory."""
    try:
        memory = float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return
    # rows and their copies in the robot's grid
    size = 3 * 8 * robot.nodes * (2 * robot.y_layout.size + robot.z_layout.size) * columns
    most = int(SHARE * memory / size)
    if horizon > most:
        raise ValueError(
            f"horizon is {horizon}; its derivatives need {1e-9 * size * horizon:.3g} GB; allowed are at most "
            f"{most} periods on this machine"
        )


# the base of controllers that plan


class PlanController(Controller):
    """Controller with a plan: controls at knots of the horizon, shifted by one period after each period.

    The state is an observer's estimate. A period without a new plan continues the old one, then holds the
    last control, then goes safe.
    """

    has_observer: ClassVar[bool] = True

    def __init__(
        self, observer: KalmanObserver, target: Output, limits: ControlLimits, knots: Knots, weights: Weights
    ):
        self.observer, self.target, self.dt = observer, target, observer.dt
        self.limits, self.knots = limits.of(observer.robot), knots
        count = observer.robot.control_layout.size
        _check_memory(observer.robot, knots.steps, knots.count * count + observer.columns)
        self.tracking = Tracking(knots, self.limits, weights, target.noise, self.dt)
        basis = knots.basis
        if self.limits.lag:
            basis = lag_weights(basis, self.limits.lag, self.dt)
        #: weights of the knots in the controls of the predicted steps
        self._basis = knots.means(basis)
        #: derivatives of the horizon's controls by the plan's numbers, one after the other
        self._by_plan = np.einsum("tk,ij->kjti", self._basis, np.eye(count)).reshape(-1, knots.steps, count)
        self.reset(np.asarray(self.limits.safe))

    @classmethod
    def for_tip(
        cls,
        robot: System,
        dt: float,
        limits: ControlLimits,
        *,
        adapt: Sequence[Adapted | str] = (),
        measured: Output | None = None,
        **options: Any,
    ) -> Self:
        """Return a controller of the tip's position, with an observer of the model."""
        target = TipPosition()
        observer = KalmanObserver(robot, dt, target if measured is None else measured, adapt=adapt)
        return cls(observer, target, limits, **options)

    @property
    def robot(self) -> System:
        """The model."""
        return self.observer.robot

    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Forget the plan; the control acts now. The observer keeps its state."""
        self._control = np.array(control, dtype=float)
        self._hold()
        self._acting = self._control
        self._reason = "no prediction is prepared"
        self._failures = 0

    def _hold(self) -> None:
        """Plan to hold the control: a constant plan is the easiest to predict."""
        self._plan = np.tile(self._control, (self.knots.count, 1))

    def copied(self) -> Self:
        """Return a copy, with a copy of the observer."""
        other = super().copied()
        other.observer = copy.copy(self.observer)
        return other

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

    def predicted(
        self,
        plan: Float[np.ndarray, "knots c"],
        wanted: Float[np.ndarray, "T p"],
        limited: tuple[Output, ...] = (),
    ) -> PredictedOutputs | None:
        """Return the prediction of a plan from the estimated state; None if it is not solved.

        It is linearised by the plan's numbers and by the directions in which the state is uncertain.
        """
        model, belief = self.observer.model, self.observer.belief
        knots, by_plan = self.with_acting(plan), self._by_plan
        spread = belief.spread.wider(len(by_plan), 0)
        none = np.zeros((len(belief.spread.records), *by_plan.shape[1:]))
        columns = model.columns(self.target, *limited)
        moved, motion = model.rollout(
            belief._replace(spread=spread),
            self._basis @ knots,
            np.concatenate([by_plan, none]),
            columns,
            self.knots.stride,
        )
        if motion is None:
            return None
        outputs = _outputs(
            moved.structure,
            self.target,
            limited,
            columns,
            moved.numbers,
            motion.records,
            motion.d_records,
            wanted,
        )
        error, slopes, value, slope, path = map(np.asarray, outputs)
        # without the derivatives by the acting controls
        n, first = plan.size, len(by_plan)
        return PredictedOutputs(error, slopes[:n], slopes[first:], value, slope[:n], slope[first:], path)

    def wanted(self, time: float, reference: Reference) -> Float[np.ndarray, "T p"]:
        """Return the reference at the ends of the predicted steps, the first of which begins at `time` (s).

        Raises:
            ValueError: a reference of another size than the target.
        """
        steps = 1.0 + np.arange(self.knots.steps)
        rows = reference.expected(time, self.knots.stride * self.dt * steps)
        if rows.shape[1] != self.target.size:
            raise ValueError(
                f"the reference has {rows.shape[1]} numbers; the target has {self.target.size}: "
                f"{', '.join(self.target.labels)}"
            )
        return rows

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
