"""Runner of interruptible jobs: each result is stored when it is complete, and not computed again.

A job is a function of plain settings. Its result is written atomically under its key to OUT/jobs, with a mark
of everything that it depends on: the job, its settings, and the versions of code and packages. Another run in
the same folder reuses results with the right mark and computes the others, here or on a Dask cluster.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import multiprocessing
import os
import platform
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

import knode_cosserat
from knode_cosserat._files.json_text import json_checksum, parse_json
from knode_cosserat._files.reading import read_bytes
from knode_cosserat._files.writing import package_version, replacing
from knode_cosserat._processes import dask_client, end_with_parent
from knode_cosserat.errors import KnodeCosseratError

#: packages whose versions may change a figure
PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "equinox", "optax")
#: largest record of a job that is read (bytes); another one is computed again
LARGEST_RECORD = 100_000_000
#: cores for each process, if it is not said how many; measured on two cores: 44 s in one process, 68 s in two
CORES = 4


class StudyError(KnodeCosseratError, ValueError):
    """Error for a study that cannot be run, or that may succeed when run again; the message is one line."""

    code = "study"


class Product(NamedTuple):
    """Result of a job: facts (plain JSON values), and files by their paths within the study's folder."""

    facts: dict[str, Any]
    files: dict[str, bytes]


def file_bytes(name: str, write: Callable[[Path], Any]) -> bytes:
    """Return the content of a file of this name that a function writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()


@dataclasses.dataclass(frozen=True)
class Job:
    """Job: a key that is a valid file name, a function of a module, and its settings (plain JSON values)."""

    key: str
    work: Callable[[Any], Product]
    settings: Mapping[str, Any]


def run(
    jobs: Sequence[Job],
    out: Path,
    *,
    workers: int | None = None,
    dask: str | None = None,
    progress: bool = False,
) -> dict[str, dict[str, Any]]:
    """Run all jobs without a stored result and return the facts of all jobs by key, in their order.

    Args:
        jobs: independent jobs in any order.
        out: the study's folder; it is created if missing.
        workers: processes on this machine; 1: this one. By default one for every four cores: each has to
            compile its own programs, and a job keeps more than one core busy.
        dask: the address of a scheduler, to run the jobs on its workers instead.
        progress: show a progress bar.

    Raises:
        StudyError: the cluster does not answer, its workers run other code, or a process died.
    """
    folder = out / "jobs"
    folder.mkdir(parents=True, exist_ok=True)
    kept = {job.key: _kept(job, out) for job in jobs}
    pending = [job for job in jobs if kept[job.key] is None]
    with tqdm(total=len(jobs), initial=len(jobs) - len(pending), disable=not progress, unit="job") as bar:
        for job, done in _ran(pending, workers or max(1, _cores() // CORES), dask):
            _require_same_code(done.made_by)
            kept[job.key] = _keep(job, done, out)
            bar.update()
            bar.set_postfix_str(job.key)
    return {key: facts for key, facts in kept.items() if facts is not None}


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# stored results


@functools.cache
def made_by() -> dict[str, str]:
    """Return the versions of packages and a checksum of the files of the package and of the studies."""
    digest = hashlib.sha256()
    for folder in (Path(knode_cosserat.__file__).parent, Path(__file__).parent):
        for file in sorted(folder.rglob("*")):
            if file.suffix in (".py", ".yaml"):
                digest.update(file.relative_to(folder).as_posix().encode() + b"\0" + file.read_bytes())
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    own = {"knode-cosserat": package_version(), "code": digest.hexdigest()[:16]}
    return {**own, "python": platform.python_version(), **versions}


def _mark(job: Job) -> str:
    named = f"{job.work.__module__}.{job.work.__qualname__}"
    return json_checksum([job.key, named, job.settings, made_by()])


def _kept(job: Job, out: Path) -> dict[str, Any] | None:
    """Return the stored result of a job if it is complete and its mark is current, else None."""
    try:
        record = parse_json(read_bytes(out / "jobs" / f"{job.key}.json", LARGEST_RECORD))
        if record["mark"] != _mark(job):
            return None
        for name, checksum in record["files"].items():
            if _checksum((out / name).read_bytes()) != checksum:
                return None
        return dict(record["facts"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None  # missing, or not written by this runner


def _keep(job: Job, done: _Done, out: Path) -> dict[str, Any]:
    facts, files = done.product
    for name, content in files.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        with replacing(out / name) as temporary:
            temporary.write_bytes(content)
    record = {
        "mark": _mark(job),
        "made_by": done.made_by,
        "seconds": round(done.seconds, 3),
        "settings": job.settings,
        "files": {name: _checksum(content) for name, content in files.items()},
        "facts": facts,
    }
    # the last: whoever finds it finds the files
    with replacing(out / "jobs" / f"{job.key}.json") as temporary:
        temporary.write_text(json.dumps(record, indent=1, allow_nan=False), encoding="utf-8")
    # as another run will read it, so that both go on from the same
    return dict(json.loads(json.dumps(facts)))


def _checksum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


# where jobs are run


class _Done(NamedTuple):
    product: Product
    seconds: float
    made_by: dict[str, str]


def _do(work: Callable[[Any], Product], settings: Mapping[str, Any]) -> _Done:
    began = time.perf_counter()
    product = work(settings)
    return _Done(product, time.perf_counter() - began, made_by())


def _require_same_code(other: dict[str, str]) -> None:
    own = made_by()
    for name in {**own, **other}:
        if own.get(name) != other.get(name):
            raise StudyError(
                f"the workers run another {name} than this process: {other.get(name)}, not {own.get(name)}"
            )


def _ran(jobs: Sequence[Job], workers: int, dask: str | None) -> Iterator[tuple[Job, _Done]]:
    """Return an iterator of the jobs in order of completion."""
    if not jobs:
        return iter(())
    if dask is not None:
        return _on_dask(jobs, dask)
    if min(workers, len(jobs)) == 1:
        return ((job, _do(job.work, job.settings)) for job in jobs)
    return _in_processes(jobs, min(workers, len(jobs)))


def _in_processes(jobs: Sequence[Job], workers: int) -> Iterator[tuple[Job, _Done]]:
    # spawned: JAX has threads, and a fork of it deadlocks
    pool = concurrent.futures.ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), initializer=end_with_parent
    )
    try:
        futures = {pool.submit(_do, job.work, job.settings): job for job in jobs}
        for future in concurrent.futures.as_completed(futures):
            try:
                yield futures[future], future.result()
            except concurrent.futures.BrokenExecutor:
                raise StudyError(
                    "a process that ran a job died, perhaps for want of memory; "
                    "the same command goes on where it stopped"
                ) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _on_dask(jobs: Sequence[Job], address: str) -> Iterator[tuple[Job, _Done]]:
    client = dask_client(address, StudyError)
    from distributed import as_completed

    with client:
        futures = {client.submit(_do, job.work, job.settings, pure=False): job for job in jobs}
        for future in as_completed(futures, loop=client.loop):
            yield futures[future], future.result()
