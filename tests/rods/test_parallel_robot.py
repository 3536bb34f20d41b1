"""A platform on six elastic legs: closed forms, symmetries, the platform's balance, control and learning.

Lateral stiffness: a leg that is clamped at both ends, one of which moves sideways without turning, gives
12 EI/L³; under the load P it yields by F L/P (tan(x)/x - 1), x = L √(P/EI) / 2, and buckles at P = π² EI/L².
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.rotation import rotation_matrix

ROBOT = kc.load_robot("six-legged-robot")
L, EI = 0.4, float(ROBOT.strand.Kbt[0, 0])
EVEN = np.arange(6) * np.pi / 3
#: upright legs that weigh next to nothing
UPRIGHT = ROBOT.replace(
    base_angles=EVEN, platform_angles=EVEN, density=1.0, gravity=np.zeros(3), drag=0.0, bending_damping=0.0
)
DT = 0.02
SOME = np.array([0.02, -0.03, 0.05, 0.01, 0.0, -0.02])


def still(robot, displacements, **options):
    found = kc.equilibrium(robot, np.asarray(displacements, dtype=float), **options)
    return found, np.asarray(found.y)[0]


def turned(matrix, vectors):
    return np.einsum("ij,...j->...i", matrix, vectors)


def about_z(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def smooth(seed, steps=100):
    """Displacements (steps, 6) that begin at zero, slowly."""
    rng = np.random.default_rng(seed)
    frequency, phase, size = (
        rng.uniform(0.5, 2.0, 6),
        rng.uniform(0, 2 * np.pi, 6),
        rng.uniform(0.01, 0.04, 6),
    )
    t = np.arange(1, steps + 1)[:, None] * DT
    return size * (np.sin(2 * np.pi * frequency * t + phase) - np.sin(phase)) * (1 - np.exp(-t / 0.1))


# symmetry


@pytest.mark.slow
@pytest.mark.parametrize("displacement", [0.0, 0.15])
def test_equal_displacements_lift_the_platform_without_tilting_it(displacement):
    found, y = still(ROBOT, [displacement] * 6)
    np.testing.assert_allclose(ROBOT.platform_position(y)[:2], 0.0, atol=1e-9)
    np.testing.assert_allclose(ROBOT.platform_orientation(y), [1.0, 0.0, 0.0, 0.0], atol=1e-9)
    height = found.tip_position[0, 2] - displacement
    np.testing.assert_allclose(height, still(ROBOT, np.zeros(6))[0].tip_position[0, 2], atol=1e-9)


@pytest.mark.campaign
def test_a_turned_layout_turns_everything():
    angle = 0.7
    other = ROBOT.replace(
        base_angles=ROBOT.base_angles + angle, platform_angles=ROBOT.platform_angles + angle
    )
    (_, one), (_, two) = still(ROBOT, SOME), still(other, SOME)
    Z = about_z(angle)
    np.testing.assert_allclose(other.leg_positions(two), turned(Z, ROBOT.leg_positions(one)), atol=1e-9)
    R, R_other = (
        np.asarray(rotation_matrix(jnp.asarray(robot.platform_orientation(y))))
        for robot, y in ((ROBOT, one), (other, two))
    )
    np.testing.assert_allclose(R_other, Z @ R @ Z.T, atol=1e-9)


def test_a_platform_turned_on_its_base_is_found_turned():
    other = UPRIGHT.replace(platform_angles=EVEN + 0.5)
    _, y = still(other, np.zeros(6))
    w, x, y_, z = other.platform_orientation(y)
    # twisting and bending legs resist: it goes most of the way back
    np.testing.assert_allclose([x, y_], 0.0, atol=1e-9)
    assert -0.5 < 2 * np.arctan2(z, w) < -0.1


# the platform


def test_the_platform_is_in_balance():
    loaded = ROBOT.replace(platform_force=[0.3, -0.2, 0.1], platform_moment=[0.01, 0.02, -0.01])
    _, y = still(loaded, SOME)
    p, h, n, m, _, _ = np.split(y[-1].reshape(6, 19), [3, 7, 10, 13, 16], axis=1)
    w, v = h[:, :1], h[:, 1:]
    x = np.stack([np.cos(loaded.platform_angles), np.sin(loaded.platform_angles), np.zeros(6)], axis=1)
    x = 0.087 * x
    arms = x + 2 * np.cross(v, np.cross(v, x) + w * x) / np.sum(h * h, axis=1, keepdims=True)
    centres = p - arms
    np.testing.assert_allclose(centres, np.broadcast_to(centres[0], (6, 3)), atol=1e-9)
    np.testing.assert_allclose(loaded.platform_position(y), centres[0], atol=1e-9)
    force = np.array([0.3, -0.2, 0.1]) + 0.12 * np.array([0, 0, -9.81]) - n.sum(axis=0)
    moment = np.array([0.01, 0.02, -0.01]) - m.sum(axis=0) - np.cross(arms, n).sum(axis=0)
    np.testing.assert_allclose(force, 0.0, atol=1e-9)
    np.testing.assert_allclose(moment, 0.0, atol=1e-9)


def test_a_trajectory_has_what_its_legs_have():
    rng = np.random.default_rng(0)
    legs = rng.normal(size=(2, 3, 10, 6, 19))
    strains = rng.normal(size=(2, 3, 10, 6, 6))
    batch = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), ROBOT, ROBOT)
    y, z = legs.reshape(2, 3, 10, -1), strains.reshape(2, 3, 10, -1)
    for system, pick in ((ROBOT, 0), (batch, slice(None))):
        none = np.zeros(3, dtype=int)
        motion = kc.Trajectory(
            system, None, np.arange(3.0), y[pick], z[pick], np.zeros((3, 6)), none, 0.0 * none, none
        )
        for name, begin in (("force", 7), ("moment", 10), ("velocity", 13), ("angular_velocity", 16)):
            np.testing.assert_array_equal(getattr(motion, name), legs[pick][..., begin : begin + 3])
        np.testing.assert_array_equal(motion.part("h"), legs[pick][..., 3:7])
        np.testing.assert_array_equal(motion.part("u"), strains[pick][..., 3:])
        np.testing.assert_array_equal(motion.part("n6"), motion.force[..., 5, :])
        with pytest.raises(KeyError, match=r"no field 'tension'; there are p1, h1, .* displacement"):
            _ = motion.part("tension")
    assert jax.jit(lambda motion: motion.force)(motion).shape == (2, 3, 10, 6, 3)


@pytest.mark.campaign
@pytest.mark.parametrize("load", [0.0, 0.2, 0.6])
def test_lateral_stiffness_and_its_loss_under_weight(load):
    """A given part of the load under which the legs buckle; Timoshenko, Theory of elastic stability, 2.6."""
    P = load * np.pi**2 * EI / L**2
    stretched = 1.0 - P / float(ROBOT.strand.Kse[2, 2])
    force = 1e-3 * 6 * 12 * EI / L**2
    robot = UPRIGHT.replace(platform_mass=6 * P / 9.81, gravity=[0, 0, -9.81], platform_force=[force, 0, 0])
    found, _ = still(robot, np.zeros(6), space="lobatto4")
    x = L * np.sqrt(max(P, 1e-9) / EI) / 2
    yields = force / 6 * L / max(P, 1e-9) * (np.tan(x) / x - 1)
    np.testing.assert_allclose(found.tip_position[0, 0], yields, rtol=3e-4)
    assert found.tip_position[0, 2] == pytest.approx(L * stretched, rel=1e-4)


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("space", "nodes", "order"), [("euler", (17, 33, 65), 1), ("lobatto4", (9, 17, 33), 4)]
)
def test_order_of_convergence_in_space(space, nodes, order):
    tips = [still(ROBOT.replace(nodes=n), SOME, space=space)[0].tip_position[0] for n in nodes]
    coarse, fine = np.linalg.norm(tips[0] - tips[1]), np.linalg.norm(tips[1] - tips[2])
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.3)


@pytest.mark.campaign
def test_a_heavy_platform_on_light_legs_swings_as_a_mass_on_springs():
    """Released from where a small force held it; the trapezoidal rule's frequency errs by order 2."""
    mass = 0.2
    robot = UPRIGHT.replace(platform_mass=mass)
    omega = np.sqrt(6 * 12 * EI / (L**3 * mass))
    held, _ = still(
        robot.replace(platform_force=[1e-3 * 6 * 12 * EI / L**2, 0, 0]), np.zeros(6), space="lobatto4"
    )
    found = []
    for steps in (32, 64, 128):
        dt = 1.5 * np.pi / omega / steps * 1.1
        swing = kc.simulate(
            robot,
            np.zeros((steps, 6)),
            dt,
            initial=held,
            time="trapezoidal",
            space="lobatto4",
            start="consistent",
        )
        x, time = swing.tip_position[:, 0], swing.time
        # from the first to the second crossing of zero is half a period
        at = [
            np.interp(0.0, x[[k + 1, k]], time[[k + 1, k]])
            if x[k] > 0
            else np.interp(0.0, x[[k, k + 1]], time[[k, k + 1]])
            for k in np.flatnonzero(x[:-1] * x[1:] < 0)
        ]
        found.append(np.pi / (at[1] - at[0]))
    errors = np.array(found) / omega - 1.0
    # tan(ω' dt/2) = ω dt/2, and a straight line between rows errs by as much
    assert np.log2((errors[0] - errors[1]) / (errors[1] - errors[2])) == pytest.approx(2.0, abs=0.3)
    assert abs(errors[2] + (errors[2] - errors[1]) / 3) < 5e-4


# control


@functools.cache
def pose_and_slope():
    """Position and small turn of the platform (6,), by displacements and force (9,); and the derivatives."""

    def pose(given):
        robot = ROBOT.replace(platform_force=given[6:])
        y = kc.equilibrium(robot, given[:6]).y[0]
        h = robot.platform_orientation(y)
        found = jnp.concatenate([robot.platform_position(y), 2 * h[1:] / h[0]])
        return found, found

    return jax.jit(jax.jacfwd(pose, has_aux=True))


@pytest.mark.campaign
def test_derivatives_of_the_pose_are_those_of_finite_differences():
    given, step = jnp.concatenate([SOME, jnp.zeros(3)]), 1e-4
    slope, _ = pose_and_slope()(given)
    for k in (0, 4, 7):
        up, down = (pose_and_slope()(given + sign * step * jnp.eye(9)[k])[1] for sign in (1, -1))
        np.testing.assert_allclose(slope[:, k], (up - down) / (2 * step), rtol=1e-4, atol=1e-5)


@pytest.mark.campaign
def test_displacements_for_a_wanted_pose_are_found_again():
    """Inverse statics is inverse kinematics: the platform's pose is that of the last node.

    Far from rest bent legs have more than one shape, and other displacements lead to the same pose.
    """
    for part in (0.3, 1.0):
        displacements = part * np.asarray(SOME)
        wanted = kc.equilibrium(ROBOT, displacements)
        pose = wanted.position[0, -1], wanted.quaternion[0, -1]
        found = kc.inverse_kinematics(ROBOT, *pose, low=-0.05, high=0.05)
        assert found.result is kc.statics.Reach.REACHED
        if part < 1.0:
            np.testing.assert_allclose(found.control, displacements, atol=1e-7)
        reached = kc.equilibrium(ROBOT, found.control)
        np.testing.assert_allclose(reached.position[0, -1], pose[0], atol=1e-9)
        np.testing.assert_allclose(reached.quaternion[0, -1], pose[1], atol=1e-9)


@pytest.mark.campaign
def test_a_pose_beyond_the_actuators_is_not_reached():
    found = kc.inverse_kinematics(ROBOT, [0.0, 0.0, 0.6], low=-0.05, high=0.05)
    assert found.result is kc.statics.Reach.UNREACHABLE and np.all(found.control >= 0.05 - 1e-6)


# motion


@functools.cache
def swung():
    return kc.simulate(ROBOT, smooth(0), DT, time="bdf2", start="paper")


@pytest.mark.slow
def test_a_simulation_begins_in_equilibrium_and_stays_there():
    resting = kc.simulate(ROBOT, np.zeros((3, 6)), DT, initial="unstressed")
    found, _ = still(ROBOT, np.zeros(6))
    np.testing.assert_allclose(resting.position[0], found.position[0], atol=1e-9)
    np.testing.assert_allclose(resting.position[-1], resting.position[0], atol=1e-8)


@pytest.mark.slow
def test_the_actuators_move_as_they_are_told():
    base = ROBOT.leg_positions(swung().y[:, 0])
    np.testing.assert_allclose(base[1:, :, 2], smooth(0), atol=1e-12)
    speed = swung().part("q3")[10:, 0, 2]
    z = base[:, 2, 2]
    np.testing.assert_allclose(speed, (1.5 * z[10:] - 2 * z[9:-1] + 0.5 * z[8:-2]) / DT, atol=1e-9)


@pytest.mark.campaign
def test_large_displacements_are_recovered():
    """Too far for Newton's method from rest: the stable elimination and load continuation get there."""
    found, y = still(ROBOT, [0.2, -0.2] * 3)
    assert found.result[0] > 0
    np.testing.assert_allclose(ROBOT.platform_position(y)[:2], 0.0, atol=1e-9)


# learning


@pytest.mark.campaign
def test_a_wrong_modulus_is_learned_from_one_trajectory():
    knowledge = ROBOT.replace(youngs_modulus=0.7 * ROBOT.youngs_modulus)
    model = kc.fit(knowledge, [swung()])
    unseen = kc.simulate(ROBOT, smooth(1), DT)
    before, after = (
        kc.metrics.tip_rmse(kc.simulate(each, smooth(1), DT), unseen) for each in (knowledge, model)
    )
    assert after < before / 1000
    # the legs are alike: one law is learned for all, and it is Young's modulus that was wrong
    found = {(each.target, each.function): each.coefficient for each in kc.learning.explain(model)}
    assert found["u_x", "u_x"] == pytest.approx(0.3 * EI, rel=1e-6)


# files, and bad input
