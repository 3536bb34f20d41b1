"""What is known at nodes only, at the stages of all pieces of the rod: interpolated over no cut.

At a cut the strains jump, and so does their past. A record of the nodes holds those on its far side; on its
near side they are what the nodes of the stretch before it say, and between two nodes what those of the same
stretch say.

A motion keeps the past of its stages themselves. This is for what begins from nodes: recorded or loaded
states, and segments to learn from.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.crossing import points_between
from knode_cosserat.solvers.space import SpaceScheme

#: so many nodes are looked at, the nearest of a stretch: order 4, if it has as many
NEAREST = 4


class Plan(NamedTuple):
    """Of which nodes' values those at the stages of all points are made, and by what these count."""

    nodes: Int[np.ndarray, "stages points nearest"]
    weights: Float[np.ndarray, "stages points nearest"]


@functools.lru_cache(maxsize=256)
def plans(cuts: tuple[float, ...], nodes: int, parts: tuple[float, ...]) -> tuple[Plan, Plan]:
    """How values at the nodes become those at stages: of what goes on over cuts, and of what jumps there."""
    points = points_between(cuts, nodes)
    along = np.append(points.segment + points.bounds[:, 0], nodes - 1.0)
    edges = np.concatenate([[0.0], along[:-1][points.acting.any(axis=1)], [nodes - 1.0]])
    shape = (len(parts), len(along), min(NEAREST, nodes))
    on, over = (Plan(np.zeros(shape, dtype=int), np.zeros(shape)) for _ in range(2))
    for piece, (low, high) in enumerate(itertools.pairwise(along)):
        first, last = edges[edges <= low].max(), edges[edges >= high].min()
        stretch = np.arange(np.ceil(first), np.floor(last) + 1.0)
        # at a cut on a node what jumps is known on the far side
        jumping = stretch if last == nodes - 1.0 else stretch[stretch < last]
        nearby = np.array([points.segment[piece], points.segment[piece] + 1.0])
        for stage, part in enumerate(parts):
            place = low + part * (high - low)
            for plan, own in ((on, stretch), (over, jumping)):
                _fill(plan, (stage, piece), own if len(own) else nearby, place)
    for plan in (on, over):  # the tip is a piece without length
        plan.nodes[:, -1, 0], plan.weights[:, -1, 0] = nodes - 1, 1.0
    return on, over


def _fill(plan: Plan, at: tuple[int, int], known: Float[np.ndarray, " known"], place: float) -> None:
    """By what nodes count at a place: those of the polynomial through the nearest that are known."""
    nearest = np.sort(known[np.argsort(np.abs(known - place), kind="stable")][:NEAREST])
    for k, node in enumerate(nearest):
        others = nearest[nearest != node]
        plan.nodes[*at, k] = int(node)
        plan.weights[*at, k] = np.prod((place - others) / (node - others))


def at_stages(
    system: System, space: SpaceScheme, records: Float[Any, "nodes x"]
) -> Float[Any, "stages points x"]:
    """Packed records at the stages of all points, from those at the nodes."""
    ny = system.y_layout.size
    both = plans(system.cuts, system.nodes, space.parts)
    found = [
        jnp.sum(plan.weights[..., None] * own[plan.nodes], axis=2)
        for plan, own in zip(both, (records[:, :ny], records[:, ny:]), strict=True)
    ]
    return jnp.concatenate(found, axis=-1)
