"""Sums of simple functions of named vectors: linear, powers, and saturating ones, each with its weights.

The functions of a vector x with the natural size σ, with k a learned slope:

    linear       x/σ
    square       |xᵢ| xᵢ/σ², cube   xᵢ³/σ³, for each component (drag)
    square_norm  |x| x/σ², cube_norm   |x|² x/σ³ (stiffening or softening, in any direction)
    saturating   tanh(k xᵢ/σ)/k, for several k (friction): a hidden layer with units along the axes
    saturating_norm   x/σ / √(1 + k²|x|²/σ²), the same in any direction

With the constant they are the linear path and the network of a structured residual. They are few enough for
least squares, and each can be interpreted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.layout import Layout

LINEAR = ("linear",)
#: functions of velocities: drag is linear or quadratic
DRAG = ("linear", "square")
CURVED = ("linear", "square", "cube", "square_norm", "cube_norm", "saturating", "saturating_norm")
#: initial slopes of the saturating functions
SLOPES = (0.5, 1.0, 2.0, 4.0)


class Term(NamedTuple):
    """One function of one vector: the vector's position, and the indices of its scale and slope."""

    name: str
    start: int
    stop: int
    form: str
    scale: int
    slope: int = -1

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
    slopes: Float[Any, " slopes"]
    terms: tuple[Term, ...] = eqx.field(static=True)

    def features(self, x: Float[Any, " x"]) -> Float[Any, " features"]:
        """Return the functions' values, the constant first."""
        values = [
            _value(term, x[term.start : term.stop] / self.scales[term.scale], self.slopes)
            for term in self.terms
        ]
        return jnp.concatenate([jnp.ones(1), *values])

    def __call__(self, x: Float[Any, " x"]) -> Float[Any, " outputs"]:
        """Return the weighted sum."""
        if all(term.form == "linear" for term in self.terms):
            # one small product of numbers that do not change along the rod
            sizes = jnp.concatenate(
                [jnp.ones(1), *(jnp.full(t.size, self.scales[t.scale]) for t in self.terms)]
            )
            weights = self.weights / sizes
            inputs = (
                jnp.concatenate([x[term.start : term.stop] for term in self.terms]) if self.terms else x[:0]
            )
            return weights[:, 0] + weights[:, 1:] @ inputs
        return self.weights @ self.features(x)

    @property
    def curved(self) -> bool:
        """True if there are nonlinear functions."""
        return any(term.form != "linear" for term in self.terms)

    def labels(self) -> list[str]:
        """Return a name for every feature, the constant first."""
        names = ["1"]
        for term in self.terms:
            axes = "xyz" if term.size == 3 else [str(i + 1) for i in range(term.size)]
            suffix = "" if term.form == "linear" else f" {term.form.replace('_', ' ')}"
            names += [f"{term.name}{suffix} {axis}" if term.size > 1 else term.name + suffix for axis in axes]
        return names

    def columns(self) -> list[tuple[Term, range]]:
        """Return each term with the indices of its features."""
        starts = np.cumsum([1, *(term.size for term in self.terms)])
        return [
            (term, range(start, start + term.size)) for term, start in zip(self.terms, starts, strict=False)
        ]

    def columns_of(self, other: Self) -> list[int]:
        """Return the indices here of another expansion's features; its terms must be a subset."""
        own = {(term.name, term.form, term.slope): where for term, where in self.columns()}
        return [0, *(k for term in other.terms for k in own[term.name, term.form, term.slope])]

    def owned(self) -> Any:
        """Return true where a feature depends on a slope (slopes, features)."""
        owned = np.zeros((len(self.slopes), self.weights.shape[1]), dtype=bool)
        for term, where in self.columns():
            if term.slope >= 0:
                owned[term.slope, where] = True
        return owned

    def kinds(self) -> list[tuple[str, str]]:
        """Return the vector and the form of each slope."""
        found = {term.slope: (term.name, term.form) for term in self.terms if term.slope >= 0}
        return [found.get(k, ("", "")) for k in range(len(self.slopes))]

    def pruned(self) -> Self | None:
        """Return a copy without terms of zero weight; None if all weights are zero."""
        used = np.any(np.asarray(self.weights) != 0.0, axis=0)
        if not used.any():
            return None
        keep = [(term, where) for term, where in self.columns() if used[list(where)].any()]
        columns = [0, *(k for _, where in keep for k in where)]
        return type(self)(self.weights[:, columns], self.scales, self.slopes, tuple(term for term, _ in keep))


def _value(term: Term, x: Any, slopes: Any) -> Any:
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
    slope = slopes[term.slope]
    if term.form == "saturating_norm":
        return x / jnp.sqrt(1.0 + slope**2 * jnp.sum(x * x))
    return jnp.tanh(slope * x) / slope


def expansion(
    layout: Layout, values: Float[Any, "S x"], forms: dict[str, Sequence[str]], outputs: int
) -> Expansion:
    """Return an expansion with zero weights, scaled by the vectors' rms values in the data."""
    terms: list[Term] = []
    scales: list[float] = []
    slopes: list[float] = []
    for k, field in enumerate(layout.fields):
        where = layout.slice(field.name)
        rms = float(np.sqrt(np.mean(np.square(values[:, where]))))
        scales.append(rms if rms > 0.0 else 1.0)
        for form in forms.get(field.name, LINEAR):
            if field.size == 1 and form.endswith("_norm"):
                continue  # the same as by itself
            if not form.startswith("saturating"):
                terms.append(Term(field.name, where.start, where.stop, form, k))
                continue
            for slope in SLOPES:
                terms.append(Term(field.name, where.start, where.stop, form, k, len(slopes)))
                slopes.append(slope)
    count = 1 + sum(term.size for term in terms)
    return Expansion(np.zeros((outputs, count)), np.array(scales), np.array(slopes), tuple(terms))
