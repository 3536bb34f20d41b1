"""Carrying y along a rod on which something may begin, end or pull between two nodes.

A scheme in arclength keeps its order only where the right-hand side is smooth. A segment is therefore
parted where the system has a cut, and y jumps there if the system says so. A cut on a node parts nothing: y
at a node is that on its near side, z that on its far side.

A step is solved for y at the cuts as for y at the nodes, so that all pieces lie side by side. What has only
the nodes carries y over a segment piece by piece.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.rods.section import INWARD
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.space import Rates, SpaceScheme

#: cuts closer to a node than this part of a segment are on it, and from inside all of them is on one side
ON_NODE = 0.1 * INWARD


class Crossing(NamedTuple):
    """How one segment is parted: where (parts of the segment), and which cuts act before each part."""

    bounds: Float[Any, " parts+1"]
    acting: Float[Any, "parts cuts"]


@functools.lru_cache(maxsize=256)
def crossings(cuts: tuple[float, ...], nodes: int) -> Crossing:
    """The crossings of all segments, stacked: as many parts each as the segment with most cuts needs."""
    along = np.asarray(cuts) * (nodes - 1)
    nearest = np.round(along)
    along = np.where(np.abs(along - nearest) < ON_NODE, nearest, along)
    segment = np.minimum(np.floor(along).astype(int), nodes - 2)
    inner = [sorted({a - j for a in along[segment == j] if a > j}) for j in range(nodes - 1)]
    parts = 1 + max(map(len, inner))
    bounds = np.ones((nodes - 1, parts + 1))
    acting = np.zeros((nodes - 1, parts, len(cuts)))
    for j, places in enumerate(inner):
        bounds[j, 0] = 0.0
        bounds[j, 1 : 1 + len(places)] = places
        for cut in np.flatnonzero(segment == j):
            within = along[cut] - j
            acting[j, 0 if within == 0.0 else 1 + places.index(within), cut] = 1.0
    return Crossing(bounds, acting)


def crossing_of(system: System) -> Crossing | None:
    """The crossings of a system's segments; None where there is nothing to cross."""
    return crossings(system.cuts, system.nodes) if system.cuts else None


def within(s: Any, low: Any, high: Any) -> Any:
    """s, moved a little into the part from low to high if it is at its end."""
    margin = INWARD * (high - low)
    return jnp.clip(s, low + margin, high - margin)


class Points(NamedTuple):
    """The nodes, and the cuts that lie between them: from each to the next y is carried over a piece."""

    #: which of them the nodes are, and which the cuts
    nodes: Int[np.ndarray, " nodes"]
    between: Int[np.ndarray, " between"]
    #: in which segment each piece is
    segment: Int[np.ndarray, " pieces"]
    #: from where to where in it, as parts of the segment
    bounds: Float[np.ndarray, "pieces 2"]
    #: which cuts act where it begins
    acting: Float[np.ndarray, "pieces cuts"]


@functools.lru_cache(maxsize=256)
def points_between(cuts: tuple[float, ...], nodes: int) -> Points:
    """The points of a rod with these cuts."""
    bounds, acting = crossings(cuts, nodes)
    pieces = [(j, k) for j, row in enumerate(bounds) for k in np.flatnonzero(np.diff(row) > 0.0)]
    segment, part = np.array(pieces).T
    whole = np.flatnonzero(part == 0)
    return Points(
        np.append(whole, len(segment)),
        np.flatnonzero(part > 0),
        segment,
        np.stack([bounds[segment, part], bounds[segment, part + 1]], axis=1),
        acting[segment, part],
    )


def parts_of(cuts: tuple[float, ...], nodes: int) -> Int[np.ndarray, "segments parts"]:
    """Which pieces are a segment's parts, the last one again for those that it does not have."""
    first, parts = points_between(cuts, nodes).nodes, crossings(cuts, nodes).acting.shape[1]
    return np.minimum(first[:-1, None] + np.arange(parts), first[1:, None] - 1)


def points_of(system: System) -> Points:
    """The points of a system."""
    return points_between(system.cuts, system.nodes)


def taken(values: Any, rows: np.ndarray) -> Any:
    """Rows of an array by numbers that are known: runs of neighbours, each copied as a whole."""
    runs = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
    found = [values[run[0] : run[-1] + 1] for run in runs]
    return found[0] if len(found) == 1 else jnp.concatenate(found)


def spread(points: Points, values: Float[Any, "nodes ..."]) -> Float[Any, "points ..."]:
    """What is known at the nodes, at all points: between nodes on a line."""
    part = points.bounds[:, 0].reshape(-1, *(1 for _ in values.shape[1:]))
    start, end = (taken(values, points.segment + k) for k in (0, 1))
    return jnp.concatenate([start + part * (end - start), values[-1:]])


#: y at the far side of cuts: (acting, y, record of history)
Jump = Callable[[Any, Any, Any], Any]


def carried(
    space: SpaceScheme, rates: Callable[[Any, Any, Any], Any], jump: Jump, crossing: Crossing,
    where: tuple[Any, Any], y: Float[Any, " y"], history: Float[Any, "parts stages x"], first: int = 0,
) -> Float[Any, " y"]:  # fmt: skip
    """y at a segment's end from y at its start; `where` is its start and its length (m).

    `rates` gives y_s, and is given the history of the stage. `first` of 1 leaves out the jump at the start: y
    is then that on the far side.
    """
    acting = jnp.asarray(crossing.acting).at[:first].set(0.0)
    s, ds = where

    def alone(s: Any, y: Any, past: Any) -> Any:
        return rates(s, y, past), None

    def part(y: Any, given: tuple[Any, Any, Any, Any]) -> Any:
        begin, end, acting, past = given
        beyond = jump(acting, y, past[0])
        return carried_on(space, alone, (s + begin * ds, s + end * ds), beyond, past)

    y, _ = jax.lax.scan(part, y, (crossing.bounds[:-1], crossing.bounds[1:], acting, history))
    return y


def carried_on(
    space: SpaceScheme, rates: Rates, where: tuple[Any, Any], y: Float[Any, " y"], known: Any
) -> tuple[Float[Any, " y"], Any]:
    """`SpaceScheme.advance` over one piece, from the far side of its start; `where` is from and to where (m).

    Nothing is evaluated at its very ends, where what jumps may be either.
    """
    low, high = where

    def inside(at: Any, y: Any, known: Any) -> Any:
        return rates(within(at, low, high), y, known)

    return space.advance(inside, low, high - low, y, known)
