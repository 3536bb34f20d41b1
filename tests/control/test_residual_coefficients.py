"""Coefficients of a learned residual that are adapted while the robot runs."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import knode_cosserat as kc
from knode_cosserat import KNODE
from knode_cosserat.estimation import Adapted, KalmanObserver, TipPosition
from knode_cosserat.estimation.parameters import adapted_model
from knode_cosserat.learning.terms import terms
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.solvers import Stepper

DT = 0.05
ROBOT = kc.load_robot("delrin-tendon-robot")
MODEL = KNODE(ROBOT, terms(ROBOT, np.full((1, 4), 5.0)))
TENSION = np.array([4.0, 1.0, 1.0, 2.0])


def test_coefficients_are_replaced_by_their_names():
    parts = {"first", "second", "third", "fourth", "levers", "tightened", "damping", "load"}
    assert set(MODEL.coefficients()) == parts
    changed = MODEL.replace(**{"residual.damping": np.array([1.0, 0.0, 0.0, 0.0]), "youngs_modulus": 2e9})
    assert_allclose(changed.residual.damping, [1.0, 0.0, 0.0, 0.0])
    assert float(nominal_model(changed).youngs_modulus) == 2e9


@pytest.mark.parametrize(
    ("robot", "adapted", "message"),
    [
        (MODEL, ["residual.friction"], "no coefficients 'residual.friction'; there are residual.first"),
        (ROBOT, ["residual.damping"], "none: the model has no residual"),
        (ROBOT, ["residual"], "no learned residual"),
        (MODEL, ["residual"], "no learned residual with coefficients that are not zero"),
        (MODEL, ["residual.damping"], "give its deviation"),
        (MODEL, [Adapted("residual", 0.1)], "allowed are at most 40"),
    ],
)
def test_wrong_coefficients_are_told_in_one_line(robot, adapted, message):
    with pytest.raises(kc.KnodeCosseratError, match=message):
        adapted_model(robot, adapted)


def test_a_coefficient_of_another_shape_is_refused():
    with pytest.raises(kc.KnodeCosseratError, match="allowed is"):
        MODEL.replace(**{"residual.damping": np.zeros(3)})


@pytest.mark.campaign
def test_a_change_of_the_robot_is_found_in_the_residuals_coefficients():
    """The robot's residual compliance changes; the observer adapts the model's coefficients to it."""
    true = np.zeros((4, 3))
    true[:, [0, 2]] = 1.0
    robot = MODEL.replace(**{"residual.second": jnp.asarray(true)})
    observer = KalmanObserver(MODEL, DT, TipPosition(), adapt=[Adapted("residual.second", 1.0)])
    truth = Stepper(robot, DT)
    for k in range(100):
        observer.update(np.asarray(truth.state.tip_position[-1]))
        control = TENSION + 1.5 * np.sin(4.0 * k * DT + np.arange(4))
        truth.step(control)
        observer.predict(control)
    found = np.asarray(observer.system.residual.second)
    assert found.shape == (4, 3)
    # a mean along the rod that weighs the base most is what the tip shows
    for axis in (0, 2):
        assert found[:, axis] @ [0.5, 0.3, 0.15, 0.05] == pytest.approx(1.0, abs=0.25)
    assert abs(observer.estimate.innovation).max() < 1e-3
