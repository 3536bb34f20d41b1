"""Noise in the data: its effect on parameters, and the coverage of their intervals."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import knode_cosserat as kc
from tests.identification.motions import FOUR, ROBOT, as_measured, noisy
from tests.learning.bar import BAR, WRONG


def holds(result: Any, truth: kc.System) -> list[bool]:
    """True for each interval that contains the truth."""
    pairs = [(it.interval, np.max(getattr(truth, it.label))) for it in result.estimates]
    return [bool(low <= value <= high) for (low, high), value in pairs]


@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["states", "poses"])
def test_intervals_hold_the_truth_of_the_robot(kind, training):
    inside, estimates = [], []
    for seed in range(60):
        data = noisy(training, 1e-2, seed) if kind == "states" else as_measured(training, 1e-3, seed)
        result = kc.identify(ROBOT.replace(youngs_modulus=10e9), data, parameters=FOUR[:3])
        inside.append(holds(result, ROBOT))
        estimates.append([it.value / np.max(getattr(ROBOT, it.label)) for it in result.estimates])
        assert not result.unexplained
    assert np.all(np.mean(inside, axis=0) >= 0.85)
    assert np.all(np.std(estimates, axis=0) < 3e-3)
    assert np.all(np.abs(np.mean(estimates, axis=0) - 1.0) < 0.5 * np.std(estimates, axis=0))


@pytest.mark.parametrize("kind", ["states", "poses"])
@pytest.mark.campaign
def test_intervals_hold_the_truth(kind, swings):
    """Of 40 draws of noise, intervals of 95 % contain the truth in about as many, not in all."""
    names = ["stiffness", "density", "damping"]
    inside, closer, widths = [], [], []
    for seed in range(40):
        data = noisy(swings, 1e-2, 1000 + seed) if kind == "states" else as_measured(swings, 2e-3, seed)
        result = kc.identify(BAR.replace(density=1.3), data, parameters=names)
        inside.append(holds(result, BAR))
        away = [abs(it.value - float(getattr(BAR, it.label))) for it in result.estimates]
        errors = [it.error for it in result.estimates]
        closer.append(np.array(away) < 0.674 * np.array(errors))
        widths.append(errors)
    assert np.all(np.mean(inside, axis=0) >= 0.85)
    assert 0.35 < np.mean(closer) < 0.65
    assert np.all(np.mean(widths, axis=0) < 0.1)


@pytest.mark.slow
def test_intervals_are_those_of_normal_errors(swings):
    result = kc.identify(BAR, noisy(swings, 1e-2, 0), parameters=["stiffness", "drag"])
    for it in result.estimates:
        assert np.ptp(it.interval) / it.error == pytest.approx(2.0 * 1.96, rel=2e-2)


@pytest.mark.campaign
def test_large_noise_in_states_causes_no_bias(swings):
    """Noise in the states hides accelerations from predictions of one step; whole motions are not biased."""
    errors, deviations = [], []
    for seed in range(30):
        result = kc.identify(BAR, noisy(swings, 7e-2, seed), parameters=["stiffness", "density", "damping"])
        errors.append([np.log(it.value / float(getattr(BAR, it.label))) for it in result.estimates])
        deviations.append([it.error / it.value for it in result.estimates])
    spread = np.mean(deviations, axis=0) / np.sqrt(len(errors))
    assert np.all(np.abs(np.mean(errors, axis=0)) < 4.0 * spread)


@pytest.mark.campaign
def test_positions_and_orientations_suffice(training):
    """Signs and lengths of quaternions do not matter; other states may be missing."""
    [measured] = as_measured(training[1:], 0.0, 0)
    turned = np.array(measured.y)
    turned[..., 3:7] *= -1.7
    begin = ROBOT.replace(youngs_modulus=1e12, length=0.05)
    result = kc.identify(begin, [dataclasses.replace(measured, y=turned)], parameters=FOUR[:3])
    assert result["youngs_modulus"].value == pytest.approx(2.757903e9, rel=1e-8)
    assert result["length"].value == pytest.approx(0.635, rel=1e-8)
    assert result["bending_damping"].value == pytest.approx(0.03, rel=1e-8)


@pytest.mark.slow
def test_motions_continue_from_their_first_rows(swings):
    result = kc.identify(WRONG, [swing[6:] for swing in swings], parameters=["stiffness", "drag"])
    assert result["stiffness"].value == pytest.approx(20.0, rel=1e-7)
    assert result["drag"].value == pytest.approx(0.5, rel=1e-7)
