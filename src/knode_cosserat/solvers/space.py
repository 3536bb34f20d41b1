"""One segment of the rod: from y at a node to y at the next."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

#: (y_s, whatever else is found there) at (s, y, what is known of that stage)
Rates = Callable[[Any, Any, Any], tuple[Any, Any]]


@dataclasses.dataclass(frozen=True)
class SpaceScheme(abc.ABC):
    """An explicit one-step scheme in arclength."""

    #: where its stages are, as parts of a segment; the first at its start
    parts: ClassVar[tuple[float, ...]]

    @property
    @abc.abstractmethod
    def order(self) -> int:
        """Order of convergence in the segment's length."""

    @abc.abstractmethod
    def advance(self, rates: Rates, s: Any, ds: Any, y: Float[Any, " y"], known: Any) -> tuple[Any, Any]:
        """y at s + ds from y at s, and what else `rates` found at each stage, stacked.

        `known` is what `rates` is given of each stage, stacked too: its past, and what was evaluated ahead.
        """


@dataclasses.dataclass(frozen=True)
class Euler(SpaceScheme):
    """Forward Euler, the paper's. Order 1: at 10 nodes a few per cent of the tip's deflection."""

    order = 1
    parts = (0.0,)

    def advance(self, rates, s, ds, y, known):  # type: ignore[no-untyped-def]
        """One evaluation, at the segment's start."""
        y_s, found = rates(s, y, jax.tree.map(lambda each: each[0], known))
        return y + ds * y_s, jax.tree.map(lambda each: each[None], found)


#: what each stage of the classical scheme counts
RK4_WEIGHTS = np.array([1.0, 2.0, 2.0, 1.0]) / 6


@dataclasses.dataclass(frozen=True)
class RK4(SpaceScheme):
    """The classical Runge-Kutta scheme. Order 4, four evaluations a segment."""

    order = 4
    parts = (0.0, 0.5, 0.5, 1.0)

    def advance(self, rates, s, ds, y, known):  # type: ignore[no-untyped-def]
        """Evaluations at the start, twice in the middle, and at the end."""

        # a loop, for four copies of the equations take several times as long to compile, and are no faster
        def stage(reached: tuple[Any, Any], given: tuple[Any, Any, Any]) -> Any:
            total, k = reached
            part, weight, there = given
            k, found = rates(s + part * ds, y + part * ds * k, there)
            return (total + weight * ds * k, k), found

        # the first stage takes nothing of k: any will do that has slopes and batches as it will have, or JAX
        # traces the equations twice to find out
        (total, _), found = jax.lax.scan(stage, (y, y), (np.array(self.parts), RK4_WEIGHTS, known))
        return total, found


SCHEMES: dict[str, SpaceScheme] = {"euler": Euler(), "rk4": RK4()}


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
