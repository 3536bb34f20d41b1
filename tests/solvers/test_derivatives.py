"""Derivatives of a simulation against finite differences; the same eagerly, compiled, and in batches."""

import functools
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc

DT = 0.05
RELATIVE = 1e-5
#: the paper's robot, in a gravity that pulls sideways too, so that every parameter matters
PARAMETERS = {
    "length": 0.635,
    "radius": 0.003175,
    "density": 1411.6751,
    "youngs_modulus": 2.757903e9,
    "shear_damping": 1e3,
    "bending_damping": 0.03,
    "drag": 0.02,
    "gravity": np.array([1.5, -2.0, -9.0]),
    "tendon_angles": np.array([0.8, 2.3, 3.9, 5.5]),
}


def numerically(function, at, along):
    """The derivative along a direction from four values: an error of order h⁴, and little noise."""
    h = 1e-3

    def value(steps):
        return float(function(jax.tree.map(lambda x, dx: x + steps * h * dx, at, along)))

    return (8 * (value(1) - value(-1)) - (value(2) - value(-2))) / (12 * h)


def directions(at, seed=0):
    """By name, for every entry a direction in which it alone changes, by a part of its own size."""
    rng = np.random.default_rng(seed)
    for name in at:
        along = {key: np.zeros(np.shape(value)) for key, value in at.items()}
        along[name] = at[name] * rng.uniform(0.5, 1.0, np.shape(at[name]))
        yield name, along


def along_gradient(gradient, along):
    return float(sum(np.sum(gradient[key] * along[key]) for key in along))


def weighed(trajectory, scales):
    """A number in which every state and strain of every row has its own weight."""
    y, z = trajectory.y[1:] / scales, trajectory.z[1:]
    rng = np.random.default_rng(2)
    weights = [rng.normal(size=part.shape) for part in (y, z)]
    return jnp.mean(y * weights[0] + y**2) + jnp.mean(z * weights[1] + z**2)


def assert_equal_trees(found, expected):
    for name in expected:
        size = np.abs(expected[name]).max()
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=1e-11 * size, err_msg=name)


# the paper's robot


def robot_loss(nodes, **options):
    """A function of all of `PARAMETERS` and of the tensions."""
    robot = kc.load_robot("delrin-tendon-robot").replace(nodes=nodes)
    scales = np.asarray(robot.scales().y)

    def loss(at):
        changed = robot.replace(**{name: at[name] for name in PARAMETERS})
        return weighed(kc.simulate(changed, at["tension"], DT, **options), scales)

    return loss


@pytest.mark.slow
def test_gradient_of_the_robot():
    at = {**PARAMETERS, "tension": kc.controls.random(100, seed=5)}
    loss = robot_loss(nodes=10)
    value, gradient = jax.jit(jax.value_and_grad(loss))(at)
    assert value == pytest.approx(float(loss(at)), rel=1e-9)
    for name, along in directions(at):
        expected = numerically(loss, at, along)
        assert along_gradient(gradient, along) == pytest.approx(expected, rel=RELATIVE, abs=0), name


# Compiling takes most of a minute; of the quick tests, one does the same with the bar below.
@pytest.mark.campaign
def test_gradient_and_tangent_of_the_robot_by_other_schemes():
    at = {**PARAMETERS, "tension": kc.controls.random(8, seed=5)}
    loss = robot_loss(nodes=6, time="bdf-alpha", space="lobatto4", start="consistent")
    gradient = jax.jit(jax.grad(loss))(at)
    tangent = jax.jit(lambda at, along: jax.jvp(loss, (at,), (along,)))
    for name, along in directions(at):
        expected = numerically(loss, at, along)
        assert along_gradient(gradient, along) == pytest.approx(expected, rel=RELATIVE, abs=0), name
        assert float(tangent(at, along)[1]) == pytest.approx(expected, rel=RELATIVE, abs=0), name


# a small system, quick to compile: whatever else can be asked of derivatives


class Bar(kc.System):
    """A bar that only stretches, softer the more it does, damped, with drag, under a load along it (N/m)."""

    y_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout(
        ("p", 1, "m", "position"), ("n", 1, "N", "force"), ("q", 1, "m/s", "velocity")
    )
    z_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout(("v", 1, "1", "stretch"))
    control_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout(("load", 1, "N/m", "load"))
    base_unknowns: ClassVar[tuple[str, ...]] = ("n",)
    mixed: ClassVar[bool] = False

    length: Any = 1.0
    mass: Any = 1.0
    softness: Any = 0.8
    softening: Any = 0.3
    damping: Any = 0.2
    drag: Any = 0.5
    nodes: int = eqx.field(static=True, default=8)

    def constitutive(self, s, t, y, y_t, control):
        n = y[1:2]
        stretch = 1.0 + self.softness * n + self.softening * n**3
        return jnp.eye(1), self.damping * jnp.eye(1), stretch

    def balance(self, s, t, y, y_t, z, z_t, control):
        q = y[2]
        n_s = self.mass * y_t[2] + self.drag * q * jnp.abs(q) - control[0]
        return jnp.stack([z[0], n_s, z_t[0]])

    def rest(self, s):
        return jnp.stack([s, jnp.zeros(()), jnp.zeros(())]), jnp.ones(1)

    def tip(self, t, control, y, y_t):
        return self.y_layout.get(y, "n")


BAR = {name: getattr(Bar(), name) for name in ("length", "mass", "softness", "softening", "damping", "drag")}
LOADS = np.sin(np.arange(3 * 8).reshape(3, 8, 1))
ONE = {**BAR, "load": LOADS[0]}


def bar_loss(at, **options):
    bar = Bar(**{name: at[name] for name in BAR})
    return weighed(kc.simulate(bar, at["load"], 0.2, **options), np.ones(3))


bar_gradient = jax.jit(jax.grad(bar_loss))


@pytest.mark.campaign
def test_gradient_by_other_schemes():
    @jax.jit
    @jax.value_and_grad
    def loss(at):
        return bar_loss(at, time="bdf-alpha", space="lobatto4", start="consistent")

    _, gradient = loss(ONE)
    for name, along in directions(ONE):
        expected = numerically(lambda at: loss(at)[0], ONE, along)
        assert along_gradient(gradient, along) == pytest.approx(expected, rel=RELATIVE, abs=0), name


@pytest.mark.campaign
def test_compiled_gradient_is_the_eager_one():
    assert_equal_trees(jax.grad(bar_loss)(ONE), bar_gradient(ONE))


@pytest.mark.campaign
def test_tangent_is_along_the_gradient():
    along = {name: np.asarray(value) * 0.3 for name, value in ONE.items()}
    value, tangent = jax.jvp(bar_loss, (ONE,), (along,))
    assert float(value) == pytest.approx(float(bar_loss(ONE)), rel=1e-12)
    assert float(tangent) == pytest.approx(along_gradient(bar_gradient(ONE), along), rel=1e-11)


#: robots that are solved side by side differ by the residual that is left
PRECISE = {"newton": kc.solvers.NewtonOptions(tolerance=1e-13)}
precise_loss = functools.partial(bar_loss, **PRECISE)


def each_by_itself(many):
    """The gradients of several bars with their loads."""
    gradient = jax.jit(jax.grad(precise_loss))
    each = [gradient({name: value[i] for name, value in many.items()}) for i in range(3)]
    return {name: np.stack([one[name] for one in each]) for name in many}


FACTORS = np.array([1.0, 0.9, 1.2])
MANY = {**{name: value * FACTORS for name, value in BAR.items()}, "load": LOADS}


@pytest.mark.campaign
def test_gradient_of_a_batch_is_each_by_itself():
    def loss(many):
        bars = [Bar(**{name: many[name][i] for name in BAR}) for i in range(3)]
        batch = kc.simulate(bars, many["load"], 0.2, **PRECISE)
        return sum(weighed(batch[i], np.ones(3)) for i in range(3))

    assert_equal_trees(jax.jit(jax.grad(loss))(MANY), each_by_itself(MANY))


@pytest.mark.campaign
def test_mapped_gradients_are_each_by_itself():
    assert_equal_trees(jax.jit(jax.vmap(jax.grad(precise_loss)))(MANY), each_by_itself(MANY))


def test_gradient_through_equilibrium():
    def tip(at):
        bar = Bar(**{name: at[name] for name in BAR})
        return kc.equilibrium(bar, at["load"]).part("p")[0, -1, 0]

    def sum_of_segments(at):
        # of the trapezoidal rule: each stretched as the mean of its ends, where n = f (L - s)
        n = at["load"][0] * at["length"] * (1 - jnp.arange(8) / 7)
        v = 1 + at["softness"] * n + at["softening"] * n**3
        return jnp.sum(v[:-1] + v[1:]) / 2 * at["length"] / 7

    at = {**BAR, "load": jnp.array([0.7])}
    value, found = jax.jit(jax.value_and_grad(tip))(at)
    expected_value, expected = jax.value_and_grad(sum_of_segments)(at)
    assert float(value) == pytest.approx(float(expected_value), rel=1e-12)
    for name in at:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-10, atol=1e-12, err_msg=name)


@pytest.mark.campaign
def test_derivatives_go_through_a_tendon_that_goes_slack():
    robot = kc.load_robot("delrin-routed-tendon-robot").replace(drive="reel", nodes=8)
    reels = np.zeros((12, 4))
    reels[:, 0] = 0.01 * np.sin(np.arange(12))
    # slack in some rows and taut in others, and nothing recovered: what was would be NaN here
    motion = kc.simulate(robot, reels, 0.05)
    assert set(np.asarray(motion.result)) == {0}
    assert np.min(motion.part("tension")[1:, 0, 0]) < 1e-5 and np.max(motion.part("tension")[:, 0, 0]) > 100.0

    def tip(part):
        return kc.simulate(robot, part * reels, 0.05).tip_position[-1, 0]

    h = 1e-5
    slope = (tip(1.0 + h) - tip(1.0 - h)) / (2.0 * h)
    # the solver's tolerance over h is 1e-7 of the length
    np.testing.assert_allclose(jax.grad(tip)(1.0), slope, rtol=1e-5)


class Labelled(kc.robots.SlenderRod):
    """A rod with a parameter that holds no numbers, as learned residuals may have."""

    nothing: Any = eqx.field(default_factory=lambda: np.zeros(0), kw_only=True)


def test_a_parameter_without_numbers_has_a_gradient():
    rod = Labelled(length=0.3, radius=0.002, density=2e3, youngs_modulus=1e9, bending_damping=1e-4)
    controls = np.zeros((2, 0))
    slopes = jax.grad(lambda rod: kc.simulate(rod, controls, 0.02).tip_position[-1, 2])(rod)
    assert np.shape(slopes.nothing) == (0,) and np.all(np.isfinite(slopes.length))
