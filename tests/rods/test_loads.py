"""Loads: closed forms of beams, exact statics, orders of convergence, and a rigid body's own equations."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.rods.loads import AttachedMass, DistributedWrench, Motion, PointWrench, point_wrench

L, RADIUS, E = 0.5, 0.005, 1e8
EI, GA = E * np.pi * RADIUS**4 / 4, E / 2.6 * np.pi * RADIUS**2
#: loads 0 to 6: with all at zero but some, one compiled program serves every test of statics here
LOADED = kc.robots.SlenderRod(
    length=L, radius=RADIUS, density=1000.0, youngs_modulus=E, gravity=[0.0, 0.0, 0.0], nodes=11,
    loads=(
        PointWrench(at=0.35), PointWrench(at=0.6), DistributedWrench(begin=0.25, end=0.73),
        AttachedMass(at=0.6), AttachedMass(at=1.0, offset=[0.0, 0.0, 0.0]), PointWrench(at=1.0),
        PointWrench(at=1.0, follows=True),
    ),
)  # fmt: skip
OFF_NODE, ON_NODE, SPREAD, RIB, TIP_BODY, TIP, FOLLOWER = (f"loads.{k}" for k in range(7))


def rest(nodes=11, gravity=(0.0, 0.0, 0.0), **changes):
    """The equilibrium under loads given as `load__name`."""
    named = {f"{globals()[key.split('__')[0]]}.{key.split('__')[1]}": value for key, value in changes.items()}
    robot = LOADED.replace(nodes=nodes, gravity=gravity, **named)
    return kc.equilibrium(robot, np.zeros(0), space="lobatto4")


def field(found, name):
    return np.asarray(found.part(name))[0]


@pytest.mark.campaign
@pytest.mark.parametrize(("load", "at"), [("OFF_NODE", 0.35), ("ON_NODE", 0.6), ("TIP", 1.0)])
def test_a_small_force_at_a_place_bends_as_a_beam(load, at):
    F, a, s = 1e-3 * EI / L**2, at * L, np.linspace(0.0, L, 11)
    found = field(rest(**{f"{load}__force": [F, 0.0, 0.0]}), "p")[:, 0]
    before = F * s**2 * (3 * a - s) / (6 * EI) + F * s / GA
    behind = F * a**2 * (3 * s - a) / (6 * EI) + F * a / GA
    # what a beam leaves out is of the order of (F L²/EI)² = 1e-6
    np.testing.assert_allclose(found, np.where(s <= a, before, behind), rtol=2e-6, atol=1e-13)


@pytest.mark.campaign
def test_a_moment_at_a_place_bends_to_a_circle_up_to_it():
    M = 0.8 * EI / L
    found = rest(ON_NODE__moment=[0.0, M, 0.0])
    # z at a cut is that on its far side
    np.testing.assert_allclose(field(found, "u")[:6, 1], M / EI, rtol=1e-9)
    np.testing.assert_allclose(field(found, "u")[6:], 0.0, atol=1e-9)
    radius, angle = EI / M, 0.6 * L * M / EI
    at_load = radius * np.array([1 - np.cos(angle), 0.0, np.sin(angle)])
    beyond = 0.4 * L * np.array([np.sin(angle), 0.0, np.cos(angle)])
    np.testing.assert_allclose(found.tip_position[0], at_load + beyond, atol=2e-7 * L)


@pytest.mark.slow
def test_the_diagrams_of_force_and_moment_of_large_loads_are_exact():
    one, other = np.array([3.0, 1.0, -2.0]) * EI / L**2, np.array([-1.0, 2.0, 0.5]) * EI / L**2
    found = rest(OFF_NODE__force=one, ON_NODE__force=other)
    s, p, n, m = np.arange(11) / 10, *(field(found, name) for name in "pnm")
    # y at a node is that on its near side
    expected = np.where((s < 0.35)[:, None], one, 0.0) + np.where((s < 0.6 + 1e-9)[:, None], other, 0.0)
    np.testing.assert_allclose(n, expected, rtol=0, atol=1e-8 * np.abs(one).max())
    size = np.abs(m).max()
    arms = np.cross(p[6] - p[4:7], other)
    np.testing.assert_allclose(m[4:7], arms, atol=1e-9 * size)
    np.testing.assert_allclose(m[:4] - m[3], np.cross(p[3] - p[:4], one + other), atol=1e-9 * size)
    np.testing.assert_allclose(m[7:], 0.0, atol=1e-8 * size)


def dead_load_shape(F, a):
    """The tip of the same rod with a dead force at s = a: an independent integration by SciPy."""
    Kse, Kbt = np.diag(LOADED.Kse), np.diag(LOADED.Kbt)

    def rates(s, x, n):
        R, m = x[3:12].reshape(3, 3), x[12:]
        p_s = R @ (R.T @ n / Kse + [0.0, 0.0, 1.0])
        R_s = np.array([np.cross(row, R.T @ m / Kbt) for row in R])
        return np.concatenate([p_s, R_s.ravel(), -np.cross(p_s, n)])

    def integrated(m):
        x = np.concatenate([np.zeros(3), np.eye(3).ravel(), m])
        for span, n in (((0.0, a), F), ((a, L), np.zeros(3))):
            x = solve_ivp(rates, span, x, args=(n,), method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        return x

    found = root(lambda m: integrated(m * EI)[12:] / EI, np.zeros(3), tol=1e-13)
    assert found.success
    return integrated(found.x * EI)[:3]


@pytest.mark.campaign
def test_a_load_between_nodes_keeps_order_four():
    F = np.array([2.0, 1.0, -1.0]) * EI / (0.35 * L) ** 2
    exact = dead_load_shape(F, 0.35 * L)
    # 0.35 is in the middle of a segment, at a quarter of one, and between
    errors = [np.linalg.norm(rest(nodes, OFF_NODE__force=F).tip_position[0] - exact) for nodes in (6, 11, 16)]
    orders = np.log([errors[0] / errors[1], errors[1] / errors[2]]) / np.log([2.0, 1.5])
    assert np.all(orders > 3.4), (errors, orders)
    assert errors[-1] < 2e-5 * L


@pytest.mark.slow
def test_a_force_that_follows_is_the_dead_force_seen_from_the_tip():
    force = np.array([1.2, 0.0, -0.4]) * EI / L**2
    following = rest(FOLLOWER__force=force)
    R = Rotation.from_quat(field(following, "h")[-1], scalar_first=True)
    np.testing.assert_allclose(R.inv().apply(field(following, "n")[-1]), force, atol=1e-8 * force.max())
    # it turned far enough to be told from a dead one
    assert R.magnitude() > 0.4
    dead = rest(TIP__force=R.apply(force))
    for name, size in (("p", L), ("h", 1.0), ("n", EI / L**2), ("m", EI / L)):
        np.testing.assert_allclose(field(dead, name), field(following, name), atol=1e-8 * size)


@pytest.mark.slow
def test_a_load_on_a_part_of_the_rod_is_carried_by_the_base():
    f = np.array([4.0, -2.0, 1.0]) * EI / L**3
    n = field(rest(SPREAD__force=f), "n")
    s = np.arange(11) / 10
    left = np.clip(0.73 - np.maximum(s, 0.25), 0.0, None) * L
    np.testing.assert_allclose(n, f * left[:, None], atol=1e-9 * EI / L**2)


def test_a_small_load_on_a_part_of_the_rod_bends_as_a_beam():
    f, a, b = 1e-3 * EI / L**3, 0.25 * L, 0.73 * L
    tip = field(rest(SPREAD__force=[0.0, f, 0.0]), "p")[-1, 1]
    bending = f / (6 * EI) * (L * (b**3 - a**3) - (b**4 - a**4) / 4)
    assert tip == pytest.approx(bending + f * (b**2 - a**2) / (2 * GA), rel=2e-6)
    # and the moment per length: u = μ (b - s)/EI on its part, μ (b - a)/EI before
    turned = field(rest(SPREAD__moment=[-f * L, 0.0, 0.0]), "p")[-1, 1]
    slope = f * L / EI * ((b - a) * a * (L - a / 2) + (b - a) ** 2 / 2 * (L - a) - (b - a) ** 3 / 6)
    assert turned == pytest.approx(slope, rel=2e-6)


def test_a_mass_at_rest_is_its_weight():
    g = np.array([6.0, 1.0, -4.0])
    mass = 2.0 * EI / L**2 / 9.81
    heavy = rest(gravity=g, RIB__mass=mass)
    pulled = rest(gravity=g, ON_NODE__force=mass * g)
    for name, size in (("p", L), ("m", EI / L)):
        np.testing.assert_allclose(field(heavy, name), field(pulled, name), atol=1e-9 * size)
    offset = np.array([0.02, -0.01, 0.03])
    body = rest(gravity=g, TIP_BODY__mass=mass, TIP_BODY__offset=offset)
    R = Rotation.from_quat(field(body, "h")[-1], scalar_first=True)
    np.testing.assert_allclose(field(body, "n")[-1], mass * g, rtol=1e-7, atol=1e-8 * EI / L**2)
    expected = np.cross(R.apply(offset), mass * g)
    np.testing.assert_allclose(field(body, "m")[-1], expected, rtol=1e-7, atol=1e-8 * EI / L)


@pytest.mark.parametrize("offset", [None, [0.05, -0.02, 0.08]])
@pytest.mark.parametrize("inertia", [None, [2e-3, 3e-3, 1e-3]])
def test_the_wrench_of_a_moving_body_is_the_rate_of_its_momentum(offset, inertia):
    """Momentum and angular momentum of a body that tumbles along a path, differentiated numerically."""
    mass, g = 0.3, np.array([1.0, 2, -9])
    r, I = (np.zeros(3) if given is None else np.array(given) for given in (offset, inertia))

    def pose(t):
        p = np.array([np.sin(2 * t), t**2, np.cos(3 * t)])
        return p, Rotation.from_rotvec([np.sin(t), 0.5 * t, t**2]).as_matrix()

    def rate(function, t, h=1e-4):
        steps = [function(t + k * h) for k in (-2, -1, 1, 2)]
        return (steps[0] - 8 * steps[1] + 8 * steps[2] - steps[3]) / (12 * h)

    def spin(t):
        hat = rate(lambda t: pose(t)[1], t) @ pose(t)[1].T
        return np.array([hat[2, 1], hat[0, 2], hat[1, 0]])

    def velocities(t):
        R = pose(t)[1]
        return np.concatenate([R.T @ rate(lambda t: pose(t)[0], t), R.T @ spin(t)])

    def momentum(t):
        p, R = pose(t)
        moving = mass * rate(lambda t: pose(t)[0] + pose(t)[1] @ r, t)
        about_the_origin = np.cross(p + R @ r, moving) + R @ (I * (R.T @ spin(t)))
        return np.concatenate([moving, about_the_origin])

    t = 0.7
    p, R = pose(t)
    q, w, q_t, w_t = np.split(np.concatenate([velocities(t), rate(velocities, t)]), 4)
    body = AttachedMass(mass=mass, offset=offset, inertia=inertia)
    force, moment = body.body.wrench(Motion(p, R, q, w, q_t, w_t), g)
    weight = np.concatenate([mass * g, np.cross(p + R @ r, mass * g)])
    taken = weight - rate(momentum, t, 1e-3)
    np.testing.assert_allclose(force, taken[:3], atol=1e-6)
    np.testing.assert_allclose(moment + np.cross(p, force), taken[3:], atol=1e-6)


def test_loads_at_one_place_do_what_each_does():
    rng = np.random.default_rng(0)
    motion = Motion(rng.normal(size=3), Rotation.random(rng=rng).as_matrix(), *rng.normal(size=(4, 3)))
    gravity = np.array([1.0, 2.0, -9.0])
    loads = [
        AttachedMass(mass=rng.uniform(0.1, 1.0), offset=rng.normal(size=3), inertia=rng.uniform(size=3)),
        AttachedMass(mass=rng.uniform(0.1, 1.0), offset=rng.normal(size=3)),
        AttachedMass(mass=rng.uniform(0.1, 1.0)),
        AttachedMass(mass=rng.uniform(0.1, 1.0), inertia=rng.uniform(size=3)),
    ]
    loads.append(PointWrench(force=rng.normal(size=3), moment=rng.normal(size=3), follows=True))
    acting = [
        (load, weight, np.zeros(0)) for load, weight in zip(loads, [1.0, 0.0, 1.0, 0.5, 1.0], strict=True)
    ]
    force, moment = point_wrench(acting, motion, gravity)
    each = [(weight, point_wrench([(load, 1.0, none)], motion, gravity)) for load, weight, none in acting]
    np.testing.assert_allclose(force, sum(weight * own.force for weight, own in each), rtol=1e-12)
    np.testing.assert_allclose(moment, sum(weight * own.moment for weight, own in each), rtol=1e-12)


# in motion: a light rod with a heavy tip, pulled aside and let go

MASS = 0.05
SWINGING = dataclasses.replace(
    LOADED, density=1.0, loads=(PointWrench(controlled=True), AttachedMass(mass=MASS, at=1.0))
)
SWINGING = SWINGING.replace(**{"loads.0.force": [1e-3 * EI / L**2, 0.0, 0.0]})


def eigenvalue(dt, pull=1.0):
    """λ of xᵢ₊₁ = 2 Re(λ) xᵢ - |λ|² xᵢ₋₁, fitted to how the tip swings."""
    aside = kc.equilibrium(SWINGING, np.array([pull]), space="lobatto4")
    along = kc.simulate(
        SWINGING, np.zeros((60, 1)), dt, time="bdf2", space="lobatto4", initial=aside, start="consistent"
    ).tip_position[:, 0]
    twice, minus_square = np.linalg.lstsq(np.stack([along[11:-1], along[10:-2]], 1), along[12:], rcond=None)[
        0
    ]
    return np.roots([1.0, -twice, -minus_square])[0]


@pytest.mark.campaign
def test_a_heavy_tip_swings_at_the_frequency_of_a_light_rod():
    m = float(SWINGING.mass_per_length) * L
    # Rayleigh's part of the rod's mass, and shear
    omega = np.sqrt(1.0 / ((L**3 / (3 * EI) + L / GA) * (MASS + 33 / 140 * m)))
    assert omega == pytest.approx(np.sqrt(3 * EI / (MASS * L**3)), rel=2e-3)
    errors = []
    for steps in (20, 40):
        dt = 2 * np.pi / omega / steps
        λ = eigenvalue(dt)
        # what BDF2 makes of a frequency: (3 - 4/λ + 1/λ²)/(2 dt) = iω, exactly
        inverted = (3 - 4 / λ + 1 / λ**2) / (2 * dt)
        assert abs(inverted) == pytest.approx(omega, rel=1e-4)
        errors.append(abs(abs(np.angle(λ)) / dt - omega))
    assert 1.8 < np.log2(errors[0] / errors[1]) < 2.2


@pytest.mark.campaign
def test_derivatives_with_respect_to_a_load_and_its_control():
    control = np.sin(np.arange(20)[:, None] / 4.0)

    def tip(force, scale):
        robot = SWINGING.replace(**{"loads.0.force": force})
        return kc.simulate(robot, scale * control, 0.02).position[-1, -1, 0]

    at, along = (np.array([1.0, 0.5, 0.2]) * EI / L**2, 0.8), (np.array([0.4, -0.3, 0.6]) * EI / L**2, 0.5)
    value, slope = jax.jvp(tip, at, along)
    gradient = jax.grad(tip, argnums=(0, 1))(*at)
    h = 1e-3
    steps = [float(tip(*(a + k * h * d for a, d in zip(at, along, strict=True)))) for k in (-2, -1, 1, 2)]
    expected = (steps[0] - 8 * steps[1] + 8 * steps[2] - steps[3]) / (12 * h)
    assert float(value) == pytest.approx(float(tip(*at)), rel=1e-9)
    assert float(slope) == pytest.approx(expected, rel=1e-5)
    dotted = np.sum(np.asarray(gradient[0]) * along[0]) + float(gradient[1]) * along[1]
    assert dotted == pytest.approx(expected, rel=1e-5)


@pytest.mark.campaign
def test_a_batch_of_robots_with_different_loads_is_each_by_itself():
    control = np.sin(np.arange(20)[:, None] / 4.0)
    robots = [
        SWINGING.replace(**{"loads.1.mass": mass, "loads.0.force": [mass, 0, 0]}) for mass in (0.05, 0.1)
    ]
    together = kc.simulate(robots, control, 0.02)
    for k, robot in enumerate(robots):
        np.testing.assert_allclose(together.y[k], kc.simulate(robot, control, 0.02).y, atol=1e-9)


@pytest.mark.campaign
@pytest.mark.parametrize(
    "load",
    [PointWrench(force=[0.2, 0.0, 0.0]), pytest.param(AttachedMass(mass=0.01), marks=pytest.mark.campaign)],
)
def test_what_rounding_keeps_from_the_tip_is_at_the_tip(load):
    """Ten tenths are a digit less than one, and the load was not there at all."""
    beside = dataclasses.replace(load, at=sum([0.1] * 10))
    assert beside.at == 1.0 and dataclasses.replace(load, at=1.0 - 1e-8).at < 1.0
    beam = kc.robots.SlenderRod(length=0.5, radius=0.005, density=1e3, youngs_modulus=5e6, nodes=11)
    tips = [
        kc.equilibrium(beam.replace(loads=(each,)), np.zeros(0), space="lobatto4").tip_position[-1]
        for each in (beside, dataclasses.replace(load, at=1.0), dataclasses.replace(load, at=1.0 - 1e-8))
    ]
    unloaded = kc.equilibrium(beam, np.zeros(0), space="lobatto4").tip_position[-1]
    assert np.linalg.norm(tips[0] - unloaded) > 1e-6
    np.testing.assert_array_equal(tips[0], tips[1])
    np.testing.assert_allclose(tips[0], tips[2], atol=1e-8)
