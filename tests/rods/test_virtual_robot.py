"""A robot whose tendons rub in its ribs, at rest: straight, its moments are only rounding errors."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.recordings.virtual import virtual_robot


@pytest.mark.parametrize("space", ["lobatto2", "lobatto4"])
def test_a_straight_robot_with_friction_rests(space):
    robot = virtual_robot()
    still = kc.equilibrium(robot, np.full(4, 5.0), space=space)
    motion = kc.simulate(robot, np.full((40, 4), 5.0), 0.0025, initial=still, space=space)
    assert np.all(motion.result == kc.Result.CONVERGED)
    assert np.max(motion.position_error) < 1e-6 * robot.length
    np.testing.assert_allclose(motion.position[-1], still.position[0], atol=1e-6)
