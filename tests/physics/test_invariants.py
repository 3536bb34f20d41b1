"""What must hold of every motion: symmetries, rest, continuation, batches, and loss of energy."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

import knode_cosserat as kc

DT = 0.05
#: in natural units
TOLERANCE = 1e-9
STEPS = 120
CONTROLS = kc.controls.random(STEPS, seed=3)
few = settings(max_examples=15, deadline=None)


@pytest.fixture(scope="module")
def robot():
    """The paper's, in a gravity that pulls sideways too."""
    return kc.load_robot("delrin-tendon-robot").replace(gravity=(1.5, -2.0, -9.0))


@pytest.fixture(scope="module")
def motion(robot):
    return kc.simulate(robot, CONTROLS, DT)


def natural(states, robot):
    """States (…, y) or states with strains (…, y + z) in natural units."""
    scales = np.asarray(robot.scales().y)
    extra = states.shape[-1] - len(scales)
    curvature = 1 / float(robot.length)
    return states / np.concatenate([scales, [1.0, 1.0, 1.0, *3 * [curvature]][:extra]])


def assert_same(found, expected, tolerance=TOLERANCE):
    """Two trajectories of like robots have the same states and strains."""
    assert found.all_valid and expected.all_valid
    both = [natural(np.concatenate([it.y, it.z], axis=-1), it.system) for it in (found, expected)]
    np.testing.assert_allclose(*both, rtol=0, atol=tolerance)


def transformed(motion, polar, axial):
    """States and strains after a linear map of vectors, and the map that belongs to it of axial vectors."""
    states = np.array(motion.y)
    for name, matrix in (("p", polar), ("n", polar), ("q", polar), ("m", axial), ("w", axial)):
        where = motion.system.y_layout.slice(name)
        states[..., where] = states[..., where] @ matrix.T
    # the quaternion's vector part is an axis
    states[..., 4:7] = states[..., 4:7] @ axial.T
    return np.concatenate([states, motion.z[..., :3] @ polar.T, motion.z[..., 3:] @ axial.T], axis=-1)


def assert_transformed(found, motion, polar, axial):
    assert found.all_valid
    states = np.concatenate([found.y, found.z], axis=-1)
    expected = transformed(motion, polar, axial)
    np.testing.assert_allclose(
        natural(states, found.system), natural(expected, found.system), rtol=0, atol=TOLERANCE
    )


# symmetries


def about_z(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@few
@given(angle=st.floats(-4, 4))
def test_turning_gravity_and_tendons_turns_the_motion(robot, angle):
    # without drag: the paper's, C q ⊙ |q|, takes its x and y axes one by one
    still_air = robot.replace(drag=0.0)
    turn = about_z(angle)
    turned = still_air.replace(
        gravity=turn @ still_air.gravity, tendon_angles=still_air.tendon_angles + angle
    )
    motion = kc.simulate(still_air, CONTROLS, DT)
    assert_transformed(kc.simulate(turned, CONTROLS, DT), motion, turn, turn)


@pytest.mark.parametrize("quarters", [-1, 1, 2])
def test_quarter_turns_with_drag(robot, motion, quarters):
    turn = about_z(quarters * np.pi / 2)
    turned = robot.replace(
        gravity=turn @ robot.gravity, tendon_angles=robot.tendon_angles + quarters * np.pi / 2
    )
    assert_transformed(kc.simulate(turned, CONTROLS, DT), motion, turn, turn)


def test_turning_the_tendons_is_to_exchange_their_tensions(robot):
    # four tendons a quarter turn apart, so that each takes the next one's place
    turned = robot.replace(tendon_angles=robot.tendon_angles + np.pi / 2)
    assert_same(kc.simulate(turned, CONTROLS, DT), kc.simulate(robot, np.roll(CONTROLS, 1, axis=1), DT))


@pytest.mark.parametrize("axis", [0, 1])
def test_mirrored_robot_makes_the_mirrored_motion(robot, motion, axis):
    mirror = np.eye(3)
    mirror[axis, axis] = -1.0
    angles = -robot.tendon_angles if axis == 1 else np.pi - robot.tendon_angles
    mirrored = robot.replace(gravity=mirror @ robot.gravity, tendon_angles=angles)
    # a mirror turns axial vectors the other way round
    assert_transformed(kc.simulate(mirrored, CONTROLS, DT), motion, mirror, -mirror)


# rest


@pytest.mark.parametrize("tension", [0.0, 6.0])
def test_robot_without_load_stays_straight(robot, tension):
    weightless = robot.replace(gravity=(0.0, 0.0, 0.0))
    still = kc.simulate(weightless, kc.controls.constant(tension, STEPS), DT)
    straight = np.zeros((10, 25))
    straight[:, 2], straight[:, 3], straight[:, 21] = still.arclength, 1.0, 1.0
    states = np.concatenate([still.y, still.z], axis=-1)
    np.testing.assert_allclose(natural(states - straight, robot), 0.0, atol=1e-12)


@few
@given(tension=st.lists(st.floats(0, 10), min_size=4, max_size=4), dt=st.floats(1e-2, 1.0))
def test_equilibrium_stays_where_it_is(robot, tension, dt):
    rest = kc.equilibrium(robot, tension)
    still = kc.simulate(robot, np.tile(tension, (STEPS, 1)), dt, initial=rest)
    moved = natural(np.concatenate([still.y - rest.y, still.z - rest.z], axis=-1), robot)
    np.testing.assert_allclose(moved, 0.0, atol=TOLERANCE)


def test_damped_motion_ends_in_equilibrium(robot):
    tension = np.array([9.0, 5.0, 6.0, 5.0])
    rest = kc.equilibrium(robot, tension)
    moving = kc.simulate(robot, np.tile(tension, (STEPS, 1)), DT)
    away = np.abs(natural(np.concatenate([moving.y - rest.y, moving.z - rest.z], axis=-1), robot)).max((1, 2))
    assert away[1] > 0.1
    assert away[-1] < TOLERANCE


# the same in pieces, and side by side


@pytest.mark.slow
@pytest.mark.parametrize("time", ["bdf1", "bdf2", pytest.param("bdf-alpha", marks=pytest.mark.campaign)])
def test_motion_goes_on_from_a_trajectory(robot, time):
    whole = kc.simulate(robot, CONTROLS, DT, time=time)
    # longer pieces than needed: the program for this many steps is there already
    first = kc.simulate(robot, CONTROLS[:80], DT, time=time)[:21]
    second = kc.simulate(robot, CONTROLS[20:100], DT, time=time, initial=first)[:21]
    third = kc.simulate(robot, CONTROLS[40:], DT, time=time, initial=second)
    np.testing.assert_allclose(third.time, whole.time[40:], rtol=1e-12)
    np.testing.assert_array_equal(third.control, whole.control[40:])
    assert_same(second, whole[20:41])
    assert_same(third, whole[40:])


@pytest.mark.campaign
def test_trapezoidal_motion_goes_on_exactly_from_rest_and_by_one_bdf1_step_from_motion(robot):
    """The rate at a trajectory's first row is not kept, and the trapezoidal rule never forgets it."""
    controls = kc.controls.sine(1.5, STEPS, DT)
    whole = kc.simulate(robot, controls, DT, time="trapezoidal")
    second = kc.simulate(robot, controls[20:], DT, time="trapezoidal", initial=whole[:21])
    assert_same(second, whole[20:])
    third = kc.simulate(robot, controls[40:], DT, time="trapezoidal", initial=second[:21])
    away = np.max(np.abs(third.tip_position - whole.tip_position[40:]))
    moved = np.max(np.abs(np.diff(whole.tip_position[40:], axis=0)))
    assert 0.0 < away < 0.1 * moved


# robots in lanes are corrected until the last of them is solved: they agree as far as their steps are solved


@pytest.mark.campaign
@pytest.mark.parametrize(("solved", "tolerance"), [(1e-10, 1e-8), (1e-13, 1e-11)])
def test_batch_of_controls_is_each_by_itself(robot, solved, tolerance):
    many = np.stack([kc.controls.random(STEPS, seed=seed) for seed in range(3)])
    newton = kc.solvers.NewtonOptions(tolerance=solved)
    batch = kc.simulate(robot, many, DT, newton=newton)
    assert batch.y.shape == (3, STEPS + 1, 10, 19)
    for i in range(3):
        assert_same(batch[i], kc.simulate(robot, many[i], DT, newton=newton), tolerance)


@pytest.mark.campaign
@pytest.mark.parametrize(("solved", "tolerance"), [(1e-10, 1e-8), (1e-13, 1e-11)])
def test_batch_of_robots_is_each_by_itself(robot, solved, tolerance):
    robots = [robot, robot.replace(length=0.4, radius=0.004), robot.replace(youngs_modulus=10e9, drag=0.01)]
    newton = kc.solvers.NewtonOptions(tolerance=solved)
    batch = kc.simulate(robots, CONTROLS, DT, newton=newton)
    for i, one in enumerate(robots):
        assert_same(batch[i], kc.simulate(one, CONTROLS, DT, newton=newton), tolerance)


# energy


@pytest.mark.slow
@pytest.mark.parametrize("damping", [{"bending_damping": 0.03}, {"bending_damping": 0.003, "drag": 0.05}])
def test_damping_only_takes_energy(robot, damping):
    free = robot.replace(gravity=(0.0, 0.0, 0.0), **damping)
    bent = kc.equilibrium(free, (8.0, 5.0, 5.0, 5.0))
    swinging = kc.simulate(free, np.zeros((STEPS, 4)), 0.02, time="bdf1", initial=bent)
    strain = swinging.z - np.concatenate([free.v_star, free.u_star])
    rates = np.concatenate([swinging.velocity, swinging.angular_velocity], axis=-1)
    stiffness, mass = np.zeros((2, 6, 6))
    stiffness[:3, :3], stiffness[3:, 3:] = free.Kse, free.Kbt
    mass[:3, :3], mass[3:, 3:] = free.mass_per_length * np.eye(3), free.section.rhoJ
    # Of a segment: Euler's method strains it as at its start, and its end then moves.
    elastic = np.einsum("tni,ij,tnj->t", strain[:, :-1], stiffness, strain[:, :-1])
    kinetic = np.einsum("tni,ij,tnj->t", rates[:, 1:], mass, rates[:, 1:])
    energy = (elastic + kinetic) / elastic[0]
    assert kinetic.max() / elastic[0] > 0.05
    assert np.diff(energy).max() < 1e-12
    assert energy[-1] < 1e-6
