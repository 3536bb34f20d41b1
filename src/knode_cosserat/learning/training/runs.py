"""Execution of the parts of a fit: in parallel on all cores, each with its own checkpoint, with progress."""

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
from knode_cosserat.learning.config import FitError
from knode_cosserat.learning.residual import Residual
from knode_cosserat.learning.training.checkpoint import CheckpointError, Checkpoints, packed_tree, unpacked

ADAM = optax.scale_by_adam(b1=0.9, b2=0.999, eps=1e-8)
#: a loss above this multiple of its initial value has diverged; the initial value counts as at least NOTHING
DIVERGED, NOTHING = 1e6, 1e-6


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

    def steps(
        self, what: str, seeds: Sequence[int], first: int, losses: np.ndarray, rates: np.ndarray
    ) -> None:
        """Record the losses and rates (steps, seeds) of consecutive steps; the first has number `first`."""
        with self._lock:
            self._bar.set_postfix_str(f"loss {np.mean(losses[-1]):.3g}", refresh=False)
            self._bar.update(losses.size)
            for k, seed in enumerate(seeds):
                self._write(seed, first, f"{what}/loss", losses[:, k])
                self._write(seed, first, f"{what}/learning_rate", rates[:, k])

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


class Best:
    """Best weights of each seed by held-out error, and early stopping."""

    def __init__(self, weights: Any, stop_after: int | None):
        count = jax.tree.leaves(weights)[0].shape[0]
        self.stop_after = stop_after
        self.errors = np.full(count, np.inf)
        self.steps = np.zeros(count, dtype=int)
        #: step after which each seed stopped; -1 if it is still running
        self.stopped = np.full(count, -1)
        self.weights = jax.tree.map(lambda leaf: np.array(leaf), weights)
        #: step, and the error of each seed
        self.seen: list[list[float]] = []

    def offer(self, step: int, errors: Sequence[float], weights: Any) -> None:
        """Record the held-out errors and weights (seeds first) after a step."""
        self.seen.append([float(step), *errors])
        for k in map(int, np.flatnonzero(self.stopped < 0)):
            if errors[k] < self.errors[k]:
                self.errors[k], self.steps[k] = errors[k], step
                for kept, new in zip(jax.tree.leaves(self.weights), jax.tree.leaves(weights), strict=True):
                    kept[k] = np.asarray(new)[k]
            elif self.stop_after is not None and step - self.steps[k] >= self.stop_after:
                self.stopped[k] = step

    def chosen(self, k: int, last: Any) -> Any:
        """Return the weights of a seed: the best if it may stop early, otherwise the last."""
        kept = self.stop_after is not None and np.isfinite(self.errors[k])
        return jax.tree.map(lambda leaf: jax.numpy.asarray(leaf[k]), self.weights if kept else last)

    def report(self, k: int) -> np.ndarray:
        """Return steps and errors (checks, 2) of a seed, until it stopped."""
        seen = np.array(self.seen).reshape(len(self.seen), 1 + len(self.errors))[:, [0, 1 + k]]
        return seen if self.stopped[k] < 0 else seen[seen[:, 0] <= self.stopped[k]]

    def snapshot(self) -> dict[str, Any]:
        """Return the state for `restore`."""
        return {
            "errors": self.errors, "steps": self.steps, "stopped": self.stopped,
            "weights": packed_tree(self.weights), "seen": np.array(self.seen),
        }  # fmt: skip

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go back to a snapshot. Raises `CheckpointError` if it is of something else."""
        like = [self.errors, self.steps, self.stopped]
        arrays = [snapshot.get(name) for name in ("errors", "steps", "stopped")]
        self.errors, self.steps, self.stopped = (np.array(leaf) for leaf in unpacked(arrays, like))
        self.weights = jax.tree.map(np.array, unpacked(snapshot.get("weights"), self.weights))
        self.seen = [list(row) for row in np.asarray(snapshot.get("seen")).tolist()]


class Run(abc.ABC):
    """Independent part of a fit: some seeds, for a number of steps.

    Attributes:
        stage: kind of its steps, for progress, metrics and the name of its checkpoint.
        seeds: seeds that it trains.
        steps: total number of steps.
        state: pytree from which it continues.
        best: best weights by held-out error, and early stopping.
        losses: (steps, seeds), before every step; with `loss_after` also after the last one.
        rates: (steps, seeds), learning rates.
    """

    stage: ClassVar[str]
    loss_after: ClassVar[bool] = False

    def __init__(self, seeds: tuple[int, ...], steps: int, state: Any, best: Best):
        self.seeds, self.steps, self.state, self.best = seeds, steps, state, best
        self.name = "-".join([self.stage, *map(str, seeds)])
        self.losses = self.rates = np.zeros((0, len(seeds)))

    @property
    def done(self) -> int:
        """Number of steps done."""
        return len(self.rates)

    @property
    def finished(self) -> bool:
        """True if all steps are done, or all seeds have stopped early."""
        return self.done >= self.steps or bool(np.all(self.best.stopped >= 0))

    @abc.abstractmethod
    def compile(self) -> None:
        """Compile the program of `advance` before threads would each compile it."""

    @abc.abstractmethod
    def advance(self, stop: int, watch: ProgressMonitor) -> None:
        """Run some steps, up to number `stop` at most. Raises `FitError`."""

    @abc.abstractmethod
    def residuals(self) -> list[Residual]:
        """Return the trained residuals, one for every seed."""

    def report(self, seed: int) -> dict[str, Any]:
        """Return loss, rate and held-out errors of one seed over the steps."""
        k = self.seeds.index(seed)
        rows = slice(0, self.best.stopped[k] if self.best.stopped[k] >= 0 and not self.loss_after else None)
        history = {"loss": self.losses[rows, k], "learning_rate": self.rates[rows, k]}
        return history | ({"held_out_error": self.best.report(k)} if self.best.seen else {})

    def snapshot(self) -> dict[str, Any]:
        """Return the state as plain values, arrays, and lists of arrays."""
        return {
            "state": packed_tree(self.state), "losses": self.losses, "rates": self.rates,
            "best": self.best.snapshot(),
        }  # fmt: skip

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go back to a snapshot. Raises `CheckpointError` if it is of something else."""
        self.state = unpacked(snapshot.get("state"), self.state)
        arrays = [snapshot.get("losses"), snapshot.get("rates")]
        done, count = len(snapshot["rates"]), len(self.seeds)
        like = [np.zeros((done + self.loss_after, count)), np.zeros((done, count))]
        self.losses, self.rates = map(np.asarray, unpacked(arrays, like))
        self.best.restore(snapshot["best"])


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
    total = sum(run.steps * len(run.seeds) for run in runs)
    watch.begin(" and ".join(sorted(stages)), total, sum(run.done * len(run.seeds) for run in runs))

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
