"""What a residual is, and the networks that add to the knowledge's [y_s; z] (paper eq. 9)."""

from __future__ import annotations

import abc
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.config import NetworkOptions
from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.system import History, System


class Residual(eqx.Module):
    """What is added to a knowledge, and where: it says what y_s, z and the tip's conditions become."""

    #: attributes that are no weights: gradient training leaves them alone (modules inside may have their own)
    fixed: ClassVar[tuple[str, ...]] = ()

    def adapted(self, knowledge: System) -> System:
        """The knowledge itself as this residual changes it: its length, say."""
        return knowledge

    @abc.abstractmethod
    def derivatives(
        self, knowledge: System, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """y_s and z of the adapted knowledge and this residual together."""

    def tip(
        self, knowledge: System, t: Any, control: Any, y: Float[Any, " y"], history: History
    ) -> Float[Any, " k"]:
        """The tip's conditions; the knowledge's own, unless a residual knows better."""
        return knowledge.tip(t, control, y, history)

    def clamped(self) -> Self:
        """The nearest residual with allowed weights: what training goes on from after every update."""
        return self


@jax.custom_jvp
def elu(x: Any) -> Any:
    """exp(x) - 1 below zero and x above: as `jax.nn.elu`, with one exponential for value and derivative."""
    return jnp.where(x > 0.0, x, jnp.exp(jnp.minimum(x, 0.0)) - 1.0)


@elu.defjvp
def _elu_tangent(primals: Any, tangents: Any) -> Any:
    value = elu(*primals)
    return value, (jnp.minimum(value, 0.0) + 1.0) * tangents[0]


class Network(Residual):
    """One hidden layer of ELU units, f_θ, added to y_s and z: the paper's residual, and its variants.

    Its inputs are y, the knowledge's z and the actuation; with `history`, ʰy and ʰz too. The corrected z is
    an output only: it does not enter y_s. `convex` weights are never negative, so that every output is convex
    and non-decreasing in every input; `clamped` keeps them so. Inputs are shifted and scaled, and outputs
    scaled, by what is kept in the model.
    """

    fixed: ClassVar[tuple[str, ...]] = ("input_mean", "input_scale", "output_scale")

    #: (hidden, inputs) and (hidden,)
    input_weights: Float[Any, "hidden inputs"]
    input_biases: Float[Any, " hidden"]
    #: (outputs, hidden) and (outputs,)
    output_weights: Float[Any, "outputs hidden"]
    output_biases: Float[Any, " outputs"]
    input_mean: Float[Any, " inputs"]
    input_scale: Float[Any, " inputs"]
    output_scale: Float[Any, " outputs"]
    history: bool = eqx.field(static=True, default=False)
    convex: bool = eqx.field(static=True, default=True)

    def inputs(
        self, knowledge: System, y: Float[Any, " y"], z: Float[Any, " z"], control: Any, history: History
    ) -> Float[Any, " inputs"]:
        """What the network sees: y, z and the actuation; with history, y, ʰy, z, ʰz and the actuation."""
        force = knowledge.actuation(control)
        if self.history:
            return jnp.concatenate([y, history.y, z, history.z, force])
        return jnp.concatenate([y, z, force])

    def correction(self, inputs: Float[Any, " inputs"]) -> Float[Any, " outputs"]:
        """f_θ, what is added to [y_s; z]."""
        hidden = self.input_weights @ ((inputs - self.input_mean) / self.input_scale) + self.input_biases
        return self.output_scale * (self.output_weights @ elu(hidden) + self.output_biases)

    def derivatives(
        self, knowledge: System, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """The knowledge's y_s and z, and the correction added."""
        y_s, z = knowledge.derivatives(s, t, y, control, history)
        added = self.correction(self.inputs(knowledge, y, z, control, history))
        return y_s + added[: y.shape[0]], z + added[y.shape[0] :]

    def clamped(self) -> Self:
        """A convex network with its negative weights at zero; any other unchanged."""
        if not self.convex:
            return self
        weights = jnp.maximum(self.input_weights, 0.0), jnp.maximum(self.output_weights, 0.0)
        return eqx.tree_at(lambda net: (net.input_weights, net.output_weights), self, weights)


def network(knowledge: System, options: NetworkOptions, key: Any) -> Network:
    """A network with its first, random weights; inputs and outputs are not scaled.

    A convex one starts as the paper's: weights |N(0.01, 0.01)|, biases N(0, 0.01). Any other starts with
    N(0, 1/√inputs) and N(0, 0.1/√hidden), and so close to the knowledge alone.
    """
    fields = input_layout(knowledge, options.history)
    inputs, outputs = fields.size, knowledge.y_layout.size + knowledge.z_layout.size
    shapes = ((options.hidden, inputs), (options.hidden,), (outputs, options.hidden), (outputs,))
    draws = [jax.random.normal(k, shape) for k, shape in zip(jax.random.split(key, 4), shapes, strict=True)]
    if options.convex:
        first, second = (jnp.abs(0.01 + 0.01 * draw) for draw in (draws[0], draws[2]))
        biases = 0.01 * draws[1], 0.01 * draws[3]
    else:
        first, second = draws[0] / np.sqrt(inputs), 0.1 * draws[2] / np.sqrt(options.hidden)
        biases = 0.1 * draws[1], jnp.zeros(outputs)
    mean, scale, output_scale = jnp.zeros(inputs), jnp.ones(inputs), jnp.ones(outputs)
    return Network(
        first, biases[0], second, biases[1], mean, scale, output_scale, options.history, options.convex
    )


def input_layout(knowledge: System, history: bool) -> Layout:
    """What a `Network` on this knowledge sees, in order."""
    own = [[*layout.fields] for layout in (knowledge.y_layout, knowledge.z_layout)]
    past = [[Field(f"{f.name} past", f.size, f"{f.unit}/s", f"ʰ of {f.name}") for f in part] for part in own]
    size = jax.eval_shape(knowledge.actuation, np.zeros(knowledge.control_size)).shape[0]
    seen = [*own[0], *past[0], *own[1], *past[1]] if history else [*own[0], *own[1]]
    return Layout(*seen, Field("actuation", size, "", "what of the control enters the equations"))


def input_size(knowledge: System, history: bool) -> int:
    """How many numbers a `Network` on this knowledge sees."""
    return input_layout(knowledge, history).size
