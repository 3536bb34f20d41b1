"""Parameters from trajectories: what is found, how well, and what is said when they cannot be."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.learning.calibration import search
from knode_cosserat.learning.calibration.calibrate import CalibrationError, calibrate
from knode_cosserat.learning.calibration.unknowns import (
    searched,
    searched_numbers,
    unknowns_of,
    values,
    with_numbers,
)
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.residual import Residual
from knode_cosserat.solvers.segments import DataError
from tests.learning.bar import BAR, WRONG, Bar, pulled
from tests.learning.calibration.data import DT, FOUR, ROBOT, noisy, sines

pytestmark = pytest.mark.slow

# what is found in data without noise


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("truth", "start"),
    [
        ({}, {"length": 0.4}),
        ({}, {"youngs_modulus": 10e9}),
        ({}, {"length": 0.4, "youngs_modulus": 10e9}),
        ({"bending_damping": 0.2}, {}),
        ({"bending_damping": 0.2, "youngs_modulus": 5e9}, {}),
        ({"drag": 0.0}, {}),
        ({}, {"drag": 0.0, "bending_damping": 0.0, "youngs_modulus": 1e12, "length": 0.05}),
    ],
    ids=str,
)
def test_imperfections_are_found(truth, start):
    true = ROBOT.replace(**truth)
    # so far that what is left of the data's own equations does not show in a force a millionth of the others'
    data = sines(true, newton=kc.solvers.NewtonOptions(tolerance=1e-12))
    result = calibrate(ROBOT.replace(**start), data, FOUR)
    assert result.estimates["youngs_modulus"] == pytest.approx(float(true.youngs_modulus), rel=1e-8)
    assert result.estimates["length"] == pytest.approx(float(true.length), rel=1e-8)
    assert result.estimates["bending_damping"] == pytest.approx(true.bending_damping[0, 0], rel=1e-8)
    assert result.estimates["drag"] == pytest.approx(true.drag[0, 0], abs=2e-10)
    for name, (low, high) in result.intervals.items():
        value = np.max(getattr(true, name))
        # what the tolerance of the solver may have done to a force so small is much of the drag
        width = 1e-2 if name == "drag" else 1e-6
        assert low <= value <= high and high - low < width * max(value, 1e-4)
    assert not result.undetermined and not result.unexplained
    controls = kc.controls.sine(1.5, 100, DT)
    again = kc.simulate(result.robot, controls, DT)[:100]
    assert kc.metrics.tip_dtw(again, kc.simulate(true, controls, DT)[:100]) < 1e-6


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("truth", "start"),
    [
        ({}, {"gravity": (0.0, 0.0, 0.0)}),
        ({"radius": 0.8 * 0.003175}, {}),
        ({}, {"length": 0.4, "density": 900.0}),
    ],
    ids=str,
)
def test_nobody_has_to_say_which_parameter_is_wrong(truth, start):
    true, begin = ROBOT.replace(**truth), ROBOT.replace(**start)
    result = calibrate(begin, sines(true))
    # the sum of opposite tensions is the same all the time, so a turned tendon may as well be gravity
    assert {"tendon_offset", "tendon_angles"} <= set(result.undetermined)
    for name in result.undetermined:
        np.testing.assert_array_equal(getattr(result.robot, name), getattr(begin, name))
    for name in ("length", "radius", "density", "youngs_modulus"):
        assert result.estimates[name] == pytest.approx(float(getattr(true, name)), rel=1e-8)
    np.testing.assert_allclose(result.robot.gravity, true.gravity, atol=1e-7)
    controls = kc.controls.sine(1.5, 100, DT)
    again = kc.simulate(result.robot, controls, DT)[:100]
    assert kc.metrics.tip_dtw(again, kc.simulate(true, controls, DT)[:100]) < 1e-6


@pytest.mark.campaign
def test_a_robot_at_rest_tells_little():
    tension = np.array([6.0, 5.0, 5.0, 5.0])
    still = kc.simulate(ROBOT, np.tile(tension, (29, 1)), DT, initial=kc.equilibrium(ROBOT, tension))
    result = calibrate(ROBOT.replace(youngs_modulus=4e9), [still, still])
    assert result.estimates["youngs_modulus"] == pytest.approx(2.757903e9, rel=1e-8)
    assert {"drag", "bending_damping", "shear_damping", "gravity"} <= set(result.undetermined)
    with pytest.raises(
        CalibrationError, match=r"^these data determine only a combination of density and gravity;"
    ):
        calibrate(ROBOT, [still, still], ["density", "gravity"])


@pytest.mark.parametrize("by", ["segments", "rollouts"])
def test_any_system(by, swings):
    result = calibrate(WRONG.replace(length=1.2, density=2.0, damping=0.0), swings, by=by)
    for name, value in result.estimates.items():
        assert value == pytest.approx(float(getattr(BAR, name)), rel=1e-7)
    assert result.labels == ("length", "density", "stiffness", "damping", "drag")


@pytest.mark.parametrize("part", [0.0, 1e-6, 1e-4])
def test_by_rk4_the_past_between_nodes_is_that_of_the_robot_that_is_found(part):
    """Trajectories have nodes only. By interpolation the drag was a hundredth off, and p not explained."""
    swings = noisy([pulled(period, space="lobatto4") for period in (1.0, 2.3)], part, seed=0)
    result = calibrate(WRONG, swings)
    for name, value in result.estimates.items():
        true, error = float(getattr(BAR, name)), result.standard_errors[name]
        assert value == pytest.approx(true, rel=10.0 * part + 1e-7, abs=4.0 * error), name
    assert result.estimates["drag"] == pytest.approx(0.5, rel=1e-7 + 30.0 * part) and not result.unexplained


@pytest.mark.campaign
def test_b_not_zero_and_the_length(string_swing):
    """Rates along the rod belong to the history then, and follow the length."""
    string = string_swing.system
    result = calibrate(string.replace(density=0.2, friction=0.0, length=1.1), [string_swing])
    for name, value in result.estimates.items():
        assert value == pytest.approx(float(getattr(string, name)), rel=1e-7)


class Stiffer(Residual):
    """A residual that makes the strain smaller."""

    factor: Any

    def constitutive(self, knowledge, s, t, y, y_t, control):
        C, D, f2 = knowledge.constitutive(s, t, y, y_t, control)
        return C / self.factor, D / self.factor, f2 + (1.0 / self.factor - 1.0) * jnp.sum(C, axis=1)


def test_the_knowledge_of_a_model(swings):
    model = KNODE(WRONG, Stiffer(np.array(0.5)))
    result = calibrate(model, [kc.simulate(model.replace(stiffness=20.0), swings[0].control[1:], 0.1)])
    assert isinstance(result.robot, KNODE)
    assert result.estimates["stiffness"] == pytest.approx(20.0, rel=1e-7)


# what is said


def test_the_table(swings):
    result = calibrate(WRONG, noisy(swings, 1e-2, 0), ["stiffness", "drag"], level=0.9)
    head, _, stiffness, drag = str(result).splitlines()
    assert head.split() == ["parameter", "unit", "before", "estimate", "90", "%", "interval"]
    assert stiffness.split()[:3] == ["stiffness", "N", "30"] and drag.split()[:3] == ["drag", "kg/m2", "0"]
    low, high = result.intervals["stiffness"]
    _, _, _, estimate, shown_low, to, shown_high = stiffness.split()
    assert to == "to"
    for shown, value in ((estimate, result.estimates["stiffness"]), (shown_low, low), (shown_high, high)):
        assert float(shown) == pytest.approx(value, abs=0.1 * result.standard_errors["stiffness"])
    assert float(result.robot.stiffness) == result.estimates["stiffness"]
    assert result.correlation.shape == (2, 2) and result.correlation[0, 0] == pytest.approx(1.0)
    assert abs(result.correlation[0, 1]) < 1.0


def test_what_the_parameters_cannot_explain_is_said(swings):
    enough = calibrate(WRONG, noisy(swings, 1e-3, 0), ["stiffness", "drag"])
    assert enough.unexplained == ()
    shorter = WRONG.replace(length=0.9)
    missing = calibrate(shorter, noisy(swings, 1e-3, 0), ["stiffness", "drag"])
    assert "p" in missing.unexplained
    assert "not explained: what is left in p" in str(missing)


class Ropes(Bar):
    """A bar of so many ropes; the colour is for the eye."""

    ropes: Any = kc.robots.parameter("1", "how many", low=0.1, high=100.0, default=1.0)
    colour: Any = kc.robots.parameter("1", "not used", low=0.0, high=1.0, default=0.5)

    def constitutive(self, s, t, y, y_t, control):
        every = self.replace(stiffness=self.stiffness * self.ropes, damping=self.damping * self.ropes)
        return Bar.constitutive(every, s, t, y, y_t, control)


ROPES = Ropes(length=1.0, density=1.0, stiffness=30.0, damping=0.4, nodes=6)


def test_what_data_cannot_tell_apart_is_named(swings):
    with pytest.raises(
        CalibrationError,
        match=r"^these data determine only a combination of stiffness, damping and ropes; leave one of",
    ):
        calibrate(ROPES, swings, ["stiffness", "damping", "density", "ropes"])
    with pytest.raises(
        CalibrationError, match=r"^colour has no effect on these data; leave it out of names$"
    ):
        calibrate(ROPES, swings, ["stiffness", "colour"])
    result = calibrate(ROPES, swings)
    assert set(result.undetermined) == {"colour", "ropes"}
    assert "not determined by these data: colour, ropes" in str(result)
    assert result.estimates["stiffness"] == pytest.approx(20.0, rel=1e-7)


def test_data_without_motion_do_not_tell_the_drag():
    still = kc.simulate(BAR, np.ones((20, 1)), 0.1, initial=kc.equilibrium(BAR, np.ones(1)))
    with pytest.raises(CalibrationError, match=r"^drag has no effect on these data; leave it out of names$"):
        calibrate(BAR, [still], ["stiffness", "drag"])


class Soft(Bar):
    """A bar that may not be as stiff as it is."""

    stiffness: Any = kc.robots.parameter("N", "EA", low=1e-3, high=15.0)


def test_the_end_of_the_allowed_range_is_no_estimate(swings):
    soft = Soft(length=1.0, density=1.0, stiffness=10.0, nodes=6)
    with pytest.raises(
        CalibrationError, match=r"^stiffness ran to the end of its allowed range, 15; leave it out"
    ):
        calibrate(soft, swings, ["stiffness"])


def test_a_search_that_does_not_end_says_so(swings, monkeypatch):
    monkeypatch.setattr(search, "MOST_EVALUATIONS", 2)
    with pytest.raises(
        CalibrationError, match=r"^the search did not converge in 2 evaluations; begin closer"
    ):
        calibrate(WRONG, swings, ["stiffness", "drag"])


def test_noise_that_hides_a_parameter_is_said(swings):
    """Accelerations that drown in noise make a mass of nothing: an estimate would be a lie."""
    still = pulled(200.0)
    data = noisy([still, still], 1.0, 0)
    with pytest.raises(CalibrationError, match=r"^(noise in these states hides|these data do not determine)"):
        calibrate(BAR, data, ["stiffness", "density", "damping"])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["youngs_modulus"], r"^Bar has no parameter 'youngs_modulus'; there are length, density, stiffness"),
        ("stiffness", r"^names is 'stiffness'; allowed is a list of parameters: length"),
        ([], r"^names is \[\]; allowed is a list"),
        (["drag", "drag"], r"^names has drag twice$"),
        ([3], r"^Bar has no parameter 3;"),
    ],
)
def test_names_that_are_not_allowed(swings, names, message):
    with pytest.raises(kc.robots.ParameterError, match=message):
        calibrate(BAR, swings, names)


def test_other_arguments_that_are_not_allowed(swings):
    with pytest.raises(DataError, match=r"^trajectories is a Trajectory; allowed is a list"):
        calibrate(BAR, swings[0], ["drag"])
    with pytest.raises(DataError, match=r"^there are no trajectories"):
        calibrate(BAR, [], ["drag"])
    with pytest.raises(CalibrationError, match=r"^robot is a list; allowed is one robot$"):
        calibrate([BAR], swings, ["drag"])
    with pytest.raises(CalibrationError, match=r"^by is 'bars'; allowed is"):
        calibrate(BAR, swings, ["drag"], by="bars")
    for level in (0.0, 1.0, 95, "much", True):
        with pytest.raises(CalibrationError, match=r"^level is .* allowed is a number between 0 and 1$"):
            calibrate(BAR, swings, ["drag"], level=level)


@pytest.mark.parametrize("by", ["segments", "rollouts"])
def test_data_that_are_not_finite(swings, by):
    y = np.array(swings[0].y)
    y[4, 2, 0] = np.nan
    with pytest.raises(DataError, match=r"^trajectory 0 has y that is not finite in row 4"):
        calibrate(BAR, [dataclasses.replace(swings[0], y=y)], ["drag"], by=by)
    with pytest.raises(
        DataError, match=r"^trajectory 0 has 10 nodes of 19 numbers; the knowledge has 6 of 3$"
    ):
        calibrate(BAR, [kc.simulate(ROBOT, kc.controls.sine(1.0, 5, DT), DT)], ["drag"], by=by)


# parameters as numbers


def test_matrices_and_vectors_as_numbers():
    robot = ROBOT.replace(bending_damping=[0.03, 0.04, 0.05])
    unknowns = unknowns_of(robot, ["bending_damping", "drag", "gravity", "radius"])
    assert [unknown.kind for unknown in unknowns] == ["diagonal", "multiple", "components", "number"]
    numbers = values(robot, unknowns)
    np.testing.assert_array_equal(numbers, [0.03, 0.04, 0.05, 1e-4, 0.0, 0.0, -9.81, 0.003175])
    np.testing.assert_allclose(searched_numbers(unknowns, searched(unknowns, numbers)), numbers, rtol=1e-14)
    changed = with_numbers(robot, unknowns, np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]))
    np.testing.assert_array_equal(changed.bending_damping, np.diag([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(changed.drag, 4.0 * np.eye(3))
    np.testing.assert_array_equal(changed.gravity, [5.0, 6.0, 7.0])
    assert changed.radius == 0.5  # the most that is allowed
    full = np.diag([0.03, 0.04, 0.05])
    full[0, 1] = full[1, 0] = 1e-3
    with pytest.raises(
        kc.robots.ParameterError, match=r"^bending_damping is a matrix with more than a diagonal; allowed is"
    ):
        unknowns_of(ROBOT.replace(bending_damping=full), ["bending_damping"])
    with pytest.raises(
        kc.robots.ParameterError, match=r"^shear_modulus has no value: it follows from other parameters"
    ):
        unknowns_of(ROBOT, ["shear_modulus"])
    assert "shear_modulus" not in [unknown.name for unknown in unknowns_of(ROBOT, None)]
