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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"youngs_modulo": 1e9},
         r"no parameter 'youngs_modulo'; there are length, radius, .*; did you mean youngs_modulus\?$"),
        ({"length": -0.1}, r"length must be between 0.001 and 20 m \(got -0.1\)$"),
        ({"length": "long"}, r"length must be a number between 0.001 and 20 m \(got 'long'\)$"),
        ({"length": [1.0, 2.0]}, r"length must be a number .* \(got \[1, 2\]\)$"),
        ({"density": np.nan}, r"density must be between .* \(got nan\)$"),
        ({"nodes": 1}, "nodes is 1; allowed is a whole number"),
        ({"nodes": 10.0}, "nodes is 10.0"),
        ({"gravity": [0.0, 1.0]}, r"gravity must be three numbers, .* \(got \[0, 1\]\)$"),
        ({"bending_stiffness": [[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]},
         r"bending_stiffness must be .*, not symmetric\)$"),
        ({"bending_stiffness": [-1.0, 1.0, 1.0]}, "bending_stiffness must be one number, three"),
        ({"drag": ["1", "2", "3"]}, "drag must be"),
        ({"drag": [True, True, False]}, "drag must be"),
        ({"drag": [[1.0], [1.0, 2.0]]}, "drag must be"),
    ],
)  # fmt: skip
def test_what_is_refused(robot, change, message):
    with pytest.raises(kc.robots.ParameterError, match=message) as caught:
        robot.replace(**change)
    assert "\n" not in str(caught.value)


def test_a_misspelt_name_of_a_constructor_is_answered_with_the_names():
    with pytest.raises(
        kc.robots.ParameterError,
        match=r"^TendonRobot has no parameter 'yongs_modulus'; .*; did you mean youngs_modulus\?$",
    ):
        kc.robots.TendonRobot(length=1.0, radius=0.01, density=1e3, yongs_modulus=1e9)
    with pytest.raises(
        kc.robots.ParameterError, match=r"'trns'; there are radius, phase, turns, .*; did you mean turns\?"
    ):
        kc.robots.routing.Helical(0.02, 0.0, trns=1.0)


def test_a_class_may_have_a_constructor_of_its_own():
    class Wire(kc.robots.SlenderRod):
        def __init__(self, gauge):
            super().__init__(length=1.0, radius=1e-3 / gauge, density=8e3, youngs_modulus=2e11)

    assert Wire(gauge=2.0).radius == 5e-4
    with pytest.raises(
        kc.robots.ParameterError,
        match=r"^Wire has no parameter 'gage'; there are gauge; did you mean gauge\?$",
    ):
        Wire(gage=2.0)


@pytest.mark.parametrize("short", [[1e-200, 0, 0, 0], [0, 0, 1e-9, 0], [0, 0, 0, 0]])
def test_a_quaternion_has_a_length(short):
    kc.robots.ends.Clamped(orientation=[1e-8, 0, 0, 0])
    with pytest.raises(
        kc.robots.ParameterError, match=r"^Clamped: orientation must be .* \(length above 1e-09\)"
    ):
        kc.robots.ends.Clamped(orientation=short)
