"""Build wheels and sdists, install the wheels in an environment of its own, and use them there.

    .venv/bin/python tools/check_package.py [--out dist]

What a user gets is neither this checkout nor its environment: a file left out of a wheel, or a module that
needs an extra, shows only here. The library is used before the distribution for hardware is installed.
"""

import argparse
import email
import json
import os
import pathlib
import shutil
import subprocess
import sys
import tarfile
import tempfile
import venv
import zipfile

ROOT = pathlib.Path(__file__).resolve().parent.parent
#: the library, and the distribution for hardware
PACKAGES = (ROOT, ROOT / "hardware")
PIP = next((ROOT / "tools").glob("pip-*.whl"))
#: the base install stays small
MOST_REQUIREMENTS = 12
#: seconds that `import knode_cosserat` may take: the best of several
LONGEST_IMPORT = 1.5

USE = """
import knode_cosserat as kc
for name in kc.catalog():
    kc.load_robot(name)
robot = kc.load_robot("delrin-tendon-robot")
found = kc.simulate(robot, kc.controls.sine(1.5, 20, 0.05), 0.05)
found.save("it.nc")
assert kc.load_trajectory("it.nc").all_valid
"""
USE_HARDWARE = """
import knode_cosserat as kc
import knode_cosserat_hardware as kch
from knode_cosserat_hardware.emulation import firmware_folder
for name in kch.__all__:
    if name != "DDSBridge":
        getattr(kch, name)
with kch.SimulatedRobot(kc.load_robot("delrin-tendon-robot")) as robot:
    robot.arm()
    robot.command([1.0, 0.0, 0.0, 0.0])
    assert robot.read().tension.shape == (4,)
assert firmware_folder().parent.name == "knode_cosserat_hardware"
"""
#: packages that only hardware needs
HARDWARE_ONLY = ("can", "dynamixel_sdk", "serial", "knode_cosserat_hardware")


def run(*command: object, status: int = 0, **options: object) -> str:
    """A program's output, without this environment's own Python in its way; another status is our failure."""
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    environment = {k: v for k, v in os.environ.items() if k not in hidden} | {"PIP_USER": "0"}
    done = subprocess.run(
        [str(part) for part in command],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        **options,
    )
    if done.returncode != status:
        sys.exit(f"{done.stdout}{done.stderr}\nerror: failed: {' '.join(map(str, command))}")
    return done.stderr if status else done.stdout


def built(package: pathlib.Path, out: pathlib.Path) -> tuple[pathlib.Path, pathlib.Path]:
    """The wheel and the sdist of a package; what the sdist builds is the same wheel."""
    with tempfile.TemporaryDirectory() as scratch:
        made = pathlib.Path(scratch)
        run(sys.executable, "-m", "hatchling", "build", "-d", made, cwd=package)
        wheel, sdist = (
            pathlib.Path(shutil.move(file, out / file.name))
            for ending in ("*.whl", "*.tar.gz")
            for file in made.glob(ending)
        )
    with tempfile.TemporaryDirectory() as scratch:
        with tarfile.open(sdist) as archive:
            # Debian 12's Python has no filters yet; it is our own archive
            archive.extractall(scratch, **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))
        (source,) = pathlib.Path(scratch).iterdir()
        again = pathlib.Path(scratch) / "again"
        run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", again, cwd=source)
        (second,) = again.glob("*.whl")
        names = [sorted(zipfile.ZipFile(each).namelist()) for each in (wheel, second)]
    if names[0] != names[1]:
        sys.exit(f"error: only one of wheel and sdist has {sorted(set(names[0]) ^ set(names[1]))}")
    return wheel, sdist


def requirements(wheel: pathlib.Path) -> list[str]:
    """What the base install needs directly."""
    archive = zipfile.ZipFile(wheel)
    (name,) = [each for each in archive.namelist() if each.endswith(".dist-info/METADATA")]
    stated = email.message_from_bytes(archive.read(name)).get_all("Requires-Dist") or []
    return [each for each in stated if "extra ==" not in each]


def used(wheel: pathlib.Path, hardware: pathlib.Path, scratch: pathlib.Path) -> dict[str, object]:
    """Install the library alone, with the locked versions of what it needs, and use it; then hardware."""
    venv.EnvBuilder(symlinks=True).create(scratch / "venv")
    python = scratch / "venv" / "bin" / "python"
    pip = [python, PIP / "pip", "install", "--quiet", "--no-input", "--disable-pip-version-check"]
    # the lock's hashes are for all of its lines or none: here its versions are enough
    pinned = [
        line.split(" ")[0] for line in (ROOT / "requirements.lock").read_text().splitlines() if "==" in line
    ]
    (scratch / "pinned.txt").write_text("\n".join(line for line in pinned if not line.startswith("#")))
    pip += ["--only-binary=:all:", "-c", scratch / "pinned.txt"]
    run(*pip, wheel)
    elsewhere = scratch / "elsewhere"
    elsewhere.mkdir()
    run(python, "-W", "error", "-c", USE, cwd=elsewhere)
    timing = "import time; t = time.perf_counter(); import knode_cosserat; print(time.perf_counter() - t)"
    seconds = min(float(run(python, "-W", "error", "-c", timing, cwd=elsewhere)) for _ in range(5))
    doctor = json.loads(run(python.with_name("knode-cosserat"), "doctor", "--json", cwd=elsewhere))
    freeze = run(python, PIP / "pip", "list", "--format=json", "--disable-pip-version-check")
    absent = f"import importlib.util as u; assert not any(map(u.find_spec, {HARDWARE_ONLY}))"
    run(python, "-c", absent, cwd=elsewhere)
    program = python.with_name("knode-cosserat")
    refused = run(program, "robot", "--help", status=2, cwd=elsewhere)
    if "pip install knode-cosserat-hardware" not in refused:
        sys.exit(f"error: without the distribution for hardware `robot` prints {refused}")
    run(*pip, hardware)
    run(python, "-W", "error", "-c", USE_HARDWARE, cwd=elsewhere)
    run(program, "robot", "--help", cwd=elsewhere)
    run(program, "robot", "connect", "--port", "simulated", "--json", cwd=elsewhere)
    run(program, "robot-parts", "delrin-routed-tendon-robot", cwd=elsewhere)
    return {"import_s": round(seconds, 2), "well": doctor["well"], "packages": len(json.loads(freeze))}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Build the packages and use them in an environment.")
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "dist", help="where wheels and sdists go")
    out = parser.parse_args().out.resolve()
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    (wheel, sdist), (hardware, its_sdist) = (built(package, out) for package in PACKAGES)
    needed = requirements(wheel)
    with tempfile.TemporaryDirectory() as scratch:
        seen = used(wheel, hardware, pathlib.Path(scratch))
    sizes = {each.name: f"{each.stat().st_size / 1e6:.2f} MB" for each in (wheel, sdist, hardware, its_sdist)}
    print(json.dumps({"files": sizes, "requirements": len(needed), **seen}, indent=2))
    if len(needed) > MOST_REQUIREMENTS:
        sys.exit(f"error: {len(needed)} direct requirements; allowed are {MOST_REQUIREMENTS}: {needed}")
    if not seen["well"]:
        sys.exit("error: the doctor finds something wrong in the installed package")
    if seen["import_s"] > LONGEST_IMPORT:
        print(f"note: importing takes {seen['import_s']} s here; wanted is {LONGEST_IMPORT} s if it is quiet")


if __name__ == "__main__":
    main()
