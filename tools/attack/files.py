"""Damaged files through every reader: `make attack`, or `python -m tools.attack [--files N] [--seed N]`.

Each file is a good one with random bytes changed, removed, inserted or repeated. It has to be read, or
refused by an error of the package in one line, within seconds. The table counts what was tried, read,
refused, and what failed; files that failed are kept.
"""

import argparse
import collections
import random
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import knode_cosserat as kc
from knode_cosserat.errors import KnodeCosseratError

#: longest time that a file may take (s)
PATIENCE = 5.0
#: what is written over a place: lengths, numbers and brackets that readers may believe
WORDS = (b"\xff\xff\xff\xff", b"\0\0\0\0", b"nan ", b"1e99", b"-1\n\n", b"[[[[", b"*a: ", b"9999")
DT = 0.05


class Outcome(NamedTuple):
    """What one reader did with its files."""

    name: str
    read: int
    refused: int
    failures: list[str]
    longest: float


def good_files(folder: Path) -> dict[str, Callable[[Path], Any]]:
    """Write a good file of each kind, and return the reader of each by the file's name."""
    robot = kc.load_robot("delrin-tendon-robot")
    motion = kc.simulate(robot, kc.controls.sine(1.0, 10, DT), DT)
    motion.save(folder / "trajectory.nc")
    kc.robots.save_robot(kc.load_robot("delrin-routed-tendon-robot"), folder / "robot.yaml")
    kc.recordings.RecordingConfig.paper_robot().save(folder / "recording.yaml")
    kc.controls.save(folder / "controls.csv", np.full((5, 4), 5.0), DT)
    measured = kc.recordings.Measurements.of(motion)
    tables, bags = ("table.csv", "table.parquet"), ("bag.bag", "bag.mcap", "bag.db3")
    for name in (*tables, *bags):
        measured.save(folder / name)
    config = kc.recordings.RecordingConfig.load(folder / "bag.yaml")
    readers: dict[str, Callable[[Path], Any]] = {
        "trajectory.nc": kc.load_trajectory,
        "robot.yaml": kc.load_robot,
        "recording.yaml": kc.recordings.RecordingConfig.load,
        "controls.csv": lambda path: kc.controls.load(path, DT),
    }
    readers |= dict.fromkeys(tables, lambda path: kc.load_recording(path).sampled(DT))
    return readers | dict.fromkeys(bags, lambda path: kc.load_recording(path, config).sampled(DT))


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
    path = folder / f"damaged{Path(name).suffix}"
    outcomes: collections.Counter[str] = collections.Counter()
    failures, longest = [], 0.0
    for k in range(count):
        path.write_bytes(damaged(content, chance))
        began, failure = time.monotonic(), ""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                reader(path)
            outcomes["read"] += 1
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


def main() -> None:
    """Attack every reader, and print the table; the exit status is 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="attack-"))
    readers = good_files(folder)
    failures: list[str] = []
    print("| file | tried | read | refused in one line | failed | longest (s) |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, reader in readers.items():
        count = -(-given.files // len(readers))
        found = attacked(name, reader, folder, count, given.seed)
        failures += found.failures
        cells = name, count, found.read, found.refused, len(found.failures), f"{found.longest:.2f}"
        print(f"| {' | '.join(map(str, cells))} |", flush=True)
    print(f"largest memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024} MB")
    for each in failures:
        print(each)
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
