"""Make the virtual environment .venv with the locked dependencies, or make a new lock.

    python3 tools/bootstrap.py                  make or update .venv
    python3 tools/bootstrap.py lock [--upgrade] write requirements.lock

Standard library only, and with a pip of its own: `python3` of a minimal Debian or Ubuntu has none to offer.
"""

import argparse
import contextlib
import fcntl
import hashlib
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import time
import venv

MINIMUM = (3, 11)
FALLBACKS = ("python3.13", "python3.12", "python3.11")

UV = "uv==0.13.8"

ROOT = pathlib.Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
LOCK = ROOT / "requirements.lock"
# the library, and the distribution for hardware
PACKAGES = (ROOT, ROOT / "hardware")
PIP = ROOT / "tools" / "pip-26.3-py3-none-any.whl"
# Held by whoever works on .venv, installers included: one that outlives its killed set-up would otherwise
# write into the environment that the next set-up makes. The folder itself, so as to leave no file behind.
TURN = os.open(ROOT, os.O_RDONLY)


def hand_over_to_a_newer_python():
    """Run this file again with a Python that is new enough, or say that there is none."""
    # An installed launcher may still be a stub for a version that is not there, so each has to prove itself.
    probe = f"import sys; sys.exit(sys.version_info < {MINIMUM})"
    for name in FALLBACKS:
        path = shutil.which(name)
        if path and subprocess.call([path, "-c", probe], stderr=subprocess.DEVNULL) == 0:
            print(f"Python {sys.version.split()[0]} is too old: using {path}", flush=True)
            os.execv(path, [path, *sys.argv])
    sys.exit(
        f"error: Python {MINIMUM[0]}.{MINIMUM[1]} or newer is needed and this is {sys.version.split()[0]}: "
        "install one, or name one with `make PYTHON=/path/to/python3 ...`"
    )


# Before anything below is evaluated: older Pythons can parse the rest of this file but not run it.
if sys.version_info < MINIMUM:
    hand_over_to_a_newer_python()


def run(*command: str | pathlib.Path, with_progress: bool = False) -> None:
    """Run an installer; where it fails, blame the network in one line or else show what it said.

    With progress it is told how many packages are there.
    """
    # Packages of another Python (a sourced ROS set-up, say) would pass for installed ones.
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
    # PIP_USER: set in many a personal configuration, and impossible inside a virtual environment.
    environment |= {"PIP_USER": "0", "PIP_NO_INPUT": "1", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    said = []
    with subprocess.Popen(
        command,
        cwd=ROOT,
        env=environment,
        pass_fds=[TURN],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as installer:
        found, told, state = 0, time.monotonic(), "packages"
        for line in installer.stdout or ():
            said.append(line)
            found += line.startswith("Collecting ")
            if line.startswith("Installing collected packages"):
                state, told = "packages, installing them", 0.0
            # a terminal's line is rewritten; a log gets a line every ten seconds
            if with_progress and time.monotonic() - told > (0.2 if sys.stdout.isatty() else 10.0):
                start, end = ("\r", "") if sys.stdout.isatty() else ("", "\n")
                print(f"{start}  {found} {state}", end=end, flush=True)
                told = time.monotonic()
    if with_progress and sys.stdout.isatty():
        print()
    if installer.returncode == 0:
        return
    output = "".join(said)
    # Out of retries: pip itself then only says that it found no matching distribution.
    broken = re.search(r"Retry\(total=0,.*connection broken by '(.*)': ", output)
    if broken:
        sys.exit(f"error: the package index is out of reach: {broken[1]}")
    sys.exit(f"{output}\nerror: this failed, its output is above: {' '.join(map(str, command))}")


def make_venv(folder: pathlib.Path) -> pathlib.Path:
    """Make an empty virtual environment that has pip; returns its Python."""
    # Not with_pip=True: Debian splits that off from its Python, and a half-made environment is what one gets.
    venv.EnvBuilder(clear=True, symlinks=True).create(folder)
    python = folder / "bin" / "python"
    run(python, PIP / "pip", "install", "--no-index", "--no-deps", PIP)
    return python


def set_up() -> None:
    """Bring .venv to what requirements.lock and both pyproject.toml say."""
    if VENV.is_symlink():
        sys.exit(f"error: .venv is a link to {VENV.resolve()}, which set-up would empty: remove the link")
    # Some network file systems have no such locks: there, two set-ups at once remain the user's own affair.
    with contextlib.suppress(OSError):
        fcntl.flock(TURN, fcntl.LOCK_EX)
    python = VENV / "bin" / "python"
    # The path too: scripts and the editable install are bound to where they were made, so that a copied or
    # moved checkout would otherwise run the original's code.
    wanted = f"{hashlib.sha256(LOCK.read_bytes()).hexdigest()}\n{sys.version}\n{VENV}\n"
    # Written only once all of it is installed: an environment without it is never built upon.
    installed = VENV / ".locked"
    if not (installed.is_file() and installed.read_text() == wanted):
        print("Setting up .venv, only once: 350 MB to download, 1.5 GB on disk, a minute or more", flush=True)
        installed.unlink(missing_ok=True)
        make_venv(VENV)
        # Wheels only: there may be no compiler here, and the hashes would not cover what a build downloads.
        install = ("-m", "pip", "install", "--only-binary=:all:", "--require-hashes", "-r", LOCK)
        run(python, *install, with_progress=True)
        installed.write_text(wanted)
    packages = [word for folder in PACKAGES for word in ("--editable", folder)]
    run(python, "-m", "pip", "install", "--no-deps", "--no-build-isolation", *packages)


def lock(upgrade: bool) -> None:
    """Write requirements.lock from both pyproject.toml; versions already locked are kept unless upgrading."""
    with tempfile.TemporaryDirectory() as scratch:
        python = make_venv(pathlib.Path(scratch) / "venv")
        run(python, "-m", "pip", "install", "--only-binary=:all:", UV)
        uv = [python.parent / "uv", "pip", "compile", "--output-file", LOCK.name]
        uv += [(folder / "pyproject.toml").relative_to(ROOT) for folder in PACKAGES]
        # hardware needs the library, which is installed from here
        uv += ["--no-emit-package", "knode-cosserat"]
        # `all` leaves out what is too large for every environment
        uv += ["--universal", "--python-version", ".".join(map(str, MINIMUM)), "--extra", "all"]
        uv += ["--generate-hashes", "--custom-compile-command", "make lock"]
        # One version for every Python wherever possible: results are then comparable between machines.
        uv += ["--fork-strategy", "fewest"]
        uv += ["--python", python, "--cache-dir", pathlib.Path(scratch) / "cache"]
        run(*uv, *(["--upgrade"] if upgrade else []))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Set up .venv, or write requirements.lock.")
    parser.add_argument("what", nargs="?", choices=["venv", "lock"], default="venv")
    parser.add_argument("--upgrade", action="store_true", help="lock the newest versions")
    arguments = parser.parse_args()
    if arguments.what == "lock":
        lock(arguments.upgrade)
    else:
        set_up()


if __name__ == "__main__":
    main()
