"""Slopes at an equilibrium: closed forms of a cantilever, differences, symmetry."""

import numpy as np
import pytest

import knode_cosserat as kc

ROBOT = kc.load_robot("delrin-tendon-robot")
ROUTED = kc.robots.RoutedTendonRobot.like(ROBOT)
TIGHT = kc.solvers.NewtonOptions(tolerance=1e-13)
CONTROL = np.array([5.0, 2.0, 1.0, 3.0])


def relative_turn(one, other):
    """Rotation vectors (…, 3) of small turns from one quaternion to the other, global axes."""
    w, v, a, b = one[..., :1], one[..., 1:], other[..., :1], other[..., 1:]
    return 2.0 * (w * b - a * v - np.cross(b, v)) / np.sum(one * other, axis=-1, keepdims=True)


@pytest.mark.campaign
def test_a_cantilever_is_compliant_as_a_beam():
    """L³/3EI and L/GA against force, L²/2EI of both, L/EI and L/GJ against moment, L/EA along."""
    robot = ROBOT.replace(gravity=(0.0, 0.0, 0.0))
    L, Kse, Kbt = float(robot.length), np.asarray(robot.Kse), np.asarray(robot.Kbt)
    EI, GJ, GA, EA = Kbt[0, 0], Kbt[2, 2], Kse[0, 0], Kse[2, 2]
    across, lean = L**3 / (3 * EI) + L / GA, L**2 / (2 * EI)
    expected = np.diag([across, across, L / EA, L / EI, L / EI, L / GJ])
    expected[0, 4] = expected[4, 0] = lean
    expected[1, 3] = expected[3, 1] = -lean
    found = kc.statics.configuration(robot, np.zeros(4), space="lobatto4").compliance
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "robot", [ROBOT, pytest.param(ROUTED, marks=pytest.mark.campaign)], ids=["crude", "routed"]
)
def test_slopes_are_those_of_the_equilibrium(robot):
    """All 4 columns of the Jacobian against central differences of equilibria."""
    found = kc.statics.configuration(robot, CONTROL)
    step = 1e-4
    around = CONTROL + step * np.concatenate([np.eye(4), -np.eye(4)])
    beside = [kc.equilibrium(robot, each, newton=TIGHT) for each in around]
    p, h = (
        np.array([np.asarray(getattr(one, n))[0, -1] for one in beside]) for n in ("position", "quaternion")
    )
    slopes = np.concatenate([p[:4] - p[4:], relative_turn(h[4:], h[:4])], axis=1).T / (2 * step)
    assert found.jacobian.shape == (6, 4)
    np.testing.assert_allclose(found.jacobian, slopes, atol=1e-8)
    at_rest = kc.equilibrium(robot, CONTROL, newton=TIGHT)
    np.testing.assert_allclose(found.position, at_rest.tip_position[0], atol=1e-9)


@pytest.mark.campaign
def test_compliance_is_symmetric_and_positive():
    """Held tensions have a potential; the scheme along the rod keeps that up to its error."""
    C = kc.statics.configuration(ROBOT, CONTROL, space="lobatto4").compliance
    assert np.max(np.abs(C - C.T)) < 1e-5 * np.max(np.abs(C))
    assert np.min(np.linalg.eigvalsh((C + C.T) / 2)) > 0.0


@pytest.mark.campaign
def test_asymmetry_is_of_the_order_of_the_scheme():
    asymmetry = []
    for nodes in (10, 20):
        C = kc.statics.configuration(ROUTED.replace(nodes=nodes), CONTROL, space="lobatto4").compliance
        assert np.min(np.linalg.eigvalsh((C + C.T) / 2)) > 0.0
        asymmetry.append(np.max(np.abs(C - C.T)) / np.max(np.abs(C)))
    assert asymmetry[0] < 1e-5
    assert asymmetry[1] < asymmetry[0] / 10


@pytest.mark.slow
@pytest.mark.parametrize("part", [0.5, 0.98, 1.02, 2.0, 4.0])
def test_an_upright_column_is_unstable_beyond_greenhills_load(part):
    """A heavy column buckles at ρA g L³/EI = 7.837, and is straight in equilibrium beyond that too."""
    L, E, weight = float(ROBOT.length), float(ROBOT.youngs_modulus), 9.81 * float(ROBOT.mass_per_length)
    soft = weight * L**3 / (7.83735 * float(ROBOT.Kbt[0, 0])) / part
    column = ROBOT.replace(youngs_modulus=E * soft)
    found = kc.statics.configuration(column, np.zeros(4), space="lobatto4")
    np.testing.assert_allclose(found.position, [0.0, 0.0, L], atol=1e-3)
    assert found.unstable == (part > 1.0)


def test_a_quarter_turn_of_the_controls_turns_everything():
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    both = np.kron(np.eye(2), turn)
    one, other = (kc.statics.configuration(ROBOT, control) for control in (CONTROL, np.roll(CONTROL, 1)))
    np.testing.assert_allclose(other.position, turn @ one.position, atol=1e-9)
    np.testing.assert_allclose(np.roll(other.jacobian, -1, axis=1), both @ one.jacobian, atol=1e-8)
    np.testing.assert_allclose(other.compliance, both @ one.compliance @ both.T, atol=1e-7)
    measures = [each.manipulability.whole.singular_values for each in (one, other)]
    np.testing.assert_allclose(*measures, atol=1e-8)


@pytest.mark.campaign
def test_manipulability_is_that_of_the_jacobian():
    found = kc.statics.configuration(ROUTED, CONTROL)
    J, L = found.jacobian, float(ROUTED.length)
    moved, turned, whole = kc.statics.configuration(ROUTED, CONTROL).manipulability
    assert moved.measure == pytest.approx(np.sqrt(np.linalg.det(J[:3] @ J[:3].T)), rel=1e-6)
    assert moved.condition == pytest.approx(np.linalg.cond(J[:3]), rel=1e-9)
    scaled = np.concatenate([J[:3] / L, J[3:]])
    np.testing.assert_allclose(whole.singular_values, np.linalg.svd(scaled)[1], atol=1e-12)
    np.testing.assert_allclose(turned.singular_values, np.linalg.svd(J[3:])[1], atol=1e-12)


@pytest.mark.slow
def test_a_rod_without_controls_has_a_compliance():
    """L³/3EI of a slender cantilever; there is nothing that moves it."""
    length, radius, E = 0.3, 1e-3, 70e9
    rod = kc.robots.SlenderRod(
        length=length, radius=radius, density=6450.0, youngs_modulus=E, gravity=[0.0, 0.0, 0.0]
    )
    found = kc.statics.configuration(rod, np.zeros(0), space="lobatto4")
    assert found.jacobian.shape == (6, 0) and not found.unstable
    softness = length**3 / (3 * E * np.pi * radius**4 / 4)
    np.testing.assert_allclose(
        np.diag(kc.statics.configuration(rod, [], space="lobatto4").compliance)[:2], softness, rtol=1e-4
    )
    for ellipsoid in found.manipulability:
        assert not len(ellipsoid.singular_values)
        assert ellipsoid.measure == 0.0 and ellipsoid.condition == np.inf
    with pytest.raises(ValueError, match=r"control has shape .*there are no controls"):
        kc.statics.configuration(rod, [1.0])
    with pytest.raises(ValueError, match="a SlenderRod without controls is given"):
        kc.inverse_kinematics(rod, [0.0, 0.0, 0.3], low=0.0, high=1.0)
    assert kc.workspace(rod, np.zeros((2, 0)), space="lobatto4").unsolved == 0


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match=r"control has shape \(3,\); allowed is \(4,\): tension"):
        kc.statics.configuration(ROBOT, [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match=r"control is nan at index \(1,\)"):
        kc.statics.configuration(ROBOT, [1.0, np.nan, 3.0, 0.0])
    with pytest.raises(ValueError, match="robot is a list; allowed is a robot"):
        kc.statics.configuration([ROBOT], CONTROL)
