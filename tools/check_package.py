"""Build the wheel and the sdist, install the wheel in an environment of its own, and use it there.

    .venv/bin/python tools/check_package.py [--out dist]

What a user gets is neither this checkout nor its environment: a file left out of the wheel, or a module that
needs an extra, shows only here.
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


def run(*command: object, **options: object) -> str:
    """A program's output, without this environment's own Python in its way; its failure is ours."""
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
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}\nerror: failed: {' '.join(map(str, command))}")
    return done.stdout


def built(out: pathlib.Path) -> tuple[pathlib.Path, pathlib.Path]:
    """The wheel and the sdist; what the sdist builds is the same wheel."""
    shutil.rmtree(out, ignore_errors=True)
    run(sys.executable, "-m", "hatchling", "build", "-d", out, cwd=ROOT)
    (wheel,), (sdist,) = out.glob("*.whl"), out.glob("*.tar.gz")
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


def used(wheel: pathlib.Path, scratch: pathlib.Path) -> dict[str, object]:
    """Install the wheel alone, with the locked versions of what it needs, and use it from elsewhere."""
    venv.EnvBuilder(symlinks=True).create(scratch / "venv")
    python = scratch / "venv" / "bin" / "python"
    pip = [python, PIP / "pip", "install", "--quiet", "--no-input", "--disable-pip-version-check"]
    # the lock's hashes are for all of its lines or none: here its versions are enough
    pinned = [
        line.split(" ")[0] for line in (ROOT / "requirements.lock").read_text().splitlines() if "==" in line
    ]
    (scratch / "pinned.txt").write_text("\n".join(line for line in pinned if not line.startswith("#")))
    run(*pip, "--only-binary=:all:", "-c", scratch / "pinned.txt", wheel)
    elsewhere = scratch / "elsewhere"
    elsewhere.mkdir()
    run(python, "-W", "error", "-c", USE, cwd=elsewhere)
    timing = "import time; t = time.perf_counter(); import knode_cosserat; print(time.perf_counter() - t)"
    seconds = min(float(run(python, "-W", "error", "-c", timing, cwd=elsewhere)) for _ in range(5))
    doctor = json.loads(run(python.with_name("knode-cosserat"), "doctor", "--json", cwd=elsewhere))
    freeze = run(python, PIP / "pip", "list", "--format=json", "--disable-pip-version-check")
    return {"import_s": round(seconds, 2), "well": doctor["well"], "packages": len(json.loads(freeze))}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Build the package and use it in an environment of its own.")
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "dist", help="where wheel and sdist go")
    out = parser.parse_args().out.resolve()
    wheel, sdist = built(out)
    needed = requirements(wheel)
    with tempfile.TemporaryDirectory() as scratch:
        seen = used(wheel, pathlib.Path(scratch))
    sizes = {each.name: f"{each.stat().st_size / 1e6:.2f} MB" for each in (wheel, sdist)}
    print(json.dumps({"files": sizes, "requirements": len(needed), **seen}, indent=2))
    if len(needed) > MOST_REQUIREMENTS:
        sys.exit(f"error: {len(needed)} direct requirements; allowed are {MOST_REQUIREMENTS}: {needed}")
    if not seen["well"]:
        sys.exit("error: the doctor finds something wrong in the installed package")
    if seen["import_s"] > LONGEST_IMPORT:
        print(f"note: importing takes {seen['import_s']} s here; wanted is {LONGEST_IMPORT} s if it is quiet")


if __name__ == "__main__":
    main()
