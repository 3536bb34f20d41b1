"""Structured residual: mechanical corrections of length, constitutive law, loads and tip.

    length      L (1 + γ)
    material    C z + D z_t + σ(z - z*, z_t) = f2: the strains are corrected before the kinematics use them
    loads       + R f(material-frame observables) + g(control): on the balance equations only
    tip         + the same two at the tip: a mass, a weight, a force that the nominal model lacks

The geometry (p_s, h_s, q_s, ω_s of a rod) stays exact, and the laws do not depend on the time step. Each of
σ, f and g is an `Expansion`: a weighted sum of simple functions of named vectors. A system's layouts mark
loads and rotated fields (`Field.frame`, `Field.load`); without such marks every rate may be corrected.

The functions of a vector x with the natural size σ, with k one of several slopes:

    linear       x/σ
    square       |xᵢ| xᵢ/σ², cube   xᵢ³/σ³, for each component (drag)
    square_norm  |x| x/σ², cube_norm   |x|² x/σ³ (stiffening or softening, in any direction)
    saturating   tanh(k xᵢ/σ)/k (friction): a hidden layer with units along the axes
    saturating_norm   x/σ / √(1 + k²|x|²/σ²), the same in any direction

They are few enough for least squares, and each can be interpreted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.residual import Residual
from knode_cosserat.rods.aspects import Ends, Observed
from knode_cosserat.rods.law import StressedLaw
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parts import RodPoint
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import with_length_factor
from knode_cosserat.rotation import dot, rotation_matrix

LINEAR = ("linear",)
#: functions of velocities: drag is linear or quadratic
DRAG = ("linear", "square")
CURVED = ("linear", "square", "cube", "square_norm", "cube_norm", "saturating", "saturating_norm")
#: slopes of the saturating functions: a saturation in between is a sum of two
SLOPES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)


class Term(NamedTuple):
    """One function of one vector: the vector's position, the index of its scale, and the slope."""

    name: str
    start: int
    stop: int
    form: str
    scale: int
    slope: float = 0.0

    @property
    def size(self) -> int:
        """Number of values of the function."""
        return self.stop - self.start


class Expansion(eqx.Module):
    """Weighted sum (outputs,) of functions of a packed vector (x,)."""

    #: attributes that gradient training does not change
    fixed: ClassVar[tuple[str, ...]] = ("scales",)

    #: (outputs, 1 + features), the constant first
    weights: Float[Any, "outputs features"]
    scales: Float[Any, " vectors"]
    terms: tuple[Term, ...] = eqx.field(static=True)

    def features(self, x: Float[Any, " x"]) -> Float[Any, " features"]:
        """Return the functions' values, the constant first."""
        values = [_value(term, x[term.start : term.stop] / self.scales[term.scale]) for term in self.terms]
        return jnp.concatenate([jnp.ones(1), *values])

    def __call__(self, x: Float[Any, " x"]) -> Float[Any, " outputs"]:
        """Return the weighted sum."""
        if self.curved:
            return self.weights @ self.features(x)
        # one small product of numbers that do not change along the rod
        sizes = [jnp.full(term.size, self.scales[term.scale]) for term in self.terms]
        weights = self.weights / jnp.concatenate([jnp.ones(1), *sizes])
        inputs = jnp.concatenate([x[:0], *(x[term.start : term.stop] for term in self.terms)])
        return weights[:, 0] + weights[:, 1:] @ inputs

    @property
    def curved(self) -> bool:
        """True if there are nonlinear functions."""
        return any(term.form != "linear" for term in self.terms)

    def columns(self) -> list[tuple[Term, range]]:
        """Return each term with the indices of its features."""
        starts = np.cumsum([1, *(term.size for term in self.terms)]).tolist()
        return [
            (term, range(start, start + term.size)) for term, start in zip(self.terms, starts, strict=False)
        ]

    def pruned(self) -> Self | None:
        """Return a copy without terms of zero weight; None if all weights are zero."""
        used = np.any(np.asarray(self.weights) != 0.0, axis=0)
        if not used.any():
            return None
        keep = [(term, where) for term, where in self.columns() if used[list(where)].any()]
        columns = [0, *(k for _, where in keep for k in where)]
        return type(self)(self.weights[:, columns], self.scales, tuple(term for term, _ in keep))


def _value(term: Term, x: Any) -> Any:
    if term.form == "linear":
        return x
    if term.form == "square":
        return x * jnp.abs(x)
    if term.form == "cube":
        return x * x * x
    if term.form == "square_norm":
        # the square root of zero has no derivative
        return x * jnp.sqrt(jnp.sum(x * x) + 1e-24)
    if term.form == "cube_norm":
        return x * jnp.sum(x * x)
    if term.form == "saturating_norm":
        return x / jnp.sqrt(1.0 + term.slope**2 * jnp.sum(x * x))
    return jnp.tanh(term.slope * x) / term.slope


def expansion(
    layout: Layout, values: Float[Any, "S x"], forms: Mapping[str, Sequence[str]], outputs: int
) -> Expansion:
    """Return an expansion with zero weights, scaled by the vectors' rms values in the data."""
    terms: list[Term] = []
    scales: list[float] = []
    for k, field in enumerate(layout.fields):
        where = layout.slice(field.name)
        rms = float(np.sqrt(np.mean(np.square(values[:, where]))))
        scales.append(rms if rms > 0.0 else 1.0)
        for form in forms.get(field.name, LINEAR):
            if field.size == 1 and form.endswith("_norm"):
                continue  # the same function as for the component
            slopes = SLOPES if form.startswith("saturating") else (0.0,)
            terms += [Term(field.name, where.start, where.stop, form, k, slope) for slope in slopes]
    count = 1 + sum(term.size for term in terms)
    return Expansion(np.zeros((outputs, count)), np.array(scales), tuple(terms))


class Load(eqx.Module):
    """A load in the material frame, of observables and control, and a global load, of the control."""

    material: Expansion | None
    ambient: Expansion | None

    def __call__(
        self, layout: Layout, frames: Layout, y: Float[Any, " y"], observables: Any, control: Any
    ) -> Float[Any, " l"]:
        """Return the load, laid out by `layout`, in the frames of the equations."""
        total = jnp.zeros(layout.size)
        if self.material is not None:
            load = self.material(jnp.concatenate([observables, control]))
            parts = layout.split(load)
            total = jnp.concatenate(
                [
                    dot(rotation_matrix(frames.get(y, field.frame)), part) if field.frame else part
                    for field, part in zip(layout.fields, parts, strict=True)
                ]
            )
        return total if self.ambient is None else total + self.ambient(control)


class Structured(Residual):
    """Structured residual (see the module). Unused parts are None, and cost nothing."""

    linear_in: ClassVar[tuple[str, ...]] = (
        "stretch",
        "stress.weights",
        "load.material.weights",
        "load.ambient.weights",
        "tip_load.material.weights",
        "tip_load.ambient.weights",
        "at_base.weights",
    )

    stretch: Float[Any, ""]
    stress: Expansion | None
    load: Load | None
    tip_load: Load | None
    #: change of what follows from the unknowns at the base by a law (`Observed.base_law`)
    at_base: Expansion | None = None

    def adapted(self, knowledge: System) -> System:
        """Return the nominal model with corrected length."""
        return with_length_factor(knowledge, 1.0 + self.stretch)

    def constitutive(self, knowledge: System, s: Any, t: Any, y: Any, y_t: Any, control: Any) -> Any:
        """Return the nominal law with the learned stress."""
        law, stress = knowledge.constitutive(s, t, y, y_t, control), self.stress
        if stress is None:
            return law
        inputs = Observed.of(knowledge).law_inputs(s, y, control)
        return StressedLaw(law, lambda z, z_t: stress(inputs(z, z_t)), not stress.curved)

    def balance(
        self, knowledge: System, s: Any, t: Any, y: Any, y_t: Any, z: Any, z_t: Any, control: Any
    ) -> Any:
        """Return the nominal balance with the learned loads."""
        balance = knowledge.balance(s, t, y, y_t, z, z_t, control)
        if self.load is None:
            return balance
        aspect, observed = Observed.of(knowledge), None
        if self.load.material is not None:
            observed = aspect.observables(RodPoint(knowledge, s, t, y, y_t, control, z=z, z_t=z_t))
        layout = loaded(knowledge)
        load = self.load(layout, knowledge.y_layout, y, observed, aspect.ambient(s, control))
        load = load * aspect.load_factor(s, control)
        load = jnp.zeros(y.shape[0]).at[knowledge.y_layout.indices(layout.names)].set(load)
        if not isinstance(balance, tuple):
            return balance + load
        A, B, f1 = balance
        return A, B, f1 + load

    def base(self, knowledge: System, t: Any, control: Any, unknowns: Float[Any, " k"]) -> Float[Any, " y"]:
        """Return the nominal model's y at the base with the learned change of what follows by a law."""
        y, aspect = knowledge.base(t, control, unknowns), Observed.of(knowledge)
        if self.at_base is None:
            return y
        values = y[knowledge.y_layout.indices(aspect.base_law)]
        change = self.at_base(aspect.base_inputs(y, control))
        return knowledge.y_layout.replaced(y, aspect.base_law, values + change)

    def tip(
        self, knowledge: System, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]
    ) -> Float[Any, " k"]:
        """Return the nominal model's conditions at the tip plus the learned tip load."""
        conditions = knowledge.tip(t, control, y, y_t)
        if self.tip_load is None:
            return conditions
        observed = tip_observables(knowledge, y, y_t, control)
        inputs = Observed.of(knowledge).ambient(knowledge.length, control)
        return conditions + self.tip_load(Ends.of(knowledge).layout, knowledge.y_layout, y, observed, inputs)


def tip_observables(knowledge: System, y: Float[Any, " y"], y_t: Any, control: Any) -> Any:
    """Return the observables for a tip load, without the strains there, which it determines itself."""
    s = knowledge.length
    _, z = knowledge.rest(s)
    point = RodPoint(knowledge, s, None, y, y_t, control, z=z, z_t=jnp.zeros_like(z))
    return Observed.of(knowledge).observables(point)


def loaded(knowledge: System) -> Layout:
    """Return the fields of y whose rates balance loads; all fields if none is marked."""
    stated = tuple(field for field in knowledge.y_layout.fields if field.load)
    return Layout(*stated) if stated else knowledge.y_layout


def material_layout(knowledge: System) -> Layout:
    """Return the input layout of a material-frame load: the observables, and the ambient inputs."""
    return Observed.of(knowledge).layout + Observed.of(knowledge).ambient_layout
