"""Damaged files through every reader.

Each file is a good one with random bytes changed, removed, inserted or repeated. It has to be read, or
refused by an error of the package in one line, within seconds. Kinds with checksums have to be read as they
were written, or refused. Files that failed are kept.
"""

from __future__ import annotations

import collections
import random
import shutil
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from knode_cosserat.errors import KnodeCosseratError
from tools.attack.samples import fingerprint, samples

#: longest time that a file may take (s)
PATIENCE = 5.0
#: what is written over a place: lengths, numbers and brackets that readers may believe
WORDS = (b"\xff\xff\xff\xff", b"\0\0\0\0", b"nan ", b"1e99", b"-1\n\n", b"[[[[", b"*a: ", b"9999")


#: kinds with a checksum of their numbers
CHECKSUMMED = (
    "trajectory.nc",
    "model.model",
    "member.checkpoint",
    "shard.parquet",
    "sweep.json",
)


class Outcome(NamedTuple):
    """What one reader did with its files."""

    name: str
    read: int
    refused: int
    failures: list[str]
    longest: float


def good_files(folder: Path) -> dict[str, Callable[[Path], Any]]:
    """Write a good file of each kind that has a reader, and return the readers by the files' names."""
    readers = {}
    for name, sample in samples().items():
        if name != "figure.png":
            sample.write(folder / name, 0)
            sample.read(folder / name)
            readers[name] = sample.read
    return readers


def damaged(content: bytes, chance: random.Random) -> bytes:
    """Return a content with some random damage."""
    found = bytearray(content)
    for _ in range(chance.choice([1, 1, 2, 5, 20])):
        place, other = chance.randrange(max(1, len(found))), chance.randrange(max(1, len(found)))
        kind = chance.randrange(6)
        if kind == 0 and found:
            found[place % len(found)] ^= 1 << chance.randrange(8)
        elif kind == 1:
            del found[place : place + chance.randrange(1, 64)]
        elif kind == 2:
            found[place:place] = bytes(chance.randrange(256) for _ in range(chance.randrange(1, 16)))
        elif kind == 3:
            found[place : place + 16] = found[other : other + 16]
        elif kind == 4:
            found[place : place + 4] = chance.choice(WORDS)
        else:
            found = found[: max(1, place)]
    return bytes(found)


def attacked(name: str, reader: Callable[[Path], Any], folder: Path, count: int, seed: int) -> Outcome:
    """Return what a reader does with so many damaged files; those that fail are kept in the folder."""
    content, chance = (folder / name).read_bytes(), random.Random(f"{seed} {name}")
    path = folder / "damaged" / name
    path.parent.mkdir(exist_ok=True)
    beside = (folder / name).with_suffix(".yaml")
    if beside.exists() and beside.name != name:
        shutil.copy(beside, path.parent)
    known = fingerprint(reader(folder / name)) if name in CHECKSUMMED else None
    outcomes: collections.Counter[str] = collections.Counter()
    failures, longest = [], 0.0
    for k in range(count):
        path.write_bytes(damaged(content, chance))
        began, failure = time.monotonic(), ""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = reader(path)
            outcomes["read"] += 1
            if known is not None and fingerprint(found) != known:
                failure = "read with other numbers"
        except KnodeCosseratError as error:
            outcomes["refused"] += 1
            failure = "more than one line" if "\n" in str(error) else ""
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            failure = f"{type(error).__name__} in {Path(last.filename).name}, line {last.lineno}"
        taken = time.monotonic() - began
        longest = max(longest, taken)
        failure = failure or (f"{taken:.1f} s" if taken > PATIENCE else "")
        if failure:
            kept = folder / f"failed-{k}-{name}"
            kept.write_bytes(path.read_bytes())
            failures.append(f"{kept}: {failure}")
    return Outcome(name, outcomes["read"], outcomes["refused"], failures, longest)
