"""Losses, the part of a prediction that no weight changes, and the epochs of gradient training."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.learning.config import NetworkOptions, Training
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.residual import Network, Residual, elu, network
from knode_cosserat.learning.training import descent as program
from knode_cosserat.learning.training.descent import (
    PaperLoss,
    StandardisedLoss,
    euler_angles,
    loss_for,
    value_scales,
)
from knode_cosserat.learning.training.runs import ProgressMonitor, split
from knode_cosserat.solvers.segments import predict_segment, samples
from tests.learning.bar import BAR, WRONG, pulled

DT = 0.05


@pytest.fixture(scope="module")
def robot():
    return kc.load_robot("delrin-tendon-robot")


@pytest.fixture(scope="module")
def moved(robot):
    """Two trajectories of different lengths."""
    return [
        kc.simulate(robot, kc.controls.sine(period, 8, DT), DT)[:rows]
        for period, rows in ((0.5, 8), (1.0, 6))
    ]


# losses


def test_euler_angles_are_those_of_scipy():
    h = np.random.default_rng(0).normal(size=(4, 200))
    expected = Rotation.from_quat(np.roll(h, -1, axis=0).T).as_euler("zyx").T
    np.testing.assert_allclose(euler_angles(jnp.asarray(h)), expected, atol=1e-12)


def test_paper_loss_is_that_of_the_paper(robot, moved):
    """Step by step as the paper has it: four means, averaged over steps, summed over trajectories."""
    imperfect = robot.replace(length=0.4, youngs_modulus=10e9)
    data = samples(imperfect, moved, nodes=(3, 5, 7, 9))
    y, z = map(np.asarray, _alone(imperfect, data))
    expected = 0.0
    for k, trajectory in enumerate(moved):
        steps = []
        for row in range(1, len(trajectory.time)):
            here = np.all(data.segments.origin == [k, row], axis=1)
            found, truth = y[here], trajectory.y[row, [3, 5, 7, 9]]
            angles = [
                Rotation.from_quat(np.roll(h[:, 3:7], -1, axis=1)).as_euler("zyx") for h in (found, truth)
            ]
            steps.append(
                np.mean((found[:, :3] - truth[:, :3]) ** 2)
                + np.mean((found[:, 7:] - truth[:, 7:]) ** 2)
                + np.mean((angles[0] - angles[1]) ** 2)
                + np.mean((z[here] - trajectory.z[row, [2, 4, 6, 8]]) ** 2)
            )
        expected += np.mean(steps)
    loss = loss_for("paper", imperfect, data.segments)
    assert isinstance(loss, PaperLoss) and expected > 1e-4
    np.testing.assert_allclose(loss(y.T, z.T), expected, rtol=1e-12)


def test_standardised_loss_of_the_mean_is_one(bars):
    """Whoever predicts every increment by its mean is off by one standard deviation."""
    segments = samples(BAR, bars).segments
    loss = loss_for("paper", BAR, segments)
    assert isinstance(loss, StandardisedLoss)  # y of a bar has no orientation: the paper's is not defined
    y = segments.y + np.mean(segments.y_next - segments.y, axis=0)
    z = np.broadcast_to(np.mean(segments.z, axis=0), segments.z.shape)
    np.testing.assert_allclose(loss(y.T, z.T), 2.0, rtol=1e-12)  # one for each trajectory
    np.testing.assert_allclose(loss(segments.y_next.T, segments.z.T), 0.0)


def test_spread_is_never_zero():
    rng = np.random.default_rng(0)
    values = np.zeros((100, 7))
    values[:, :2] = rng.normal(size=(100, 2)) * [1.0, 1e-9]  # a number that hardly varies beside its field
    values[:, 3:5] = 1.0 + 1e-16 * rng.normal(size=(100, 2))  # rounding about one
    values[:, 5:7] = rng.normal(size=(100, 2)) * 1e-6
    found = value_scales(values, [3, 2, 2])
    deviation = np.std(values, axis=0)
    np.testing.assert_allclose(found[[0, 5, 6]], deviation[[0, 5, 6]])
    np.testing.assert_allclose(found[[1, 2]], 1e-3 * deviation[0])
    np.testing.assert_allclose(found[3:5], 1.0)


# predictions


def test_elu_and_its_derivative():
    x = np.concatenate([np.linspace(-30.0, 30.0, 301), [0.0, -1e-12, 1e-12]])
    np.testing.assert_allclose(elu(x), jax.nn.elu(x), atol=1e-15, rtol=1e-15)
    slope, expected = (jax.vmap(jax.grad(function))(x) for function in (elu, jax.nn.elu))
    np.testing.assert_allclose(slope, expected, atol=1e-15)
    twice, expected = (jax.vmap(jax.grad(jax.grad(function)))(x[x != 0]) for function in (elu, jax.nn.elu))
    np.testing.assert_allclose(twice, expected, atol=1e-15)


@pytest.mark.campaign
@pytest.mark.parametrize("system", ["robot", "bar with history"])
def test_what_no_weight_changes_is_found_once(robot, moved, bars, system):
    """Prediction and gradient are those of `predict` on the KNODE, sample by sample."""
    imperfect, known_of = (robot.replace(length=0.4), moved) if system == "robot" else (WRONG, bars)
    data = samples(imperfect, known_of)
    options = NetworkOptions(
        hidden=9, history="history" in system, convex=False, standardised=True, unit_quaternions=True
    )
    net = network(imperfect, options, jax.random.key(1), np.asarray(1.5 / DT))
    net = program.standardised(net, imperfect, data)
    size = imperfect.y_layout.size + imperfect.z_layout.size
    target = jnp.asarray(np.random.default_rng(0).normal(size=(size, len(data.segments.t))))

    def fast(net):
        known = program.nominal_predictions(net, imperfect, data.segments, data.space)
        return jnp.concatenate(program.corrected(net, known))

    def slow(net):
        model = KNODE(imperfect, net)
        return jnp.concatenate(
            jax.vmap(lambda one: predict_segment(model, data.space, one), out_axes=-1)(data.segments)
        )

    def found(predicted):
        def total(net):
            values = predicted(net)
            return jnp.sum(values * target), values

        # the derivative too where it compiles fast
        if system == "robot":
            return jax.jit(total)(net)[1], None
        (_, values), slope = jax.jit(jax.value_and_grad(total, has_aux=True))(net)
        return values, slope

    both = found(fast), found(slow)
    for one, other in zip(*map(jax.tree.leaves, both), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-11 * np.max(np.abs(other)) + 1e-30)
    without = np.concatenate([part.T for part in _alone(imperfect, data)])
    assert np.max(np.abs(both[0][0] - without)) > 1e-6


@functools.partial(jax.jit, static_argnums=1)
def _predicted(system, space, segments):
    return jax.vmap(lambda one: predict_segment(system, space, one))(segments)


def _alone(system, data):
    return _predicted(system, data.space, data.segments)


def test_standardised_inputs_have_mean_zero_and_spread_one(bars):
    data = samples(WRONG, bars)
    net = network(WRONG, NetworkOptions(hidden=4, convex=False), jax.random.key(0))
    scaled = program.standardised(net, WRONG, data)
    known = program.nominal_predictions(scaled, WRONG, data.segments, kc.solvers.Euler())
    np.testing.assert_allclose(np.mean(known.inputs[:-1], axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.std(known.inputs[:-1], axis=1), 1.0)
    # an output of one is as large as what the knowledge lacks: z is off by n (1/EA - 1/EA'), and damping
    y, z = _alone(WRONG, data)
    lacking = np.concatenate([(data.segments.y_next - y) * 5.0, data.segments.z - z], axis=1)
    np.testing.assert_allclose(scaled.output_scale, np.sqrt(np.mean(lacking**2, axis=0)), rtol=1e-9)


class Inner(eqx.Module):
    fixed = ("size",)
    size: jax.Array
    gain: jax.Array


class Nested(Residual):
    inner: Inner
    parts: tuple


def test_weights_are_what_is_not_fixed():
    tree = Nested(Inner(jnp.ones(2), jnp.ones(3)), (jnp.ones(4), jnp.arange(5), {"a": np.ones(6)}))
    weights, rest = split(tree)
    assert sorted(leaf.shape[0] for leaf in jax.tree.leaves(weights)) == [3, 4, 6]
    assert sorted(leaf.shape[0] for leaf in jax.tree.leaves(rest)) == [2, 5]
    net = network(BAR, NetworkOptions(hidden=4), jax.random.key(0))
    weights, _ = split(net)
    names = ("input_weights", "input_biases", "output_weights", "output_biases")
    assert [getattr(weights, name) is getattr(net, name) for name in names] == [True] * 4
    assert len(jax.tree.leaves(weights)) == 4


# epochs


def trained(data, net, training):
    """Weights, losses and rates after all epochs."""
    run = program.SegmentRun(training, data, None, KNODE(WRONG, net), 0)
    with ProgressMonitor(False, None) as watch:
        watch.begin("", run.steps, 0)
        while not run.finished:
            run.advance(run.steps, watch)
    return run.state.weights, run.losses, run.rates


def small(seed=0, **options):
    return network(WRONG, NetworkOptions(hidden=6, **{"convex": False} | options), jax.random.key(seed))


@pytest.mark.parametrize("convex", [True, False])
def test_an_epoch_is_a_step_of_adam(bars, convex):
    """Against optax.adamw on the loss of `predict` alone: no precomputation."""
    data = samples(WRONG, bars, nodes=(2, 5))
    net = small(convex=convex)
    training = Training(epochs=7, learning_rate=0.03, weight_decay=0.1, schedule="constant", nodes=(2, 5))
    weights, losses, _ = trained(data, net, training)
    loss = loss_for("standardised", WRONG, data.segments)

    def slow(weights):
        model = KNODE(WRONG, eqx.combine(weights, rest))
        return loss(
            *jax.vmap(lambda one: predict_segment(model, data.space, one), out_axes=-1)(data.segments)
        )

    expected, rest = split(net)
    optimiser = optax.adamw(0.03, weight_decay=0.1, mask=lambda w: jax.tree.map(lambda x: x.ndim > 1, w))
    state, slope = optimiser.init(expected), jax.jit(jax.value_and_grad(slow))
    for epoch in range(7):
        value, gradient = slope(expected)
        np.testing.assert_allclose(losses[epoch], value, rtol=1e-9)
        updates, state = optimiser.update(gradient, state, expected)
        expected = optax.apply_updates(expected, updates)
        if convex:
            for name in ("input_weights", "output_weights"):
                kept = np.maximum(getattr(expected, name), 0.0)
                expected = eqx.tree_at(lambda w, name=name: getattr(w, name), expected, jnp.asarray(kept))
    for found, wanted in zip(jax.tree.leaves(weights), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-7, atol=1e-10)
    if convex:
        assert np.min(weights.input_weights) == 0.0 and np.min(weights.input_biases) < 0.0


def test_plateau_is_that_of_pytorch():
    """A transcription of torch.optim.lr_scheduler.ReduceLROnPlateau(mode="min"), on losses with rests."""
    rng = np.random.default_rng(0)
    losses = np.minimum.accumulate(rng.exponential(size=400)) * (1.0 + 1e-4 * rng.normal(size=400))
    losses[100:200] = losses[100] * (1.0 - 0.9e-4) ** np.arange(100)  # falls, but never by enough at once
    numbers = {"patience": 7, "factor": 0.5}
    rate, best, bad = 0.01, np.inf, 0
    state = (jnp.array(0.01), jnp.array(np.inf), jnp.array(0))
    step = jax.jit(program.plateau)
    for loss in losses:
        state = step(numbers, loss, *state)
        if loss < best * (1.0 - 1e-4):
            best, bad = loss, 0
        else:
            bad += 1
        if bad > 7:
            rate, bad = rate * 0.5, 0
        assert float(state[0]) == rate and int(state[2]) == bad
    assert rate < 0.01 * 0.5**5


def test_cosine_goes_down_to_zero(bars):
    _, _, rates = trained(samples(WRONG, bars), small(), Training(epochs=60, schedule="cosine"))
    np.testing.assert_allclose(rates, 0.005 * (1.0 + np.cos(np.pi * np.arange(60) / 60)))


def test_it_learns(bars):
    data = samples(WRONG, bars)
    net = program.standardised(small(), WRONG, data)
    _, losses, _ = trained(data, net, Training(epochs=400))
    assert losses[-1] < 1e-2 * losses[0]


@pytest.mark.parametrize("space", ["lobatto4", "lobatto2"])
def test_any_scheme_and_any_residual(bars, space):
    """Where a prediction is more than the knowledge's and something added, it is made anew in each epoch."""
    swing = pulled(1.0, space=space) if space == "lobatto4" else bars[0]
    data = samples(WRONG, [swing])
    residual = small() if space == "lobatto4" else Softer(jnp.zeros(()))
    weights, losses, _ = trained(data, residual, Training(epochs=250, learning_rate=0.02))
    assert losses[-1] < 0.1 * losses[0]
    if isinstance(residual, Softer):
        # what remains is the drag
        np.testing.assert_allclose(weights.softness, 0.5, rtol=0.02)


class Softer(Residual):
    """The knowledge with another stiffness: not something added to its y_s."""

    softness: jax.Array

    def adapted(self, knowledge):
        return dataclasses.replace(knowledge, stiffness=knowledge.stiffness / (1.0 + self.softness))


def test_first_weights_are_as_the_paper_has_them(robot):
    net = network(robot, NetworkOptions(hidden=512), jax.random.key(0))
    assert (
        isinstance(net, Network)
        and net.input_weights.shape == (512, 28)
        and net.output_weights.shape == (25, 512)
    )
    for weights in (net.input_weights, net.output_weights):
        assert np.min(weights) >= 0.0
        # the mean of |N(0.01, 0.01)|: 0.01 (√(2/π) e^(-1/2) + erf(1/√2))
        np.testing.assert_allclose(np.mean(weights), 0.011666, rtol=0.02)
    np.testing.assert_allclose(np.std(net.input_biases), 0.01, rtol=0.1)
    assert network(robot, NetworkOptions(hidden=8, history=True), jax.random.key(0)).input_weights.shape == (
        8,
        53,
    )
