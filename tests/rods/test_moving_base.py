"""A rod on a moving base: accelerated frames, base excitation, the wrench on the base, controls of a path."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.robots import ParameterError, ends

L, RADIUS, DENSITY, E = 0.3, 0.004, 1100.0, 2e6
AREA, EI = np.pi * RADIUS**2, E * np.pi * RADIUS**4 / 4.0
#: first circular frequency (1/s) of the clamped rod, and the damping for about a tenth of the critical one
FIRST = 1.8751**2 / L**2 * np.sqrt(EI / (DENSITY * AREA))
ARM = kc.robots.SlenderRod(
    length=L,
    radius=RADIUS,
    density=DENSITY,
    youngs_modulus=E,
    bending_damping=0.2 * EI / FIRST,
    gravity=[0.0, 0.0, 0.0],
    nodes=11,
    base_end=ends.Moving(),
)
#: it hangs from its body
HANGING = ARM.replace(gravity=[0.0, 0.0, -9.81], **{"base_end.orientation": [0.0, 1.0, 0.0, 0.0]})
DT = 0.01


def motion(robot, rows, dt=DT, **options):
    start = kc.equilibrium(robot, rows[0], space="lobatto4")
    return kc.simulate(robot, rows[1:], dt, initial=start, space="lobatto4", **options)


def path(count):
    """Positions and orientations of a smooth path, in rows of DT."""
    t = DT * np.arange(count)
    p = np.stack([0.1 * np.sin(3.0 * t), 0.0 * t, 0.05 * np.cos(2.0 * t)], axis=1)
    turned = Rotation.from_rotvec(np.stack([1.5 * t, 0.5 * np.sin(3.0 * t), 0.0 * t], axis=1))
    return p, turned.as_quat(scalar_first=True)


# accelerated frames


def test_a_base_in_free_fall_sees_no_gravity():
    t = DT * np.arange(21)
    rows = np.zeros((21, 13))
    rows[:, 2], rows[:, 9] = -9.81 * t**2 / 2.0, -9.81 * t
    rows[:, 3:5] = np.cos(0.5), np.sin(0.5)
    start = kc.equilibrium(ARM.replace(base_end=HANGING.base_end), rows[0], space="lobatto4")
    falling = kc.simulate(HANGING, rows[1:], DT, initial=start, space="lobatto4")
    assert np.max(np.abs(falling.base_wrench[1:])) < 1e-11
    assert np.ptp(falling.position[1:] - rows[1:, None, :3], axis=0).max() < 1e-11


def test_a_steady_rotation_stretches_the_rod_as_in_the_closed_form():
    # N_s = -ρA Ω² x and x_s = 1 + N/EA, with x(0) = 0 and N(L) = 0
    spin = 20.0
    control = np.zeros(13)
    control[[3, 10]] = 1.0, spin
    turning = kc.equilibrium(ARM, control, space="lobatto4")
    root = spin * np.sqrt(DENSITY / E)
    expected = np.sin(root * np.linspace(0.0, L, 11)) / root / np.cos(root * L)
    np.testing.assert_allclose(turning.position[0, :, 2], expected, rtol=1e-7, atol=1e-12)
    pull = E * AREA * (1.0 / np.cos(root * L) - 1.0)
    np.testing.assert_allclose(turning.base_wrench[0], [0.0, 0.0, pull, 0.0, 0.0, 0.0], atol=1e-6 * pull)


def response(frequency):
    """Complex amplitudes of tip, base force and base moment for a base of amplitude 1 across the rod.

    The equations of a Timoshenko beam with damped bending, by the matrix exponential.
    """
    Kse, Kbt = float(np.asarray(ARM.Kse)[0, 0]), float(np.asarray(ARM.Kbt)[0, 0])
    bending = Kbt + 1j * frequency * float(np.asarray(ARM.bending_damping)[0, 0])
    rates = np.zeros((4, 4), dtype=complex)
    rates[0, 1], rates[0, 2], rates[1, 3], rates[3, 2] = 1.0, 1.0 / Kse, 1.0 / bending, -1.0
    rates[2, 0] = -DENSITY * AREA * frequency**2
    rates[3, 1] = -DENSITY * EI / E * frequency**2
    over = expm(rates * L)
    force, moment = np.linalg.solve(over[2:, 2:], -over[2:, 0])
    return over[0, 0] + over[0, 2:] @ [force, moment], force, moment


def amplitude(t, values, frequency):
    """Complex amplitude of the last two periods."""
    last = t > t[-1] - 4.0 * np.pi / frequency + 1e-9
    terms = np.stack([np.cos(frequency * t[last]), np.sin(frequency * t[last])], axis=1)
    cosine, sine = np.linalg.lstsq(terms, values[last], rcond=None)[0]
    return cosine - 1j * sine


def test_a_shaken_cantilever_converges_to_the_closed_form_with_order_two():
    frequency, size = 1.2 * FIRST, 1e-4
    exact, errors = np.array(response(frequency)), []
    for steps in (16, 32):
        dt = 2.0 * np.pi / frequency / steps
        t = dt * np.arange(14 * steps + 1)
        rows = np.zeros((len(t), 13))
        rows[:, 3], rows[:, 0] = 1.0, size * np.cos(frequency * t)
        rows[:, 7] = -size * frequency * np.sin(frequency * t)
        shaken = motion(ARM, rows, dt, errors=False)
        wrench = shaken.mean_base_wrench
        series = (t, shaken.tip_position[:, 0]), *((t - dt / 2.0, wrench[:, k]) for k in (0, 4))
        found = np.array([amplitude(*each, frequency) for each in series]) / size
        errors.append(np.abs(found - exact) / np.abs(exact))
    assert np.all(errors[1] < [0.015, 0.03, 0.015])
    assert errors[0][0] / errors[1][0] > 3.4
    assert abs(exact[0]) > 3.0  # near the resonance


# the wrench


def test_the_wrench_on_the_base_is_the_loss_of_momentum():
    p, h = path(61)
    robot = ARM.replace(nodes=21)
    rows = kc.controls.base_motion(robot, [], DT, position=p, orientation=h)
    moved = motion(robot, rows)
    R = Rotation.from_quat(np.asarray(moved.quaternion).reshape(-1, 4), scalar_first=True)
    v = R.apply(np.asarray(moved.velocity).reshape(-1, 3)).reshape(61, 21, 3)
    weights = np.array([1, *[4, 2] * 9, 4, 1]) / 60.0 * L * DENSITY * AREA
    spin = DENSITY * EI / E * np.array([1.0, 1.0, 2.0])
    own = R.apply(spin * np.asarray(moved.angular_velocity).reshape(-1, 3)).reshape(61, 21, 3)
    own = np.einsum("i,tij->tj", weights / (DENSITY * AREA), own)
    momentum = np.einsum("i,tij->tj", weights, v)
    angular = np.einsum("i,tij->tj", weights, np.cross(moved.position, v)) + own
    wrench = np.asarray(moved.mean_base_wrench)
    force, middle = wrench[1:, :3], (p[1:] + p[:-1]) / 2.0
    # about the origin
    moment = wrench[1:, 3:] + np.cross(middle, force)
    for lost, impulse in ((momentum, force), (angular, moment)):
        change = lost[0] - lost
        summed = np.concatenate([np.zeros((1, 3)), np.cumsum(DT * impulse, axis=0)])
        assert np.max(np.abs(change - summed)) < 5e-4 * np.ptp(change, axis=0).max()


@pytest.mark.slow
def test_tendons_whose_motors_are_on_the_base_pull_at_no_outer_wrench():
    robot = kc.robots.RoutedTendonRobot.like(
        kc.load_robot("delrin-tendon-robot"),
        tendon_offset=0.02,
        gravity=[0.0, 0.0, 0.0],
        base_end=ends.Moving(),
    )
    assert robot.control_layout.names[0] == "tension"
    control = np.zeros(robot.control_layout.size)
    control[0], control[4:8] = 4.0, Rotation.from_rotvec([0.3, 0.2, 0.0]).as_quat(scalar_first=True)
    bent = kc.equilibrium(robot, control)
    assert np.max(np.abs(bent.base_wrench)) < 1e-7
    assert np.linalg.norm(bent.part("u")[0, 0]) > 0.1


# controls


def test_a_path_makes_the_controls_of_one_motion():
    p, h = path(81)
    signs = np.where(np.arange(81) % 3 == 0, -1.0, 1.0)[:, None]
    rows = kc.controls.base_motion(HANGING, [], DT, position=p, orientation=signs * h)
    t = DT * np.arange(81)
    np.testing.assert_allclose(rows[:, 7], 0.3 * np.cos(3.0 * t), atol=1e-5)
    before, after = (Rotation.from_quat(rows[k, 3:7], scalar_first=True) for k in (39, 41))
    spin = (after * before.inv()).as_rotvec() / (2.0 * DT)
    np.testing.assert_allclose(rows[40, 10:], spin, atol=1e-3)
    moved = motion(HANGING, rows)  # no warning
    np.testing.assert_allclose(moved.position[:, 0], p, atol=1e-12)
    start = kc.equilibrium(HANGING, rows[0], space="lobatto4")
    stepper = kc.solvers.Stepper(HANGING, DT, initial=start, space="lobatto4")
    for row in rows[1:]:
        state = stepper.step(row)
    for name in ("base_wrench", "mean_base_wrench"):
        np.testing.assert_allclose(getattr(state, name)[0], getattr(moved, name)[-1], atol=1e-8)
    assert np.ptp([moved.base_wrench[-1], moved.mean_base_wrench[-1]], axis=0).max() > 1e-4
    still = kc.simulate(ARM, np.zeros((2, 13)), DT, space="lobatto4")  # an orientation of zeros is upright
    np.testing.assert_allclose(still.tip_position[-1], [0.0, 0.0, L], atol=1e-12)


def test_velocities_that_are_not_the_rates_of_the_pose_are_told():
    p, h = path(21)
    rows = kc.controls.base_motion(HANGING, [], DT, position=p, orientation=h)
    for columns, name in ((slice(7, 10), "base_velocity"), (slice(10, 13), "base_angular_velocity")):
        wrong = rows.copy()
        wrong[:, columns] *= -1.0
        with pytest.warns(UserWarning, match=rf"{name} is off by up to .*base_motion\("):
            kc.simulate(HANGING, wrong[1:], DT, space="lobatto4")


def test_a_batch_has_a_wrench_each():
    p, h = path(11)
    rows = kc.controls.base_motion(HANGING, [], DT, position=p, orientation=h)
    slower = rows * np.where(np.arange(13) == 3, 1.0, 0.0)
    both = kc.simulate(HANGING, np.stack([rows[1:], slower[1:]]), DT, space="lobatto4")
    assert both.base_wrench.shape == (2, 11, 6)
    weight = DENSITY * AREA * L * 9.81
    np.testing.assert_allclose(both.base_wrench[1, -1], [0.0, 0.0, -weight, 0.0, 0.0, 0.0], atol=1e-9)


@pytest.mark.slow
def test_derivatives_follow_the_base():
    p, h = path(11)
    rows = kc.controls.base_motion(HANGING, [], DT, position=p, orientation=h)

    def force(change):
        moved = jnp.asarray(rows[1:]).at[-1, 7].add(change)
        return kc.simulate(HANGING, moved, DT).base_wrench[-1, 0]

    differences = (force(1e-4) - force(-1e-4)) / 2e-4
    np.testing.assert_allclose(jax.grad(force)(0.0), differences, rtol=1e-6)
    assert differences < 0.0  # against its acceleration


def test_what_a_moving_base_cannot_be_is_refused():
    with pytest.raises(ParameterError, match=r"allowed is RoutedTendonRobot\.like\(robot\)"):
        kc.load_robot("delrin-tendon-robot").replace(base_end=ends.Moving())
    with pytest.raises(ParameterError, match="a moving end is a tip"):
        ARM.replace(tip_end=ends.Moving())
    with pytest.raises(ParameterError, match="a moving end has spinning-frame"):
        ARM.replace(effects=(kc.robots.SpinningFrame(rate=1.0),))
    fixed = ARM.replace(base_end=ends.Clamped())
    for robot, options, said in (
        (fixed, {"position": np.zeros((3, 3))}, "with base_end=kc.robots.ends.Moving"),
        (ARM, {}, "have no rows"),
        (ARM, {"position": np.zeros((3, 2))}, r"position has the shape \(3, 2\)"),
        (ARM, {"position": np.zeros((3, 3)), "orientation": np.ones((4, 4))}, "as many rows"),
        (ARM, {"position": np.zeros((3, 3)), "orientation": np.zeros(4)}, "an orientation is zero"),
    ):
        with pytest.raises(kc.controls.ControlsError, match=said):
            kc.controls.base_motion(robot, [], DT, **options)
