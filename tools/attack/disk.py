"""Faults of the disk while files are written: one line says so, the old file stays, and nothing else is left.

Three kinds: the disk is full after a random number of bytes (the limit of a file's size stands for it), the
synchronisation fails, and the rename fails. Each kind of file is written in a process of its own, because a
library may crash the interpreter there.
"""

from __future__ import annotations

import errno
import json
import os
import random
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from knode_cosserat.errors import KnodeCosseratError
from tools.attack.samples import samples
from tools.attack.table import Row, printed_row


@contextmanager
def full(size: int) -> Iterator[None]:
    """Let no file become larger than so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def failing(name: str) -> Iterator[None]:
    """Let a function of `os` fail as a broken disk does."""
    before = getattr(os, name)

    def fails(*given: Any, **options: Any) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    setattr(os, name, fails)
    try:
        yield
    finally:
        setattr(os, name, before)


def _content(folder: Path) -> dict[str, bytes]:
    return {each.name: each.read_bytes() for each in sorted(folder.iterdir())}


def _fault(kind: str, size: int) -> Any:
    return full(size) if kind == "full" else failing({"sync": "fsync", "rename": "replace"}[kind])


def tried(write: Callable[[Path, int], None], path: Path, kind: str, size: int) -> tuple[str, bool]:
    """Write a file while the disk fails; return the failure, or "", and True if it was refused."""
    before, refused, failure = _content(path.parent), False, ""
    try:
        with _fault(kind, size):
            write(path, 1)
    except (KnodeCosseratError, OSError) as error:
        refused = True
        failure = "more than one line" if "\n" in str(error) else ""
    except Exception as error:
        failure = f"{type(error).__name__}: {error}"
    after = _content(path.parent)
    if refused and after != before:
        changed = [name for name in before.keys() | after.keys() if before.get(name) != after.get(name)]
        failure = f"changed or left behind: {', '.join(sorted(changed))}"
    elif not refused and not failure and kind != "full":
        failure = "the write did not fail"
    return failure, refused


def attempts(name: str, folder: Path, count: int, seed: int) -> None:
    """Let so many writes of a file fail, and print the outcomes."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    sample, path, chance = samples()[name], folder / name, random.Random(f"{seed} {name}")
    sample.write(path, 1)
    sample.write(path, 0)
    size = path.stat().st_size
    outcomes = []
    for k in range(count):
        kind = ("full", "sync", "full", "rename")[k % 4]
        limit = chance.randrange(size)
        failure, refused = tried(sample.write, path, kind, limit)
        where = f"{name}, {kind}, {limit} bytes"
        outcomes.append({"failure": f"{where}: {failure}" if failure else "", "refused": refused})
        sample.write(path, 0)
    sample.read(path)
    print(json.dumps(outcomes))


def faults(folder: Path, count: int, seed: int, names: Sequence[str] = ()) -> list[Row]:
    """Let so many writes fail, of all kinds of files or of some."""
    names, rows = names or list(samples()), []
    for k, name in enumerate(names):
        own = count // len(names) + (k < count % len(names))
        if not own:
            continue
        (folder / name).mkdir()
        command = [sys.executable, "-m", "tools.attack.disk", name, str(folder / name), str(own), str(seed)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            last = (done.stderr.strip().splitlines() or [""])[-1]
            failures, refused = [f"{name}: the process ended with {done.returncode}: {last}"] * own, 0
        else:
            outcomes = json.loads(done.stdout.strip().splitlines()[-1])
            failures = [each["failure"] for each in outcomes if each["failure"]]
            refused = sum(each["refused"] for each in outcomes)
        rows.append(Row(f"disk faults: {name}", own, refused, failures))
        printed_row(rows[-1])
    return rows


if __name__ == "__main__":
    attempts(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
