"""Errors of states, quantity by quantity: by hand, and what cannot be compared."""

import dataclasses

import numpy as np
import pytest

import knode_cosserat as kc

ROBOT = kc.load_robot("delrin-tendon-robot")


@pytest.fixture(scope="module")
def truth():
    return kc.simulate(ROBOT, kc.controls.sine(1.0, 10, 0.05), 0.05)


def with_added(truth, name, values):
    y = np.array(truth.y)
    y[..., ROBOT.y_layout.slice(name)] += values
    return dataclasses.replace(truth, y=y)


def test_nothing_is_wrong_with_the_truth(truth):
    errors = kc.metrics.state_errors(truth, truth)
    assert set(errors) == {"p", "h", "n", "m", "q", "w", "v", "u"}
    assert all(error.rms == 0.0 and error.size > 0.0 for error in errors.values())
    assert errors["n"].unit == "N" and errors["h"].unit == "rad"


def test_errors_are_lengths_of_vectors(truth):
    errors = kc.metrics.state_errors(with_added(truth, "n", [3.0, 0.0, 4.0]), truth)
    assert errors["n"].rms == pytest.approx(5.0)
    assert errors["p"].rms == 0.0


@pytest.mark.parametrize("angle", [1e-9, 0.3, 3.0])
def test_an_orientation_s_error_is_an_angle_whatever_the_quaternion_s_sign_or_size(truth, angle):
    y = np.array(truth.y)
    h = y[..., ROBOT.y_layout.slice("h")]
    w, x = np.cos(angle / 2), np.sin(angle / 2)
    turned = np.stack(
        [
            w * h[..., 0] - x * h[..., 1],
            w * h[..., 1] + x * h[..., 0],
            w * h[..., 2] - x * h[..., 3],
            w * h[..., 3] + x * h[..., 2],
        ],
        axis=-1,
    )
    y[..., ROBOT.y_layout.slice("h")] = -2.0 * turned
    assert kc.metrics.state_errors(dataclasses.replace(truth, y=y), truth)["h"].rms == pytest.approx(
        angle, rel=1e-6
    )


@pytest.mark.campaign
def test_a_finer_truth_is_looked_up(truth):
    fine = ROBOT.replace(nodes=28)
    finer = kc.simulate(fine, kc.controls.sine(1.0, 20, 0.025), 0.025)
    coarse = dataclasses.replace(
        finer[::2], y=np.asarray(finer.y)[::2, ::3], z=np.asarray(finer.z)[::2, ::3], system=ROBOT
    )
    assert all(error.rms == 0.0 for error in kc.metrics.state_errors(coarse, finer).values())


def test_rows_before_the_start_do_not_count(truth):
    y = np.array(truth.y)
    y[0, :, ROBOT.y_layout.slice("n")] += 9.0
    wrong = dataclasses.replace(truth, y=y)
    assert kc.metrics.state_errors(wrong, truth)["n"].rms > 1.0
    assert kc.metrics.state_errors(wrong, truth, start=0.05)["n"].rms == 0.0


def test_what_cannot_be_compared(truth):
    later = dataclasses.replace(truth, time=np.asarray(truth.time) + 0.01)
    with pytest.raises(ValueError, match=r"the truth has no row at 0.01 s"):
        kc.metrics.state_errors(later, truth)
    with pytest.raises(ValueError, match="no row to compare"):
        kc.metrics.state_errors(truth, truth, start=9.0)
    other = dataclasses.replace(truth, y=np.asarray(truth.y)[:, :8], z=np.asarray(truth.z)[:, :8])
    with pytest.raises(ValueError, match="the truth has no node at"):
        kc.metrics.state_errors(truth, other)
    batch = dataclasses.replace(truth, y=np.stack([truth.y, truth.y]))
    with pytest.raises(ValueError, match="a batch of 2"):
        kc.metrics.state_errors(batch, truth)
