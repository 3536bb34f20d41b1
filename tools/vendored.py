"""Check or update the scripts of others in the viewer: `python -m tools.vendored --check | --update`.

`--check` compares each file with the one in the package of the npm registry, at the version that the README
beside it states; the package itself is checked by the registry's checksum. `--update`, with `--version
NAME=VERSION` for another version, writes the files, and their versions into the README. `--offline` compares
with the checksums in `vendored.json` alone. Files that were changed, or are missing, are named.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import io
import json
import re
import sys
import tarfile
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

FOLDER = Path(__file__).parents[1] / "src" / "knode_cosserat" / "viewer" / "vendor"
CHECKSUMS = Path(__file__).with_name("vendored.json")
REGISTRY = "https://registry.npmjs.org"
#: largest package that is read (bytes), and the same expanded
LARGEST, EXPANDED = 50_000_000, 300_000_000
TIMEOUT = 60.0

Fetch = Callable[[str], bytes]


class Source(NamedTuple):
    """A file of a package of the registry."""

    package: str
    path: str


FILES = {
    "three.module.min.js": Source("three", "build/three.module.min.js"),
    "OrbitControls.js": Source("three", "examples/jsm/controls/OrbitControls.js"),
    "three.LICENSE": Source("three", "LICENSE"),
    "uPlot.iife.min.js": Source("uplot", "dist/uPlot.iife.min.js"),
    "uPlot.min.css": Source("uplot", "dist/uPlot.min.css"),
    "uPlot.LICENSE": Source("uplot", "LICENSE"),
}


class VendoredError(Exception):
    """A package that cannot be read or is not the one that the registry states."""


def fetched(address: str) -> bytes:
    """Return the content of an address of the registry."""
    if not address.startswith(f"{REGISTRY}/"):
        raise VendoredError(f"{address}: allowed is an address of {REGISTRY}")
    with urllib.request.urlopen(address, timeout=TIMEOUT) as answer:
        content: bytes = answer.read(LARGEST + 1)
    if len(content) > LARGEST:
        raise VendoredError(f"{address}: more than {LARGEST} bytes")
    return content


def stated_versions(readme: str) -> dict[str, str]:
    """Return the version of each package from the table of the README."""
    found = dict(re.findall(r"npm package `([\w.-]+)` \| ([\w.-]+) \|", readme))
    missing = sorted({source.package for source in FILES.values()} - found.keys())
    if missing:
        raise VendoredError(f"the README states no version of {', '.join(missing)}")
    return found


def with_version(readme: str, package: str, version: str) -> str:
    """Return the README with another version of a package."""
    return re.sub(rf"(npm package `{re.escape(package)}` \| )[\w.-]+( \|)", rf"\g<1>{version}\g<2>", readme)


def package_files(package: str, version: str, fetch: Fetch = fetched) -> dict[str, bytes]:
    """Return the wanted files of a package by their names here.

    Raises:
        VendoredError: the package is not the one that the registry states, or lacks a file.
    """
    about = json.loads(fetch(f"{REGISTRY}/{package}/{version}"))
    content = fetch(about["dist"]["tarball"])
    algorithm, _, stated = about["dist"]["integrity"].partition("-")
    if algorithm != "sha512" or base64.b64encode(hashlib.sha512(content).digest()).decode() != stated:
        raise VendoredError(f"{package} {version}: its checksum is not the one that the registry states")
    wanted = {f"package/{source.path}": name for name, source in FILES.items() if source.package == package}
    found, expanded = {}, 0
    with tarfile.open(fileobj=io.BytesIO(content), mode="r:gz") as archive:
        for member in archive:
            expanded += member.size
            if expanded > EXPANDED:
                raise VendoredError(f"{package} {version}: it expands to more than {EXPANDED} bytes")
            if member.name in wanted and member.isfile():
                file = archive.extractfile(member)
                assert file is not None
                found[wanted[member.name]] = file.read()
    missing = sorted(set(wanted.values()) - found.keys())
    if missing:
        raise VendoredError(f"{package} {version}: it has no {', '.join(missing)}")
    return found


def checksum(content: bytes) -> str:
    """Return the SHA-256 of a content, whatever its line endings."""
    return hashlib.sha256(content.replace(b"\r\n", b"\n")).hexdigest()


def differences(folder: Path, wanted: dict[str, str]) -> list[str]:
    """Return a line for each file of a folder that is missing or has another checksum than the wanted one."""
    lines = []
    for name, stated in sorted(wanted.items()):
        path = folder / name
        if not path.exists():
            lines.append(f"{name}: it is missing")
        elif checksum(path.read_bytes()) != stated:
            lines.append(f"{name}: it is not the published file")
    lines += [
        f"{path.name}: it belongs to no package"
        for path in sorted(folder.iterdir())
        if path.is_file() and path.name not in {*wanted, "README.md", "__init__.py"}
    ]
    return lines


def published(versions: dict[str, str], fetch: Fetch = fetched) -> dict[str, bytes]:
    """Return the files of all packages by their names here."""
    files: dict[str, bytes] = {}
    for package in sorted({source.package for source in FILES.values()}):
        files |= package_files(package, versions[package], fetch)
    return files


def update(folder: Path, checksums: Path, changed: dict[str, str], fetch: Fetch = fetched) -> dict[str, str]:
    """Write the files of the stated or changed versions, the README's versions and the checksums.

    Returns:
        The versions. Nothing is written if a package cannot be read.
    """
    readme = (folder / "README.md").read_text(encoding="utf-8")
    versions = stated_versions(readme) | changed
    files = published(versions, fetch)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    for package, version in versions.items():
        readme = with_version(readme, package, version)
    (folder / "README.md").write_text(readme, encoding="utf-8")
    sums = {name: checksum(content) for name, content in sorted(files.items())}
    checksums.write_text(
        json.dumps({"versions": versions, "sha256": sums}, indent=2) + "\n", encoding="utf-8"
    )
    return versions


def check(folder: Path, checksums: Path, offline: bool, fetch: Fetch = fetched) -> list[str]:
    """Return what is wrong with the files, against the registry or the stored checksums."""
    versions = stated_versions((folder / "README.md").read_text(encoding="utf-8"))
    stored = json.loads(checksums.read_text(encoding="utf-8"))
    wrong = differences(folder, stored["sha256"])
    if stored["versions"] != versions:
        wrong.append(f"README.md: its versions are {versions}; the checksums are of {stored['versions']}")
    if not offline:
        sums = {name: checksum(content) for name, content in published(versions, fetch).items()}
        wrong += [f"{line} of the registry" for line in differences(folder, sums)]
    return wrong


def main() -> None:
    """Check or update; the exit status is 1 if a file is not the published one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("--check", action="store_true")
    action.add_argument("--update", action="store_true")
    parser.add_argument("--offline", action="store_true", help="compare with stored checksums only")
    parser.add_argument("--version", action="append", default=[], metavar="NAME=VERSION")
    given = parser.parse_args()
    try:
        if given.update:
            changed = dict(each.split("=", 1) for each in given.version)
            versions = update(FOLDER, CHECKSUMS, changed)
            print(f"written: {versions}; run the tests of the viewer (tests/viewer)")
            return
        wrong = check(FOLDER, CHECKSUMS, given.offline)
    except (VendoredError, OSError, ValueError, KeyError) as error:
        sys.exit(f"error: {error}")
    for line in wrong:
        print(line)
    if not wrong:
        print(f"{len(FILES)} files are those that were published")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
