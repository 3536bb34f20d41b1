"""Rods in water: momentum and energy of the fluid, Lighthill's theory, frequencies, falling, streams."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import knode_cosserat as kc
from knode_cosserat.rods.ends import Driven, Free
from knode_cosserat.rods.fluids import Fluid, Tail
from knode_cosserat.rods.loads import Motion
from knode_cosserat.rods.parts import RodPoint
from knode_cosserat.rotation import quaternion_of, rotation_matrix

L, RADIUS, E, DENSITY, WATER = 1.0, 0.001, 1e9, 1500.0, 1000.0
EI, MASS, ADDED = E * np.pi * RADIUS**4 / 4, DENSITY * np.pi * RADIUS**2, WATER * np.pi * RADIUS**2
TIME = L**2 * np.sqrt(MASS / EI)
STREAM = (0.3, -0.2, 0.5)


def wet(nodes=11, fluid=None, gravity=(0.0, 0.0, 0.0), **changes):
    """A rod in water; without drag unless stated."""
    changes = {"length": L, "radius": RADIUS, "density": DENSITY, "youngs_modulus": E} | changes
    loads = (fluid or Fluid(drag=0.0, friction=0.0),)
    return kc.robots.SlenderRod(**{"loads": loads, "gravity": gravity} | changes, nodes=nodes)


# one point


def at(motion, radius=RADIUS, gravity=(0.0, 0.0, 0.0)):
    """A point of a rod with what a fluid sees of it."""
    rod, material = types.SimpleNamespace(gravity=gravity), types.SimpleNamespace(radius=radius)
    return RodPoint(rod, 0.0, 0.0, None, None, None, motion, material)


def moving(seed):
    rng = np.random.default_rng(seed)
    return Motion(
        rng.normal(size=3),
        np.asarray(rotation_matrix(quaternion_of(rng.normal(size=3)))),
        *rng.normal(size=(4, 3)),
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_power_of_the_fluid_is_the_rate_of_its_energy(seed):
    motion = moving(seed)
    _, R, q, w, q_t, _ = motion
    load = Fluid(drag=0.0, friction=0.0, stream=STREAM).load(at(motion))
    still = R.T @ np.array(STREAM)
    relative = R @ (q - still)
    power = load.force @ relative + load.moment @ (R @ w)
    q, q_t = q - still, q_t + np.cross(w, still)
    assert power == pytest.approx(-ADDED * (q[:2] @ q_t[:2]), rel=1e-12)
    # a tail leaves the energy of the fluid behind it, at the speed at which it moves on
    span = Tail(span=2 * RADIUS, stream=STREAM).wrench(motion, None)
    assert span.force @ relative == pytest.approx(0.5 * ADDED * q[2] * (q[:2] @ q[:2]), rel=1e-12)
    # drag takes energy only
    dragged = Fluid(added_mass=0.0, stream=STREAM).load(at(motion)).force
    assert dragged @ relative < 0.0 and np.abs(load.moment).max() > 0.0


def test_drag_across_and_along_a_cylinder():
    """Taylor (1952), rough cylinder: ρ a (C_D sin²i + C_f sin i) across, ρ a C_f cos i along, times U²."""
    U, i = 0.7, 0.4
    q = U * np.array([0.0, np.sin(i), np.cos(i)])
    motion = Motion(np.zeros(3), np.eye(3), q, *np.zeros((3, 3)))
    force = Fluid(drag=1.1, friction=0.02).load(at(motion)).force
    unit = WATER * RADIUS * U**2
    expected = [0.0, -(1.1 * np.sin(i) ** 2 + 0.02 * np.sin(i)), -0.02 * np.cos(i)]
    np.testing.assert_allclose(force, unit * np.array(expected), rtol=1e-9)
    slope = jax.jacfwd(lambda q: Fluid().load(at(motion._replace(q=q))).force)(jnp.zeros(3))
    assert np.all(np.isfinite(slope)) and np.abs(slope).max() < 1e-5


# Lighthill's theory

GAUSS, WEIGHT = (0.5 * each for each in np.polynomial.legendre.leggauss(24))
GAUSS = GAUSS + 0.5


def frame(s, t):
    """Orientation of a rod that bends, twists and turns in space."""
    x = s + 0.3 * t
    turn = jnp.stack([0.5 * jnp.sin(2.0 * x) + t * s, 0.4 * jnp.cos(3.0 * x + t), 0.3 * x * x])
    return rotation_matrix(quaternion_of(turn))


def place(s, t):
    """Position of the same rod, without stretch and shear."""
    tangents = jax.vmap(lambda part: frame(s * part, t)[:, 2])(jnp.asarray(GAUSS))
    return jnp.stack([jnp.sin(t), 0.2 * t, -0.5 * t * t]) + s * jnp.asarray(WEIGHT) @ tangents


def rate(function, t):
    return jax.jvp(function, (t,), (1.0,))[1]


def motion_of(s, t):
    def velocities(t):
        R, R_t = frame(s, t), rate(lambda t: frame(s, t), t)
        W = R.T @ R_t
        return R.T @ rate(lambda t: place(s, t), t), jnp.stack([W[2, 1], W[0, 2], W[1, 0]])

    (q, w), (q_t, w_t) = velocities(t), rate(velocities, t)
    return Motion(place(s, t), frame(s, t), q, w, q_t, w_t)


def test_it_bends_a_rod_as_the_theory_of_elongated_bodies_does():
    """The moment at each cut, by the force per length of Lighthill (1971) as it is written there."""
    fluid, tail, t = Fluid(drag=0.0, friction=0.0, stream=STREAM), Tail(span=2 * RADIUS, stream=STREAM), 0.7

    def momentum(s, t):
        motion = motion_of(s, t)
        v = motion.R @ motion.q - jnp.asarray(STREAM)
        d = motion.R[:, 2]
        across = v - (v @ d) * d
        return ADDED * across, (v @ d) * ADDED * across - 0.5 * ADDED * (across @ across) * d

    def lighthill(s):
        along = jax.jvp(lambda s: momentum(s, t)[1], (s,), (1.0,))[1]
        return along - rate(lambda t: momentum(s, t)[0], t)

    @jax.jit
    def moments(cut):
        def at_part(part):
            s = cut + (1.0 - cut) * part
            motion = motion_of(s, t)
            load, arm = fluid.load(at(motion)), motion.p - place(cut, t)
            return jnp.cross(arm, load.force) + load.moment, jnp.cross(arm, lighthill(s))

        parts = jax.vmap(at_part)(jnp.asarray(GAUSS))
        own, theirs = ((1.0 - cut) * jnp.asarray(WEIGHT) @ part for part in parts)
        end = motion_of(1.0, t)
        return own + jnp.cross(end.p - place(cut, t), tail.wrench(end, None).force), theirs

    for cut in (0.0, 0.3, 0.8):
        own, theirs = moments(cut)
        assert np.abs(theirs).max() > 1e-6
        np.testing.assert_allclose(own, theirs, atol=1e-9 * np.abs(theirs).max())


@pytest.mark.slow
def test_the_mean_thrust_of_a_swimmer_is_lighthills():
    """½ m (h_t² - U² h_s²) at the tail, of a rod whose base heaves in a stream from its nose."""
    U, omega, water = 0.4, 10.0 / TIME, {"stream": [0.0, 0.0, 0.4]}
    fluid, tail = Fluid(drag=0.0, friction=0.0, **water), Tail(span=2 * RADIUS, **water)
    rod = wet(fluid=fluid, base_end=Driven(axes=("x",)), bending_damping=0.2 * EI * TIME)
    rod, errors = rod.replace(loads=(fluid, tail)), []
    for steps in (40, 80):
        dt, phase = 2 * np.pi / omega / steps, 2 * np.pi / steps * np.arange(1, 8 * steps + 1)
        heave = 1e-3 * np.sin(phase) * (1.0 - np.exp(-phase / 5.0))
        found = kc.simulate(rod, heave[:, None], dt, space="lobatto4", time="bdf2")
        q, h, n = (np.asarray(found.part(name))[-steps:] for name in ("q", "h", "n"))
        h_t, h_s = q[:, -1, 0], 2.0 * h[:, -1, 2]
        thrust = 0.5 * ADDED * np.mean(h_t**2 - U**2 * h_s**2)
        assert thrust > 0.25 * ADDED * np.mean(h_t**2)
        errors.append(np.mean(n[:, 0, 2]) / -thrust - 1.0)
    assert abs(errors[1]) < 2e-3 and 4.0 * abs(errors[1]) < abs(errors[0]), errors


# frequencies, weight, streams


@pytest.mark.slow
def test_frequencies_fall_by_the_added_mass():
    dry, in_water = (
        kc.statics.modes(kc.equilibrium(robot, np.zeros(0)), count=4)
        for robot in (wet(fluid=Fluid(density=0.0)), wet())
    )
    np.testing.assert_allclose(in_water.frequency / dry.frequency, np.sqrt(MASS / (MASS + ADDED)), rtol=5e-6)
    assert np.abs(in_water.damping).max() < 1e-8


def test_buoyancy_carries_the_rod():
    down = (-9.81, 0.0, 0.0)
    afloat = kc.equilibrium(wet(density=WATER, gravity=down), np.zeros(0), space="lobatto4")
    assert np.abs(np.asarray(afloat.position)[..., :2]).max() < 1e-12
    left = tuple(g * (1.0 - WATER / DENSITY) for g in down)
    sunk, light = (
        kc.equilibrium(robot, np.zeros(0), space="lobatto4").position
        for robot in (wet(gravity=down), wet(fluid=Fluid(density=0.0), gravity=left))
    )
    assert np.abs(sunk[..., 0]).max() > 0.1 * L
    np.testing.assert_allclose(sunk, light, atol=1e-9 * L)


@pytest.mark.parametrize(
    ("direction", "coefficient"), [([-1.0, 0.0, 0.0], 1.1 + 0.03), ([0.0, 0.0, 1.0], 0.03)]
)
def test_a_free_rod_sinks_at_its_terminal_velocity(direction, coefficient):
    """m V_t = F (1 - V²/V∞²): V∞ tanh(t F/(m V∞)), with the added mass across the rod."""
    g, across = 9.81, direction[0] != 0.0
    rod = wet(nodes=6, fluid=Fluid(), base_end=Free(), gravity=np.multiply(g, direction), length=0.2)
    force = (MASS - ADDED) * g
    speed = np.sqrt(force / (WATER * RADIUS * coefficient))
    dt = 0.1 * (MASS + across * ADDED) * speed / force
    found = kc.simulate(rod, np.zeros((80, 0)), dt, initial="unstressed")
    q = np.asarray(found.part("q")) @ direction
    assert found.all_valid
    np.testing.assert_allclose(q[-1], speed, rtol=1e-5)
    np.testing.assert_allclose(q[10:31, 0], speed * np.tanh(0.1 * np.arange(10, 31)), rtol=5e-3)


def test_a_stream_bends_a_rod_by_its_drag():
    U = 0.02
    stiff = wet(fluid=Fluid(stream=[U, 0.0, 0.0]), youngs_modulus=1e10)
    found = kc.equilibrium(stiff, np.zeros(0), space="lobatto4")
    f = WATER * RADIUS * (1.1 + 0.03) * U**2
    assert found.part("n")[0, 0, 0] == pytest.approx(f * L, rel=3e-4)
    assert found.tip_position[0, 0] == pytest.approx(f * L**4 / (8 * 10 * EI), rel=1e-3)
    # relative to the stream, a rod that moves with it is at rest
    afloat = Motion(np.zeros(3), np.eye(3), np.array([U, 0.0, 0.0]), *np.zeros((3, 3)))
    load = stiff.loads[0].load(at(afloat))
    assert np.abs(load.force).max() == 0.0 and np.abs(load.moment).max() == 0.0


@pytest.mark.slow
def test_a_stream_along_a_rounded_rod_buckles_it():
    """EI y'''' + m U² y'' = 0 with EI y''' + m U² y' = 0 at the tip: U L √(m/EI) = π/2 (Païdoussis 1966)."""
    critical = np.pi / 2 * np.sqrt(EI / ADDED) / L

    def least(part):
        fluid = Fluid(drag=0.0, friction=0.0, stream=[0.0, 0.0, part * critical])
        rest = kc.equilibrium(wet(6, fluid), np.zeros(0), space="lobatto4", with_stability=False)
        return kc.statics.stability(rest).least

    assert brentq(least, 0.99, 1.01, xtol=1e-5) == pytest.approx(1.0, abs=1e-4)


# as every part: motion, batches, gradients, files


@pytest.fixture(scope="module")
def arm():
    """A soft arm in water that falls from its horizontal rest."""
    return wet(
        nodes=10, fluid=Fluid(), length=0.3, radius=0.005, youngs_modulus=2e6, gravity=(-9.81, 0.0, 0.0)
    )


STEPS, DT = 20, 0.02


def tip(robot):
    return kc.simulate(robot, np.zeros((STEPS, 0)), DT, initial="unstressed").tip_position[-1, 0]


def test_it_is_differentiable_and_runs_in_batches(arm):
    def fall(density, drag):
        return tip(arm.replace(**{"loads.0.density": density, "loads.0.drag": drag}))

    slopes = jax.grad(fall, argnums=(0, 1))(900.0, 1.1)
    for k, h in enumerate((0.1, 1e-3)):
        sides = [fall(900.0 + sign * h * (k == 0), 1.1 + sign * h * (k == 1)) for sign in (1, -1)]
        assert float(slopes[k]) == pytest.approx(float(sides[0] - sides[1]) / (2 * h), rel=1e-4)
    # denser water and more drag keep it up
    assert slopes[0] > 0.0 and slopes[1] > 0.0
    robots = [arm.replace(**{"loads.0.drag": drag}) for drag in (0.0, 2.0)]
    both = kc.simulate(robots, np.zeros((2, STEPS, 0)), DT, initial="unstressed")
    for k, robot in enumerate(robots):
        assert both.tip_position[k, -1, 0] == pytest.approx(float(tip(robot)), abs=1e-10)


@pytest.mark.slow
def test_its_numbers_are_identified(arm):
    truth = kc.simulate(arm, np.zeros((STEPS, 0)), DT, initial="unstressed")
    names = ["loads.0.drag", "loads.0.added_mass"]
    guess = arm.replace(**{names[0]: 0.8, names[1]: 1.3})
    found = kc.identify(guess, [truth], parameters=names)
    for name, exact in zip(names, (1.1, 1.0), strict=True):
        assert found[name].value == pytest.approx(exact, rel=1e-4)
