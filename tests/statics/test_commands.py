"""The commands `reach` and `workspace`."""

import json

import numpy as np
import pytest
import typer.testing
import xarray

import knode_cosserat as kc
from knode_cosserat.cli import app

ROBOT = "delrin-tendon-robot"


def run(*arguments):
    return typer.testing.CliRunner().invoke(app, [str(argument) for argument in arguments])


def told(*arguments):
    ran = run(*arguments, "--json")
    assert ran.exit_code == 0, ran.stderr
    return json.loads(ran.stdout)


@pytest.mark.slow
def test_reach_tells_tensions_that_reach():
    tip = kc.equilibrium(kc.load_robot(ROBOT), [4.0, 1.0, 0.0, 0.0]).tip_position[0]
    facts = told("reach", ROBOT, "--position", *tip)
    assert facts["result"] == "reached" and facts["converged"] and facts["position_error"] < 1e-8
    np.testing.assert_allclose(facts["control"], [4.0, 1.0, 0.0, 0.0], atol=1e-5)
    text = run("reach", ROBOT, "--position", *tip).stdout
    assert text.startswith("reached; ") and "at the lower limit: 3, 4" in text


@pytest.mark.slow
def test_reach_says_what_it_cannot():
    facts = told("reach", ROBOT, "--position", 0, 0, 2, "--high", "1,2,3,4")
    assert facts["result"] == "unreachable" and not facts["converged"]
    assert 1.3 < facts["position_error"] < 1.5


ROD = """
format: 2
kind: slender-rod
parameters:
  length: 0.5
  radius: 0.005
  density: 1000.0
  youngs_modulus: 2.0e+7
  bending_damping: 1.0e-4
  base_end: {kind: driven, axes: [z, ry]}
  loads:
    - {kind: point-wrench, at: 0.5, force: [0.02, 0, 0], controlled: true}
"""


@pytest.fixture
def rod(tmp_path):
    (tmp_path / "rod.yaml").write_text(ROD)
    return tmp_path / "rod.yaml"


@pytest.mark.campaign
def test_reach_names_controls_that_are_no_tensions(rod):
    arguments = ("reach", rod, "--position", 0.1, 0, 0.48, "--low", -0.3, "--high", "0.3,0.3,0.3")
    facts = told(*arguments)
    assert facts["names"] == ["base_z", "base_ry", "load0_scale"] and facts["units"] == ["m", "rad", "1"]
    text = run(*arguments).stdout
    z, turn, scale = facts["control"]
    assert f"controls: base_z={z:.6g} m, base_ry={turn:.6g} rad, load0_scale={scale:.6g}\n" in text
    assert "tension" not in text and " N" not in text
    held = run("reach", rod, "--position", 0, 0, 0.1, "--low", "-0.1,0,0", "--high", "0.1,0,0").stdout
    assert "at the lower limit: base_z, base_ry, load0_scale" in held
    for command in ("reach", "workspace"):
        assert "controls (N)" not in " ".join(run(command, "--help").stdout.split())


@pytest.mark.campaign
def test_reach_says_that_a_pose_is_unstable(rod):
    """Upright, and beyond Greenhill's load: straight it is in equilibrium, and falls."""
    arguments = ("--position", 0, 0, 0.5, "--low", 0, "--high", "0.1,0,0", "--tolerance", 1e-2)
    falls = ("reach", rod, *arguments, "--set", "youngs_modulus=1.0e6")
    assert told(*falls)["unstable"] is True and "UNSTABLE: a small disturbance" in run(*falls).stdout
    stands = ("reach", rod, *arguments, "--set", "youngs_modulus=2.0e9")
    assert told(*stands)["unstable"] is False and "UNSTABLE" not in run(*stands).stdout


def test_workspace_writes_and_draws(tmp_path):
    out, picture = tmp_path / "w.nc", tmp_path / "w.png"
    facts = told("workspace", ROBOT, "--count", 40, "--out", out, "--picture", picture)
    assert facts["unsolved"] == 0 and picture.stat().st_size > 5_000
    with xarray.open_dataset(out, engine="h5netcdf") as read:
        np.testing.assert_allclose(read["position"].values.min(axis=0), facts["box"][0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("reach", ROBOT), "neither position nor quaternion"),
        (
            ("reach", ROBOT, "--position", 0, 0, 1, "--low", "a"),
            "--low must be one number for all controls, or 4, one for each (got 'a')",
        ),
        (("workspace", ROBOT, "--out", "w.txt"), "w.txt: the name must end in"),
        (("workspace", ROBOT, "--out", "w.nc", "--low", 3, "--high", 1), "low is 3 and high 1"),
    ],
)
def test_wrong_arguments_end_in_one_line(arguments, message):
    ran = run(*arguments)
    assert ran.exit_code == 2 and message in ran.stderr and ran.stderr.count("\n") == 1


ARM = """
format: 2
kind: slender-rod
parameters:
  {length: 180 mm, radius: 11 mm, youngs_modulus: 300 kPa, density: 1080 kg/m3, bending_damping: 3.7e-5,
   effects: [{kind: chambers, angles: [0.0, 2.0, 4.0], offset: 7 mm, radius: 3 mm}]}
"""


@pytest.mark.parametrize(
    ("command", "options"),
    [
        (("reach", "--position", 0, 0, 0.1), "--low and --high"),
        (("workspace", "--out", "w.nc", "--low", -10), "--high"),
        (("control", "--reference", "circle:radius=0.03,period=4"), "--low, --high and --rate"),
        (("control", "--reference", "circle:radius=0.03,period=4", "--low", 0, "--high", 2e4), "--rate"),
    ],
)
def test_controls_that_are_no_tensions_need_limits(tmp_path, monkeypatch, command, options):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.yaml").write_text(ARM)
    ran = run(command[0], "arm.yaml", *command[1:])
    assert ran.exit_code == 2 and ran.stderr.count("\n") == 1
    assert (
        f"limits are needed for the controls pressure (Pa): give {options}, one number for all, or one for "
        "each of 3" in ran.stderr
    )


def test_a_workspace_is_within_the_limits_that_a_robot_states(tmp_path):
    (tmp_path / "arm.yaml").write_text(
        ARM.replace("radius: 3 mm}", "radius: 3 mm, lowest: -1 kPa, highest: 20 kPa}")
    )
    out = tmp_path / "w.nc"
    assert told("workspace", tmp_path / "arm.yaml", "--count", 64, "--out", out)["unsolved"] == 0
    with xarray.open_dataset(out, engine="h5netcdf") as read:
        pressures = read["control"].values
    assert -1e3 <= pressures.min() < 0.0 and 19e3 < pressures.max() <= 20e3
    assert told("workspace", tmp_path / "arm.yaml", "--count", 8, "--out", out, "--low", 5e3)["unsolved"] == 0
    with xarray.open_dataset(out, engine="h5netcdf") as read:
        assert read["control"].values.min() >= 5e3


@pytest.mark.slow
def test_modes_are_printed_and_drawn(rod, tmp_path):
    arguments = ("modes", rod, "--set", "gravity=0,0,9.81", "--count", 3)
    facts = told(*arguments, "--control", "base_z=0", "--picture", tmp_path / "modes.png")
    hanging = kc.load_robot(rod).replace(gravity=(0.0, 0.0, 9.81))
    found = kc.statics.modes(kc.equilibrium(hanging, np.zeros(3), space="lobatto4"), count=3)
    np.testing.assert_allclose(facts["frequency"], found.frequency)
    np.testing.assert_allclose(facts["damping"], found.damping)
    assert (tmp_path / "modes.png").stat().st_size > 10_000
    text = run(*arguments, "--control", "0,0,0").stdout
    assert "damping ratio" in text and len(text.splitlines()) == 4
    assert "no control is given" in run(*arguments).stderr
