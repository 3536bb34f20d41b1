"""Effects: nominal numbers change nothing, and each component does what its closed form says."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import knode_cosserat as kc
from knode_cosserat.estimation.parameters import Number
from knode_cosserat.identification.effects import library_model
from knode_cosserat.rods.routing import Helical, Straight
from knode_cosserat.rods.section import Sleeve
from knode_cosserat.rods.tendons import (
    EarlyAnchors,
    LoadCells,
    RibSpacing,
    TendonFriction,
    stiffness_under_pressure,
)

NOMINAL = kc.load_robot("delrin-tendon-robot").replace(tendon_offset=0.02)
ROUTED = kc.robots.RoutedTendonRobot.like(NOMINAL)
TENSION = np.array([7.0, 5.0, 3.0, 5.0])


@pytest.fixture(scope="module")
def model():
    return library_model(NOMINAL, np.tile(TENSION, (4, 1)))


def shape(robot, tension=TENSION, **more):
    return np.asarray(kc.equilibrium(robot, tension, **more).position[-1])


@pytest.mark.campaign
def test_nominal_numbers_change_nothing(model):
    """The robot with all effects at zero is the nominal one, and so is the one without their parts."""
    x = np.zeros(model.size)
    basic = x.copy()
    expected = shape(ROUTED)
    assert np.allclose(shape(model.robot(basic)), expected, rtol=0.0, atol=1e-9)
    reduced = model.reduced(x, ("stiffness", "damping"))
    assert reduced.sections == () and reduced.loads == () and reduced.load_cells is None


def test_a_stated_damping_is_the_nominal_one():
    def damping_of(stated):
        model = library_model(NOMINAL.replace(bending_damping=stated), np.tile(TENSION, (4, 1)))
        return model.effect("damping").numbers[0]

    assert damping_of(0.03).nominal == 0.03 and damping_of([0.002, 0.002, 0.001]).nominal == 0.002
    # a fiftieth of the critical damping of the first mode, of a robot that states none
    usual = damping_of(0.0)
    w = 3.516 * np.sqrt(NOMINAL.Kbt[0, 0] / NOMINAL.mass_per_length) / NOMINAL.length**2
    assert usual.nominal == pytest.approx(0.04 * NOMINAL.Kbt[0, 0] / w, rel=0.01)
    assert usual.width == damping_of(0.03).width


@pytest.mark.campaign
def test_reduced_robots_stand_as_those_with_all_parts(model):
    """What is left out of a robot does nothing there."""
    nominal = model.reduced(np.zeros(model.size), ("stiffness", "damping"))
    assert np.allclose(shape(nominal), shape(ROUTED), rtol=0.0, atol=1e-9)
    x = 0.3 * np.ones(model.size)
    names = ("stiffness", "damping", "rest curvature", "sleeve", "load cell gains", "base rotation")
    whole = model.robot(np.where(model.mask(names), x, 0.0))
    assert np.allclose(shape(whole), shape(model.reduced(x, names)), rtol=0.0, atol=1e-9)


@given(st.floats(-3.0, 3.0), st.booleans(), st.floats(0.1, 10.0), st.floats(0.01, 2.0))
@settings(deadline=None, max_examples=50)
def test_numbers_and_their_coordinates(x, logarithmic, nominal, width):
    number = Number("a", "m", nominal, width, 0.0, 1e6, logarithmic)
    value = float(number.value(np.asarray(x)))
    expected = nominal * np.exp(width * x) if logarithmic else nominal + width * x
    assert value == pytest.approx(expected, rel=1e-12)
    low, _ = number.bounds
    at_low = 0.0 if np.isinf(low) else float(number.value(np.asarray(low)))
    assert at_low == pytest.approx(0.0, abs=1e-9)


def test_pressed_is_smooth_and_that_of_a_beam_column():
    w = np.array([1e-12, 9.99e-4, 1.001e-3, 0.5, 1.0, 2.0])
    assert np.asarray(stiffness_under_pressure(w)) == pytest.approx(
        np.sqrt(w) / np.tan(np.sqrt(w)), rel=1e-13
    )
    assert float(stiffness_under_pressure(np.asarray(0.0))) == 1.0
    # a rod between two ribs that buckles has no stiffness
    assert float(stiffness_under_pressure(np.asarray(np.pi**2 / 4.0))) == pytest.approx(0.0, abs=1e-12)
    beyond = np.asarray(stiffness_under_pressure(np.pi**2 / 4.0 + np.array([1e-7, 5.0, 50.0])))
    assert np.all(np.diff(beyond) < 0.0) and beyond == pytest.approx([-5e-8, -2.5, -25.0])


@pytest.mark.slow
def test_softening_by_tension_bends_the_rod_to_a_smaller_circle():
    """Closed form: T r/EI, softer by the factor of a beam-column, towards the tendon at 45 degrees."""
    robot = ROUTED.replace(gravity=(0.0, 0.0, 0.0))
    tension, c, EI = np.array([2.0, 0.0, 0.0, 0.0]), 1e-2, float(robot.Kbt[0, 0])
    left = float(stiffness_under_pressure(np.asarray(3.0 * c * tension.sum() / EI)))
    assert left < 0.95
    bent = kc.equilibrium(robot.replace(rib_spacing=RibSpacing(softening=c)), tension)
    expected = 2.0 * 0.02 / (EI * left) * np.sqrt(0.5) * np.array([-1.0, 1.0, 0.0])
    np.testing.assert_allclose(bent.part("u")[-1] - expected, 0.0, atol=1e-9)


@pytest.mark.campaign
def test_softening_by_tension_is_that_of_stiffness():
    """Without gravity a tendon bends the rod to a circle; softer by the factor of a beam-column."""
    # the ribs below are at nodes
    robot = ROUTED.replace(gravity=(0.0, 0.0, 0.0), shear_stiffness=1e6, nodes=9)
    tension, c = np.array([2.0, 0.0, 0.0, 0.0]), 1e-3
    EI = float(robot.Kbt[0, 0])
    left = float(stiffness_under_pressure(np.asarray(3.0 * c * tension.sum() / EI)))
    soft = robot.replace(rib_spacing=RibSpacing(softening=c))
    # of ribs whose places are known
    spans = robot.replace(
        rib_spacing=RibSpacing(at=(0.25, 0.5, 0.75, 1.0), share=c / (0.25 * robot.length) ** 2 * 12.0)
    )
    softer = robot.replace(bending_stiffness=np.diag([EI * left, EI * left, float(robot.Kbt[2, 2])]))
    assert np.allclose(shape(soft, tension), shape(softer, tension), rtol=0.0, atol=1e-9)
    assert np.allclose(shape(spans, tension), shape(softer, tension), rtol=0.0, atol=1e-8)


@pytest.mark.slow
def test_load_cells_correct_tensions():
    gain, offset = np.array([1.1, 0.9, 1.0, 1.0]), np.array([0.2, 0.0, -0.1, -9.0])
    cells = LoadCells(gain=gain, offset=offset)
    true = np.maximum(gain * TENSION + offset, 0.0)
    assert true[-1] == 0.0
    found = shape(ROUTED.replace(load_cells=cells))
    assert np.allclose(found, shape(ROUTED, true), rtol=0.0, atol=1e-9)


@pytest.mark.campaign
def test_early_anchors_are_ends_of_routings():
    at = 6.0 / 9.0
    early = ROUTED.replace(anchors=EarlyAnchors(at=at, share=(0.0, 1.0, 1.0, 1.0)))
    routing = tuple(
        Straight(0.02 * np.cos(angle), 0.02 * np.sin(angle), end=at if k == 0 else 1.0)
        for k, angle in enumerate(np.asarray(NOMINAL.tendon_angles))
    )
    assert np.allclose(shape(early), shape(ROUTED.replace(routing=routing)), rtol=0.0, atol=1e-8)


@pytest.mark.campaign
def test_twisted_tendons_are_helices():
    twist = 0.7
    routing = tuple(
        Helical(0.02, phase=angle, turns=twist / (2.0 * np.pi)) for angle in np.asarray(NOMINAL.tendon_angles)
    )
    twisted = ROUTED.replace(tendon_twist=twist)
    assert not np.allclose(shape(twisted), shape(ROUTED), atol=1e-3)
    assert np.allclose(shape(twisted), shape(ROUTED.replace(routing=routing)), rtol=0.0, atol=1e-9)


@pytest.mark.campaign
def test_tendons_whose_routing_is_stated_are_moved_by_effects_of_that():
    """Angles of tendons mean nothing there; those of the routing turn each tendon."""
    routing = tuple(
        Straight(0.02 * np.cos(angle), 0.02 * np.sin(angle)) for angle in np.asarray(NOMINAL.tendon_angles)
    )
    model = library_model(ROUTED.replace(routing=routing), np.tile(TENSION, (4, 1)))
    assert not {"tendon offset", "tendon angles", "tendon twist"} & set(model.names)
    x = np.zeros(model.size)
    x[model.slice("routing by motor")] = [1.0, 0.0, 0.0, 0.0]
    turn = model.numbers[model.slice("routing by motor").start].width
    angles = np.asarray(NOMINAL.tendon_angles) + np.array([turn, 0.0, 0.0, 0.0])
    found = shape(model.reduced(x, ("stiffness", "damping", "routing by motor")))
    assert np.allclose(found, shape(ROUTED.replace(tendon_angles=angles)), rtol=0.0, atol=1e-9)


def test_a_sleeve_is_stiffness_along_the_rod():
    s = np.linspace(0.0, 1.0, 7) * float(ROUTED.length)
    robot = ROUTED.replace(sections=(Sleeve(stiffening=2.0, length=0.3),))
    found = [float(robot.material(each, np.zeros(4)).Kbt[0, 0] / ROUTED.Kbt[0, 0]) for each in s]
    assert found == pytest.approx(1.0 + 2.0 * np.exp(-((s / (0.3 * float(ROUTED.length))) ** 4)), rel=1e-12)


@pytest.mark.campaign
def test_friction_at_rest_holds_the_robot_back():
    """A part of the friction of the way from the unloaded rod: it is bent less, and more by the opposite."""
    robot = ROUTED.replace(friction=TendonFriction(wobble=0.5, reach=0.1))
    bent = {}
    for part in (-1.0, 0.0, 1.0):
        friction = dataclasses.replace(robot.friction, at_rest=part)
        bent[part] = np.linalg.norm(shape(robot.replace(friction=friction))[-1, :2])
    assert bent[1.0] < bent[0.0] < bent[-1.0]
    assert bent[0.0] == pytest.approx(np.linalg.norm(shape(ROUTED)[-1, :2]), rel=1e-9)


@pytest.mark.slow
def test_its_parts_come_back_from_a_file(model, tmp_path):
    x = 0.3 * np.ones(model.size)
    robot = model.reduced(x, model.names)
    kc.save_robot(robot, tmp_path / "found.yaml")
    again = kc.load_robot(tmp_path / "found.yaml")
    assert again.load_cells.kind == "load-cells" and again.anchors.kind == "early-anchors"
    assert again.sections[-1].kind == "sleeve"
    tension = TENSION[None]
    assert np.allclose(again.load_cells.tension(tension[0]), robot.load_cells.tension(tension[0]), rtol=1e-12)
    assert np.allclose(again.anchors.share, robot.anchors.share, rtol=1e-12)
    assert float(again.friction.at_rest) == pytest.approx(float(robot.friction.at_rest), rel=1e-12)
