"""Runs of sweeps: missing shards are solved by processes of this machine, a Dask cluster, or SLURM."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import itertools
import multiprocessing
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from knode_cosserat._arguments import check_arguments
from knode_cosserat._processes import dask_client, end_with_parent
from knode_cosserat.solvers.run import usable_cores
from knode_cosserat.sweeps._data import SweepData, load_sweep
from knode_cosserat.sweeps._description import Sweep, SweepError
from knode_cosserat.sweeps._folder import (
    SHARDS,
    is_complete,
    log_run,
    machine,
    made_by,
    open_folder,
    shard_path,
)
from knode_cosserat.sweeps._plan import Plan
from knode_cosserat.sweeps._shards import require_pyarrow, shard_bytes, write_shard
from knode_cosserat.sweeps._solve import solve_shard

#: shards for each process from which processes are started by default: a start takes as long as some shards
SHARDS_EACH = 4
#: seconds between two looks at the jobs of a cluster
POLL = 0.5
DIED = (
    "died, perhaps for want of memory; complete shards are kept, and the same command goes on where it "
    "stopped"
)


class Done(NamedTuple):
    """A solved shard."""

    shard: int
    cases: int
    failed: int
    #: time, and time of all cores, in s
    seconds: float
    cpu_seconds: float
    #: content of its file if the worker was not to write it
    content: bytes | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Work:
    """A plan, and the work of a worker with a shard of it.

    Attributes:
        plan: the plan.
        folder: the sweep's folder, for workers to write to; None: they return the content.
        made_by: versions of the process that started the sweep; a worker with others refuses to work.
        threads: threads of a worker; None: one for each core that it may use.
    """

    plan: Plan
    folder: Path | None
    made_by: dict[str, str]
    threads: int | None = None

    def solve(self, number: int) -> Done:
        """Return a solved shard; write it if the worker is to write."""
        local = made_by()
        for name in {**local, **self.made_by}:
            if local.get(name) != self.made_by.get(name):
                raise SweepError(
                    f"the workers have another {name} than this process: {local.get(name)}, not "
                    f"{self.made_by.get(name)}"
                )
        began, cpu = time.perf_counter(), time.process_time()
        columns = solve_shard(self.plan, number, self.threads)
        cases, failed = len(columns["case"]), int(np.count_nonzero(np.any(columns["result"] < 0, axis=1)))
        about = {"sweep": self.plan.identity, "shard": number, "cases": cases, "failed": failed}
        content = shard_bytes(columns, {**about, "made_by": self.made_by, "machine": machine()})
        if self.folder is not None:
            write_shard(shard_path(self.folder, number), content)
        seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
        return Done(number, cases, failed, seconds, cpu, content if self.folder is None else None)


@dataclasses.dataclass(frozen=True)
class Local:
    """Processes of this machine, each with a core of its own; one worker is this process, with all cores.

    Attributes:
        workers: number of workers; None: one for each core that this process may use, or this process alone
            for a few shards.
    """

    workers: int | None = None

    def run(self, work: Work, shards: Sequence[int]) -> Iterator[Done]:
        """Solve shards here, or in spawned processes."""
        cores = usable_cores()
        workers = self.workers or (cores if len(shards) >= SHARDS_EACH * cores else 1)
        if (workers := min(workers, len(shards))) <= 1:
            yield from map(work.solve, shards)
            return
        # spawned: JAX has threads, and a fork of it deadlocks
        context = multiprocessing.get_context("spawn")
        ranks, work = context.Queue(), dataclasses.replace(work, threads=1)
        for rank in range(workers):
            ranks.put(rank)
        pool = concurrent.futures.ProcessPoolExecutor(workers, context, _begin_worker, (ranks, work))
        try:
            futures = [pool.submit(_solve, number) for number in shards]
            for future in concurrent.futures.as_completed(futures):
                yield future.result()
        except concurrent.futures.BrokenExecutor:
            raise SweepError(f"a worker process {DIED}") from None
        finally:
            pool.shutdown(cancel_futures=True)


#: the work of this process, if it is a worker
_WORK: list[Work] = []


def _begin_worker(ranks: Any, work: Work) -> None:
    """Prepare a worker process: end with its parent, and keep to one core."""
    end_with_parent()
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, {cores[ranks.get() % len(cores)]})
    _WORK[:] = [work]


def _solve(number: int) -> Done:
    return _WORK[0].solve(number)


@dataclasses.dataclass(frozen=True)
class Dask:
    """Workers of a running Dask cluster. They need not see the folder: this process writes the shards.

    Attributes:
        address: of the scheduler, such as tcp://host:8786.
    """

    address: str

    def run(self, work: Work, shards: Sequence[int]) -> Iterator[Done]:
        """Solve shards on the cluster; twice as many as it has threads are in work at a time."""
        assert work.folder is not None
        folder, rest = work.folder, iter(shards)
        client = dask_client(self.address, SweepError)
        from distributed import KilledWorker, as_completed

        with client:
            # one copy on each worker, not one a shard
            remote = client.scatter(dataclasses.replace(work, folder=None, threads=1), broadcast=True)

            def submit(count: int) -> list[Any]:
                numbers = itertools.islice(rest, count)
                return [client.submit(Work.solve, remote, number, pure=False) for number in numbers]

            working = as_completed(submit(2 * sum(client.nthreads().values())), loop=client.loop)
            for future in working:
                try:
                    done: Done = future.result()
                except KilledWorker:
                    raise SweepError(f"a worker of the cluster {DIED}") from None
                future.release()
                write_shard(shard_path(folder, done.shard), done.content or b"")
                yield done._replace(content=None)
                working.update(submit(1))


@dataclasses.dataclass(frozen=True)
class Slurm:
    """Jobs of SLURM, by submitit. All jobs must see the folder of the sweep: each writes its shards.

    The jobs do not need this process: if it ends, they go on, and the same call waits for the rest.

    Attributes:
        jobs: number of jobs, among which the shards are divided.
        cluster: "slurm"; "local" for processes of this machine and "debug" for this process, to try it.
        parameters: of submitit, such as {"timeout_min": 60, "cpus_per_task": 8, "slurm_partition": "cpu"}.
    """

    jobs: int = 1
    cluster: str = "slurm"
    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def run(self, work: Work, shards: Sequence[int]) -> Iterator[Done]:
        """Solve shards in jobs; yield those of a job when it has ended."""
        if self.cluster not in ("slurm", "local", "debug"):
            raise SweepError(f"cluster is {self.cluster!r}; allowed is slurm, local or debug")
        try:
            import submitit
        except ImportError:
            raise ImportError("SLURM needs submitit: pip install 'knode-cosserat[sweep]'") from None
        assert work.folder is not None
        count = min(self.jobs, len(shards))
        try:
            executor = submitit.AutoExecutor(work.folder / "jobs", cluster=self.cluster)
            executor.update_parameters(**self.parameters)
            with executor.batch():
                jobs = [executor.submit(ShardJob(work, tuple(shards[k::count]))) for k in range(count)]
        except Exception as error:  # submitit raises many kinds, also for a missing `sbatch`
            reason = " ".join(str(error).split()) or type(error).__name__
            raise SweepError(f"{self.cluster}: jobs cannot be submitted: {reason}") from None
        # `done` of a job of the kind debug would start the debugger at an error
        is_debug = self.cluster == "debug"
        for job in jobs if is_debug else submitit.helpers.as_completed(jobs, poll_frequency=POLL):
            failure = job.exception()
            if isinstance(failure, SweepError):
                raise failure
            if failure is not None:
                lines = [line.strip() for line in str(failure).splitlines() if line.strip()]
                reason = lines[-1] if lines else "unknown"
                raise SweepError(f"job {job.job_id} failed: {reason}; complete shards are kept")
            yield from job.result()


@dataclasses.dataclass(eq=False)
class ShardJob:
    """Job of a cluster: it solves several shards, and writes each when it is solved.

    A job that is interrupted and queued again goes on where it stopped.
    """

    work: Work
    shards: tuple[int, ...]

    def __call__(self) -> list[Done]:
        """Solve the shards that are not there, and return them."""
        assert self.work.folder is not None
        folder = self.work.folder
        missing = (number for number in self.shards if not is_complete(self.work.plan, folder, number))
        return [self.work.solve(number) for number in missing]

    def checkpoint(self) -> object:
        """Return this job for submission again, as submitit asks of an interrupted one."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def run_sweep(
    sweep: Sweep, folder: str | Path, *, executor: Local | Dask | Slurm | None = None, progress: bool = False
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
    check_arguments(run_sweep, locals())
    require_pyarrow()
    folder, executor = Path(folder).absolute(), executor or Local()
    plan, began, date = Plan.of(sweep), time.perf_counter(), time.time()
    open_folder(plan, folder)
    missing = [number for number in range(plan.shard_count) if not is_complete(plan, folder, number)]
    present = sweep.case_count - sum(last - first for _, first, last in map(plan.span, missing))
    solved: list[Done] = []
    bar = tqdm(
        total=sweep.case_count, initial=present, disable=not progress, unit="case", unit_scale=True
    )  # fmt: skip
    try:
        for done in executor.run(Work(plan, folder, made_by()), missing) if missing else ():
            solved.append(done)
            bar.update(done.cases)
            bar.set_postfix_str(f"{sum(shard.failed for shard in solved)} failed")
    finally:
        bar.close()
        facts: dict[str, Any] = {
            "missing_shards": len(missing), "solved_cases": sum(done.cases for done in solved),
            "seconds": round(time.perf_counter() - began, 3),
        }  # fmt: skip
        if solved:
            times = [(done.seconds / done.cases, done.cpu_seconds / done.cases) for done in solved]
            facts["case_seconds"], facts["case_cpu_seconds"] = np.median(times, axis=0).tolist()
        log_run(folder, executor=repr(executor), **facts)
    # files of killed writes
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder / SHARDS):
            if entry.name.endswith(".tmp") and entry.stat().st_mtime < date:
                os.unlink(entry.path)
    return load_sweep(folder)
