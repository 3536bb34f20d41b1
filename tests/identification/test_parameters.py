"""Plain parameters from trajectories: accuracy, undetermined parameters, and errors."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.estimation import BaseWrench, Curvatures
from knode_cosserat.estimation.parameters import ParameterModel
from knode_cosserat.identification import Experiment, IdentificationError, identify, search
from knode_cosserat.identification.experiments import experiments_of
from knode_cosserat.identification.free_parameters import parameter_effects
from knode_cosserat.identification.misfit import Misfit
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.residual import Residual
from knode_cosserat.rods.aspects import Ends
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.solvers.segments import DataError
from tests.identification.motions import DT, FOUR, ROBOT, noisy, require_exact_slopes, sines
from tests.learning.bar import BAR, WRONG, Bar, pulled

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
    result = identify(ROBOT.replace(**start), data, parameters=FOUR)
    assert result["youngs_modulus"].value == pytest.approx(float(true.youngs_modulus), rel=1e-8)
    assert result["length"].value == pytest.approx(float(true.length), rel=1e-8)
    assert result["bending_damping"].value == pytest.approx(true.bending_damping[0, 0], rel=1e-8)
    assert result["drag"].value == pytest.approx(true.drag[0, 0], abs=2e-10)
    for name in FOUR:
        (low, high), value = result[name].interval, np.max(getattr(true, name))
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
    result = identify(begin, sines(true), parameters="all")
    # the sum of opposite tensions is the same all the time, so a turned tendon may as well be gravity
    assert {"tendon_offset", "tendon_angles"} <= set(result.undetermined)
    for name in result.undetermined:
        np.testing.assert_array_equal(getattr(result.robot, name), getattr(begin, name))
    for name in ("length", "radius", "density", "youngs_modulus"):
        assert result[name].value == pytest.approx(float(getattr(true, name)), rel=1e-8)
    np.testing.assert_allclose(result.robot.gravity, true.gravity, atol=1e-7)
    controls = kc.controls.sine(1.5, 100, DT)
    again = kc.simulate(result.robot, controls, DT)[:100]
    assert kc.metrics.tip_dtw(again, kc.simulate(true, controls, DT)[:100]) < 1e-6


@pytest.mark.campaign
def test_a_robot_at_rest_tells_little():
    tension = np.array([6.0, 5.0, 5.0, 5.0])
    still = kc.simulate(ROBOT, np.tile(tension, (29, 1)), DT, initial=kc.equilibrium(ROBOT, tension))
    result = identify(ROBOT.replace(youngs_modulus=4e9), [still, still], parameters="all")
    assert result["youngs_modulus"].value == pytest.approx(2.757903e9, rel=1e-8)
    assert {"drag", "bending_damping", "shear_damping", "gravity"} <= set(result.undetermined)
    result = identify(ROBOT, [still, still], parameters=["density", "gravity"])
    assert result.undetermined == ("gravity",) and "density" in result.effects
    assert any("only a combination of density and gravity" in step for step in result.steps)


def test_any_system(swings):
    begin = WRONG.replace(length=1.2, density=2.0, damping=0.0)
    result = identify(begin, swings, parameters="all")
    for it in result.estimates:
        assert it.value == pytest.approx(float(getattr(BAR, it.label)), rel=1e-7)
    assert result.effects == ("length", "density", "stiffness", "damping", "drag")


@pytest.mark.parametrize("part", [0.0, 1e-6, 1e-4])
def test_trajectories_by_a_scheme_with_stages_between_nodes(part):
    swings = noisy([pulled(period, space="lobatto4") for period in (1.0, 2.3)], part, seed=0)
    result = identify(WRONG, swings, parameters="all")
    for it in result.estimates:
        true = float(getattr(BAR, it.label))
        assert it.value == pytest.approx(true, rel=10.0 * part + 1e-7, abs=4.0 * it.error), it.label
    assert result["drag"].value == pytest.approx(0.5, rel=1e-7 + 30.0 * part) and not result.unexplained


@pytest.mark.campaign
def test_b_not_zero_and_the_length(string_swing):
    """Rates along the rod belong to the history then, and follow the length."""
    string = string_swing.system
    begin = string.replace(density=0.2, friction=0.0, length=1.1)
    result = identify(begin, [string_swing], parameters="all")
    for it in result.estimates:
        assert it.value == pytest.approx(float(getattr(string, it.label)), rel=1e-7)


class Stiffer(Residual):
    """A residual that makes the strain smaller."""

    factor: Any

    def derivatives(self, knowledge, point):
        z = 1.0 + self.factor * (semi_discrete.strains(knowledge, point) - 1.0)
        return semi_discrete.rates(knowledge, point, z), z


def test_the_knowledge_of_a_model(swings):
    model = KNODE(WRONG, Stiffer(np.array(0.5)))
    moved = kc.simulate(model.replace(stiffness=20.0), swings[0].control[1:], 0.1)
    result = identify(model, [moved], parameters="all")
    assert isinstance(result.robot, KNODE)
    assert result["stiffness"].value == pytest.approx(20.0, rel=1e-7)


# what is said


def test_the_table(swings):
    result = identify(WRONG, noisy(swings, 1e-2, 0), parameters=["stiffness", "drag"])
    head, _, stiffness, drag, *_ = str(result).splitlines()
    assert head.split() == ["number", "unit", "nominal", "estimate", "95", "%", "interval"]
    assert stiffness.split()[:3] == ["stiffness", "N", "30"] and drag.split()[:3] == ["drag", "kg/m2", "0"]
    low, high = result["stiffness"].interval
    _, _, _, estimate, shown_low, to, shown_high = stiffness.split()
    assert to == "to"
    for shown, value in ((estimate, result["stiffness"].value), (shown_low, low), (shown_high, high)):
        assert float(shown) == pytest.approx(value, abs=0.1 * result["stiffness"].error)
    assert float(result.robot.stiffness) == result["stiffness"].value
    assert result.correlation.shape == (2, 2) and result.correlation[0, 0] == pytest.approx(1.0)
    assert abs(result.correlation[0, 1]) < 1.0
    with pytest.raises(KeyError, match="no estimate 'colour'; there are stiffness, drag"):
        result["colour"]


def test_what_the_parameters_cannot_explain_is_said(swings):
    enough = identify(WRONG, noisy(swings, 1e-3, 0), parameters=["stiffness", "drag"])
    assert enough.unexplained == ()
    shorter = WRONG.replace(length=0.99)
    missing = identify(shorter, noisy(swings, 1e-3, 0), parameters=["stiffness", "drag"])
    assert "p" in missing.unexplained
    assert "not explained: the remaining differences in p" in str(missing)


class Ropes(Bar):
    """A bar of so many ropes; the colour is for the eye."""

    ropes: Any = kc.robots.parameter("1", "how many", low=0.1, high=100.0, default=1.0)
    colour: Any = kc.robots.parameter("1", "not used", low=0.0, high=1.0, default=0.5)

    def constitutive(self, s, t, y, y_t, control):
        every = self.replace(stiffness=self.stiffness * self.ropes, damping=self.damping * self.ropes)
        return Bar.constitutive(every, s, t, y, y_t, control)


ROPES = Ropes(length=1.0, density=1.0, stiffness=30.0, damping=0.4, nodes=6)


def test_undetermined_parameters_are_named(swings):
    result = identify(ROPES, swings, parameters=["stiffness", "damping", "density", "ropes"])
    assert result.undetermined == ("ropes",)
    assert "these data determine only a combination of stiffness and ropes" in result.steps
    result = identify(ROPES, swings, parameters="all")
    assert set(result.undetermined) == {"colour", "ropes"}
    assert "colour has no effect on these data" in result.steps
    assert "not determined by these data, unchanged: ropes, colour" in str(result)
    assert result["stiffness"].value == pytest.approx(20.0, rel=1e-7)
    with pytest.raises(IdentificationError, match=r"^these data determine none of colour: colour has no"):
        identify(ROPES, swings, parameters=["colour"])


def test_data_without_motion_do_not_determine_the_drag():
    still = kc.simulate(BAR, np.ones((20, 1)), 0.1, initial=kc.equilibrium(BAR, np.ones(1)))
    result = identify(BAR, [still], parameters=["stiffness", "drag"])
    assert result.undetermined == ("drag",) and "drag has no effect on these data" in result.steps
    assert result["stiffness"].value == pytest.approx(20.0, rel=1e-7)


class Soft(Bar):
    """A bar that may not be as stiff as it is."""

    stiffness: Any = kc.robots.parameter("N", "EA", low=1e-3, high=15.0)


def test_the_end_of_the_allowed_range_is_no_estimate(swings):
    soft = Soft(length=1.0, density=1.0, stiffness=10.0, nodes=6)
    with pytest.raises(
        IdentificationError, match=r"^stiffness ran to the end of its allowed range, 15; leave it out"
    ):
        identify(soft, swings, parameters=["stiffness"])


def test_a_search_that_does_not_converge_is_an_error(swings, monkeypatch):
    monkeypatch.setattr(search, "EXACT", (1, 1e-15))
    monkeypatch.setattr(search, "FIRST", (1, 1e-2))
    with pytest.raises(IdentificationError, match=r"^the search did not converge; begin closer"):
        identify(WRONG, swings, parameters=["stiffness", "drag"])


def test_a_parameter_hidden_by_noise_is_undetermined():
    """Accelerations that are smaller than the noise do not determine a mass."""
    still = pulled(200.0)
    data = noisy([still, still], 100.0, 0)
    with pytest.raises(IdentificationError, match=r"^these data determine none of stiffness, density, damp"):
        identify(BAR, data, parameters=["stiffness", "density", "damping"])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["youngs_modulus"], r"^Bar has no parameter 'youngs_modulus'; there are length, density, stiffness"),
        ("stiffness", r"^parameters is 'stiffness'; allowed is a list.*did you mean \[parameters\]"),
        ([], r"^parameters is \[\]; allowed is a list"),
        (["drag", "drag"], r"^parameters has drag twice$"),
        ([3], r"^parameters holds 3; allowed is a list"),
    ],
)
def test_names_that_are_not_allowed(swings, names, message):
    with pytest.raises(ValueError, match=message):
        identify(BAR, swings, parameters=names)


def test_other_arguments_that_are_not_allowed(swings):
    with pytest.raises(ValueError, match=r"^data is a Trajectory; allowed is a list"):
        identify(BAR, swings[0], parameters=["drag"])
    with pytest.raises(DataError, match=r"^there are no recordings and no trajectories"):
        identify(BAR, [], parameters=["drag"])
    with pytest.raises(ValueError, match=r"^robot is a list; allowed is a robot"):
        identify([BAR], swings, parameters=["drag"])
    with pytest.raises(DataError, match=r"^data holds a Trajectory; effects need recordings"):
        identify(BAR, swings)


def test_data_that_do_not_fit(swings):
    wild = dataclasses.replace(swings[0], control=np.full_like(swings[0].control, np.nan))
    with pytest.raises(DataError, match=r"^trajectory 0 has controls that are not finite"):
        identify(BAR, [wild], parameters=["drag"])
    with pytest.raises(DataError, match=r"^trajectory 0 has 10 nodes of 19 numbers; the robot has 6 of 3$"):
        identify(BAR, [kc.simulate(ROBOT, kc.controls.sine(1.0, 5, DT), DT)], parameters=["drag"])
    with pytest.raises(DataError, match=r"^data holds a Trajectory; effects need recordings"):
        identify(ROBOT, [kc.simulate(ROBOT, kc.controls.sine(1.0, 5, DT), DT)])


def test_states_that_were_not_measured_may_be_missing(swings):
    y = np.array(swings[0].y)
    y[4, 2, 0] = np.nan
    found = identify(WRONG, [dataclasses.replace(swings[0], y=y)], parameters=["stiffness", "drag"])
    assert found["stiffness"].value == pytest.approx(20.0, rel=1e-7)


# kinds of data


@pytest.mark.parametrize("output", [Curvatures((0.3, 0.7)), BaseWrench()], ids=["curvatures", "base wrench"])
def test_any_output_of_a_sensor_determines_parameters(output):
    true = ROBOT.replace(youngs_modulus=3.3e9)
    control = kc.controls.sine(0.5, 12, DT)
    moved = kc.simulate(true, control, DT)
    data = np.array([output.value(true, y, z) for y, z in zip(moved.y, moved.z, strict=True)])
    data[0] = np.nan
    seen = Experiment(DT, control, output, data)
    found = identify(ROBOT, [seen], parameters=["youngs_modulus"])
    assert found["youngs_modulus"].value == pytest.approx(3.3e9, rel=1e-6)


# slopes


class Hanging(Bar):
    """A bar stretched by its own weight: its start is an equilibrium that has to be found."""

    def balance(self, s, t, y, y_t, z, z_t, control):
        return super().balance(s, t, y, y_t, z, z_t, control).at[1].add(-9.81 * self.density)


class GuessedRest(Ends, of=Hanging):
    rest_is_guess = True


@pytest.mark.parametrize("space", [pytest.param("euler", marks=pytest.mark.campaign), "lobatto4"])
def test_slopes_of_a_start_that_has_to_be_found_are_exact(space):
    bar = Hanging(**{name: getattr(BAR, name) for name in BAR.parameters()}, nodes=6)
    moved = pulled(1.0, robot=bar, space=space)
    assert moved.y[0, -1, 0] > 1.1
    other = bar.replace(stiffness=25.0)
    model = ParameterModel(other, parameter_effects(other, ["length", "density", "stiffness", "damping"]))
    require_exact_slopes(Misfit(model, experiments_of([moved], model)), 4)


# parameters as numbers


def test_matrices_and_vectors_as_numbers():
    robot = ROBOT.replace(bending_damping=[0.03, 0.04, 0.05])
    effects = parameter_effects(robot, ["bending_damping", "drag", "gravity", "radius"])
    model = ParameterModel(robot, effects)
    assert model.labels == (
        "bending_damping[0]",
        "bending_damping[1]",
        "bending_damping[2]",
        "drag",
        "gravity[0]",
        "gravity[1]",
        "gravity[2]",
        "radius",
    )
    np.testing.assert_allclose(
        model.values(np.zeros(model.size)), [0.03, 0.04, 0.05, 1e-4, 0.0, 0.0, -9.81, 0.003175]
    )
    numbers = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0])
    x = np.array([it.coordinate(value) for it, value in zip(model.numbers, numbers, strict=True)])
    changed = model.reduced(x, model.names)
    np.testing.assert_allclose(changed.bending_damping, np.diag([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(changed.drag, 4.0 * np.eye(3))
    np.testing.assert_allclose(changed.gravity, [5.0, 6.0, 7.0])
    assert changed.radius == 0.5  # the most that is allowed
    full = np.diag([0.03, 0.04, 0.05])
    full[0, 1] = full[1, 0] = 1e-3
    with pytest.raises(
        kc.robots.ParameterError, match=r"^bending_damping is a matrix with more than a diagonal; allowed is"
    ):
        parameter_effects(ROBOT.replace(bending_damping=full), ["bending_damping"])
    with pytest.raises(
        kc.robots.ParameterError, match=r"^shear_modulus has no value: it follows from other parameters"
    ):
        parameter_effects(ROBOT, ["shear_modulus"])
    assert "shear_modulus" not in [effect.name for effect in parameter_effects(ROBOT, "all")]
