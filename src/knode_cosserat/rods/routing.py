"""Routing of tendons in the rod, from the base to their anchors.

A routing gives the point where its tendon crosses the section at σ = s/L: (x, y) in metres in the material
frame, whose third axis is along the rod. σ runs from 0 to 1 over the whole rod, also for a tendon that is
anchored before the tip.
"""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.parameters import ParameterError, known_size, parameter, place
from knode_cosserat.rods.parts import Part
from knode_cosserat.rods.tendon_law import stretches

#: points of Gauss quadrature for the length of a tendon in the unloaded robot
GAUSS = 24
#: points at which the turns of a function's path are measured
SAMPLES = 1001


class Routing(Part):
    """The path of one tendon. `end` is the fraction of the length at which it is anchored."""

    end: float = place("where the tendon is anchored", low=1e-3, default=1.0, kw_only=True)

    @property
    def total_turn(self) -> float:
        """Angle (rad) through which the tendon turns over the rod: its way across it over its distance."""
        return 0.0

    @abc.abstractmethod
    def at(self, sigma: Any) -> tuple[Any, Any]:
        """Return x and y (m) at σ. JAX-traceable."""

    def rate(self, sigma: Any) -> tuple[Any, Any]:
        """Return the derivatives of x and y with respect to σ (m)."""
        sigma = jnp.asarray(sigma, dtype=float)
        x_s, y_s = jax.jvp(self.at, (sigma,), (jnp.ones_like(sigma),))[1]
        return x_s, y_s


class Straight(Routing):
    """A straight routing beside the rod, at a constant place of the section."""

    kind: ClassVar[str] = "straight"

    x: Any = parameter("m", "place in the section", low=-1.0, high=1.0)
    y: Any = parameter("m", "place in the section", low=-1.0, high=1.0)

    def at(self, sigma: Any) -> tuple[Any, Any]:
        """Return the constant place."""
        return self.x, self.y

    def rate(self, sigma: Any) -> tuple[Any, Any]:
        """Return zero."""
        return np.zeros(()), np.zeros(())


class Tapered(Routing):
    """A routing at a constant angle, with a distance from the axis that changes linearly down to its end."""

    kind: ClassVar[str] = "tapered"

    base_offset: Any = parameter("m", "distance from the axis at the base", low=-1.0, high=1.0)
    end_offset: Any = parameter("m", "distance from the axis where it is anchored", low=-1.0, high=1.0)
    angle: Any = parameter("rad", "angle about the rod, from x to y", low=-10.0, high=10.0, default=0.0)

    def at(self, sigma: Any) -> tuple[Any, Any]:
        """Return the point on a straight line in σ, from the base to `end`."""
        offset = self.base_offset + (self.end_offset - self.base_offset) * (sigma / self.end)
        return offset * jnp.cos(self.angle), offset * jnp.sin(self.angle)

    def rate(self, sigma: Any) -> tuple[Any, Any]:
        """Return the constant slope."""
        slope = (self.end_offset - self.base_offset) / self.end
        return slope * jnp.cos(self.angle), slope * jnp.sin(self.angle)


class Helical(Routing):
    """A helix around the rod, at a constant distance from the axis."""

    kind: ClassVar[str] = "helical"

    radius: Any = parameter("m", "distance from the axis", low=0.0, high=1.0)
    phase: Any = parameter("rad", "angle about the rod at the base, from x to y", low=-10.0, high=10.0)
    turns: Any = parameter(
        "", "turns over the whole length of the rod, from x to y if positive", low=-1e3, high=1e3
    )

    @property
    def total_turn(self) -> float:
        """Angle of its turns (rad)."""
        return 2.0 * np.pi * known_size(self.turns)

    def at(self, sigma: Any) -> tuple[Any, Any]:
        """Return the point on a circle about the axis."""
        angle = self.phase + 2.0 * np.pi * self.turns * sigma
        return self.radius * jnp.cos(angle), self.radius * jnp.sin(angle)

    def rate(self, sigma: Any) -> tuple[Any, Any]:
        """Return the tangent of that circle."""
        x, y = self.at(sigma)
        speed = 2.0 * np.pi * self.turns
        return -speed * y, speed * x


class Polynomial(Routing):
    """A routing with polynomials x and y of σ: any number of coefficients, from 1, σ, σ² on."""

    kind: ClassVar[str] = "polynomial"

    x: Any = parameter("m", "coefficients of x, from the constant on", shape="list", low=-1e3, high=1e3)
    y: Any = parameter("m", "coefficients of y, from the constant on", shape="list", low=-1e3, high=1e3)

    def at(self, sigma: Any) -> tuple[Any, Any]:
        """Return the polynomials' values, by Horner's rule."""
        return _horner(self.x, sigma), _horner(self.y, sigma)

    def rate(self, sigma: Any) -> tuple[Any, Any]:
        """Return the polynomials' derivatives."""
        return _horner(_derivative(self.x), sigma), _horner(_derivative(self.y), sigma)


class FunctionRouting(Routing):
    """Any function of σ that returns x and y (m), written with `jax.numpy`. Robot files cannot hold it."""

    function: Callable[[Any], tuple[Any, Any]] = eqx.field(static=True)  # type: ignore[misc]

    @property
    def total_turn(self) -> float:
        """Angle of the path of the function's values."""
        return _path_winding(self.function)

    def at(self, sigma: Any) -> tuple[Any, Any]:
        """Return the function's value."""
        x, y = self.function(sigma)
        return x, y

    def __check_init__(self) -> None:
        super().__check_init__()
        allowed = "allowed is a JAX-traceable function of σ that gives two numbers, x and y"
        if not callable(self.function):
            raise ParameterError(f"FunctionRouting: function is {self.function!r}; {allowed}")
        try:
            result = jax.eval_shape(self.function, jnp.zeros(()))
        except Exception as error:
            first = (str(error).splitlines() or [""])[0]
            raise ParameterError(
                f"FunctionRouting: function raises {type(error).__name__}: {first}; {allowed}"
            ) from None
        shapes = [np.shape(part) for part in result] if isinstance(result, tuple | list) else result
        if shapes != [(), ()]:
            raise ParameterError(f"FunctionRouting: function gives shapes {shapes}; {allowed}")


@functools.lru_cache(maxsize=256)
def _path_winding(function: Callable[[Any], tuple[Any, Any]]) -> float:
    """Return the length of a tendon's path across the rod, over its largest distance from the axis."""
    with jax.ensure_compile_time_eval():
        x, y = map(np.asarray, jax.vmap(function)(jnp.linspace(0.0, 1.0, SAMPLES)))
    way, most = np.sum(np.hypot(np.diff(x), np.diff(y))), np.max(np.hypot(x, y))
    return float(way / most) if most > 0.0 else 0.0


class OffsetPaths(NamedTuple):
    """Paths of tendons at a distance (m) from the axis, or one each, turned by `twist` (rad) to the tip."""

    offset: Any
    angles: Float[Any, " c"]
    twist: Any
    length: Any

    @property
    def winding(self) -> float:
        """Angle (rad) through which the tendons turn about the rod."""
        return known_size(self.twist)

    @property
    def straight(self) -> bool:
        """True if the tendons do not turn about the rod."""
        return self.twist is None

    @property
    def ends(self) -> tuple[float, ...]:
        """Fractions of the length at which the tendons are anchored."""
        return (1.0,) * np.shape(self.angles)[-1]

    @property
    def routings(self) -> tuple[Routing, ...]:
        """Routings of the tendons."""
        angles = jnp.asarray(self.angles)
        if self.twist is not None:
            offsets: Any = jnp.broadcast_to(self.offset, angles.shape)
            turns = self.twist / (2.0 * np.pi)
            return tuple(Helical(offsets[k], angles[k], turns) for k in range(angles.shape[0]))
        x, y = self.offset * jnp.cos(angles), self.offset * jnp.sin(angles)
        return tuple(Straight(x[k], y[k]) for k in range(angles.shape[0]))

    def routes(self, s: Any) -> tuple[Float[Any, "c 3"], Float[Any, "c 3"]]:
        """Return r (m) and r′ of the tendons at s (m)."""
        angles = self._angles(s)
        offset = self.offset if np.ndim(self.offset) == 0 else self.offset[:, None]
        r = offset * jnp.stack([jnp.cos(angles), jnp.sin(angles), jnp.zeros_like(angles)], axis=-1)
        if self.twist is None:
            return r, np.zeros(r.shape)
        across = jnp.stack([-r[:, 1], r[:, 0], jnp.zeros_like(angles)], axis=-1)
        return r, self.twist / self.length * across

    def directions(self, s: Any) -> Float[Any, "c 3"]:
        """Return eᵢ: the direction of u in which each tendon bends the rod at s (m), material frame."""
        angles = self._angles(s)
        return jnp.stack([-jnp.sin(angles), jnp.cos(angles), jnp.zeros_like(angles)], axis=-1)

    def _angles(self, s: Any) -> Float[Any, " c"]:
        angles = jnp.asarray(self.angles)
        return angles if self.twist is None else angles + self.twist * (s / self.length)


class RoutedPaths(NamedTuple):
    """Paths of tendons with a routing each, in a rod of a length (m)."""

    routings: tuple[Routing, ...]
    length: Any

    @property
    def winding(self) -> float:
        """Largest angle (rad) through which a tendon turns about the rod."""
        return max(routing.total_turn for routing in self.routings)

    @property
    def straight(self) -> bool:
        """False: the tendons may turn about the rod."""
        return False

    @property
    def ends(self) -> tuple[float, ...]:
        """Fractions of the length at which the tendons are anchored."""
        return tuple(float(routing.end) for routing in self.routings)

    def routes(self, s: Any) -> tuple[Float[Any, "c 3"], Float[Any, "c 3"]]:
        """Return r (m) and r′ of the tendons at s (m)."""
        return routes(self.routings, s / self.length, self.length)

    def directions(self, s: Any) -> Float[Any, "c 3"]:
        """Return eᵢ: the direction of u in which each tendon bends the rod at s (m), material frame."""
        r, _ = self.routes(s)
        across = jnp.stack([-r[:, 1], r[:, 0], jnp.zeros_like(r[:, 0])], axis=-1)
        return across / jnp.sqrt(jnp.sum(across * across, axis=1, keepdims=True) + 1e-24)


def routes(
    routings: Sequence[Routing], sigma: Any, length: Any
) -> tuple[Float[Any, "c 3"], Float[Any, "c 3"]]:
    """Return r (m) of all tendons at σ, and r′, its derivative with respect to s.

    If no routing depends on σ, the result is one constant array for all nodes.
    """
    r = _vectors([routing.at(sigma) for routing in routings])
    if all(isinstance(routing, Straight) for routing in routings):
        return r, np.zeros(r.shape)
    return r, _vectors([routing.rate(sigma) for routing in routings]) / length


def path_lengths(
    routings: Sequence[Routing], s: Any, length: Any, strains: Callable[[Any], Any]
) -> Float[Any, " c"]:
    """Return the tendons' lengths (m) in an unstressed rod from the base to s, by Gauss quadrature.

    `strains` returns v and u at an arclength (m).
    """
    nodes, weights = np.polynomial.legendre.leggauss(GAUSS)
    lengths = []
    for routing in routings:
        last = jnp.minimum(s, routing.end * length)
        at = 0.5 * (nodes + 1.0) * jnp.asarray(last)[..., None]

        def stretched(place: Any, routing: Routing = routing) -> Any:
            r, r_s = routes((routing,), place / length, length)
            return stretches(*map(jnp.asarray, (*strains(place), r, r_s)))[0]

        lengths.append(0.5 * last * jnp.sum(weights * jax.vmap(stretched)(at)))
    return jnp.stack(lengths)


def _vectors(places: list[tuple[Any, Any]]) -> Any:
    numeric = jnp if any(isinstance(x, jax.Array) for place in places for x in place) else np
    return numeric.stack([numeric.stack([x, y, np.zeros(())]) for x, y in places])


def _horner(coefficients: Any, sigma: Any) -> Any:
    total = coefficients[-1]
    for k in reversed(range(coefficients.shape[0] - 1)):
        total = total * sigma + coefficients[k]
    return total


def _derivative(coefficients: Any) -> Any:
    count = coefficients.shape[0]
    return coefficients[1:] * np.arange(1.0, count) if count > 1 else np.zeros(1)
