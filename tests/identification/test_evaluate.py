"""Errors of predictions of recordings, and the rows that they come from."""

import dataclasses
import types

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.identification.evaluate import LEVEL, compared, coverage, evaluate, predict
from knode_cosserat.learning.ensemble import Ensemble, Prediction
from knode_cosserat.learning.residual import Nothing
from knode_cosserat.metrics import pose_mse, rotation_rmse

ROBOT = kc.load_robot("delrin-tendon-robot").replace(nodes=7)
DT = 0.05
FRACTIONS = (0.5, 1.0)
#: so thin that its tendons move it beyond all solutions
HOPELESS = ROBOT.replace(radius=1e-5)


@pytest.fixture(scope="module")
def truth():
    return kc.simulate(ROBOT, kc.controls.sine(0.5, 12, DT), DT, initial="equilibrium")


@pytest.fixture(scope="module")
def seen(truth):
    return kc.recordings.Measurements.of(truth, FRACTIONS)


@pytest.fixture(scope="module")
def softer():
    return ROBOT.replace(youngs_modulus=0.9 * ROBOT.youngs_modulus)


@pytest.fixture(scope="module")
def found(softer, seen):
    return evaluate(softer, seen)


def test_the_angle_comes_before_the_papers_metric(found):
    words = str(found)
    tip, angle, paper = (words.index(it) for it in ("tip RMSE", "degrees off", "the paper's pose MSE"))
    assert tip < angle < paper
    assert f"orientations {np.degrees(found.rotation_rmse):.3g} degrees off" in words
    assert [*found.to_dict()] == ["tip_rmse", "rotation_rmse", "tip_dtw", "pose_mse"]
    off = 1e3 * found.comparison.distance[:, -1]
    assert f"mm (median {np.median(off):.2f}, largest {off.max():.2f})" in words


def test_errors_are_those_of_the_rows(found, seen):
    it = found.comparison
    poses = [
        types.SimpleNamespace(position=p, quaternion=h)
        for p, h in ((it.position, it.quaternion), (seen.position, it.turned))
    ]
    assert found.rotation_rmse == pytest.approx(rotation_rmse(*poses), rel=1e-9)
    assert found.pose_mse == pytest.approx(pose_mse(*poses), rel=1e-12)
    assert found.tip_rmse == pytest.approx(np.sqrt(np.mean(it.distance[:, -1] ** 2)), rel=1e-12)
    np.testing.assert_array_equal(found.tip, it.position[:, -1])
    np.testing.assert_array_equal(it.time, seen.time)
    assert it.distance.shape == it.angle.shape == (13, 2) and it.space == "lobatto4"
    assert len(it.control) == 13 and it.band is None


def test_the_prediction_has_the_times_of_the_recording(softer, seen):
    later = dataclasses.replace(seen, time=seen.time + 7.0)
    it = evaluate(softer, later, every=3, last=4).comparison
    np.testing.assert_array_equal(it.rows, [0, 3, 6, 9])
    np.testing.assert_array_equal(it.trajectory.time, later.time[it.rows])
    np.testing.assert_array_equal(it.time, later.time[it.rows])
    np.testing.assert_allclose(it.trajectory.tip_position, it.position[:, -1], atol=1e-12)
    for wrong in ({"every": 0}, {"last": 0}):
        with pytest.raises(ValueError, match=r"must be a number of rows from 1 on \(got 0\)"):
            evaluate(softer, later, **wrong)


def test_bodies_without_orientation_leave_those_of_the_others(softer, seen, found):
    quaternion = np.array(seen.quaternion)
    quaternion[:, 0] = np.nan
    half = evaluate(softer, dataclasses.replace(seen, quaternion=quaternion))
    assert half.rotation_rmse == pytest.approx(np.sqrt(np.mean(found.comparison.angle[:, 1] ** 2)))
    assert half.pose_mse is None and "pose MSE" not in str(half)


def test_rows_without_all_bodies_do_not_count(softer, seen):
    position = np.array(seen.position)
    position[4, 0] = np.nan
    it = evaluate(softer, dataclasses.replace(seen, position=position))
    assert np.isnan(it.comparison.distance[4]).all() and np.isfinite(it.comparison.distance[5]).all()
    assert np.isfinite(it.tip_rmse)


def test_a_failure_keeps_what_was_measured(seen):
    failed = evaluate(HOPELESS, seen)
    assert failed.failed and failed.tip is None and failed.band is None
    it = failed.comparison
    np.testing.assert_array_equal(it.seen, seen.position)
    assert it.trajectory is None and np.isnan(it.distance).all() and np.isnan(it.angle).all()


def test_an_ensemble_gives_a_band_and_its_coverage(seen, found, softer):
    members = [ROBOT.replace(youngs_modulus=factor * ROBOT.youngs_modulus) for factor in (0.95, 1.0, 1.06)]
    it = evaluate(softer, seen, ensemble=[*members, HOPELESS])
    np.testing.assert_array_equal(it.comparison.position, found.comparison.position)
    band = it.band
    assert band.members == 3 and band.failed == 1 and band.level == LEVEL
    assert band.coverage == pytest.approx(coverage(members, seen))
    inside = (band.low <= seen.position) & (seen.position <= band.high)
    assert band.coverage == pytest.approx(np.mean(inside[1:]))
    assert "inside the 90% band of 3 models, 1 more without a solution" in str(it)
    assert it.to_dict()["band"] == {"level": 0.9, "coverage": band.coverage, "members": 3, "failed": 1}


def test_the_mean_of_an_ensemble_is_compared(seen):
    ensemble = Ensemble(
        kc.KNODE(ROBOT.replace(youngs_modulus=factor * ROBOT.youngs_modulus), Nothing())
        for factor in (0.9, 1.0, 1.2)
    )
    it = evaluate(ensemble, seen).comparison
    motions = [predict(member, seen) for member in ensemble]
    mean = Prediction(motions).position[:, [3, 6]]
    np.testing.assert_allclose(it.position, mean, atol=1e-12)
    # the drawn shape is the member nearest to the mean
    np.testing.assert_array_equal(it.trajectory.y, motions[1].y)
    assert it.band.members == 3
    lost = evaluate(Ensemble([kc.KNODE(HOPELESS, Nothing())]), seen)
    assert lost.failed.startswith("no member has a solution")


def test_equilibria_are_compared_row_by_row(softer):
    control = np.array([[5.0, 5.0, 5.0, 5.0], [6.0, 5.0, 4.0, 5.0], [7.0, 5.0, 3.0, 5.0]])
    rows = kc.solvers.equilibria(ROBOT, control)
    seen = dataclasses.replace(kc.recordings.Measurements.of(rows), control=control, static=True)
    found = evaluate(softer, seen)
    expected = np.linalg.norm(
        kc.solvers.equilibria(softer, control, space="lobatto4").tip_position - rows.tip_position, axis=1
    )
    np.testing.assert_allclose(found.comparison.distance[:, 0], expected, atol=1e-9)


def test_systems_without_orientations_have_no_angles(string_swing):
    it = compared(string_swing.system, string_swing, kc.recordings.Measurements.of(string_swing))
    assert it.tip_rmse == 0.0 and it.rotation_rmse is None and it.pose_mse is None
    assert np.isnan(it.comparison.angle).all()
