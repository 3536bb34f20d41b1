"""What a newcomer meets: wrong calls say what was given and what is allowed; the doctor; the logger."""

import logging
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import knode_cosserat as kc
from knode_cosserat.cli import app

ROBOT = kc.load_robot("delrin-tendon-robot")
TENSIONS = kc.controls.sine(1.5, 5, 0.05)


@pytest.fixture(scope="module")
def moved():
    return kc.simulate(ROBOT, TENSIONS, 0.05)


# each: a call that is wrong, what of it the error repeats, and what of the allowed it names

WRONG = {
    "a robot by its name": (lambda t: kc.simulate("delrin", TENSIONS, 0.05), "str", "a robot or"),
    "no robot": (lambda t: kc.simulate(None, TENSIONS, 0.05), "None", "a robot or"),
    "robots mixed with text": (lambda t: kc.simulate([ROBOT, "x"], TENSIONS, 0.05), "str 'x'", "or a list"),
    "controls as text": (lambda t: kc.simulate(ROBOT, "sine", 0.05), "'sine'", r"\(steps, 4\)"),
    "three tendons": (
        lambda t: kc.simulate(ROBOT, TENSIONS[:, :3], 0.05), r"\(5, 3\)", r"\(steps, 4\).*\(N\)",
    ),
    "one row": (lambda t: kc.simulate(ROBOT, TENSIONS[0], 0.05), r"\(4,\)", r"\(steps, 4\)"),
    "controls that are NaN": (lambda t: kc.simulate(ROBOT, TENSIONS * np.nan, 0.05), "nan", "finite"),
    "complex controls": (lambda t: kc.simulate(ROBOT, TENSIONS * 1j, 0.05), "complex", r"\(steps, 4\)"),
    "dt below zero": (lambda t: kc.simulate(ROBOT, TENSIONS, -0.05), "-0.05", "positive number of seconds"),
    "dt as text": (lambda t: kc.simulate(ROBOT, TENSIONS, "0.05"), "'0.05'", "a number"),
    "dt as an array": (lambda t: kc.simulate(ROBOT, TENSIONS, np.ones(2)), "array", "a number"),
    "a scheme of space for time": (
        lambda t: kc.simulate(ROBOT, TENSIONS, 0.05, time="lobatto4"), "'lobatto4'", "bdf2",
    ),
    "initial as text": (lambda t: kc.simulate(ROBOT, TENSIONS, 0.05, initial="x"), "str", "a Trajectory"),
    "newton as a number": (lambda t: kc.simulate(ROBOT, TENSIONS, 0.05, newton=3), "3", "a NewtonOptions"),
    "a tolerance below zero": (lambda t: kc.solvers.NewtonOptions(tolerance=-1.0), "-1", "above 0"),
    "an unknown way to fail": (
        lambda t: kc.simulate(ROBOT, TENSIONS, 0.05, on_failure="x"), "'x'", '"raise" or "return"',
    ),
    "a rest under nothing": (lambda t: kc.equilibrium(ROBOT, None), "None", r"\(4,\)"),
    "a rest under a number": (lambda t: kc.equilibrium(ROBOT, 3.0), "3.0", r"\(c,\)"),
    "a robot that is not there": (lambda t: kc.load_robot("nope"), "nope", "catalog has"),
    "a robot that is a number": (lambda t: kc.load_robot(3), "3", "a text or a path"),
    "a length in mm": (lambda t: ROBOT.replace(length=635), "635", "0.001 and 20 m"),
    "a length as text": (lambda t: ROBOT.replace(length="long"), "'long'", "0.001 and 20 m"),
    "a parameter misspelt": (lambda t: ROBOT.replace(lenght=1), "'lenght'", "there are length"),
    "gravity as a number": (lambda t: ROBOT.replace(gravity=-9.81), "-9.81", "three numbers.*m/s2"),
    "half a node": (lambda t: ROBOT.replace(nodes=10.5), "10.5", "whole number from 2"),
    "a fit of text": (lambda t: kc.fit("x", [t]), "str", "a robot"),
    "a fit to one trajectory": (lambda t: kc.fit(ROBOT, t), "Trajectory", r"did you mean \[data\]"),
    "a fit to arrays": (lambda t: kc.fit(ROBOT, [np.zeros(3)]), "array", "a Trajectory.*load_recording"),
    "a fit to nothing": (lambda t: kc.fit(ROBOT, []), "no trajectories", "at least one"),
    "a config by its name": (lambda t: kc.fit(ROBOT, [t], "paper"), "'paper'", "a FitConfig"),
    "a metric of text": (lambda t: kc.metrics.tip_dtw(t, "x"), "str", "a Trajectory"),
    "a metric of an array": (lambda t: kc.metrics.pose_mse(np.zeros((3, 3)), t), "ndarray", "a Trajectory"),
    "trajectories of two lengths": (lambda t: kc.metrics.tip_rmse(t, t[:3]), "6 rows.*3", "the same number"),
    "errors of a number": (lambda t: kc.metrics.state_errors(t, 3), "3", "a Trajectory"),
    "to explain a robot": (lambda t: kc.learning.explain(ROBOT), "TendonRobot", "a KNODE"),
    "a missing trajectory": (lambda t: kc.load_trajectory("nope.nc"), "nope.nc", "no such file"),
    "a trajectory of text": (lambda t: kc.load_trajectory(__file__), "test_first_contact", "netCDF"),
    "a missing model": (lambda t: kc.load_model("nope"), "nope", "no such file"),
    "a model of text": (lambda t: kc.load_model(__file__), "test_first_contact", "not a netCDF-4 file"),
    "a missing recording": (lambda t: kc.load_recording("nope.bag"), "nope.bag", "no such file"),
    "a field that is not there": (lambda t: t.part("k"), "'k'", "there are p, h"),
    "a tip in two dimensions": (
        lambda t: kc.inverse_kinematics(ROBOT, [0, 0], low=0, high=9), r"\(2,\)", r"\(3,\)",
    ),
    "limits the wrong way round": (
        lambda t: kc.inverse_kinematics(ROBOT, [0, 0, 0.6], low=5, high=1), "low is 5", "not be above",
    ),
    "a workspace of text": (lambda t: kc.workspace(ROBOT, "many"), "'many'", r"\(B, 4\)"),
    "a configuration of 2": (lambda t: kc.statics.configuration(ROBOT, [1, 2]), r"\(2,\)", r"\(4,\).*\(N\)"),
    "a configuration of text": (lambda t: kc.statics.configuration(ROBOT, "x"), "'x'", r"\(4,\).*\(N\)"),
    "to identify text": (lambda t: kc.identify("x", [t], parameters="all"), "str", "a robot"),
    "to identify by one": (lambda t: kc.identify(ROBOT, t, parameters="all"), "Trajectory", r"\[data\]"),
    "to identify from states": (lambda t: kc.identify(ROBOT, [t]), "Trajectory", "recordings"),
    "to estimate from text": (lambda t: kc.estimate_states("x", ROBOT), "str", "a Recording"),
    "a sine of no period": (lambda t: kc.controls.sine(0, 5, 0.05), "0", "seconds above 0"),
    "half a step": (lambda t: kc.controls.sine(1.5, 5.5, 0.05), "5.5", "a whole number"),
    "a load beyond the rod": (lambda t: kc.robots.loads.PointWrench(at=2), "2", "0 and 1"),
    "a force as a number": (lambda t: kc.robots.loads.PointWrench(force=3), r"got 3\)", "three numbers.* N"),
    "an unknown axis": (lambda t: kc.robots.ends.Driven(axes=("a",)), "'a'", "x, y, z, rx"),
    "a plane of no side": (lambda t: kc.robots.surroundings.Plane(normal=[0, 0, 0]), "0", "a direction"),
    "a stretch backwards": (lambda t: kc.robots.Stretch(begin=0.5, end=0.2), "0.2", "beyond begin, 0.5"),
    "tendons along text": (lambda t: kc.robots.RoutedTendonRobot.like("x"), "str", "tendon-driven robot"),
    "loads that are text": (
        lambda t: kc.robots.SlenderRod(length=1, radius=0.01, density=1e3, youngs_modulus=1e6, loads="x"),
        "str", "a load",
    ),
    "a stepper of text": (lambda t: kc.solvers.Stepper("x", 0.05), "str", "a robot"),
    "a step of two": (lambda t: kc.solvers.Stepper(ROBOT, 0.05).step([1, 2]), r"\(2,\)", r"\(4,\).*N\)"),
    "a scene of text": (lambda t: kc.viewer.export_scene("x", "x.html"), "str", "a Trajectory"),
    "a view of a number": (lambda t: kc.view(3), "3", "a Trajectory"),
    "a live view of text": (lambda t: kc.viewer.view_live("x"), "str", "a robot"),
    "no ensemble": (lambda t: kc.learning.load_ensemble("nope"), "nope", "member-000"),
    "to estimate parts of text": (lambda t: kc.recordings.estimate_parts("x", ROBOT), "str", "a Recording"),
    "nodes of a number": (lambda t: kc.metrics.node_error(t, 3), "int", "a Trajectory"),
    "a configuration of none": (lambda t: kc.statics.configuration("x", [1, 2, 3, 4]), "str", "a robot"),
    "the stability of a number": (lambda t: kc.statics.stability(3), "3", "a Trajectory"),
    "the stability of no row": (lambda t: kc.statics.stability(t, row="x"), "'x'", "a whole number"),
    **{
        f"a figure of text: {name}": (lambda t, name=name: getattr(kc.figures, name)("x"), "'x'", allowed)
        for name, allowed in (
            ("shape", "a Trajectory"), ("path", "a mapping of names"), ("tips", "a mapping of names"),
            ("states", "a Trajectory"), ("tensions", "a Trajectory"), ("overview", "a Trajectory"),
            ("spread", "a Trajectory"), ("workspace", "a Workspace"),
        )
    },
    "an error of text": (lambda t: kc.figures.error(t, "x"), "'x'", "a mapping of names"),
    "a motion of text": (lambda t: kc.figures.animate("x", "x.gif"), "str", "a Trajectory"),
    "a motion in a text": (lambda t: kc.figures.animate(t, "x.txt"), "x.txt", ".gif, .mp4"),
    "a save to nowhere": (lambda t: t.save("/nonexistent/x.nc"), "/nonexistent/x.nc", "No such file"),
}  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_call_says_what_it_got_and_what_it_takes(wrong, moved):
    call, given, allowed = WRONG[wrong]
    with pytest.raises(
        (ValueError, TypeError, OSError, KeyError), match=f"(?s)(?=.*{given})(?=.*{allowed})"
    ) as caught:
        call(moved)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.slow
def test_tensions_that_are_no_newtons_are_suspected():
    with pytest.raises(kc.SimulationError, match=r"tension is .* N, .* is it meant in another unit\?"):
        kc.simulate(ROBOT, 1e5 * TENSIONS, 0.05)


def test_milliseconds_are_suspected():
    with pytest.warns(UserWarning, match=r"dt is 50 s, longer than .*\(is dt in seconds\?\)"):
        kc.simulate(ROBOT, TENSIONS, 50)


def test_one_load_does_for_a_list_of_one():
    load = kc.robots.loads.PointWrench(force=[1.0, 0.0, 0.0])
    rod = {"length": 1.0, "radius": 0.01, "density": 1e3, "youngs_modulus": 1e6}
    assert (
        kc.robots.SlenderRod(**rod, loads=load).loads
        == kc.robots.SlenderRod(**rod, loads=[load]).loads
        == (load,)
    )


# the doctor


def test_the_doctor_finds_this_installation_well():
    found = kc.diagnosis.doctor()
    assert found.well and {check.name for check in found.checks} == {
        "precision",
        "cache",
        "simulation",
        "balance",
    }
    assert "all checks passed" in str(found) and found.versions["jax"]


def test_the_doctor_says_what_is_wrong(monkeypatch):
    monkeypatch.setattr("knode_cosserat.diagnosis.simulate", lambda *_: 1 / 0)
    found = kc.diagnosis.doctor()
    assert not found.well and "ZeroDivisionError" in str(found)
    done = CliRunner().invoke(app, ["doctor"])
    assert done.exit_code == 1 and "FAILED" in done.output and "mend: pip install" in done.output


# the logger


def test_it_is_quiet_unless_it_is_listened_to():
    program = (
        "import numpy as np, knode_cosserat as kc; r = kc.load_robot('delrin-tendon-robot');"
        "kc.simulate(r, np.zeros((2, 4)), 0.05)"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", program], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout == done.stderr == ""


@pytest.mark.slow
def test_recovered_steps_are_told_to_the_logger(caplog):
    pulled = np.zeros((3, 4))
    pulled[1:, 0] = 8.0
    # one linearisation is too few for a jump: recovery, which has more, solves the step
    hasty = kc.solvers.NewtonOptions(max_linearisations=1, patience=1)
    with caplog.at_level(logging.INFO, "knode_cosserat"):
        found = kc.simulate(ROBOT, pulled, 0.05, newton=hasty)
    assert found.all_valid and caplog.records
    for record in caplog.records:
        row = int(record.getMessage().removeprefix("step ").partition(":")[0])
        assert record.getMessage() == f"step {row}: {kc.Result(found.result[row]).message}"


# the shell, and types seen from outside


def test_the_shell_completes_robots_and_commands():
    line = "knode-cosserat simulate delrin-"
    env = {
        **os.environ,
        "COMP_WORDS": line,
        "COMP_CWORD": "2",
        "_KNODE_COSSERAT_COMPLETE": "complete_bash",
    }
    program = "from knode_cosserat.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", program], env=env, capture_output=True, text=True)
    assert done.stdout.split() == ["delrin-routed-tendon-robot", "delrin-tendon-robot"], done.stderr


@pytest.mark.campaign
@pytest.mark.sample
def test_a_type_checker_sees_the_types_from_outside(tmp_path):
    """`py.typed` counts: a stranger's program is checked against our signatures."""
    (tmp_path / "user.py").write_text(
        "import knode_cosserat as kc\n"
        'robot = kc.load_robot("delrin-tendon-robot")\n'
        "reveal_type(kc.equilibrium(robot, [1.0, 2.0, 3.0, 4.0]))\n"
        'kc.simulate(robot, [[1.0] * 4], dt="fast")\n'
    )
    marker = Path(kc.__file__).with_name("py.typed")
    assert marker.exists()
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--follow-imports=silent", "user.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "MYPYPATH": str(marker.parent.parent)},
    )
    assert 'Revealed type is "knode_cosserat.trajectory.Trajectory"' in done.stdout, done.stdout + done.stderr
    assert 'Argument "dt" to "simulate" has incompatible type "str"' in done.stdout
