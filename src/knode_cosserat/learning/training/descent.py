"""Gradient training on one-segment samples: one compiled program for all epochs.

With a scheme without stages, a network adds to the prediction of the nominal model. That prediction does not
depend on the weights and is evaluated once; an epoch is then two matrix products and their derivatives. Other
schemes and residuals are predicted in every epoch by `segments.predict_segment`.

Arrays of a loss have numbers first and samples last, (numbers, S), like the outputs of a network.
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
from jaxtyping import Float, Int

from knode_cosserat.learning.config import FitError, Training
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.residual import Network, Residual, elu, input_layout
from knode_cosserat.learning.training import runs
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.strands import strand_of
from knode_cosserat.rods.system import System
from knode_cosserat.rotation import rotation_matrix
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.grid import grid_of
from knode_cosserat.schemes.semi_discrete import Point
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.segments import Dataset, Samples, end_point, predict_segment, start_point

#: largest number of epochs in one call of the program
PIECE = 50
#: relative decrease of the best loss that counts as an improvement, as in PyTorch's ReduceLROnPlateau
LEAST_GAIN = 1e-4
#: fields of y in the paper's loss
PAPER_FIELDS = ("p", "h", "n", "m", "q", "w")
#: a number whose spread is below this part of its field's largest is scaled by the field's spread
LEAST_PART = 1e-3
#: relative variation below which a field is constant
ROUNDING = 1e-12


# losses


class PaperLoss(eqx.Module):
    """The paper's loss: the sum of four mean squares, with orientations as Euler angles.

    The four are positions, Euler angles, strains z, and n, m, q and ω together, all in SI units. Means are
    over the numbers of a step and over steps, sums over trajectories.
    """

    y: Float[Any, "y S"]
    z: Float[Any, "z S"]
    angles: Float[Any, "3 S"]
    weight: Float[Any, " S"]
    layout: Layout = eqx.field(static=True)

    def __call__(self, y: Float[Any, "y S"], z: Float[Any, "z S"]) -> Float[Any, ""]:
        """Return the loss (paper eq. 8, training loss), in mixed units."""
        p, h, *rest = (y[self.layout.slice(name)] for name in PAPER_FIELDS)
        p_true, _, *rest_true = (self.y[self.layout.slice(name)] for name in PAPER_FIELDS)
        squares = (
            _mean_square(p - p_true)
            + _mean_square(jnp.concatenate(rest) - jnp.concatenate(rest_true))
            + _mean_square(euler_angles(h) - self.angles)
            + _mean_square(z - self.z)
        )
        return jnp.sum(self.weight * squares)


class StandardisedLoss(eqx.Module):
    """Mean square of all errors, each over its own spread, for any system.

    Errors of y are scaled by the spread of its increments over a segment, errors of z by the spread of z.
    """

    y: Float[Any, "y S"]
    z: Float[Any, "z S"]
    y_spread: Float[Any, " y"]
    z_spread: Float[Any, " z"]
    weight: Float[Any, " S"]

    def __call__(self, y: Float[Any, "y S"], z: Float[Any, "z S"]) -> Float[Any, ""]:
        """Return the loss (dimensionless)."""
        errors = [(y - self.y) / self.y_spread[:, None], (z - self.z) / self.z_spread[:, None]]
        return jnp.sum(self.weight * _mean_square(jnp.concatenate(errors)))


def loss_for(name: str, knowledge: System, segments: Samples) -> PaperLoss | StandardisedLoss:
    """Return the "paper" loss if y has the fields for it, otherwise the "standardised" loss."""
    y, z = segments.y_next.T, segments.z.T
    if name == "paper" and set(PAPER_FIELDS) <= set(knowledge.y_layout.names):
        angles = np.asarray(_angles(y[knowledge.y_layout.slice("h")]))
        return PaperLoss(y, z, angles, segments.weight, knowledge.y_layout)
    y_spread = value_scales(segments.y_next - segments.y, field_sizes(knowledge.y_layout))
    z_spread = value_scales(segments.z, field_sizes(knowledge.z_layout))
    return StandardisedLoss(y, z, y_spread, z_spread, segments.weight)


def euler_angles(h: Float[Any, "4 S"]) -> Float[Any, "3 S"]:
    """Return angles (rad) of quaternions (scalar first, any length) about the fixed z, then y, then x axis.

    The order is SciPy's "zyx". If the second angle is ±π/2 they are not unique, and have no derivative.
    """
    R = jax.vmap(rotation_matrix, in_axes=-1, out_axes=-1)(h)
    about_y = jnp.arcsin(jnp.clip(R[0, 2], -1.0, 1.0))
    return jnp.stack([jnp.arctan2(-R[0, 1], R[0, 0]), about_y, jnp.arctan2(-R[1, 2], R[2, 2])])


_angles = jax.jit(euler_angles)


def field_sizes(layout: Layout) -> list[int]:
    """Return the size of each field."""
    return [field.size for field in layout.fields]


def value_scales(values: Float[Any, "S x"], fields: Sequence[int]) -> Float[np.ndarray, " x"]:
    """Return the standard deviation of every number, never zero, as a scale of errors, noise and inputs.

    Args:
        values: one row a sample.
        fields: size of each field, in order. A number that hardly varies, such as a force normal to the plane
            of motion, gets a part of its field's largest; the numbers of a constant field get one.
    """
    scales = []
    for part in np.split(np.asarray(values), np.cumsum(fields)[:-1], axis=1):
        deviation = np.std(part, axis=0)
        largest = deviation.max(initial=0.0)
        varies = largest > ROUNDING * max(1e-3, np.abs(part).max(initial=0.0))
        scales.append(np.maximum(deviation, LEAST_PART * largest) if varies else np.ones_like(deviation))
    return np.concatenate(scales)


def _mean_square(errors: Float[Any, "x S"]) -> Float[Any, " S"]:
    return jnp.mean(errors * errors, axis=0)


# predictions of the nominal model


class _NominalPredictions(NamedTuple):
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


def _inputs(net: Network, knowledge: System, point: Point, z: Any) -> Float[Any, " inputs"]:
    inputs = net.inputs(knowledge, point.y, point.y_t, z, point.z_t(z), point.control)
    return (inputs - net.input_mean) / net.input_scale


def nominal_predictions(
    net: Network, knowledge: System, samples: Samples, space: SpaceScheme
) -> _NominalPredictions:
    """Evaluate the terms that do not depend on a network's weights; for schemes without stages."""
    steps = knowledge.length / (knowledge.nodes - 1) * jnp.asarray(space.formula.weights[:2])

    def one(sample: Samples) -> Any:
        y, z = predict_segment(knowledge, space, sample)
        inputs = [_inputs(net, knowledge, start_point(knowledge, sample), z)]
        if space.implicit:
            end = end_point(knowledge, sample)
            inputs.append(_inputs(net, knowledge, end, semi_discrete.strains(knowledge, end)))
        return inputs, y, z

    inputs, y, z = jax.vmap(one, out_axes=-1)(samples)
    joined = jnp.concatenate(inputs, axis=1)
    states = jnp.concatenate([samples.y, samples.y_next][: len(inputs)]).T
    return _NominalPredictions(jnp.concatenate([joined, jnp.ones_like(joined[:1])]), states, y, z, steps)


def corrected(net: Network, known: _NominalPredictions) -> tuple[Float[Any, "y S"], Float[Any, "z S"]]:
    """Return the predictions of all samples by nominal model and network, as `segments.predict_segment`.

    Hidden units first and the biases as an additional column was the fastest layout tried (0.61 s for 1000
    epochs of the paper's configuration on one core, 0.54 s with `_product`; samples first 0.69 to 1.0 s).
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


def _product_slope(factors: Any, slope: Any) -> Any:
    weights, units = factors
    # the barrier forces a copy: XLA's product with a transposed matrix takes twice the time
    turned = jax.lax.optimization_barrier(weights.T)
    return slope @ units.T, turned @ slope


_product.defvjp(lambda weights, units: (weights @ units, (weights, units)), _product_slope)


def standardised(net: Network, knowledge: System, data: Dataset) -> Network:
    """Return the network with standardised inputs and scaled outputs.

    An output is scaled by the root mean square of the correction that is needed along a segment.
    """
    samples = data.segments
    y, z = _predicted(knowledge, data.space, samples)
    inputs = np.asarray(_start_inputs(net, knowledge, samples, z.T))
    ds = knowledge.length / (knowledge.nodes - 1)
    lacking = [(samples.y_next.T - y) / ds, samples.z.T - z]
    scale = np.sqrt(np.mean(np.square(np.concatenate(lacking)), axis=1))
    return dataclasses.replace(
        net,
        input_mean=jnp.asarray(inputs.mean(axis=0)),
        input_scale=jnp.asarray(
            value_scales(inputs, field_sizes(input_layout(knowledge, net.c0 is not None)))
        ),
        output_scale=jnp.asarray(scale),
    )


_known = jax.jit(nominal_predictions, static_argnames="space")


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, None, 0, 0))
def _start_inputs(net: Network, knowledge: System, sample: Samples, z: Any) -> Any:
    return _inputs(net, knowledge, start_point(knowledge, sample), z)


@functools.partial(jax.jit, static_argnames="space")
def _predicted(system: System, space: SpaceScheme, samples: Samples) -> Any:
    return jax.vmap(lambda one: predict_segment(system, space, one), out_axes=-1)(samples)


# the program


class _TrainingData(eqx.Module):
    """Inputs of an epoch besides the state; `known` if predictions are fixed, otherwise `samples`."""

    knowledge: System
    rest: Any
    samples: Samples | None
    known: _NominalPredictions | None
    loss: PaperLoss | StandardisedLoss
    #: numbers of `Training`, which do not change the compiled program
    numbers: dict[str, Any]
    space: SpaceScheme = eqx.field(static=True)
    schedule: str = eqx.field(static=True)


class _State(NamedTuple):
    """State of the training."""

    epoch: Int[Any, ""]
    weights: Any
    adam: Any
    #: for the "plateau" schedule: the rate, the best loss, and the number of epochs since then
    rate: Float[Any, ""]
    best: Float[Any, ""]
    waited: Int[Any, ""]


def _loss(weights: Any, data: _TrainingData) -> Any:
    residual = eqx.combine(weights, data.rest)
    if data.known is not None:
        return data.loss(*corrected(residual, data.known))
    return data.loss(*_predicted(KNODE(data.knowledge, residual), data.space, data.samples))


def plateau(numbers: dict[str, Any], loss: Any, rate: Any, best: Any, waited: Any) -> tuple[Any, Any, Any]:
    """Return rate, best loss and epochs since then, after an epoch, as PyTorch's ReduceLROnPlateau."""
    better = loss < best * (1.0 - LEAST_GAIN)
    waited = jnp.where(better, 0, waited + 1)
    enough = waited > numbers["patience"]
    rate = jnp.where(enough, rate * numbers["factor"], rate)
    return rate, jnp.where(better, loss, best), jnp.where(enough, 0, waited)


def _epoch(data: _TrainingData, state: _State) -> tuple[_State, Any, Any]:
    """Run one update: return the new state, the loss before, and the rate."""
    epoch, weights, adam, rate, best, waited = state
    loss, slope = jax.value_and_grad(_loss)(weights, data)
    now, numbers = rate, data.numbers
    if data.schedule == "cosine":
        now = numbers["learning_rate"] * 0.5 * (1.0 + jnp.cos(jnp.pi * epoch / numbers["epochs"]))
    direction, adam = runs.ADAM.update(slope, adam)

    def updated(weight: Any, change: Any) -> Any:
        decay = numbers["weight_decay"] * weight if weight.ndim >= 2 else 0.0
        return weight - now * (change + decay)

    weights = jax.tree.map(updated, weights, direction)
    weights, _ = runs.split(eqx.combine(weights, data.rest).clamped())
    if data.schedule == "plateau":
        rate, best, waited = plateau(numbers, loss, rate, best, waited)
    return _State(epoch + 1, weights, adam, rate, best, waited), loss, now


@jax.jit
def run_epochs(
    data: _TrainingData, state: _State, stop: Any
) -> tuple[_State, Float[Any, " PIECE"], Float[Any, " PIECE"]]:
    """Run epochs up to `stop`, at most `PIECE`: return the new state, the losses and the rates.

    The number of epochs is a value, not a shape. One program serves every piece, so that an interruption does
    not change the result.
    """
    first = state.epoch

    def one(carry: Any) -> Any:
        state, losses, rates = carry
        i = state.epoch - first
        state, loss, rate = _epoch(data, state)
        return state, losses.at[i].set(loss), rates.at[i].set(rate)

    nothing = jnp.full(PIECE, jnp.nan)
    last = jnp.minimum(stop, first + PIECE)
    return jax.lax.while_loop(lambda carry: carry[0].epoch < last, one, (state, nothing, nothing))


# before the first epoch


def prepared(knowledge: System, residual: Residual, dataset: Dataset, training: Training) -> _TrainingData:
    """Return the program's inputs besides its state."""
    segments, space = dataset.segments, dataset.space
    # the prediction is the nominal model's plus a linear combination of the network's outputs
    divided = grid_of(knowledge).parts.shape[1] > 1
    adds = isinstance(residual, Network) and not space.formula.stages and not divided
    known = _known(residual, knowledge, segments, space) if adds else None
    names = ("learning_rate", "patience", "factor", "weight_decay", "epochs")
    data = _TrainingData(
        knowledge,
        runs.split(residual)[1],
        None if adds else segments,
        known,
        loss_for(training.loss, knowledge, segments),
        {name: getattr(training, name) for name in names},
        space,
        training.schedule,
    )
    return jax.tree.map(jnp.asarray, data)


class SegmentRun(runs.Run):
    """Epochs on one-segment samples."""

    stage = "segments"

    def __init__(self, training: Training, dataset: Dataset, held_out: runs.HeldOut, model: KNODE, seed: int):
        super().__init__(training, training.epochs, held_out, model, seed)
        self._data = prepared(strand_of(model.knowledge), model.residual, dataset, training)

    def started(self, weights: Any) -> _State:
        """Return the state before the first epoch."""
        rate, best = (jnp.array(x, dtype=float) for x in (self.training.learning_rate, jnp.inf))
        zero = jnp.zeros((), dtype=int)
        return _State(zero, weights, runs.ADAM.init(weights), rate, best, zero)

    def compile(self) -> None:
        """Compile the epochs' program without running one, and run one held-out rollout."""
        run_epochs(self._data, self.state, self.done)
        super().compile()

    def advance(self, stop: int, watch: runs.ProgressMonitor) -> None:
        """Run epochs up to the next check, at most `PIECE`."""
        first, every = self.done, self.training.check_every
        stop = min(stop, first + PIECE, self.steps)
        if self.held_out:
            stop = min(stop, first - first % every + every)
        state, losses, rates = run_epochs(self._data, self.state, stop)
        losses, rates = (np.asarray(values)[: stop - first] for values in (losses, rates))
        self._require_sane(losses, state.weights)
        self.state = state
        self.losses, self.rates = np.append(self.losses, losses), np.append(self.rates, rates)
        watch.steps(self.stage, self.seed, first, losses, rates)
        self.check(watch)

    def _require_sane(self, losses: Float[np.ndarray, " epochs"], weights: Any) -> None:
        start = np.append(self.losses, losses)[0]
        diverged = np.flatnonzero(~(losses <= runs.DIVERGED * max(start, runs.NOTHING)))
        if len(diverged):
            raise FitError(
                f"the loss of seed {self.seed} became {losses[diverged[0]]:.3g} in epoch "
                f"{self.done + diverged[0]} ({start:.3g} in the first): a smaller learning rate may help"
            )
        if not runs.is_finite(weights):
            raise FitError(
                f"weights are not finite after epoch {self.done + len(losses)}: "
                "a smaller learning rate may help"
            )
