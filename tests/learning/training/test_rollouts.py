"""Whole simulations as what is learned from: the loss, its gradient, and fine-tuning."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.learning.config import (
    FitConfig,
    FitError,
    NetworkOptions,
    RolloutTraining,
    StructuredOptions,
)
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.residual import network
from knode_cosserat.learning.states import fit_states
from knode_cosserat.learning.training import rollouts as module
from knode_cosserat.learning.training.rollouts import (
    RolloutRun,
    held_out_error,
    loss_and_slope,
    trajectory_batches,
)
from knode_cosserat.learning.training.runs import ProgressMonitor, split
from knode_cosserat.solvers.segments import DataError
from tests.learning.bar import BAR, WRONG, pulled

OPTIONS = RolloutTraining(horizon=6, updates=60, learning_rate=5e-3)


@pytest.fixture(scope="module")
def residual():
    net = network(WRONG, NetworkOptions(hidden=5, convex=False), jax.random.key(0))
    return dataclasses.replace(net, output_scale=jnp.full(4, 0.3, dtype=float))


def evaluated(batches, residual):
    return loss_and_slope(*split(residual), WRONG, batches)


def only_positions(trajectory):
    """A trajectory of which nothing but the positions is known."""
    y = np.array(trajectory.y)
    y[:, :, 1:] = np.nan
    return dataclasses.replace(trajectory, y=y, z=np.full(np.shape(trajectory.z), np.nan))


@pytest.mark.slow
def test_loss_and_gradient(bars, residual):
    """The loss by `simulate` and NumPy; the gradient by finite differences along random directions."""
    along = trajectory_batches(WRONG, [only_positions(each) for each in bars], OPTIONS)
    value, slope = evaluated(along, residual)
    model, squares, paths = KNODE(WRONG, residual), [], []
    for each in bars:
        found = kc.simulate(model, each.control[1:7], each.dt)
        squares.append((found.part("p")[1:] - each.part("p")[1:7]) ** 2)
        paths.append(each.part("p")[:7])
    spread = np.mean([np.var(path, axis=0) for path in paths])
    np.testing.assert_allclose(value, np.mean(squares) / spread, rtol=1e-6)
    assert value > 1e-3
    rng = np.random.default_rng(0)
    for _ in range(2):
        ways = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), slope)
        step = 1e-5
        ends = [float(evaluated(along, _moved(residual, ways, sign * step))[0]) for sign in (1.0, -1.0)]
        along_it = sum(np.sum(a * b) for a, b in zip(*map(jax.tree.leaves, (slope, ways)), strict=True))
        np.testing.assert_allclose((ends[0] - ends[1]) / (2.0 * step), along_it, rtol=1e-4)


def _moved(residual, ways, step):
    weights, rest = split(residual)
    weights = jax.tree.map(lambda leaf, way: leaf + step * way, weights, ways)
    return jax.tree.map(lambda a, b: b if a is None else a, weights, rest, is_leaf=lambda x: x is None)


@pytest.mark.slow
def test_one_program_for_trajectories_of_one_length(bars, residual):
    """Two lengths are two parts, each trajectory counting one; more of the same length trace nothing anew."""
    both = trajectory_batches(WRONG, [bars[0], bars[1][:5], bars[1]], RolloutTraining())
    assert [part.control.shape for part in both.parts] == [(2, 20, 1), (1, 4, 1)]
    one = evaluated(trajectory_batches(WRONG, bars, OPTIONS), residual)[0]
    before = loss_and_slope._cache_size()
    other = evaluated(trajectory_batches(WRONG, bars[::-1], OPTIONS), residual)[0]
    assert loss_and_slope._cache_size() == before
    np.testing.assert_allclose(one, other, rtol=1e-9)


def test_a_quaternion_is_compared_up_to_its_sign_and_length():
    rng = np.random.default_rng(0)
    h, other = rng.normal(size=(2, 50, 4))
    error = module._difference("h", h, other)
    for same in (-other, 3.0 * other):
        np.testing.assert_allclose(module._difference("h", h, same), error, atol=1e-14)
    np.testing.assert_allclose(module._difference("h", h, -2.0 * h), 0.0, atol=1e-15)
    # half the angle between the two, as the chord: 2 sin(θ/4)
    cosine = np.abs(np.sum(h * other, axis=1)) / np.linalg.norm(h, axis=1) / np.linalg.norm(other, axis=1)
    np.testing.assert_allclose(
        np.linalg.norm(error, axis=1), 2.0 * np.sin(np.arccos(cosine) / 2.0), rtol=1e-9
    )


@pytest.mark.slow
def test_held_out_error_is_that_of_simulate(bars, residual):
    model = KNODE(WRONG, residual)
    shorter = pulled(0.7)[:9]
    expected = []
    for each in (bars[0], shorter):
        found = kc.simulate(model, each.control[1:], each.dt)
        expected.append(np.sqrt(np.mean((found.tip_position - each.tip_position) ** 2)))
    error = held_out_error(WRONG, [only_positions(bars[0]), shorter])
    np.testing.assert_allclose(error(model), np.mean(expected), rtol=1e-9)
    assert held_out_error(WRONG, []) is None
    broken = dataclasses.replace(residual, output_biases=residual.output_biases + np.nan)
    assert error(KNODE(WRONG, broken)) == np.inf


# fine-tuning


def simulated_error(model, trajectory):
    it = trajectory.settings
    found = kc.simulate(model, trajectory.control[1:], trajectory.dt, time=it.time, start=it.start)
    return float(np.sqrt(np.mean((found.part("p") - trajectory.part("p")) ** 2)))


@pytest.mark.slow
def test_it_learns_from_positions_alone():
    """Nothing is known of forces, velocities and strains, and there is no stage before."""
    # of half as many rows what is learned, and so the error, is a matter of rounding
    options = dataclasses.replace(OPTIONS, horizon=12, updates=400, learning_rate=0.02)
    config = FitConfig(NetworkOptions(hidden=5, convex=False), None, options)
    # stages are not known in measured rows, whose rates are differences of the rows
    moved = {period: pulled(period, time="bdf2", start="paper") for period in (1.0, 0.7, 1.4)}
    model = fit_states(WRONG, [only_positions(moved[period]) for period in (1.0, 0.7)], config)
    history = model.about.facts["rollouts"]
    assert history["loss"].shape == (401,) and history["learning_rate"].shape == (400,)
    assert history["loss"].min() < 1e-5 * history["loss"][0]
    # also of the rows after those that it saw, and of a motion that it has not seen
    for truth in moved.values():
        assert simulated_error(model, truth) < 0.2 * simulated_error(WRONG, truth)


@pytest.mark.campaign
def test_any_residual_is_fine_tuned(bars):
    """A structured one that may only use linear functions, and so cannot have the square of the drag."""
    config = FitConfig(
        StructuredOptions(curved=False), None, dataclasses.replace(OPTIONS, learning_rate=1e-3)
    )
    model = fit_states(WRONG, bars, config)
    loss = model.about.facts["rollouts"]["loss"]
    assert loss[0] > 1e-9 and loss.min() < 0.7 * loss[0]
    found, _ = evaluated(trajectory_batches(WRONG, bars, OPTIONS), model.residual)
    np.testing.assert_allclose(found, loss.min(), rtol=1e-9)


class Bumpy:
    """Stands in for the loss: a parabola that cannot be simulated beyond a wall."""

    def __init__(self, wall):
        self.wall = wall
        self.calls = []

    def __call__(self, run, weights):
        x = weights.input_biases
        self.calls.append(np.array(x))
        if np.any(x > self.wall):
            return float("nan"), jax.tree.map(lambda leaf: leaf * np.nan, weights)
        slope = dataclasses.replace(jax.tree.map(jnp.zeros_like, weights), input_biases=2.0 * (x - 1.0))
        return float(np.sum((x - 1.0) ** 2)), slope


def bumpy_run(bars, residual, monkeypatch, wall, **options):
    bumpy = Bumpy(wall)
    monkeypatch.setattr(RolloutRun, "_evaluated", lambda run, weights: bumpy(run, weights))
    start = dataclasses.replace(residual, input_biases=jnp.zeros(5))
    options = dataclasses.replace(OPTIONS, **options)
    batches = trajectory_batches(WRONG, bars, options)
    return bumpy, RolloutRun(options, batches, None, KNODE(WRONG, start), 0)


def to_its_end(run):
    with ProgressMonitor(False, None) as watch:
        watch.begin("", run.steps, 0)
        while not run.finished:
            run.advance(run.steps, watch)


def test_a_step_that_cannot_be_simulated_is_halved(bars, residual, monkeypatch):
    bumpy, run = bumpy_run(bars, residual, monkeypatch, wall=0.5, learning_rate=0.3, updates=3, rejections=4)
    to_its_end(run)
    # Adam's first steps are of the size of the rate: 0.3, then 0.6 is beyond the wall, 0.45 is not, …
    first = [calls[0] for calls in bumpy.calls]
    np.testing.assert_allclose(first[:4], [0.0, 0.3, 0.6, 0.45], atol=0.02)
    assert np.all(np.isfinite(run.report()["loss"])) and np.all(np.diff(run.report()["loss"]) < 0.0)
    rates = run.report()["learning_rate"]
    assert rates[0] == 0.3 and rates[1] == 0.15 and rates[2] < 0.15
    found = run.residual().input_biases
    assert np.all(found < 0.5) and np.all(found > 0.45)


def test_too_many_rejections_stop_it(bars, residual, monkeypatch):
    _, run = bumpy_run(bars, residual, monkeypatch, wall=0.5, learning_rate=0.3, updates=30, rejections=2)
    with pytest.raises(FitError, match=r"halved 2 times.*cannot be simulated") as caught:
        to_its_end(run)
    assert "\n" not in str(caught.value)
    assert np.all(run.residual().input_biases < 0.5) and run.done >= 1


class Torn(type(BAR)):
    """A bar without a solution: no force balances the pull at its tip."""

    def tip(self, t, control, y, y_t):
        return 1.0 + control**2 + y[1:2] ** 2


@pytest.mark.slow
def test_a_model_that_cannot_be_simulated(bars):
    config = FitConfig(NetworkOptions(hidden=5, convex=False), None, OPTIONS)
    with pytest.raises(
        FitError, match=r"cannot be simulated over the trajectories.*nothing was kept"
    ) as caught:
        fit_states(Torn(length=1.0, density=1.0, stiffness=30.0, nodes=6), bars, config)
    assert "\n" not in str(caught.value)


def test_best_held_out_weights_are_kept(bars, unseen):
    config = FitConfig(
        NetworkOptions(hidden=5, convex=False),
        None,
        dataclasses.replace(OPTIONS, updates=200, learning_rate=0.05, stop_after=10, check_every=5),
    )
    model = fit_states(WRONG, bars, config, held_out=[unseen])
    history = model.about.facts["rollouts"]
    errors = history["held_out_error"]
    best = np.argmin(errors[:, 1])
    assert errors[0, 0] == 0 and len(history["learning_rate"]) == errors[-1, 0] == errors[best, 0] + 10
    np.testing.assert_allclose(held_out_error(WRONG, [unseen])(model), errors[best, 1], rtol=1e-9)


# wrong data


def test_what_is_compared_must_be_known(bars):
    unknown = np.array(bars[0].y)
    unknown[5, 2, 0] = np.nan
    moving = dataclasses.replace(bars[0], time=bars[0].time + 1.0)
    cases = [
        (bars, {"compared": ("p", "h")}, "compared has 'h'; y has p, n, q"),
        ([dataclasses.replace(bars[0], y=unknown)], {}, "trajectory 0 has y that is not finite in row 5"),
        (
            [only_positions(bars[0])],
            {"compared": ("p", "n")},
            "trajectory 0 has y that is not finite in row 0",
        ),
        ([bars[0], moving], {}, "trajectory 1 begins at 1 s, in motion"),
        (["x"], {}, "trajectory 0 is a str"),
        ([], {}, "there are no trajectories"),
    ]
    for trajectories, options, words in cases:
        with pytest.raises(DataError, match=words) as caught:
            trajectory_batches(WRONG, trajectories, RolloutTraining(**options))
        assert "\n" not in str(caught.value)
