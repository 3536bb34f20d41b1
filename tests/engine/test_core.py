"""The emitted time loop against the solver in JAX: the same equations and the same mathematics."""

import functools

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.engine.core import Core
from knode_cosserat.solvers.time import BDF2

DT, STEPS = 0.05, 25
COEFFICIENTS = np.array([BDF2().coefficients(DT, DT)[:3]] * STEPS)
ROBOTS = ["delrin-tendon-robot", "delrin-routed-tendon-robot"]


@functools.cache
def core_of(name, robots):
    return Core(kc.load_robot(name), robots)


def tensions(count, low=4.0, high=8.0):
    return np.random.default_rng(3).uniform(low, high, (count, STEPS, 4))


def assert_same(robot, control, rows, infos, estimate):
    wanted = kc.simulate(robot, control, DT, time="bdf2", start="paper")
    ny, scale = robot.y_layout.size, np.asarray(robot.scales().y)
    assert np.max(np.abs(rows[..., :ny] - np.asarray(wanted.y)[1:]) / scale) < 1e-8
    np.testing.assert_allclose(rows[..., ny:], np.asarray(wanted.z)[1:], atol=1e-7)
    assert np.all(infos[:, 1] < 1e-8)
    error = np.asarray(wanted.position_error)[1:]
    np.testing.assert_allclose(infos[:, 4], error, atol=estimate * error.max())


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_with_places_in_lanes(name):
    robot, control = kc.load_robot(name), tensions(1)
    rows, infos = core_of(name, False).run([robot], control, DT, COEFFICIENTS)
    # one lane is one robot: the same iterates, and the same estimate
    assert_same(robot, control[0], rows[0], infos[0], estimate=1e-6)


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_in_lanes_have_their_own_parameters_and_controls(name):
    """Ten robots in lanes of eight. Estimates of a vector stop together: they differ by their tolerance."""
    robot = kc.load_robot(name)
    moduli = np.linspace(2e9, 4e9, 10)
    systems = [robot.replace(youngs_modulus=modulus) for modulus in moduli]
    control = tensions(10)
    rows, infos = core_of(name, True).run(systems, control, DT, COEFFICIENTS)
    for k in (0, 3, 9):
        assert_same(systems[k], control[k], rows[k], infos[k], estimate=0.05)


def test_hard_steps_are_damped():
    """Tensions between 0 and 30 N in steps of 50 ms need several linearisations and shorter corrections."""
    robot, control = kc.load_robot(ROBOTS[0]), tensions(1, 0.0, 30.0)
    rows, infos = core_of(ROBOTS[0], False).run([robot], control, DT, COEFFICIENTS)
    assert np.max(infos[0, :, 3]) >= 3.0
    assert_same(robot, control[0], rows[0], infos[0], estimate=1e-3)
