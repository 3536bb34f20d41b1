"""Self-test of this installation: versions, hardware, and a short simulation."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import os
import platform
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from knode_cosserat._files.writing import package_version
from knode_cosserat._program_cache import SUFFIX
from knode_cosserat._reprs import count_of
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.run import usable_cores
from knode_cosserat.solvers.simulate import simulate

#: required packages
NEEDED = ("jax", "jaxlib", "equinox", "numpy", "scipy")
#: optional packages, with the extra that installs each
OPTIONAL = {
    "matplotlib": "viz",
    "rosbags": "ros",
    "pyarrow": "parquet",
    "tensorboardX": "tensorboard",
    "distributed": "dask",
}
#: what mends an installation whose programs or results are wrong
REINSTALL = (
    "pip install --upgrade --force-reinstall knode-cosserat, in a new environment (python3 -m venv); "
    "empty the cache's folder; if it stays, report this page"
)
#: largest relative error of the force at the base against the rod's weight
WEIGHT_ERROR = 1e-9


class Check(NamedTuple):
    """One check: name, success, observation, and what mends a failure."""

    name: str
    well: bool
    seen: str
    mend: str


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """Result of `doctor`."""

    #: versions by name: this package, Python, JAX, …; None for an extra that is not installed
    versions: dict[str, str | None]
    machine: str
    cores: int
    devices: list[str]
    cache: str
    programs: int
    checks: list[Check]

    @property
    def well(self) -> bool:
        """True if every check passed."""
        return all(check.well for check in self.checks)

    def to_dict(self) -> dict[str, Any]:
        """Return the diagnosis as a mapping for JSON."""
        checks = [check._asdict() for check in self.checks]
        return dataclasses.asdict(self) | {"checks": checks, "well": self.well}

    def __repr__(self) -> str:
        wrong = [check.name for check in self.checks if not check.well]
        return f"Diagnosis: {count_of(len(self.checks), 'check')}, " + (
            f"wrong: {', '.join(wrong)}" if wrong else "all is well"
        )

    def __str__(self) -> str:
        """Return a page of text."""
        there = [f"{name} {version}" for name, version in self.versions.items() if version]
        missing = [name for name, version in self.versions.items() if not version]
        extras = sorted({OPTIONAL[name] for name in missing if name in OPTIONAL})
        lines = [
            f"versions   {', '.join(there)}",
            f"machine    {self.machine}, {self.cores} cores to use",
            f"devices    {', '.join(self.devices)}",
            f"cache      {self.cache} ({self.programs} compiled programs)",
        ]
        if extras:
            lines.append(f"missing    {', '.join(missing)}: pip install 'knode-cosserat[{','.join(extras)}]'")
        for check in self.checks:
            lines.append(f"{'ok' if check.well else 'FAILED':<10} {check.name}: {check.seen}")
            if not check.well:
                lines.append(f"{'':<10} mend: {check.mend}")
        lines.append("all checks passed" if self.well else "a check failed: see its mend above")
        return "\n".join(lines)


def doctor() -> Diagnosis:
    """Check this installation with a short simulation: a few seconds, less with compiled programs.

    Failures are reported in the checks, not raised.
    """
    versions: dict[str, str | None] = {"knode-cosserat": package_version()}
    versions["Python"] = platform.python_version()
    versions |= {name: _version(name) for name in (*NEEDED, *OPTIONAL)}
    cache = Path(getattr(jax.config, "jax_compilation_cache_dir", None) or "")
    kind = jax.numpy.zeros(()).dtype
    precision = Check(
        "precision",
        kind == np.float64,
        f"numbers are {kind}; float64 is needed",
        "unset JAX_ENABLE_X64, and do not set jax_enable_x64 to False after this package is imported",
    )
    checks = [precision, _cache(cache), *_simulated()]
    # files of this package, and of JAX in a directory that the user set for it
    programs = sum(1 for end in (SUFFIX, "-cache") for _ in cache.glob(f"*{end}"))
    return Diagnosis(
        versions,
        f"{platform.system()} {platform.machine()}",
        usable_cores(),
        [f"{device.device_kind} ({device.platform})" for device in jax.devices()],
        str(cache),
        programs,
        checks,
    )


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _cache(folder: Path) -> Check:
    """Check that compiled programs can be stored in the folder, or in its parent if it does not exist."""
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    kept = bool(folder.name) and os.access(place, os.W_OK)
    said = "can be written" if kept else "cannot be written: every run compiles anew"
    mend = "export KNODE_COSSERAT_CACHE=FOLDER, one that you may write to"
    return Check("cache", kept, f"{folder} {said}", mend)


def _simulated() -> list[Check]:
    robot: Any = load_robot("delrin-tendon-robot")
    tensions = np.tile([7.0, 5.0, 5.0, 7.0], (20, 1))
    times = []
    try:
        for _ in range(2):
            began = time.perf_counter()
            moved = simulate(robot, tensions, 0.05)
            times.append(time.perf_counter() - began)
        carried = float(equilibrium(robot, np.zeros(4), with_stability=False).part("n")[0, 0, 2])
    except Exception as error:  # any failure is a result of the check
        said = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return [Check("simulation", False, said, REINSTALL)]
    solved = bool(moved.all_valid and np.max(moved.residual) <= 1e-8)
    weight = float(robot.mass_per_length * robot.length * robot.gravity[2])
    off = abs(carried / weight - 1.0)
    balance = f"the base carries {-carried:.6f} N, the rod's weight to {off:.0e}"
    return [
        Check(
            "simulation", solved, f"20 steps in {times[0]:.2f} s, then in {1e3 * times[1]:.1f} ms", REINSTALL
        ),
        Check("balance", off <= WEIGHT_ERROR, balance, REINSTALL),
    ]
