import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.cli.arguments import limits_of
from knode_cosserat.cli.kinematics import TipTarget
from knode_cosserat.cli.program import joined_vectors
from knode_cosserat.cli.robots import Held
from knode_cosserat.control.commands import CONTROLLERS
from knode_cosserat.metrics import dtw_distance
from tests.commands import COMMANDS, ROBOT, run, simulated, succeeded, told
from tests.viewer.test_scene import Scripts, unpacked

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


def test_without_the_distribution_for_hardware_its_commands_name_it(monkeypatch):
    monkeypatch.setattr("knode_cosserat.cli.program.entry_points", lambda **_: ())
    for command in ("robot", "robot-parts"):
        result = run(command, "--help")
        assert result.exit_code == 2
        assert result.stderr == (
            f"error: {command} needs knode-cosserat-hardware: pip install knode-cosserat-hardware\n"
        )


# simulate


def test_simulate_writes_what_the_package_computes(tmp_path):
    text = succeeded(*simulated(tmp_path / "truth.nc"))
    assert "16 steps of 0.05 s" in text
    assert "16 converged" in text
    assert f"wrote {tmp_path / 'truth.nc'}\n" in text
    robot = kc.load_robot(ROBOT)
    sine = kc.controls.sine(period=0.5, steps=16, dt=0.05)
    expected = kc.simulate(robot, sine, 0.05, initial="equilibrium")
    np.testing.assert_array_equal(kc.load_trajectory(tmp_path / "truth.nc").y, expected.y)


def test_a_robot_that_sags_is_simulated_from_its_equilibrium(tmp_path):
    rod = kc.robots.SlenderRod(
        length=0.3,
        radius=0.004,
        density=1200.0,
        youngs_modulus=2e8,
        bending_damping=1e-3,
        nodes=6,
        gravity=[9.81, 0.0, 0.0],
        base_end=kc.robots.ends.Driven(axes=("x",)),
    )
    kc.save_robot(rod, tmp_path / "rod.yaml")
    words = ("simulate", tmp_path / "rod.yaml", "--controls", "none", "--steps", 4, "--dt", 0.02, "--out")
    told(*words, tmp_path / "a.nc")
    tips = kc.load_trajectory(tmp_path / "a.nc").tip_position
    assert np.ptp(tips, axis=0).max() < 1e-7 and tips[0, 0] > 0.01
    told(*words, tmp_path / "b.nc", "--initial", "unstressed")
    tips = kc.load_trajectory(tmp_path / "b.nc").tip_position
    np.testing.assert_allclose(tips[0], [0.0, 0.0, 0.3], atol=1e-12)
    assert tips[-1, 0] > 1e-3
    result = run(*words, tmp_path / "c.nc", "--initial", "straight")
    assert (
        result.exit_code == 2 and 'allowed is a Trajectory or "equilibrium" or "unstressed"' in result.stderr
    )


def test_a_robot_without_controls_needs_none(tmp_path):
    rod = kc.robots.SlenderRod(
        length=0.3,
        radius=0.004,
        density=1200.0,
        youngs_modulus=2e8,
        bending_damping=1e-3,
        nodes=6,
        gravity=[9.81, 0.0, 0.0],
    )
    kc.save_robot(rod, tmp_path / "rod.yaml")
    words = (
        "simulate",
        tmp_path / "rod.yaml",
        "--steps",
        4,
        "--dt",
        0.02,
        "--initial",
        "unstressed",
        "--out",
    )
    told(*words, tmp_path / "a.nc")
    told(*words, tmp_path / "b.nc", "--controls", "none")
    first, second = (kc.load_trajectory(tmp_path / name) for name in ("a.nc", "b.nc"))
    assert first.control.shape == (5, 0) and first.tip_position[-1, 0] > 1e-3
    np.testing.assert_array_equal(first.y, second.y)


@pytest.mark.campaign
def test_simulate_takes_schemes_and_parameters(tmp_path):
    facts = told(
        *simulated(tmp_path / "a.nc", "--dt", 0.02, "--time", "bdf1", "--space", "lobatto4", "--nodes", 7),
        "--set",
        "youngs_modulus=10e9",
        "--set",
        "gravity=[0, 0, -1e0]",
        "--set",
        "drag=0",
    )
    made = kc.load_trajectory(tmp_path / "a.nc")
    assert (type(made.settings.time), type(made.settings.space)) == (kc.solvers.BDF1, kc.solvers.Lobatto4)
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
    np.testing.assert_array_equal(kc.load_trajectory(out).held_tension[:-1], tensions)


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


@pytest.mark.slow
def test_equilibrium_tells_the_shape_and_what_holds_it(tmp_path):
    facts = told("equilibrium", ROBOT, "--tension", "7,5,5,7", "--out", tmp_path / "rest.nc")
    robot = kc.load_robot(ROBOT)
    rest = kc.equilibrium(robot, np.array([7.0, 5.0, 5.0, 7.0]))
    np.testing.assert_array_equal(facts["position"], rest.position[0])
    np.testing.assert_array_equal(facts["tip_position"], rest.tip_position[0])
    np.testing.assert_array_equal(kc.load_trajectory(tmp_path / "rest.nc").y, rest.y)
    # Tendons 1 and 4, at ±45 degrees, pull 2 N harder: along x. The loads are even along the rod, so the
    # sums of the scheme are exact: 2√2 N/m, and the weight, over the length.
    weight = float(robot.mass_per_length) * 9.81 * 0.635
    np.testing.assert_allclose(facts["base_force"], [2 * np.sqrt(2) * 0.635, 0, -weight], atol=1e-9)
    assert facts["base_moment"][1] > 0
    # the last segment's chord leans as its middle does; the rod hardly bends there
    *_, before, tip = np.array(facts["position"])
    chord = np.arccos((tip - before)[2] / np.linalg.norm(tip - before))
    assert facts["tip_inclination"] == pytest.approx(chord, abs=0.01)
    words = succeeded("equilibrium", ROBOT, "--tension", "7,5,5,7")
    assert "tip: (0.244533, 0, 0.57779) m" in words
    assert "largest estimated position error: 0.66 mm (0.1 % of the length)" in words


@pytest.mark.campaign
def test_equilibrium_estimates_its_error_and_warns_of_a_coarse_grid():
    facts = told("equilibrium", ROBOT, "--tension", "7,5,5,7")
    # the estimate is of the size of the difference from order 4
    robot = kc.load_robot(ROBOT)
    fine = kc.equilibrium(robot, np.array([7.0, 5.0, 5.0, 7.0]), space="lobatto4")
    error = np.linalg.norm(np.subtract(facts["position"], fine.position[0]), axis=1).max()
    assert facts["position_error"] == pytest.approx(error, rel=0.3)
    paper = succeeded("equilibrium", ROBOT, "--tension", "7,5,5,7", "--space", "euler")
    assert "tip: (0.28029, 0, 0.551513) m" in paper and "COARSE GRID: " in paper


@pytest.mark.slow
@pytest.mark.parametrize(
    "given",
    [
        ("--tension", "7", "5", "5", "7"),
        ("--tension", "7 5 5 7"),
        ("--tension=[7, 5, 5, 7]",),
        ("--control", "7,5,5,7"),
        ("--control", "tension_1=7,tension_2=5; tension_3 = 5", "tension_4=7"),
    ],
)
def test_vectors_may_be_separated_by_commas_or_spaces(given):
    control = told("equilibrium", ROBOT, *given)["control"]
    assert control == [7.0, 5.0, 5.0, 7.0]


@pytest.mark.parametrize(
    "given",
    [
        ("rotation_1=180deg,insertion_1=-2mm", "rotation_3=0.25 rev"),
        ("insertion_1 = -2 mm; rotation_1 = 180 deg  rotation_3 = 90 °",),
        ("180deg, -2 mm, 0, 0, 90 deg, 0",),
    ],
)
def test_controls_may_have_units(given):
    control = joined_vectors(["--control", *given])[1]
    found = Held(control=control).of(kc.load_robot("three-tube-robot"))
    np.testing.assert_allclose(found, [np.pi, -0.002, 0.0, 0.0, np.pi / 2, 0.0], rtol=1e-15)


def test_limits_may_have_units():
    tubes, tendons = kc.load_robot("three-tube-robot"), kc.load_robot(ROBOT)
    found = limits_of(
        tubes, low="0,-50 mm,0,-3cm,0,-0.02", high="1rev,0,360deg,0,6.283185307179586,0", rate="1"
    )
    assert found["low"] == [0.0, -0.05, 0.0, -0.03, 0.0, -0.02] and found["rate"] == 1.0
    np.testing.assert_allclose(found["high"], [2 * np.pi, 0.0] * 3, rtol=1e-15)
    assert limits_of(tendons, high="500 gf")["high"] == [4.905] * 4
    assert limits_of(tendons, rate="10 N/s", low=None) == {
        "rate": [10.0] * 4,
        "low": pytest.approx([0.0] * 4),
    }
    for wrong, message in (
        ({"high": "20 mm"}, "--high is '20 mm': mm is no unit of a number in N"),
        ({"rate": "20 N"}, "--rate is '20 N': N is no unit of a number in N/s"),
        ({"low": "1 N,b,2,3"}, r"--low must be one number for all controls, or 4"),
        ({"low": "1 N,2"}, r"--low must be one number .* \(got '1 N,2'\)"),
    ):
        with pytest.raises(ValueError, match=message):
            limits_of(tendons, **wrong)


def test_tensions_and_positions_may_have_units():
    tendons = kc.load_robot(ROBOT)
    found = Held(tension=joined_vectors(["--tension", "7 N,500gf,5,7 N"])[1]).of(tendons)
    np.testing.assert_allclose(found, [7.0, 4.905, 5.0, 7.0], rtol=1e-15)
    target = TipTarget(position="174.04 mm, 0.0838, 60cm").pose(0.635)[0]
    np.testing.assert_allclose(target, [0.17404, 0.0838, 0.6], rtol=1e-15)
    with pytest.raises(ValueError, match="--tension is '7 mm,5,5,7': mm is no unit of a number in N"):
        Held(tension="7 mm,5,5,7").of(tendons)
    with pytest.raises(ValueError, match="--position must be 3 numbers"):
        TipTarget(position="174 mm, 83 mm").pose(0.635)


def test_parameters_that_are_vectors():
    for given in (
        ("gravity=0", "0", "-1"),
        ("gravity=0,0,-1",),
        ("gravity=0 0 -1",),
        ("gravity=[0, 0, -1]",),
    ):
        facts = told("info", ROBOT, "--set", *given)
        assert facts["parameters"]["gravity"]["value"] == [0.0, 0.0, -1.0]


def test_constant_controls_are_given_by_their_numbers(tmp_path):
    out = tmp_path / "a.nc"
    for controls in ("7,5,5,7", "constant:7 5 5 7"):
        succeeded(*simulated(out, controls=controls, steps=2))
        np.testing.assert_array_equal(kc.load_trajectory(out).control[1:], [[7, 5, 5, 7]] * 2)


@pytest.mark.slow
@pytest.mark.filterwarnings("always:bending_damping is 0")
def test_undamped_motion_gives_a_warning(tmp_path):
    result = run(*simulated(tmp_path / "a.nc", "--set", "bending_damping=0", "--json"))
    assert result.exit_code == 0 and json.loads(result.stdout)["all_solved"]
    assert result.stderr.startswith("warning: bending_damping is 0 and nothing else damps the motion")
    assert "Set bending_damping, such as 0.0006 N m2 s" in result.stderr
    assert result.stderr.count("\n") == 1
    assert succeeded("equilibrium", ROBOT, "--tension", "7,5,5,7", "--set", "bending_damping=0")


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


def test_info_tells_controls_as_they_are_given():
    for robot in (ROBOT, "six-legged-robot", "soft-slender-robot"):
        facts, words = told("info", robot), succeeded("info", robot)
        layout = kc.load_robot(robot).control_layout
        assert list(facts["controls"]) == kc.controls.labels(layout)
        for field in layout.fields:
            names = [name for name in facts["controls"] if name.startswith(field.name)]
            assert facts["controls"][names[0]] == {"unit": field.unit, "meaning": field.meaning}
        assert all(f"\n  {name} " in words for name in facts["controls"])


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


@pytest.mark.campaign
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


@pytest.mark.campaign
def test_fit_tells_what_it_did(data, tmp_path):
    text = succeeded(
        "fit", ROBOT, data / "a.nc", "--set", "length=0.4", "--rows", 12, "--out", tmp_path / "m"
    )
    assert f"learned a residual model of {ROBOT} from 1 trajectory (12 rows): training" in text
    assert ": training configuration best, " in text
    assert "+0.5875 of the nominal length" in text
    assert text.endswith(f"wrote {tmp_path / 'm'}\n")


def test_fit_continues_from_an_identified_robot_until_the_time_is_over(tmp_path):
    """A model is written in any case; without time the robot is as it was."""
    cables = Path(__file__).parents[1] / "examples" / "three_cables"
    found = told(
        *("fit", cables / "identified.yaml", cables / "identify.csv", "--config", cables / "recording.yaml"),
        *("--minutes", "1e-9", "--checkpoint", tmp_path / "work", "--out", tmp_path / "model"),
    )
    assert found["residual"] is False and found["complete"] is False
    assert found["given"] == ["three cables, identify: 50 rows"]
    assert found["steps"] == ["no residual: the time is over"]
    model, robot = kc.load_model(tmp_path / "model"), kc.load_robot(cables / "identified.yaml")
    assert float(model.length) == float(robot.length) and not model.coefficients()


@pytest.mark.campaign
def test_fit_trains_an_ensemble_of_networks_at_once(data, tmp_path):
    out = tmp_path / "models"
    facts = told(
        "fit",
        ROBOT,
        data / "a.nc",
        "--set",
        "length=0.6",
        "--preset",
        "paper",
        "--seeds",
        "3,1",
        "--epochs",
        20,
        "--checkpoint",
        tmp_path / "kept",
        "--log",
        tmp_path / "log",
        "--out",
        out,
    )
    assert [model["seed"] for model in facts["models"]] == [3, 1]
    one, other = (model["segments"] for model in facts["models"])
    assert one["steps"] == other["steps"] == 20
    assert one["loss"] != other["loss"]
    assert any((tmp_path / "kept").iterdir()) and any((tmp_path / "log").iterdir())
    members = kc.learning.load_ensemble(out)
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
    assert "+0.5875 of the nominal length" in succeeded("info", model)
    assert facts["found"] == fitted["models"][0]["found"]
    succeeded("plot", out, "--out", tmp_path / "a.png")


# the program itself


def python(*arguments, cwd):
    """Python in a process of its own, with the package that is tested here."""
    source = str(Path(importlib.util.find_spec("knode_cosserat").origin).parents[1])
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": source},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
    )


def program(*arguments, cwd):
    """The program as the entry point `knode-cosserat` starts it."""
    return python("-c", "from knode_cosserat.cli import main; main()", *arguments, cwd=cwd)


@pytest.mark.campaign
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
    assert written == {
        "truth.nc",
        "overview.png",
        "model",
        "learning.png",
        "motion.gif",
        "scene.html",
        "calibrated.yaml",
        "recording.png",
    }
    rows = {line[3:33].strip(): line[33:].split() for line in done.stdout.splitlines()}
    before, published, ours = (
        [float(word) for word in rows[label]]
        for label in ("imperfect model", "paper's network, published", "learned model")
    )
    assert before == pytest.approx([42.70, 34.57, 23.13, 21.44], rel=5e-3)
    assert published == pytest.approx([5.07, 10.95, 1.31, 5.94], rel=5e-3)
    assert all(own < 0.01 * paper for own, paper in zip(ours, published, strict=True))
    # the scene shows no row that the paper's coarse grid spoils
    page = Scripts((tmp_path / "pictures" / "scene.html").read_text(encoding="utf-8"))
    tracks = json.loads(page.found["scene"])["tracks"]
    assert len(tracks) == 3
    assert all(np.all(unpacked(track["result"]) == 0) for track in tracks)
    # the last table: a held-out recording is predicted after calibration
    title, nominal, calibrated = done.stdout.rstrip().splitlines()[-7:-4]
    assert "held-out recording (simulated)" in title
    assert "nominal model" in nominal and float(nominal.split()[-1]) > 15.0
    assert "calibrated model" in calibrated and float(calibrated.split()[-1]) < 5.0


CONTROLLER = """
from knode_cosserat.control import Command, Controller, register_controller

@register_controller("still", "no control")
class Still(Controller):
    def __init__(self, robot, dt, limits):
        self.dt, self.limits = dt, limits.of(robot)

    def reset(self, control):
        pass

    def command(self, time, measured, reference):
        return Command(self.limits.safe)
"""


@pytest.fixture
def forgotten(monkeypatch):
    """Modules, folders and controllers that a test imports are gone after it."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield
    sys.modules.pop("my_controller", None)
    CONTROLLERS.pop("still", None)


def test_a_file_is_imported_before_the_command(tmp_path, forgotten):
    (tmp_path / "my_controller.py").write_text(CONTROLLER)
    command = ("control", "delrin-tendon-robot", "--method")
    refused = run(*command, "still", "--reference", "circle")
    assert "; one of your own is known once its file is imported (--import)" in refused.stderr
    for _ in range(2):
        listed = succeeded("--import", tmp_path / "my_controller.py", *command, "list")
        assert "still: no control" in listed


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("none.py", None, "none.py is not a Python file; allowed for --import is a file such as my_loads.py"),
        ("robot.yaml", "", "robot.yaml is not a Python file"),
        ("json.py", "", "json.py has the name of the module json; allowed is a name of its own"),
        ("divides.py", "import math\n\n1 / 0\n", "divides.py, line 3: ZeroDivisionError: division by zero"),
        ("unclosed.py", "x = (\n", "unclosed.py: SyntaxError: "),
    ],
)
def test_a_file_that_cannot_be_imported_is_told_in_one_line(name, text, message, tmp_path, forgotten):
    if text is not None:
        (tmp_path / name).write_text(text)
    refused = run("--import", tmp_path / name, "info")
    assert refused.exit_code == 2 and refused.stderr.startswith("error: ")
    assert message in refused.stderr and refused.stderr.count("\n") == 1
