"""Gradient training on one-segment samples: one compiled program for all epochs, and for several seeds.

With a scheme without stages, a network adds to the prediction of the nominal model. That prediction does not
depend on the weights and is evaluated once; an epoch is then two matrix products and their derivatives. Other
schemes and residuals are predicted in every epoch by `samples.predict_segment`.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from jaxtyping import Float, Int, UInt32

from knode_cosserat.learning.config import Training
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.residual import Network, Residual, elu, input_layout
from knode_cosserat.learning.samples import Dataset, Samples, end_of, predict_segment, start_of
from knode_cosserat.learning.training.losses import Loss, field_sizes, loss_for, value_scales
from knode_cosserat.rods.system import System
from knode_cosserat.solvers import semi_discrete
from knode_cosserat.solvers.grid import grid_of
from knode_cosserat.solvers.semi_discrete import Point, unpacked_history
from knode_cosserat.solvers.space import Euler, SpaceScheme

#: largest number of epochs in one call of the program
PIECE = 50
#: relative decrease of the best loss that counts as an improvement, as in PyTorch's ReduceLROnPlateau
LEAST_GAIN = 1e-4

ADAM = optax.scale_by_adam(b1=0.9, b2=0.999, eps=1e-8)


# weights


def split(residual: Residual) -> tuple[Any, Any]:
    """Split a residual into its weights and the rest; `equinox.combine` joins them."""
    mask = jax.tree_util.tree_map_with_path(lambda path, leaf: _is_weight(residual, path, leaf), residual)
    return eqx.partition(residual, mask)


def _is_weight(node: Any, path: Any, leaf: Any) -> bool:
    for key in path:
        name = getattr(key, "name", None)
        if name in getattr(type(node), "fixed", ()):
            return False
        index = getattr(key, "idx", getattr(key, "key", None))
        node = node[index] if name is None else getattr(node, name)
    return bool(np.issubdtype(jnp.result_type(leaf), np.floating))


# predictions of the nominal model


class NominalPredictions(NamedTuple):
    """Predictions of the samples (S) by the nominal model alone, and a network's scaled inputs."""

    #: at the starts of segments, then at their ends if the scheme uses them; the last row is ones, for the
    #: biases
    inputs: Float[Any, "inputs+1 E*S"]
    #: true states there
    at: Float[Any, "y E*S"]
    y: Float[Any, "y S"]
    z: Float[Any, "z S"]
    #: length of a segment times the scheme's weights of the start and of the end
    steps: Float[Any, "2"]


def nominal_predictions(
    net: Network, knowledge: System, samples: Samples, space: SpaceScheme
) -> NominalPredictions:
    """Evaluate the terms that do not depend on a network's weights; for schemes without stages."""
    steps = knowledge.length / (knowledge.nodes - 1) * jnp.asarray(space.formula.weights[:2])

    def at(s: Any, sample: Samples, y: Any, record: Any) -> Point:
        history = unpacked_history(knowledge, sample.c0, record)
        return Point(s, sample.t, y, sample.control, history)

    def inputs_at(point: Point, z: Any) -> Any:
        return (net.inputs(knowledge, point, z) - net.input_mean) / net.input_scale

    def one(sample: Samples) -> Any:
        y, z = predict_segment(knowledge, space, sample)
        inputs = [inputs_at(at(start_of(knowledge, sample.place), sample, sample.y, sample.history[0]), z)]
        if space.implicit:
            end = at(end_of(knowledge, sample.place), sample, sample.y_next, sample.history[1])
            inputs.append(inputs_at(end, semi_discrete.strains(knowledge, end)))
        return inputs, y, z

    inputs, y, z = jax.vmap(one, out_axes=-1)(samples)
    joined = jnp.concatenate(inputs, axis=1)
    states = jnp.concatenate([samples.y, samples.y_next][: len(inputs)]).T
    return NominalPredictions(jnp.concatenate([joined, jnp.ones_like(joined[:1])]), states, y, z, steps)


def corrected(net: Network, known: NominalPredictions) -> tuple[Float[Any, "y S"], Float[Any, "z S"]]:
    """Return the predictions of all samples by nominal model and network, equal to `samples.predict_segment`.

    Hidden units first and the biases as an additional column was the fastest layout tried (0.61 s for 1000
    epochs of the paper's preset on one core, 0.54 s with `_product`; samples first 0.69 to 1.0 s).
    """
    first = jnp.concatenate([net.input_weights, net.input_biases[:, None]], axis=1)
    second = _product(net.output_weights, elu(first @ known.inputs)) + net.output_biases[:, None]
    added = net.turning(net.output_scale[:, None] * second, known.at)
    size, count = known.y.shape
    y = known.y + known.steps[0] * added[:size, :count]
    if added.shape[1] > count:
        y = y + known.steps[1] * added[:size, count:]
    return y, known.z + added[size:, :count]


@jax.custom_vjp
def _product(weights: Float[Any, "outputs hidden"], units: Float[Any, "hidden S"]) -> Float[Any, "outputs S"]:
    return weights @ units


def _product_slope(given: Any, slope: Any) -> Any:
    weights, units = given
    # the barrier forces a copy: XLA's product with a transposed matrix takes twice the time
    turned = jax.lax.optimization_barrier(weights.T)
    return slope @ units.T, turned @ slope


_product.defvjp(lambda weights, units: (weights @ units, (weights, units)), _product_slope)


def standardised(net: Network, knowledge: System, data: Dataset) -> Network:
    """Return the network with standardised inputs and scaled outputs.

    An output is scaled by the root mean square of the correction that is needed along a segment.
    """
    samples = data.segments
    seen = _known(net, knowledge, samples, Euler())
    y, z = (seen.y, seen.z) if isinstance(data.space, Euler) else _predicted(knowledge, data.space, samples)
    inputs = np.asarray(seen.inputs)[:-1].T
    ds = knowledge.length / (knowledge.nodes - 1)
    lacking = [(samples.y_next.T - y) / ds, samples.z.T - z]
    scale = np.sqrt(np.mean(np.square(np.concatenate(lacking)), axis=1))
    return dataclasses.replace(
        net,
        input_mean=jnp.asarray(inputs.mean(axis=0)),
        input_scale=jnp.asarray(value_scales(inputs, field_sizes(input_layout(knowledge, net.history)))),
        output_scale=jnp.asarray(scale),
    )


_known = jax.jit(nominal_predictions, static_argnames="space")


@functools.partial(jax.jit, static_argnames="space")
def _predicted(system: System, space: SpaceScheme, samples: Samples) -> Any:
    return jax.vmap(lambda one: predict_segment(system, space, one), out_axes=-1)(samples)


# the program


class Numbers(NamedTuple):
    """Numerical settings, which do not change the compiled program."""

    learning_rate: Any
    patience: Any
    factor: Any
    weight_decay: Any
    noise: Any
    epochs: Any


class Recipe(NamedTuple):
    """The settings that change the program."""

    space: SpaceScheme
    schedule: str
    noisy: bool


class TrainingData(NamedTuple):
    """Inputs of an epoch besides the weights: `known` if predictions are fixed, otherwise `samples`."""

    knowledge: System
    rest: Any
    samples: Samples | None
    known: NominalPredictions | None
    loss: Loss
    y_spread: Float[Any, " y"]
    history_spread: Float[Any, " x"]


class State(NamedTuple):
    """State of the training; all fields but `epoch` have the seeds (G) as first axis."""

    epoch: Int[Any, ""]
    weights: Any
    adam: Any
    #: for the "plateau" schedule: the rate, the best loss, and the number of epochs since then
    rate: Float[Any, " G"]
    best: Float[Any, " G"]
    waited: Int[Any, " G"]
    key: UInt32[Any, "G 2"]


def _loss(weights: Any, recipe: Recipe, data: TrainingData, noise: Any, key: Any) -> Any:
    residual = eqx.combine(weights, data.rest)
    if data.known is not None:
        return data.loss(*corrected(residual, data.known))
    samples: Any = data.samples
    if recipe.noisy:
        samples = _noisy(samples, data, noise, key)
    if _adds(residual, recipe.space, data.knowledge):
        return data.loss(
            *corrected(residual, nominal_predictions(residual, data.knowledge, samples, recipe.space))
        )
    model = KNODE(data.knowledge, residual)
    return data.loss(*jax.vmap(lambda one: predict_segment(model, recipe.space, one), out_axes=-1)(samples))


def _adds(residual: Residual, space: SpaceScheme, knowledge: System) -> bool:
    """True if a prediction is the nominal model's plus a linear combination of the network's outputs."""
    parted = grid_of(knowledge).parts.shape[1] > 1
    return isinstance(residual, Network) and not space.formula.stages and not parted


def _noisy(samples: Samples, data: TrainingData, noise: Any, key: Any) -> Samples:
    """Return samples with noise in states and histories at the segments' starts; targets are unchanged."""
    for_y, for_history = jax.random.split(key)
    y = samples.y + noise * data.y_spread * jax.random.normal(for_y, samples.y.shape)
    # the same along the segment: a perturbation of the whole history
    shift = noise * data.history_spread * jax.random.normal(for_history, samples.history[:, 0].shape)
    later = samples.later + shift[:, None, None]
    return samples._replace(y=y, history=samples.history + shift[:, None], later=later)


def _rate(recipe: Recipe, numbers: Numbers, epoch: Any, rate: Any) -> Any:
    if recipe.schedule == "cosine":
        return numbers.learning_rate * 0.5 * (1.0 + jnp.cos(jnp.pi * epoch / numbers.epochs))
    return rate


def plateau(numbers: Numbers, loss: Any, rate: Any, best: Any, waited: Any) -> tuple[Any, Any, Any]:
    """Return rate, best loss and epochs since then, after an epoch, as PyTorch's ReduceLROnPlateau."""
    better = loss < best * (1.0 - LEAST_GAIN)
    waited = jnp.where(better, 0, waited + 1)
    enough = waited > numbers.patience
    return (
        jnp.where(enough, rate * numbers.factor, rate),
        jnp.where(better, loss, best),
        jnp.where(enough, 0, waited),
    )


def _epoch(recipe: Recipe, numbers: Numbers, data: TrainingData, epoch: Any, of_seed: Any) -> Any:
    """Run one update of one seed: return its new state, the loss before, and the rate."""
    weights, adam, rate, best, waited, key = of_seed
    fresh = jax.random.fold_in(key, epoch) if recipe.noisy else None
    loss, slope = jax.value_and_grad(_loss)(weights, recipe, data, numbers.noise, fresh)
    now = _rate(recipe, numbers, epoch, rate)
    direction, adam = ADAM.update(slope, adam)

    def updated(weight: Any, change: Any) -> Any:
        decay = numbers.weight_decay * weight if weight.ndim >= 2 else 0.0
        return weight - now * (change + decay)

    weights = jax.tree.map(updated, weights, direction)
    weights, _ = split(eqx.combine(weights, data.rest).clamped())
    if recipe.schedule == "plateau":
        rate, best, waited = plateau(numbers, loss, rate, best, waited)
    return (weights, adam, rate, best, waited, key), loss, now


@functools.partial(jax.jit, static_argnames="recipe")
def run_epochs(
    recipe: Recipe, numbers: Numbers, data: TrainingData, state: State, stop: Any
) -> tuple[State, Float[Any, "PIECE G"], Float[Any, "PIECE G"]]:
    """Run epochs up to `stop`, at most `PIECE`: return the new state, the losses and the rates.

    The number of epochs is a value, not a shape. One program serves every piece, so that an interruption does
    not change the result.
    """
    first = state.epoch

    def one(carry: Any) -> Any:
        state, losses, rates = carry
        epoch, *of_seeds = state
        update = functools.partial(_epoch, recipe, numbers, data, epoch)
        of_seeds, loss, rate = _side_by_side(update, tuple(of_seeds))
        i = epoch - first
        return State(epoch + 1, *of_seeds), losses.at[i].set(loss), rates.at[i].set(rate)

    nothing = jnp.full((PIECE, state.rate.shape[0]), jnp.nan)
    last = jnp.minimum(stop, first + PIECE)
    return jax.lax.while_loop(lambda carry: carry[0].epoch < last, one, (state, nothing, nothing))


def _side_by_side(update: Any, of_seeds: Any) -> Any:
    """Apply `update` to all seeds; without a batch axis for one seed, which would cost a third more."""
    if jax.tree.leaves(of_seeds)[0].shape[0] > 1:
        return jax.vmap(update)(of_seeds)
    alone = update(jax.tree.map(lambda leaf: leaf[0], of_seeds))
    return jax.tree.map(lambda leaf: leaf[None], alone)


# before the first epoch


def prepared(
    knowledge: System, residual: Residual, dataset: Dataset, training: Training
) -> tuple[Recipe, Numbers, TrainingData]:
    """Return the program's inputs besides its state."""
    segments = dataset.segments
    recipe = Recipe(dataset.space, training.schedule, training.noise > 0.0)
    numbers = Numbers(
        training.learning_rate, training.patience, training.factor, training.weight_decay, training.noise,
        float(training.epochs),
    )  # fmt: skip
    _, rest = split(residual)
    given: Any = residual
    ready = (
        _known(given, knowledge, segments, dataset.space)
        if _adds(residual, dataset.space, knowledge) and not recipe.noisy
        else None
    )
    per_y, per_z = field_sizes(knowledge.y_layout), field_sizes(knowledge.z_layout)
    fields = [*per_y, *per_z, *(per_y if knowledge.mixed else [])]
    data = TrainingData(
        knowledge, rest, None if ready else segments, ready,
        loss_for(training.loss, knowledge, segments),
        value_scales(segments.y, per_y), value_scales(segments.history[:, 0], fields),
    )  # fmt: skip
    return recipe, numbers, jax.tree.map(jnp.asarray, data)


def started(residuals: Sequence[Residual], training: Training, seeds: Sequence[int]) -> State:
    """Return the state before the first epoch, with one residual for each seed."""
    every = [split(residual)[0] for residual in residuals]
    weights = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(x, dtype=float) for x in leaves]), *every)
    count = len(residuals)
    return State(
        jnp.zeros((), dtype=int),
        weights,
        jax.vmap(ADAM.init)(weights),
        jnp.full(count, training.learning_rate),
        jnp.full(count, jnp.inf),
        jnp.zeros(count, dtype=int),
        jnp.stack([jax.random.key_data(jax.random.fold_in(jax.random.key(seed), 1)) for seed in seeds]),
    )
