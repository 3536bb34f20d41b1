"""Coefficients of a learned residual that are adapted while the robot runs."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import knode_cosserat as kc
from knode_cosserat import KNODE
from knode_cosserat.estimation import Adapted, KalmanObserver, TipPosition
from knode_cosserat.estimation.parameters import adapted_model
from knode_cosserat.learning.passive import passive
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.solvers import Stepper

DT = 0.05
ROBOT = kc.load_robot("delrin-tendon-robot")
MODEL = KNODE(ROBOT, passive(ROBOT, np.full((1, 4), 5.0)).pruned())
TENSION = np.array([4.0, 1.0, 1.0, 2.0])


def test_coefficients_are_replaced_by_their_names():
    assert set(MODEL.coefficients()) == {"stiffness", "levers", "energy", "damping"}
    changed = MODEL.replace(**{"residual.damping": np.array([1.0, 0.0, 0.0]), "youngs_modulus": 2e9})
    assert_allclose(changed.residual.damping, [1.0, 0.0, 0.0])
    assert float(nominal_model(changed).youngs_modulus) == 2e9


@pytest.mark.parametrize(
    ("robot", "adapted", "message"),
    [
        (MODEL, ["residual.friction"], "no coefficients 'residual.friction'; there are residual.stiffness"),
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
        MODEL.replace(**{"residual.damping": np.zeros(4)})


@pytest.mark.campaign
def test_a_change_of_the_robot_is_found_in_the_residuals_coefficients():
    """The robot's residual stiffness changes; the observer adapts the model's coefficients to it."""
    true = np.zeros((3, 3))
    true[0, 0] = 0.2
    robot = MODEL.replace(**{"residual.stiffness": jnp.asarray(true)})
    observer = KalmanObserver(MODEL, DT, TipPosition(), adapt=[Adapted("residual.stiffness", 0.2)])
    truth = Stepper(robot, DT)
    for k in range(100):
        observer.update(np.asarray(truth.state.tip_position[-1]))
        control = TENSION + 1.5 * np.sin(4.0 * k * DT + np.arange(4))
        truth.step(control)
        observer.predict(control)
    found = np.asarray(observer.system.residual.stiffness)
    assert found.shape == (3, 3)
    # the mean along the rod, under these tensions, is what the tip shows
    mean = found[0, 0] + found[2, 0] * np.mean(TENSION) / 5.0
    assert mean == pytest.approx(0.2, abs=0.05)
    assert abs(observer.estimate.innovation).max() < 1e-3
