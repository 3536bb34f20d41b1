"""Linearised motion about an equilibrium: growth rates and frequencies of its modes.

In a small motion δy e^{λt} all rates are λ times the changes. A step of implicit Euler of any length,
y_t = c0 (y - y_before), multiplies such a motion by ζ = c0 / (c0 - λ). The eigenvalues ζ of one linearised
step therefore give λ without an error in time. Inertia, damping, relaxation, ends and attached bodies are
those of `simulate`; no potential is needed.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.law import InternalState, MaterialLaw
from knode_cosserat.rods.strands import in_strands, strand_of
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.solvers.grid import grid_of
from knode_cosserat.solvers.history import StepCoefficients, used_places
from knode_cosserat.solvers.replay import still_state
from knode_cosserat.solvers.run import TimeIntegration
from knode_cosserat.solvers.sensitivity import Changes, TangentState, tangent_time_loop
from knode_cosserat.solvers.settings import NewtonOptions, Settings
from knode_cosserat.solvers.space import Lobatto4

#: nodes of the two grids that are compared: for robots of at most as many nodes as the finer one, or the last
GRIDS = ((11, 21), (21, 41))
#: largest number of history terms of a step on the finer grid; beyond, eigenvalues take minutes
MOST_TERMS = 4000
#: number of tangents side by side
COLUMNS = 512
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
    #: growth rates on the coarser grid (1/s)
    coarse: np.ndarray
    #: (nodes, y): complex amplitude of y in the first mode
    first: np.ndarray

    @property
    def growing(self) -> np.ndarray:
        """True for modes that grow, for certain."""
        return self.values.real > self.uncertainty

    @property
    def undecided(self) -> np.ndarray:
        """True for modes that grow on one of the grids, but not for certain."""
        return ~self.growing & (np.maximum(self.values.real, self.coarse) > self.rounding)


def linearised_modes(system: System, y: np.ndarray, control: np.ndarray) -> _Modes:
    """Return the modes of small motions about an equilibrium y (nodes, y).

    Raises `ValueError`, with a reason, if they cannot be computed.
    """
    grids = next((pair for pair in GRIDS if system.nodes <= pair[1]), GRIDS[-1])
    layout, scale = strand_of(system).y_layout, np.asarray(strand_of(system).scales().y)
    if "q" not in layout.names:
        raise ValueError(f"a {type(system).__name__} has no velocity q in y")
    s = jnp.zeros(())
    base = in_strands(system, jnp.asarray(y[0]))[0]
    strand, still = strand_of(nominal_model(system)), jnp.zeros_like(base)
    law = strand.constitutive(s, s, base, still, jnp.asarray(control))
    if isinstance(law, InternalState) or (isinstance(law, MaterialLaw) and law.internal is not None):
        raise ValueError("its friction has no linearisation at rest")
    time = float(scale[layout.slice("p")][0] / scale[layout.slice("q")][0])
    found, c0 = [], RATE / time
    for nodes in grids:
        own = system.replace(nodes=nodes)
        if used_places(own, Lobatto4()) * _history_size(own) > MOST_TERMS:
            raise ValueError(f"its motions have more than {MOST_TERMS} history terms")
        at = np.linspace(0.0, 1.0, nodes)
        guess = np.stack([np.interp(at, np.linspace(0.0, 1.0, system.nodes), each) for each in y.T], axis=1)
        solved, error, step = _step(own, guess, control, c0)
        off = np.max(np.abs(in_strands(system, solved - guess)[..., layout.slice("p")]))
        if not (error <= NewtonOptions().acceptable and off < SAME * float(system.length)):
            raise ValueError(f"no equilibrium near it is found with {nodes} nodes")
        moving = np.any(step != 0.0, axis=0)
        factors = np.linalg.eigvals(step[np.ix_(moving, moving)])
        factors = factors[np.abs(factors) > STILL]
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
    fine, factors, other = fine[kept], factors[kept], coarse[nearest[kept]]
    rounding = (
        ROUNDING * np.abs(fine)
        + FACTOR_ROUNDING * np.abs(RATE - fine) ** 2 / RATE
        + NEUTRAL * (np.abs(fine) < NEUTRAL)
    )
    uncertainty = ERROR * np.abs(fine.real - other.real) + rounding
    # of motions that neither grow nor decay, the slowest first
    growth = np.where(np.abs(fine.real) <= uncertainty, 0.0, fine.real)
    order = np.lexsort((np.abs(fine), -growth))
    first = _motion(own, step, moving, factors[order[0]])
    found = [each[order] / time for each in (fine, uncertainty, rounding, other.real)]
    return _Modes(found[0], found[1], found[2], found[3], first)


def _history_size(system: System) -> int:
    return system.y_layout.size * (2 if system.mixed else 1) + system.z_layout.size


def _step(
    system: System, guess: np.ndarray, control: np.ndarray, c0: float
) -> tuple[np.ndarray, float, np.ndarray]:
    """Return the equilibrium at the nodes, its error, and the matrix of a linearised step on its history."""
    space, used, ny = Lobatto4(), used_places(system, Lobatto4()), system.y_layout.size
    still, settings = (Settings.of(time, space, "paper", NewtonOptions()) for time in (None, "bdf1"))
    y = still_state(system, space, control, guess).y
    _, y, found = TimeIntegration(still).solve(system, control[None], y)
    records = still_state(system, space, control, y).records[:used]
    steps = StepCoefficients.of(settings, 1.0 / c0, settings.memory)
    count, past, parts = records.size, np.stack([records] * settings.memory), []
    for k in range(0, count, COLUMNS):
        m = min(COLUMNS, count - k)
        d_past = np.zeros((2, count, m))
        d_past[0, k : k + m] = np.eye(m)
        d_past = d_past.reshape(settings.memory, *records.shape, m)
        state = TangentState(past, np.zeros_like(records), d_past, np.zeros_like(d_past[0]), 0.0)
        changes = Changes(np.zeros((1, system.control_layout.size, m)))
        solved = found.records, found.unknowns
        after, _ = tangent_time_loop(steps, solved, (system, control[None]), changes, state)
        parts.append(after.d_records[0].reshape(count, -1))
    return found.records[0, :, :ny], float(found.error[0]), np.concatenate(parts, axis=1)


def _motion(system: System, step: np.ndarray, moving: np.ndarray, factor: complex) -> np.ndarray:
    """Return the complex amplitude of y at the nodes in the motion with a factor, by inverse iteration."""
    own = step[np.ix_(moving, moving)] - factor * (1.0 + STILL) * np.eye(int(np.sum(moving)))
    vector = np.linalg.solve(own, np.linalg.solve(own, np.ones(len(own))))
    grid = grid_of(system, Lobatto4())
    record = (step[:, moving] @ (vector / np.max(np.abs(vector)))).reshape(-1, _history_size(system))
    return np.asarray(record[grid.nodes, : system.y_layout.size])
