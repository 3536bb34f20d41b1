"""Reels: lengths by motors' angles, antagonistic pairs, springs in series, files and errors."""

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.robots import ParameterError
from knode_cosserat.rods.tendons import Reels

PAIRS = Reels(motors=(1, -1, 2, -2), radius=(0.02, 0.03), zero=(0.1, 0.0), taken_in=(1e-3, 1e-3, 0.0, 2e-3))
ROBOT = kc.robots.RoutedTendonRobot.like(
    kc.load_robot("delrin-tendon-robot"),
    drive="reel",
    tendon_offset=0.02,
    tendon_compliance=1e-4,
    tendon_angles=(0.0, np.pi, np.pi / 2, -np.pi / 2),
    gravity=(0.0, 0.0, 0.0),
    nodes=6,
)


def test_a_pair_is_wound_up_on_one_side_and_let_out_on_the_other():
    found = np.asarray(PAIRS.lengths(np.array([0.6, -0.2])))
    assert found == pytest.approx([0.01 + 1e-3, -0.01 + 1e-3, -0.006, 0.006 + 2e-3], abs=1e-15)
    slopes = jax.jacobian(PAIRS.lengths)(np.array([0.6, -0.2]))
    assert np.asarray(slopes) == pytest.approx(np.array([[0.02, 0], [-0.02, 0], [0, 0.03], [0, -0.03]]))
    # lengths in m, each reel for itself
    own = Reels(motors=(1, 2), taken_in=(0.0, -1e-3))
    assert np.asarray(own.lengths(np.array([2e-3, 3e-3]))) == pytest.approx([2e-3, 2e-3])


@pytest.mark.slow
def test_controls_are_angles_and_the_robot_is_that_of_the_lengths():
    motors = ROBOT.replace(reels=PAIRS)
    assert motors.control_layout.names == ("motor",) and motors.control_layout.size == 2
    assert motors.control_layout.fields[0].unit == "rad"
    angles = np.array([0.6, -0.2])
    by_angle = kc.equilibrium(motors, angles).tip_position
    by_length = kc.equilibrium(ROBOT, np.asarray(PAIRS.lengths(angles))).tip_position
    np.testing.assert_allclose(by_angle, by_length, rtol=0.0, atol=1e-12)
    # the first pair bends it towards the tendon that is wound up, the second away
    assert by_angle[0, 0] > 0.01 and by_angle[0, 1] < -0.003


@pytest.mark.campaign
def test_springs_in_series_bend_the_robot_less():
    motors, angles = ROBOT.replace(reels=PAIRS), np.array([0.6, -0.2])
    by_angle = kc.equilibrium(motors, angles).tip_position
    springs = motors.replace(reels=Reels(motors=(1, -1, 2, -2), radius=(0.02, 0.03), compliance=(1e-3,) * 4))
    soft = kc.equilibrium(springs, angles - np.array([0.1, 0.0])).tip_position
    assert 0.0 < soft[0, 0] < 0.9 * by_angle[0, 0]


def test_reels_come_back_from_a_file(tmp_path):
    kc.save_robot(ROBOT.replace(reels=PAIRS), tmp_path / "it.yaml")
    again = kc.load_robot(tmp_path / "it.yaml")
    for name in ("motors", "radius", "zero", "taken_in"):
        np.testing.assert_array_equal(getattr(again.reels, name), getattr(PAIRS, name))
    assert again.reels.compliance is None


def test_reels_fit_the_robot():
    with pytest.raises(ParameterError, match="reels have 2 tendons; the robot has 4"):
        ROBOT.replace(reels=Reels(motors=(1, 2)))
    with pytest.raises(ParameterError, match="drive is tension; allowed is reel"):
        ROBOT.replace(drive="tension", reels=PAIRS)
