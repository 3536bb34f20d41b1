"""The program `python -m studies`, called in the process of the tests."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands import ROBOT, run_study

ROOT = Path(__file__).parents[2]
BEAM = ROOT / "tests" / "files" / "beam"
NAMES = (
    "simulation",
    "control",
    "environments",
    "hardware",
    "imperfections",
    "data",
    "estimation",
    "recordings",
    "beam",
    "cables",
    "virtual-robots",
    "loop",
)
BAD = [
    (("nothing",), "No such command"),
    (("simulation",), "--out"),
    (("simulation", "--out", "file"), "this is a file"),
    (("simulation", "--out", "o", "--seeds", "0"), "--seeds"),
    (("simulation", "--out", "o", "--methods", "best,worst"), "'worst' is unknown"),
    (("imperfections", "--out", "o", "--only", "damping,rust"), "'rust' is unknown"),
    (("data", "--out", "o", "--methods", "paper, no knowledge,magic"), "'magic' is unknown"),
    (("simulation", "--out", "o", "--workers", "2", "--dask", "a:1"), "give one of them"),
    (("recordings", "gone", "--out", "o"), "no such folder"),
    (("cables", ".", "--out", "o"), "no cables there"),
    (("beam", "nowhere", "--out", "o"), "no recordings found"),
    (("beam", BEAM, "--out", "o", "--train", "beam_load99"), "there is no recording 'beam_load99'"),
    (("beam", BEAM, "--out", "o", "--load", "beam_run3"), "--load must be NAME=GRAMS"),
    (("beam", BEAM, "--out", "o", "--load", "beam_run3=30"), "there is no recording 'beam_run3'"),
    (("loop", ROBOT, "--plant", f"elastica:{ROBOT},rust=1", "--reference", "circle"), "has 'rust=1'"),
]


@pytest.mark.parametrize("name", NAMES)
def test_help_has_an_example_that_can_be_typed(name):
    result = run_study(name, "--help")
    assert result.exit_code == 0
    assert f"python -m studies {name}" in result.stdout
    assert name in run_study("--help").stdout


@pytest.mark.parametrize(("arguments", "words"), BAD)
def test_bad_input_gives_status_2_and_one_line(tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    result = run_study(*arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ") and words in result.stderr
    assert result.stderr.count("\n") == 1
    assert os.listdir() == ["file"]


def test_an_output_that_cannot_be_written_is_said_before_anything_is_computed(tmp_path):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o555)
    if os.access(locked, os.W_OK):
        # who may write everywhere may not there
        locked = Path("/proc")
    result = run_study("estimation", "--out", locked / "o")
    assert result.exit_code == 2
    assert f": nothing can be written in {locked}: " in result.stderr


@pytest.mark.slow
def test_jobs_in_worker_processes_find_the_studies(tmp_path):
    command = [sys.executable, "-m", "studies", "simulation", "--methods", "baseline", "--workers", "2"]
    done = subprocess.run(
        [*command, "--out", str(tmp_path / "o")], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "8 cells (0 failed)" in done.stdout and (tmp_path / "o" / "table1.md").exists()
