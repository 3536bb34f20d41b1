"""Progress of a running fit: a progress bar, and metrics as TensorBoard event files."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from knode_cosserat.errors import KnodeCosseratError


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
