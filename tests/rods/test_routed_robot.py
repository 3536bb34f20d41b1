"""Tendons beside the rod: closed forms, symmetry, friction as a memory, vibration, derivatives."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat import Result
from knode_cosserat.recordings.virtual import virtual_robot
from knode_cosserat.robots import section, tendons

KNOWLEDGE = kc.load_robot("delrin-tendon-robot")
NO_LOADS = {"gravity": [0.0, 0.0, 0.0], "drag": 0.0}
RUBBING = {"friction": tendons.TendonFriction(wobble=0.6, curvature=0.1, reach=0.1), "bending_damping": 2e-3}


def moved(robot, steps=60, dt=0.025, control="sine:1.0", **options):
    return kc.simulate(robot, kc.controls.parse(control, steps, dt), dt, **options)


@pytest.mark.slow
@pytest.mark.parametrize("tension", [0.5, 3.0])
def test_one_tendon_bends_the_rod_evenly(tension):
    robot = kc.robots.RoutedTendonRobot.like(KNOWLEDGE, **NO_LOADS)
    bent = kc.equilibrium(robot, np.array([tension, 0.0, 0.0, 0.0]))
    curvature = tension * 0.02 / float(robot.Kbt[0, 0])
    towards_the_tendon = curvature * np.sqrt(0.5) * np.array([-1.0, 1.0, 0.0])
    np.testing.assert_allclose(np.asarray(bent.z)[-1, :, 3:6] - towards_the_tendon, 0.0, atol=1e-9)


@pytest.mark.campaign
def test_one_tendon_bends_the_rod_to_a_circle():
    tension, robot = 3.0, kc.robots.RoutedTendonRobot.like(KNOWLEDGE, **NO_LOADS, nodes=40)
    bent = kc.equilibrium(robot, np.array([tension, 0.0, 0.0, 0.0]), space=kc.solvers.Lobatto4())
    L, curvature = 0.635, tension * 0.02 / float(robot.Kbt[0, 0])
    squeezed = 1.0 - tension / float(robot.Kse[2, 2])
    away = (1.0 - np.cos(curvature * L)) / curvature * squeezed
    up = np.sin(curvature * L) / curvature * squeezed
    # towards the tendon, at 45 degrees
    expected = [away * np.sqrt(0.5), away * np.sqrt(0.5), up]
    np.testing.assert_allclose(bent.tip_position[-1], expected, atol=1e-8)


def test_tendons_pull_the_rod_to_their_side_like_the_crude_model():
    for k in range(4):
        pulled = np.zeros(4)
        pulled[k] = 1.0
        crude = kc.equilibrium(KNOWLEDGE, pulled).tip_position[-1, :2]
        real = kc.equilibrium(kc.robots.RoutedTendonRobot.like(KNOWLEDGE), pulled).tip_position[-1, :2]
        assert np.dot(crude, real) > 0.99 * np.linalg.norm(crude) * np.linalg.norm(real)


@pytest.mark.slow
def test_a_quarter_turn_of_the_tendons_is_a_quarter_turn_of_the_robot():
    robot = kc.robots.RoutedTendonRobot.like(KNOWLEDGE, **RUBBING, sections=(section.Sleeve(stiffening=1.0),))
    control = kc.controls.parse("random:3", 200, 0.025)
    one, other = kc.simulate(robot, control, 0.025), kc.simulate(robot, np.roll(control, 1, axis=1), 0.025)
    turned = Rotation.from_euler("z", 90, degrees=True).apply(one.position.reshape(-1, 3))
    np.testing.assert_allclose(other.position.reshape(-1, 3), turned, atol=1e-8)


@pytest.mark.campaign
def test_nothing_is_remembered_without_friction():
    robot = kc.robots.RoutedTendonRobot.like(KNOWLEDGE)
    assert robot.z_layout.names == ("v", "u") and "loss" not in robot.y_layout.names
    rubbing = kc.robots.RoutedTendonRobot.like(KNOWLEDGE, **RUBBING)
    there_and_back = np.concatenate([np.linspace(0, 3, 80), np.linspace(3, 0, 80), np.zeros(80)])
    control = np.outer(there_and_back, [1.0, 0.0, 0.0, 0.0]) + 3.0
    for each, least, most in ((robot, 0.0, 2e-4), (rubbing, 2e-3, 1.0)):
        tip = kc.simulate(each, control, 0.05).tip_position[-1]
        straight = kc.equilibrium(each, control[-1]).tip_position[-1]
        assert least <= np.linalg.norm(tip - straight) <= most


@pytest.mark.campaign
def test_friction_is_the_same_however_fine_the_time_steps_are():
    """Quasi-static: friction has no time in it, only the way that was gone."""
    robot = kc.robots.RoutedTendonRobot.like(KNOWLEDGE, **{**RUBBING, "bending_damping": 0.03})

    def tip(steps, time):
        pull = 2.0 * (1.0 - np.cos(2 * np.pi * np.arange(1, steps + 1) / steps)) * (20.0 / 20.0)
        control = np.outer(pull, [1.0, 0.0, 0.0, 0.0]) + 3.0
        return kc.simulate(robot, control, 20.0 / steps, time=time).tip_position[-1]

    exact = tip(3200, kc.solvers.BDF2())
    errors = [np.linalg.norm(tip(steps, kc.solvers.BDF1()) - exact) for steps in (200, 400, 800)]
    assert errors[0] > 1.6 * errors[1] > 2.5 * errors[2]


@pytest.mark.slow
def test_friction_stays_between_none_and_all_and_opposes_motion():
    # of the same parts as above, for the same program
    robot = kc.robots.RoutedTendonRobot.like(KNOWLEDGE, **RUBBING, sections=(section.Sleeve(stiffening=1.0),))
    along = moved(robot, 200, control="random:1")
    f = np.asarray(along.z)[..., 6:10]
    assert np.all(np.abs(f) <= 1.0) and np.abs(f).max() > 0.5
    u = np.asarray(along.z)[..., 3:6]
    bent = u @ np.asarray(robot.bending_directions(0.0)).T
    rate = np.diff(bent, axis=0)
    # since it last turned back; by 2 κ₀ further on it slides, wherever friction stood before
    way = np.zeros_like(rate)
    for k in range(1, len(rate)):
        way[k] = np.where(rate[k] * rate[k - 1] > 0.0, way[k - 1], 0.0) + rate[k]
    sliding = np.abs(way) > 3 * float(robot.friction.reach)
    assert sliding.sum() > 200
    assert np.all(np.sign(f[1:][sliding]) == np.sign(rate[sliding]))


@pytest.mark.campaign
def test_vibration_frees_the_tendons_and_stays_until_tension_falls():
    robot = kc.robots.RoutedTendonRobot.like(
        KNOWLEDGE, **RUBBING, vibration=tendons.Vibration(tension=20.0, rate=1.0, softening=1e-3)
    )
    total = np.concatenate([np.full(20, 16.0), np.full(20, 24.0), np.full(20, 18.0)])
    along = kc.simulate(robot, np.repeat(total[:, None] / 4, 4, axis=1), 0.05)
    x = np.asarray(along.z)[:, 5, -1]
    assert x[20] == 0.0 and x[40] == 1.0
    assert 0.0 <= x[-1] < 1e-9 and 0.2 < x[45] < 0.8


@pytest.mark.campaign
def test_derivatives_are_those_of_the_solution():
    robot = kc.robots.RoutedTendonRobot.like(KNOWLEDGE, **RUBBING, sections=(section.Sleeve(stiffening=1.0),))
    control = kc.controls.parse("sine:0.7", 30, 0.05)

    def tip(wobble, reach):
        changed = robot.replace(friction=dataclasses.replace(robot.friction, wobble=wobble, reach=reach))
        return kc.simulate(changed, control, 0.05).position[-1, -1]

    slopes = jax.jacfwd(tip, argnums=(0, 1))(0.6, 0.1)
    for k, (low, high) in enumerate(
        (((0.6 - 1e-4, 0.1), (0.6 + 1e-4, 0.1)), ((0.6, 0.1 - 2e-5), (0.6, 0.1 + 2e-5)))
    ):
        step = max(np.subtract(high, low))
        expected = (np.asarray(tip(*high)) - np.asarray(tip(*low))) / step
        np.testing.assert_allclose(slopes[k], expected, rtol=2e-3, atol=1e-6)


@pytest.mark.campaign
def test_the_batch_does_what_each_robot_does():
    robot = kc.robots.RoutedTendonRobot.like(KNOWLEDGE, **RUBBING)
    controls = np.stack([kc.controls.parse(f"random:{k}", 40, 0.05) for k in range(3)])
    together = kc.simulate(robot, controls, 0.05)
    for k, control in enumerate(controls):
        np.testing.assert_allclose(
            together.position[k], kc.simulate(robot, control, 0.05).position, atol=1e-9
        )


@pytest.mark.campaign
def test_strong_pulls_and_much_friction_are_solved_or_reported():
    robot = kc.robots.RoutedTendonRobot.like(
        KNOWLEDGE, friction=tendons.TendonFriction(wobble=1.0, reach=0.03), bending_damping=2e-3
    )
    for seed in range(4):
        control = 3.0 * kc.controls.parse(f"random:{seed}", 60, 0.05)
        along = kc.simulate(robot, control, 0.05, on_failure="return")
        solved = np.asarray(along.result) >= Result.CONVERGED
        assert solved.mean() > 0.9 and np.all(np.isfinite(np.asarray(along.y)[solved]))


@pytest.mark.parametrize("space", ["lobatto2", "lobatto4"])
def test_a_straight_robot_with_friction_rests(space):
    """Its moments are only rounding errors."""
    robot = virtual_robot()
    still = kc.equilibrium(robot, np.full(4, 5.0), space=space)
    motion = kc.simulate(robot, np.full((40, 4), 5.0), 0.0025, initial=still, space=space)
    assert np.all(motion.result == kc.Result.CONVERGED)
    assert np.max(motion.position_error) < 1e-6 * robot.length
    np.testing.assert_allclose(motion.position[-1], still.position[0], atol=1e-6)
