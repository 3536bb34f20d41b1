"""Linearised motion about an equilibrium: frequencies, damping and shapes of its modes.

In a small motion δy e^{λt} all rates are λ times the changes. A step of implicit Euler of any length,
y_t = c0 (y - y_before), multiplies such a motion by ζ = c0 / (c0 - λ). The eigenvalues ζ of one linearised
step therefore give λ without an error in time. Inertia, damping, relaxation, ends and attached bodies are
those of `simulate`; no potential is needed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.aspects import Ends
from knode_cosserat.rods.law import InternalState, JointLaw, MaterialLaw
from knode_cosserat.rods.strands import in_strands, of_rods, strand_count, strand_of
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.solvers.grid import grid_of
from knode_cosserat.solvers.history import StepCoefficients, repeated_record_history, used_places
from knode_cosserat.solvers.replay import still_state
from knode_cosserat.solvers.run import TimeIntegration
from knode_cosserat.solvers.sensitivity import Changes, TangentState, tangent_time_loop
from knode_cosserat.solvers.settings import NewtonOptions, Settings
from knode_cosserat.solvers.space import Lobatto4

#: nodes of the two grids that are compared: for robots of at most as many nodes as the finer one, or the last
GRIDS = ((11, 21), (21, 41))
#: largest number of history terms of a step on the finer grid; beyond, eigenvalues take minutes
MOST_TERMS = 4000
#: vectors side by side; largest factors that are wanted of each strand, and most vectors for each of them
BLOCK, WANTED, MOST = 16, 40, 16
#: residual of an eigenvector, as a fraction of its factor
CONVERGED = 1e-9
#: c0 of the step in natural units: near the lowest frequencies, which are thereby the most accurate
RATE = 10.0
#: factors below this are of history that does not move anything
STILL = 1e-9
#: largest difference of λ between the two grids, as a fraction of λ or of the natural rate, up to the first
#: mode with a larger one: modes beyond it are of the grid. A scheme of order 4 has a fifteenth of the
#: difference as its error on the finer grid; a quarter is taken
RESOLVED, ERROR = 0.1, 0.25
#: rounding of a factor ζ; rounding of λ as a fraction of it; natural rate below which a mode is neutral
FACTOR_ROUNDING, ROUNDING, NEUTRAL = 1e-13, 1e-8, 1e-4
#: frequency below which an eigenvalue is real, as a fraction of λ or of the natural rate
TOGETHER = 1e-6
#: largest distance, in lengths, between the equilibria of the two grids
SAME = 0.02


class _Modes(NamedTuple):
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


def linearised_modes(system: System, y: np.ndarray, control: np.ndarray) -> _Modes:
    """Return the modes of small motions about an equilibrium y (nodes, y).

    Raises `ValueError`, with a reason, if they cannot be computed.
    """
    grids = next((pair for pair in GRIDS if system.nodes <= pair[1]), GRIDS[-1])
    if used_places(system.replace(nodes=grids[1]), Lobatto4()) * _history_size(system) > MOST_TERMS:
        raise ValueError(f"its motions have more than {MOST_TERMS} history terms")
    layout, scale = strand_of(system).y_layout, np.asarray(strand_of(system).scales().y)
    if not layout.ranges("q"):
        raise ValueError(f"a {type(system).__name__} has no velocity q in y")
    s = jnp.zeros(())
    base = in_strands(system, jnp.asarray(y[0]))[0]
    strand, still = strand_of(nominal_model(system)), jnp.zeros_like(base)
    law = strand.constitutive(s, s, base, still, jnp.asarray(control))
    for own in [own for own, *_ in law.laws] if isinstance(law, JointLaw) else [law]:
        if isinstance(own, InternalState) or (isinstance(own, MaterialLaw) and own.internal is not None):
            raise ValueError("its friction has no linearisation at rest")
    time = float(scale[layout.ranges("p")[0][0]] / scale[layout.ranges("q")[0][0]])
    found, c0 = [], RATE / time
    for nodes in grids:
        own = system.replace(nodes=nodes)
        at = np.linspace(0.0, 1.0, nodes)
        guess = np.stack([np.interp(at, np.linspace(0.0, 1.0, system.nodes), each) for each in y.T], axis=1)
        solved, error, step, unit = _step(own, guess, control, c0)
        off = np.max(np.abs(of_rods(system, solved - guess, "p")))
        if not (error <= NewtonOptions().acceptable and off < SAME * float(system.length)):
            raise ValueError(f"no equilibrium near it is found with {nodes} nodes")
        factors, vectors = _largest_eigenvalues(step, unit, WANTED * strand_count(system))
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
    found = [each[order] / time for each in (fine, uncertainty, rounding, other)]
    records = vectors.T[order].reshape(len(order), -1, _history_size(own))
    motions = records[:, grid_of(own, Lobatto4()).nodes, : own.y_layout.size]
    return _Modes(found[0], found[1], found[2], found[3], motions)


def _history_size(system: System) -> int:
    return system.y_layout.size * (2 if system.mixed else 1) + system.z_layout.size


def _step(
    system: System, guess: np.ndarray, control: np.ndarray, c0: float
) -> tuple[np.ndarray, float, Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """Return the equilibrium at the nodes, its error, a linearised step of its history, and its units."""
    space, used, ny = Lobatto4(), used_places(system, Lobatto4()), system.y_layout.size
    still, settings = (Settings.of(time, space, "paper", NewtonOptions()) for time in (None, "bdf1"))
    begun = still_state(system, space, control, guess)
    if Ends.of(system).held:
        _, y, found = TimeIntegration(still).solve(system, control[None], begun.y)
    else:
        # a robot that can move as a whole has no single equilibrium, but a step from rest
        past = repeated_record_history(system, settings, begun.records, begun.y, 0.0)
        _, after, found = TimeIntegration(settings, 1.0 / c0).solve(system, control[None], past)
        y = after.y[0]
    records = still_state(system, space, control, y).records[:used]
    steps = StepCoefficients.of(settings, 1.0 / c0, settings.memory)
    before = np.stack([records] * settings.memory)
    unit = np.tile(np.concatenate([system.scales().y, np.ones(records.shape[1] - ny)]), used)

    def stepped(vectors: np.ndarray) -> np.ndarray:
        m = vectors.shape[1]
        d_past = np.zeros((settings.memory, *records.shape, m))
        d_past[0] = vectors.reshape(*records.shape, m)
        state = TangentState(before, np.zeros_like(records), d_past, np.zeros_like(d_past[0]), 0.0)
        changes = Changes(np.zeros((1, system.control_layout.size, m)))
        solved = found.records, found.unknowns
        moved, _ = tangent_time_loop(steps, solved, (system, control[None]), changes, state)
        return np.asarray(moved.d_records[0].reshape(len(vectors), m))

    return found.records[0, :, :ny], float(found.error[0]), stepped, unit


def _largest_eigenvalues(
    step: Callable[[np.ndarray], np.ndarray], unit: np.ndarray, wanted: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest eigenvalues of a linear map of vectors, and their vectors (count, m).

    By a block Krylov method, which finds multiple eigenvalues as well (Saad 2011, section 6.5).

    Args:
        step: map of vectors side by side (count, BLOCK).
        unit: unit of each number (count,).
        wanted: number of eigenvalues, or more than there are.
    """
    fresh = np.linalg.qr(np.random.default_rng(0).normal(size=(len(unit), BLOCK)))[0]
    basis = images = np.zeros((len(unit), 0))
    while True:
        basis = np.concatenate([basis, fresh], axis=1)
        images = np.concatenate([images, step(unit[:, None] * fresh) / unit[:, None]], axis=1)
        values, small = np.linalg.eig(basis.T @ images)
        largest = np.argsort(-np.abs(values))[:wanted]
        values, vectors = values[largest], basis @ small[:, largest]
        off = np.linalg.norm(images @ small[:, largest] - vectors * values, axis=0)
        known = (np.abs(values) > STILL) & (off <= CONVERGED * np.abs(values))
        if known.all() or basis.shape[1] + BLOCK > min(MOST * wanted, len(unit)):
            # none beyond one that did not converge
            count = int(np.argmin(np.append(known, False)))
            return values[:count], unit[:, None] * vectors[:, :count]
        fresh = images[:, -BLOCK:]
        for _ in range(2):
            fresh = np.linalg.qr(fresh - basis @ (basis.T @ fresh))[0]


def displacements(system: System, motion: np.ndarray) -> np.ndarray:
    """Return the displacements of the nodes of a robot (nodes, strands, 3) in a mode (points, y).

    Their phase is that of the largest displacement.
    """
    p = of_rods(system, motion, "p")
    moves = np.real(p * np.conj(p.ravel()[np.argmax(np.abs(p))]))
    grid, nodes = (np.linspace(0.0, 1.0, size) for size in (len(moves), system.nodes))
    return np.apply_along_axis(lambda own: np.interp(nodes, grid, own), 0, moves)


def normalised(moves: np.ndarray) -> np.ndarray:
    """Return displacements (nodes, strands, 3) with maximum 1; a single strand has no axis."""
    # a mode of pure torsion does not move the line
    moves = moves / max(float(np.max(np.linalg.norm(moves, axis=-1))), np.finfo(float).tiny)
    return moves[:, 0] if moves.shape[1] == 1 else moves
