"""Linearised motion about an equilibrium: frequencies, damping and shapes of its modes, on two grids."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from knode_cosserat._blas import one_thread
from knode_cosserat.engine.linear_step import LinearStep
from knode_cosserat.engine.loops import has_friction, linear_step
from knode_cosserat.rods.aspects import Ends
from knode_cosserat.rods.strands import of_rods, strand_count, strand_of
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.grid import grid_of
from knode_cosserat.schemes.history import repeated_record_history, used_places
from knode_cosserat.schemes.settings import NewtonOptions, Settings
from knode_cosserat.schemes.space import Lobatto4
from knode_cosserat.solvers.run import TimeIntegration
from knode_cosserat.solvers.small_motion import (
    NEUTRAL,
    RATE,
    SAME,
    history_size,
    largest_eigenvalues,
    natural_time,
)

#: nodes of the two grids that are compared: for robots of at most as many nodes as the finer one, or the last
GRIDS = ((11, 21), (21, 41))
#: largest number of history terms of a step on the finer grid; beyond, eigenvalues take minutes
MOST_TERMS = 4000
#: largest factors that are wanted of each strand
WANTED = 40
#: largest difference of λ between the two grids, as a fraction of λ or of the natural rate, up to the first
#: mode with a larger one: modes beyond it are of the grid. A scheme of order 4 has a fifteenth of the
#: difference as its error on the finer grid; a quarter is taken
RESOLVED, ERROR = 0.1, 0.25
#: rounding of a factor ζ; rounding of λ as a fraction of it
FACTOR_ROUNDING, ROUNDING = 1e-13, 1e-8
#: frequency below which an eigenvalue is real, as a fraction of λ or of the natural rate
TOGETHER = 1e-6


class _ResolvedModes(NamedTuple):
    """Resolved modes of small motions about an equilibrium: the fastest growing first."""

    #: λ: growth rate and angular frequency (1/s); of a complex pair, the one with positive frequency
    values: np.ndarray
    #: uncertainty of the growth rates (1/s), by two grids, and the part of it that is rounding
    uncertainty: np.ndarray
    rounding: np.ndarray
    #: λ on the coarser grid (1/s)
    coarse: np.ndarray
    #: (m, nodes, y): complex amplitudes of y
    motions: np.ndarray

    @property
    def growing(self) -> np.ndarray:
        """True for modes that grow, for certain."""
        return self.values.real > self.uncertainty

    @property
    def undecided(self) -> np.ndarray:
        """True for modes that grow on one of the grids, but not for certain."""
        return ~self.growing & (np.maximum(self.values.real, self.coarse.real) > self.rounding)


def linearised_modes(system: System, y: np.ndarray, control: np.ndarray) -> _ResolvedModes:
    """Return the modes of small motions about an equilibrium y (nodes, y).

    Raises `ValueError`, with a reason, if they cannot be computed.
    """
    needed = system.needed_nodes
    grids = next((pair for pair in GRIDS if max(system.nodes, needed) <= pair[1]), GRIDS[-1])
    grids = grids if needed <= grids[1] else (needed, 2 * needed - 1)
    if used_places(system.replace(nodes=grids[1]), Lobatto4()) * history_size(system) > MOST_TERMS:
        raise ValueError(f"its motions have more than {MOST_TERMS} history terms")
    if not strand_of(system).y_layout.ranges("q"):
        raise ValueError(f"a {type(system).__name__} has no velocity q in y")
    found = []
    for nodes in grids:
        own = system.replace(nodes=nodes)
        at = np.linspace(0.0, 1.0, nodes)
        guess = np.stack([np.interp(at, np.linspace(0.0, 1.0, system.nodes), each) for each in y.T], axis=1)
        if has_friction(own, Lobatto4()):
            raise ValueError("its friction has no linearisation at rest")
        solved, error, step = _step(own, guess, control)
        off = np.max(np.abs(of_rods(system, solved - guess, "p")))
        if not (error <= NewtonOptions().acceptable and off < SAME * float(system.length)):
            raise ValueError(f"no equilibrium near it is found with {nodes} nodes")
        with one_thread():
            factors, vectors = largest_eigenvalues(step, WANTED * strand_count(system))
        found.append(RATE * (1.0 - 1.0 / factors))
    coarse, fine = found
    nearest = np.abs(fine[:, None] - coarse).argmin(axis=1)
    sizes = np.maximum(np.abs(fine), 1.0)
    # a double real eigenvalue may be computed as a complex pair
    fine = np.where(np.abs(fine.imag) < TOGETHER * sizes, fine.real, fine)
    differs = np.abs(fine - coarse[nearest]) > RESOLVED * sizes
    kept = (np.abs(fine) < np.min(np.abs(fine[differs]), initial=np.inf)) & (fine.imag >= 0.0)
    if not np.any(kept):
        raise ValueError(f"none of its motions is the same with {grids[0]} and {grids[1]} nodes")
    fine, vectors, other = fine[kept], vectors[:, kept], coarse[nearest[kept]]
    rounding = (
        ROUNDING * np.abs(fine)
        + FACTOR_ROUNDING * np.abs(RATE - fine) ** 2 / RATE
        + NEUTRAL * (np.abs(fine) < NEUTRAL)
    )
    uncertainty = ERROR * np.abs(fine.real - other.real) + rounding
    # of motions that neither grow nor decay, the slowest first
    growth = np.where(np.abs(fine.real) <= uncertainty, 0.0, fine.real)
    order = np.lexsort((np.abs(fine), -growth))
    time = natural_time(own, step)
    found = [each[order] / time for each in (fine, uncertainty, rounding, other)]
    records = vectors.T[order].reshape(len(order), -1, history_size(own))
    motions = records[:, grid_of(own, Lobatto4()).nodes, : own.y_layout.size]
    return _ResolvedModes(found[0], found[1], found[2], found[3], motions)


def _step(system: System, guess: np.ndarray, control: np.ndarray) -> tuple[np.ndarray, float, LinearStep]:
    """Return the equilibrium at the nodes, its error, and a linearised step from it."""
    space, ny = Lobatto4(), system.y_layout.size
    still, settings = (Settings.of(time, space, "paper", NewtonOptions()) for time in (None, "bdf1"))
    begun = linear_step(system, space, control, guess)
    c0 = RATE / natural_time(system, begun)
    if Ends.of(system).held:
        found = TimeIntegration(still).solve(system, control[None], begun.still.y)[2]
    else:
        # a robot that can move as a whole has no single equilibrium, but a step from rest
        past = repeated_record_history(system, settings, begun.still.records, begun.still.y, 0.0)
        found = TimeIntegration(settings, 1.0 / c0).solve(system, control[None], past)[2]
    solved = found.records[0, :, :ny]
    step = linear_step(system, space, control, solved)
    step.linearise(c0)
    return solved, float(found.error[0]), step


def displacements(system: System, motion: np.ndarray) -> np.ndarray:
    """Return the displacements of the nodes of a robot (nodes, strands, 3) in a mode (points, y).

    Their phase is that of the largest displacement.
    """
    p = of_rods(system, motion, "p")
    moves = np.real(p * np.conj(p.ravel()[np.argmax(np.abs(p))]))
    grid, nodes = (np.linspace(0.0, 1.0, size) for size in (len(moves), system.nodes))
    return np.apply_along_axis(lambda own: np.interp(nodes, grid, own), 0, moves)


def normalise(moves: np.ndarray) -> np.ndarray:
    """Return displacements (nodes, strands, 3) with maximum 1; a single strand has no axis."""
    # a mode of pure torsion does not move the line
    moves = moves / max(float(np.max(np.linalg.norm(moves, axis=-1))), np.finfo(float).tiny)
    return moves[:, 0] if moves.shape[1] == 1 else moves
