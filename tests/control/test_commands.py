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


def test_reach_tells_tensions_that_reach():
    tip = kc.equilibrium(kc.load_robot(ROBOT), [4.0, 1.0, 0.0, 0.0]).tip_position[0]
    facts = told("reach", ROBOT, "--position", *tip)
    assert facts["result"] == "reached" and facts["converged"] and facts["position_error"] < 1e-8
    np.testing.assert_allclose(facts["control"], [4.0, 1.0, 0.0, 0.0], atol=1e-5)
    text = run("reach", ROBOT, "--position", *tip).stdout
    assert text.startswith("reached; ") and "at the lower limit: 3, 4" in text


def test_reach_says_what_it_cannot():
    facts = told("reach", ROBOT, "--position", 0, 0, 2, "--high", "1,2,3,4")
    assert facts["result"] == "unreachable" and not facts["converged"]
    assert 1.3 < facts["position_error"] < 1.5


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
        (("reach", ROBOT, "--position", 0, 0, 1, "--low", "a"), "--low 'a': allowed is a number"),
        (("workspace", ROBOT, "--out", "w.txt"), "w.txt: allowed is a name that ends in"),
        (("workspace", ROBOT, "--out", "w.nc", "--low", 3, "--high", 1), "low is 3 and high 1"),
    ],
)
def test_wrong_arguments_end_in_one_line(arguments, message):
    ran = run(*arguments)
    assert ran.exit_code == 2 and message in ran.stderr and ran.stderr.count("\n") == 1
