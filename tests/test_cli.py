import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typer.testing

import knode_cosserat as kc
from knode_cosserat.cli import app
from knode_cosserat.evaluation.metrics import dtw_distance

ROBOT = "delrin-tendon-robot"
COMMANDS = ("simulate", "equilibrium", "info", "reach", "workspace", "fit", "evaluate", "plot", "animate",
            "inspect", "study simulation", "study imperfections", "study data", "study estimation",
            "record-virtual", "schema", "doctor", "view")  # fmt: skip


def run(*arguments):
    """What the program prints and exits with, in this process."""
    return typer.testing.CliRunner().invoke(app, [str(argument) for argument in arguments])


def succeeded(*arguments):
    result = run(*arguments)
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    return result.stdout


def told(*arguments):
    """The one JSON object on stdout."""
    text = succeeded(*arguments, "--json")
    assert text.count("\n") == 1
    return json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def simulated(path, *more, controls="sine:0.5", steps=16):
    return ("simulate", ROBOT, "--controls", controls, "--steps", steps, "--out", path, *more)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    path = tmp_path_factory.mktemp("truth") / "truth.nc"
    succeeded(*simulated(path))
    return path


# help


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command):
    text = succeeded(*command.split(), "--help")
    assert text.startswith(f"Usage: knode-cosserat {command}")
    assert f"\n    knode-cosserat {command}" in text
    assert "--json" in text


def test_without_a_command_there_is_help():
    assert succeeded() == succeeded("--help")
    assert all(command.split()[0] in succeeded("--help") for command in COMMANDS)


def test_the_version_is_told():
    assert succeeded("--version").startswith("knode-cosserat ")


# simulate


def test_simulate_writes_what_the_package_computes(tmp_path):
    text = succeeded(*simulated(tmp_path / "truth.nc"))
    assert "16 steps of 0.05 s" in text
    assert "16 converged" in text
    assert f"wrote {tmp_path / 'truth.nc'}\n" in text
    robot = kc.load_robot(ROBOT)
    expected = kc.simulate(robot, kc.controls.sine(period=0.5, steps=16, dt=0.05), 0.05)
    np.testing.assert_array_equal(kc.load_trajectory(tmp_path / "truth.nc").y, expected.y)


@pytest.mark.campaign
def test_simulate_takes_schemes_and_parameters(tmp_path):
    facts = told(
        *simulated(tmp_path / "a.nc", "--dt", 0.02, "--time", "bdf1", "--space", "rk4", "--nodes", 7),
        "--set", "youngs_modulus=10e9", "--set", "gravity=[0, 0, -1e0]", "--set", "drag=0",
    )  # fmt: skip
    made = kc.load_trajectory(tmp_path / "a.nc")
    assert (type(made.settings.time), type(made.settings.space)) == (kc.BDF1, kc.RK4)
    assert made.system.youngs_modulus == 10e9
    np.testing.assert_array_equal(made.system.gravity, [0, 0, -1])
    np.testing.assert_array_equal(made.system.drag, np.zeros((3, 3)))
    assert made.position.shape == (17, 7, 3)
    assert made.dt == facts["dt"] == 0.02
    assert facts["robot"] == ROBOT
    assert facts["steps"] == 16
    assert facts["results"] == {"converged": 16}
    assert facts["all_solved"]
    assert facts["first_failure"] is None
    assert facts["out"] == str(tmp_path / "a.nc")
    assert facts["figure"] is None
    np.testing.assert_array_equal(facts["tip_position"], made.tip_position[-1])


def test_simulate_takes_controls_from_a_file_at_its_own_step(tmp_path):
    tensions = kc.controls.random(12, seed=3)
    kc.controls.save(tmp_path / "tensions.csv", tensions, 0.025)
    out = tmp_path / "a.nc"
    facts = told("simulate", ROBOT, "--controls", tmp_path / "tensions.csv", "--out", out)
    assert (facts["steps"], facts["dt"]) == (12, 0.025)
    np.testing.assert_array_equal(kc.load_trajectory(out).tension[1:], tensions)


def test_simulate_draws(tmp_path):
    facts = told(*simulated(tmp_path / "a.nc", "--figure", tmp_path / "a.png"))
    assert facts["figure"] == str(tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_progress_goes_to_stderr(tmp_path):
    result = run(*simulated(tmp_path / "a.nc", "--progress", "--json"))
    assert result.exit_code == 0
    assert json.loads(result.stdout)["all_solved"]
    assert "16" in result.stderr and "step" in result.stderr


@pytest.fixture
def unsolvable(monkeypatch):
    """Whatever is simulated fails at step 3."""
    true = kc.simulate

    def failing(robot, controls, dt, *, on_failure="raise", **options):
        states = true(robot, controls, dt, **options)
        if on_failure == "raise":
            raise kc.SimulationError(3, 3 * dt, 0.5, kc.Result.NO_CONVERGENCE, "It was told to.")
        fields = {name: np.array(getattr(states, name)) for name in ("y", "z", "residual", "result")}
        for name in ("y", "z", "residual"):
            fields[name][3:] = np.nan
        fields["result"][3], fields["result"][4:] = kc.Result.NO_CONVERGENCE, kc.Result.NOT_REACHED
        parts = {name: getattr(states, name) for name in ("time", "control", "iterations")} | fields
        return kc.Trajectory(states.system, states.settings, **parts)

    monkeypatch.setattr(kc, "simulate", failing)


def test_a_failed_step_is_an_error_of_its_own(tmp_path, unsolvable):
    result = run(*simulated(tmp_path / "a.nc"))
    assert result.exit_code == 1
    assert result.stdout == ""
    assert result.stderr.startswith("error: step 3 (t = 0.15 s): no solution found; ")
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "a.nc").exists()


def test_a_failure_may_be_allowed_and_is_not_hidden(tmp_path, unsolvable):
    text = succeeded(*simulated(tmp_path / "a.nc", "--allow-failure"))
    assert "NOT SOLVED from step 3 (t = 0.15 s) on: no solution found" in text
    facts = told(*simulated(tmp_path / "a.nc", "--allow-failure"))
    assert not facts["all_solved"]
    assert facts["first_failure"] == {"step": 3, "time": pytest.approx(0.15), "message": "no solution found"}
    assert facts["results"] == {"converged": 2, "no_convergence": 1, "not_reached": 13}
    made = kc.load_trajectory(tmp_path / "a.nc")
    np.testing.assert_array_equal(made.valid, np.arange(17) < 3)
    np.testing.assert_array_equal(facts["tip_position"], made.tip_position[2])


# equilibrium


def test_equilibrium_tells_the_shape_and_what_holds_it(tmp_path):
    facts = told("equilibrium", ROBOT, "--tension", "7,5,5,7", "--out", tmp_path / "rest.nc")
    robot = kc.load_robot(ROBOT)
    rest = kc.equilibrium(robot, np.array([7.0, 5.0, 5.0, 7.0]))
    np.testing.assert_array_equal(facts["position"], rest.position[0])
    np.testing.assert_array_equal(facts["tip_position"], rest.tip_position[0])
    np.testing.assert_array_equal(kc.load_trajectory(tmp_path / "rest.nc").y, rest.y)
    # Tendons 1 and 4, at ±45 degrees, pull 2 N harder: along x. The explicit scheme gives the load to each
    # node but the last, so the sums over the rod are exact: 2√2 N/m, and the weight, over the length.
    weight = float(robot.mass_per_length) * 9.81 * 0.635
    np.testing.assert_allclose(facts["base_force"], [2 * np.sqrt(2) * 0.635, 0, -weight], atol=1e-9)
    assert facts["base_moment"][1] > 0
    # the last two nodes are one straight segment, which has the direction of the rod before its last bend
    *_, before, tip = np.array(facts["position"])
    chord = np.arccos((tip - before)[2] / np.linalg.norm(tip - before))
    assert facts["tip_inclination"] == pytest.approx(chord, abs=0.05)
    words = succeeded("equilibrium", ROBOT, "--tension", "7,5,5,7")
    assert "tip: (0.28029, 0, 0.551513) m" in words


# info


def test_info_lists_the_catalog():
    assert told("info") == {"catalog": kc.catalog()}
    assert all(name in succeeded("info") for name in kc.catalog())


def test_info_tells_every_parameter_with_unit_and_meaning():
    facts = told("info", ROBOT)
    robot = kc.load_robot(ROBOT)
    stated = robot.parameters()
    assert set(facts["parameters"]) == {*stated, "nodes"}
    words = succeeded("info", ROBOT)
    for name, parameter in stated.items():
        given = facts["parameters"][name]
        value = getattr(robot, name)
        if value is None:
            assert given["value"] is None
        else:
            np.testing.assert_array_equal(given["value"], value)
        assert (given["unit"], given["meaning"]) == (parameter.unit, parameter.meaning)
        assert f"  {name} " in words and parameter.meaning in words
    assert facts["parameters"]["nodes"]["value"] == 10


def test_info_derives_stiffness_mass_and_frequency():
    values = {name: it["value"] for name, it in told("info", ROBOT, "--set", "length=0.5")["derived"].items()}
    E, r, rho = 2.757903e9, 0.003175, 1411.6751
    A, I, G = np.pi * r**2, np.pi * r**4 / 4, E / 2.6
    assert values["G"] == pytest.approx(G, rel=1e-12)
    assert values["Kse"] == pytest.approx([G * A, G * A, E * A], rel=1e-12)
    assert values["Kbt"] == pytest.approx([E * I, E * I, 2 * G * I], rel=1e-12)
    assert values["mass"] == pytest.approx(rho * A * 0.5, rel=1e-12)
    # a cantilever's first mode: f = 0.55959 √(EI / ρAL⁴), from any handbook
    assert values["frequency"] == pytest.approx(0.55959 * np.sqrt(E * I / (rho * A * 0.5**4)), rel=1e-4)


# fit, and models in the place of robots


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Two trajectories to learn from, and one to predict."""
    folder = tmp_path_factory.mktemp("data")
    for name, period, steps in (("a", 0.5, 19), ("b", 1.0, 19), ("truth", 1.5, 40)):
        succeeded(*simulated(folder / f"{name}.nc", controls=f"sine:{period}", steps=steps))
    return folder


@pytest.fixture(scope="module")
def fitted(data):
    """A model that had to find out the length, and what the program told of it."""
    return told("fit", ROBOT, data / "a.nc", data / "b.nc", "--set", "length=0.4", "--out", data / "model")


def test_fit_learns_what_is_missing_and_the_model_predicts(data, fitted):
    assert (fitted["robot"], fitted["preset"], fitted["rows"]) == (ROBOT, "best", 40)
    (one,) = fitted["models"]
    assert (one["seed"], fitted["out"]) == (0, str(data / "model"))
    stretch = next(each for each in one["found"] if each["part"] == "length")
    assert stretch["coefficient"] == pytest.approx(0.635 / 0.4 - 1, rel=1e-6)
    (before,) = told("evaluate", ROBOT, data / "truth.nc", "--set", "length=0.4")["references"]
    (after,) = told("evaluate", data / "model", data / "truth.nc")["references"]
    assert after["tip_dtw"] < 1e-3 * before["tip_dtw"]
    assert after["pose_mse"] < 1e-3 * before["pose_mse"]


def test_fit_tells_what_it_did(data, tmp_path):
    text = succeeded(
        "fit", ROBOT, data / "a.nc", "--set", "length=0.4", "--rows", 12, "--out", tmp_path / "m"
    )
    assert f"learned what {ROBOT} misses from 1 trajectories of 12 rows in all: preset best" in text
    assert "+0.5875 of the knowledge's length" in text
    assert text.endswith(f"wrote {tmp_path / 'm'}\n")


@pytest.mark.campaign
def test_fit_trains_an_ensemble_of_networks_at_once(data, tmp_path):
    out = tmp_path / "models"
    facts = told(
        "fit", ROBOT, data / "a.nc", "--set", "length=0.6", "--preset", "paper", "--seeds", "3,1",
        "--epochs", 20, "--checkpoint", tmp_path / "kept", "--log", tmp_path / "log", "--out", out,
    )  # fmt: skip
    assert [model["seed"] for model in facts["models"]] == [3, 1]
    one, other = (model["segments"] for model in facts["models"])
    assert one["steps"] == other["steps"] == 20
    assert one["loss"] != other["loss"]
    assert any((tmp_path / "kept").iterdir()) and any((tmp_path / "log").iterdir())
    members = kc.load_ensemble(out)
    assert [member.about.facts["segments"]["loss"][-1] for member in members] == [one["loss"], other["loss"]]
    (row,) = told("evaluate", out, data / "a.nc", "--rows", 5)["references"]
    reference = kc.load_trajectory(data / "a.nc")
    mean = members.predict(reference.control[1:], reference.dt)
    assert row["rows"] == 5
    assert row["tip_dtw"] == dtw_distance(mean.tip_position[:5], reference.tip_position[:5])


@pytest.mark.campaign
def test_a_model_is_taken_where_a_robot_is(data, fitted, tmp_path):
    model, out = data / "model", tmp_path / "a.nc"
    succeeded("simulate", model, "--controls", "sine:1.5", "--steps", 40, "--out", out)
    (row,) = told("evaluate", out, data / "truth.nc")["references"]
    assert row["tip_rmse"] < 1e-6
    tips = [told("equilibrium", it, "--tension", "7,5,5,7")["tip_position"] for it in (model, ROBOT)]
    np.testing.assert_allclose(*tips, atol=1e-5)
    facts = told("info", model)
    assert facts["kind"] == "KNODE"
    assert facts["parameters"]["length"]["value"] == 0.4
    assert "+0.5875 of the knowledge's length" in succeeded("info", model)
    assert facts["found"] == fitted["models"][0]["found"]
    succeeded("plot", out, "--out", tmp_path / "a.png")


# evaluate


def test_evaluate_compares_trajectories(tmp_path, truth):
    other = tmp_path / "other.nc"
    succeeded(*simulated(other, "--set", "length=0.6"))
    facts = told("evaluate", other, truth, other)
    a, b = kc.load_trajectory(other), kc.load_trajectory(truth)
    expected = {"tip_dtw": kc.tip_dtw(a, b), "pose_mse": kc.pose_mse(a, b), "tip_rmse": kc.tip_rmse(a, b)}
    first, second = facts["references"]
    assert first == {"reference": str(truth), "rows": 17, **expected}
    assert second == {"reference": str(other), "rows": 17, "tip_dtw": 0.0, "pose_mse": 0.0, "tip_rmse": 0.0}
    words = succeeded("evaluate", other, truth, other)
    assert f"{expected['tip_dtw']:.4g}" in words and "tip DTW [m]" in words


def test_evaluate_simulates_a_robot_as_the_papers_table_has_it(tmp_path):
    # protocol.md: stiffness, sine: DTW 19.99, MSE 12.52; the paper keeps the first 100 rows
    out = tmp_path / "truth.nc"
    succeeded(*simulated(out, controls="sine:1.5", steps=100))
    (row,) = told("evaluate", ROBOT, out, "--set", "youngs_modulus=10e9", "--rows", 100)["references"]
    assert row["rows"] == 100
    assert row["tip_dtw"] == pytest.approx(19.99, abs=0.005)
    assert row["pose_mse"] == pytest.approx(12.52, abs=0.005)


@pytest.mark.campaign
def test_evaluate_simulates_by_the_references_settings(tmp_path):
    out, robot = tmp_path / "a.nc", tmp_path / "robot.yaml"
    succeeded(*simulated(out, "--dt", 0.02, "--time", "bdf1", "--space", "rk4", "--nodes", 7))
    kc.save_robot(kc.load_robot(ROBOT).replace(nodes=7), robot)
    (row,) = told("evaluate", robot, out)["references"]
    assert row["tip_rmse"] < 1e-9


# plot


@pytest.mark.parametrize("kind", ["overview", "shape", "path", "tip", "states", "tensions"])
def test_plot_draws(tmp_path, truth, kind):
    out = tmp_path / "figure.svg"
    text = succeeded("plot", truth, "--out", out, "--kind", kind)
    assert text == f"wrote {out}\n"
    assert "<svg" in out.read_text()


def test_plot_tells_in_json(tmp_path, truth):
    out = tmp_path / "figure.pdf"
    facts = told("plot", truth, "--out", out)
    assert facts == {"trajectories": [str(truth)], "kind": "overview", "out": str(out)}
    assert out.read_bytes().startswith(b"%PDF")


def test_plot_draws_several_over_each_other(tmp_path, truth):
    other = tmp_path / "other.nc"
    succeeded(*simulated(other, "--set", "youngs_modulus=5e9"))
    for kind in ("compare", "error", "path"):
        out = tmp_path / f"{kind}.svg"
        succeeded("plot", truth, other, "--out", out, "--kind", kind, "--view", "xy", "--columns", 2)
        assert "<svg" in out.read_text()
    assert told("plot", truth, other, "--out", out)["kind"] == "compare"
    for given, words in (
        ((truth, other, "--kind", "shape"), "draws one"),
        ((truth, "--kind", "error"), "needs"),
    ):
        failed = run("plot", *given, "--out", out)
        assert failed.exit_code == 2 and words in failed.stderr


# animate


def test_animate_writes_a_motion(tmp_path, truth):
    out = tmp_path / "it.gif"
    assert succeeded("animate", truth, "--out", out, "--fps", 10, "--view", "xz") == f"wrote {out}\n"
    assert out.read_bytes().startswith(b"GIF89a")
    failed = run("animate", truth, "--out", tmp_path / "it.mov")
    assert failed.exit_code == 2 and "ends in .gif, .mp4" in failed.stderr
    failed = run("animate", truth, truth, "--out", out)
    assert failed.exit_code == 2 and "given twice" in failed.stderr


# what is wrong


def bad_inputs():
    simulation = ("simulate", ROBOT, "--out", "a.nc")
    sine = (*simulation, "--controls", "sine:1.5")
    full = (*sine, "--steps", "3")
    return [
        (("simulat",), "simulate"),
        (("info", "--colour"), "--colour"),
        ((*simulation, "--steps", "3"), "--controls"),
        (("simulate", ROBOT, "--controls", "sine:1.5", "--steps", "3"), "--out"),
        ((*sine, "--steps", "three"), "--steps"),
        ((*sine, "--steps", "0"), "steps"),
        ((*sine, "--steps", "-3"), "steps"),
        ((*sine, "--steps", str(10**13)), "allocate"),
        (sine, "number of steps"),
        ((*full, "--dt", "0"), "dt is 0"),
        ((*full, "--dt", "nan"), "dt is nan"),
        ((*full, "--time", "rk4"), "trapezoidal"),
        ((*full, "--space", "bdf2"), "rk4"),
        ((*full, "--nodes", "1"), "nodes is 1"),
        ((*full, "--set", "colour=red"), "no parameter 'colour'"),
        ((*full, "--set", "length"), "NAME=VALUE"),
        ((*full, "--set", "length=["), "NAME=VALUE"),
        ((*full, "--set", "length=long"), "length is 'long'"),
        ((*full, "--set", "length=-1"), "length is -1"),
        ((*full, "--set", "youngs_modulus=2.7"), "youngs_modulus is 2.7"),
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
        (("info", "nobot"), "the catalog has delrin-"),
        (("info", "--set", "length=1"), "name it"),
        (("fit", ROBOT, "nowhere.nc", "--out", "m"), "nowhere.nc: no such file"),
        (("fit", ROBOT, "--out", "m"), "TRAJECTORY"),
        (("fit", ROBOT, "broken.nc", "--out", "m"), "broken.nc: not a netCDF-4 file"),
        (("fit", ROBOT, "broken.nc"), "--out"),
        (("fit", ROBOT, "broken.nc", "--out", "nowhere/m"), "no folder nowhere"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--preset", "worst"), "worst"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--seeds", "a,b"), "whole numbers, such as 0,1,2"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--seeds", "1,1"), "several different ones"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--seed", "1", "--seeds", "1,2"), "give one of them"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--seed", "-1"), "whole number from 0"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--epochs", "5"), "the preset best has none"),
        (("fit", ROBOT, "broken.nc", "--out", "m", "--preset", "paper", "--epochs", "0"), "epochs is 0"),
        (("fit", "nobot", "broken.nc", "--out", "m"), "nobot"),
        (("fit", "broken.model", "broken.nc", "--out", "m"), "broken.model"),
        (("fit", ROBOT, "broken.nc", "--out", "broken.nc", "--seeds", "1,2"), "this is a file"),
        (("info", "broken.model"), "broken.model"),
        (("info", "."), "this is a folder"),
        (("evaluate", ".", "broken.nc"), "no ensemble here"),
        (("study",), "command"),
        (("study", "simulation"), "--out"),
        (("study", "simulation", "--out", "broken.nc"), "this is a file"),
        (("study", "simulation", "--out", "o", "--seeds", "0"), "--seeds"),
        (("study", "simulation", "--out", "o", "--methods", "best,worst"), "'worst' is unknown"),
        (("study", "imperfections", "--out", "o", "--only", "damping,rust"), "'rust' is unknown"),
        (("study", "data", "--out", "o", "--methods", "paper, no knowledge,magic"), "'magic' is unknown"),
        (("study", "simulation", "--out", "o", "--workers", "2", "--dask", "a:1"), "give one of them"),
        (("evaluate", "nowhere.nc", "nowhere.nc"), "nowhere.nc: no such file"),
        (("evaluate", "nobot", "nowhere.nc"), "nobot"),
        (("evaluate", ROBOT, "broken.nc"), "broken.nc: not a netCDF-4 file"),
        (("evaluate", ROBOT), "REFERENCE"),
        (("plot", "nowhere.nc", "--out", "a.png"), "nowhere.nc: no such file"),
        (("plot", "broken.nc", "--out", "a.png"), "broken.nc: not a netCDF-4 file"),
        (("plot", "broken.nc", "--out", "a"), "ends in .png"),
        (("plot", "broken.nc", "--out", "a.png", "--kind", "cake"), "--kind"),
    ]


@pytest.mark.parametrize(("arguments", "words"), bad_inputs())
@pytest.mark.parametrize("as_json", [False, True])
def test_bad_input_gives_status_2_and_one_line(tmp_path, monkeypatch, arguments, words, as_json):
    monkeypatch.chdir(tmp_path)
    for name in ("broken.csv", "broken.yaml", "broken.nc"):
        Path(name).write_text("this: [is\nnot right")
    Path("broken.model").write_text("knode-cosserat model, format 1, package 0.1.0\nbroken")
    # a group of commands has no --json
    result = run(*arguments, *(["--json"] if as_json and arguments != ("study",) else []))
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith("error: ")
    assert words in result.stderr
    assert result.stderr.count("\n") == 1 and result.stderr.endswith("\n")
    assert not {"a.nc", "a.png", "m", "o"} & set(os.listdir())


def test_trajectories_that_cannot_be_compared_give_one_line(tmp_path, truth):
    succeeded(*simulated(tmp_path / "short.nc", steps=9))
    result = run("evaluate", tmp_path / "short.nc", truth)
    assert result.exit_code == 2
    assert result.stderr == (
        f"error: {truth}: prediction has 10 rows and reference has 17; both must have the same number\n"
    )
    result = run("fit", ROBOT, truth, tmp_path / "short.nc", "--set", "nodes=8", "--out", tmp_path / "m")
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: {truth} has 10 nodes of 19 numbers; the knowledge has 8")
    result = run("info", truth)
    assert result.exit_code == 2
    assert "this is a trajectory" in result.stderr
    result = run("evaluate", truth, truth, "--set", "length=1")
    assert result.exit_code == 2
    assert "--set changes a robot" in result.stderr


def test_a_mistake_of_ours_is_not_taken_for_one_of_the_users(monkeypatch):
    def broken(name):
        raise TypeError("a bug")

    monkeypatch.setattr(kc, "load_robot", broken)
    assert isinstance(run("info", ROBOT).exception, TypeError)


# the program itself


def python(*arguments, cwd):
    """Python in a process of its own, with the package that is tested here."""
    source = str(Path(importlib.util.find_spec("knode_cosserat").origin).parents[1])
    return subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=cwd, env=os.environ | {"PYTHONPATH": source},
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120,
    )  # fmt: skip


def program(*arguments, cwd):
    """The program as the entry point `knode-cosserat` starts it."""
    return python("-c", "from knode_cosserat.cli import main; main()", *arguments, cwd=cwd)


def test_the_program_simulates(tmp_path):
    done = program(*simulated("truth.nc", "--json"), cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["results"] == {"converged": 16}
    assert kc.load_trajectory(tmp_path / "truth.nc").all_valid


def test_the_program_fails_in_one_line(tmp_path):
    done = program("info", "nobot", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    names = ", ".join(kc.catalog())
    assert done.stderr == f"error: nobot: no such file or robot; the catalog has {names}\n"


@pytest.mark.campaign
def test_the_demonstration_runs_and_says_what_it_shows(tmp_path):
    demo = Path(__file__).parents[1] / "examples" / "demo.py"
    done = python(demo, "--out", "pictures", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    written = {path.name for path in (tmp_path / "pictures").iterdir()}
    assert written == {"truth.nc", "overview.png", "recording.png", "model", "learning.png"}
    assert "tip DTW 61." in done.stdout
    assert "simulated stand-in robot" in done.stdout.replace("\n   ", " ")
    rows = {line[3:33].strip(): line[33:].split() for line in done.stdout.splitlines()}
    before, published, ours = (
        [float(word) for word in rows[label]]
        for label in ("the model, before", "the paper's KNODE, published", "this package's")
    )
    assert before == pytest.approx([42.70, 34.57, 23.13, 21.44], rel=5e-3)
    assert published == pytest.approx([5.07, 10.95, 1.31, 5.94], rel=5e-3)
    assert all(own < 0.01 * paper for own, paper in zip(ours, published, strict=True))
