"""What holds a rod: free motion, pendulums, driven ends, and beams held at both of them."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import ellipk

import knode_cosserat as kc
from knode_cosserat import Result
from knode_cosserat.robots import ends, surroundings
from knode_cosserat.solvers import BDF2, Settings
from knode_cosserat.solvers.recovery import likely_cause

G = 9.81


def quaternion(*rotation_vector):
    return Rotation.from_rotvec(rotation_vector).as_quat(scalar_first=True)


def rotations(h):
    return Rotation.from_quat(np.asarray(h).reshape(-1, 4), scalar_first=True)


# a rod that nothing holds, and a plane beneath that is there where its stiffness is not zero

L, RADIUS, DENSITY = 0.5, 0.005, 1000.0
LEVEL = quaternion(0.0, np.pi / 2, 0.0)
LOOSE = kc.robots.SlenderRod(
    length=L,
    radius=RADIUS,
    density=DENSITY,
    youngs_modulus=1e7,
    bending_damping=1e-3,
    nodes=11,
    base_end=ends.Free(position=[0.0, 0.0, 0.0], orientation=LEVEL),
    linear_drag=0.0,
    surroundings=(surroundings.Plane(stiffness=0.0, point=[0.0, 0.0, -0.2]),),
)
MASS = float(LOOSE.mass_per_length) * L
SIMPSON = np.array([1, 4, 2, 4, 2, 4, 2, 4, 2, 4, 1]) / 30.0


def loose(steps, dt, initial="unstressed", time="sdirk2", **changes):
    robot = LOOSE.replace(**{key.replace("__", "."): value for key, value in changes.items()})
    return kc.simulate(
        robot, np.zeros((steps, 0)), dt, time=time, initial=initial, start="consistent", space="lobatto4"
    )


def in_motion(q=(0.0, 0.0, 0.0), w=(0.0, 0.0, 0.0), **changes):
    """The straight rod about its middle, moving as a rigid body: q there and w, material frame."""
    first = loose(1, 1e-3, gravity=[0.0, 0.0, 0.0], **changes)[:1]
    along = np.zeros((11, 3))
    along[:, 2] = (np.linspace(0.0, 1.0, 11) - 0.5) * L
    y, layout = np.array(first.y), first.system.y_layout
    y[0, :, layout.slice("q")] = np.asarray(q) + np.cross(w, along)
    y[0, :, layout.slice("w")] = w
    return dataclasses.replace(first, y=y)


def momenta(found):
    """Momentum, and angular momentum about the origin, of every row."""
    q, w, p = (np.asarray(found.part(name)) for name in "qwp")
    turn, shape = rotations(found.part("h")), q.shape
    rhoA, rhoJ = float(LOOSE.mass_per_length), np.asarray(LOOSE.section.rhoJ)
    moving = rhoA * turn.apply(q.reshape(-1, 3)).reshape(shape)
    spinning = turn.apply((w @ rhoJ).reshape(-1, 3)).reshape(shape)
    return (np.einsum("n,tnk->tk", SIMPSON * L, each) for each in (moving, np.cross(p, moving) + spinning))


@pytest.mark.campaign
@pytest.mark.parametrize("time", ["bdf2", "sdirk2"])
def test_a_free_rod_falls(time):
    lag = []
    for steps in (50, 100):
        t = np.arange(steps + 1) / steps
        found = loose(steps, 1 / steps, time=time)
        P, H = momenta(found)
        np.testing.assert_allclose(P, MASS * np.outer(t, [0.0, 0.0, -G]), atol=1e-7 * MASS * G)
        middle = np.einsum("n,tnk->tk", SIMPSON, np.asarray(found.part("p")))
        np.testing.assert_allclose(H, MASS * np.cross(middle, [0, 0, -G]) * t[:, None], atol=1e-7 * MASS * G)
        lag.append(abs(middle[-1, 2] + G / 2))
        # all of it comes from BDF2's first step, which is of order 1; SDIRK2 is exact for parabolas
        assert lag[-1] < (1.01 * G / steps**2 if time == "bdf2" else 1e-12)
    assert time == "sdirk2" or 1.9 < np.log2(lag[0] / lag[1]) < 2.1


@pytest.mark.slow
def test_a_free_rod_that_spins_keeps_its_momenta():
    drift = []
    for steps in (60, 120):
        # tumbling, spinning about itself, and flying
        begin = in_motion(q=[0.1, 0.2, -0.3], w=[2.0, 0.0, 6.0])
        found = loose(steps, 0.6 / steps, begin, gravity=[0.0, 0.0, 0.0])
        P, H = momenta(found)
        drift.append([np.abs(each - each[0]).max() / np.abs(each[0]).max() for each in (P, H)])
        assert rotations(found.part("h")[-1, 5]).magnitude() > 1.0
    drift = np.array(drift)
    # 1e-7 is what is left of the solve
    assert np.all(drift[1] < 1e-2) and np.all(drift[1] < 0.35 * drift[0] + 1e-7), drift


@pytest.mark.slow
@pytest.mark.parametrize("law", ["linear", "square"])
def test_a_falling_rod_reaches_its_terminal_velocity(law):
    rhoA = float(LOOSE.mass_per_length)
    wanted = 0.7
    drag = {"linear_drag": rhoA * G / wanted} if law == "linear" else {"drag": rhoA * G / wanted**2}
    found = loose(100, 0.02, **drag)
    velocity = rotations(found.part("h")[-1]).apply(found.part("q")[-1])
    np.testing.assert_allclose(velocity, np.tile([0.0, 0.0, -wanted], (11, 1)), atol=1e-6)
    # on the way there: 1 - exp(-gt/v), and tanh(gt/v)
    t = np.asarray(found.time)
    expected = wanted * (1 - np.exp(-G * t / wanted) if law == "linear" else np.tanh(G * t / wanted))
    speed = np.linalg.norm(np.asarray(found.part("q"))[:, 5], axis=1)
    np.testing.assert_allclose(speed, expected, atol=0.05 * wanted)


@pytest.mark.slow
def test_a_rod_on_a_plane_is_carried_by_it():
    k, δ = 2e4, 1e-4
    plane = {
        "surroundings__0__stiffness": k,
        "surroundings__0__smoothing": δ,
        "surroundings__0__damping": 5.0,
        "surroundings__0__point": [0.0, 0.0, -RADIUS],
    }
    found = loose(128, 0.01, **plane)
    p = np.asarray(found.part("p"))[-1]
    pressed = k * δ * np.log1p(np.exp(-p[:, 2] / δ))
    weight = float(LOOSE.mass_per_length) * G
    assert np.sum(SIMPSON * L * pressed) == pytest.approx(weight * L, rel=1e-6)
    # f = k δ log(1 + exp(d/δ)) solved for the depth; far in it would be weight/k
    depth = δ * np.log(np.expm1(weight / (k * δ)))
    np.testing.assert_allclose(p[:, 2], -depth, atol=1e-8)
    assert abs(depth) < 3 * δ and weight / k == pytest.approx(3.85e-5, rel=1e-2)


def test_a_rod_that_slides_is_slowed_by_friction():
    k, δ, μ = 2e4, 1e-5, 0.3
    weight = float(LOOSE.mass_per_length) * G
    depth = δ * np.log(np.expm1(weight / (k * δ)))
    plane = {
        "surroundings__0__stiffness": k,
        "surroundings__0__smoothing": δ,
        "surroundings__0__friction": μ,
        "surroundings__0__point": [0.0, 0.0, -RADIUS + depth],
        "surroundings__0__damping": 5.0,
    }
    # along itself (material z is global x), so that friction at its surface does not roll it
    begin = in_motion(q=[0.0, 0.0, 1.0])
    found = loose(100, 0.005, begin, **plane)
    speed = np.asarray(found.part("q"))[:, 5, 2]
    t = np.asarray(found.time) - float(found.time[0])
    expected = 1.0 - μ * G * t
    moving = expected > 0.2
    np.testing.assert_allclose(speed[moving], expected[moving], atol=2e-3)
    # and then it rests: what is left creeps below the speed at which friction is full
    assert np.all(np.abs(speed[t > 0.36]) < 1e-3)


# held at the base, anywhere

HELD = kc.robots.SlenderRod(
    length=L,
    radius=RADIUS,
    density=DENSITY,
    youngs_modulus=1e7,
    bending_damping=1e-3,
    nodes=11,
    base_end=ends.Clamped(position=[0.0, 0.0, 0.0], orientation=[1.0, 0.0, 0.0, 0.0]),
)


@pytest.mark.slow
def test_where_the_base_is_moves_and_turns_everything():
    g = np.array([3.0, -4.0, -6.0])
    turn, shift = Rotation.from_rotvec([0.4, -1.1, 0.7]), np.array([0.3, -0.2, 0.5])
    here = kc.simulate(HELD.replace(gravity=g), np.zeros((30, 0)), 0.02, initial="unstressed")
    there = kc.simulate(
        HELD.replace(**{
            "gravity": turn.apply(g), "base_end.position": shift,
            # of any length
            "base_end.orientation": 2.0 * turn.as_quat(scalar_first=True),
        }),
        np.zeros((30, 0)), 0.02, initial="unstressed")  # fmt: skip
    for name in "pnm":
        moved = turn.apply(np.asarray(here.part(name)).reshape(-1, 3)) + (shift if name == "p" else 0.0)
        size = np.abs(moved).max()
        np.testing.assert_allclose(np.asarray(there.part(name)).reshape(-1, 3), moved, atol=1e-7 * size)
    for name in "qwvu":
        size = np.abs(np.asarray(here.part(name))).max()
        np.testing.assert_allclose(there.part(name), here.part(name), atol=1e-7 * size)


# a pendulum: a stiff rod from a ball joint, let go at an angle from hanging down


def quarter_period(amplitude, steps):
    bar = kc.robots.SlenderRod(
        length=L,
        radius=0.01,
        density=DENSITY,
        youngs_modulus=1e11,
        nodes=11,
        base_end=ends.Pinned(orientation=quaternion(0.0, np.pi - amplitude, 0.0)),
    )
    small = np.pi / 2 * np.sqrt(2 * L / (3 * G))
    t_end = 1.3 * small * ellipk(np.sin(amplitude / 2) ** 2) / (np.pi / 2)
    found = kc.simulate(bar, np.zeros((steps, 0)), t_end / steps, space="lobatto4", initial="unstressed")
    p, t = np.asarray(found.part("p"))[:, -1], np.asarray(found.time)
    np.testing.assert_allclose(np.asarray(found.part("p"))[:, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(p, axis=1), L, atol=1e-6)
    x = np.unwrap(np.arctan2(p[:, 0], -p[:, 2]))
    k = np.flatnonzero((x[:-1] > 0) & (x[1:] <= 0))[0]
    # the time at which it hangs down, by a cubic through four rows
    return np.polyval(np.polyfit(x[k - 1 : k + 3], t[k - 1 : k + 3], 3), 0.0) / small


@pytest.mark.campaign
@pytest.mark.parametrize("degrees", [10.0, 60.0, 150.0])
def test_a_pendulum_has_its_period(degrees):
    amplitude = np.deg2rad(degrees)
    # inertia of a rod about its end: m L²/3, and m r²/4 of its sections
    exact = ellipk(np.sin(amplitude / 2) ** 2) / (np.pi / 2) * np.sqrt(1.0 + 0.75 * (0.01 / L) ** 2)
    coarse, fine = (quarter_period(amplitude, steps) for steps in (64, 128))
    assert 1.9 < np.log2((coarse - exact) / (fine - exact)) < 2.1
    assert (4 * fine - coarse) / 3 == pytest.approx(exact, rel=1e-6)


# beams held at both ends, slender, without shear and free to stretch

BEAM_EI = 2.0
BEAM = {
    "length": 1.0,
    "radius": 0.01,
    "density": 100.0,
    "youngs_modulus": 1e9,
    "nodes": 11,
    "bending_stiffness": BEAM_EI,
    "shear_stiffness": [1e8, 1e8, 10.0],
}


@pytest.mark.slow
@pytest.mark.parametrize("tip", [ends.Clamped(), pytest.param(ends.Pinned(), marks=pytest.mark.campaign)])
def test_beams_held_at_both_ends(tip):
    w = 1e-3 * BEAM_EI
    beam = kc.robots.SlenderRod(**BEAM, tip_end=tip)
    # the load is sideways: nothing else weighs
    beam = beam.replace(gravity=[w / float(beam.mass_per_length), 0.0, 0.0])
    found = kc.equilibrium(beam, np.zeros(0), space="lobatto4")
    s, deflection = np.linspace(0, 1, 11), np.asarray(found.part("p"))[0, :, 0]
    if type(tip) is ends.Clamped:
        expected, most = w * s**2 * (1 - s) ** 2 / (24 * BEAM_EI), w / (384 * BEAM_EI)
    else:
        expected, most = w * s**2 * (3 - 5 * s + 2 * s**2) / (48 * BEAM_EI), w / (185 * BEAM_EI)
    np.testing.assert_allclose(deflection, expected, atol=2e-6 * most)
    assert deflection.max() == pytest.approx(most, rel=6e-3)
    np.testing.assert_allclose(found.tip_position[0], [0.0, 0.0, 1.0], atol=1e-9)


# a base that is driven

DRIVEN = kc.robots.SlenderRod(
    length=L,
    radius=RADIUS,
    density=DENSITY,
    youngs_modulus=1e7,
    bending_damping=2e-3,
    nodes=11,
    base_end=ends.Driven(axes=("x", "ry", "z"), position=[0.1, 0.2, 0.3]),
    tip_end=ends.Clamped(position=[0.12, 0.2, 0.75]),
)


@pytest.mark.campaign
@pytest.mark.parametrize("time", ["bdf2", "sdirk2"])
def test_a_driven_base_is_where_it_is_driven(time):
    t = np.arange(1, 101) * 0.05
    control = np.stack([0.03 * np.sin(t), 0.2 * np.sin(0.7 * t), 0.02 * np.cos(0.9 * t)], axis=1)
    found = kc.simulate(DRIVEN, control, 0.05, time=time)
    p, q, w = (np.asarray(found.part(name))[:, 0] for name in "pqw")
    shift = np.stack([control[:, 0], 0 * t, control[:, 2]], axis=1)
    np.testing.assert_allclose(p[1:], np.add([0.1, 0.2, 0.3], shift), atol=1e-12)
    turn = rotations(found.part("h")[1:, 0])
    np.testing.assert_allclose(turn.as_rotvec(), np.outer(control[:, 1], [0, 1, 0]), atol=1e-12)
    # it moves as it is driven: BDF2 to its order; SDIRK2 along the lines from row to row, as in their middle
    if time == "sdirk2":
        slope = np.diff(shift, axis=0) / 0.05
        np.testing.assert_allclose(turn.apply(q[1:])[1:], slope, atol=1e-12)
        np.testing.assert_allclose(w[2:, 1], np.diff(control[:, 1]) / 0.05, atol=1e-6)
    at = t if time == "bdf2" else t - 0.025
    rate = np.stack([0.03 * np.cos(at), 0 * at, -0.018 * np.sin(0.9 * at)], axis=1)
    np.testing.assert_allclose(turn.apply(q[1:])[3:], rate[3:], atol=2e-4)
    np.testing.assert_allclose(w[4:, 1], 0.14 * np.cos(0.7 * at[3:]), atol=2e-4)
    np.testing.assert_allclose(found.tip_position, np.tile([0.12, 0.2, 0.75], (101, 1)), atol=1e-8)


@pytest.mark.campaign
def test_a_slowly_driven_rod_is_in_equilibrium():
    ramp = np.linspace(0.0, 1.0, 60)
    way = np.concatenate([3 * ramp**2 - 2 * ramp**3, np.ones(60)])
    control = np.outer(way, [0.04, 0.3, 0.01])
    found = kc.simulate(DRIVEN, control, 0.2)
    still = kc.equilibrium(DRIVEN, control[-1], initial=found)
    for name, size in (("p", L), ("n", float(DRIVEN.Kbt[0, 0]) / L**2)):
        np.testing.assert_allclose(found.part(name)[-1], still.part(name)[0], atol=1e-5 * size)


@pytest.mark.parametrize("result", [Result.NO_CONVERGENCE, Result.NOT_FINITE])
def test_what_nothing_holds_is_said_to_have_no_equilibrium_under_its_weight(result):
    def cause(robot, time):
        # all that is tried before would take a minute
        return likely_cause(result, robot, Settings(time=time), np.zeros(robot.control_layout.size))

    falling = LOOSE.replace(surroundings=())
    assert "nothing holds the robot" in cause(falling, None)
    assert "nothing holds" not in cause(falling, BDF2())
    for end in ("base_end", "tip_end"):
        assert "nothing holds" not in cause(falling.replace(**{end: ends.Pinned()}), None)
    # it may lie on the plane
    assert "nothing holds" not in cause(LOOSE, None)
    assert "nothing holds" not in cause(kc.load_robot("six-legged-robot"), None)


# a universal joint


@pytest.mark.slow
def test_a_universal_joint_carries_a_moment_across_both_hinges_only():
    """At the tip of a bent and twisted rod; a constraint does no work, so the stiffness is symmetric."""
    beam = kc.robots.SlenderRod(
        length=L,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=1e7,
        nodes=11,
        gravity=[2.0, 1.0, 0.0],
        base_end=ends.Clamped(orientation=quaternion(0.0, 0.0, 0.6)),
        tip_end=ends.Universal(position=[0.05, 0.02, 0.44], orientation=[1.0, 0.0, 0.0, 0.0]),
    )
    found = kc.equilibrium(beam, np.zeros(0), space="lobatto4")
    d = rotations(found.part("h")[0, -1]).as_matrix()[0]
    m = np.asarray(found.part("m"))[0, -1]
    cross = np.cross([1.0, 0.0, 0.0], d[:, 1])
    assert abs(d[0, 1]) < 1e-9 and abs(d[2, 2]) < 0.95
    np.testing.assert_allclose(np.cross(m, cross), 0.0, atol=1e-9 * np.linalg.norm(m))
    assert np.linalg.norm(m) > 1e-3 * float(beam.Kbt[0, 0]) / L
    assert kc.statics.stability(found).asymmetry < 1e-6
