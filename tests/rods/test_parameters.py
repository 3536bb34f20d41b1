"""Parameters by name: what follows from them, and what is refused."""

import warnings

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.learning import KNODE
from knode_cosserat.learning.residual import Nothing
from knode_cosserat.rods.wrapped import nominal_model


@pytest.fixture(scope="module")
def robot():
    return kc.load_robot("delrin-tendon-robot")


def test_dependent_stiffness_follows_unless_given(robot):
    stiffer = robot.replace(youngs_modulus=10e9)
    I, A = np.pi * 0.003175**4 / 4, np.pi * 0.003175**2
    np.testing.assert_allclose(np.diag(stiffer.Kbt), 10e9 * I * np.array([1.0, 1.0, 2.0 / 2.6]))
    np.testing.assert_allclose(np.diag(stiffer.Kse), 10e9 * A * np.array([1 / 2.6, 1 / 2.6, 1.0]))
    given = robot.replace(bending_stiffness=[0.3, 0.3, 0.2])
    with pytest.warns(UserWarning, match="no effect"):
        np.testing.assert_array_equal(given.replace(youngs_modulus=10e9).Kbt, np.diag([0.3, 0.3, 0.2]))
    np.testing.assert_allclose(robot.replace(shear_modulus=1e9).Kse[0, 0], 1e9 * A)


@pytest.mark.parametrize(
    ("stated", "changes", "message"),
    [
        (
            {"bending_stiffness": 0.3},
            {"youngs_modulus": 1e9},
            "youngs_modulus has no effect on bending and twisting: the robot states its bending_stiffness; "
            "set it",
        ),
        (
            {"bending_stiffness": 0.3, "shear_stiffness": 1e4},
            {"youngs_modulus": 1e9, "shear_modulus": 1e8},
            "youngs_modulus and shear_modulus have no effect: the robot states its bending_stiffness and "
            "shear_stiffness; set these",
        ),
        ({"shear_stiffness": 1e4}, {"youngs_modulus": 1e9}, ""),
        ({}, {"youngs_modulus": 1e9}, ""),
        ({"bending_stiffness": 0.3}, {"youngs_modulus": 1e9, "bending_stiffness": 0.2}, ""),
        ({"bending_stiffness": 0.3}, {"length": 0.5}, ""),
    ],
)
def test_a_modulus_without_effect_is_said(robot, stated, changes, message):
    """Also around a model; the stiffness that moduli do not change is compared too."""
    before = robot.replace(**stated)
    for model in (before, KNODE(before, Nothing())):
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            after = nominal_model(model.replace(**changes))
        assert [str(warning.message) for warning in seen] == [message] * bool(message)
        same = np.array_equal(before.Kbt, after.Kbt)
        assert same == (bool(message) or "length" in changes)


@pytest.mark.parametrize("given", [0.1, [0.1, 0.1, 0.1], 0.1 * np.eye(3)])
def test_matrices_in_three_ways(robot, given):
    np.testing.assert_array_equal(robot.replace(bending_damping=given).bending_damping, 0.1 * np.eye(3))


def test_a_part_is_named_by_its_number_or_its_kind():
    """An effect names the part that it adds, wherever it stands among those of other effects."""
    loads = kc.robots.loads
    rod = kc.robots.SlenderRod(
        0.4,
        radius=0.004,
        density=1000.0,
        youngs_modulus=1e8,
        loads=(loads.AttachedMass(mass=0.1), loads.PointWrench(), loads.AttachedMass(mass=0.2, at=0.5)),
    )
    pushed = rod.replace(**{"loads.point-wrench.force": [1.0, 2.0, 3.0]})
    np.testing.assert_array_equal(pushed.loads[1].force, [1.0, 2.0, 3.0])
    assert [float(load.mass) for load in (pushed.loads[0], pushed.loads[2])] == [0.1, 0.2]
    for name, message in (
        ("loads.attached-mass.mass", "may be any of several parts of the kind attached-mass; .* 0, 2"),
        ("loads.point-wrnch.force", "no 'point-wrnch' among .*, attached-mass, point-wrench; did you mean"),
        ("loads.3.mass", "no '3' among 0, 1, 2, attached-mass, point-wrench"),
    ):
        with pytest.raises(kc.robots.ParameterError, match=message):
            rod.replace(**{name: 1.0})


def test_a_parameter_has_one_of_the_shapes():
    with pytest.raises(ValueError, match=r"shape is \(3,\); allowed is scalar, vector, direction, q"):
        kc.robots.parameter("m", "a place", shape=(3,), low=0.0, high=1.0)
