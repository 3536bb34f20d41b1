"""Gradients of equilibria and motions with respect to routing, stiffness and damping, against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.rods.routing import Helical, Polynomial, Tapered

ANGLES = 2.0 * np.pi / 3.0 * np.arange(3)
ROBOT = kc.robots.RoutedTendonRobot(
    length=0.3,
    radius=0.0025,
    density=1400.0,
    youngs_modulus=1.2e9,
    bending_damping=2e-3,
    nodes=6,
    tendon_offset=0.012,
    tendon_angles=ANGLES,
    loads=(kc.robots.loads.AttachedMass(mass=0.02),),
    routing=(Helical(0.012, 0.0, 0.2), Tapered(0.012, 0.008, 2.0), Polynomial([-0.006, 0.002], [-0.01, 0.0])),
)
#: changed parameters, each with a value and a step of its own size
DESIGN = {
    "youngs_modulus": (1.2e9, 1e8),
    "radius": (0.0025, 1e-4),
    "loads.0.mass": (0.02, 2e-3),
    "routing.0.radius": (0.012, 1e-3),
    "routing.0.phase": (0.1, 0.2),
    "routing.0.turns": (0.2, 0.1),
    "routing.1.base_offset": (0.012, 1e-3),
    "routing.1.end_offset": (0.008, 1e-3),
    "routing.1.angle": (2.0, 0.2),
    "routing.2.x": (np.array([-0.006, 0.002]), np.array([1e-3, -1e-3])),
    "routing.2.y": (np.array([-0.01, 0.0]), np.array([-5e-4, 2e-3])),
}
#: central differences of order 4 with steps of 1e-3 of DESIGN's, and solutions to 1e-10 or so
RELATIVE = 1e-6


def designed(steps):
    """Return the robot a number of steps from the first design, one number for each parameter."""
    return ROBOT.replace(
        **{name: at + k * step for k, (name, (at, step)) in zip(steps, DESIGN.items(), strict=True)}
    )


def differences(function, count, h=1e-3):
    """Return central differences of order 4 with respect to each of `count` numbers, about zero."""
    found = []
    for each in np.eye(count):
        far, near, right, rightmost = (float(function(k * h * each)) for k in (-2, -1, 1, 2))
        found.append((far - 8.0 * near + 8.0 * right - rightmost) / (12.0 * h))
    return np.array(found)


def rest_error(steps):
    tensions = np.array([[3.0, 1.0, 0.5], [0.5, 4.0, 1.0]])
    tips = kc.equilibrium(designed(steps), tensions).tip_position[:, 0]
    return 1e4 * jnp.mean(jnp.sum((tips - np.array([0.1, 0.05, 0.25])) ** 2, axis=1))


@pytest.mark.campaign
@pytest.mark.sample
def test_gradient_of_a_batch_of_equilibria_with_respect_to_the_design():
    slope = jax.jit(jax.value_and_grad(rest_error))
    gradient = np.asarray(slope(np.zeros(len(DESIGN)))[1])
    expected = differences(lambda steps: slope(steps)[0], len(DESIGN))
    np.testing.assert_allclose(gradient, expected, rtol=RELATIVE, atol=RELATIVE * np.abs(expected).max())
    assert np.all(np.abs(expected) > 1e-4 * np.abs(expected).max())  # every parameter counts


def settling(steps):
    """Return the mean square distance (cm²) from the last place, of a motion after a step of the tensions."""
    damping = {"bending_damping": 2e-3 * (1.0 + 0.1 * steps[-1])}
    robot = designed(steps[:-1]).replace(**damping)
    tips = kc.simulate(robot, np.tile([3.0, 1.0, 0.5], (12, 1)), 0.02).tip_position
    return 1e4 * jnp.mean(jnp.sum((tips - tips[-1]) ** 2, axis=1))


@pytest.mark.campaign
def test_gradient_of_a_motion_with_respect_to_design_and_damping():
    count = len(DESIGN) + 1
    slope = jax.jit(jax.value_and_grad(settling))
    gradient = np.asarray(slope(np.zeros(count))[1])
    expected = differences(lambda steps: slope(steps)[0], count)
    np.testing.assert_allclose(gradient, expected, rtol=RELATIVE, atol=RELATIVE * np.abs(expected).max())


@pytest.mark.campaign
def test_designs_solved_as_one_batch_are_each_by_itself():
    robots = [designed(k * np.ones(len(DESIGN))) for k in (0.0, 1.0)]
    tensions = np.array([3.0, 1.0, 0.5])
    together = kc.equilibrium(robots, np.tile(tensions, (2, 1)))
    assert together.all_valid
    alone = kc.equilibrium(robots[1], tensions)
    np.testing.assert_allclose(together.tip_position[1, 0], alone.tip_position[0], atol=1e-9)
