"""Fine-tuning through whole simulations compared with trajectories, and the held-out error.

Only the compared fields of a trajectory must be known. Every solved step is differentiable by the implicit
function theorem (`solvers.sensitivity`), so that any residual can be trained in this way.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from jaxtyping import Float

from knode_cosserat.learning.config import FitError, RolloutTraining
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.training import runs
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.solvers.initial import named_start
from knode_cosserat.solvers.segments import DataError, samples, settings_of
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.trajectory import Trajectory

#: fields compared by default, if the system has them
POSE = ("p", "h")


class _TrajectoryBatch(eqx.Module):
    """Trajectories (B) of one length: controls and target states."""

    control: Float[Any, "B T c"]
    #: row 0 is the initial state of the simulations
    y: Float[Any, "B T+1 nodes y"]
    #: where they start, as in `simulate`
    initial: Literal["equilibrium", "unstressed"] = eqx.field(static=True)


class TrajectoryBatches(eqx.Module):
    """All trajectories, grouped by length and start, with the settings of their simulation."""

    parts: tuple[_TrajectoryBatch, ...]
    #: scale of each compared field's errors: the rms of its motion
    scales: Float[Any, " fields"]
    compared: tuple[str, ...] = eqx.field(static=True)
    settings: Settings = eqx.field(static=True)
    dt: float = eqx.field(static=True)


def trajectory_batches(
    knowledge: System, trajectories: Sequence[Trajectory], options: RolloutTraining, what: str = ""
) -> TrajectoryBatches:
    """Return trajectories prepared for simulation and comparison; `what` precedes their number in messages.

    Raises:
        DataError: a trajectory does not fit the nominal model or the others, is too short, begins in motion,
            or is not finite where it is used.
    """
    compared = _checked_names(knowledge, options.compared)
    try:
        samples(knowledge, [_relevant(knowledge, one, compared) for one in trajectories])
    except DataError as error:
        raise DataError(f"{what}{error}") from None
    alike: dict[tuple[int, str], list[_TrajectoryBatch]] = {}
    for k, trajectory in enumerate(trajectories):
        if float(trajectory.time[0]) != 0.0:
            raise DataError(
                f"{what}trajectory {k} begins at {float(trajectory.time[0]):g} s, in motion; simulations "
                "start at rest, at time 0"
            )
        rows = min(len(trajectory.time), 1 + (options.horizon or len(trajectory.time)))
        y, control = (np.asarray(part, dtype=float)[:rows] for part in (trajectory.y, trajectory.control))
        initial = named_start(trajectory, compared)
        alike.setdefault((rows, initial), []).append(_TrajectoryBatch(control[1:], y, initial))
    parts = [jax.tree.map(lambda *leaves: np.stack(leaves), *several) for several in alike.values()]
    scales = []
    for name in compared:
        values = [knowledge.y_layout.get(part.y, name) for part in parts]
        moves = [np.mean(np.var(value, axis=1)) * len(value) for value in values]
        scale = float(np.sqrt(sum(moves) / sum(map(len, values))))
        scales.append(scale if scale > 1e-12 else 1.0)
    settings = settings_of(trajectories[0])
    return TrajectoryBatches(tuple(parts), np.array(scales), compared, settings, trajectories[0].dt)


def _checked_names(knowledge: System, compared: tuple[str, ...] | None) -> tuple[str, ...]:
    known = knowledge.y_layout.names
    # a strand's number may follow
    pose = tuple(name for name in known if name.rstrip("0123456789") in POSE)
    names = pose if compared is None else compared
    for name in names:
        if name not in known:
            raise DataError(f"RolloutTraining.compared has {name!r}; y has {', '.join(known)}")
    if not names:
        raise DataError(f"y has no p or h; RolloutTraining.compared must say which of {', '.join(known)}")
    return names


def _relevant(knowledge: System, trajectory: Any, names: tuple[str, ...]) -> Any:
    """Return a trajectory with zeros in all unused values, which may be unknown."""
    if not isinstance(trajectory, Trajectory) or np.ndim(trajectory.y) != 3:
        return trajectory
    y = np.array(trajectory.y, dtype=float)
    if y.shape[-1] == knowledge.y_layout.size:
        unused = tuple(name for name in knowledge.y_layout.names if name not in names)
        y[..., knowledge.y_layout.indices(unused)] = 0.0
    return dataclasses.replace(trajectory, y=y, z=np.zeros(np.shape(trajectory.z)))


# simulating


def simulated_batch(
    model: System, batch: _TrajectoryBatch, batches: TrajectoryBatches
) -> Float[Any, "B T+1 nodes y"]:
    """Return y of all trajectories simulated by the model, one after the other; NaN in unsolved steps."""
    settings = batches.settings

    def one(control: Any) -> Any:
        return simulate(
            model,
            control,
            batches.dt,
            space=settings.space,
            start=settings.start,
            newton=settings.newton,
            between=settings.between,
            initial=batch.initial,
            time=settings.time,  # type: ignore[arg-type]  # None is refused there
        ).y

    return jax.lax.map(one, batch.control)


@jax.jit
def _tip_errors(model: System, batches: TrajectoryBatches) -> Any:
    errors = []
    positions = Drawing.of(model).positions
    for batch in batches.parts:
        tips = positions(simulated_batch(model, batch, batches)[:, :, -1])
        distance = jnp.sum((tips - positions(batch.y[:, :, -1])) ** 2, axis=-1)
        errors.append(jnp.sqrt(jnp.mean(distance, axis=-1)))
    return jnp.concatenate(errors)


def held_out_error(knowledge: System, trajectories: Sequence[Trajectory]) -> runs.HeldOut:
    """Return a function of a model: its rms tip error (m) from rest, infinite if a step is not solved.

    The errors are averaged over the trajectories. None if there are no trajectories.

    Raises:
        DataError: as for `trajectory_batches`, or the system has no positions.
    """
    if not trajectories:
        return None
    known = knowledge.y_layout.names
    places = tuple(name for name in known if name.rstrip("0123456789") == "p")
    if not places:
        raise DataError(f"held-out rollouts need positions; y has {', '.join(known)}")
    batches = trajectory_batches(knowledge, trajectories, RolloutTraining(compared=places), "held-out ")

    def error(model: System) -> float:
        errors = np.asarray(_tip_errors(model, batches))
        return float(np.mean(errors)) if np.all(np.isfinite(errors)) else float("inf")

    return error


# the loss


@jax.jit
def loss_and_slope(
    weights: Any, rest: Any, knowledge: System, batches: TrajectoryBatches
) -> tuple[Float[Any, ""], Any]:
    """Return the rollout loss of a residual's weights and its gradient; NaN if a step is not solved.

    The loss is the mean of squared errors, each over its field's scale, over trajectories, rows (without the
    first), nodes and numbers, then over fields. Quaternions are normalised, and compared up to their sign.
    """

    def loss(weights: Any) -> Any:
        model = KNODE(knowledge, eqx.combine(weights, rest))
        total, count = jnp.zeros(()), 0
        for batch in batches.parts:
            simulated = simulated_batch(model, batch, batches)[:, 1:]
            for name, scale in zip(batches.compared, batches.scales, strict=True):
                pair = (model.y_layout.get(y, name) for y in (simulated, batch.y[:, 1:]))
                total = total + jnp.mean((_difference(name, *pair) / scale) ** 2) * batch.y.shape[0]
            count += batch.y.shape[0]
        return total / (count * len(batches.compared))

    return jax.value_and_grad(loss)(weights)


def _difference(name: str, values: Any, truth: Any) -> Any:
    if name != "h" or values.shape[-1] != 4:
        return values - truth
    values, truth = (h / jnp.sqrt(jnp.sum(h * h, axis=-1, keepdims=True)) for h in (values, truth))
    same = jnp.sum(values * truth, axis=-1, keepdims=True) >= 0.0
    return values - jnp.where(same, truth, -truth)


# fine-tuning


class _RolloutState(NamedTuple):
    """State of fine-tuning: weights, optimiser, gradient, weights of least loss, factor on the step."""

    weights: Any
    adam: Any
    slope: Any
    lowest: Any
    scale: Any


@jax.jit
def _proposal(state: _RolloutState, rest: Any, rate: Any, clip: Any) -> Any:
    """Return the weights and the optimiser after a step."""
    slope, _ = optax.clip_by_global_norm(clip).update(state.slope, optax.EmptyState())
    direction, adam = runs.ADAM.update(slope, state.adam)
    moved = jax.tree.map(lambda weight, change: weight - rate * change, state.weights, direction)
    return runs.split(eqx.combine(moved, rest).clamped())[0], adam


class RolloutRun(runs.Run):
    """Fine-tuning of one seed's residual through whole simulations.

    A step after which the simulation fails or the loss diverges is rejected: it is halved, and so are all
    later steps.
    """

    stage = "rollouts"
    loss_after = True

    def __init__(
        self,
        options: RolloutTraining,
        batches: TrajectoryBatches,
        held_out: runs.HeldOut,
        model: KNODE,
        seed: int,
    ):
        super().__init__(options, options.updates, held_out, model, seed)
        self._batches, self._options = batches, options

    def started(self, weights: Any) -> _RolloutState:
        """Return the state before the first update, without a gradient."""
        slope = jax.tree.map(jnp.zeros_like, weights)
        return _RolloutState(weights, runs.ADAM.init(weights), slope, weights, np.array(1.0))

    @property
    def last(self) -> Any:
        """Weights with the lowest loss."""
        return self.state.lowest

    def compile(self) -> None:
        """Compile by one evaluation and one held-out rollout."""
        self._evaluated(self.state.weights)
        super().compile()

    def _evaluated(self, weights: Any) -> tuple[float, Any]:
        loss, slope = loss_and_slope(weights, self.rest, self.knowledge, self._batches)
        return float(loss), slope

    def _begin(self, watch: runs.ProgressMonitor) -> None:
        """Evaluate the loss before the first update. Raises `FitError` if the simulation fails."""
        loss, slope = self._evaluated(self.state.weights)
        if not np.isfinite(loss) or not runs.is_finite(slope):
            raise FitError(
                f"the model of seed {self.seed} cannot be simulated over the trajectories and so not "
                "be fine-tuned: train it longer on segments, or simulate fewer rows (RolloutTraining.horizon)"
            )
        self.state, self.losses = self.state._replace(slope=slope), np.array([loss])
        self.check(watch)

    def advance(self, stop: int, watch: runs.ProgressMonitor) -> None:
        """Run one update."""
        if len(self.losses) == 0:
            self._begin(watch)
        options, state = self._options, self.state
        rate, scale = options.learning_rate, float(state.scale)
        if options.schedule == "cosine":
            rate *= 0.5 * (1.0 + np.cos(np.pi * self.done / options.updates))
        for _ in range(options.rejections):
            step = rate * scale
            weights, adam = _proposal(state, self.rest, step, options.clip)
            loss, slope = self._evaluated(weights)
            if loss <= runs.DIVERGED * max(self.losses[0], runs.NOTHING) and runs.is_finite((weights, slope)):
                break
            scale /= 2.0
        else:
            raise FitError(
                f"fine-tuning of seed {self.seed} stopped in update {self.done}: with the step halved "
                f"{options.rejections} times, to {step:.3g}, the robot still cannot be simulated after it"
            )
        lowest = weights if loss < self.losses.min() else state.lowest
        self.state = _RolloutState(weights, adam, slope, lowest, np.array(scale))
        watch.steps(self.stage, self.seed, self.done, self.losses[-1:], np.array([step]))
        self.losses, self.rates = np.append(self.losses, loss), np.append(self.rates, step)
        self.check(watch)
