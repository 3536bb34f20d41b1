"""Manifest of a sweep: its description, columns and provenance, with a checksum.

It has no dates, so that a sweep that was stopped and continued has the same one as a sweep that was not.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import json
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from knode_cosserat._files.json_text import json_checksum, parse_json
from knode_cosserat._files.limits import excess
from knode_cosserat._files.reading import ReadError, read_bytes
from knode_cosserat._files.writing import package_version, replacing
from knode_cosserat._files.yaml_text import shown
from knode_cosserat._jax import machine_name
from knode_cosserat.rods.parameters import Parameter
from knode_cosserat.rods.paths import parameter_at
from knode_cosserat.sweeps.columns import columns_of
from knode_cosserat.sweeps.errors import SweepError
from knode_cosserat.sweeps.plan import Plan, control_titles, robot_text

#: folder of this package
ROOT = Path(__file__).parents[1]
#: name within the folder of a sweep
MANIFEST = "sweep.json"
FORMAT = "knode-cosserat sweep"
#: versions of the manifest that are read, and its key for the checksum of all others, from version 2 on
VERSIONS, CHECKSUM = (1, 2), "checksum"
#: largest manifest (bytes): a varied number has up to 20, and there are up to a million of them in lists
LARGEST_MANIFEST = 64_000_000
#: packages whose versions may change a result in its last bits
PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "equinox", "pyarrow")
#: parts of this package that results depend on
_SOURCES = ("_files", "rods", "solvers", "learning", "identification", "sweeps")


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
        "version": VERSIONS[-1],
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
    version, stated = manifest.get("version"), manifest.pop(CHECKSUM, None)
    if version not in VERSIONS:
        known = " or ".join(map(str, VERSIONS))
        raise SweepError(
            f"{path}: the sweep has the version {shown(version)}; allowed is {known}, which this version of "
            "the package reads. Nothing was changed"
        )
    if stated != json_checksum(manifest) and not (stated is None and version == 1):
        raise SweepError(f"{path}: damaged or changed: its contents do not have its checksum")
    _require_consistent(manifest, path)
    return manifest


def _require_consistent(manifest: Mapping[str, Any], path: Path) -> None:
    """Raise `SweepError` if keys are missing, or numbers contradict each other."""
    needed = {"identity": str, "sweep": dict, "robots": list}
    counts = ("cases", "shards", "shard_cases")
    if not all(isinstance(manifest.get(key), kind) for key, kind in needed.items()):
        raise SweepError(f"{path}: damaged: allowed are the keys {', '.join([*needed, *counts])}")
    if not all(type(manifest.get(key)) is int and manifest[key] > 0 for key in counts):
        raise SweepError(f"{path}: damaged: {', '.join(counts)} must be whole numbers above 0")
    robots = manifest["robots"]
    each, rest = divmod(manifest["cases"], len(robots) or 1)
    if not robots or rest or manifest["shards"] != len(robots) * -(-each // manifest["shard_cases"]):
        raise SweepError(f"{path}: damaged: its numbers of robots, cases and shards contradict each other")
    if not all(isinstance(robot, dict) and isinstance(robot.get("columns"), dict) for robot in robots):
        raise SweepError(f"{path}: damaged: a robot has no columns")


def require_same(own: Mapping[str, Any], other: Mapping[str, Any], folder: Path) -> None:
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
