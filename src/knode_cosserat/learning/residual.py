"""Base class of residuals, and networks that add to the nominal model's [y_s; z]."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat._reprs import count_of
from knode_cosserat.learning.config import NetworkOptions
from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.parameters import ParameterError
from knode_cosserat.rods.system import System
from knode_cosserat.solvers import semi_discrete
from knode_cosserat.solvers.semi_discrete import Point


class Residual(eqx.Module):
    """Correction of a nominal model: returns the corrected y_s, z and boundary conditions at the tip."""

    #: attributes that gradient training does not change (nested modules may have their own)
    fixed: ClassVar[tuple[str, ...]] = ()
    #: paths of the attributes in which the correction is linear (near zero), such as "load.material.weights"
    linear_in: ClassVar[tuple[str, ...]] = ()

    def __repr__(self) -> str:
        numbers = sum(int(np.size(leaf)) for leaf in jax.tree.leaves(self) if eqx.is_array(leaf))
        return f"{type(self).__name__} with {count_of(numbers, 'number')}"

    def adapted(self, knowledge: System) -> System:
        """Return the nominal model with the residual's parameter changes, such as a corrected length."""
        return knowledge

    @abc.abstractmethod
    def derivatives(self, knowledge: System, point: Point) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return y_s and z of the nominal model plus Δ (paper eq. 6, true dynamics).

        `knowledge` is the adapted nominal model.
        """

    def strains(self, knowledge: System, point: Point) -> Float[Any, " z"]:
        """Return z of the adapted nominal model with this residual."""
        return self.derivatives(knowledge, point)[1]

    def rates(self, knowledge: System, point: Point, z: Float[Any, " z"]) -> Float[Any, " y"]:
        """Return y_s at strains z, which need not be those of the law.

        By default it follows z as the nominal model's y_s does, from `derivatives` on.
        """
        y_s, corrected = self.derivatives(knowledge, point)
        z0 = semi_discrete.strains(knowledge, point)
        here, there = (semi_discrete.rates(knowledge, point, at) for at in (z0, z0 + z - corrected))
        return y_s + there - here

    def law_residual(self, knowledge: System, point: Point, z: Float[Any, " z"]) -> Float[Any, " z"]:
        """Return the residual of the law at z; by default the nominal model's, at z less its correction."""
        corrected = self.strains(knowledge, point)
        z0 = semi_discrete.strains(knowledge, point)
        return semi_discrete.law_residual(knowledge, point, z0 + z - corrected)

    @property
    def linear(self) -> bool:
        """True if `law_residual` is linear in z wherever the nominal model's is."""
        return True

    def tip(
        self, knowledge: System, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]
    ) -> Float[Any, " k"]:
        """Return the residual of the tip's boundary conditions; by default the nominal model's."""
        return knowledge.tip(t, control, y, y_t)

    def clamped(self) -> Self:
        """Return the nearest residual with allowed weights; training calls it after every update."""
        return self

    def coefficients(self) -> dict[str, Float[Any, "..."]]:
        """Return the arrays of `linear_in` by their paths; those that do not exist are left out."""
        found = {path: _at(self, path) for path in self.linear_in}
        return {path: value for path, value in found.items() if value is not None}

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
        return eqx.tree_at(lambda own: [_at(own, name) for name in names], self, [*changes.values()])


def _at(owner: Any, path: str) -> Any:
    """Return the attribute at a path with dots; None if it or an owner of it is None."""
    for name in path.split("."):
        owner = None if owner is None else getattr(owner, name)
    return owner


class Nothing(Residual):
    """No residual: the nominal model unchanged."""

    def derivatives(self, knowledge: System, point: Point) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return y_s and z of the nominal model."""
        return semi_discrete.derivatives(knowledge, point)

    def strains(self, knowledge: System, point: Point) -> Float[Any, " z"]:
        """Return z of the nominal model."""
        return semi_discrete.strains(knowledge, point)

    def rates(self, knowledge: System, point: Point, z: Float[Any, " z"]) -> Float[Any, " y"]:
        """Return y_s of the nominal model at strains z."""
        return semi_discrete.rates(knowledge, point, z)

    def law_residual(self, knowledge: System, point: Point, z: Float[Any, " z"]) -> Float[Any, " z"]:
        """Return the residual of the nominal model's law at z."""
        return semi_discrete.law_residual(knowledge, point, z)


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

    Its inputs are y, the nominal model's z and the actuation; with `history`, ʰy and ʰz too. These depend on
    the time scheme: at rest they are -c0 times y and z in a time step, and zero in an equilibrium. Those of
    the training's time steps, with the same rates y_t and z_t, are the inputs everywhere, so that the model
    is the same in equilibria and at other time steps. The corrected z is an output only: it does not enter
    y_s. With `convex` the weights are nonnegative, so that every output is convex and non-decreasing in every
    input; `clamped` enforces this. Inputs are shifted and scaled, and outputs scaled, by constants stored in
    the model.
    """

    fixed: ClassVar[tuple[str, ...]] = ("input_mean", "input_scale", "output_scale", "history_c0")
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
    history: bool = eqx.field(static=True, default=False)
    convex: bool = eqx.field(static=True, default=True)
    #: c0 of the training's time steps (1/s); None in files of earlier versions: that of each problem
    history_c0: Float[Any, ""] | None = None
    #: first and last + 1 place in y of a quaternion whose length the correction leaves as it is, or None
    quaternion: tuple[int, int] | None = eqx.field(static=True, default=None)

    def inputs(self, knowledge: System, point: Point, z: Float[Any, " z"]) -> Float[Any, " inputs"]:
        """Return the inputs: y, z and the actuation; with history, y, ʰy, z, ʰz and the actuation."""
        force = knowledge.observed.actuation(point.control)
        if self.history:
            past = point.history
            more = 0.0 if self.history_c0 is None else past.c0 - self.history_c0
            return jnp.concatenate([point.y, past.y + more * point.y, z, past.z + more * z, force])
        return jnp.concatenate([point.y, z, force])

    def correction(self, knowledge: System, point: Point, z: Float[Any, " z"]) -> Float[Any, " outputs"]:
        """Return f_θ, the correction of [y_s; z], at the nominal model's z."""
        inputs = (self.inputs(knowledge, point, z) - self.input_mean) / self.input_scale
        hidden = self.input_weights @ inputs + self.input_biases
        added = self.output_scale * (self.output_weights @ elu(hidden) + self.output_biases)
        return self.turning(added, point.y)

    def turning(self, added: Any, y: Any) -> Any:
        """Return corrections (outputs, …) at y (y, …) without the part that lengthens the quaternion.

        That part turns nothing, so data cannot determine it.
        """
        if self.quaternion is None:
            return added
        own = slice(*self.quaternion)
        h, h_s = y[own], added[own]
        return added.at[own].add(-h * (jnp.sum(h * h_s, axis=0) / jnp.sum(h * h, axis=0)))

    def derivatives(self, knowledge: System, point: Point) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return the nominal model's y_s and z plus the correction."""
        y_s, z = semi_discrete.derivatives(knowledge, point)
        added = self.correction(knowledge, point, z)
        return y_s + added[: point.y.shape[0]], z + added[point.y.shape[0] :]

    def strains(self, knowledge: System, point: Point) -> Float[Any, " z"]:
        """Return the nominal model's z plus the correction."""
        z = semi_discrete.strains(knowledge, point)
        return z + self.correction(knowledge, point, z)[point.y.shape[0] :]

    def rates(self, knowledge: System, point: Point, z: Float[Any, " z"]) -> Float[Any, " y"]:
        """Return the nominal model's y_s at z less its correction, plus the correction of y_s."""
        z0 = semi_discrete.strains(knowledge, point)
        added = self.correction(knowledge, point, z0)
        return (
            semi_discrete.rates(knowledge, point, z - added[point.y.shape[0] :]) + added[: point.y.shape[0]]
        )

    def clamped(self) -> Self:
        """Return a convex network with its negative weights set to zero; any other unchanged."""
        if not self.convex:
            return self
        weights = jnp.maximum(self.input_weights, 0.0), jnp.maximum(self.output_weights, 0.0)
        return eqx.tree_at(lambda net: (net.input_weights, net.output_weights), self, weights)


def network(knowledge: System, options: NetworkOptions, key: Any, c0: Any = None) -> Network:
    """Return a network with random initial weights; inputs and outputs are not scaled.

    `c0` (1/s) is that of the training's time steps, for a network with history.

    A convex network starts like the paper's: weights |N(0.01, 0.01)|, biases N(0, 0.01). Any other starts
    with N(0, 1/√inputs) and N(0, 0.1/√hidden), and is therefore close to the nominal model.
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
    layout, kept = knowledge.y_layout, None
    if options.unit_quaternions and "h" in layout.names:
        kept = layout.slice("h").start, layout.slice("h").stop
    return Network(
        first, biases[0], second, biases[1], mean, scale, output_scale, options.history, options.convex,
        c0 if options.history else None, kept,
    )  # fmt: skip


def input_layout(knowledge: System, history: bool) -> Layout:
    """Return the layout of a `Network`'s inputs, for this nominal model."""
    own = [[*layout.fields] for layout in (knowledge.y_layout, knowledge.z_layout)]
    past = [[Field(f"{f.name} past", f.size, f"{f.unit}/s", f"ʰ of {f.name}") for f in part] for part in own]
    size = jax.eval_shape(knowledge.observed.actuation, np.zeros(knowledge.control_size)).shape[0]
    seen = [*own[0], *past[0], *own[1], *past[1]] if history else [*own[0], *own[1]]
    return Layout(*seen, Field("actuation", size, "", "what of the control enters the equations"))


def input_size(knowledge: System, history: bool) -> int:
    """Return the number of inputs of a `Network`, for this nominal model."""
    return input_layout(knowledge, history).size
