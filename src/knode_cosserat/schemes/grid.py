"""Points and places along a rod: nodes, discontinuities between them, and where equations are evaluated.

A scheme in arclength keeps its order only where the right-hand side is smooth. A segment is therefore
divided into pieces at every discontinuity of the system (`System.discontinuities`), and y jumps there if the
system says so. Within the tolerance `ON_NODE` a discontinuity lies on a node. At a node, y is the value on
the near side and z the value on the far side.

y is unknown at the points: the nodes and the discontinuities between them. The equations are evaluated at the
places: at the points (on the far side of discontinuities), at the near sides of discontinuities, and at the
stages of the scheme within every piece.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.rods.kept import kept
from knode_cosserat.rods.section import INWARD
from knode_cosserat.rods.system import System, array_module
from knode_cosserat.schemes.space import LOBATTO2, SpaceScheme

#: a discontinuity closer to a node than this part of a segment is placed on the node
ON_NODE = 0.1 * INWARD
#: largest number of nodes of a smooth stretch that interpolation uses: order 4
NEAREST = 4


class _Stencil(NamedTuple):
    """Interpolation from nodes to places: node indices and weights."""

    nodes: Int[np.ndarray, "places nearest"]
    weights: Float[np.ndarray, "places nearest"]


class Grid:
    """Points and places of a rod, from its discontinuities (parts of its length) and its number of nodes."""

    def __init__(self, cuts: tuple[float, ...], nodes: int, stages: tuple[float, ...]):
        along = np.asarray(cuts, dtype=float) * (nodes - 1)
        nearest = np.round(along)
        along = np.where(np.abs(along - nearest) < ON_NODE, nearest, along)
        starts = np.unique(np.concatenate([np.arange(nodes - 1.0), along[along < nodes - 1]]))
        #: segment index of each piece
        self.segment = np.minimum(np.floor(starts).astype(int), nodes - 2)
        ends = np.append(starts[1:], nodes - 1.0)
        #: start and end of each piece, as parts of its segment
        self.bounds = np.stack([starts, ends], axis=1) - self.segment[:, None]
        #: the discontinuities at each piece's start (pieces, cuts)
        self.acting = (starts[:, None] == along[None]).astype(float)
        #: indices of the nodes and of the others among the points
        whole = starts == np.floor(starts)
        self.nodes = np.append(np.flatnonzero(whole), len(starts))
        self.between = np.flatnonzero(~whole)
        #: index of the tip among the points; equals the number of pieces
        self.tip = len(starts)
        #: points that have a near side
        self.near = np.flatnonzero(self.acting.any(axis=1) & (starts > 0.0))
        #: number of places at ends of pieces, and of all places
        self.ends = self.tip + 1 + len(self.near)
        self.count = self.ends + len(stages) * self.tip
        #: the place at every piece's end
        self.end_of = np.arange(1, self.tip + 1)
        self.end_of[self.near - 1] = self.tip + 1 + np.arange(len(self.near))
        self._stages = stages

    def stage(self, k: int) -> slice:
        """Return the places of stage k of all pieces."""
        return slice(self.ends + k * self.tip, self.ends + (k + 1) * self.tip)

    def places_of(self, pieces: Int[np.ndarray, " n"]) -> Int[np.ndarray, "n stages+2"]:
        """Return the places of pieces: start, end, and stages between."""
        between = [self.stage(k).start + pieces for k in range(len(self._stages))]
        return np.stack([pieces, self.end_of[pieces], *between], axis=1)

    @property
    def parts(self) -> Int[np.ndarray, "segments parts"]:
        """Pieces of each segment, the last one repeated up to the largest number of them."""
        most = int(np.max(np.diff(self.nodes)))
        return np.minimum(self.nodes[:-1, None] + np.arange(most), self.nodes[1:, None] - 1)

    def spread(self, values: Float[Any, "nodes ..."]) -> Float[Any, "points ..."]:
        """Interpolate values at the nodes to all points, linearly."""
        if not len(self.between):
            return values
        part = self.bounds[:, 0].reshape(-1, *(1 for _ in values.shape[1:]))
        start, end = (take_rows(values, self.segment + k) for k in (0, 1))
        return _join([start + part * (end - start), values[-1:]])

    @functools.cached_property
    def lengths(self) -> Float[np.ndarray, " pieces"]:
        """Lengths of the pieces, as parts of the rod's."""
        return (self.bounds[:, 1] - self.bounds[:, 0]) / (len(self.nodes) - 1)

    @functools.cached_property
    def along(self) -> Float[np.ndarray, " places"]:
        """Places as parts of the rod's length; at discontinuities they are a little inside of pieces."""
        low, high = ((self.segment + self.bounds[:, k]) / (len(self.nodes) - 1) for k in (0, 1))
        first, last, near = low, high[-1:], high[self.near - 1]
        if self.acting.shape[1]:
            first, last = inside(first, low, high), inside(last, low[-1:], high[-1:])
            near = inside(near, low[self.near - 1], near)
        return np.concatenate([first, last, near, *(low + stage * (high - low) for stage in self._stages)])

    @functools.cached_property
    def stencils(self) -> tuple[_Stencil, _Stencil]:
        """Interpolation stencils from nodes to places: for y, and for values that jump (z and y_s)."""
        points = np.append(self.segment + self.bounds[:, 0], self.nodes.size - 1.0)
        starts, ends = points[:-1], points[1:]
        along = [
            starts,
            points[-1:],
            points[self.near],
            *(starts + c * (ends - starts) for c in self._stages),
        ]
        of_piece = np.arange(self.tip)
        piece = [of_piece, of_piece[-1:], self.near - 1, *(of_piece for _ in self._stages)]
        return self._stencils(points, np.concatenate(along), np.concatenate(piece))

    def _stencils(self, points: Any, along: Any, piece: Any) -> tuple[_Stencil, _Stencil]:
        last = self.nodes.size - 1.0
        edges = np.concatenate([[0.0], points[:-1][self.acting.any(axis=1)], [last]])
        shape = (len(along), min(NEAREST, self.nodes.size))
        on, over = (_Stencil(np.zeros(shape, dtype=int), np.zeros(shape)) for _ in range(2))
        for place, (where, k) in enumerate(zip(along, piece, strict=True)):
            low, high = points[k], points[k + 1]
            first, end = edges[edges <= low].max(), edges[edges >= high].min()
            stretch = np.arange(np.ceil(first), np.floor(end) + 1.0)
            # a value that jumps at a node is known on the far side only
            jumping = stretch if end == last else stretch[stretch < end]
            nearby = np.array([self.segment[k], self.segment[k] + 1.0])
            for stencil, own in ((on, stretch), (over, jumping)):
                _fill(stencil, place, own if len(own) else nearby, where)
        return on, over


def _fill(stencil: _Stencil, place: int, known: Float[np.ndarray, " known"], where: float) -> None:
    """Set the weights of the polynomial through the nearest known nodes."""
    nearest = np.sort(known[np.argsort(np.abs(known - where), kind="stable")][:NEAREST])
    for k, node in enumerate(nearest):
        others = nearest[nearest != node]
        stencil.nodes[place, k] = int(node)
        stencil.weights[place, k] = np.prod((where - others) / (node - others))


@functools.lru_cache(maxsize=256)
def _grid(cuts: tuple[float, ...], nodes: int, stages: tuple[float, ...]) -> Grid:
    return Grid(cuts, nodes, stages)


def grid_of(system: System, space: SpaceScheme = LOBATTO2) -> Grid:
    """Return the grid of a system; its points and pieces do not depend on the scheme."""
    return _grid(
        tuple(system.discontinuities.places), system.nodes, tuple(stage.place for stage in space.check.stages)
    )


@kept
def turn_of_segments(system: System) -> float:
    """Return the angle (rad) through which parts turn in a segment; estimates see it up to `SEEN_TURN`."""
    return system.winding / (system.nodes - 1)


def at_places(system: System, space: SpaceScheme, records: Float[Any, "nodes x"]) -> Float[Any, "places x"]:
    """Interpolate packed records at the nodes to all places; no stencil spans a discontinuity."""
    ny = system.y_layout.size
    found = [
        (stencil.weights[..., None] * own[stencil.nodes]).sum(axis=1)
        for stencil, own in zip(
            grid_of(system, space).stencils, (records[:, :ny], records[:, ny:]), strict=True
        )
    ]
    return _join(found, axis=-1)


def inside(s: Any, low: Any, high: Any) -> Any:
    """Return s, moved a little into the piece from low to high if it is at its end."""
    margin = INWARD * (high - low)
    return array_module(s).clip(s, low + margin, high - margin)


def take_rows(values: Any, rows: np.ndarray) -> Any:
    """Return rows of an array by known indices; runs of neighbours are copied as a whole."""
    if not len(rows):
        return values[:0]
    runs = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
    found = [values[run[0] : run[-1] + 1] for run in runs]
    return found[0] if len(found) == 1 else _join(found)


def _join(parts: list[Any], axis: int = 0) -> Any:
    """Return arrays as one; by NumPy outside of JAX's transformations, where each shape would be compiled."""
    return array_module(parts).concatenate(parts, axis=axis)
