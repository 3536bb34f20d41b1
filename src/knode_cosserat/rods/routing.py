"""Where tendons run in the rod, from the base to where they are anchored.

A routing says where its tendon crosses the section at σ = s/L: (x, y) in metres in the material frame, whose
third axis is along the rod. σ runs from 0 to 1 over the whole rod, also for a tendon that ends before.

Where n and m carry rod and tendons they are continuous where a tendon ends: it suffices that its tension is 0
from there on. (n and m of the rod alone jump, by that tendon's pull and by the kinks that the others get.)
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.parameters import ParameterError, checked, parameter, parameters_of


class Routing(eqx.Module):
    """The way of one tendon. `end` is the part of the length at which it is anchored."""

    #: what robot files call it
    kind: ClassVar[str]

    end: float = eqx.field(static=True, default=1.0, kw_only=True)

    @abc.abstractmethod
    def at(self, sigma: Any) -> tuple[Any, Any]:
        """x and y (m) at σ. JAX-traceable."""

    def rate(self, sigma: Any) -> tuple[Any, Any]:
        """Derivatives of x and y with respect to σ (m)."""
        sigma = jnp.asarray(sigma, dtype=float)
        x_s, y_s = jax.jvp(self.at, (sigma,), (jnp.ones_like(sigma),))[1]
        return x_s, y_s

    def __check_init__(self) -> None:
        name, end = type(self).__name__, self.end
        given: Any = end
        number = isinstance(given, int | float | np.number) and not isinstance(given, bool)
        if not number or not 0.0 < end <= 1.0:
            raise ParameterError(
                f"{name}: end is {end!r}; allowed is a number above 0, up to 1: the part of the length where "
                "the tendon is anchored"
            )
        for field, stated in parameters_of(type(self)).items():
            try:
                checked(field, getattr(self, field), stated)
            except ParameterError as error:
                raise ParameterError(f"{name}: {error}") from None


class Straight(Routing):
    """Beside the rod, always at the same place of the section."""

    kind: ClassVar[str] = "straight"

    x: Any = parameter("m", "place in the section", low=-1.0, high=1.0)
    y: Any = parameter("m", "place in the section", low=-1.0, high=1.0)

    def at(self, sigma: Any) -> tuple[Any, Any]:
        """The same at every σ."""
        return self.x, self.y

    def rate(self, sigma: Any) -> tuple[Any, Any]:
        """None."""
        return np.zeros(()), np.zeros(())


class Tapered(Routing):
    """At one angle about the rod, with a distance from the axis that changes evenly down to its end."""

    kind: ClassVar[str] = "tapered"

    base_offset: Any = parameter("m", "distance from the axis at the base", low=-1.0, high=1.0)
    end_offset: Any = parameter("m", "distance from the axis where it is anchored", low=-1.0, high=1.0)
    angle: Any = parameter("rad", "angle about the rod, from x to y", low=-10.0, high=10.0, default=0.0)

    def at(self, sigma: Any) -> tuple[Any, Any]:
        """A straight line in σ, from the base to `end`."""
        offset = self.base_offset + (self.end_offset - self.base_offset) * (sigma / self.end)
        return offset * jnp.cos(self.angle), offset * jnp.sin(self.angle)

    def rate(self, sigma: Any) -> tuple[Any, Any]:
        """The same at every σ."""
        slope = (self.end_offset - self.base_offset) / self.end
        return slope * jnp.cos(self.angle), slope * jnp.sin(self.angle)


class Helical(Routing):
    """Around the rod, always at the same distance from the axis."""

    kind: ClassVar[str] = "helical"

    radius: Any = parameter("m", "distance from the axis", low=0.0, high=1.0)
    phase: Any = parameter("rad", "angle about the rod at the base, from x to y", low=-10.0, high=10.0)
    turns: Any = parameter(
        "", "turns over the whole length of the rod, from x to y if positive", low=-1e3, high=1e3
    )

    def at(self, sigma: Any) -> tuple[Any, Any]:
        """On a circle about the axis."""
        angle = self.phase + 2.0 * np.pi * self.turns * sigma
        return self.radius * jnp.cos(angle), self.radius * jnp.sin(angle)

    def rate(self, sigma: Any) -> tuple[Any, Any]:
        """Along that circle."""
        x, y = self.at(sigma)
        speed = 2.0 * np.pi * self.turns
        return -speed * y, speed * x


class Polynomial(Routing):
    """x and y are polynomials of σ: the coefficients of 1, σ, σ², … each, as many as one likes."""

    kind: ClassVar[str] = "polynomial"

    x: Any = parameter("m", "coefficients of x, from the constant on", shape="list", low=-1e3, high=1e3)
    y: Any = parameter("m", "coefficients of y, from the constant on", shape="list", low=-1e3, high=1e3)

    def at(self, sigma: Any) -> tuple[Any, Any]:
        """By Horner's rule."""
        return _horner(self.x, sigma), _horner(self.y, sigma)

    def rate(self, sigma: Any) -> tuple[Any, Any]:
        """The polynomials' derivatives."""
        return _horner(_derived(self.x), sigma), _horner(_derived(self.y), sigma)


class FunctionRouting(Routing):
    """Any function of σ that gives x and y (m), written with `jax.numpy`. Robot files cannot hold it."""

    kind: ClassVar[str] = "function"

    function: Callable[[Any], tuple[Any, Any]] = eqx.field(static=True)

    def at(self, sigma: Any) -> tuple[Any, Any]:
        """What the function says."""
        x, y = self.function(sigma)
        return x, y

    def __check_init__(self) -> None:
        allowed = "allowed is a JAX-traceable function of σ that gives two numbers, x and y"
        if not callable(self.function):
            raise ParameterError(f"FunctionRouting: function is {self.function!r}; {allowed}")
        try:
            given = jax.eval_shape(self.function, jnp.zeros(()))
        except Exception as error:
            first = (str(error).splitlines() or [""])[0]
            raise ParameterError(
                f"FunctionRouting: function raises {type(error).__name__}: {first}; {allowed}"
            ) from None
        shapes = [np.shape(part) for part in given] if isinstance(given, tuple | list) else given
        if shapes != [(), ()]:
            raise ParameterError(f"FunctionRouting: function gives shapes {shapes}; {allowed}")


#: the routings that a robot file can name as a kind
KINDS: dict[str, type[Routing]] = {
    routing.kind: routing for routing in (Straight, Tapered, Helical, Polynomial)
}


def routes(
    routings: Sequence[Routing], sigma: Any, length: Any
) -> tuple[Float[Any, "c 3"], Float[Any, "c 3"]]:
    """r (m) of all tendons at σ, and r′, its derivative with respect to s.

    Where no routing depends on σ neither does the result: it is the same array for all nodes.
    """
    r = _vectors([routing.at(sigma) for routing in routings])
    if all(isinstance(routing, Straight) for routing in routings):
        return r, np.zeros(r.shape)
    return r, _vectors([routing.rate(sigma) for routing in routings]) / length


def ends(routings: Sequence[Routing]) -> np.ndarray:
    """The parts of the length (c,) at which the tendons are anchored: from there on their tension is 0."""
    return np.array([routing.end for routing in routings], dtype=float)


def _vectors(places: list[tuple[Any, Any]]) -> Any:
    numeric = jnp if any(isinstance(x, jax.Array) for place in places for x in place) else np
    return numeric.stack([numeric.stack([x, y, np.zeros(())]) for x, y in places])


def _horner(coefficients: Any, sigma: Any) -> Any:
    total = coefficients[-1]
    for k in reversed(range(coefficients.shape[0] - 1)):
        total = total * sigma + coefficients[k]
    return total


def _derived(coefficients: Any) -> Any:
    count = coefficients.shape[0]
    return coefficients[1:] * np.arange(1.0, count) if count > 1 else np.zeros(1)
