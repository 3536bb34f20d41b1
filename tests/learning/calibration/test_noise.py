"""What noise in the data does to parameters, and what their intervals say of it."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.learning.calibration import search
from knode_cosserat.learning.calibration.calibrate import calibrate
from knode_cosserat.learning.calibration.misfit import SegmentMisfit
from knode_cosserat.learning.calibration.noise import by_states, errors_of
from knode_cosserat.learning.calibration.unknowns import searched, unknowns_of, values
from tests.learning.bar import BAR, WRONG, pulled
from tests.learning.calibration.data import FOUR, ROBOT, as_measured, noisy


def holds(result: Any, truth: kc.System) -> list[bool]:
    """Which of the intervals hold the truth."""
    pairs = [(result.intervals[name], np.max(getattr(truth, name))) for name in result.intervals]
    return [bool(low <= value <= high) for (low, high), value in pairs]


@pytest.mark.campaign
@pytest.mark.parametrize("by", ["segments", "rollouts"])
def test_intervals_hold_the_truth_of_the_robot(by, training):
    inside, estimates = [], []
    for seed in range(60):
        data = noisy(training, 1e-2, seed) if by == "segments" else as_measured(training, 1e-3, seed)
        result = calibrate(ROBOT.replace(youngs_modulus=10e9), data, FOUR[:3], by=by)
        inside.append(holds(result, ROBOT))
        estimates.append([result.estimates[name] / np.max(getattr(ROBOT, name)) for name in FOUR[:3]])
        assert not result.unexplained
    assert np.all(np.mean(inside, axis=0) >= 0.85)
    assert np.all(np.std(estimates, axis=0) < 3e-3)
    assert np.all(np.abs(np.mean(estimates, axis=0) - 1.0) < 0.5 * np.std(estimates, axis=0))


@pytest.mark.parametrize("by", ["segments", "rollouts"])
@pytest.mark.campaign
def test_intervals_hold_the_truth(by, swings):
    """Of 40 times that noise was drawn, intervals of 95 % hold the truth in about as many, not in all."""
    names = ["stiffness", "density", "damping"]
    inside, closer, widths = [], [], []
    for seed in range(40):
        data = noisy(swings, 1e-2, 1000 + seed) if by == "segments" else as_measured(swings, 2e-3, seed)
        result = calibrate(BAR.replace(density=1.3), data, names, by=by)
        inside.append(holds(result, BAR))
        away = [abs(result.estimates[name] - float(getattr(BAR, name))) for name in names]
        errors = [result.standard_errors[name] for name in names]
        closer.append(np.array(away) < 0.674 * np.array(errors))
        widths.append(errors)
    assert np.all(np.mean(inside, axis=0) >= 0.85)
    assert 0.35 < np.mean(closer) < 0.65
    assert np.all(np.mean(widths, axis=0) < 0.1)


def test_the_level_of_an_interval(swings):
    data = noisy(swings, 1e-2, 0)
    half, most = (calibrate(BAR, data, ["stiffness", "drag"], level=level) for level in (0.5, 0.99))
    assert half.estimates == most.estimates and half.level == 0.5
    widths = [np.ptp(result.intervals["drag"]) for result in (half, most)]
    assert widths[1] / widths[0] == pytest.approx(2.576 / 0.6745, rel=2e-2)


@pytest.mark.campaign
def test_what_noise_does_on_average_is_taken_away(swings):
    """Noise in the states hides accelerations, so that a bar seems lighter than it is."""
    unknowns = unknowns_of(BAR, ["stiffness", "density", "damping"])
    truth = searched(unknowns, values(BAR, unknowns))
    raw, corrected, errors = [], [], []
    for seed in range(30):
        misfit = SegmentMisfit(BAR, noisy(swings, 7e-2, seed), unknowns)
        ended = search.search_coordinates(misfit, truth, may_leave_out=False)
        found_errors = errors_of(misfit, ended)
        raw.append(ended.coordinates - truth)
        corrected.append(raw[-1] - found_errors.shift)
        errors.append(found_errors.standard)
    spread = np.mean(errors, axis=0) / np.sqrt(len(errors))
    density = 1
    assert np.mean(raw, axis=0)[density] < -8.0 * spread[density]
    assert np.all(np.abs(np.mean(corrected, axis=0)) < 4.0 * spread)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("time", "space"), [("bdf2", "lobatto4"), ("trapezoidal", "euler"), ("string", "euler")]
)
def test_how_states_enter_is_known_exactly(time, space, string_swing):
    """A small change of all states moves the differences as the covariance takes it to."""
    swing = string_swing if time == "string" else pulled(1.0, 8, time=time, space=space)
    robot = swing.system.replace(length=1.3)
    unknowns = unknowns_of(robot, None)
    misfit = SegmentMisfit(robot, [swing], unknowns)
    rng, at = np.random.default_rng(0), searched(unknowns, values(robot, unknowns))
    factors = rng.normal(size=(len(at), len(misfit.groups)))
    in_y, in_z = rng.normal(size=swing.y.shape), rng.normal(size=swing.z.shape)

    def changed(size: float) -> Any:
        moved = dataclasses.replace(swing, y=swing.y + size * in_y, z=swing.z + size * in_z)
        return factors @ SegmentMisfit(robot, [moved], unknowns)(at).values

    step = 1e-6
    expected = (changed(step) - changed(-step)) / (2 * step)
    [slopes] = by_states(misfit, at, factors)
    predicted = np.sum(slopes * np.concatenate([in_y, in_z], axis=-1), axis=(1, 2, 3))
    np.testing.assert_allclose(predicted, expected, rtol=1e-5)


@pytest.mark.campaign
def test_rollouts_need_positions_and_orientations_only(training):
    """Signs and lengths of quaternions do not matter; what was not measured may be missing."""
    [measured] = as_measured(training[1:], 0.0, 0)
    turned = np.array(measured.y)
    turned[..., 3:7] *= -1.7
    begin = ROBOT.replace(youngs_modulus=1e12, length=0.05)
    result = calibrate(begin, [dataclasses.replace(measured, y=turned)], FOUR[:3], by="rollouts")
    assert result.estimates["youngs_modulus"] == pytest.approx(2.757903e9, rel=1e-8)
    assert result.estimates["length"] == pytest.approx(0.635, rel=1e-8)
    assert result.estimates["bending_damping"] == pytest.approx(0.03, rel=1e-8)
    assert set(result.remainder) == {"position", "orientation"}


@pytest.mark.slow
def test_rollouts_go_on_from_where_data_begin(swings):
    result = calibrate(WRONG, [swing[6:] for swing in swings], ["stiffness", "drag"], by="rollouts")
    assert result.estimates["stiffness"] == pytest.approx(20.0, rel=1e-7)
    assert result.estimates["drag"] == pytest.approx(0.5, rel=1e-7)
