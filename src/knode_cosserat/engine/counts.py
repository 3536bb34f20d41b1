"""Where the numbers of all strands are: counts of points, pieces and places, and their tables.

Machine code serves every grid of a room, the largest grid for which its memory is laid out. Counts and tables
are numbers in this memory. Strands lie end to end. The pieces between them are idle.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np

from knode_cosserat.engine.codegen import vector_lanes
from knode_cosserat.rods.strands import strand_count
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.grid import Grid, grid_of
from knode_cosserat.schemes.space import SpaceScheme

#: segments of a strand in the smallest room, and the ratio of one room to the next
SMALLEST, RATIO = 32, 4
#: pieces between two changes of the unknowns
GROUPS = (3, 4, 5)


class Counts:
    """Counts by name, of all strands together unless it is said."""

    def __init__(self, pieces: int, near: int, strands: int, space: SpaceScheme):
        """Count for a number of pieces and of near sides of a strand."""
        own, self.near = pieces + 1, near
        points, lanes = strands * own, vector_lanes()
        every, ends = points - 1, points + strands * near
        used, count = (ends + len(each.stages) * every for each in (space.formula, space.check))
        # a change of the unknowns costs about two pieces
        size = min(GROUPS, key=lambda each: -(-pieces // each) * (each + 2))
        groups = (pieces - 1) // size
        self.numbers = {
            "points of strand": own, "points": points, "pieces": every, "ends": ends, "used": used,
            "count": count, "used between": used - ends, "between": count - ends,
            "pieces of group": size, "groups of strand": groups, "groups": groups * strands,
            "groups and tips": (groups + 1) * strands, "ends of vectors": -(-ends // lanes) * lanes,
            "nodes": own, "filled": strands * near, "most": 0,
        }  # fmt: skip
        stages, every_strand = range(len(space.check.stages)), range(strands)
        self.numbers |= {
            # first place of each stage, among all and among those between ends
            **{f"stage {k}": ends + k * every for k in stages},
            **{f"pieces {k}": k * every for k in stages},
            # first and last point of each strand, and place of the unknowns of its first and last pieces
            **{f"base {q}": q * own for q in every_strand},
            **{f"tip {q}": q * own + pieces for q in every_strand},
            **{f"first alpha {q}": q * (groups + 1) for q in every_strand},
            **{f"alpha {q}": q * (groups + 1) + groups for q in every_strand},
            # points with a near side
            **{f"near {k}": 0 for k in range(strands * near)},
        }

    def __getitem__(self, name: str) -> int:
        return self.numbers[name]

    @classmethod
    def room_of(cls, system: System, space: SpaceScheme) -> Counts:
        """Return the largest counts of a system whose nodes are the most of a room (`in_room`)."""
        near = len(grid_of(system, space).near)
        return cls(system.nodes - 1 + near, near, strand_count(system), space)


class GridCounts(Counts):
    """Counts and tables of a grid."""

    def __init__(self, grid: Grid, strands: int, space: SpaceScheme):
        super().__init__(grid.tip, len(grid.near), strands, space)
        self.grid, own = grid, grid.tip + 1
        bases, pieces = [self[f"base {q}"] for q in range(strands)], list(np.ndindex(strands, own))[:-1]
        #: strand and place in the grid of each place; an idle piece has the stages of the one before
        self.origins = [(q, j) for q in range(strands) for j in range(own)]
        self.origins += [(q, j) for q in range(strands) for j in range(own, grid.ends)]
        for k in range(len(space.check.stages)):
            self.origins += [(q, grid.stage(k).start + min(j, grid.tip - 1)) for q, j in pieces]
        stages = [self[f"stage {k}"] for k in range(len(space.formula.stages))]
        #: stages of the idle pieces
        self.idle = [first + base - 1 for first in stages for base in bases[1:]]
        #: points between nodes with the nodes around them, and parts of segments there
        at = grid.segment[grid.between]
        around = np.stack([grid.between, grid.nodes[at], grid.nodes[at + 1]], axis=1)
        self.filled = np.concatenate([around + base for base in bases])
        self.filled_parts = np.tile(grid.bounds[grid.between, 0], strands)
        # the most of these points in a segment
        most = int(np.max(np.diff(grid.nodes))) - 1
        self.numbers |= {"nodes": len(grid.nodes), "filled": len(self.filled), "most": most}
        near = [base + int(point) for base in bases for point in grid.near]
        self.numbers |= {f"near {k}": point for k, point in enumerate(near)}
        #: counts as they are in memory
        self.whole = np.array(list(self.numbers.values()))
        #: places, and lengths of pieces, as parts of a strand's length
        self.along = grid.along[[place for _, place in self.origins]]
        self.lengths = np.tile(np.append(grid.lengths, 0.0), strands)[:-1]


@functools.lru_cache(maxsize=256)
def _counts(grid: Grid, strands: int, space: SpaceScheme, lanes: int) -> GridCounts:
    return GridCounts(grid, strands, space)


def counts_of(system: System, space: SpaceScheme) -> GridCounts:
    """Return the counts of a system's grid."""
    return _counts(grid_of(system, space), strand_count(system), space, vector_lanes())


def in_room(system: System) -> Any:
    """Return a system with the most nodes of the room of its grid, for which code is written."""
    segments = SMALLEST
    while segments < system.nodes - 1:
        segments *= RATIO
    found = _with_nodes(system, segments + 1)
    # a coarse grid may have discontinuities in one place that are apart in a finer one
    return found if len(grid_of(found).near) == len(grid_of(system).near) else system


def _with_nodes(system: System, nodes: int) -> Any:
    """Return a copy with other nodes, unchecked: where code is made, parameters are any numbers."""
    copy = object.__new__(type(system))
    for field in dataclasses.fields(system):
        value = getattr(system, field.name)
        value = _with_nodes(value, nodes) if isinstance(value, System) else value
        object.__setattr__(copy, field.name, nodes if field.name == "nodes" else value)
    return copy
