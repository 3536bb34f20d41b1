"""The firmware's sources, and its build: board, test program, host library and emulator."""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import subprocess
from pathlib import Path

from knode_cosserat_hardware.driver import HardwareError

#: Debian packages that the build needs
PACKAGES = "make g++ arduino-core-avr gcc-avr avr-libc binutils-avr libsimavr-dev libelf-dev"
#: where Debian's packages put what the build needs
NEEDED = ("/usr/share/arduino/hardware/arduino/avr/cores/arduino", "/usr/include/simavr/sim_avr.h")


def firmware_folder() -> Path:
    """Return the folder of the firmware's sources.

    Raises:
        HardwareError: the package was installed without them.
    """
    here = Path(__file__).resolve()
    for folder in (here.parents[4] / "firmware", here.parents[1] / "firmware"):
        if (folder / "Makefile").is_file():
            return folder
    raise HardwareError("the firmware's sources are not installed; use a checkout of the repository")


def missing() -> str:
    """Return the reason why the firmware cannot be built here, or an empty text."""
    tools = [name for name in ("make", "avr-g++", "g++") if shutil.which(name) is None]
    tools += [path for path in NEEDED if not os.path.exists(path)]
    if not tools:
        return ""
    return f"{tools[0]} is missing; install: apt-get install --no-install-recommends {PACKAGES}"


@functools.lru_cache
def built() -> Path:
    """Return the folder of the built firmware; builds it (some seconds) if its sources are newer.

    Raises:
        HardwareError: the tools are missing, or the build fails.
    """
    if reason := missing():
        raise HardwareError(f"the firmware cannot be built: {reason}")
    sources = firmware_folder()
    folder = _output(sources)
    folder.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(
        ["make", "--no-print-directory", "-C", str(sources), f"OUT={folder}", "all"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "error" in line.lower()]
        raise HardwareError(f"the firmware's build failed: {(lines or ['make failed'])[0]}")
    return folder


def _output(sources: Path) -> Path:
    """Return the folder for outputs: that of `make firmware` in a checkout, else one in the user's cache."""
    root = sources.parent
    if (root / "pyproject.toml").is_file() and os.access(root, os.W_OK):
        return root / "build" / "firmware"
    digest = hashlib.sha256()
    for file in sorted(sources.rglob("*")):
        if file.is_file():
            digest.update(file.read_bytes())
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "knode-cosserat" / f"firmware-{digest.hexdigest()[:16]}"
