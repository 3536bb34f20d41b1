"""`fit`: what it gives, what stops it, what it tells while it runs, and the paper's training."""

import builtins
import dataclasses
import importlib
import importlib.metadata
import json
import math
import struct

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.learning.config import FitConfig, FitError, NetworkOptions, RolloutTraining, Training
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.states import fit_states
from knode_cosserat.learning.training.checkpoint import data_hash
from knode_cosserat.learning.training.runs import WatchError
from knode_cosserat.rods.aspects import Ends
from knode_cosserat.rods.wrapped import Wrapped
from knode_cosserat.solvers.segments import DataError
from tests.learning.bar import BAR, WRONG, pulled

#: the package has its function under the same name
module = importlib.import_module("knode_cosserat.learning.states")

SMALL = FitConfig.network(hidden=5, epochs=500)


def tip_rmse(model, truth, **options):
    found = kc.simulate(model, truth.control[1:], truth.dt, **options).tip_position
    return float(np.sqrt(np.mean(np.sum((found - truth.tip_position) ** 2, axis=-1))))


def with_training(config=SMALL, **changes):
    return dataclasses.replace(config, segments=dataclasses.replace(config.segments, **changes))


# what it gives


def test_a_model_and_what_is_known_of_it(bars, unseen):
    model = fit_states(WRONG, bars, SMALL, held_out=[unseen])
    assert isinstance(model, KNODE) and model.knowledge is WRONG
    # the bar is at rest where nothing pulls; what is learned is at rest near there
    assert tip_rmse(model, unseen, initial="unstressed") < 0.1 * tip_rmse(WRONG, unseen)
    facts = model.about.facts
    assert facts["seed"] == 0 and FitConfig.from_dict(json.loads(json.dumps(facts["config"]))) == SMALL
    *learned, tested = model.passport.origins
    assert [each.sha256 for each in learned] == [data_hash(each) for each in bars]
    assert all(each.learned for each in learned) and not tested.learned
    assert (tested.sha256, tested.rows, tested.dt) == (data_hash(unseen), 21, pytest.approx(0.1))
    assert tested.held_out_error == facts["held_out_error"]
    assert model.passport.command == "fit"
    assert model.passport.versions["jax"] == importlib.metadata.version("jax")
    assert model.passport.date.startswith("20") and facts["seconds"] > 0.0
    segments = facts["segments"]
    assert segments["loss"].shape == segments["learning_rate"].shape == (500,)
    assert segments["loss"][-1] < 2e-2 * segments["loss"][0]
    # the held-out error is that of `simulate`, after the last epoch
    assert segments["held_out_error"].shape == (10, 2) and segments["held_out_error"][-1, 0] == 500
    for error in (segments["held_out_error"][-1, 1], facts["held_out_error"]):
        np.testing.assert_allclose(error, tip_rmse(model, unseen), rtol=1e-9)


def test_a_model_is_what_its_knowledge_is():
    """A model delegates the whole interface of a system, except what follows from the other members."""
    derived = {"nodes", "passport"}
    assert {name for name in vars(kc.System) if not name.startswith("_")} - set(vars(Wrapped)) == derived
    loose = kc.robots.SlenderRod(
        length=0.5, radius=0.005, density=1e3, youngs_modulus=5e7, base_end=kc.robots.ends.Free()
    )
    assert not Ends.of(loose).held and not Ends.of(KNODE(loose, None)).held


def test_noise_in_the_data_is_in_every_number_and_the_same_each_time(bars):
    shaken, again = (module._noisy(bars[0], 0.01, 0) for _ in range(2))
    for name in ("y", "z"):
        change = np.asarray(getattr(shaken, name)) - np.asarray(getattr(bars[0], name))
        assert np.all(change != 0.0) and 0.007 < change.std() < 0.013
        np.testing.assert_array_equal(getattr(shaken, name), getattr(again, name))
    assert np.any(module._noisy(bars[0], 0.01, 1).y != shaken.y)


def test_several_seeds(bars):
    """On their own threads they are what they are alone."""
    models = fit_states(WRONG, bars, dataclasses.replace(SMALL, seed=(0, 7, 3)))
    alone = fit_states(WRONG, bars, dataclasses.replace(SMALL, seed=7))
    assert [model.about.facts["seed"] for model in models] == [0, 7, 3]
    for found, expected in zip(*map(jax.tree.leaves, (models[1].residual, alone.residual)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)
    loss = models[1].about.facts["segments"]["loss"]
    np.testing.assert_allclose(loss, alone.about.facts["segments"]["loss"], rtol=1e-6)
    assert not np.allclose(models[0].residual.input_weights, models[1].residual.input_weights, rtol=0.1)


def test_the_default_is_structured(bars, unseen):
    model = fit_states(WRONG, bars, held_out=[unseen])
    # the error is one of rounding, of which the two computations differ
    np.testing.assert_allclose(
        model.about.facts["held_out_error"], tip_rmse(model, unseen), rtol=1e-6, atol=1e-12
    )
    assert model.about.facts["config"]["residual"]["kind"] == "structured"
    assert tip_rmse(model, unseen) < 0.1 * tip_rmse(WRONG, unseen)


def test_early_stopping_keeps_the_best(bars, unseen):
    config = with_training(
        epochs=3000, schedule="constant", learning_rate=0.03, stop_after=100, check_every=20
    )
    model = fit_states(WRONG, bars, config, held_out=[unseen])
    history = model.about.facts["segments"]
    errors = history["held_out_error"]
    best = np.argmin(errors[:, 1])
    assert len(history["loss"]) == errors[-1, 0] == errors[best, 0] + 100 < 3000
    np.testing.assert_allclose(tip_rmse(model, unseen), errors[best, 1], rtol=1e-9)


# what stops it


def test_wrong_arguments(bars):
    for arguments, options, words in (
        (("robot", bars, SMALL), {}, "knowledge is a str"),
        ((WRONG, bars, "paper"), {}, "config is a str; allowed is a FitConfig"),
        ((WRONG, bars, SMALL), {"checkpoint_every": 0}, "checkpoint_every is 0"),
        ((WRONG, bars, with_training(stop_after=5)), {}, "stop_after is 5, but there are no held_out"),
    ):
        with pytest.raises(FitError, match=words) as caught:
            fit_states(*arguments, **options)
        assert "\n" not in str(caught.value)


def test_data_that_nothing_can_be_learned_from(bars):
    nan = np.array(bars[0].y)
    nan[4, 2, 1] = np.nan
    for trajectories, words in (
        ([], "there are no trajectories"),
        ([bars[0][:2]], "trajectory 0 has 2 rows; at least 3"),
        ([bars[0], dataclasses.replace(bars[0], y=nan)], "trajectory 1 has y that is not finite in row 4"),
        ([pulled(1.0, robot=BAR.replace(nodes=5))], "trajectory 0 has 5 nodes"),
        (
            [bars[0], dataclasses.replace(bars[1], time=bars[1].time * 2)],
            "trajectory 1 has time steps of 0.2 s",
        ),
    ):
        for config in (SMALL, FitConfig(), FitConfig.paper()):
            if config.segments and config.segments.nodes:
                config = with_training(config, nodes=(2,))
            with pytest.raises(DataError, match=words) as caught:
                fit_states(WRONG, trajectories, config)
            assert "\n" not in str(caught.value)
    with pytest.raises(DataError, match=r"nodes is \(3, 5, 7, 9\); allowed is .* from 1 to 5"):
        fit_states(WRONG, bars, FitConfig.paper())
    moving = dataclasses.replace(bars[0], time=bars[0].time + 1.0)
    with pytest.raises(DataError, match="held-out trajectory 0 begins at 1 s, in motion"):
        fit_states(WRONG, bars, SMALL, held_out=[moving])


def test_a_loss_that_diverges(bars, tmp_path):
    """It stops with one line that names the last good checkpoint, and that can be gone on from."""
    config = FitConfig(
        NetworkOptions(hidden=5, convex=False), Training(epochs=400, learning_rate=10.0, schedule="constant")
    )
    with pytest.raises(FitError, match=r"the loss of seed 0 became .* nothing was kept") as caught:
        fit_states(WRONG, bars, config)
    assert "\n" not in str(caught.value)
    path = tmp_path / "segments-0.checkpoint"
    with pytest.raises(FitError, match="in epoch ") as caught:
        fit_states(WRONG, bars, config, checkpoint=tmp_path, checkpoint_every=1)
    message = str(caught.value)
    assert f"the last good state is kept in {path}" in message and "\n" not in message
    epoch = int(message.split("in epoch ")[1].split()[0])
    assert epoch >= 1  # what was kept is of the epoch before: the next one fails again, at once
    with pytest.raises(FitError, match=f"in epoch {epoch} "):
        fit_states(WRONG, bars, config, checkpoint=tmp_path, checkpoint_every=1)


def test_one_seed_that_fails_stops_the_others(bars):
    config = FitConfig(
        NetworkOptions(hidden=5, convex=False),
        Training(epochs=100_000, learning_rate=10.0, schedule="constant"),
        seed=(0, 1, 2),
    )
    with pytest.raises(FitError, match="the loss of seed"):
        fit_states(WRONG, bars, config)


# what it tells


def test_progress(bars, capfd):
    fit_states(WRONG, bars, with_training(epochs=60), progress=True)
    captured = capfd.readouterr()
    assert captured.out == "" and "segments: 100%" in captured.err and "loss " in captured.err
    fit_states(WRONG, bars, with_training(epochs=60))
    assert capfd.readouterr().err == ""


def _scalars(folder):
    """(tag, step, value) of all event files, by TensorBoard's own message types."""
    from tensorboardX.proto.event_pb2 import Event

    found = []
    for path in sorted(folder.glob("events.out.tfevents.*")):
        data, at = path.read_bytes(), 0
        while at < len(data):
            (size,) = struct.unpack_from("<Q", data, at)
            event = Event.FromString(data[at + 12 : at + 12 + size])
            at += 12 + size + 4
            found += [(value.tag, event.step, value.simple_value) for value in event.summary.value]
    return found


@pytest.mark.campaign
def test_metrics_for_tensorboard(bars, unseen, tmp_path):
    pytest.importorskip("tensorboardX")
    config = dataclasses.replace(
        with_training(epochs=70, check_every=30), rollouts=RolloutTraining(updates=3, horizon=6), seed=(0, 4)
    )
    models = fit_states(WRONG, bars, config, held_out=[unseen], log_dir=tmp_path)
    assert sorted(folder.name for folder in tmp_path.iterdir()) == ["seed-0", "seed-4"]
    for model in models:
        facts = model.about.facts
        scalars = _scalars(tmp_path / f"seed-{facts['seed']}")
        for stage, name, tag in (
            ("segments", "loss", "loss"),
            ("segments", "learning_rate", "learning_rate"),
            ("rollouts", "learning_rate", "learning_rate"),
        ):
            series = [(step, value) for label, step, value in scalars if label == f"{stage}/{tag}"]
            assert [step for step, _ in series] == list(range(len(facts[stage][name])))
            np.testing.assert_allclose([value for _, value in series], facts[stage][name], rtol=1e-6)
        for stage in ("segments", "rollouts"):
            errors = [(step, value) for tag, step, value in scalars if tag == f"{stage}/held_out_error"]
            np.testing.assert_allclose(errors, facts[stage]["held_out_error"], rtol=1e-6)


def test_metrics_without_tensorboard(bars, tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *arguments):
        if name.startswith("tensorboardX"):
            raise ImportError(name)
        return real(name, *arguments)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(WatchError, match=r"pip install knode-cosserat\[tensorboard\]"):
        fit_states(WRONG, bars, SMALL, log_dir=tmp_path)


def test_metrics_that_cannot_be_written(bars, tmp_path):
    pytest.importorskip("tensorboardX")
    (tmp_path / "file").write_text("")
    with pytest.raises(WatchError, match="file/seed-0: metrics cannot be written") as caught:
        fit_states(WRONG, bars, with_training(epochs=10), log_dir=tmp_path / "file")
    assert "\n" not in str(caught.value)


# the paper

DT, ROWS = 0.05, 100
IMPERFECTIONS = {
    "self-weight": {"gravity": (0.0, 0.0, 0.0)},
    "length": {"length": 0.4},
    "stiffness": {"youngs_modulus": 10e9},
    "length & stiffness": {"length": 0.4, "youngs_modulus": 10e9},
}
#: DTW and MSE of the KNODE, the larger of the paper's figure and that of a rerun
FIGURES = {
    ("self-weight", "sine"): (0.005, 0.005),
    ("length", "sine"): (4.31, 1.44),
    ("stiffness", "sine"): (1.22, 0.05),
    ("length & stiffness", "sine"): (5.43, 1.70),
    ("self-weight", "step"): (0.005, 0.005),
    ("length", "step"): (11.54, 7.71),
    ("stiffness", "step"): (2.44, 0.19),
    ("length & stiffness", "step"): (10.95, 5.94),
}
#: where one seed ends
LOSSES = {"self-weight": 1e-12, "length": 1.3e-4, "stiffness": 2e-5, "length & stiffness": 1.1e-4}


#: the paper's schemes and start; its signals are sampled at the ends of steps
PAPER = {"time": "bdf2", "start": "paper", "space": "euler", "initial": "unstressed"}


@pytest.fixture(scope="module")
def robot():
    return kc.load_robot("delrin-tendon-robot")


@pytest.fixture(scope="module")
def sines(robot):
    return [
        kc.simulate(robot, kc.controls.sine(period, 30, DT, sampled="end"), DT, **PAPER)[:30]
        for period in (0.5, 1.0)
    ]


@pytest.mark.campaign
@pytest.mark.parametrize("imperfection", ["stiffness", "self-weight"])
def test_losses_of_the_paper(robot, sines, imperfection):
    model = fit_states(robot.replace(**IMPERFECTIONS[imperfection]), sines, FitConfig.paper())
    last = model.about.facts["segments"]["loss"][-1]
    assert last < 1.2 * LOSSES[imperfection]
    assert imperfection == "self-weight" or last > 0.8 * LOSSES[imperfection]
    assert np.min(model.residual.input_weights) >= 0.0 and np.min(model.residual.output_weights) >= 0.0


@pytest.mark.campaign
@pytest.mark.parametrize("imperfection", IMPERFECTIONS)
def test_table_one_of_the_paper(robot, sines, imperfection):
    models = fit_states(
        robot.replace(**IMPERFECTIONS[imperfection]), sines, FitConfig.paper(seed=(0, 1, 2, 3, 4))
    )
    losses = [model.about.facts["segments"]["loss"][-1] for model in models]
    assert np.median(losses) < 1.2 * LOSSES[imperfection]
    for name, controls in (
        ("sine", kc.controls.sine(1.5, ROWS, DT, sampled="end")),
        ("step", kc.controls.step(1.5, ROWS, DT, sampled="end")),
    ):
        truth = kc.simulate(robot, controls, DT, **PAPER)[:ROWS]
        found = [kc.simulate(model, controls, DT, **PAPER)[:ROWS] for model in models]
        dtw, mse = FIGURES[imperfection, name]
        assert np.mean([kc.metrics.tip_dtw(each, truth) for each in found]) <= 1.3 * dtw
        assert np.mean([kc.metrics.pose_mse(each, truth) for each in found]) <= 1.3 * mse
    assert all(math.isfinite(loss) for loss in losses)
