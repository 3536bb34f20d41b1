"""Work of one worker: solve a shard, and write it or return its content."""

from __future__ import annotations

import dataclasses
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from knode_cosserat.sweeps.errors import SweepError
from knode_cosserat.sweeps.folder import is_complete, shard_path
from knode_cosserat.sweeps.manifest import machine, made_by
from knode_cosserat.sweeps.plan import Plan
from knode_cosserat.sweeps.shard_file import shard_bytes, write_shard
from knode_cosserat.sweeps.solve import Solver


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
    """A plan, and what workers do with a shard of it.

    Attributes:
        plan: the plan.
        folder: the sweep's folder, for workers to write to; None: they return the content.
        made_by: versions of the process that started the sweep; a worker with others refuses to work.
        threads: threads of a worker; None: one for each core that it may use.
    """

    plan: Plan
    folder: str | None
    made_by: dict[str, str]
    threads: int | None = None

    def solve(self, number: int) -> Done:
        """Return a solved shard; write it if the worker is to write."""
        own = made_by()
        for name in {**own, **self.made_by}:
            if own.get(name) != self.made_by.get(name):
                raise SweepError(
                    f"the workers have another {name} than this process: {own.get(name)}, not "
                    f"{self.made_by.get(name)}"
                )
        began, cpu = time.perf_counter(), time.process_time()
        columns = self._solver().shard(number)
        failed = int(np.count_nonzero(np.any(columns["result"] < 0, axis=1)))
        content = shard_bytes(columns, self._about(number, len(columns["case"]), failed))
        if self.folder is not None:
            write_shard(shard_path(Path(self.folder), number), content)
        seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
        kept = content if self.folder is None else None
        return Done(number, len(columns["case"]), failed, seconds, cpu, kept)

    def _about(self, number: int, cases: int, failed: int) -> dict[str, object]:
        """Return the metadata of a shard."""
        return {
            "sweep": self.plan.identity, "shard": number, "cases": cases, "failed": failed,
            "made_by": self.made_by, "machine": machine(),
        }  # fmt: skip

    def _solver(self) -> Solver:
        with _LOCK:
            if _SOLVERS.get("identity") != self.plan.identity:
                _SOLVERS.update(identity=self.plan.identity, solver=Solver(self.plan, self.threads))
            solver = _SOLVERS["solver"]
            assert isinstance(solver, Solver)
            return solver


#: the last solver of this process: it knows the programs that are compiled
_SOLVERS: dict[str, object] = {}
_LOCK = threading.Lock()


@dataclasses.dataclass(eq=False)
class ShardJob:
    """Job of a cluster: it solves several shards, and writes each when it is solved.

    A job that is interrupted and queued again goes on where it stopped.
    """

    work: Work
    shards: tuple[int, ...]

    def __call__(self) -> int:
        """Solve the shards that are not there, and return how many that were."""
        assert self.work.folder is not None
        folder, count = Path(self.work.folder), 0
        for number in self.shards:
            if not is_complete(self.work.plan, folder, number):
                self.work.solve(number)
                count += 1
        return count

    def checkpoint(self) -> object:
        """Return this job for submission again, as submitit asks of an interrupted one."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)
