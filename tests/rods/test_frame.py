"""Robots seen from a spinning frame: closed forms of spinning rods, the same motion from the ground."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.learning import NetworkOptions
from knode_cosserat.learning.residual import network
from knode_cosserat.robots import SpinningFrame, ends, loads, surroundings
from knode_cosserat.rods.parts import RodPoint
from knode_cosserat.rotation import quaternion_of, quaternion_product, rotation_matrix
from knode_cosserat.statics.stability import checked_equilibrium

NONE = np.zeros(0)


def rod(*frames, **changes):
    given = {"length": 0.5, "radius": 0.005, "density": 1000.0, "youngs_modulus": 1e7, "gravity": np.zeros(3)}
    return kc.robots.SlenderRod(**{**given, **changes}, effects=frames)


# kinematics


def motion_of(pose, t):
    """The motion of a moving pose at a time, by differentiating it."""

    def rates(t):
        return ends.velocities(*jax.jvp(pose, (t,), (1.0,)))

    (q, w), (q_t, w_t) = jax.jvp(rates, (t,), (1.0,))
    p, h = pose(t)
    return loads.Motion(p, rotation_matrix(h), q, w, q_t, w_t)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), t=st.floats(-2.0, 2.0))
def test_the_absolute_motion_is_that_of_the_turned_pose(seed, t):
    """In a frame, and in one that turns within another, as a gyroscope on a turntable."""
    rng = np.random.default_rng(seed)
    paths, turns = rng.normal(size=(2, 3, 3))
    frames = [SpinningFrame(rng.normal(), rng.normal(size=3), rng.normal(size=3)) for _ in range(2)]

    def seen(t):
        powers = jnp.stack([1.0, t, t * t])
        return ends.Pose(paths @ powers, quaternion_of(turns @ powers))

    def on_the_ground(t):
        p, h = seen(t)
        for frame in frames:
            turn = quaternion_of(t * frame.spin)
            p = frame.point + rotation_matrix(turn) @ (p - frame.point)
            h = quaternion_product(turn, h)
        return ends.Pose(p, h)

    robot = rod(*frames)
    point = RodPoint(robot, 0.0, t, None, None)
    found, expected = robot.absolute(point, motion_of(seen, t)).motion, motion_of(on_the_ground, t)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    # a vector of the ground, and back
    R = expected.R @ motion_of(seen, t).R.T
    np.testing.assert_allclose(R @ robot.seen(t, paths[0]), paths[0], atol=1e-12)


# equilibria


def test_a_blade_has_the_tension_of_its_closed_form():
    """EA p'' = -ρA Ω² p, of order 4 along the rod; to first order in strain n = ρA Ω² (L² - s²) / 2."""
    errors, rate = [], 60.0
    for nodes in (6, 11):
        found = kc.equilibrium(rod(SpinningFrame(rate, (1.0, 0.0, 0.0)), nodes=nodes), NONE, space="lobatto4")
        blade = found.system
        EA, a = float(blade.Kse[2, 2]), rate * np.sqrt(1000.0 / 1e7)
        s = np.linspace(0.0, 0.5, nodes)
        n = EA * (np.cos(a * s) / np.cos(a * 0.5) - 1.0)
        p = np.sin(a * s) / (a * np.cos(a * 0.5))
        np.testing.assert_allclose(found.part("p")[0, :, 2], p, atol=2e-8)
        errors.append(np.max(np.abs(found.part("n")[0, :, 2] - n)) / n[0])
        centrifugal = float(blade.mass_per_length) * rate**2 * 0.5**2 / 2.0
        assert n[0] == pytest.approx(centrifugal * (1.0 + 5.0 / 12.0 * (a * 0.5) ** 2), rel=2e-3)
    assert errors[1] < 3e-9 and errors[0] / errors[1] > 14.0


def test_gravity_across_the_axis_leaves_no_equilibrium():
    upright = rod(SpinningFrame(5.0), gravity=(0.0, 0.0, -9.81), length=0.2)
    checked_equilibrium(kc.equilibrium(upright, NONE), -1)
    found = kc.equilibrium(upright.replace(gravity=(3.0, 0.0, 0.0)), NONE)
    for task in (kc.statics.stability, kc.statics.modes):
        with pytest.raises(ValueError, match="no equilibrium at later times: loads turn") as caught:
            task(found)
        assert "\n" not in str(caught.value)


# small motions

E, RADIUS, DENSITY = 2e9, 0.025, 1e3
A, I = np.pi * RADIUS**2, np.pi * RADIUS**4 / 4.0


def whirl(k, rate, GA):
    """Angular frequencies (rad/s), forward positive, of a simply supported shaft: a rotating Timoshenko beam.

    With w = sin(ks) and the rotation cos(ks), times e^{iωt} in the global frame. For GA → ∞ it is
    Rayleigh's: (ρA + ρI k²) ω² - 2 ρI k² Ω ω = EI k⁴.
    """
    P = np.polynomial.Polynomial
    bent = P([E * I * k * k + GA, 2.0 * DENSITY * I * rate, -DENSITY * I])
    return np.sort((P([GA * k * k, 0.0, -DENSITY * A]) * bent - (GA * k) ** 2).roots().real)


def modes_of_a_shaft(rate, GA, nodes=21):
    shaft = rod(
        SpinningFrame(rate),
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=E,
        nodes=nodes,
        base_end=ends.Pinned(),
        tip_end=ends.Universal(),
        shear_stiffness=[GA, GA, E * A],
    )
    return kc.statics.modes(kc.equilibrium(shaft, NONE), count=40)


@pytest.mark.slow
def test_a_shaft_whirls_forward_and_backward_as_a_rotating_beam():
    """Seen from the frame at |ω - Ω|; the errors of the two grids are of order 4."""
    k = np.pi / 0.5
    for rate in (100.0, 400.0):
        for GA, rayleigh in ((E * A / 2.6, 5e-2), (1e3 * E * A, 1e-4)):
            exact = np.sort(np.abs(whirl(k, rate, GA) - rate))[:2]
            found = np.abs(modes_of_a_shaft(rate, GA).values.imag)
            nearest = found[np.argmin(np.abs(found[:, None] - exact), axis=0)]
            np.testing.assert_allclose(nearest, exact, rtol=1e-5)
            # Rayleigh's beam, and the gyroscopic part of its whirl
            turn = DENSITY * I * k * k
            size = DENSITY * A + turn
            root = np.sqrt((turn * rate) ** 2 + E * I * k**4 * size)
            closed = np.abs((turn * rate + np.array([root, -root])) / size - rate)
            np.testing.assert_allclose(nearest, np.sort(closed), rtol=rayleigh)
    shift = np.diff(np.sort(nearest))[0] / 2.0
    assert abs(shift - 400.0) > 1.0  # not of the frame alone


L = 1.0


def supercritical(part, damping, drag):
    """A cantilever along the axis, its speed over the first critical one; time constant and drag over ω₁."""
    bare = rod(length=L, radius=0.002, youngs_modulus=1e9)
    first = 2.0 * np.pi * float(bare.bending_frequency)
    robot = rod(
        SpinningFrame(part * first),
        length=L,
        radius=0.002,
        youngs_modulus=1e9,
        nodes=21,
        bending_damping=damping * float(bare.Kbt[0, 0]) / first,
        linear_drag=drag * float(bare.mass_per_length) * first,
    )
    return kc.equilibrium(robot, NONE, space="lobatto4"), first


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "damping", "drag", "kind"),
    [
        (0.98, 0.0, 0.0, "stable"),
        # the spin holds it beyond the first critical speed
        (1.02, 0.0, 0.0, "stable"),
        (0.98, 0.02, 0.0, "stable"),
        (1.02, 0.02, 0.0, "flutter"),
        (1.02, 0.02, 0.2, "stable"),
    ],
)
def test_damping_of_the_material_destabilises_beyond_the_critical_speed_and_air_does_not(
    part, damping, drag, kind
):
    """μ² + c μ + 1 + τ (μ - iΩ) = 0 in units of ω₁, with μ = λ + iΩ in the global frame."""
    found, first = supercritical(part, damping, drag)
    decided = kc.statics.stability(found)
    assert decided.kind == kind and decided.unstable_directions == (kind == "flutter")
    slow = kc.statics.modes(found, count=2).values / first
    exact = np.roots([1.0, drag + damping, 1.0 - 1j * damping * part]) - 1j * part
    exact = np.where(exact.imag < 0.0, np.conj(exact), exact)
    # Rayleigh's rotary inertia is left out
    np.testing.assert_allclose(np.sort(slow.real), np.sort(exact.real), atol=1e-5)
    np.testing.assert_allclose(np.sort(slow.imag), np.sort(exact.imag), atol=1e-4)


# motions

RATE, POINT, PLACE = 8.0, np.array([0.01, -0.03, 0.4]), np.array([0.05, 0.02, 0.0])
TILT = Rotation.from_rotvec([0.3, 1.2, 0.2]).as_quat(scalar_first=True)
LADEN = {
    "length": 0.4, "radius": 0.004, "density": 1200.0, "youngs_modulus": 2e7, "bending_damping": 2e-4,
    "linear_drag": 0.02, "drag": 0.01, "gravity": [1.0, 0.0, -9.81],
    "loads": (
        loads.AttachedMass(mass=0.004, offset=[0.01, 0.0, 0.005], inertia=[1e-6, 2e-6, 1e-6]),
        loads.AttachedMass(mass=0.003, at=0.5, offset=[0.0, 0.01, 0.0]),
        loads.PointWrench(force=[0.02, 0.0, 0.0], at=0.7),
        loads.DistributedWrench(force=[0.0, 0.03, 0.0], follows=True),
    ),
    "surroundings": (
        surroundings.Plane(
            point=[0, 0, -0.05], normal=[0.1, 0, 1.0], stiffness=200.0, friction=0.3, slip=0.05, damping=1.0
        ),
    ),
}  # fmt: skip
STEPS, TIME = 480, 0.3


def carried(robot):
    """The straight robot at rest in the frame, as it moves over the ground."""
    still = robot.replace(gravity=np.zeros(3), loads=(), surroundings=())
    first = kc.simulate(still, np.zeros((1, 3)), 1e-6, space="lobatto4", initial="unstressed")[:1]
    y, layout = np.array(first.y), first.system.y_layout
    turn = Rotation.from_quat(y[0, :, layout.slice("h")], scalar_first=True)
    spin = np.array([0.0, 0.0, RATE])
    y[0, :, layout.slice("q")] = turn.apply(np.cross(spin, y[0, :, layout.slice("p")] - POINT), inverse=True)
    y[0, :, layout.slice("w")] = turn.apply(np.tile(spin, (robot.nodes, 1)), inverse=True)
    return dataclasses.replace(first, y=y)


@pytest.mark.slow
def test_a_rod_in_the_frame_moves_as_one_with_a_turning_base():
    """With bodies, turning gravity, dead and follower loads, drag and contact; of order 4 along the rod."""
    t = np.arange(1, STEPS + 1) * TIME / STEPS
    turn = Rotation.from_rotvec(np.outer(RATE * t, [0.0, 0.0, 1.0]))
    control = np.column_stack([(turn.apply(PLACE - POINT) - (PLACE - POINT))[:, :2], RATE * t])
    distances = []
    for nodes in (11, 21):
        seen = rod(
            SpinningFrame(RATE, point=POINT),
            **LADEN,
            nodes=nodes,
            base_end=ends.Clamped(position=PLACE, orientation=TILT),
        )
        driven = rod(
            **LADEN,
            nodes=nodes,
            base_end=ends.Driven(axes=("x", "y", "rz"), position=PLACE, orientation=TILT),
        )
        one = kc.simulate(seen, np.zeros((STEPS, 0)), TIME / STEPS, space="lobatto4", initial="unstressed")
        other = kc.simulate(driven, control, TIME / STEPS, space="lobatto4", initial=carried(driven))
        tip = POINT + turn.apply(one.tip_position[1:] - POINT)
        distances.append(np.max(np.abs(tip - other.tip_position[1:])))
    # of a motion of 0.2 m
    assert distances[1] < 4e-6 and distances[0] / distances[1] > 8.0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:bending_damping is 0")
def test_without_damping_energy_less_spin_times_angular_momentum_is_constant():
    """Jacobi's integral, of order 4 along the rod; relative to the change of the elastic energy."""
    drift, steps = [], 200
    spin, J = np.array([0.0, 0.0, 15.0]), np.asarray(rod().section.rhoJ)
    for nodes in (21, 41):
        robot = rod(
            SpinningFrame(15.0),
            nodes=nodes,
            base_end=ends.Clamped(orientation=[np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]),
        )
        # let go from its shape under a weight along the axis
        bent = kc.equilibrium(robot.replace(gravity=[0.0, 0.0, -9.81]), NONE, space="lobatto4")
        found = kc.simulate(robot, np.zeros((steps, 0)), 0.2 / steps, space="lobatto4", initial=bent)
        p, h, q, w, v, u = (np.asarray(found.part(name)) for name in "phqwvu")
        turn, flat = Rotation.from_quat(h.reshape(-1, 4), scalar_first=True), p.reshape(-1, 3)
        # over the ground, in the axes of the frame; w in those of the material
        q = turn.apply(q.reshape(-1, 3)) + np.cross(spin, flat)
        w = w.reshape(-1, 3) + turn.inv().apply(spin)
        mass, stretch = float(robot.mass_per_length), v - [0.0, 0.0, 1.0]
        momentum = np.cross(flat, mass * q) + turn.apply(w @ J)
        kinetic = 0.5 * np.sum(mass * q * q + (w @ J) * w, axis=1)
        elastic = 0.5 * np.sum((stretch @ robot.Kse) * stretch + (u @ robot.Kbt) * u, axis=-1)
        simpson = np.array([1.0, *[4.0, 2.0] * (nodes // 2 - 1), 4.0, 1.0]) / (6.0 * (nodes - 1))
        total = ((kinetic - momentum @ spin).reshape(p.shape[:2]) + elastic) @ simpson
        drift.append(np.max(np.abs(total - total[0])) / np.ptp(elastic @ simpson))
        assert np.ptp(found.tip_position, axis=0)[1] > 1e-3
    assert drift[1] < 6e-5 and drift[0] / drift[1] > 12.0


@pytest.mark.slow
def test_it_runs_in_batches_has_gradients_and_carries_a_model():
    def moved(rate):
        return kc.simulate(
            rod(SpinningFrame(rate), bending_damping=1e-4, gravity=[1.0, 0.0, 0.0], nodes=6),
            np.zeros((20, 0)),
            0.01,
            initial="unstressed",
        )

    robots = [moved(rate).system for rate in (3.0, 9.0)]
    both = kc.simulate(robots, np.zeros((2, 20, 0)), 0.01, initial="unstressed")
    np.testing.assert_allclose(both[1].tip_position, moved(9.0).tip_position, rtol=0.0, atol=1e-12)
    step = 1e-4
    slope = jax.grad(lambda rate: moved(rate).tip_position[-1, 0])(9.0)
    apart = moved(9.0 + step).tip_position[-1, 0] - moved(9.0 - step).tip_position[-1, 0]
    assert float(slope) == pytest.approx(float(apart) / (2.0 * step), rel=1e-4)
    none = jax.tree.map(
        lambda leaf: 0.0 * leaf if eqx.is_inexact_array(leaf) else leaf,
        network(robots[1], NetworkOptions(hidden=3), jax.random.PRNGKey(0)),
    )
    found = kc.simulate(
        kc.KNODE(robots[0], none).replace(**{"effects.0.rate": 9.0}),
        np.zeros((20, 0)),
        0.01,
        initial="unstressed",
    )
    np.testing.assert_allclose(found.tip_position, moved(9.0).tip_position, atol=1e-9)


@pytest.mark.slow
def test_its_rate_is_identified():
    truth = rod(SpinningFrame(7.0), bending_damping=1e-4, gravity=[1.0, 0.0, 0.0], nodes=6)
    motion = kc.simulate(truth, np.zeros((30, 0)), 0.01, initial="unstressed")
    found = kc.identify(truth.replace(**{"effects.0.rate": 5.0}), [motion], parameters=["effects.0.rate"])
    assert found.robot.effects[0].rate == pytest.approx(7.0, rel=1e-5)
