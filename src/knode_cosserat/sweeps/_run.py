"""Runs of sweeps: an executor solves the missing shards in this process, in others, or on a cluster."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import multiprocessing
import os
import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from knode_cosserat._arguments import check_arguments
from knode_cosserat._processes import end_with_parent
from knode_cosserat.solvers.run import usable_cores
from knode_cosserat.sweeps._data import SweepData, load_sweep
from knode_cosserat.sweeps._description import Sweep, SweepError
from knode_cosserat.sweeps._folder import (
    SHARDS,
    holds_plan,
    is_complete,
    log_run,
    machine,
    made_by,
    open_folder,
    shard_path,
)
from knode_cosserat.sweeps._plan import Plan
from knode_cosserat.sweeps._shards import KEPT, require_pyarrow, shard_bytes, write_shard
from knode_cosserat.sweeps._solve import solve_shard

#: shards for each process from which processes are started by default: a start takes as long as some shards
SHARDS_EACH = 4


@dataclasses.dataclass
class SolvedShard:
    """Facts on a solved shard, and the content of its file if the worker could not write it."""

    number: int
    cases: int
    failed: int
    #: time, and time of all cores, in s
    seconds: float
    cpu_seconds: float
    content: bytes | None = None


@dataclasses.dataclass(eq=False)
class Work:
    """Shards of one call of an executor. The call returns the shards that it solved.

    Attributes:
        plan: the plan.
        folder: the sweep's folder. A worker that does not see it returns the contents of files.
        shards: numbers of the shards.
        made_by: versions of the process that started the sweep; a worker with others refuses to work.
        threads: number of threads; None: one for each usable core.
    """

    plan: Plan
    folder: Path
    shards: Sequence[int]
    made_by: dict[str, str]
    threads: int | None = None

    def __call__(self) -> list[SolvedShard]:
        """Solve the shards that are not in the folder; each is written when it is solved."""
        local = made_by()
        for name in {**local, **self.made_by}:
            if local.get(name) != self.made_by.get(name):
                raise SweepError(
                    f"the workers have another {name} than this process: {local.get(name)}, not "
                    f"{self.made_by.get(name)}"
                )
        missing = (number for number in self.shards if not is_complete(self.plan, self.folder, number))
        return [self._solve(number) for number in missing]

    def _solve(self, number: int) -> SolvedShard:
        began, cpu = time.perf_counter(), time.process_time()
        columns = solve_shard(self.plan, number, self.threads)
        cases, failed = len(columns["case"]), int(np.count_nonzero(np.any(columns["result"] < 0, axis=1)))
        about = {"sweep": self.plan.identity, "shard": number, "cases": cases, "failed": failed}
        content = shard_bytes(columns, {**about, "made_by": self.made_by, "machine": machine()})
        is_written = holds_plan(self.folder, self.plan)
        if is_written:
            write_shard(shard_path(self.folder, number), content)
        seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
        return SolvedShard(number, cases, failed, seconds, cpu, None if is_written else content)

    def checkpoint(self) -> object:
        """Return this work for submission again, as submitit asks of an interrupted job."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def _begin_worker() -> None:
    """Prepare a worker process: end with its parent, and keep to one core."""
    end_with_parent()
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        # "SpawnProcess-2" is the second one
        rank = int(multiprocessing.current_process().name.rpartition("-")[2])
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, {cores[rank % len(cores)]})


def _solved(
    plan: Plan, folder: Path, missing: Sequence[int], workers: int | None, executor: Any
) -> Generator[SolvedShard, None, None]:
    """Yield the solved shards, in order of completion where the executor has one."""
    versions = made_by()
    if executor is None:
        cores = usable_cores()
        workers = min(workers or (cores if len(missing) >= SHARDS_EACH * cores else 1), len(missing))
        if workers <= 1:
            for number in missing:
                yield from Work(plan, folder, [number], versions)()
            return
        # spawned: JAX has threads, and a fork of it deadlocks
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(workers, context, _begin_worker) as pool:
            yield from _solved(plan, folder, missing, None, pool)
        return
    is_local = isinstance(executor, concurrent.futures.Executor)
    calls = min(workers or len(missing), len(missing))
    works = [Work(plan, folder, missing[k::calls], versions, 1 if is_local else None) for k in range(calls)]
    try:
        with getattr(executor, "batch", contextlib.nullcontext)():
            futures = [executor.submit(work) for work in works]
    except Exception as error:  # submitit raises many kinds, also for a missing `sbatch`
        raise SweepError(f"jobs cannot be submitted: {_reason(error)}") from error
    try:
        # jobs of submitit are no futures; they write their files without this process
        for future in concurrent.futures.as_completed(futures) if is_local else futures:
            try:
                failure = future.exception()
            except concurrent.futures.CancelledError as error:
                failure = error
            if isinstance(failure, SweepError):
                raise failure
            if failure is not None:
                raise SweepError(f"a worker failed or died: {_reason(failure)}; {KEPT}") from failure
            yield from future.result()
    finally:
        for future in futures if is_local else ():
            future.cancel()


def _reason(error: BaseException) -> str:
    """Return an error in one line; of the text of a failed job, the last line of its traceback."""
    text = str(error).partition("\n----------------------\nYou can check")[0]
    lines = [" ".join(line.split()) for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__


def run_sweep(
    sweep: Sweep,
    folder: str | Path,
    *,
    workers: int | None = None,
    executor: Any = None,
    progress: bool = False,
) -> SweepData:
    """Solve all cases of a sweep into a folder, and return its data.

    Shards that are there are not solved again, so that the same call continues a sweep that was stopped or
    killed. A failed case does not stop the sweep: it is stored with its result codes and the reason, and its
    unsolved rows are NaN. Results do not depend on the executor, or on how often the sweep was stopped; they
    are equal bit for bit on one kind of CPU.

    Args:
        sweep: description of the sweep.
        folder: folder for its files; it is created if missing.
        workers: number of processes of this machine, each on a core of its own; 1 is this process, with all
            cores, as by default for few shards. With an executor, the number of calls among which the shards
            are divided; by default one for each shard.
        executor: executor with `submit`, as those of concurrent.futures, of Dask
            (`Client(address).get_executor(pure=False)`) and of submitit (`AutoExecutor(folder)`). Workers of
            concurrent.futures and of Dask solve with one thread, jobs of submitit with all their cores.
        progress: show a progress bar.

    Raises:
        SweepError: the sweep is not possible, the folder has another sweep or a shard of another version,
            nothing can be written, or a worker died.
    """
    check_arguments(run_sweep, locals())
    if workers is not None and workers < 1:
        raise SweepError(f"workers is {workers}; allowed is a whole number from 1 on")
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise SweepError(f"executor is {executor!r}; allowed is one with submit, as in concurrent.futures")
    require_pyarrow()
    folder, plan = Path(folder).absolute(), Plan.of(sweep)
    began, date = time.perf_counter(), time.time()
    open_folder(plan, folder)
    missing = [number for number in range(plan.shard_count) if not is_complete(plan, folder, number)]
    present = sweep.case_count - sum(last - first for _, first, last in map(plan.span, missing))
    solved: list[SolvedShard] = []
    bar = tqdm(total=sweep.case_count, initial=present, disable=not progress, unit="case", unit_scale=True)
    try:
        with bar, contextlib.closing(_solved(plan, folder, missing, workers, executor)) as shards:
            for shard in shards if missing else ():
                if shard.content is not None:
                    write_shard(shard_path(folder, shard.number), shard.content)
                    shard.content = None
                solved.append(shard)
                bar.update(shard.cases)
                bar.set_postfix_str(f"{sum(shard.failed for shard in solved)} failed")
    finally:
        facts: dict[str, Any] = {
            "missing_shards": len(missing),
            "solved_cases": sum(shard.cases for shard in solved),
            "seconds": round(time.perf_counter() - began, 3),
        }
        if solved:
            times = [(shard.seconds / shard.cases, shard.cpu_seconds / shard.cases) for shard in solved]
            facts["case_seconds"], facts["case_cpu_seconds"] = np.median(times, axis=0).tolist()
        log_run(
            folder, executor=type(executor).__name__ if executor else "processes", workers=workers, **facts
        )
    # files of killed writes
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder / SHARDS):
            if entry.name.endswith(".tmp") and entry.stat().st_mtime < date:
                os.unlink(entry.path)
    return load_sweep(folder)
