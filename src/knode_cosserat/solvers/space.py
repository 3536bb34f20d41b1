"""One segment of the rod: from y at a node to y at the next."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

#: y_s at (s, y, what is known there: a record of history)
SpatialDerivative = Callable[[Any, Any, Any], Any]


@dataclasses.dataclass(frozen=True)
class SpaceScheme(abc.ABC):
    """An explicit one-step scheme in arclength."""

    #: whether history is needed in the middle of a segment
    uses_middle = False

    @property
    @abc.abstractmethod
    def order(self) -> int:
        """Order of convergence in the segment's length."""

    @abc.abstractmethod
    def advance(
        self, y_s: SpatialDerivative, s: Any, ds: Any, y: Float[Any, " y"], known: tuple[Any, Any, Any]
    ) -> Float[Any, " y"]:
        """y at s + ds from y at s; `known` is what `y_s` is given of s, s + ds/2 and s + ds: the history."""


@dataclasses.dataclass(frozen=True)
class Euler(SpaceScheme):
    """Forward Euler, the paper's. Order 1: at 10 nodes a few per cent of the tip's deflection."""

    order = 1

    def advance(self, y_s, s, ds, y, known):  # type: ignore[no-untyped-def]
        """One evaluation, at the segment's start."""
        return y + ds * y_s(s, y, known[0])


#: where the stages of the classical scheme are, as parts of the segment, and what each counts
RK4_PARTS, RK4_WEIGHTS = np.array([0.0, 0.5, 0.5, 1.0]), np.array([1.0, 2.0, 2.0, 1.0]) / 6


@dataclasses.dataclass(frozen=True)
class RK4(SpaceScheme):
    """The classical Runge-Kutta scheme. Order 4, four evaluations a segment."""

    order = 4
    uses_middle = True

    def advance(self, y_s, s, ds, y, known):  # type: ignore[no-untyped-def]
        """Evaluations at the start, twice in the middle, and at the end."""
        start, middle, end = known
        # a loop, for four copies of the equations take several times as long to compile, and are no faster
        stages = jax.tree.map(lambda *each: jnp.stack(each), start, middle, middle, end)

        def stage(reached: tuple[Any, Any], given: tuple[Any, Any, Any]) -> Any:
            total, k = reached
            part, weight, there = given
            k = y_s(s + part * ds, y + part * ds * k, there)
            return (total + weight * ds * k, k), None

        # the first stage takes nothing of k: any will do that has slopes and batches as it will have, or JAX
        # traces the equations twice to find out
        (total, _), _ = jax.lax.scan(stage, (y, y), (RK4_PARTS, RK4_WEIGHTS, stages))
        return total


SCHEMES: dict[str, SpaceScheme] = {"euler": Euler(), "rk4": RK4()}


def middles(values: Float[Any, "nodes x"]) -> Float[Any, "segments x"]:
    """Values half-way between neighbouring nodes, by cubic interpolation.

    Order 4, like RK4: a mean of two neighbours would hold the whole solution to order 2.
    """
    count = values.shape[0]
    if count < 4:
        return (values[:-1] + values[1:]) / 2
    inner = (9 * (values[1:-2] + values[2:-1]) - values[:-3] - values[3:]) / 16
    first = (5 * values[0] + 15 * values[1] - 5 * values[2] + values[3]) / 16
    last = (5 * values[-1] + 15 * values[-2] - 5 * values[-3] + values[-4]) / 16
    return jnp.concatenate([first[None], inner, last[None]])


class Along(NamedTuple):
    """What is carried along a segment: `begin(y)` at its start, then `on(advance, state)` over each part."""

    begin: Callable[[Any], Any]
    on: Callable[[Callable[[Any], Any], Any], Any]


def _with_slopes(y: Any) -> tuple[Any, Any]:
    return y, jnp.eye(y.shape[0])


def _pushed(advance: Callable[[Any], Any], state: tuple[Any, Any]) -> tuple[Any, Any]:
    y, slopes = state

    def along(direction: Any) -> Any:
        return jax.jvp(advance, (y,), (direction,))

    return jax.vmap(along, in_axes=-1, out_axes=(None, -1))(slopes)


#: y itself
VALUES = Along(lambda y: y, lambda advance, y: advance(y))
#: y and its exact derivatives with respect to y where the segment begins, by forward mode
SLOPES = Along(_with_slopes, _pushed)
