"""Executors of a sweep: processes of this machine, a Dask cluster, and SLURM.

Each gives the solved shards in order of completion, and has few in work at a time, so that memory is bounded.
"""

from __future__ import annotations

import abc
import concurrent.futures
import contextlib
import dataclasses
import itertools
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from knode_cosserat._processes import dask_client, end_with_parent
from knode_cosserat.solvers.run import usable_cores
from knode_cosserat.sweeps.errors import SweepError
from knode_cosserat.sweeps.folder import shard_path
from knode_cosserat.sweeps.shard_file import read_about, write_shard
from knode_cosserat.sweeps.work import Done, ShardJob, Work

#: shards for each process from which processes are started by default: a start takes as long as some shards
SHARDS_EACH = 4
#: seconds between two looks at the jobs of a cluster
POLL = 0.5


class Executor(abc.ABC):
    """Executor of a sweep's shards."""

    @abc.abstractmethod
    def run(self, work: Work, shards: Sequence[int]) -> Iterator[Done]:
        """Solve shards; yield each when it is in the folder.

        Raises:
            SweepError: a worker died, or cannot work; complete shards are kept.
        """

    @property
    @abc.abstractmethod
    def label(self) -> str:
        """Name for the log of runs."""


@dataclasses.dataclass(frozen=True)
class Local(Executor):
    """Processes of this machine, each with a core of its own; one worker is this process, with all cores.

    Attributes:
        workers: number of workers; None: one for each core that this process may use, or this process alone
            for a few shards.
    """

    workers: int | None = None

    @property
    def label(self) -> str:
        """Name for the log of runs."""
        return f"local, {self.workers or 'automatic'} workers"

    def run(self, work: Work, shards: Sequence[int]) -> Iterator[Done]:
        """Solve shards here, or in spawned processes."""
        cores = usable_cores()
        workers = self.workers or (cores if len(shards) >= SHARDS_EACH * cores else 1)
        workers = min(workers, len(shards))
        if workers <= 1:
            return map(work.solve, shards)
        return self._in_processes(dataclasses.replace(work, threads=1), shards, workers)

    def _in_processes(self, work: Work, shards: Sequence[int], workers: int) -> Iterator[Done]:
        # spawned: JAX has threads, and a fork of it deadlocks
        context = multiprocessing.get_context("spawn")
        ranks = context.Queue()
        for rank in range(workers):
            ranks.put(rank)
        pool = concurrent.futures.ProcessPoolExecutor(workers, context, _begin_worker, (ranks, work))
        try:
            yield from _in_window(lambda number: pool.submit(_solve, number), shards, 2 * workers)
        except concurrent.futures.BrokenExecutor:
            raise SweepError(
                "a worker process died, perhaps for want of memory; complete shards are kept, and the same "
                "command goes on where it stopped"
            ) from None
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


def _in_window(submit: Callable[[int], Any], shards: Sequence[int], window: int) -> Iterator[Done]:
    """Yield results of submitted shards, with a bounded number in work."""
    rest, working = iter(shards), set()
    for number in rest:
        working.add(submit(number))
        if len(working) < window:
            continue
        done, working = concurrent.futures.wait(working, return_when=concurrent.futures.FIRST_COMPLETED)
        yield from (future.result() for future in done)
    for future in concurrent.futures.as_completed(working):
        yield future.result()


@dataclasses.dataclass(frozen=True)
class Dask(Executor):
    """Workers of a running Dask cluster. They need not see the folder: this process writes the shards.

    Attributes:
        address: of the scheduler, such as tcp://host:8786.
    """

    address: str

    @property
    def label(self) -> str:
        """Name for the log of runs."""
        return f"dask, {self.address}"

    def run(self, work: Work, shards: Sequence[int]) -> Iterator[Done]:
        """Solve shards on the cluster."""
        folder = Path(str(work.folder))
        client = dask_client(self.address, SweepError)
        from distributed import as_completed

        with client:
            threads = sum(client.nthreads().values())
            # one copy on each worker, not one a shard
            remote = client.scatter(dataclasses.replace(work, folder=None, threads=1), broadcast=True)
            rest = iter(shards)

            def submit(number: int) -> Any:
                return client.submit(Work.solve, remote, number, pure=False)

            begun = [submit(number) for number in itertools.islice(rest, 2 * threads)]
            working = as_completed(begun, loop=client.loop)
            for future in working:
                done = _result(future)
                future.release()
                write_shard(shard_path(folder, done.shard), done.content or b"")
                yield done._replace(content=None)
                following = next(rest, None)
                if following is not None:
                    working.add(submit(following))


def _result(future: Any) -> Done:
    """Return the result of a Dask future; a worker that was killed is an error in one line."""
    from distributed import KilledWorker

    try:
        found = future.result()
    except KilledWorker:
        raise SweepError(
            "a worker of the cluster died, perhaps for want of memory; complete shards are kept, and the "
            "same command goes on where it stopped"
        ) from None
    assert isinstance(found, Done)
    return found


@dataclasses.dataclass(frozen=True)
class Slurm(Executor):
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

    @property
    def label(self) -> str:
        """Name for the log of runs."""
        return f"{self.cluster}, {self.jobs} jobs"

    def run(self, work: Work, shards: Sequence[int]) -> Iterator[Done]:
        """Solve shards in jobs."""
        if self.cluster not in ("slurm", "local", "debug"):
            raise SweepError(f"cluster is {self.cluster!r}; allowed is slurm, local or debug")
        count = min(self.jobs, len(shards))
        parts = [ShardJob(work, tuple(shards[k::count])) for k in range(count)]
        folder = Path(str(work.folder))
        jobs = self._submitted(parts, folder)
        missing, began = list(shards), time.perf_counter()
        while missing:
            # a job may end between the look at the jobs and the look at the folder: look at the jobs first
            states = [self._has_ended(job) for job in jobs]
            for number in [each for each in missing if shard_path(folder, each).exists()]:
                missing.remove(number)
                about = read_about(shard_path(folder, number))
                yield Done(number, about["cases"], about["failed"], time.perf_counter() - began, math.nan)
            if missing and all(states):
                raise SweepError(
                    f"all jobs ended and {len(missing)} shards are missing; see {folder / 'jobs'}; the same "
                    "command goes on where it stopped"
                )
            if missing:
                time.sleep(POLL)

    def _submitted(self, parts: list[ShardJob], folder: Path) -> list[Any]:
        try:
            import submitit
        except ImportError:
            raise ImportError("SLURM needs submitit: pip install 'knode-cosserat[sweep]'") from None
        try:
            executor = submitit.AutoExecutor(folder / "jobs", cluster=self.cluster)
            executor.update_parameters(**self.parameters)
            with executor.batch():
                return [executor.submit(part) for part in parts]
        except Exception as error:  # submitit raises many kinds, also for a missing `sbatch`
            reason = " ".join(str(error).split()) or type(error).__name__
            raise SweepError(f"{self.cluster}: jobs cannot be submitted: {reason}") from None

    def _has_ended(self, job: Any) -> bool:
        """True if a job has ended. Raises `SweepError` for a failed one."""
        # `done` of a job of the kind debug would start the debugger at an error
        if self.cluster != "debug" and not job.done():
            return False
        error = job.exception()
        if error is None:
            return True
        if isinstance(error, SweepError):
            raise error
        reason = next((line for line in reversed(str(error).splitlines()) if line.strip()), "unknown")
        raise SweepError(f"job {job.job_id} failed: {reason.strip()}; complete shards are kept")
