"""Identification of robots with reels: nominal numbers change nothing, and equilibria tell the truth."""

import dataclasses

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.identification.effects import library_model
from knode_cosserat.identification.evaluate import evaluate
from knode_cosserat.identification.experiments import experiments_of
from knode_cosserat.rods.routing import Straight
from knode_cosserat.rods.section import Stretch
from knode_cosserat.rods.tendons import Reels

#: three cables in a soft rod that hangs; a control of 1 takes in 0.1 mm
CABLES = kc.robots.RoutedTendonRobot(
    length=0.12,
    radius=0.004,
    density=1100.0,
    youngs_modulus=3e5,
    gravity=(0.0, 0.0, 9.81),
    nodes=6,
    tendon_offset=0.004,
    tendon_angles=(0.0, 2.0944, 4.1888),
    drive="reel",
    reels=Reels(motors=(1, 2, 3), radius=(1e-4, 1e-4, 1e-4)),
)
PAIR = CABLES.replace(
    routing=(Straight(0.02, 0.0), Straight(-0.02, 0.0), Straight(0.0, 0.02, end=0.5)),
    reels=Reels(motors=(1, -1, 2), radius=(0.03, 0.03), taken_in=(1e-3, 1e-3, 0.0), compliance=(1e-3,) * 3),
)


@pytest.mark.parametrize("robot", [CABLES, PAIR])
def test_nominal_numbers_change_nothing(robot):
    model = library_model(robot, np.ones((4, robot.control_layout.size)))
    assert not {"load cell gains", "early anchors", "vibration", "friction"} & set(model.names)
    assert ("tendon angles" in model.names) == (robot.routing is None)
    same = model.robot(np.zeros(model.size))
    control = np.linspace(0.5, 1.0, robot.control_layout.size)
    for s in (0.0, 0.3, 1.0):
        for each, nominal in zip(same.routes_at(s), robot.routes_at(s), strict=True):
            np.testing.assert_allclose(each, nominal, rtol=0.0, atol=1e-15)
        found, expected = same.material(s * 0.12, control), robot.material(s * 0.12, control)
        np.testing.assert_allclose(found.Kse, expected.Kse, rtol=1e-12)
        np.testing.assert_allclose(found.Kbt, expected.Kbt, rtol=1e-12)
    np.testing.assert_allclose(same.taken_in(control), robot.taken_in(control), rtol=0.0, atol=1e-15)
    own, nominal = (each.parts["tendons"].compliance for each in (same, robot))
    np.testing.assert_allclose(own, nominal * np.ones(3), rtol=1e-12)
    reduced = model.reduced(np.zeros(model.size), ("stiffness", "damping"))
    assert reduced.sections == () and reduced.loads == () and reduced.shear_stiffness is None
    for name in ("zero", "taken_in", "compliance"):
        assert (getattr(reduced.reels, name) is None) == (getattr(robot.reels, name) is None)


def test_what_effects_do():
    model = library_model(PAIR, np.ones((4, 2)))
    x = np.zeros(model.size)
    x[model.slice("taken in")] = [1.0, 2.0]
    x[model.slice("motor zeros")] = [0.5, 0.0]
    x[model.slice("axial stiffness")] = 1.0
    x[model.slice("routing")] = [1.0, 2.0]
    robot = model.robot(x)
    # by where they end: first those to half of the length; angles by 1 % of the length over the radius
    zero = 0.5 * 0.01 * 0.12 / 0.03
    expected = [1e-3 + 2.4e-3 - 0.03 * zero, 1e-3 + 2.4e-3 + 0.03 * zero, 1.2e-3]
    assert np.asarray(robot.taken_in(np.zeros(2))) == pytest.approx(expected, abs=1e-12)
    assert np.asarray(robot.Kse) == pytest.approx(np.e * np.asarray(PAIR.Kse), rel=1e-12)
    r = 0.02 * np.exp(0.1)
    assert robot.routes_at(0.0)[0][0] == pytest.approx([r * np.cos(0.2), r * np.sin(0.2), 0.0], rel=1e-12)


def test_motors_whose_zeros_are_elsewhere_are_refused_at_once():
    turned = np.random.default_rng(2).uniform(-20.0, 20.0, (6, 3))
    for zero, done in ((100.0, "taken in"), (-100.0, "let out")):
        data = equilibria(CABLES, turned)
        data = dataclasses.replace(data, control=turned + zero)
        words = rf"all tendons are {done} by [67]\.?\d* % .* zero: \[{turned[0, 0] + zero:.4g}, "
        with pytest.raises(kc.identification.IdentificationError, match=words):
            kc.identify(CABLES, [data])


def equilibria(robot, control, noise=5e-5):
    still = kc.equilibrium(robot, control, space="lobatto4")
    position = np.asarray(still.position)[:, :, -1]
    position = position + noise * np.random.default_rng(0).normal(size=position.shape)
    count = len(control)
    return kc.recordings.Measurements(
        time=np.arange(float(count)),
        control=control,
        fractions=np.ones(1),
        position=position,
        quaternion=np.full((count, 1, 4), np.nan),
        measured=np.ones((count, 1), dtype=bool),
        simulated=True,
        source="equilibria",
        static=True,
    )


def test_equilibria_follow_a_row_that_was_not_seen():
    seen = equilibria(CABLES, np.full((3, 3), 20.0))
    [data] = experiments_of([seen], library_model(CABLES, seen.control, seen.fractions))
    assert data.static and len(data.control) == 3 and np.isnan(data.data[0]).all()
    np.testing.assert_array_equal(data.data[1:, :3], seen.position[:, 0])


@pytest.mark.campaign
def test_a_robot_is_found_from_equilibria():
    """Slack cables among them; each row is predicted by itself, and in any order."""
    true = CABLES.replace(
        length=0.125,
        tendon_offset=0.0043,
        sections=(Stretch(curvature=(1.0, -0.5, 0.0)),),
        shear_stiffness=0.7 * np.asarray(CABLES.Kse),
    )
    rng = np.random.default_rng(1)
    control = 80.0 * rng.uniform(size=(40, 3))
    control[np.arange(40), rng.integers(0, 3, size=40)] = 0.0
    seen = equilibria(true, control)
    assert evaluate(true, seen).tip_rmse < 1e-4
    learned, unseen = seen.rows(0, 20), seen.rows(20, 40)
    effects = ["length", "axial stiffness", "tendon offset", "rest curvature"]
    found = kc.identify(CABLES, [learned], effects)
    before, after = (evaluate(robot, unseen).tip_rmse for robot in (CABLES, found.robot))
    assert before > 2e-3 and after < 2e-4
    by_label = {each.label: each.value for each in found.estimates}
    assert by_label["length"] == pytest.approx(0.125, rel=0.01)


#: two sections of steel, three tendons each, with a servo for each tendon; controls are lengths
SERVOS = kc.robots.RoutedTendonRobot(
    length=0.2,
    radius=5e-4,
    density=7850.0,
    youngs_modulus=2e11,
    nodes=7,
    drive="reel",
    reels=Reels(motors=(1, 2, 3, 4, 5, 6)),
    routing=tuple(
        Straight(4.5e-3 * np.cos(angle), 4.5e-3 * np.sin(angle), end=end)
        for end, turn in ((0.5, 0.0), (1.0, np.pi / 6))
        for angle in turn + 2 * np.pi / 3 * np.arange(3)
    ),
)


@pytest.mark.campaign
def test_a_servo_robot_is_found_from_the_tip():
    """Elastic tendons, slack, wrong zeros, a displaced base: lengths determine stiffness × compliance."""
    compliance = 6e-5
    true = SERVOS.replace(
        reels=Reels(motors=(1, 2, 3, 4, 5, 6), zero=(2e-4, -3e-4, 1e-4, -2e-4, 3e-4, -1e-4)),
        tendon_compliance=compliance,
        base_end=kc.robots.ends.Clamped(position=(2e-3, -1e-3, 0.0), orientation=(1.0, 0.0, 0.0, 0.0)),
    )
    control = 3e-3 * np.random.default_rng(2).uniform(-1.0, 1.0, size=(80, 6))
    seen = equilibria(true, control, 5e-4)
    found = kc.identify(SERVOS, [seen.rows(0, 50)], ["base position", "motor zeros", "tendon elasticity"])
    before, after = (evaluate(robot, seen.rows(50, 80)).tip_rmse for robot in (SERVOS, found.robot))
    assert before > 5e-3 and after < 1.2e-3  # noise 0.9 mm
    modulus = found["youngs_modulus"]
    assert modulus.held and modulus.value == pytest.approx(2e11, rel=0.5)
    product = found["tendon_compliance"].value * modulus.value / 2e11
    assert product == pytest.approx(compliance, rel=0.1)
