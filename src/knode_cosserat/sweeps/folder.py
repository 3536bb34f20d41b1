"""Folder of a sweep: the manifest with its provenance, the shards, and a log of runs.

    DIR/sweep.json          description, robots, columns, versions; written once, before the first shard
    DIR/shards/000012.parquet
    DIR/log.jsonl           one line for each run: date, machine, times

Manifest and shards have no dates, so that a sweep that was stopped and continued equals one that was
not.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import platform
import time
from pathlib import Path
from typing import Any

from knode_cosserat.sweeps.errors import SweepError
from knode_cosserat.sweeps.manifest import (
    MANIFEST,
    machine,
    manifest_of,
    read_manifest,
    require_same,
    write_manifest,
)
from knode_cosserat.sweeps.plan import Plan
from knode_cosserat.sweeps.shard_file import read_shard

#: names within the folder
SHARDS, LOG = "shards", "log.jsonl"


def shard_path(folder: Path, number: int) -> Path:
    """Return the path of a shard."""
    return folder / SHARDS / f"{number:06d}.parquet"


def shard_numbers(folder: Path, count: int) -> tuple[int, ...]:
    """Return the numbers of the existing shards, of those below a count."""
    stems = (path.stem for path in (folder / SHARDS).glob("*.parquet"))
    numbers = (int(stem) for stem in stems if stem.isdecimal() and len(stem) < 16)
    return tuple(sorted(k for k in numbers if k < count and shard_path(folder, k).exists()))


def open_folder(plan: Plan, folder: Path) -> dict[str, Any]:
    """Return the manifest in a folder; it is written if the folder is new.

    Raises:
        SweepError: the folder has another sweep, or one begun with other versions; or cannot be written.
    """
    path = folder / MANIFEST
    manifest = json.loads(json.dumps(manifest_of(plan)))
    if path.exists():
        require_same(manifest, read_manifest(folder), folder)
        return read_manifest(folder)
    if (folder / SHARDS).is_dir() and any((folder / SHARDS).glob("*.parquet")):
        raise SweepError(f"{folder}: there are shards without their {MANIFEST}; allowed is another folder")
    try:
        (folder / SHARDS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SweepError(f"{folder}: cannot be written: {error.strerror or error}") from None
    write_manifest(folder, manifest)
    return dict(manifest)


def is_complete(plan: Plan, folder: Path, number: int) -> bool:
    """True if a shard is there and undamaged; a damaged one is to be computed again.

    Raises:
        SweepError: the shard has another version, or belongs to another sweep.
    """
    path = shard_path(folder, number)
    if not path.exists():
        return False
    try:
        about = read_shard(path).about
    except SweepError as error:
        if ": damaged: " in str(error):
            return False
        raise
    if about.get("sweep") != plan.identity or about.get("shard") != number:
        raise SweepError(f"{path}: the shard belongs to another sweep; allowed is another folder")
    return True


def log_run(folder: Path, **facts: Any) -> None:
    """Add a line to the log of runs; a full disk does not stop the sweep for it."""
    date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    line = json.dumps({"date": date, "host": platform.node(), **machine(), **facts})
    with contextlib.suppress(OSError), (folder / LOG).open("a", encoding="utf-8") as file:
        file.write(line + "\n")


def remove_temporaries(folder: Path, before: float) -> None:
    """Remove files of killed writes from before a time (s since the epoch)."""
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder / SHARDS):
            if entry.name.endswith(".tmp") and entry.stat().st_mtime < before:
                os.unlink(entry.path)


def now() -> float:
    """Return the time (s since the epoch)."""
    return time.time()
