"""Carrying y over one segment of a rod on which something may begin, end or pull in between.

A scheme in arclength keeps its order only where the right-hand side is smooth. A segment is therefore
parted where the system has a cut, and y jumps there if the system says so. A cut on a node parts nothing: y
at a node is that on its near side, z that on its far side. What is known of the past at a cut is
interpolated, to order 3.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.space import SpaceScheme

#: cuts closer to a node than this part of the length are on it
ON_NODE = 1e-9
#: by this part of a segment points are moved into it, so that what is smooth within is seen up to its ends
INWARD = 1e-9


class Crossing(NamedTuple):
    """How one segment is parted: where (parts of the segment), and which cuts act before each part."""

    bounds: Float[Any, " parts+1"]
    acting: Float[Any, "parts cuts"]


@functools.lru_cache(maxsize=256)
def crossings(cuts: tuple[float, ...], nodes: int) -> Crossing:
    """The crossings of all segments, stacked: as many parts each as the segment with most cuts needs."""
    along = np.asarray(cuts) * (nodes - 1)
    nearest = np.round(along)
    along = np.where(np.abs(along - nearest) < ON_NODE * (nodes - 1), nearest, along)
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


class Rounds(NamedTuple):
    """How the parts of all segments are shared out: in rounds one after the other, side by side in each.

    The parts of one segment follow each other at one place. Most segments have but one part, so that as many
    rounds of all segments would take about as many times as long.
    """

    #: which segment is at a place (rounds, places)
    segment: np.ndarray
    #: whether it begins there, or goes on from where the last round left it
    begins: np.ndarray
    #: from where to where in the segment (rounds, places, 2): from 1 to 1 where nothing is left to do
    bounds: np.ndarray
    #: which cuts act where it begins (rounds, places, cuts)
    acting: np.ndarray
    #: where each segment ends, among all places of all rounds
    last: np.ndarray


@functools.lru_cache(maxsize=256)
def rounds_of(cuts: tuple[float, ...], nodes: int) -> Rounds:
    """As many rounds as the segment with most parts needs, all as narrow as can be."""
    bounds, acting = crossings(cuts, nodes)
    counts = [max(1, int(np.sum(np.diff(row) > 0.0))) for row in bounds]
    most = max(counts)
    places: list[list[tuple[int, int]]] = [[] for _ in range(-(-sum(counts) // most))]
    for j in sorted((j for j, count in enumerate(counts) if count > 1), key=lambda j: -counts[j]):
        place = next((each for each in places if len(each) + counts[j] <= most), None)
        if place is None:
            places.append(place := [])
        place += [(j, k) for k in range(counts[j])]
    # row by row, so that neighbours stay neighbours
    single = (j for j, count in enumerate(counts) if count == 1)
    for k in range(most):
        for place in places:
            if len(place) == k:
                place.append((next(single, -1), 0))
    shape = most, len(places)
    found = Rounds(
        np.zeros(shape, dtype=int), np.ones(shape, dtype=bool), np.ones((*shape, 2)),
        np.zeros((*shape, len(cuts))), np.zeros(nodes - 1, dtype=int),
    )  # fmt: skip
    for k, row in enumerate(zip(*places, strict=True)):
        for at, (j, part) in enumerate(row):
            if j >= 0:
                found.segment[k, at], found.begins[k, at] = j, part == 0
                found.bounds[k, at] = bounds[j, part : part + 2]
                found.acting[k, at] = acting[j, part]
                found.last[j] = k * len(places) + at
    return found


def taken(values: Any, rows: np.ndarray) -> Any:
    """Rows of an array by numbers that are known: runs of neighbours, each copied as a whole."""
    runs = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
    return jnp.concatenate([values[run[0] : run[-1] + 1] for run in runs])


#: y at the far side of cuts: (acting, y, record of history)
Jump = Callable[[Any, Any, Any], Any]


def carried(
    space: SpaceScheme, rates: Callable[[Any, Any, Any], Any], jump: Jump, crossing: Crossing,
    where: tuple[Any, Any], y: Float[Any, " y"], history: tuple[Any, Any, Any], first: int = 0,
) -> Float[Any, " y"]:  # fmt: skip
    """y at a segment's end from y at its start; `where` is its start and its length (m).

    `first` of 1 leaves out the jump at the start: y is then that on the far side.
    """
    acting = jnp.asarray(crossing.acting).at[:first].set(0.0)

    def of_past(s: Any, y: Any, known: tuple[Any, Any]) -> Any:
        return rates(s, y, known[0])

    def part(y: Any, given: tuple[Any, Any, Any]) -> Any:
        return carried_part(space, of_past, jump, given, where, y, history, parted=acting.shape[0] > 1), None

    y, _ = jax.lax.scan(part, y, (crossing.bounds[:-1], crossing.bounds[1:], acting))
    return y


def carried_part(
    space: SpaceScheme, rates: Callable[[Any, Any, Any], Any], jump: Jump, part: tuple[Any, Any, Any],
    where: tuple[Any, Any], y: Float[Any, " y"], history: tuple[Any, Any, Any], parted: bool,
    ahead: tuple[Any, Any, Any] | None = None,
) -> Float[Any, " y"]:  # fmt: skip
    """The same over one part: from where to where, as parts of the segment, and which cuts act before it.

    Where no segment is parted, which is known before, the past need not be interpolated. `rates` is given
    what `known_at` says of the past and of what was evaluated `ahead` for this part.
    """
    (s, ds), (begin, end, acting) = where, part
    past = _part_of(space, history, begin, end) if parted else history
    low, high = s + begin * ds, s + end * ds

    def inside(at: Any, y: Any, known: Any) -> Any:
        return rates(within(at, low, high), y, known)

    return space.advance(inside, low, high - low, jump(acting, y, past[0]), known_at(past, ahead))


def known_at(history: tuple[Any, Any, Any], ahead: tuple[Any, Any, Any] | None) -> tuple[Any, Any, Any]:
    """What is known where a segment begins, is half-way and ends: (past there, what was evaluated ahead)."""
    start, middle, end = zip(history, (None, None, None) if ahead is None else ahead, strict=True)
    return start, middle, end


def _part_of(space: SpaceScheme, history: tuple[Any, Any, Any], begin: Any, end: Any) -> tuple[Any, Any, Any]:
    """What is known of the past at the begin, middle and end of a part, from that of the whole segment."""
    start, middle, last = history

    def at(part: Any) -> Any:
        if not space.uses_middle:
            return start + part * (last - start)
        weights = (2 * part - 1) * (part - 1), 4 * part * (1 - part), part * (2 * part - 1)
        return weights[0] * start + weights[1] * middle + weights[2] * last

    return at(begin), at((begin + end) / 2), at(end)
