"""The two stages of gradient training: one-segment samples first, then whole rollouts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.learning.config import RolloutTraining, Training
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.residual import Residual
from knode_cosserat.learning.samples import Dataset
from knode_cosserat.learning.training.checkpoint import packed_tree, unpacked
from knode_cosserat.learning.training.descent import ADAM, PIECE, prepared, run_epochs, split, started
from knode_cosserat.learning.training.progress import ProgressMonitor
from knode_cosserat.learning.training.rollouts import (
    RolloutTargets,
    TrajectoryBatches,
    loss_and_slope,
    scales,
    tip_error,
)
from knode_cosserat.learning.training.runs import Best, FitError, Run
from knode_cosserat.rods.system import System

#: a loss above this multiple of its initial value has diverged; the initial value counts as at least NOTHING
DIVERGED = 1e6
NOTHING = 1e-6


def _finite(tree: Any) -> bool:
    return all(bool(np.all(np.isfinite(np.asarray(leaf)))) for leaf in jax.tree.leaves(tree))


class SegmentRun(Run):
    """Epochs on one-segment samples, for one seed or several in one program."""

    stage = "segments"

    def __init__(
        self, knowledge: System, residuals: Sequence[Residual], dataset: Dataset, training: Training,
        seeds: tuple[int, ...], held_out: TrajectoryBatches | None,
    ):  # fmt: skip
        self.name = "-".join(["segments", *map(str, seeds)])
        self.seeds, self.steps = seeds, training.epochs
        self._knowledge, self._training, self._held_out = knowledge, training, held_out
        self._given = prepared(knowledge.strand, residuals[0], dataset, training)
        self._state = started(residuals, training, seeds)
        self._losses = np.zeros((0, len(seeds)))
        self._rates = np.zeros((0, len(seeds)))
        self._best = Best(self._state.weights, training.stop_after)

    @property
    def finished(self) -> bool:
        """True if all epochs are done, or all seeds have stopped."""
        return self.done >= self.steps or bool(np.all(self._best.stopped >= 0))

    def compile(self) -> None:
        """Compile the epochs' program without running one, and run one held-out rollout."""
        run_epochs(*self._given, self._state, self.done)
        if self._held_out:
            tip_error(KNODE(self._knowledge, self._last()[0]), self._held_out)

    def advance(self, stop: int, watch: ProgressMonitor) -> None:
        """Run epochs up to the next check, at most `PIECE`."""
        every = self._training.check_every
        stop = min(stop, self.done + PIECE, self.steps)
        if self._held_out:
            stop = min(stop, self.done - self.done % every + every)
        state, losses, rates = run_epochs(*self._given, self._state, stop)
        losses, rates = (np.asarray(values)[: stop - self.done] for values in (losses, rates))
        self._require_sane(losses, state.weights)
        self._state = state
        self._losses = np.concatenate([self._losses, losses])
        self._rates = np.concatenate([self._rates, rates])
        first, self.done = self.done, stop
        watch.steps(self.stage, self.seeds, first, losses, rates)
        if self._held_out and (stop % every == 0 or stop == self.steps):
            models = [KNODE(self._knowledge, residual) for residual in self._last()]
            errors = [tip_error(model, self._held_out) for model in models]
            self._best.offer(stop, errors, state.weights)
            for seed, error in zip(self.seeds, errors, strict=True):
                watch.error(self.stage, seed, stop, error)

    def _require_sane(self, losses: np.ndarray, weights: Any) -> None:
        start = np.concatenate([self._losses, losses])[0]
        going = self._best.stopped < 0
        bad = ~(losses <= DIVERGED * np.maximum(start, NOTHING)) & going
        if bad.any():
            row, k = np.argwhere(bad)[0]
            raise FitError(
                f"the loss of seed {self.seeds[k]} became {losses[row, k]:.3g} in epoch {self.done + row} "
                f"({start[k]:.3g} in the first): a smaller learning rate may help"
            )
        if not _finite([np.asarray(leaf)[going] for leaf in jax.tree.leaves(weights)]):
            raise FitError(
                f"weights are not finite after epoch {self.done + len(losses)}: "
                "a smaller learning rate may help"
            )

    def _residual(self, weights: Any) -> Residual:
        return eqx.combine(weights, self._given[2].rest)

    def _last(self) -> list[Residual]:
        weights = self._state.weights
        return [self._residual(jax.tree.map(lambda x, k=k: x[k], weights)) for k in range(len(self.seeds))]

    def residuals(self) -> list[Residual]:
        """Return residuals with the last weights, or the best if training may stop early."""
        weights = self._state.weights
        return [self._residual(self._best.chosen(k, weights)) for k in range(len(self.seeds))]

    def history(self, seed: int) -> dict[str, Any]:
        """Return the loss before every update, the learning rate, and held-out errors."""
        k = self.seeds.index(seed)
        stopped = self._best.stopped[k]
        rows = slice(0, stopped if stopped >= 0 else None)
        found = {"loss": self._losses[rows, k], "learning_rate": self._rates[rows, k]}
        return found | ({"held_out_error": self._best.history(k)} if self._held_out else {})

    def snapshot(self) -> dict[str, Any]:
        """Return state, histories and best weights."""
        return {
            "state": packed_tree(self._state), "losses": self._losses, "rates": self._rates,
            "best": self._best.snapshot(),
        }  # fmt: skip

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go back to a snapshot."""
        self._state = unpacked(snapshot.get("state"), self._state)
        self.done = int(self._state.epoch)
        like = [np.zeros((self.done, len(self.seeds)))] * 2
        histories = unpacked([snapshot.get("losses"), snapshot.get("rates")], like)
        self._losses, self._rates = map(np.asarray, histories)
        self._best.restore(snapshot["best"])


@jax.jit
def _proposal(weights: Any, rest: Any, adam: Any, slope: Any, rate: Any, clip: Any) -> Any:
    length = jnp.sqrt(sum(jnp.sum(leaf * leaf) for leaf in jax.tree.leaves(slope)))
    slope = jax.tree.map(lambda leaf: leaf * jnp.minimum(1.0, clip / jnp.maximum(length, 1e-300)), slope)
    direction, adam = ADAM.update(slope, adam)
    moved = jax.tree.map(lambda weight, change: weight - rate * change, weights, direction)
    return split(eqx.combine(moved, rest).clamped())[0], adam


class RolloutRun(Run):
    """Fine-tuning of one seed's residual through whole simulations.

    A step after which the simulation fails or the loss diverges is rejected: it is halved, and so are all
    later steps.
    """

    stage = "rollouts"

    def __init__(
        self, knowledge: System, residual: Residual, courses: TrajectoryBatches, options: RolloutTraining,
        seed: int, held_out: TrajectoryBatches | None,
    ):  # fmt: skip
        self.name = f"rollouts-{seed}"
        self.seeds, self.steps = (seed,), options.updates
        self._courses, self._options, self._held_out = courses, options, held_out
        weights, self._rest = split(residual)
        self._weights = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), weights)
        measured = np.array(scales(courses, knowledge.y_layout))
        self._aim = RolloutTargets(knowledge, self._rest, courses.parts, measured)
        self._adam = ADAM.init(self._weights)
        #: factor on the step after halvings
        self._scale = 1.0
        self._losses = np.zeros(0)
        self._rates = np.zeros(0)
        self._slope = jax.tree.map(jnp.zeros_like, self._weights)
        self._lowest = self._weights
        self._best = Best(self._one(self._weights), options.stop_after)

    @staticmethod
    def _one(weights: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf[None], weights)

    @property
    def finished(self) -> bool:
        """True if all updates are done, or the held-out error has not improved for `stop_after` updates."""
        return self.done >= self.steps or bool(self._best.stopped[0] >= 0)

    def compile(self) -> None:
        """Compile by one evaluation and one held-out rollout."""
        self._evaluated(self._weights)
        if self._held_out:
            tip_error(self._model(), self._held_out)

    def _evaluated(self, weights: Any) -> tuple[float, Any]:
        courses = self._courses
        loss, slope = loss_and_slope(weights, self._aim, courses.compared, courses.settings, courses.dt)
        return float(loss), slope

    def begin(self, watch: ProgressMonitor) -> None:
        """Evaluate the loss before the first update. Raises `FitError` if the simulation fails."""
        loss, self._slope = self._evaluated(self._weights)
        if not np.isfinite(loss) or not _finite(self._slope):
            raise FitError(
                f"the model of seed {self.seeds[0]} cannot be simulated over the trajectories and so not "
                "be fine-tuned: train it longer on segments, or simulate fewer rows (RolloutTraining.horizon)"
            )
        self._losses = np.array([loss])
        self._check(watch)

    def advance(self, stop: int, watch: ProgressMonitor) -> None:
        """Run one update."""
        if len(self._losses) == 0:
            self.begin(watch)
        options = self._options
        rate = options.learning_rate
        if options.schedule == "cosine":
            rate *= 0.5 * (1.0 + np.cos(np.pi * self.done / options.updates))
        for _ in range(options.rejections):
            step = rate * self._scale
            weights, adam = _proposal(self._weights, self._rest, self._adam, self._slope, step, options.clip)
            loss, slope = self._evaluated(weights)
            if loss <= DIVERGED * max(self._losses[0], NOTHING) and _finite((weights, slope)):
                break
            self._scale /= 2.0
        else:
            raise FitError(
                f"fine-tuning of seed {self.seeds[0]} stopped in update {self.done}: with the step halved "
                f"{options.rejections} times, to {step:.3g}, the robot still cannot be simulated after it"
            )
        if loss < self._losses.min():
            self._lowest = weights
        self._weights, self._adam, self._slope = weights, adam, slope
        watch.steps(self.stage, self.seeds, self.done, self._losses[-1:, None], np.array([[step]]))
        self._losses, self._rates = np.append(self._losses, loss), np.append(self._rates, step)
        self.done += 1
        self._check(watch)

    def _model(self) -> KNODE:
        return KNODE(self._aim.knowledge, eqx.combine(self._weights, self._rest))

    def _check(self, watch: ProgressMonitor) -> None:
        if self._held_out is None or (self.done % self._options.check_every and self.done < self.steps):
            return
        error = tip_error(self._model(), self._held_out)
        self._best.offer(self.done, [error], self._one(self._weights))
        watch.error(self.stage, self.seeds[0], self.done, error)

    def residuals(self) -> list[Residual]:
        """Return the weights with the lowest loss, or the lowest held-out error if it may stop early."""
        return [eqx.combine(self._best.chosen(0, self._one(self._lowest)), self._rest)]

    def history(self, seed: int) -> dict[str, Any]:
        """Return the loss before every update and after the last, step size, and held-out errors."""
        found = {"loss": self._losses, "learning_rate": self._rates}
        return found | ({"held_out_error": self._best.history(0)} if self._held_out else {})

    def _state(self) -> Any:
        return self._weights, self._adam, self._slope, self._lowest, np.array(self._scale)

    def snapshot(self) -> dict[str, Any]:
        """Return weights, optimiser state, gradient, histories and best weights."""
        return {
            "state": packed_tree(self._state()), "losses": self._losses, "rates": self._rates,
            "best": self._best.snapshot(),
        }  # fmt: skip

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go back to a snapshot."""
        state = unpacked(snapshot.get("state"), self._state())
        self._weights, self._adam, self._slope, self._lowest, scale = state
        self._scale = float(scale)
        self._rates = np.asarray(snapshot.get("rates"), dtype=float).reshape(-1)
        self.done = len(self._rates)
        self._losses = np.asarray(unpacked([snapshot.get("losses")], [np.zeros(self.done + 1)])[0])
        self._best.restore(snapshot["best"])
