"""Inverse kinematics: there and back, limits, what cannot be reached, paths, bad input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import knode_cosserat as kc
from knode_cosserat.learning.structured.residual import Structured
from knode_cosserat.robots import Drawing
from knode_cosserat.statics.reach import _same_shape, at_limits, rotation_between

ROBOT = kc.load_robot("delrin-tendon-robot")
ROUTED = kc.robots.RoutedTendonRobot.like(ROBOT)
HIGH = 10.0


def tip(robot, control):
    found = kc.equilibrium(robot, control)
    return np.asarray(found.position)[0, -1], np.asarray(found.quaternion)[0, -1]


def learned():
    """The robot with a wrong stiffness, and a residual that was fitted to the right one."""
    truth = kc.simulate(ROBOT, kc.controls.sine(1.0, 30, 0.05), 0.05)[:30]
    return kc.fit(ROBOT.replace(youngs_modulus=10e9), [truth], kc.FitConfig(seed=0))


@pytest.mark.slow
@pytest.mark.parametrize(
    "robot", [ROBOT, pytest.param(ROUTED, marks=pytest.mark.campaign)], ids=["crude", "routed"]
)
def test_reachable_positions_are_reached(robot):
    generator = np.random.default_rng(7)
    for control in generator.uniform(0.0, HIGH, (30, 4)):
        position, _ = tip(robot, control)
        found = kc.inverse_kinematics(robot, position, low=0.0, high=HIGH)
        assert found.result is kc.statics.Reach.REACHED and found.converged
        assert np.all(found.control >= 0.0) and np.all(found.control <= HIGH)
        assert found.position_error < 1e-8
        if found.from_rest:
            np.testing.assert_allclose(tip(robot, found.control)[0], position, atol=1e-8)
        # no tension beyond what the pose needs: never more than the tensions that it was made with
        assert np.linalg.norm(found.control) <= np.linalg.norm(control) * (1 + 1e-6)
    assert found.from_rest


@pytest.mark.campaign
def test_a_model_that_was_learned_is_led_as_well():
    model = learned()
    assert isinstance(model.residual, Structured)
    generator = np.random.default_rng(8)
    for control in generator.uniform(0.0, HIGH, (5, 4)):
        position, quaternion = tip(model, control)
        found = kc.inverse_kinematics(model, position, quaternion, low=0.0, high=HIGH)
        assert found.converged
        np.testing.assert_allclose(tip(model, found.control)[0], position, atol=1e-8)


@pytest.mark.slow
def test_pose_and_orientation_alone_are_reached():
    control = np.array([4.0, 1.0, 0.5, 2.0])
    position, quaternion = tip(ROBOT, control)
    both = kc.inverse_kinematics(ROBOT, position, -3.0 * quaternion, low=0.0, high=HIGH)
    turned = kc.inverse_kinematics(ROBOT, quaternion=quaternion, low=0.0, high=HIGH)
    for found in (both, turned):
        assert found.converged and found.angle_error < 1e-8
    np.testing.assert_allclose(both.control, turned.control, atol=1e-6)
    assert turned.position_error == 0.0


@pytest.mark.slow
def test_least_tension_beyond_the_lower_limits_is_taken():
    """The crude model feels the resultant alone: of two opposite tendons one is at its lower limit."""
    low = np.array([1.0, 2.0, 0.5, 1.5])
    position, _ = tip(ROBOT, [5.0, 6.0, 3.0, 4.0])
    found = kc.inverse_kinematics(ROBOT, position, low=low, high=20.0)
    assert found.converged
    # u₀ - u₂ and u₁ - u₃ are given by the pose; the least of u₀² + u₂² above 0 has one of them at 0
    pull = np.array([5.0 - 3.0, 6.0 - 4.0])
    beyond = pull - (low[:2] - low[2:])
    expected = low + np.concatenate([np.maximum(beyond, 0.0), np.maximum(-beyond, 0.0)])
    np.testing.assert_allclose(found.control, expected, atol=1e-5)
    np.testing.assert_array_equal(found.at_low, [False, False, True, True])
    np.testing.assert_array_equal(found.control[2:], low[2:])


@pytest.mark.slow
@pytest.mark.parametrize("target", [(0.5, 0.2, 0.6), (0.1, 0.1, 0.9), (0.3, 0.0, 0.2)])
def test_what_cannot_be_reached_gives_the_nearest(target):
    """First-order optimal: the distance has no slope but into limits that are active."""
    found = kc.inverse_kinematics(ROBOT, target, low=0.0, high=3.0)
    assert found.result is kc.statics.Reach.UNREACHABLE and not found.converged
    away = found.position - np.array(target)
    assert found.position_error == pytest.approx(np.linalg.norm(away)) and found.position_error > 1e-2
    slope = away @ kc.statics.configuration(ROBOT, found.control).jacobian[:3]
    inside = ~(found.at_low | found.at_high)
    assert np.all(np.abs(slope[inside]) < 1e-8)
    assert np.all(slope[found.at_low] > -1e-8) and np.all(slope[found.at_high] < 1e-8)
    assert np.all(found.control[found.at_high] == 3.0) and np.all(found.control[found.at_low] == 0.0)
    # and nothing among many samples is nearer
    sampled = kc.workspace(ROBOT, 0.0, 3.0, 1024).position
    assert found.position_error <= np.min(np.linalg.norm(sampled - target, axis=1)) + 1e-9


@settings(max_examples=200, deadline=None)
@given(st.floats(0.0, 1.0))
def test_a_step_up_to_a_limit_ends_there(u):
    """In floating point u + (1 - u) may be a little less than 1, and a limit would not seem active."""
    assert at_limits(np.array(u + (1.0 - u))) == 1.0
    assert at_limits(np.array(u - u)) == 0.0
    assert at_limits(np.array(u)) == pytest.approx(u, abs=1e-12)


def test_a_beginning_beside_a_limit_is_at_it():
    """What cannot be reached is known by active limits: with one missed by rounding it was not known."""
    target = (0.5, 0.2, 0.6)
    found = kc.inverse_kinematics(ROBOT, target, low=0.0, high=3.0)
    assert np.any(found.at_high)
    beside = np.where(found.at_high, np.nextafter(3.0, 0.0), found.control)
    again = kc.inverse_kinematics(ROBOT, target, low=0.0, high=3.0, initial=beside, starts=1)
    assert again.result is kc.statics.Reach.UNREACHABLE
    np.testing.assert_array_equal(again.at_high, found.at_high)
    np.testing.assert_allclose(again.control, found.control, atol=1e-6)


def test_a_path_is_followed():
    angle = np.linspace(0.0, 2 * np.pi, 9)
    pulls = np.stack(
        [3 + 2 * np.cos(angle), 3 + 2 * np.sin(angle), 3 - 2 * np.cos(angle), 3 - 2 * np.sin(angle)]
    )
    path = np.array([tip(ROBOT, pull)[0] for pull in pulls.T])
    found = kc.inverse_kinematics(ROBOT, path, low=0.0, high=HIGH)
    assert np.all(found.converged) and found.control.shape == (9, 4)
    assert str(found.result).count("REACHED") == 9 and "9 REACHED" in repr(found)
    np.testing.assert_allclose(found.position, path, atol=1e-8)
    np.testing.assert_allclose(found.control[0], found.control[-1], atol=1e-5)


def test_a_quarter_turn_of_the_target_turns_the_controls():
    position, _ = tip(ROBOT, [5.0, 1.0, 0.0, 0.0])
    turned = np.array([-position[1], position[0], position[2]])
    one, other = (kc.inverse_kinematics(ROBOT, p, low=0.0, high=HIGH) for p in (position, turned))
    np.testing.assert_allclose(np.roll(one.control, 1), other.control, atol=1e-5)


def test_near_is_reached_if_that_is_enough():
    """The crude model's tip moves on a surface: a point 1 mm above it is not on it."""
    position = tip(ROBOT, [4.0, 1.0, 0.0, 0.0])[0] + np.array([0.0, 0.0, 1e-3])
    exact, near = (
        kc.inverse_kinematics(ROBOT, position, low=0.0, high=HIGH, tolerance=part) for part in (1e-9, 2e-3)
    )
    assert exact.result is kc.statics.Reach.UNREACHABLE and near.result is kc.statics.Reach.REACHED
    np.testing.assert_allclose(near.position, exact.position, atol=1e-6)


def test_a_control_that_is_held_stays():
    low, high = np.array([2.0, 0.0, 0.0, 0.0]), np.array([2.0, 9.0, 9.0, 9.0])
    position, _ = tip(ROBOT, [2.0, 1.0, 3.0, 4.0])
    found = kc.inverse_kinematics(ROBOT, position, low=low, high=high)
    assert found.converged and found.control[0] == 2.0


def middle(system, y):
    """Half the tip's position: some function of the last node."""
    return 0.5 * Drawing.of(system).positions(y), Drawing.of(system).quaternions(y)


@pytest.mark.slow
def test_the_pose_may_be_any_function_of_the_last_node():
    position, _ = tip(ROBOT, [4.0, 1.0, 0.0, 0.0])
    found = kc.inverse_kinematics(ROBOT, 0.5 * position, low=0.0, high=HIGH, pose=middle)
    assert found.converged
    np.testing.assert_allclose(found.control, [4.0, 1.0, 0.0, 0.0], atol=1e-5)


@pytest.mark.slow
def test_no_equilibrium_to_begin_with_is_said():
    held = {"low": 1e160, "high": 1e160}
    found = kc.inverse_kinematics(ROBOT, [0.0, 0.0, 0.5], **held, starts=1)
    assert found.result is kc.statics.Reach.NO_EQUILIBRIUM
    assert np.all(np.isnan(found.position)) and np.isnan(found.position_error)
    assert found.equilibrium.result[0] < 0 and np.all(np.isnan(found.equilibrium.y))


#: inextensible tendons on reels: their tensions feel any residual far more than the shape does
REELED = kc.robots.RoutedTendonRobot(
    length=0.3,
    radius=0.0015,
    density=1500.0,
    youngs_modulus=3.0e9,
    bending_damping=2.0e-3,
    tendon_offset=0.01,
    tendon_angles=[0.0, 2.0943951, 4.1887902],
    gravity=[0.0, 0.0, 0.0],
    drive="reel",
    nodes=21,
)


@pytest.mark.campaign
def test_of_reels_the_shape_is_compared_and_not_the_tensions():
    found = kc.inverse_kinematics(
        REELED, [0.0441, 0.0, 0.2955], low=-0.01, high=0.01, tolerance=1e-4, space="lobatto4"
    )
    assert found.converged and found.from_rest
    y = np.asarray(kc.equilibrium(REELED, found.control, space="lobatto4").y[0])
    for name, factor, same in (
        ("tension", 1.01, True),
        ("h", -1.0, True),
        ("h", -3.0, True),
        ("p", 1.01, False),
    ):
        other = y.copy()
        other[:, REELED.y_layout.slice(name)] *= factor
        assert _same_shape(REELED, y, other) == same


def test_of_several_rods_every_shape_is_compared():
    robot = kc.load_robot("six-legged-robot")
    s = np.linspace(0.0, 1.0, robot.nodes) * float(robot.length)
    y = np.stack([np.asarray(robot.rest(each)[0]) for each in s])
    bent, turned = y.copy(), y.copy()
    bent[5, 0] += 1e-4
    turned[5, robot.y_layout.slice(robot.y_layout.names[1])] += [0.0, 1e-4, 0.0, 0.0]
    assert _same_shape(robot, y, y)
    assert not _same_shape(robot, y, bent) and not _same_shape(robot, y, turned)


@pytest.mark.campaign
def test_of_reels_it_is_certain_that_nothing_is_nearer():
    """What Newton's method leaves of a residual hid from the search that it was at the nearest."""
    found = kc.inverse_kinematics(
        REELED, [0.0441, 0.0, 0.2955], low=0.0, high=0.01, tolerance=1e-4, space="lobatto4"
    )
    assert found.result is kc.statics.Reach.UNREACHABLE and found.from_rest
    np.testing.assert_array_equal(found.at_low, [False, True, True])


def test_the_equilibrium_that_was_reached_is_given():
    positions = np.array([tip(ROBOT, [pull, 0.0, 0.0, 0.0])[0] for pull in (1.0, 3.0)])
    path = kc.inverse_kinematics(ROBOT, positions, low=0.0, high=HIGH)
    assert path.equilibrium.y.shape[:2] == (2, 1)
    np.testing.assert_allclose(path.equilibrium.tip_position[:, 0], positions, atol=1e-8)
    one = kc.inverse_kinematics(ROBOT, positions[1], low=0.0, high=HIGH).equilibrium
    alone = kc.equilibrium(ROBOT, one.control[0])
    for name in ("y", "z"):
        np.testing.assert_allclose(getattr(one, name), getattr(alone, name), atol=1e-6)


@pytest.mark.campaign
def test_the_equilibrium_that_was_reached_is_stable_and_begins_a_motion():
    position, _ = tip(ROBOT, [3.0, 0.0, 0.0, 0.0])
    one = kc.inverse_kinematics(ROBOT, position, low=0.0, high=HIGH).equilibrium
    assert kc.statics.stability(one).stable
    assert kc.simulate(ROBOT, one.control, 0.05, initial=one).y.shape[0] == 2


def test_rotation_vectors_turn_one_into_the_other():
    from scipy.spatial.transform import Rotation

    for seed in range(5):
        one, other = Rotation.random(2, rng=np.random.default_rng(seed))
        quaternions = [np.roll(each.as_quat(), 1) for each in (one, other)]
        turned = (other * one.inv()).as_rotvec()
        np.testing.assert_allclose(
            rotation_between(quaternions[0], -2.0 * quaternions[1]), turned, atol=1e-12
        )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "neither position nor quaternion is given"),
        ({"position": [0.0, 1.0]}, r"position has shape \(2,\); allowed is \(3,\) or \(B, 3\)"),
        ({"position": [0.0, np.nan, 1.0]}, r"position is nan at index \(1,\)"),
        ({"quaternion": [0.0, 0.0, 0.0, 0.0]}, "quaternion is zero"),
        ({"position": [0, 0, 1], "quaternion": np.ones((2, 4))}, "give as many of both"),
        ({"position": [0, 0, 1], "low": 5.0, "high": 1.0}, "low is 5 and high 1 for control 0"),
        ({"position": [0, 0, 1], "high": None}, "high"),
        ({"position": [0, 0, 1], "initial": [20.0] * 4}, "initial is .* between low and high"),
        ({"position": [0, 0, 1], "weights": (1.0, 0.0)}, "weights are .* above 0"),
        ({"position": [0, 0, 1], "starts": 0}, "starts is 0"),
        ({"position": [0, 0, 1], "tolerance": 0.0}, "tolerance is 0; allowed is above 0"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message) as raised:
        kc.inverse_kinematics(ROBOT, **{"low": 0.0, "high": HIGH, **arguments})
    assert "\n" not in str(raised.value)
