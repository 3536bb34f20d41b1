"""Runs of sweeps: what is missing in the folder is solved."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from knode_cosserat.sweeps.data import SweepData
from knode_cosserat.sweeps.description import Sweep
from knode_cosserat.sweeps.errors import SweepError
from knode_cosserat.sweeps.executors import Executor, Local
from knode_cosserat.sweeps.folder import (
    is_complete,
    log_run,
    now,
    open_folder,
    remove_temporaries,
)
from knode_cosserat.sweeps.manifest import made_by
from knode_cosserat.sweeps.plan import Plan
from knode_cosserat.sweeps.shard_file import require_pyarrow
from knode_cosserat.sweeps.work import Done, Work


def run_sweep(
    sweep: Sweep, folder: str | Path, *, executor: Executor | None = None, progress: bool = False
) -> SweepData:
    """Solve all cases of a sweep into a folder, and return its data.

    Shards that are there are not solved again, so that the same call continues a sweep that was stopped or
    killed. A failed case does not stop the sweep: it is stored with its result codes and the reason, and its
    unsolved rows are NaN. Results do not depend on the executor, or on how often the sweep was stopped; they
    are equal bit for bit on one kind of CPU.

    Args:
        sweep: description of the sweep.
        folder: folder for its files; it is created if missing.
        executor: `Local`, `Dask` or `Slurm`; by default processes of this machine.
        progress: show a progress bar.

    Raises:
        SweepError: the sweep is not possible, the folder has another sweep or a shard of another version,
            nothing can be written, or a worker died.
    """
    if not isinstance(sweep, Sweep):
        raise SweepError(f"sweep is a {type(sweep).__name__}; allowed is a Sweep")
    require_pyarrow()
    folder, executor = Path(folder), executor or Local()
    if not isinstance(executor, Executor):
        raise SweepError(f"executor is a {type(executor).__name__}; allowed is Local, Dask or Slurm")
    plan, began, started = Plan.of(sweep), time.perf_counter(), now()
    open_folder(plan, folder)
    missing = [number for number in range(plan.shard_count) if not is_complete(plan, folder, number)]
    work = Work(plan, str(folder.absolute()), made_by())
    solved: list[Done] = []
    try:
        solved.extend(_solved(work, missing, executor, progress))
    finally:
        counts = {"missing_shards": len(missing), "solved_cases": sum(done.cases for done in solved)}
        seconds = round(time.perf_counter() - began, 3)
        log_run(folder, executor=executor.label, **counts, seconds=seconds, **_medians(solved))
    remove_temporaries(folder, started)
    return SweepData.open(folder)


def _solved(work: Work, missing: list[int], executor: Executor, progress: bool) -> Iterator[Done]:
    """Solve missing shards; yield each when it is stored."""
    plan = work.plan
    total = plan.sweep.case_count
    present = total - sum(plan.rows(number) for number in missing)
    failed = 0
    shown: dict[str, Any] = {"disable": not progress, "unit": "case", "unit_scale": True}
    with tqdm(total=total, initial=present, **shown) as bar:
        if missing:
            for done in executor.run(work, missing):
                failed += done.failed
                bar.update(done.cases)
                bar.set_postfix_str(f"{failed} failed")
                yield done


def _medians(solved: list[Done]) -> dict[str, float]:
    """Return the median times of a case: of its worker, and of all cores (s)."""
    if not solved:
        return {}
    times = np.median([(done.seconds / done.cases, done.cpu_seconds / done.cases) for done in solved], axis=0)
    found = {"case_seconds": float(times[0]), "case_cpu_seconds": float(times[1])}
    return {name: each for name, each in found.items() if np.isfinite(each)}
