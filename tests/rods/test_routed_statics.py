"""Routed robots through the package's own solver: Rucker & Webster's equations, reels, and capstans."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.rods.routing import Helical, Polynomial, Straight, Tapered
from knode_cosserat.rods.tendons import TendonFriction
from tests.rods import rucker_webster as oracle

DELRIN = kc.load_robot("delrin-tendon-robot")
L = 0.635
ROD = oracle.Rod(
    L,
    np.asarray(DELRIN.Kse),
    np.asarray(DELRIN.Kbt),
    float(DELRIN.mass_per_length) * np.array([0.0, 0.0, -9.81]),
)
#: one ends at a node (of 11, 21 or 41), one between nodes
ROUTING = (
    Straight(0.015, 0.01),
    Helical(0.02, 0.5, 0.75),
    Polynomial([0.01, 0.02, -0.03], [0.0, 0.015], end=0.4),
    Tapered(0.02, 0.008, 2.5, end=0.73),
)
PATHS = (
    lambda T: oracle.polynomial([0.015], [0.01], L, T),
    lambda T: oracle.helix(0.02, 0.5, 0.75, L, T),
    lambda T: oracle.polynomial([0.01, 0.02, -0.03], [0.0, 0.015], L, T, end=0.4),
    lambda T: oracle.polynomial(
        *([0.02 * f(2.5), -0.012 / 0.73 * f(2.5)] for f in (np.cos, np.sin)), L, T, end=0.73
    ),
)
ROBOT = kc.robots.RoutedTendonRobot.like(DELRIN, routing=ROUTING, bending_damping=0.0)


def rest(tensions, nodes=41):
    return kc.equilibrium(ROBOT.replace(nodes=nodes), np.asarray(tensions), space="lobatto4")


def exact(tensions):
    return oracle.shape(ROD, [path(T) for path, T in zip(PATHS, tensions, strict=True)])


@pytest.mark.parametrize(
    "tensions",
    [
        pytest.param((8.0, 0.0, 0.0, 0.0), id="straight", marks=pytest.mark.campaign),
        pytest.param((0.0, 8.0, 0.0, 0.0), id="helical", marks=pytest.mark.campaign),
        pytest.param((0.0, 0.0, 8.0, 0.0), id="ends at a node", marks=pytest.mark.campaign),
        pytest.param((0.0, 0.0, 0.0, 8.0), id="ends between nodes", marks=pytest.mark.campaign),
        pytest.param((4.0, 6.0, 3.0, 5.0), id="all", marks=pytest.mark.campaign),
    ],
)
def test_statics_are_those_of_rucker_and_webster(tensions):
    found, expected = rest(tensions), exact(tensions)
    np.testing.assert_allclose(found.tip_position[0], expected[:3], atol=1e-6 * L)
    R = Rotation.from_quat(found.quaternion[0, -1], scalar_first=True).as_matrix()
    np.testing.assert_allclose(R, expected[3:12].reshape(3, 3), atol=1e-6)
    np.testing.assert_allclose(np.asarray(found.z)[0, -1, :6], expected[12:], atol=1e-6)
    assert np.linalg.norm(expected[:3] - [0.0, 0.0, L]) > 0.02


@pytest.mark.campaign
def test_order_four_with_tendons_that_end_at_and_between_nodes():
    tensions = (4.0, 6.0, 3.0, 5.0)
    expected = exact(tensions)[:3]
    errors = [np.linalg.norm(rest(tensions, nodes).tip_position[0] - expected) for nodes in (11, 21, 41)]
    assert np.all(np.log2(np.divide(errors[:-1], errors[1:])) > 3.5), errors


# reels

REELED = kc.robots.RoutedTendonRobot.like(DELRIN, drive="reel", tendon_compliance=0.0, bending_damping=0.03)
PULLED = kc.robots.RoutedTendonRobot.like(DELRIN, bending_damping=0.03)


def field(found, name, row=-1):
    return np.asarray(found.part(name))[row]


@pytest.mark.slow
def test_a_taut_reel_is_the_tension_that_it_has():
    taken_in = np.array([0.004, 0.001, -0.002, 0.0005])
    for compliance in (0.0, 2e-4):
        reeled = kc.equilibrium(REELED.replace(tendon_compliance=compliance), taken_in)
        T = field(reeled, "tension")[0]
        pulled = kc.equilibrium(PULLED, T)
        np.testing.assert_allclose(field(pulled, "p"), field(reeled, "p"), atol=1e-7 * L)
        np.testing.assert_allclose(field(pulled, "u"), field(reeled, "u"), atol=1e-6)
        # what is taut is as long as its reel leaves it; what is not has no tension
        missing = L - taken_in + compliance * T - field(reeled, "path")[-1]
        taut = T > 1.0
        assert taut[[0, 2]].all() and taut.all() == (compliance > 0.0)
        np.testing.assert_allclose(missing[taut], 0.0, atol=1e-6 * L)
        assert np.all(missing > -1e-6 * L) and np.all(T >= -1e-6)
        np.testing.assert_allclose(T[~taut], 0.0, atol=1e-3)
        assert np.all(missing[~taut] > 1e-8)


@pytest.mark.slow
def test_a_slack_tendon_does_nothing_until_it_is_pulled_in_again():
    give = np.linspace(0.0, -0.02, 30)
    pull = np.concatenate([give, give[::-1], np.linspace(0.0, 0.004, 30)])
    control = np.outer(pull, [1.0, 0.0, 0.0, 0.0]) - 0.03 * np.array([0.0, 1.0, 1.0, 1.0])
    found = kc.simulate(REELED.replace(gravity=[0.0, 0.0, 0.0]), control, 0.05)
    T = np.asarray(found.part("tension"))[:, 0]
    assert np.all(T >= -1e-6) and np.all(T[:, 1:] < 1e-3)
    assert np.all(T[2:59, 0] < 1e-3)
    np.testing.assert_allclose(found.tip_position[2:59], np.tile([0.0, 0.0, L], (57, 1)), atol=1e-5)
    # then taut: more tension the further it is pulled, and the rod follows
    assert np.all(np.diff(T[64:, 0]) > 0.0) and T[-1, 0] > 1.0
    assert np.linalg.norm(found.tip_position[-1] - [0, 0, L]) > 0.05


@pytest.mark.slow
def test_a_tendon_that_gives_takes_more_pulling():
    taken_in = np.array([0.003, -0.05, -0.05, -0.05])
    T = [
        field(kc.equilibrium(REELED.replace(tendon_compliance=C), taken_in), "tension")[0, 0]
        for C in (0.0, 1e-4, 1e-3)
    ]
    assert T[0] > T[1] > T[2] > 0.0
    # small and straight: springs in series, of rod and tendon
    give = 0.003 / T[0]
    np.testing.assert_allclose(T[1:], [0.003 / (give + C) for C in (1e-4, 1e-3)], rtol=0.05)


@pytest.mark.campaign
def test_derivatives_through_a_reel():
    control = 0.002 * (1.0 + np.sin(np.arange(20)[:, None] / 4.0 + np.arange(4) * np.pi / 2))

    def tip(modulus, scale):
        robot = REELED.replace(youngs_modulus=modulus, tendon_compliance=1e-4)
        return kc.simulate(robot, scale * control, 0.05).position[-1, -1, 0]

    at, along = (2.7e9, 0.9), (0.6e9, 0.3)
    slope = float(jax.jvp(tip, at, along)[1])
    gradient = jax.grad(tip, argnums=(0, 1))(*at)
    h = 1e-3
    steps = [float(tip(*(a + k * h * d for a, d in zip(at, along, strict=True)))) for k in (-2, -1, 1, 2)]
    expected = (steps[0] - 8 * steps[1] + 8 * steps[2] - steps[3]) / (12 * h)
    assert slope == pytest.approx(expected, rel=1e-5)
    assert gradient[0] * along[0] + gradient[1] * along[1] == pytest.approx(expected, rel=1e-5)


@pytest.mark.campaign
def test_a_batch_of_reeled_robots_is_each_by_itself():
    control = 0.002 * (1.0 + np.sin(np.arange(20)[:, None] / 4.0 + np.arange(4) * np.pi / 2))
    robots = [REELED.replace(tendon_compliance=C) for C in (1e-4, 1e-3)]
    together = kc.simulate(robots, control, 0.05)
    for k, robot in enumerate(robots):
        np.testing.assert_allclose(together.y[k], kc.simulate(robot, control, 0.05).y, atol=1e-8)


# friction, and symmetry, of helical tendons


def helices(turn=0.0):
    routing = tuple(Helical(0.02, turn + k * np.pi / 2, 0.5) for k in range(4))
    return kc.robots.RoutedTendonRobot.like(
        DELRIN,
        routing=routing,
        friction=TendonFriction(wobble=0.6, curvature=0.3, reach=0.02),
        gravity=[0.0, 0.0, 0.0],
    )


@pytest.mark.campaign
def test_a_slow_pull_loses_tension_as_on_a_capstan():
    robot = helices()
    control = np.outer(np.linspace(0.0, 5.0, 100), [1.0, 0.0, 0.0, 0.0])
    found = kc.simulate(robot, control, 0.2, time="bdf1")
    loss, u = field(found, "loss")[:, 0], field(found, "u")
    assert np.all(field(found, "f")[:, 0] == 1.0)
    k, μ, ds = 0.6, 0.3, L / (robot.nodes - 1)
    bent = np.sqrt(u[:, 0] ** 2 + u[:, 1] ** 2 + 1e-4) - 1e-2
    # the scheme's sums are the trapezium rule's
    np.testing.assert_allclose(np.diff(loss), ds * (k + μ * (bent[:-1] + bent[1:]) / 2), rtol=1e-9)
    assert loss[-1] > 0.4
    at_tip = [float(robot.tension_at(L * 0.999, found.y[-1, -1], control[-1])[0]), 5.0 * np.exp(-loss[-1])]
    assert at_tip[0] == pytest.approx(at_tip[1], rel=1e-12)


@pytest.mark.campaign
def test_turned_tendons_turn_the_robot():
    control = kc.controls.parse("random:3", 60, 0.05)
    one, other = (kc.simulate(helices(turn), control, 0.05) for turn in (0.0, np.pi / 2))
    turned = Rotation.from_euler("z", 90, degrees=True).apply(one.position.reshape(-1, 3))
    np.testing.assert_allclose(other.position.reshape(-1, 3), turned, atol=1e-7)
    assert np.abs(one.position[..., :2]).max() > 0.01


@pytest.mark.campaign
def test_what_the_tendons_do_is_what_is_stored():
    """No friction, no damping, no gravity: dE/dT = -(way of the tendon) between equilibria (Castigliano)."""
    robot = ROBOT.replace(gravity=[0.0, 0.0, 0.0], nodes=41)

    def of(T):
        found = kc.equilibrium(robot, T, space="lobatto4")
        v, u = field(found, "v") - [0.0, 0.0, 1.0], field(found, "u")
        elastic = 0.5 * (np.einsum("ni,ij,nj->n", v, ROD.Kse, v) + np.einsum("ni,ij,nj->n", u, ROD.Kbt, u))
        r, r_s = (np.array(x) for x in zip(*(robot.routes_at(s) for s in np.linspace(0, L, 41)), strict=True))
        way = np.linalg.norm(v[:, None] + [0, 0, 1] + np.cross(u[:, None], r) + r_s, axis=-1)[:, 1]
        simpson = np.r_[1, [4, 2] * 19, 4, 1] * L / 120
        return simpson @ elastic, simpson @ way

    T, dT = np.array([0.0, 6.0, 0.0, 0.0]), np.array([0.0, 1e-2, 0.0, 0.0])
    (high, way_high), (low, way_low) = of(T + dT), of(T - dT)
    # the work that goes in is T times what is taken in: dE = -T dℓ
    assert high - low == pytest.approx(-6.0 * (way_high - way_low), rel=1e-5)
