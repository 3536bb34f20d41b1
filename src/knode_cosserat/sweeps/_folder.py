"""Folder of a sweep: the manifest with its provenance, the shards, and a log of runs.

    DIR/sweep.json          description, robots, columns, versions; written once, before the first shard
    DIR/shards/000012.parquet
    DIR/log.jsonl           one line for each run: date, machine, times

Manifest and shards have no dates, so that a sweep that was stopped and continued equals one that was
not.
"""

from __future__ import annotations

import datetime
import functools
import hashlib
import importlib.metadata
import json
import platform
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from knode_cosserat._files.json_text import json_checksum, parse_json
from knode_cosserat._files.limits import excess
from knode_cosserat._files.reading import ReadError, read_bytes
from knode_cosserat._files.writing import package_version, replacing
from knode_cosserat._files.yaml_text import excerpt
from knode_cosserat._jax import machine_name
from knode_cosserat.controls import titles
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.rods.parameters import parameter_at
from knode_cosserat.rods.robot_file import format_robot
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.sweeps._description import STORED, SweepError
from knode_cosserat.sweeps._plan import Plan
from knode_cosserat.sweeps._shards import read_shard

#: folder of this package
ROOT = Path(__file__).parents[1]
#: names within the folder
MANIFEST, SHARDS, LOG = "sweep.json", "shards", "log.jsonl"
#: mark and version of a manifest, and its key for the checksum of all others
FORMAT, VERSION, CHECKSUM = "knode-cosserat sweep", 1, "checksum"
#: largest manifest (bytes): a varied number has up to 20, and there are up to a million of them in lists
LARGEST_MANIFEST = 64_000_000
#: packages whose versions may change a result in its last bits
PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "equinox", "llvmlite", "pyarrow")
#: parts of this package that results depend on
SOURCES = ("_files", "rods", "schemes", "engine", "solvers", "learning", "sweeps")


# provenance


@functools.cache
def made_by() -> dict[str, str]:
    """Return the versions of Python and packages, and a checksum of the code that results depend on."""
    digest = hashlib.sha256()
    files = [*ROOT.glob("*.py"), *(file for name in SOURCES for file in (ROOT / name).rglob("*.py"))]
    for file in sorted(files):
        digest.update(file.relative_to(ROOT).as_posix().encode() + b"\0" + file.read_bytes())
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    package = {"knode-cosserat": package_version(), "code": digest.hexdigest()[:16]}
    return {**package, "python": platform.python_version(), **versions}


def machine() -> dict[str, str]:
    """Return the machine's kind and a short name of its CPU model, which results depend on in last bits."""
    return {"system": platform.system(), "machine": platform.machine(), "cpu": machine_name()}


def _git_commit() -> str | None:
    """Return the commit of the checkout that the package is in; None for an installed package."""
    try:
        command = ["git", "-C", str(ROOT), "rev-parse", "HEAD"]
        result = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10.0)
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip()


# the manifest


def _manifest_of(plan: Plan) -> dict[str, Any]:
    """Return the manifest of a plan, as plain data."""
    sweep = plan.sweep
    return {
        "format": FORMAT, "version": VERSION, "identity": plan.identity, "sweep": sweep.described(),
        "cases": sweep.case_count, "shards": plan.shard_count, "shard_cases": plan.shard_cases,
        "robots": [
            {
                "label": entry.label, "text": _text(system),
                "controls": titles(system.control_layout), "columns": _columns(plan, robot),
            }
            for robot, (entry, system) in enumerate(zip(sweep.robots, plan.systems, strict=True))
        ],
        "made_by": made_by(), "git": _git_commit(), "machine": machine(),
    }  # fmt: skip


def _text(system: System) -> str:
    """Return the text of a robot file, or the text of a system that has none."""
    try:
        return format_robot(system)
    except KnodeCosseratError:
        return repr(system)


def _columns(plan: Plan, robot: int) -> dict[str, dict[str, Any]]:
    """Return the columns of a robot's shards by name: shape of one case's value, unit and meaning."""
    sweep, rows = plan.sweep, [plan.sweep.steps + 1]
    columns: dict[str, tuple[Sequence[int], str, str]] = {
        "case": ([], "", "number of the case in the sweep"),
        "robot": ([], "", "number of the robot in the description, from 0"),
        "word": ([], "", "number of the word of controls, from 0"),
        "seed": ([], "", "seed of the case"),
    }
    for name, values in sweep.vary.items():
        stated = parameter_at(nominal_model(plan.systems[0]), name)
        shape = np.shape(values[0]) if isinstance(values, tuple) else []
        columns[name] = shape, stated.unit if stated else "", "varied number"
    columns |= {
        "result": (rows, "", "result codes of the rows; below 0: not solved"),
        "position_error": (rows, "m", "estimated discretisation error of positions"),
        "reason": ([], "", "reason of a failed case; empty for a solved one"),
    }
    for name, shape in plan.stored_shapes(robot).items():
        meaning, unit = STORED[name]
        columns[name] = shape, unit, meaning
    return {
        name: {"shape": list(shape), "unit": unit, "meaning": meaning}
        for name, (shape, unit, meaning) in columns.items()
    }


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write a manifest into a folder. Raises `SweepError`."""
    path = folder / MANIFEST
    text = json.dumps({**manifest, CHECKSUM: json_checksum(manifest)}, indent=1)
    if reason := excess(len(text), LARGEST_MANIFEST, "bytes"):
        raise SweepError(f"{path}: its description is too long: {reason}")
    try:
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    except OSError as error:
        raise SweepError(f"{path}: cannot be written: {error.strerror or error}") from None


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a sweep's folder. Raises `SweepError`."""
    path = folder / MANIFEST
    try:
        text = read_bytes(path, LARGEST_MANIFEST)
    except ReadError as error:
        missing = f"{folder}: no sweep is here: there is no {MANIFEST}"
        raise SweepError(f"{path}: {error}" if path.exists() else missing) from None
    try:
        manifest = parse_json(text)
    except ReadError as error:
        raise SweepError(f"{path}: damaged: {error}") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise SweepError(f"{path}: not the manifest of a sweep")
    stated = manifest.pop(CHECKSUM, None)
    if manifest.get("version") != VERSION:
        raise SweepError(
            f"{path}: the sweep has the version {excerpt(manifest.get('version'))}; allowed is {VERSION}, "
            "which this version of the package reads. Nothing was changed"
        )
    if stated != json_checksum(manifest):
        raise SweepError(f"{path}: damaged or changed: its contents do not have its checksum")
    return manifest


# the folder


def shard_path(folder: Path, number: int) -> Path:
    """Return the path of a shard."""
    return folder / SHARDS / f"{number:06d}.parquet"


def shard_numbers(folder: Path, count: int) -> tuple[int, ...]:
    """Return the numbers of the existing shards, of those below a count."""
    stems = (path.stem for path in (folder / SHARDS).glob("*.parquet"))
    numbers = (int(stem) for stem in stems if stem.isdecimal() and len(stem) < 16)
    return tuple(sorted(k for k in numbers if k < count and shard_path(folder, k).exists()))


def open_folder(plan: Plan, folder: Path) -> None:
    """Check the manifest in a folder; it is written if the folder is new.

    Raises:
        SweepError: the folder has another sweep, or one begun with other versions; or cannot be written.
    """
    manifest = json.loads(json.dumps(_manifest_of(plan)))
    if not (folder / MANIFEST).exists():
        if shard_numbers(folder, 10**16):
            raise SweepError(
                f"{folder}: there are shards without their {MANIFEST}; allowed is another folder"
            )
        try:
            (folder / SHARDS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SweepError(f"{folder}: cannot be written: {error.strerror or error}") from None
        write_manifest(folder, manifest)
        return
    other = read_manifest(folder)
    if manifest["identity"] != other["identity"]:
        changed = [key for key, value in manifest["sweep"].items() if other["sweep"].get(key) != value]
        reason = "a robot or a file of controls was changed"
        if changed:
            reason = f"its {changed[0]} is {excerpt(other['sweep'].get(changed[0]))}"
        raise SweepError(
            f"{folder}: another sweep is here: {reason}; allowed is the same description, or another folder"
        )
    for name, version in manifest["made_by"].items():
        if (made := other["made_by"].get(name)) != version:
            raise SweepError(
                f"{folder}: the sweep was begun with {name} {made}, and this is {version}, so results may "
                "differ; go on with the same version, or use another folder"
            )


def holds_plan(folder: Path, plan: Plan) -> bool:
    """True if the folder has the manifest of a plan: a worker on another machine may not see it."""
    try:
        return bool(read_manifest(folder)["identity"] == plan.identity)
    except SweepError:
        return False


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
    with suppress(OSError), (folder / LOG).open("a", encoding="utf-8") as file:
        file.write(line + "\n")
