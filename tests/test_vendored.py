"""Scripts of others in the viewer: they are the published files; a false package changes nothing."""

import base64
import hashlib
import io
import json
import shutil
import tarfile

import pytest

from tools import vendored
from tools.vendored import CHECKSUMS, FILES, FOLDER, REGISTRY, VendoredError


def packed(files):
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:gz") as archive:
        for name, data in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return content.getvalue()


class Registry:
    """A registry whose packages have the files of this folder, or changed ones."""

    def __init__(self, **changes):
        self.answers = {}
        for package, version in (("three", "0.170.0"), ("uplot", "1.6.32"), ("uplot", "1.7.0")):
            files = {
                f"package/{source.path}": changes.get("content", (FOLDER / name).read_bytes())
                for name, source in FILES.items()
                if source.package == package and name != changes.get("missing")
            }
            data, address = packed(files), f"{REGISTRY}/{package}/-/{package}-{version}.tgz"
            stated = base64.b64encode(hashlib.sha512(data).digest()).decode()
            about = {"dist": {"tarball": address, "integrity": f"sha512-{changes.get('integrity', stated)}"}}
            self.answers[f"{REGISTRY}/{package}/{version}"] = json.dumps(about).encode()
            self.answers[address] = data

    def __call__(self, address):
        return self.answers[address]


@pytest.fixture
def copied(tmp_path):
    shutil.copytree(FOLDER, tmp_path / "vendor")
    shutil.copy(CHECKSUMS, tmp_path / "vendored.json")
    return tmp_path / "vendor", tmp_path / "vendored.json"


def test_the_files_have_the_stored_checksums():
    assert vendored.check(FOLDER, CHECKSUMS, offline=True) == []
    assert json.loads(CHECKSUMS.read_text())["sha256"].keys() == FILES.keys()


def test_changed_missing_and_foreign_files_are_named(copied):
    folder, checksums = copied
    with (folder / "OrbitControls.js").open("a") as file:
        file.write("fetch('http://elsewhere.example');\n")
    (folder / "uPlot.min.css").unlink()
    (folder / "extra.js").write_text("0")
    assert vendored.check(folder, checksums, offline=True) == [
        "OrbitControls.js: it is not the published file",
        "uPlot.min.css: it is missing",
        "extra.js: it belongs to no package",
    ]


def test_files_are_compared_with_the_registry(copied):
    folder, checksums = copied
    assert vendored.check(folder, checksums, offline=False, fetch=Registry()) == []
    wrong = vendored.check(folder, checksums, offline=False, fetch=Registry(content=b"other"))
    assert len(wrong) == len(FILES) and all(
        line.endswith("it is not the published file of the registry") for line in wrong
    )


def test_another_version_is_written_with_its_checksums(copied):
    folder, checksums = copied
    registry = Registry(content=b"newer")
    found = vendored.update(folder, checksums, {"uplot": "1.7.0"}, registry)
    assert found == {"three": "0.170.0", "uplot": "1.7.0"}
    assert "npm package `uplot` | 1.7.0 |" in (folder / "README.md").read_text()
    assert (folder / "uPlot.iife.min.js").read_bytes() == b"newer"
    assert vendored.check(folder, checksums, offline=False, fetch=registry) == []


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"integrity": "AAAA"}, "three 0.170.0: its checksum is not the one that the registry states"),
        ({"missing": "uPlot.min.css"}, "uplot 1.6.32: it has no uPlot.min.css"),
    ],
)
def test_a_false_package_changes_nothing(copied, changes, what):
    folder, checksums = copied
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    with pytest.raises(VendoredError, match=what):
        vendored.update(folder, checksums, {}, Registry(**changes))
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == before


def test_nothing_but_the_registry_is_fetched():
    with pytest.raises(VendoredError, match=r"allowed is an address of https://registry\.npmjs\.org"):
        vendored.fetched("file:///etc/passwd")
