"""Turning vectors."""

import jax
import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation

from knode_cosserat.rotation import mean_turned, quaternion_of, rotate, since_first

AXIS, VECTOR = np.array([2.0, -1.0, 2.0]) / 3.0, np.array([0.3, -0.7, 0.5])
#: on both sides of where series give way to sines, too
ANGLES = [0.0, 1e-6, 1e-3, 0.0999, 0.1001, 1.0, 3.0, 9.0]


@pytest.mark.parametrize("angle", ANGLES)
def test_turned_and_mean_turned(angle):
    turn = angle * AXIS
    expected = Rotation.from_rotvec(turn).apply(VECTOR)
    np.testing.assert_allclose(rotate(3.0 * quaternion_of(turn), VECTOR), expected, atol=1e-14)
    mean, _ = quad_vec(lambda part: Rotation.from_rotvec(part * turn).apply(VECTOR), 0.0, 1.0, epsabs=1e-15)
    np.testing.assert_allclose(mean_turned(turn, VECTOR), mean, atol=1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_slope_of_mean_turned_by_the_angle(angle):
    """Of a vector across the axis: its mean is (sin θ / θ, (1 - cos θ) / θ) of it and of it turned by 90°."""
    across = np.cross(AXIS, VECTOR)
    found = jax.jvp(lambda angle: mean_turned(angle * AXIS, across), (angle,), (1.0,))[1]
    if angle < 0.01:
        slopes = -angle / 3.0, 0.5 - angle**2 / 8.0
    else:
        slopes = (
            (angle * np.cos(angle) - np.sin(angle)) / angle**2,
            (angle * np.sin(angle) - 1.0 + np.cos(angle)) / angle**2,
        )
    expected = slopes[0] * across + slopes[1] * np.cross(AXIS, across)
    np.testing.assert_allclose(found, expected, atol=1e-11)


def test_rotations_since_the_first_row():
    """About a fixed axis of the global frame angles are differences, whatever the orientation before."""
    angles = np.array([[0.3, 0.0], [0.9, 0.4], [-0.5, 1.0]])
    about = Rotation.from_rotvec(angles.reshape(-1, 1) * [[0.0, 0.0, 1.0]])
    before = Rotation.from_rotvec([[0.2, 0.5, -0.1], [1.0, 0.0, 0.3]] * 3)
    h = (about * before).as_quat(scalar_first=True).reshape(3, 2, 4)
    expected = Rotation.from_rotvec((angles - angles[0]).reshape(-1, 1) * [[0.0, 0.0, 1.0]])
    found = Rotation.from_quat(np.asarray(since_first(h)).reshape(-1, 4), scalar_first=True)
    np.testing.assert_allclose((found * expected.inv()).magnitude(), 0.0, atol=1e-12)
    h[0, 1] = np.nan
    found = np.asarray(since_first(h))
    assert np.all(np.isnan(found[:, 1])) and np.all(np.isfinite(found[:, 0]))
