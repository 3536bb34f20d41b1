"""Several seeds as one model: mean, spread, and whether the spread can be trusted."""

import dataclasses

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.learning.config import StructuredOptions
from knode_cosserat.learning.ensemble import Ensemble, Prediction
from knode_cosserat.learning.knode import KNODE, About, ModelFileError
from knode_cosserat.learning.residual import Nothing

DT = 0.05
ROBOT = kc.load_robot("delrin-tendon-robot")
SEEDS = tuple(range(5))


def noisy(trajectory, level, seed):
    draw = np.random.default_rng(seed)
    y, z = np.array(trajectory.y), np.array(trajectory.z)
    for values in (y, z):
        values += level * values.std(axis=(0, 1)) * draw.normal(size=values.shape)
    return dataclasses.replace(trajectory, y=y, z=z)


@pytest.fixture(scope="module")
def training():
    return [
        noisy(kc.simulate(ROBOT, kc.controls.sine(period, 60, DT), DT), 3e-3, seed)
        for seed, period in enumerate((0.5, 1.0))
    ]


@pytest.fixture(scope="module")
def truth():
    return kc.simulate(ROBOT, kc.controls.sine(1.5, 40, DT), DT)


@pytest.fixture(scope="module")
def ensemble(training):
    wrong = ROBOT.replace(youngs_modulus=6e9)
    return kc.fit(wrong, training, kc.FitConfig(StructuredOptions(curved=False, resample=True), seed=SEEDS))


@pytest.fixture(scope="module")
def prediction(ensemble):
    return ensemble.predict(kc.controls.sine(1.5, 40, DT), DT)


@pytest.mark.campaign
def test_the_members_differ_by_as_much_as_they_may_be_wrong(prediction, truth):
    error = np.sqrt(np.mean((prediction.tip_position - truth.tip_position)[1:] ** 2))
    spread = np.sqrt(np.mean(prediction.spread[1:, -1] ** 2))
    assert 1e-6 < spread < 3e-2
    assert error < 4.0 * spread


@pytest.mark.campaign
def test_the_mean_is_compared_like_a_trajectory(prediction, truth):
    baseline = kc.simulate(ROBOT.replace(youngs_modulus=6e9), kc.controls.sine(1.5, 40, DT), DT)
    assert kc.metrics.tip_dtw(prediction, truth) < 0.1 * kc.metrics.tip_dtw(baseline, truth)
    assert kc.metrics.pose_mse(prediction, truth) < 0.1 * kc.metrics.pose_mse(baseline, truth)
    np.testing.assert_allclose(np.linalg.norm(prediction.quaternion, axis=-1), 1.0, atol=1e-14)
    np.testing.assert_allclose(prediction.time, truth.time)


@pytest.mark.campaign
def test_another_run_gives_the_same_members(ensemble, training):
    wrong = ROBOT.replace(youngs_modulus=6e9)
    again = kc.fit(wrong, training, kc.FitConfig(StructuredOptions(curved=False, resample=True), seed=(3,)))[
        0
    ]
    tension = kc.controls.sine(1.5, 10, DT)
    np.testing.assert_array_equal(kc.simulate(again, tension, DT).y, kc.simulate(ensemble[3], tension, DT).y)


@pytest.mark.campaign
def test_saved_and_loaded(ensemble, prediction, tmp_path):
    ensemble.save(tmp_path / "many")
    again = kc.learning.load_ensemble(tmp_path / "many").predict(kc.controls.sine(1.5, 40, DT), DT)
    np.testing.assert_array_equal(again.position, prediction.position)
    with pytest.raises(ModelFileError, match=r"there is no ensemble here"):
        kc.learning.load_ensemble(tmp_path)


class Drawn:
    """Positions as a trajectory has them."""

    def __init__(self, position):
        self.position, self.time = position, np.arange(len(position)) * DT


@pytest.mark.parametrize("level", [0.5, 0.9])
@pytest.mark.parametrize("count", [2, 5, 20])
def test_coverage_is_the_level_where_the_truth_is_one_more_member(count, level):
    draw = np.random.default_rng(count)
    members = [Drawn(draw.normal(size=(400, 11, 3))) for _ in range(count)]
    reference = Drawn(draw.normal(size=(400, 11, 3)))
    assert Prediction(members).coverage(reference, level) == pytest.approx(level, abs=0.02)


@pytest.mark.parametrize("share", [0.1, 1.0, 10.0])
def test_coverage_is_the_level_where_no_member_has_the_noise(share):
    draw, noise = np.random.default_rng(1), share * np.linspace(0.0, 1.0, 11)
    members = [Drawn(draw.normal(size=(400, 11, 3))) for _ in range(10)]
    reference = Drawn(draw.normal(size=(400, 11, 3)) + noise[:, None] * draw.normal(size=(400, 11, 3)))
    assert Prediction(members, noise).coverage(reference, 0.9) == pytest.approx(0.9, abs=0.02)


def test_noise_is_stated_at_bodies_and_linear_between():
    about = About({"noise": [(0.5, 1e-3), (1.0, 2e-3)]})
    ensemble = Ensemble([KNODE(ROBOT, Nothing(), about)] * 2)
    np.testing.assert_allclose(
        ensemble.noise_at([0.0, 0.25, 0.5, 0.75, 1.0]), [0.0, 5e-4, 1e-3, 1.5e-3, 2e-3]
    )
    np.testing.assert_array_equal(Ensemble([KNODE(ROBOT, Nothing())]).noise_at([0.5, 1.0]), 0.0)


def test_coverage_tells_that_members_agree_on_something_wrong():
    draw = np.random.default_rng(0)
    members = [Drawn(1e-3 * draw.normal(size=(50, 4, 3))) for _ in range(5)]
    assert Prediction(members).coverage(Drawn(np.ones((50, 4, 3)))) == 0.0


@pytest.mark.campaign
def test_wrong_input_is_told(ensemble, prediction, truth):
    with pytest.raises(ValueError, match=r"^one member has no spread; at least two are needed$"):
        Prediction(prediction.members[:1]).coverage(truth)
    with pytest.raises(ValueError, match=r"^level is 1.5; allowed is a number between 0 and 1$"):
        prediction.interval(1.5)
    with pytest.raises(ValueError, match=r"positions are \(21, 10, 3\) and the prediction's \(41, 10, 3\)"):
        prediction.coverage(truth[:21])
    with pytest.raises(ValueError, match=r"allowed is one KNODE or more"):
        Ensemble([])
