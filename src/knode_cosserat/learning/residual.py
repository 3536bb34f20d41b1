"""Residuals: terms of the law and of the loads, or a network that adds to the nominal model's [y_s; z]."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat._reprs import count_of
from knode_cosserat.learning.config import NetworkOptions
from knode_cosserat.rods.aspects import Observed
from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.parameters import ParameterError
from knode_cosserat.rods.system import System


class Residual(eqx.Module):
    """Terms that a model adds to its nominal model (paper eq. 6, true dynamics); none by default.

    A subclass overrides what it changes: parameters (`adapted`), the law of the strains (`constitutive`), the
    loads along the rod (`balance`) and at its tip (`tip`), or it defines a `correction`, whose value adds to
    [y_s; z]. `knowledge` is the adapted nominal model; the other arguments and the results are those of
    `System`.
    """

    #: attributes that gradient training does not change (nested modules may have their own)
    fixed: ClassVar[tuple[str, ...]] = ()
    #: paths of the attributes in which the residual is linear (near zero), such as "load.material.weights"
    linear_in: ClassVar[tuple[str, ...]] = ()
    #: None, or a method (knowledge, s, t, y, y_t, z, z_t, control) that returns a correction of [y_s; z]
    correction: ClassVar[Callable[..., Any] | None] = None

    def __repr__(self) -> str:
        numbers = sum(int(np.size(leaf)) for leaf in jax.tree.leaves(self) if eqx.is_array(leaf))
        return f"{type(self).__name__} with {count_of(numbers, 'number')}"

    def adapted(self, knowledge: System) -> System:
        """Return the nominal model with the residual's parameter changes, such as a corrected length."""
        return knowledge

    def constitutive(self, knowledge: System, s: Any, t: Any, y: Any, y_t: Any, control: Any) -> Any:
        """Return the law of z with the residual's terms (`System.constitutive`)."""
        return knowledge.constitutive(s, t, y, y_t, control)

    def balance(
        self, knowledge: System, s: Any, t: Any, y: Any, y_t: Any, z: Any, z_t: Any, control: Any
    ) -> Any:
        """Return the balance along the rod with the residual's loads (`System.balance`)."""
        return knowledge.balance(s, t, y, y_t, z, z_t, control)

    def base(self, knowledge: System, t: Any, control: Any, unknowns: Float[Any, " k"]) -> Float[Any, " y"]:
        """Return y at the base (`System.base`)."""
        return knowledge.base(t, control, unknowns)

    def tip(
        self, knowledge: System, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]
    ) -> Float[Any, " k"]:
        """Return the residual of the tip's boundary conditions with the residual's load (`System.tip`)."""
        return knowledge.tip(t, control, y, y_t)

    def clamped(self) -> Self:
        """Return the nearest residual with allowed weights; training calls it after every update."""
        return self

    def coefficients(self) -> dict[str, Float[Any, "..."]]:
        """Return the arrays of `linear_in` by their paths; missing ones are left out."""
        parts = {path: _at(self, path) for path in self.linear_in}
        return {path: value for path, value in parts.items() if value is not None}

    def with_coefficients(self, changes: Mapping[str, Any]) -> Self:
        """Return a copy with other coefficients, which may be traced.

        Raises:
            ParameterError: a path that does not exist, or an array of another shape.
        """
        known = self.coefficients()
        for path, value in changes.items():
            if path not in known:
                there = ", ".join(f"residual.{name}" for name in known) or "none"
                raise ParameterError(f"there are no coefficients 'residual.{path}'; there are {there}")
            if np.shape(value) != np.shape(known[path]):
                raise ParameterError(
                    f"residual.{path} has shape {np.shape(value)}; allowed is {np.shape(known[path])}"
                )
        names = list(changes)
        return eqx.tree_at(lambda it: [_at(it, name) for name in names], self, [*changes.values()])


def _at(owner: Any, path: str) -> Any:
    """Return the attribute at a path with dots; None if it or an owner of it is None."""
    for name in path.split("."):
        owner = None if owner is None else getattr(owner, name)
    return owner


class Nothing(Residual):
    """No residual: the nominal model unchanged."""


@jax.custom_jvp
def elu(x: Any) -> Any:
    """Return exp(x) - 1 below zero and x above: `jax.nn.elu`, but its derivative uses no exponential."""
    return jnp.where(x > 0.0, x, jnp.exp(jnp.minimum(x, 0.0)) - 1.0)


@elu.defjvp
def _elu_tangent(primals: Any, tangents: Any) -> Any:
    value = elu(*primals)
    return value, (jnp.minimum(value, 0.0) + 1.0) * tangents[0]


class Network(Residual):
    """One hidden layer of ELU units, f_θ, added to y_s and z: the paper's residual, and its variants.

    Its inputs are y, the nominal model's z and the actuation; with `c0`, ʰy and ʰz too. The corrected z is an
    output only: it does not enter y_s. With `convex` the weights are nonnegative, so that every output is
    convex and non-decreasing in every input; `clamped` enforces this. Inputs are shifted and scaled, and
    outputs scaled, by constants stored in the model.
    """

    fixed: ClassVar[tuple[str, ...]] = ("input_mean", "input_scale", "output_scale", "c0")
    linear_in: ClassVar[tuple[str, ...]] = ("output_weights", "output_biases")

    #: (hidden, inputs) and (hidden,)
    input_weights: Float[Any, "hidden inputs"]
    input_biases: Float[Any, " hidden"]
    #: (outputs, hidden) and (outputs,)
    output_weights: Float[Any, "outputs hidden"]
    output_biases: Float[Any, " outputs"]
    input_mean: Float[Any, " inputs"]
    input_scale: Float[Any, " inputs"]
    output_scale: Float[Any, " outputs"]
    convex: bool = eqx.field(static=True, default=True)
    #: c0 of the training's time steps (1/s), for the paper's inputs ʰy = y_t - c0 y and ʰz = z_t - c0 z; None
    #: without them. It is stored because ʰ of a problem depends on the time scheme, and is zero at rest:
    #: with the c0 of the training's steps the model is the same everywhere
    c0: Float[Any, ""] | None = None
    #: first and last + 1 place in y of a quaternion whose length the correction leaves as it is, or None
    quaternion: tuple[int, int] | None = eqx.field(static=True, default=None)

    def inputs(
        self, knowledge: System, y: Any, y_t: Any, z: Any, z_t: Any, control: Any
    ) -> Float[Any, " inputs"]:
        """Return the inputs: y, z and the actuation; with `c0`, y, ʰy, z, ʰz and the actuation."""
        force = Observed.of(knowledge).actuation(control)
        if self.c0 is None:
            return jnp.concatenate([y, z, force])
        return jnp.concatenate([y, y_t - self.c0 * y, z, z_t - self.c0 * z, force])

    def correction(
        self, knowledge: System, s: Any, t: Any, y: Any, y_t: Any, z: Any, z_t: Any, control: Any
    ) -> Float[Any, " outputs"]:
        """Return f_θ, the correction of [y_s; z], at the nominal model's z."""
        inputs = (self.inputs(knowledge, y, y_t, z, z_t, control) - self.input_mean) / self.input_scale
        hidden = self.input_weights @ inputs + self.input_biases
        added = self.output_scale * (self.output_weights @ elu(hidden) + self.output_biases)
        return self.turning(added, y)

    def turning(self, added: Any, y: Any) -> Any:
        """Return corrections (outputs, …) at y (y, …) without the part that lengthens the quaternion.

        That part turns nothing, so data cannot determine it.
        """
        if self.quaternion is None:
            return added
        where = slice(*self.quaternion)
        h, h_s = y[where], added[where]
        return added.at[where].add(-h * (jnp.sum(h * h_s, axis=0) / jnp.sum(h * h, axis=0)))

    def clamped(self) -> Self:
        """Return a convex network with its negative weights set to zero; any other unchanged."""
        if not self.convex:
            return self
        weights = jnp.maximum(self.input_weights, 0.0), jnp.maximum(self.output_weights, 0.0)
        return eqx.tree_at(lambda net: (net.input_weights, net.output_weights), self, weights)


def network(knowledge: System, options: NetworkOptions, key: Any, c0: Any = None) -> Network:
    """Return a network with random initial weights; inputs and outputs are not scaled.

    `c0` (1/s), of the training's time steps, is for a network with history inputs.

    A convex network starts like the paper's: weights |N(0.01, 0.01)|, biases N(0, 0.01). Any other starts
    with N(0, 1/√inputs) and N(0, 0.1/√hidden), and is therefore close to the nominal model.
    """
    layout = knowledge.y_layout
    inputs = input_layout(knowledge, options.history).size
    outputs = layout.size + knowledge.z_layout.size
    shapes = ((options.hidden, inputs), (options.hidden,), (outputs, options.hidden), (outputs,))
    draws = [jax.random.normal(k, shape) for k, shape in zip(jax.random.split(key, 4), shapes, strict=True)]
    if options.convex:
        first, second = (jnp.abs(0.01 + 0.01 * draw) for draw in (draws[0], draws[2]))
        biases = 0.01 * draws[1], 0.01 * draws[3]
    else:
        first, second = draws[0] / np.sqrt(inputs), 0.1 * draws[2] / np.sqrt(options.hidden)
        biases = 0.1 * draws[1], jnp.zeros(outputs)
    quaternion = None
    if options.unit_quaternions and "h" in layout.names:
        quaternion = layout.slice("h").start, layout.slice("h").stop
    return Network(
        first,
        biases[0],
        second,
        biases[1],
        jnp.zeros(inputs),
        jnp.ones(inputs),
        jnp.ones(outputs),
        options.convex,
        c0 if options.history else None,
        quaternion,
    )


def input_layout(knowledge: System, history: bool) -> Layout:
    """Return the layout of a `Network`'s inputs, for this nominal model."""
    fields: list[Field] = []
    for layout in (knowledge.y_layout, knowledge.z_layout):
        fields += layout.fields
        if history:
            fields += [
                Field(f"{f.name} past", f.size, f"{f.unit}/s", f"ʰ of {f.name}") for f in layout.fields
            ]
    size = jax.eval_shape(Observed.of(knowledge).actuation, np.zeros(knowledge.control_layout.size)).shape[0]
    return Layout(*fields, Field("actuation", size, "", "part of the control that enters the equations"))
