"""Outputs and observers of moving robots."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import knode_cosserat as kc
from knode_cosserat.estimation import (
    Adapted,
    BaseWrench,
    BendingAngles,
    BodyPoses,
    BodyPositions,
    BoundaryObserver,
    Curvatures,
    KalmanObserver,
    MovingHorizonObserver,
    Orientations,
    TipPose,
    TipPosition,
)
from knode_cosserat.estimation.outputs import Several
from knode_cosserat.estimation.parameters import adapted_model
from knode_cosserat.robots import Drawing, loads
from knode_cosserat.solvers import Stepper

pytestmark = pytest.mark.slow

DT = 0.05
ROBOT = kc.load_robot("delrin-tendon-robot")
TENSION = np.array([4.0, 1.0, 1.0, 2.0])


@pytest.fixture(scope="module")
def still():
    return kc.equilibrium(ROBOT, TENSION)


@pytest.mark.parametrize(
    "output",
    [
        TipPosition(),
        BodyPositions((0.5, 1.0)),
        TipPose(),
        BodyPoses((0.25, 1.0)),
        Curvatures((0.1, 0.5)),
        BaseWrench(),
        BendingAngles((0.5, 1.0)),
        Several((TipPosition(), Orientations((0.5, 1.0)))),
    ],
)
def test_outputs_have_names_and_no_error_from_themselves(output, still):
    y, z = np.asarray(still.y[-1]), np.asarray(still.z[-1])
    value = np.asarray(output.value(ROBOT, y, z))
    assert value.shape == (output.size,) == (len(output.labels),)
    error = np.asarray(output.error(ROBOT, y, z, value))
    assert error.shape == output.noise.shape
    assert_allclose(error, 0.0, atol=1e-12)


def test_outputs_are_those_of_the_trajectory(still):
    y, z = np.asarray(still.y[-1]), np.asarray(still.z[-1])
    assert_allclose(TipPosition().value(ROBOT, y, z), still.tip_position[-1], atol=1e-12)


def test_the_base_bears_the_weight():
    slack = kc.equilibrium(ROBOT, np.zeros(4))
    force = np.asarray(BaseWrench().value(ROBOT, np.asarray(slack.y[-1]), np.asarray(slack.z[-1])))[:3]
    weight = float(ROBOT.mass_per_length * ROBOT.length) * np.asarray(ROBOT.gravity)
    assert np.linalg.norm(weight) > 0.1
    assert_allclose(force, weight, rtol=1e-9, atol=1e-12)


def test_an_error_of_orientation_is_a_rotation_vector(still):
    y, z = np.asarray(still.y[-1]), np.asarray(still.z[-1])
    value = np.asarray(TipPose().value(ROBOT, y, z))
    angle = 1e-3
    turn = np.array([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0])
    from knode_cosserat.rotation import quaternion_product

    wanted = np.concatenate([value[:3], quaternion_product(value[3:], turn)])
    for sign in (1.0, -1.0):  # both quaternions are one orientation
        reference = np.concatenate([wanted[:3], sign * wanted[3:]])
        error = np.asarray(TipPose().error(ROBOT, y, z, reference))
        assert_allclose(error, [0.0, 0.0, 0.0, -angle, 0.0, 0.0], atol=1e-9)


def test_coordinates_of_parameters_are_zero_at_their_values_and_bounded():
    robot = ROBOT.replace(loads=(loads.AttachedMass(mass=0.0),))
    adapted, _ = adapted_model(robot, ["youngs_modulus", "bending_damping", Adapted("loads.0.mass", 0.03)])
    assert adapted.size == 3 and adapted.labels == ("youngs_modulus", "bending_damping", "loads.0.mass")
    same = adapted.robot(np.zeros(3))
    assert float(same.youngs_modulus) == float(robot.youngs_modulus)
    moved = adapted.robot(np.array([1.0, 0.0, 1.0]))
    assert float(moved.youngs_modulus) == pytest.approx(np.exp(0.3) * float(robot.youngs_modulus))
    assert float(moved.loads[0].mass) == pytest.approx(0.03)
    # a mass is not negative
    assert adapted.bounds[0, 2] == 0.0


@pytest.mark.parametrize(
    ("adapted", "message"),
    [
        (["stiffness"], "no parameter 'stiffness'"),
        ([Adapted("youngs_modulus", -1.0)], "the deviation of youngs_modulus is -1.0; allowed is above zero"),
        (["gravity"], "give its deviation, in its unit"),
    ],
)
def test_wrong_parameters_are_told_in_one_line(adapted, message):
    with pytest.raises(kc.KnodeCosseratError, match=message):
        adapted_model(ROBOT, adapted)


Window = MovingHorizonObserver


def followed(observer, still, count=60):
    """Return errors of the shape (parts of the length), and whether the regions cover it, in every period."""
    truth = Stepper(ROBOT, DT, initial=still)
    rng = np.random.default_rng(0)
    errors, inside = [], []
    for k in range(count):
        measured = np.asarray(truth.state.tip_position[-1]) + 2e-4 * rng.normal(size=3)
        observer.update(measured)
        position = np.asarray(Drawing.of(ROBOT).positions(observer.estimate.y))
        apart = position - np.asarray(truth.state.position[-1])
        errors.append(np.sqrt(np.mean(np.sum(apart**2, axis=-1))) / 0.635)
        inside.append(observer.covers(truth.state))
        control = TENSION + 0.8 * np.sin(4.0 * k * DT + np.arange(4))
        # the tensions that act are those that the observer knows, with its deviation
        truth.step(control + 0.05 * rng.normal(size=4))
        observer.predict(control)
    return np.array(errors), np.array(inside)


@pytest.mark.parametrize("kind", [KalmanObserver, MovingHorizonObserver])
def test_a_wrong_start_is_corrected_from_the_tip_alone(kind, still):
    """After one second the shape is within 0.5 % of the length, with the sensor's noise."""
    errors, inside = followed(kind(ROBOT, DT, TipPosition(), start_deviation=2.0), still)
    assert errors[0] > 0.02
    assert max(errors[20:]) < 5e-3
    assert np.mean(inside[20:]) > 0.8


def test_an_exact_window_is_that_of_least_squares(still):
    """Oracle: with a linear model the window's estimate is the filter's, whatever its length."""
    tension = np.asarray(TENSION)
    kalman, window = (kind(ROBOT, DT, TipPosition(), initial=still) for kind in (KalmanObserver, Window))
    rng = np.random.default_rng(1)
    for _ in range(14):
        measured = np.asarray(still.tip_position[-1]) + 2e-4 * rng.normal(size=3)
        for each in (kalman, window):
            each.update(measured)
            each.predict(tension)
    apart = np.asarray(window.estimate.y) - np.asarray(kalman.estimate.y)
    assert np.max(np.abs(apart[:, :3])) < 1e-6
    assert window.time == pytest.approx(kalman.time)


def test_an_unlikely_measurement_counts_less(still):
    observer = KalmanObserver(ROBOT, DT, TipPosition(), initial=still)
    observer.predict(TENSION)
    before = np.asarray(observer.estimate.y)
    observer.update(np.asarray(still.tip_position[-1]) + np.array([0.5, 0.0, 0.0]))
    moved = np.max(np.abs(np.asarray(observer.estimate.y)[:, :3] - before[:, :3]))
    assert observer.estimate.surprise > 100.0 and moved < 0.02


def test_the_boundary_observer_converges_to_a_loaded_robot(still):
    """The true robot bears a mass that the model does not know: the tip follows the measurement."""
    observer = BoundaryObserver(ROBOT, DT)
    tip = np.asarray(still.tip_position[-1])
    start = np.linalg.norm(np.asarray(observer.state.tip_position[-1]) - tip)
    for _ in range(80):
        observer.update(tip)
        observer.predict(np.zeros(4))
    assert np.linalg.norm(np.asarray(observer.state.tip_position[-1]) - tip) < 0.15 * start
    with pytest.raises(ValueError, match="allowed is a rod with loads"):
        BoundaryObserver(kc.load_robot("six-legged-robot"), DT)


def test_an_unknown_force_at_the_tip_is_found():
    """From the noisy position of the tip alone, within 10 % after six seconds of movement."""
    model, force = ROBOT.replace(loads=(loads.PointWrench(),)), np.array([0.06, -0.04, 0.05])
    truth = Stepper(model.replace(**{"loads.0.force": force}), DT)
    observer = KalmanObserver(model, DT, TipPosition(), adapt=[Adapted("loads.0.force", 0.1)])
    rng = np.random.default_rng(0)
    for k in range(120):
        observer.update(np.asarray(truth.state.tip_position[-1]) + 2e-4 * rng.normal(size=3))
        control = TENSION + 1.5 * np.sin(4.0 * k * DT + np.arange(4))
        truth.step(control)
        observer.predict(control)
    found = np.array(list(observer.estimate.parameters.values()))
    assert np.linalg.norm(found - force) < 0.1 * np.linalg.norm(force)
