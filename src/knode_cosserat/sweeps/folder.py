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
import functools
import hashlib
import importlib.metadata
import json
import os
import platform
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from knode_cosserat._files import package_version, replacing
from knode_cosserat._jax import machine_name
from knode_cosserat._yaml import shown
from knode_cosserat.rods.parameters import Parameter
from knode_cosserat.rods.paths import parameter_at
from knode_cosserat.sweeps.columns import columns_of
from knode_cosserat.sweeps.errors import SweepError
from knode_cosserat.sweeps.plan import Plan, control_titles, robot_text
from knode_cosserat.sweeps.shard_file import VERSION, read_shard

#: folder of this package
ROOT = Path(__file__).parents[1]
#: names within the folder
MANIFEST, SHARDS, LOG = "sweep.json", "shards", "log.jsonl"
FORMAT = "knode-cosserat sweep"
#: packages whose versions may change a result in its last bits
PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "equinox", "pyarrow")
#: parts of this package that results depend on
_SOURCES = ("rods", "solvers", "learning", "identification", "sweeps")


def shard_path(folder: Path, number: int) -> Path:
    """Return the path of a shard."""
    return folder / SHARDS / f"{number:06d}.parquet"


@functools.cache
def made_by() -> dict[str, str]:
    """Return the versions of Python and packages, and a checksum of the code that results depend on."""
    files = [*ROOT.glob("*.py"), *(file for name in _SOURCES for file in (ROOT / name).rglob("*.py"))]
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(file.relative_to(ROOT).as_posix().encode() + b"\0" + file.read_bytes())
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    own = {"knode-cosserat": package_version(), "code": digest.hexdigest()[:16]}
    return {**own, "python": platform.python_version(), **versions}


def machine() -> dict[str, str]:
    """Return the machine's kind and a short name of its CPU model, which results depend on in last bits."""
    return {"system": platform.system(), "machine": platform.machine(), "cpu": machine_name()}


def git_commit() -> str | None:
    """Return the commit of a checkout that the package is run from; None for an installed package."""
    for parent in ROOT.parents:
        head = parent / ".git" / "HEAD"
        if not head.is_file():
            continue
        with contextlib.suppress(OSError):
            text = head.read_text().strip()
            name = text.removeprefix("ref: ")
            if name == text:
                return text
            reference = parent / ".git" / name
            if reference.is_file():
                return reference.read_text().strip()
            packed = (parent / ".git" / "packed-refs").read_text().splitlines()
            return next((line.split()[0] for line in packed if line.endswith(f" {name}")), None)
        return None
    return None


def manifest_of(plan: Plan) -> dict[str, Any]:
    """Return the manifest of a plan, as plain data."""
    sweep = plan.sweep
    first = plan.systems[0]
    stated: dict[str, Parameter | None] = {name: parameter_at(first.nominal, name) for name in sweep.vary}
    units = {name: each.unit for name, each in stated.items() if each}
    return {
        "format": FORMAT,
        "version": VERSION,
        "identity": plan.identity,
        "sweep": sweep.described(),
        "cases": sweep.case_count,
        "shards": plan.shard_count,
        "shard_cases": plan.shard_cases,
        "robots": [
            {
                "label": each.label, "text": robot_text(system), "controls": control_titles(system),
                "columns": {name: col.described() for name, col in columns_of(system, sweep, units).items()},
            }
            for each, system in zip(sweep.robots, plan.systems, strict=True)
        ],
        "made_by": made_by(),
        "git": git_commit(),
        "machine": machine(),
    }  # fmt: skip


def open_folder(plan: Plan, folder: Path) -> dict[str, Any]:
    """Return the manifest in a folder; it is written if the folder is new.

    Raises:
        SweepError: the folder has another sweep, or one begun with other versions; or cannot be written.
    """
    path = folder / MANIFEST
    manifest = json.loads(json.dumps(manifest_of(plan)))
    if path.exists():
        _require_same(manifest, read_manifest(folder), folder)
        return read_manifest(folder)
    if (folder / SHARDS).is_dir() and any((folder / SHARDS).glob("*.parquet")):
        raise SweepError(f"{folder}: there are shards without their {MANIFEST}; allowed is another folder")
    try:
        (folder / SHARDS).mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    except OSError as error:
        raise SweepError(f"{path}: cannot be written: {error.strerror or error}") from None
    return dict(manifest)


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a sweep's folder. Raises `SweepError`."""
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SweepError(f"{folder}: no sweep is here: there is no {MANIFEST}") from None
    except OSError as error:
        raise SweepError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError:
        raise SweepError(f"{path}: damaged: not JSON") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise SweepError(f"{path}: not the manifest of a sweep")
    if manifest.get("version") != VERSION:
        raise SweepError(
            f"{path}: the sweep has the version {shown(manifest.get('version'))}; allowed is {VERSION}, "
            "which this version of the package reads and writes. Nothing was changed"
        )
    needed = {"identity": str, "sweep": dict, "cases": int, "shards": int, "shard_cases": int, "robots": list}
    if not all(isinstance(manifest.get(key), kind) for key, kind in needed.items()) or not manifest["robots"]:
        raise SweepError(f"{path}: damaged: allowed are the keys {', '.join(needed)}")
    return manifest


def _require_same(own: Mapping[str, Any], other: Mapping[str, Any], folder: Path) -> None:
    """Raise `SweepError` if a folder has another sweep, or results may differ from its shards."""
    if own["identity"] != other["identity"]:
        changed = [key for key, each in own["sweep"].items() if other["sweep"].get(key) != each]
        what = (
            f"its {changed[0]} is {shown(other['sweep'].get(changed[0]))}"
            if changed
            else "a robot or a file of controls was changed"
        )
        raise SweepError(
            f"{folder}: another sweep is here: {what}; allowed is the same description, or another folder"
        )
    for name, each in own["made_by"].items():
        made = other.get("made_by", {}).get(name)
        if made != each:
            raise SweepError(
                f"{folder}: the sweep was begun with {name} {made}, and this is {each}, so results may "
                "differ; go on with the same version, or use another folder"
            )


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
