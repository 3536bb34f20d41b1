"""Robots with a camera in a frame of its own: control is in the robot's frame, as without a camera."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import knode_cosserat as kc
from knode_cosserat.control import ControlLimits, Sensor, SimulatedPlant, circle, constant, controller_named
from knode_cosserat.control.loop import run_loop
from knode_cosserat.estimation import BoundaryObserver, TipPosition
from knode_cosserat.learning.residual import Nothing
from knode_cosserat.robots import Camera
from knode_cosserat.rotation import quaternion_of, rotation_matrix
from knode_cosserat.solvers.places import OwnFrame, camera_of, without_camera

pytestmark = pytest.mark.slow

DT = 0.05
ROBOT = kc.load_robot("delrin-tendon-robot").replace(nodes=5)
LIMITS = ControlLimits(0.0, 10.0, 40.0)
TURNED = Camera(rotation=(0.03, 0.0, 0.01), position=(0.01, -0.02, 0.1))
MARKED = dataclasses.replace(TURNED, marker=(0.0, 0.002, 0.004))


def loop(robot, name="predictive"):
    plant = SimulatedPlant(robot, DT, Sensor(TipPosition()))
    return run_loop(controller_named(name, robot, DT, LIMITS), plant, circle(0.05, 4.0), 4.0)


def measured_by(camera, tip):
    turn = np.asarray(rotation_matrix(quaternion_of(jnp.asarray(camera.rotation))))
    return turn @ tip + np.asarray(camera.position)


@pytest.fixture(scope="module")
def without():
    return loop(ROBOT)


@pytest.mark.parametrize("learned", [False, True])
def test_a_robot_with_a_camera_follows_as_one_without(without, learned):
    """Also around a KNODE, whose nominal model has the camera; the measurements are the camera's."""
    robot = ROBOT.replace(camera=MARKED)
    log = loop(kc.KNODE(robot, Nothing()) if learned else robot)
    assert without.tip_rmse() < 1e-4
    assert_allclose(log.tip_rmse(), without.tip_rmse(), rtol=1e-3)
    assert_allclose(log.tip, without.tip, atol=1e-6)
    assert_allclose(log.control, without.control, atol=1e-3)
    # a place near the straight tip, where the marker is 4 mm further
    seen = measured_by(TURNED, without.tip[0] + [0.0, 0.002, 0.004])
    assert_allclose(log.measured[0], seen, atol=2e-4)


@pytest.mark.parametrize("name", ["mppi", "lqr", "kinematic", "pid"])
def test_controllers_command_as_without_a_camera(name):
    own, seen = (controller_named(name, robot, DT, LIMITS) for robot in (ROBOT, ROBOT.replace(camera=TURNED)))
    tip, aim = np.array([0.01, -0.02, 0.6]), constant([0.05, 0.02, np.nan])
    for each in (own, seen):
        each.reset(np.full(4, 2.0))
    wanted = own.command(0.0, tip, aim).control
    assert_allclose(seen.command(0.0, measured_by(TURNED, tip), aim).control, wanted, atol=1e-6)


def test_without_an_observer_only_the_markers_turn_is_missed():
    """A turned camera costs nothing; a marker costs what it turns with the tip, up to its distance x θ."""
    own, turned, marked = (loop(ROBOT.replace(camera=it), "lqr") for it in (None, TURNED, MARKED))
    assert_allclose(turned.tip, own.tip, atol=1e-9)
    # a cantilever under a moment, the least inclined: θ = 2 d / L; under a force at the tip 1.5 d / L
    inclination = 2.0 * np.linalg.norm(own.tip[:, :2], axis=1).max() / float(ROBOT.length)
    missed = np.linalg.norm(marked.tip - own.tip, axis=1).max()
    assert 1e-4 < missed < 1.1 * np.linalg.norm(MARKED.marker) * inclination


def test_a_boundary_observer_is_pulled_in_the_robots_frame():
    tip, estimates = np.array([0.05, 0.0, 0.62]), []
    for camera, measured in ((None, tip), (TURNED, measured_by(TURNED, tip))):
        observer = BoundaryObserver(ROBOT.replace(camera=camera), DT)
        for _ in range(3):
            observer.update(measured)
            observer.predict(np.zeros(4))
        estimates.append(observer.state.tip_position[-1])
    assert_allclose(estimates[1], estimates[0], atol=1e-9)


def test_a_measured_tip_is_brought_back():
    """Exactly for the unstressed robot; lost numbers only concern coordinates on which they bear."""
    robot = ROBOT.replace(camera=MARKED)
    y, z = robot.rest(jnp.asarray(robot.length))
    seen = TipPosition().value(robot, jnp.tile(y, (5, 1)), jnp.tile(z, (5, 1)))
    frame = OwnFrame.of(robot)
    assert_allclose(frame.tip(seen), [0.0, 0.0, float(robot.length)], atol=1e-12)
    assert_allclose(OwnFrame.of(ROBOT).tip([np.nan, 1.0, 2.0]), [np.nan, 1.0, 2.0])
    assert np.isnan(frame.tip([np.nan, 1.0, 2.0])).all()
    assert camera_of(without_camera(robot)) is None and without_camera(ROBOT) is ROBOT
