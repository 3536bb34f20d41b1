import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest
import typer.testing

import knode_cosserat as kc
from knode_cosserat.learning.knode import KNODE, About
from knode_cosserat.learning.structured.residual import Structured
from knode_cosserat.trajectory import TrajectoryFileError
from tests.learning.files.made import (
    MODELS,
    ROBOT,
    STRING,
    TENSIONS,
    YOURS,
    Pull,
    assert_same,
    fails,
    network,
)
from tests.trajectories import edited

pytestmark = pytest.mark.slow

# trajectories


@pytest.fixture(scope="module")
def prediction(tmp_path_factory):
    path = tmp_path_factory.mktemp("prediction") / "prediction.nc"
    model = with_facts(MODELS["network"], {"loss": np.arange(3.0)})
    trajectory = kc.simulate(model, TENSIONS, 0.05)
    trajectory.save(path)
    return trajectory, path


def with_facts(model, facts):
    return KNODE(model.knowledge, model.residual, About(facts))


def assert_same_states(a, b):
    for name in ("time", "y", "z", "control", "result", "residual", "iterations"):
        assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True), name
    assert a.settings == b.settings


def test_a_prediction_comes_back_with_its_model(prediction):
    trajectory, path = prediction
    found = kc.load_trajectory(path)
    assert_same_states(found, trajectory)
    assert_same(found.system, trajectory.system)
    assert found.system.about.facts["loss"].tolist() == [0.0, 1.0, 2.0]
    again = kc.simulate(found.system, found.held_tension[:-1], found.dt)
    assert np.array_equal(again.y, trajectory.y)


def test_a_prediction_is_read_in_another_process(prediction):
    _, path = prediction
    code = (
        "import sys, knode_cosserat as kc\n"
        "found = kc.load_trajectory(sys.argv[1])\n"
        "print(type(found.system).__name__, found.y.shape, found.system.residual.input_weights.sum().hex())"
    )
    ran = subprocess.run([sys.executable, "-c", code, path], check=True, capture_output=True, text=True)
    assert ran.stdout.split(maxsplit=1)[0] == "KNODE"
    assert ran.stdout.split()[-1] == MODELS["network"].residual.input_weights.sum().hex()


def test_the_command_line_reads_predictions(prediction, tmp_path):
    from knode_cosserat.cli import app

    trajectory, path = prediction
    truth = kc.simulate(ROBOT, TENSIONS, 0.05)
    truth.save(tmp_path / "truth.nc")
    runner = typer.testing.CliRunner()
    told = runner.invoke(app, ["evaluate", str(path), str(tmp_path / "truth.nc"), "--json"])
    assert told.exit_code == 0, told.stderr
    assert json.loads(told.stdout)["references"][0]["tip_dtw"] == kc.metrics.tip_dtw(trajectory, truth) > 0.0
    drawn = runner.invoke(app, ["plot", str(path), "--out", str(tmp_path / "prediction.png")])
    assert drawn.exit_code == 0, drawn.stderr
    assert (tmp_path / "prediction.png").stat().st_size > 10_000


@pytest.mark.campaign
def test_batches_of_models(tmp_path):
    members = [KNODE(ROBOT, network(seed=seed)) for seed in (1, 2)]
    batch = kc.simulate(members, TENSIONS, 0.05)
    assert batch.y.shape == (2, 7, 5, 19)
    batch.save(tmp_path / "batch.nc")
    found = kc.load_trajectory(tmp_path / "batch.nc")
    assert_same_states(found, batch)
    assert_same(found.system, batch.system)
    for i, member in enumerate(members):
        assert_same(found[i].system, member)
        assert_same(batch[i].system, member)
        alone = kc.simulate(batch[i].system, TENSIONS, 0.05)
        np.testing.assert_allclose(alone.y, batch[i].y, rtol=1e-6, atol=1e-7)
    batch[:1].save(tmp_path / "one.nc")
    assert_same(kc.load_trajectory(tmp_path / "one.nc").system, batch[:1].system)
    # one model under many tensions is no batch of models
    many = dataclasses.replace(batch, system=members[0])
    many.save(tmp_path / "many.nc")
    assert_same(kc.load_trajectory(tmp_path / "many.nc").system, members[0])
    edited(tmp_path / "batch.nc", lambda file: file["arrays/model[1]"].__setitem__(-1, 0))
    with fails("batch.nc: its system, a KNODE: its model: ", error=TrajectoryFileError):
        kc.load_trajectory(tmp_path / "batch.nc")


def test_predictions_of_what_no_file_describes_are_saved_all_the_same(tmp_path):
    hand = np.tile([0.6, 0.0], (3, 1))
    for system, parts in (
        (KNODE(STRING, Structured(np.asarray(0.0), None, None, None)), ["HangingString", "knowledge=…"]),
        (KNODE(ROBOT, Pull(0.1)), ["'Pull', which is not known here"]),
        (KNODE(ROBOT, network(), About({"f": abs})), ["its system, a KNODE (a KNODE: about.f is a builtin"]),
    ):
        y, z = np.zeros((3, 5, system.y_layout.size)), np.zeros((3, 5, system.z_layout.size))
        control = hand if system.control_layout.size == 2 else np.zeros((3, 4))
        zeros = np.zeros(3)
        states = kc.Trajectory(system, None, np.arange(3.0), y, z, control, zeros.astype(int), zeros, zeros)
        path = tmp_path / "a.nc"
        states.save(path)
        with fails("a.nc: ", *parts, "load_trajectory(path, system=…)", error=TrajectoryFileError):
            kc.load_trajectory(path)
        found = kc.load_trajectory(path, system=system)
        assert_same_states(found, states)
        assert found.system is system


def test_predictions_of_a_users_residual_are_read_with_its_classes(tmp_path):
    model = KNODE(ROBOT, Pull(0.1))
    y, z, zeros = np.zeros((3, 5, model.y_layout.size)), np.zeros((3, 5, model.z_layout.size)), np.zeros(3)
    states = kc.Trajectory(
        model, None, np.arange(3.0), y, z, np.zeros((3, 4)), zeros.astype(int), zeros, zeros
    )
    states.save(tmp_path / "a.nc")
    assert_same(kc.load_trajectory(tmp_path / "a.nc", residuals=YOURS).system, model)


def test_predictions_whose_model_is_damaged(prediction, tmp_path):
    _, path = prediction
    (tmp_path / "a.nc").write_bytes(path.read_bytes())
    edited(tmp_path / "a.nc", lambda file: file["arrays/model"].__setitem__(500, 77))
    with fails(
        "a.nc: its system, a KNODE: its model: damaged",
        "load_trajectory(path, system=…)",
        error=TrajectoryFileError,
    ):
        kc.load_trajectory(tmp_path / "a.nc")
    edited(tmp_path / "a.nc", lambda file: file.attrs.__setitem__("system", "os.system"))
    with fails("there is no reader of its system, a os.system", error=TrajectoryFileError):
        kc.load_trajectory(tmp_path / "a.nc")
