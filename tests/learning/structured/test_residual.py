"""The structured residual: what it finds is what was wrong, in a mechanician's numbers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from examples.hanging_string import HangingString
from knode_cosserat.learning.config import StructuredOptions
from knode_cosserat.learning.explain import explain
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.structured.fit import residuals_of
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.semi_discrete import History, Point
from studies import truths
from tests.learning.bar import BAR, pulled

DT = 0.05
UNSEEN = kc.controls.sine(1.5, 60, DT)


@pytest.fixture(scope="module")
def robot():
    return kc.load_robot("delrin-tendon-robot")


def like(robot, kind, **extra):
    return kind(**{name: getattr(robot, name) for name in robot.parameters()}, nodes=robot.nodes, **extra)


def recorded(truth, rows=30, periods=(0.5, 1.0), **options):
    return [kc.simulate(truth, kc.controls.sine(p, rows, DT), DT, **options)[:rows] for p in periods]


def learned(knowledge, trajectories, **options):
    [residual] = residuals_of(knowledge, trajectories, StructuredOptions(**options), [0])
    return KNODE(knowledge, residual)


def findings(model):
    return {(found.part, found.target, found.function): found.coefficient for found in explain(model)}


def left(model, knowledge, truth, controls=UNSEEN, dt=DT, **options):
    """Tip error on unseen controls as a part of the knowledge's own."""
    true, base, ours = (kc.simulate(one, controls, dt, **options) for one in (truth, knowledge, model))
    return kc.metrics.tip_dtw(ours, true) / kc.metrics.tip_dtw(base, true)


@pytest.mark.slow
def test_a_wrong_length_is_a_stretch_and_nothing_else(robot):
    knowledge = robot.replace(length=0.4)
    model = learned(knowledge, recorded(robot))
    [found] = explain(model)
    assert found.part == "length"
    np.testing.assert_allclose(0.4 * (1 + found.coefficient), robot.length, rtol=1e-9)
    assert left(model, knowledge, robot) < 1e-8


def test_a_wrong_stiffness_is_a_stress_in_proportion_to_strain(robot):
    knowledge = robot.replace(youngs_modulus=10e9)
    model = learned(knowledge, recorded(robot))
    missing = np.asarray(robot.Kbt - knowledge.Kbt)
    found = findings(model)
    assert {part for part, _, _ in found} == {"stress"}
    for i, axis in enumerate("xyz"):
        np.testing.assert_allclose(found["stress", f"u_{axis}", f"u_{axis}"], missing[i, i], rtol=1e-6)
    assert left(model, knowledge, robot) < 1e-8


def test_a_missing_weight_is_an_ambient_load(robot):
    model = learned(robot.replace(gravity=(0, 0, 0)), recorded(robot))
    [found] = explain(model)
    # n_s = … - ρA g: without it the weight per length is missing
    assert (found.part, found.target, found.function) == ("load*", "n_z", "1")
    np.testing.assert_allclose(found.coefficient, 9.81 * robot.mass_per_length, rtol=1e-7)


@pytest.mark.campaign
def test_a_missing_tip_mass_is_weighed(robot):
    truth = like(robot, truths.TipMass)
    model = learned(robot, recorded(truth))
    found = findings(model)
    for axis in "xyz":
        mass = -found["tip", f"n_{axis}", f"acceleration_{axis}"]
        np.testing.assert_allclose(mass, 0.01, rtol=1e-5)
    np.testing.assert_allclose(found["tip*", "n_z", "1"], -0.01 * 9.81, rtol=1e-6)
    assert len(found) == 4
    assert left(model, robot, truth) < 1e-7


@pytest.mark.campaign
def test_what_is_learned_does_not_depend_on_the_time_step(robot):
    truth = robot.replace(bending_damping=0.2, youngs_modulus=5e9)
    model = learned(robot, recorded(truth))
    controls = kc.controls.sine(1.5, 100, 0.02)
    assert left(model, robot, truth, controls, 0.02) < 1e-8


@pytest.mark.campaign
@pytest.mark.parametrize(("kind", "part"), [("Stiffening", 1e-6), ("InternalFriction", 5e-3)])
def test_a_law_that_is_not_linear(robot, kind, part):
    """A power is in the library; a saturation between its slopes is a sum of several functions."""
    truth = like(robot, getattr(truths, kind))
    model = learned(robot, recorded(truth))
    assert model.residual.stress.curved
    assert left(model, robot, truth) < part


def test_nothing_is_found_where_nothing_is_missing(robot):
    model = learned(robot, recorded(robot))
    assert explain(model) == []
    assert model.residual.stress is model.residual.load is model.residual.tip_load is None


def test_ten_rows_of_one_sine_are_enough(robot):
    knowledge = robot.replace(length=0.4, youngs_modulus=10e9)
    model = learned(knowledge, recorded(robot, 10, (1.0,)))
    assert left(model, knowledge, robot) < 1e-7


@pytest.mark.campaign
def test_noise_does_not_make_terms_up(robot):
    """A thousandth of each number's spread on all states: the weight is found, and little else."""
    knowledge = robot.replace(gravity=(0, 0, 0))
    rng = np.random.default_rng(0)

    def noisy(trajectory):
        y, z = np.array(trajectory.y), np.array(trajectory.z)
        y += 1e-3 * y.std((0, 1)) * rng.normal(size=y.shape)
        z += 1e-3 * z.std((0, 1)) * rng.normal(size=z.shape)
        return dataclasses.replace(trajectory, y=y, z=z)

    model = learned(knowledge, [noisy(one) for one in recorded(robot)])
    assert len(explain(model)) <= 12
    assert left(model, knowledge, robot) < 0.05


@pytest.mark.campaign
def test_segments_that_are_not_one_euler_step():
    """A bar's y_s comes from splines, and what they give first is polished on the segments."""
    bar = BAR.replace(nodes=12, drag=0.0)
    wrong = bar.replace(density=1.5, stiffness=30.0)
    data = [pulled(period, 20, bar, space="lobatto4") for period in (1.0, 0.7)]
    model = learned(wrong, data)
    unseen = 1.5 * np.cos(np.arange(1, 31) * 0.15)[:, None]
    before, after, true = (
        kc.simulate(system, unseen, 0.1, space="lobatto4").y for system in (wrong, model, bar)
    )
    assert np.max(np.abs(after - true)) < 1e-6 * np.max(np.abs(before - true))


@pytest.mark.campaign
def test_segments_of_the_robot_that_are_not_one_euler_step(robot):
    knowledge = robot.replace(length=0.4, youngs_modulus=10e9)
    model = learned(knowledge, recorded(robot, space="lobatto4"))
    assert left(model, knowledge, robot, space="lobatto4") < 1e-7


@pytest.mark.campaign
def test_derivatives_of_an_implicit_law(robot):
    """∂z/∂y of the corrected strains against differences."""
    model = learned(robot, recorded(like(robot, truths.Stiffening)))
    trajectory = recorded(robot, 4, (1.0,))[0]
    y = jnp.asarray(trajectory.y[3, 4])
    history = History(jnp.array(30.0), -30.0 * y, -30.0 * jnp.asarray(trajectory.z[2, 4]), jnp.zeros(19))

    @jax.jit
    def strains(y):
        return semi_discrete.strains(model, Point(0.1, 0.0, y, jnp.zeros(4), history))

    exact = jax.jit(jax.jacfwd(strains))(y)
    step = 1e-5 * np.asarray(robot.scales().y)
    for k in range(3, 13):
        h = np.zeros(19)
        h[k] = step[k]
        difference = (strains(y + h) - strains(y - h)) / (2 * step[k])
        np.testing.assert_allclose(exact[:, k], difference, rtol=1e-6, atol=1e-7 * np.abs(exact).max())


@pytest.mark.campaign
def test_a_system_of_ones_own_learns_too():
    """The string, whose layouts say nothing of loads and whose B is not zero: a wrong drag of the air."""
    dt, rest = 0.02, np.array([0.6, 0.0])
    string = HangingString(length=1.0, density=0.1, stiffness=1e3, friction=0.05, nodes=21)
    truth = string.replace(friction=0.15)

    def swung(system, period):
        t = np.arange(1, 61) * dt
        hand = np.stack([0.6 + 0.05 * np.sin(2 * np.pi * t / period), 0 * t], axis=1)
        hanging = kc.equilibrium(system, rest, space="lobatto4")
        return kc.simulate(system, hand, dt, space="lobatto4", initial=hanging)

    model = learned(string, [swung(truth, 1.0)])
    true, base, ours = (np.asarray(swung(one, 0.7).part("p")) for one in (truth, string, model))
    assert np.abs(ours - true).max() < 0.1 * np.abs(base - true).max()


@pytest.mark.campaign
def test_a_mirrored_robot_learns_the_mirror_image(robot):
    """Tendons and data mirrored in the plane y = x: the same model, mirrored."""
    knowledge = robot.replace(youngs_modulus=5e9, gravity=(1.0, 0.5, -9.0))
    truth = robot.replace(gravity=(0.0, 0.0, -9.81))
    mirrored = {"tendon_angles": np.pi / 2 - np.asarray(robot.tendon_angles)}
    model = learned(knowledge, recorded(truth))
    image = learned(
        knowledge.replace(gravity=(0.5, 1.0, -9.0), **mirrored), recorded(truth.replace(**mirrored))
    )
    one, other = (np.asarray(kc.simulate(each, UNSEEN, DT).tip_position) for each in (model, image))
    np.testing.assert_allclose(one[:, [1, 0, 2]], other, atol=1e-7)
