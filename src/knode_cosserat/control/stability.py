"""Whether an equilibrium is stable: the second variation of its energy, by the stiffness of its segments.

Each segment is a finite element (`stiffness`). Summed up over the segments, and with what the two ends allow
and ask, that is the second variation of the energy. An equilibrium is stable if it has no negative
eigenvalue. Segments are divided until that no longer changes their number, and what gives way between two
nodes is counted too.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from knode_cosserat.control.stiffness import (
    NEEDED,
    Pieces,
    divided,
    firm,
    joined,
    narrow,
    symmetric,
    wide,
)
from knode_cosserat.rods.system import System, in_strands
from knode_cosserat.solvers.boundary import static_error
from knode_cosserat.solvers.equilibrium import equilibrium as rests
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.space import Lobatto4
from knode_cosserat.trajectory import Trajectory

#: in natural units: what is further than this from balance is no equilibrium
BALANCED = 1e-6
#: of the largest singular value: what counts as held
HELD = 1e-9
#: in natural units: what moves less than this by poses and stresses rests
RESTING = 1e-9
#: by what segments are divided, until two in a row find the same
DIVISIONS = (1, 2, 4, 8, 16)
#: of all strands, as many as eigenvalues are computed of in seconds; by 2 segments are always divided
POINTS = 400
#: of the largest eigenvalue: what may be rounding, which may turn the sign of a soft one
ROUNDING = 1e-14
#: in natural units: where rounding is beyond this a rod is not called stable for what is less than that
SEEN = 1e-3
#: roots of the equations that are found from a root nearby
NEARBY = (Result.CONVERGED, Result.COARSE, Result.RECOVERED_LOAD_CONTINUATION)


class Stability(NamedTuple):
    """The second variation of an equilibrium's energy."""

    #: how many ways there are to leave it: negative eigenvalues, none of a stable one. Where segments would
    #: buckle even in 16 parts it is a count of those that the nodes show
    unstable_directions: int
    #: the least eigenvalue, in natural units (EI/L): zero where the robot is about to buckle or snap
    least: float
    #: (nodes, 3): how the line would move in the direction of the least, its largest displacement 1; of
    #: several rods (nodes, rods, 3)
    mode: np.ndarray
    #: how far the stiffness is from symmetric, as a part of its largest entry: what has a potential is
    #: symmetric; follower loads are not
    asymmetry: float

    @property
    def stable(self) -> bool:
        """Whether there is none."""
        return self.unstable_directions == 0


def stability(equilibrium: Trajectory, row: int = -1) -> Stability:
    """Whether a robot that rests stays where it is when it is pushed a little.

    For whatever holds its ends: it finds what buckles between clamps, an arch that is about to snap, a column
    that would fall. An equilibrium by another scheme along the rod is solved again by Lobatto4. Loads that
    follow the rod have no potential: it finds their divergence, and not their flutter. Friction, which only
    helps, is not counted.

    Args:
        equilibrium: of one robot: what `kc.equilibrium` gives, or a trajectory that has come to rest.
        row: which row of it.

    Raises:
        ValueError: no equilibrium, a system that is not rods with positions and orientations, or one with
            more in y that moves with them (tendons on reels have an energy of their own). Or it cannot be
            decided: the nodes are too few for the loads, or rounding is more than what holds the rod.
    """
    system, y, z, control = _checked(equilibrium, row)
    space = equilibrium.settings.space
    if not isinstance(space, Lobatto4):
        one = Trajectory(
            system=system, settings=equilibrium.settings, time=np.zeros(1), y=y[None], z=z[None],
            control=control[None], result=np.zeros(1, int), residual=np.zeros(1), iterations=np.zeros(1, int),
        )  # fmt: skip
        found = rests(system, control, space="lobatto4", initial=one, on_failure="return")
        if found.result[0] not in NEARBY:
            raise ValueError(
                f"row {row} cannot be decided: by Lobatto4 along the rod no equilibrium is found near it; "
                'allowed is one that was solved with space="lobatto4"'
            )
        y = np.asarray(found.y[0])
    by = [count for count in DIVISIONS if count <= 2 or count * system.nodes * system.strands <= POINTS]
    return _decided(system, divided(system, y, control, by), row)


def _checked(equilibrium: Any, row: Any) -> tuple[System, np.ndarray, np.ndarray, np.ndarray]:
    if not isinstance(equilibrium, Trajectory):
        raise ValueError(
            f"equilibrium is a {type(equilibrium).__name__}; allowed is a Trajectory, of kc.equilibrium"
        )
    y = np.asarray(equilibrium.y)
    if y.ndim != 3:
        raise ValueError(f"equilibrium is of a batch, y {y.shape}; allowed is that of one robot")
    if not isinstance(row, int | np.integer) or not -len(y) <= row < len(y):
        raise ValueError(f"row is {row!r}; allowed is {-len(y)} to {len(y) - 1}")
    system = equilibrium.system
    names = system.strand.y_layout.names
    if not set(NEEDED) <= set(names):
        raise ValueError(
            f"a {type(system).__name__} has y = {', '.join(names)}; allowed are rods with p, h, n and m"
        )
    y, z, control = y[row], np.asarray(equilibrium.z)[row], np.asarray(equilibrium.control)[row]
    record = np.concatenate([y, z] + ([np.zeros_like(y)] if system.mixed else []), axis=1)
    off = float(static_error(system, equilibrium.settings.space, record, control, jnp.zeros(())))
    if not off <= BALANCED:
        raise ValueError(
            f"row {row} is no equilibrium: {off:.2g} of natural size is left when every rate is zero; "
            f"allowed is {BALANCED:g}"
        )
    return system, y, z, control


def _require_rest(system: System, base: np.ndarray, moved: np.ndarray) -> None:
    """That what y has beside poses and stresses, such as velocities, rests whatever those do."""
    layout = system.strand.y_layout
    base = base.reshape(system.strands, layout.size, -1)
    for field in layout.fields:
        if field.name in NEEDED:
            continue
        own = layout.indices((field.name,))
        if max(np.abs(moved[own]).max(), np.abs(base[:, own]).max()) > RESTING:
            raise ValueError(
                f"a {type(system).__name__} has {field.name} ({field.meaning}) in y, which has an energy of "
                "its own; allowed are rods whose equilibria are of p, h, n and m alone"
            )


@dataclasses.dataclass(frozen=True)
class _Variation:
    """The second variation in what is free to move."""

    energy: np.ndarray
    #: poses of all points by that, strands inside (6 points strands, free)
    free: np.ndarray
    #: which part of the rod each point stands for, so that eigenvalues do not depend on the points
    part: np.ndarray
    #: which points are the nodes
    nodes: np.ndarray

    @functools.cached_property
    def spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues in natural units, and the poses of all points in their directions (points, ways)."""
        weight = np.repeat(self.part, len(self.free) // len(self.part))
        root = 1.0 / np.sqrt(np.sum(self.free**2 * weight[:, None], axis=0))
        values, vectors = np.linalg.eigh(root[:, None] * symmetric(self.energy) * root)
        return values, self.free @ (root[:, None] * vectors)

    @property
    def rounding(self) -> float:
        """That of the stiffest, which pulls, may turn the sign of a soft one."""
        return ROUNDING * float(np.max(np.abs(self.spectrum[0]), initial=0.0))

    @property
    def count(self) -> int:
        """How many eigenvalues are negative."""
        return int(np.sum(self.spectrum[0] < -self.rounding))

    def told(self, system: System, row: int) -> Stability:
        """The result, unless rounding leaves it open."""
        values, ways = self.spectrum
        least = float(values[0])
        if self.rounding > SEEN and abs(least) <= self.rounding:
            raise ValueError(
                f"row {row} cannot be decided: its least eigenvalue, {least:.2g} EI/L, is within the "
                f"rounding of the largest, {self.rounding:.2g} EI/L; allowed is a rod that is less slender"
            )
        moves = ways[:, 0].reshape(-1, system.strands, 6)[self.nodes, :, :3]
        # what only twists does not move the line
        moves = moves / max(float(np.max(np.linalg.norm(moves, axis=-1))), np.finfo(float).tiny)
        mode = moves[:, 0] if system.strands == 1 else moves
        asymmetry = float(np.max(np.abs(self.energy - self.energy.T)) / np.max(np.abs(self.energy)))
        return Stability(self.count, least, mode, asymmetry)


def _decided(system: System, divisions: Iterator[Pieces], row: int) -> Stability:
    """What two divisions in a row agree on; that it is unstable the last one may tell alone."""
    counts: list[int] = []
    sure, found = False, None
    for pieces in divisions:
        _require_rest(system, pieces.ends.base, pieces.moved)
        found = _variation(system, pieces)
        counts.append(found.count)
        # a piece that would not stay by itself may hide some
        before, sure = sure, firm(pieces.stiffness)
        if before and sure and counts[-1] == counts[-2]:
            return found.told(system, row)
    if found is not None and all(counts[-2:]):
        return found.told(system, row)
    raise ValueError(
        f"row {row} cannot be decided: with segments divided further and further it has "
        f"{', '.join(map(str, counts))} unstable directions; allowed is a rod with more nodes than "
        f"{system.nodes}, by which no segment buckles alone"
    )


def _variation(system: System, pieces: Pieces) -> _Variation:
    """The second variation by the nodes' poses; where those would hide a direction, by all pieces'."""
    elements, part = pieces.stiffness, pieces.part
    nodes = np.searchsorted(pieces.segment, np.arange(system.nodes))
    whole, hidden = joined(np.split(elements, nodes[1:-1]))
    if system.nodes > 2 and not hidden and firm(whole):
        elements, part, nodes = whole, np.full(len(whole), 1.0 / len(whole)), np.arange(system.nodes)
    count, points = 6 * system.strands, len(elements) + 1
    K = np.zeros((count * points, count * points))
    for j, element in enumerate(elements):
        for k, own in enumerate(element):
            spot = np.arange(6) + count * j + 6 * k
            spots = np.append(spot, spot + count)
            K[np.ix_(spots, spots)] += own
    ends = pieces.ends
    base = _freedom(_at_end(system, ends.y[0], narrow, ends.base))
    # what the tip's conditions leave free: as many ways as they have numbers
    left = np.linalg.svd(_at_end(system, ends.y[1], wide, ends.tip.T).T)[2][ends.tip.shape[0] :].T
    tip = _freedom(left)
    inner = np.eye(count * (points - 2))
    free = block_diag(base[0], inner, tip[0])
    energy = free.T @ K @ free
    a, b = base[0].shape[1], tip[0].shape[1]
    energy[:a, :a] += base[0].T @ base[1]
    energy[len(energy) - b :, len(energy) - b :] -= tip[0].T @ tip[1]
    weight = (np.append(part, 0.0) + np.append(0.0, part)) / 2.0
    return _Variation(energy, free, weight, nodes)


def _at_end(system: System, y: np.ndarray, way: Any, columns: np.ndarray) -> np.ndarray:
    """Columns of y's numbers in poses and stresses, all poses first; or, by `wide`, of what asks of y."""
    strands, moved = system.strands, columns.reshape(system.strands, -1, columns.shape[1])
    own = np.stack([np.asarray(way(system.strand, jnp.asarray(each))) for each in in_strands(system, y)])
    if way is wide:
        own = np.swapaxes(own, 1, 2)
    found = (own @ moved).reshape(strands, 2, 6, -1)
    return np.swapaxes(found, 0, 1).reshape(12 * strands, -1)


def _freedom(ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the ways (δx over δf, in columns) in which an end can change: poses it can take, and δf of each."""
    x, f = np.split(ways, 2)
    U, size, V = np.linalg.svd(x)
    rank = int(np.sum(size > HELD * max(1.0, size.max(initial=0.0))))
    return U[:, :rank], f @ V[:rank].T / size[:rank]
