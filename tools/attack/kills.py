"""Kills of processes that write files: the old or the new version is there whole, and nothing is left behind.

Each victim writes the two versions of a file in turn, without end, and is killed at a random time. The
temporary file of the killed write stays at first, because it may belong to a running process; it is made two
hours old here, and the next process that writes into the folder has to remove it.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

from tools.attack.samples import Sample, fingerprint, samples
from tools.attack.table import Row, printed_row

#: longest time between the first write of a victim and its kill (s); half of the kills come as soon as a
#: temporary file is seen, within this time (s)
LONGEST, SEEN = 0.25, 1.0
_OLD = 7200.0


def victim(name: str, folder: Path) -> None:
    """Write the versions of a file in turn, until killed; a line on stdout says that both were written."""
    sample, path = samples()[name], folder / name
    for version in (0, 1):
        sample.write(path, version)
    print("writing", flush=True)
    version = 0
    while True:
        sample.write(path, version)
        version = 1 - version


def started(name: str, folder: Path) -> subprocess.Popen[str]:
    """Start a victim and wait until it writes."""
    command = [sys.executable, "-m", "tools.attack.kills", name, str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    if process.stdout.readline().strip() != "writing":
        process.kill()
        raise RuntimeError(f"the process that writes {name} has not begun")
    return process


def temporary_files(folder: Path) -> list[Path]:
    """Return what unfinished writes left in a folder."""
    return [each for each in folder.iterdir() if each.name.startswith(".") or each.suffix == ".tmp"]


def wait_for_write(folder: Path) -> None:
    """Wait until a temporary file is there: a write is in its midst."""
    until = time.monotonic() + SEEN
    while not temporary_files(folder) and time.monotonic() < until:
        pass


def versions(sample: Sample, path: Path) -> set[str]:
    """Return the fingerprints of both versions of a file, which is removed afterwards."""
    found = set()
    for version in (0, 1):
        sample.write(path, version)
        found.add(fingerprint(sample.read(path)))
    for each in path.parent.iterdir():
        each.unlink()
    return found


def killed_writes(name: str, folder: Path, count: int, seed: int) -> Row:
    """Kill so many writers of a file, and check the file after each."""
    sample, path, chance = samples()[name], folder / name, random.Random(f"{seed} {name}")
    known = versions(sample, path)
    failures: list[str] = []
    unfinished = 0
    for k in range(count):
        process = started(name, folder)
        old = [each for each in temporary_files(folder) if time.time() - each.stat().st_mtime > _OLD / 2]
        if old:
            failures.append(f"kill {k} of {name}: {old[0].name} of an earlier kill was not removed")
        time.sleep(chance.uniform(0.0, LONGEST))
        if k % 2:
            wait_for_write(folder)
        process.send_signal(signal.SIGKILL)
        process.wait()
        try:
            if fingerprint(sample.read(path)) not in known:
                failures.append(f"kill {k} of {name}: the file has neither version")
        except Exception as error:
            failures.append(f"kill {k} of {name}: {type(error).__name__}: {error}")
        for each in temporary_files(folder):
            unfinished += 1
            before = time.time() - _OLD
            os.utime(each, (before, before))
    process = started(name, folder)
    left = [each.name for each in temporary_files(folder) if time.time() - each.stat().st_mtime > _OLD / 2]
    process.kill()
    process.wait()
    if left:
        failures.append(f"{name}: left behind: {', '.join(left)}")
    return Row(f"kills of writers: {name}", count, 0, failures, f"{unfinished} in the midst of a write")


def killed(folder: Path, count: int, seed: int) -> list[Row]:
    """Kill so many writers, of all kinds of files."""
    names, rows = list(samples()), []
    for k, name in enumerate(names):
        own = count // len(names) + (k < count % len(names))
        if own:
            (folder / name).mkdir()
            rows.append(killed_writes(name, folder / name, own, seed))
            printed_row(rows[-1])
    return rows


if __name__ == "__main__":
    victim(sys.argv[1], Path(sys.argv[2]))
