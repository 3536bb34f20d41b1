"""Parameters by name: what follows from them, and what is refused."""

import numpy as np
import pytest

import knode_cosserat as kc


@pytest.fixture(scope="module")
def robot():
    return kc.load_robot("delrin-tendon-robot")


def test_dependent_stiffness_follows_unless_given(robot):
    stiffer = robot.replace(youngs_modulus=10e9)
    I, A = np.pi * 0.003175**4 / 4, np.pi * 0.003175**2
    np.testing.assert_allclose(np.diag(stiffer.Kbt), 10e9 * I * np.array([1.0, 1.0, 2.0 / 2.6]))
    np.testing.assert_allclose(np.diag(stiffer.Kse), 10e9 * A * np.array([1 / 2.6, 1 / 2.6, 1.0]))
    given = robot.replace(bending_stiffness=[0.3, 0.3, 0.2])
    np.testing.assert_array_equal(given.replace(youngs_modulus=10e9).Kbt, np.diag([0.3, 0.3, 0.2]))
    np.testing.assert_allclose(robot.replace(shear_modulus=1e9).Kse[0, 0], 1e9 * A)


@pytest.mark.parametrize("given", [0.1, [0.1, 0.1, 0.1], 0.1 * np.eye(3)])
def test_matrices_in_three_ways(robot, given):
    np.testing.assert_array_equal(robot.replace(bending_damping=given).bending_damping, 0.1 * np.eye(3))
