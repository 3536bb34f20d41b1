"""What is known at nodes, where pieces of the rod begin, are half-way and end: interpolated over no cut.

At a cut the strains jump, and so does their past. A record holds those on its far side; on its near side they
are what the nodes of the stretch before it say, and between two nodes what those of the same stretch say. An
interpolation over the cut, or the far side's strains taken for the near side's, leave a damped motion with
an error of order 1, whatever the scheme: millimetres instead of nanometres at 40 nodes.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.crossing import points_between, taken
from knode_cosserat.solvers.space import SpaceScheme, middles

#: so many nodes are looked at, the nearest of a stretch: order 4, if it has as many
NEAREST = 4


class Plan(NamedTuple):
    """Which rows are those of pieces: of the nodes', of what is interpolated besides, and of the middles'."""

    #: by what nodes' values: of what goes on over cuts, and of what jumps there
    weights: Float[np.ndarray, "2 more nodes"]
    #: where pieces begin, are half-way and end
    rows: Int[np.ndarray, "3 pieces"]


@functools.lru_cache(maxsize=256)
def plan(cuts: tuple[float, ...], nodes: int) -> Plan:
    """How values at the nodes of a rod with these cuts become those of its pieces."""
    points = points_between(cuts, nodes)
    along = np.append(points.segment + points.bounds[:, 0], nodes - 1.0)
    edges = np.concatenate([[0.0], along[:-1][points.acting.any(axis=1)], [nodes - 1.0]])
    rows = np.stack([points.segment, points.segment, points.segment + 1])
    # those that are as in a rod without cuts
    regular = np.full(rows.shape, True)
    weights: list[list[np.ndarray]] = []
    for piece, (low, high) in enumerate(itertools.pairwise(along)):
        first, last = edges[edges <= low].max(), edges[edges >= high].min()
        stretch = np.arange(np.ceil(first), np.floor(last) + 1.0)
        # at a cut on a node what jumps is known on the far side
        jumping = stretch if last == nodes - 1.0 else stretch[stretch < last]
        lowest = min(max(low - 1.0, 0.0), max(nodes - NEAREST, 0.0))
        used = np.array([low]), np.arange(lowest, min(lowest + NEAREST, nodes)), np.array([high])
        for k, place in enumerate((low, (low + high) / 2.0, high)):
            if cuts and not np.isin(used[k], jumping).all():
                rows[k, piece], regular[k, piece] = nodes + len(weights), False
                nearby = np.array([points.segment[piece], points.segment[piece] + 1.0])
                weights.append(
                    [_weights(own if len(own) else nearby, place, nodes) for own in (stretch, jumping)]
                )
    rows[1, regular[1]] += nodes + len(weights)
    return Plan(np.array(weights).reshape(-1, 2, nodes).swapaxes(0, 1), rows)


def _weights(known: Float[np.ndarray, " known"], place: float, nodes: int) -> Float[np.ndarray, " nodes"]:
    """By what each node counts at a place, where the polynomial through the nearest that are known is."""
    nearest = np.sort(known[np.argsort(np.abs(known - place), kind="stable")][:NEAREST])
    found = np.zeros(nodes)
    for node in nearest:
        others = nearest[nearest != node]
        found[int(node)] = np.prod((place - others) / (node - others))
    return found


def along_pieces(
    system: System, space: SpaceScheme, records: Float[Any, "nodes x"]
) -> tuple[Float[Any, "pieces x"], Float[Any, "pieces x"], Float[Any, "pieces x"]]:
    """Packed records where pieces begin, are half-way and end; a scheme without middles uses the first."""
    weights, rows = plan(system.cuts, system.nodes)
    ny = system.y_layout.size
    known = records
    if weights.shape[1]:
        more = jnp.concatenate([weights[0] @ records[:, :ny], weights[1] @ records[:, ny:]], axis=1)
        known = jnp.concatenate([records, more])
    if not space.uses_middle:
        begin = taken(known, rows[0])
        return begin, begin, begin
    known = jnp.concatenate([known, middles(records)])
    begin, middle, end = (taken(known, each) for each in rows)
    return begin, middle, end
