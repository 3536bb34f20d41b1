"""Every kind of robot is a file, runs in batches as it runs alone, and is differentiable."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from tests.learning.test_systems import DT, SYSTEMS
from tests.solvers.test_derivatives import numerically

STEPS = 12


def six_legs():
    robot = kc.load_robot("six-legged-robot")
    t = np.arange(1, 61)[:, None] * DT
    return robot, *(
        0.01 * np.sin(2 * np.pi * t / T + np.arange(robot.control_layout.size)) for T in (1.0, 1.5)
    )


KINDS = {**SYSTEMS, "six_legs": six_legs}


@functools.cache
def kind(name):
    robot, first, second = KINDS[name]()
    return robot, np.asarray(first)[:STEPS], np.asarray(second)[:STEPS]


@pytest.mark.parametrize("name", KINDS)
def test_it_is_a_robot_file(name, tmp_path):
    robot, *_ = kind(name)
    kc.save_robot(robot, tmp_path / "robot.yaml")
    again = kc.load_robot(tmp_path / "robot.yaml")
    assert jax.tree.structure(again) == jax.tree.structure(robot)
    for one, other in zip(jax.tree.leaves(robot), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.campaign
@pytest.mark.parametrize("name", KINDS)
def test_it_runs_in_a_batch_as_alone(name):
    robot, *controls = kind(name)
    batch = kc.simulate(robot, np.stack(controls), DT)
    for own, control in zip(batch.y, controls, strict=True):
        alone = kc.simulate(robot, control, DT)
        scale = np.asarray(robot.scales().y)
        np.testing.assert_allclose(own / scale, np.asarray(alone.y) / scale, atol=1e-8)


@pytest.mark.campaign
@pytest.mark.parametrize("name", KINDS)
def test_its_tip_has_a_derivative(name):
    robot, control, _ = kind(name)
    assert np.all(kc.simulate(robot, control, DT).result == kc.Result.CONVERGED)

    def height(part):
        own = robot.replace(youngs_modulus=robot.youngs_modulus * part)
        found = kc.simulate(own, jnp.asarray(control), DT)
        return jnp.sum(found.position[-1, -1] * jnp.array([1.0, 0.7, 0.3]))

    slope = float(jax.grad(height)(1.0))
    assert slope == pytest.approx(numerically(height, 1.0, 1.0), rel=1e-5, abs=1e-9)
