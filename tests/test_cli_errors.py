"""What is wrong with a command is said in one line."""

import os
from pathlib import Path

import pytest

import knode_cosserat as kc
from knode_cosserat.cli.arguments import require_writable
from tests.commands import ROBOT, run


def bad_inputs():
    simulation = ("simulate", ROBOT, "--out", "a.nc")
    sine = (*simulation, "--controls", "sine:1.5")
    full = (*sine, "--steps", "3")
    return [
        (("simulat",), "simulate"),
        (("info", "--colour"), "--colour"),
        ((*simulation, "--steps", "3"), "--controls is not given; allowed is one number for each control"),
        (("simulate", ROBOT, "--controls", "sine:1.5", "--steps", "3"), "--out"),
        ((*sine, "--steps", "three"), "--steps"),
        ((*sine, "--steps", "0"), "steps"),
        ((*sine, "--steps", "-3"), "steps"),
        ((*sine, "--steps", str(10**13)), "allocate"),
        (sine, "number of steps"),
        ((*full, "--dt", "0"), "dt is 0"),
        ((*full, "--dt", "nan"), "dt is nan"),
        ((*full, "--time", "lobatto4"), "trapezoidal"),
        ((*full, "--space", "bdf2"), "lobatto4"),
        ((*full, "--nodes", "1"), "nodes is 1"),
        ((*full, "--set", "colour=red"), "no parameter 'colour'"),
        ((*full, "--set", "length"), "NAME=VALUE"),
        ((*full, "--set", "length=["), "NAME=VALUE"),
        ((*full, "--set", "length=long"), "length must be a number between 0.001 and 20 m (got 'long')"),
        ((*full, "--set", "length=-1"), "length must be between 0.001 and 20 m (got -1"),
        ((*full, "--set", "drag=1", "--set", " drag=2"), "drag is given by another --set too"),
        ((*full, "--set", "nodes=8", "--nodes", "9"), "nodes is given by --nodes too"),
        ((*full, "--set", "youngs_modulus=2.7"), "Did you mean 2700000000 (2.7 GPa)?"),
        ((*full, "--set", "length=635"), "between 0.001 and 20 m (got 635). Did you mean 0.635 (635 mm)?"),
        ((*full, "--set", "radius=6 kg"), "(got '6 kg'): kg is no unit of a number in m"),
        ((*full, "--set", "gravity=0", "0", "-9810"), "Did you mean [0, 0, -9.81] ([0, 0, -9810] mm/s2)?"),
        ((*simulation, "--controls", "step:1e5", "--steps", "10"), "the step starts at 1.5 s, after the end"),
        ((*simulation, "--controls", "step:1e5", "--steps", "10"), "use 31 steps or more, or at=0"),
        ((*simulation, "--controls", "7,5,5", "--steps", "10"), "must be 4 finite numbers"),
        ((*simulation, "--controls", "7,5,5,7"), "the number of steps is not given"),
        ((*simulation, "--controls", "base_z=ramp:1", "--steps", "3"), "the control 'base_z' is unknown"),
        ((*full, "--figure", "a.doc"), ".png"),
        ((*full, "--figure", "nowhere/a.png"), "no folder nowhere"),
        (("simulate", ROBOT, "--controls", "sine:1.5", "--steps", "3", "--out", "nowhere/a.nc"), "no folder"),
        (("simulate", ROBOT, "--controls", "sine:1.5", "--steps", "3", "--out", "."), "folder"),
        ((*simulation, "--steps", "3", "--controls", "sinus:1.5"), "did you mean sine:PERIOD?"),
        ((*simulation, "--steps", "3", "--controls", "nowhere.csv"), "no such signal or file"),
        ((*simulation, "--controls", "broken.csv"), "broken.csv"),
        (("simulate", "nobot", "--controls", "sine:1", "--steps", "3", "--out", "a.nc"), "nobot"),
        (("simulate", "broken.yaml", "--controls", "sine:1", "--steps", "3", "--out", "a.nc"), "broken.yaml"),
        (("equilibrium", ROBOT), "--tension"),
        (("equilibrium", ROBOT, "--tension", "7,5"), "4 numbers"),
        (("equilibrium", ROBOT, "--tension", "7,5,5,-7"), "0 or more"),
        (("equilibrium", ROBOT, "--tension", "7,5,5,inf"), "0 or more"),
        (("equilibrium", ROBOT, "--tension", "strong"), "strong"),
        (
            ("equilibrium", ROBOT, "--tension", "7,5,5,7", "--control", "tension_2=1"),
            "tension_2 is given already",
        ),
        (("equilibrium", ROBOT, "--control", "tension_1=1,tension_1=2"), "tension_1 is given already"),
        (("equilibrium", ROBOT, "--control", "7,5"), "4 numbers, in the order tension_1, tension_2"),
        (("equilibrium", ROBOT, "--tension", "7", "5"), "4 numbers, such as 7,5,5,7 (got '7,5')"),
        (("reach", ROBOT, "--position", "100", "50", "250"), "Did you mean 0.1 0.05 0.25 (100,50,250 mm)?"),
        (("reach", ROBOT, "--position", "0.1", "0.05"), "--position must be 3 numbers"),
        (("record-virtual", "step:4", "--seconds", "1", "--out", "a.bag"), "--seconds must be above 2"),
        (("fit", ROBOT, "a b.csv", "broken.nc", "--out", "m"), "broken.nc: this is no recording"),
        (("fit", ROBOT, "a b.csv", "--out", "m", "--rows", "3"), "--rows is for trajectories; a b.csv is a"),
        (("fit", ROBOT, "a b.csv", "--out", "m", "--preset", "paper"), "--preset is for trajectories"),
        (
            ("fit", ROBOT, "broken.nc", "--out", "m", "--minutes", "3"),
            "are for recordings; broken.nc is none",
        ),
        (("evaluate", "broken.nc", "a.csv"), "knode-cosserat evaluate ROBOT a.csv --config recording.yaml"),
        (("evaluate", "a.csv", ROBOT), "type: knode-cosserat evaluate delrin-tendon-robot a.csv"),
        (
            ("evaluate", ROBOT, "broken.nc", "a.csv"),
            "type: knode-cosserat evaluate delrin-tendon-robot a.csv --config recording.yaml",
        ),
        (("evaluate", ROBOT, "columns.csv"), "or describe its own names in a YAML file with --config"),
        (("identify", ROBOT, "broken.nc", "--out", "m"), "knode-cosserat fit ROBOT broken.nc --out model"),
        (("inspect", "broken.nc"), "type: knode-cosserat plot broken.nc --out broken.png"),
        (("plot", "broken.csv", "--out", "a.png"), "type: knode-cosserat inspect broken.csv"),
        (("view", "broken.csv"), "type: knode-cosserat inspect broken.csv"),
        (("info", "broken.csv"), "type: knode-cosserat inspect broken.csv"),
        (("evaluate", "broken.nc", ROBOT), "Type: knode-cosserat evaluate delrin-tendon-robot broken.nc"),
        (("simulate", ROBOT, "--controls", "sine:1", "--steps", "3", "--out", "a.csv"), "Did you mean a.nc?"),
        (("workspace", ROBOT, "--out", "a.nc", "--high", "8,8"), "one number for all controls, or 4"),
        (("info", "nobot"), "the catalog has delrin-"),
        (("info", "--set", "length=1"), "name it"),
        (("fit", ROBOT, "nowhere.nc", "--out", "m"), "nowhere.nc: no such file"),
        (("fit", ROBOT, "--out", "m"), "DATA"),
        (("fit", ROBOT, "broken.nc", "--out", "m"), "broken.nc: not a netCDF-4 file"),
        (("fit", ROBOT, "broken.nc"), "--out"),
        (("fit", ROBOT, "broken.nc", "--out", "nowhere/m"), "no folder nowhere"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--preset", "worst"), "worst"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--seeds", "a,b"), "whole numbers, such as 0,1,2"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--seeds", "1,1"), "several different ones"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--seed", "1", "--seeds", "1,2"), "give one of them"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--seed", "-1"), "whole number from 0"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--epochs", "5"), "training configuration best has none"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--preset", "paper", "--epochs", "0"), "epochs is 0"),
        (("fit", "nobot", "broken.nc", "--out", "m"), "nobot"),
        (("fit", "broken.model", "broken.nc", "--out", "m"), "broken.model"),
        (("fit", ROBOT, "broken.nc", "--out", "broken.nc", "--seeds", "1,2"), "this is a file"),
        (("info", "broken.model"), "broken.model"),
        (("info", "."), "no ensemble here"),
        (("evaluate", ".", "broken.nc"), "no ensemble here"),
        (("study", "simulation", "--out", "o"), "part of the repository: git clone"),
        (("evaluate", "nowhere.nc", "nowhere.nc"), "nowhere.nc: no such file"),
        (("evaluate", "nobot", "nowhere.nc"), "nobot"),
        (("evaluate", ROBOT, "broken.nc"), "broken.nc: not a netCDF-4 file"),
        (("evaluate", ROBOT), "REFERENCE"),
        (("plot", "nowhere.nc", "--out", "a.png"), "nowhere.nc: no such file"),
        (("plot", "broken.nc", "--out", "a.png"), "broken.nc: not a netCDF-4 file"),
        (("plot", "broken.nc", "--out", "a"), "end in .png"),
        (("plot", "broken.nc", "--out", "a.png", "--kind", "cake"), "--kind"),
    ]


@pytest.mark.parametrize(("arguments", "words"), bad_inputs())
@pytest.mark.parametrize("as_json", [False, True])
def test_bad_input_gives_status_2_and_one_line(tmp_path, monkeypatch, arguments, words, as_json):
    monkeypatch.chdir(tmp_path)
    for name in ("broken.csv", "broken.yaml", "broken.nc"):
        Path(name).write_text("this: [is\nnot right")
    Path("columns.csv").write_text("t,x\n0,1\n")
    Path("broken.model").write_text("knode-cosserat model, format 1, package 0.1.0\nbroken")
    result = run(*arguments, *(["--json"] if as_json else []))
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith("error: ")
    assert words in result.stderr
    assert result.stderr.count("\n") == 1 and result.stderr.endswith("\n")
    assert not {"a.nc", "a.png", "m", "o"} & set(os.listdir())


def test_a_mistake_of_ours_is_not_taken_for_one_of_the_users(monkeypatch):
    def broken(name):
        raise TypeError("a bug")

    monkeypatch.setattr(kc, "load_robot", broken)
    assert isinstance(run("info", ROBOT).exception, TypeError)


OUTPUTS = {
    "simulate": ("simulate", ROBOT, "--controls", "sine:1.5", "--steps", "3", "--out", "{}/a.nc"),
    "simulate, a figure": (
        "simulate", ROBOT, "--controls", "sine:1.5", "--steps", "3", "--out", "a.nc", "--figure", "{}/a.png",
    ),
    "equilibrium": ("equilibrium", ROBOT, "--tension", "7,5,5,7", "--out", "{}/a.nc"),
    "workspace": ("workspace", ROBOT, "--out", "{}/a.csv"),
    "fit": ("fit", ROBOT, "b.nc", "--out", "{}/m"),
    "fit, several seeds": ("fit", ROBOT, "b.nc", "--seeds", "1,2", "--out", "{}/m"),
    "fit, a checkpoint": ("fit", ROBOT, "b.nc", "--out", "m", "--checkpoint", "{}/c/d"),
    "fit, a log": ("fit", ROBOT, "b.nc", "--out", "m", "--log", "{}/log"),
    "plot": ("plot", "b.nc", "--out", "{}/a.png"),
    "animate": ("animate", "b.nc", "--out", "{}/a.gif"),
    "inspect": ("inspect", "b.bag", "--plot", "{}/a.png"),
    "record-virtual": ("record-virtual", "sine:1", "--out", "{}/a.bag"),
    "view": ("view", "b.nc", "--export", "{}/a.html"),
}  # fmt: skip


@pytest.mark.parametrize("output", OUTPUTS)
def test_what_cannot_be_written_is_said_before_anything_is_computed_or_read(tmp_path, monkeypatch, output):
    monkeypatch.chdir(tmp_path)
    locked = Path("locked")
    locked.mkdir(mode=0o555)
    if os.access(locked, os.W_OK):
        # who may write everywhere may not there
        locked = Path("/proc")
    result = run(*(word.format(locked) for word in OUTPUTS[output]))
    assert result.exit_code == 2 and result.stderr.count("\n") == 1
    assert result.stderr.startswith(f"error: {locked}/")
    assert f": nothing can be written in {locked}: " in result.stderr
    assert {"locked"} == set(os.listdir())


def test_an_older_file_is_no_hindrance_and_stays_as_it_is(tmp_path):
    old = [tmp_path / "a.nc", tmp_path / "a.png"]
    for path in old:
        path.write_text("old")
    folder = tmp_path / "new" / "newer"
    require_writable(*old, [tmp_path, folder])
    require_writable(Path(os.devnull))
    assert [path.read_text() for path in old] == ["old", "old"]
    assert set(os.listdir(tmp_path)) == {"a.nc", "a.png"}
    with pytest.raises(ValueError, match=r"a.nc is a file; allowed is a folder"):
        require_writable(folders=[old[0] / "in"])
