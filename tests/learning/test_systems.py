"""Every kind of robot is learned from one short trajectory: a modulus 30 % off, and an unseen control."""

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.learning.structured.fit import _rates
from knode_cosserat.rods.ends import Driven
from knode_cosserat.rods.loads import AttachedMass, PointWrench
from knode_cosserat.rods.routing import Helical
from knode_cosserat.rods.surroundings import Plane
from knode_cosserat.solvers.segments import pieces, samples, start_point

STEPS, DT = 60, 0.05
DELRIN = kc.load_robot("delrin-tendon-robot")
FOUR = np.arange(4) * np.pi / 2


def pushed(period, size, phases):
    """Sines that begin at zero, each with a phase of its own."""
    t = np.arange(1, STEPS + 1)[:, None] * DT
    return np.asarray(size) * (np.sin(2 * np.pi * t / period + phases) - np.sin(phases))


def driven_in_contact():
    robot = kc.robots.SlenderRod(
        length=0.4,
        radius=0.005,
        density=1100.0,
        youngs_modulus=2e6,
        nodes=41,
        bending_damping=2e-4,
        drag=0.01,
        base_end=Driven(axes=("x", "ry")),
        gravity=[0.0, 0.0, 9.81],
        surroundings=(
            Plane(point=[-0.03, 0.0, 0.0], normal=[1.0, 0.0, 0.0], stiffness=300.0, smoothing=2e-3),
        ),
    )
    return robot, *(pushed(T, [0.03, 0.2], np.array([0.0, 1.0])) for T in (1.5, 2.2))


def variable_curvature():
    robot = kc.load_robot("variable-curvature-robot")
    return robot, *(pushed(T, 0.4, np.arange(3.0)) for T in (1.5, 2.2))


def magnetic():
    robot = kc.load_robot("magnetic-catheter")
    return robot, *(pushed(T, 2e-3, np.arange(3.0)) for T in (1.5, 2.2))


def in_water():
    robot = kc.robots.SlenderRod(
        length=0.3,
        radius=0.005,
        density=1100.0,
        youngs_modulus=2e6,
        nodes=11,
        bending_damping=2e-4,
        base_end=Driven(axes=("x", "ry")),
        loads=(kc.robots.fluids.Fluid(),),
    )
    return robot, *(pushed(T, [0.03, 0.4], np.array([0.0, 1.0])) for T in (1.5, 2.2))


def helical_tendons():
    routing = tuple(Helical(0.02, angle, 0.25) for angle in FOUR)
    robot = kc.robots.RoutedTendonRobot.like(DELRIN, routing=routing)
    return robot, kc.controls.sine(1.5, STEPS, DT), kc.controls.random(STEPS, seed=3, hold=10)


def reels():
    robot = kc.robots.RoutedTendonRobot.like(DELRIN, drive="reel", tendon_compliance=5e-4)
    return robot, *(0.004 + pushed(T, 0.002, FOUR) for T in (1.5, 2.2))


def with_ribs():
    robot = kc.load_robot("delrin-routed-tendon-robot")
    return robot, kc.controls.sine(1.5, STEPS, DT), kc.controls.random(STEPS, seed=3, hold=10)


SYSTEMS = {
    each.__name__: each
    for each in (driven_in_contact, variable_curvature, magnetic, in_water, helical_tendons, reels, with_ribs)
}


def error(found, truth):
    """Root mean square distance of all nodes."""
    return float(np.sqrt(np.mean(np.sum((found.position - truth.position) ** 2, axis=-1))))


@pytest.mark.campaign
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_wrong_modulus_is_made_up_for(name):
    robot, seen, unseen = SYSTEMS[name]()
    knowledge = robot.replace(youngs_modulus=0.7 * robot.youngs_modulus)
    model = kc.fit(knowledge, [kc.simulate(robot, seen, DT)])
    truth = kc.simulate(robot, unseen, DT)
    before, after = (error(kc.simulate(each, unseen, DT), truth) for each in (knowledge, model))
    print(f"\n{name}: from {before:.3g} m to {after:.3g} m, {before / after:.0f}-fold")
    assert before > 1e-4 and after < 0.1 * before


# samples where something acts

LADEN = kc.robots.SlenderRod(
    length=0.5,
    radius=0.005,
    density=1000.0,
    youngs_modulus=1e8,
    bending_damping=1e-2,
    nodes=11,
    loads=(PointWrench(at=0.4, force=[0.3, 0.0, 0.0], controlled=True), AttachedMass(at=0.4, mass=0.05)),
)


@pytest.mark.campaign
def test_forward_euler_moves_a_rod_with_loads_at_a_node():
    control = pushed(1.0, 1.0, np.zeros(1))[:4]
    moved, fine = (kc.simulate(LADEN, control, DT, space=space) for space in ("euler", "lobatto2"))
    off = np.linalg.norm(moved.tip_position - fine.tip_position, axis=1)
    np.testing.assert_allclose(moved.position_error, off, atol=0.1 * np.max(off))


@pytest.fixture(scope="module", params=["lobatto2", pytest.param("lobatto4", marks=pytest.mark.campaign)])
def laden(request):
    control = pushed(1.0, 1.0, np.zeros(1))[:30]
    return kc.simulate(LADEN, control, DT, time="bdf2", start="paper", space=request.param)


@pytest.mark.slow
def test_samples_begin_beyond_what_acts_at_their_node(laden):
    data = samples(LADEN, [laden])
    y = np.asarray(data.segments.y).reshape(-1, 10, 19)
    near, far, layout = np.asarray(laden.y)[1:, :-1], y, LADEN.y_layout
    rest = np.arange(10) != 4
    np.testing.assert_array_equal(far[:, rest], near[:, rest])
    jump = (far - near)[:, 4]
    np.testing.assert_array_equal(jump[:, : layout.slice("n").start], 0.0)
    # the force, and the mass times gravity less its acceleration, by BDF2 of the trajectory itself
    h, q = (np.asarray(laden.part(name))[:, 4] for name in "hq")
    from scipy.spatial.transform import Rotation

    velocity = Rotation.from_quat(h, scalar_first=True).apply(q)
    acceleration = (1.5 * velocity[2:] - 2.0 * velocity[1:-1] + 0.5 * velocity[:-2]) / DT
    expected = np.asarray(laden.control)[2:] * [0.3, 0.0, 0.0] + 0.05 * ([0.0, 0.0, -9.81] - acceleration)
    # R q differentiated is not R (q_t + ω × q) exactly, step by step
    np.testing.assert_allclose(-jump[1:, layout.slice("n")], expected, atol=0.02)


@pytest.mark.slow
def test_slopes_do_not_go_over_what_acts(laden):
    data = samples(LADEN, [laden])
    n = LADEN.y_layout.slice("n")
    slope = np.asarray(data.segments.slope).reshape(-1, 10, 19)[..., n] / 0.5
    # without the jump's own: what the rod weighs and takes, smooth on both sides
    jump = np.abs(np.asarray(data.segments.y).reshape(-1, 10, 19)[:, 4] - np.asarray(laden.y)[1:, 4])[
        :, n
    ].max()
    assert jump > 0.3
    assert np.abs(slope).max() < 0.2 * jump / 0.05
    # and they are those of the equations
    starts = jax.vmap(lambda sample: start_point(LADEN, sample))(data.segments)
    rates = np.asarray(_rates(LADEN, starts, data.segments.z)).reshape(-1, 10, 19)
    found = np.asarray(data.segments.slope).reshape(-1, 10, 19) / 0.5
    # the force's and the moment's, and where it is; what hardly changes is not known as well
    for name in "pnm":
        spot = LADEN.y_layout.slice(name)
        size = np.abs(rates[..., spot]).max()
        worst = np.abs(found - rates)[..., spot].max() / size
        assert worst < (1e-6 if laden.settings.space.order == 1 else 2e-3), name


@pytest.mark.parametrize(
    ("cuts", "nodes", "expected"),
    [
        ((), 5, [(0, 4)]),
        ((0.5,), 5, [(0, 2), (2, 4)]),
        ((0.4,), 5, [(0, 1), (2, 4)]),
        ((0.1, 0.5, 0.9), 5, [(0, 0), (1, 2), (2, 3), (4, 4)]),
        ((1 / 3, 0.4, 0.42, 2 / 3), 4, [(0, 1), (1, 1), (2, 3)]),
    ],
)
def test_pieces_between_cuts(cuts, nodes, expected):
    assert pieces(cuts, nodes) == expected
