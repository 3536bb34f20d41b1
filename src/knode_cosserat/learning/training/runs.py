"""Gradient training of the seeds of a fit: in parallel on all cores, with checkpoints and progress."""

from __future__ import annotations

import abc
import collections
import concurrent.futures
import os
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from tqdm import tqdm

from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.learning.config import FitError, RolloutTraining, Training
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.residual import Residual
from knode_cosserat.learning.training.checkpoint import CheckpointError, Checkpoints, packed_tree, unpacked

ADAM = optax.scale_by_adam(b1=0.9, b2=0.999, eps=1e-8)
#: a loss above this multiple of its initial value has diverged; the initial value counts as at least NOTHING
DIVERGED, NOTHING = 1e6, 1e-6
#: a function that returns the held-out error (m) of a model, or None
HeldOut = Callable[[KNODE], float] | None


class WatchError(KnodeCosseratError, ValueError):
    """Metrics cannot be written. The message is one line with the reason."""

    code = "training-log"


class ProgressMonitor:
    """Receiver of progress from all parts of a fit, from any thread. Use as a context manager."""

    def __init__(self, progress: bool, log_dir: str | Path | None):
        self._lock = threading.Lock()
        self._folder = None if log_dir is None else Path(log_dir)
        self._writer_class = None if log_dir is None else _writer_class()
        self._writers: dict[int, Any] = {}
        self._bar: Any = None
        self._progress = progress

    def __enter__(self) -> ProgressMonitor:
        return self

    def __exit__(self, *_: object) -> None:
        for writer in self._writers.values():
            writer.close()
        if self._bar is not None:
            self._bar.close()

    def begin(self, what: str, total: int, done: int) -> None:
        """Start a stage with a total number of steps; some may be done already."""
        if self._bar is not None:
            self._bar.close()
        self._bar = tqdm(total=total, initial=done, desc=what, unit="step", disable=not self._progress)

    def steps(self, what: str, seed: int, first: int, losses: np.ndarray, rates: np.ndarray) -> None:
        """Record the losses and rates of consecutive steps; the first has number `first`."""
        with self._lock:
            self._bar.set_postfix_str(f"loss {losses[-1]:.3g}", refresh=False)
            self._bar.update(losses.size)
            self._write(seed, first, f"{what}/loss", losses)
            self._write(seed, first, f"{what}/learning_rate", rates)

    def error(self, what: str, seed: int, step: int, error: float) -> None:
        """Record the held-out error (m) after a step."""
        with self._lock:
            self._write(seed, step, f"{what}/held_out_error", [error])

    def _write(self, seed: int, first: int, name: str, values: Any) -> None:
        if self._folder is None or self._writer_class is None:
            return
        if seed not in self._writers:
            folder = self._folder / f"seed-{seed}"
            try:
                # purge metrics that an interrupted run wrote after its last checkpoint: they come again
                self._writers[seed] = self._writer_class(str(folder), purge_step=first, flush_secs=5)
            except OSError as error:
                raise WatchError(f"{folder}: metrics cannot be written: {error.strerror}") from None
        for i, value in enumerate(values):
            self._writers[seed].add_scalar(name, float(value), first + i)


def _writer_class() -> Any:
    try:
        from tensorboardX import SummaryWriter  # type: ignore[import-untyped]
    except ImportError:
        raise WatchError("log_dir needs tensorboardX: pip install knode-cosserat[tensorboard]") from None
    return SummaryWriter


def split(residual: Residual) -> tuple[Any, Any]:
    """Split a residual into its weights and the rest; `equinox.combine` joins them."""
    mask = jax.tree_util.tree_map_with_path(lambda path, leaf: _is_weight(residual, path, leaf), residual)
    return eqx.partition(residual, mask)


def _is_weight(node: Any, path: Any, leaf: Any) -> bool:
    for key in path:
        name = getattr(key, "name", None)
        if name in getattr(type(node), "fixed", ()):
            return False
        index = getattr(key, "idx", getattr(key, "key", None))
        node = node[index] if name is None else getattr(node, name)
    return bool(np.issubdtype(jnp.result_type(leaf), np.floating))


def is_finite(tree: Any) -> bool:
    """True if all numbers of a pytree are finite."""
    return all(bool(np.all(np.isfinite(np.asarray(leaf)))) for leaf in jax.tree.leaves(tree))


class Run(abc.ABC):
    """Gradient training of one seed's residual, for a number of steps.

    Attributes:
        stage: kind of its steps, for progress, metrics and the name of its checkpoint.
        seed: seed of the residual.
        steps: total number of steps.
        state: pytree from which it continues; it has the `weights`.
        losses: losses before every step; with `loss_after` also after the last one.
        rates: learning rates.
        checks: (checks, 2), step and held-out error (m) of every held-out rollout.
        best: weights with the least held-out error.
    """

    stage: ClassVar[str]
    loss_after: ClassVar[bool] = False

    def __init__(
        self, training: Training | RolloutTraining, steps: int, held_out: HeldOut, model: KNODE, seed: int
    ):
        """Prepare the training of a model's residual."""
        self.knowledge, self.training, self.held_out = model.knowledge, training, held_out
        self.seed, self.steps, self.name = seed, steps, f"{self.stage}-{seed}"
        weights, self.rest = split(model.residual)
        weights = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), weights)
        self.state, self.best = self.started(weights), weights
        self.losses = self.rates = np.zeros(0)
        self.checks = np.zeros((0, 2))

    @abc.abstractmethod
    def started(self, weights: Any) -> Any:
        """Return the state before the first step."""

    @abc.abstractmethod
    def advance(self, stop: int, watch: ProgressMonitor) -> None:
        """Run some steps, up to number `stop` at most. Raises `FitError`."""

    def compile(self) -> None:
        """Compile the programs of `advance` before threads would each compile them."""
        if self.held_out:
            self.held_out(self.model())

    @property
    def done(self) -> int:
        """Number of steps done."""
        return len(self.rates)

    @property
    def finished(self) -> bool:
        """True if all steps are done, or the held-out error has not fallen for long enough."""
        limit, (steps, errors) = self.training.stop_after, self.checks.T
        stopped = limit is not None and len(steps) > 0 and steps[-1] - steps[np.argmin(errors)] >= limit
        return self.done >= self.steps or bool(stopped)

    @property
    def last(self) -> Any:
        """Weights after the last step."""
        return self.state.weights

    def model(self) -> KNODE:
        """Return the model with the present weights."""
        return KNODE(self.knowledge, eqx.combine(self.state.weights, self.rest))

    def residual(self) -> Residual:
        """Return the residual with the last weights, or the best if training may stop early."""
        errors = self.checks[:, 1]
        early = self.training.stop_after is not None and np.any(np.isfinite(errors))
        return eqx.combine(self.best if early else self.last, self.rest)

    def check(self, watch: ProgressMonitor) -> None:
        """Find the held-out error, if it is due after this step."""
        if self.held_out is None or (self.done % self.training.check_every and self.done < self.steps):
            return
        error = self.held_out(self.model())
        if error < np.min(self.checks[:, 1], initial=np.inf):
            self.best = self.state.weights
        self.checks = np.append(self.checks, [[self.done, error]], axis=0)
        watch.error(self.stage, self.seed, self.done, error)

    def report(self) -> dict[str, Any]:
        """Return loss, rate and held-out errors over the steps."""
        history = {"loss": self.losses, "learning_rate": self.rates}
        return history | ({"held_out_error": self.checks} if len(self.checks) else {})

    def snapshot(self) -> dict[str, Any]:
        """Return the state as arrays, and lists of arrays."""
        return {
            "state": packed_tree(self.state),
            "best": packed_tree(self.best),
            "losses": self.losses,
            "rates": self.rates,
            "checks": self.checks,
        }

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go back to a snapshot. Raises `CheckpointError` if it is of something else."""
        done, checks = len(snapshot["rates"]), len(snapshot["checks"])
        arrays = [snapshot[name] for name in ("losses", "rates", "checks")]
        like = [np.zeros(done + self.loss_after), np.zeros(done), np.zeros((checks, 2))]
        self.losses, self.rates, self.checks = map(np.asarray, unpacked(arrays, like))
        self.state = unpacked(snapshot["state"], self.state)
        self.best = unpacked(snapshot["best"], self.best)


def run_all(runs: Sequence[Run], checkpoints: Checkpoints | None, every: int, watch: ProgressMonitor) -> None:
    """Complete all runs, from their checkpoints if there are any, with a checkpoint every `every` steps.

    Raises:
        FitError: a run cannot continue; the others have stopped too.
        CheckpointError: a checkpoint cannot be used, or not be written.
    """
    for run in runs if checkpoints else ():
        snapshot = checkpoints.load(run.name)  # type: ignore[union-attr]
        try:
            if snapshot is not None:
                run.restore(snapshot)
        except (CheckpointError, TypeError, ValueError, AttributeError, KeyError) as error:
            known = isinstance(error, CheckpointError)
            reason = str(error) if known else "it has something else in it than states"
            path = checkpoints.path(run.name)  # type: ignore[union-attr]
            raise CheckpointError(f"{path}: {reason}; delete it to start again") from None
    stages = {run.stage for run in runs}
    watch.begin(" and ".join(sorted(stages)), sum(run.steps for run in runs), sum(run.done for run in runs))

    def work(run: Run) -> None:
        try:
            run.advance(run.done - run.done % every + every, watch)
        except FitError as error:
            kept = "nothing was kept: no checkpoint was asked for"
            if checkpoints is not None:
                path = checkpoints.path(run.name)
                kept = f"the last good state is kept in {path}"
                kept = kept if path.exists() else "it was too early for a checkpoint"
            raise FitError(f"{error}; {kept}") from None
        if checkpoints and (run.finished or run.done % every == 0):
            checkpoints.save(run.name, run.snapshot())

    _side_by_side([run for run in runs if not run.finished], work)


def _side_by_side(runs: Sequence[Run], work: Callable[[Run], None]) -> None:
    """Work on all runs in turn, a piece at a time, with one thread for each core.

    With one thread for each run, five runs on two cores would take the time of six.
    """
    waiting = collections.deque(runs)
    stop = threading.Event()

    def worker() -> None:
        while not stop.is_set():
            try:
                run = waiting.popleft()
            except IndexError:
                return
            work(run)
            if not run.finished:
                waiting.append(run)

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = min(len(runs), cores if jax.default_backend() == "cpu" else 1)
    if count <= 1:
        worker()
        return
    runs[0].compile()
    with concurrent.futures.ThreadPoolExecutor(count) as pool:
        workers = [pool.submit(worker) for _ in range(count)]
        try:
            done, _ = concurrent.futures.wait(workers, return_when=concurrent.futures.FIRST_EXCEPTION)
            for future in done:
                future.result()
        finally:
            stop.set()
