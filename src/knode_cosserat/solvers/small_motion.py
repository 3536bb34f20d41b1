"""Stability of equilibria by their small motions, on the grid and by the scheme that solved them.

In a small motion δy e^{λt} all rates are λ times the changes. A step of implicit Euler of any length,
y_t = c0 (y - y_before), multiplies such a motion by ζ = c0 / (c0 - λ). The eigenvalues ζ of one linearised
step therefore give λ without an error in time. Inertia, damping, relaxation, ends and all parts are those of
`simulate`; no potential is needed. An equilibrium whose motion grows is tested again on a finer grid.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.law import InternalState, JointLaw, MaterialLaw
from knode_cosserat.rods.strands import in_strands, of_rods, strand_of
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.solvers.energy import RodEnergy, is_tested
from knode_cosserat.solvers.history import StepCoefficients, StepRows, used_places
from knode_cosserat.solvers.refinement import is_too_coarse
from knode_cosserat.solvers.replay import still_state
from knode_cosserat.solvers.result import Result, Verdict
from knode_cosserat.solvers.run import TimeIntegration
from knode_cosserat.solvers.sensitivity import Changes, TangentState, tangent_time_loop
from knode_cosserat.solvers.settings import NewtonOptions, Settings
from knode_cosserat.solvers.space import SpaceScheme

#: vectors side by side; most vectors for each factor that is wanted
BLOCK, MOST = 16, 16
#: residual of an eigenvector, as a fraction of its factor
CONVERGED = 1e-9
#: c0 of the step in natural units: near the lowest frequencies, which are thereby the most accurate
RATE = 10.0
#: factors below this are of history that does not move anything
STILL = 1e-9
#: number of history terms beyond which the eigenvalues would take longer than the equilibrium
TOO_MANY = 2000
#: growth, as a fraction of |λ| or of the natural rate, below which a motion does not grow
GROWTH = 1e-6
#: natural rate below which a motion is neutral
NEUTRAL = 1e-4
#: segments in half a wave from which a grid resolves a bending mode
SEGMENTS = 4.0
#: rate above which no motion of the rod grows, as a multiple of that of the last resolved mode
BEYOND = 10.0
#: largest distance, in lengths, between the equilibria of the two grids
SAME = 0.02
#: time (s) at which an equilibrium must still be one, and largest residual then, in natural units; no common
#: rate of a frame makes whole turns in it
LATER, BALANCED = 0.618, 1e-6


def verdicts(system: System, settings: Settings, rows: StepRows, controls: np.ndarray | None) -> np.ndarray:
    """Return a `Verdict` for each equilibrium (…, T) of a robot or a batch, under controls (…, T, c).

    The energy decides for rods under dead loads. Of other robots a single equilibrium is tested. Without
    controls no more is tested than `static_run` did.
    """
    untested = Verdict.UNTESTED_MANY if controls is not None else Verdict.UNTESTED_UNASKED
    found = np.full(np.shape(rows.result), int(untested))
    found[rows.result < 0] = int(Verdict.UNTESTED_UNSOLVED)
    found[rows.result == Result.UNSTABLE] = int(Verdict.UNSTABLE)
    if controls is None:
        return found
    many, by_energy = np.ndim(system.length) > 0, is_tested(system)
    for at in zip(*np.nonzero(found == int(Verdict.UNTESTED_MANY)), strict=True):
        if is_too_coarse(settings.space, rows.result[at]):
            found[at] = int(Verdict.UNTESTED_GRID)
        elif by_energy and not many:
            y = rows.records[at][:, : system.y_layout.size]
            unstable = RodEnergy(system, y, controls[at]).mode() is not None
            found[at] = int(Verdict.UNSTABLE if unstable else Verdict.STABLE)
        elif found.size == 1 and not many:
            row = StepRows(*(leaf[at] for leaf in rows))
            found[at] = int(verdict_by_motion(system, settings, row, controls[at]))
    return found


def verdict_by_motion(system: System, settings: Settings, row: StepRows, control: np.ndarray) -> Verdict:
    """Return the stability of one equilibrium by the growth of its small motions."""
    strand, y = strand_of(system), row.records[:, : system.y_layout.size]
    if not (strand.y_layout.ranges("p") and strand.y_layout.ranges("q")):
        return Verdict.UNTESTED_SYSTEM
    if has_friction(system, y[0], control):
        return Verdict.UNTESTED_FRICTION
    if used_places(system, settings.space) * history_size(system) > TOO_MANY:
        return Verdict.UNTESTED_SIZE
    later, scales = still_state(system, settings.space, control, y, LATER), system.scales()
    if not max(float(later.error), float(np.max(np.abs(later.tip / scales.tip)))) <= BALANCED:
        return Verdict.UNTESTED_TURNING
    rate = fastest_growth(system, settings, row, control)
    if rate is None:
        return Verdict.UNTESTED_GRID
    if rate == 0j:
        return Verdict.STABLE
    # a coarse grid may have motions that the rod has not
    finer = system.replace(nodes=2 * system.nodes - 1)
    at = np.linspace(0.0, 1.0, finer.nodes)
    guess = np.stack([np.interp(at, np.linspace(0.0, 1.0, system.nodes), own) for own in y.T], axis=1)
    still = still_state(finer, settings.space, control, guess)
    _, _, rows = TimeIntegration(settings).solve(finer, control[None], still.y)
    off = np.max(np.abs(of_rods(system, rows.records[0, ::2, : y.shape[1]] - y, "p")))
    if not (rows.error[0] <= settings.newton.acceptable and off < SAME * float(system.length)):
        return Verdict.UNTESTED_GRID
    fine = fastest_growth(finer, settings, StepRows(*(leaf[0] for leaf in rows)), control)
    if fine is None or not fine.real > abs(fine.real - rate.real):
        return Verdict.UNTESTED_GRID
    return Verdict.UNSTABLE if abs(fine.imag) <= fine.real else Verdict.FLUTTER


def fastest_growth(system: System, settings: Settings, row: StepRows, control: np.ndarray) -> complex | None:
    """Return λ, in natural units, of the motion that grows most; 0 if none grows, None if not resolved."""
    time = natural_time(system)
    rows = StepRows(*(np.asarray(leaf)[None] for leaf in row))
    step, unit = linearised_step(system, settings.space, rows, control, RATE / time)
    factors = _eigenvalues(step, unit, history_size(system))
    rates = RATE * (1.0 - 1.0 / factors[np.abs(factors) > STILL])
    sizes = np.maximum(np.abs(rates), 1.0)
    growing = (rates.real > GROWTH * sizes) & (np.abs(rates) > NEUTRAL)
    limit = (np.pi * (system.nodes - 1) / SEGMENTS) ** 2
    resolved, near = (np.abs(rates) <= most for most in (limit, BEYOND * limit))
    if not np.any(resolved):
        return None
    if np.any(growing & resolved):
        fastest = rates[growing & resolved]
        return complex(fastest[np.argmax(fastest.real)])
    # fast oscillations that grow are of the grid; buckling in short waves may be of the rod
    return None if np.any(growing & near & (rates.real > np.abs(rates.imag))) else 0j


def _eigenvalues(step: Callable[[np.ndarray], np.ndarray], unit: np.ndarray, size: int) -> np.ndarray:
    """Return the eigenvalues of a map of history with `size` terms at each place, but zeros."""
    places = len(unit) // size
    # terms whose rates are in no equation; a random history shows them
    random = np.random.default_rng(0).normal(size=(places, size, 1)) * np.eye(size)
    seen = step(unit[:, None] * random.reshape(len(unit), size)) / unit[:, None]
    kept = np.flatnonzero(np.tile(np.any(seen != 0.0, axis=0), places))
    image = step((unit[:, None] * np.eye(len(unit)))[:, kept]) / unit[:, None]
    return np.linalg.eigvals(image[kept])


def natural_time(system: System) -> float:
    """Return the natural time (s) of a robot's first strand: that of its position over its velocity."""
    layout, scale = strand_of(system).y_layout, np.asarray(strand_of(system).scales().y)
    return float(scale[layout.ranges("p")[0][0]] / scale[layout.ranges("q")[0][0]])


def has_friction(system: System, base: np.ndarray, control: np.ndarray) -> bool:
    """True if internal variables of the law have bounds, such as friction: no linearisation at rest."""
    strand, found = strand_of(nominal_model(system)), list[bool]()

    def look(y: Any, control: Any) -> None:
        s = jnp.zeros(())
        law = strand.constitutive(s, s, y, jnp.zeros_like(y), control)
        laws: Iterable[Any] = [own for own, *_ in law.laws] if isinstance(law, JointLaw) else [law]
        found.extend(
            isinstance(own, InternalState) or (isinstance(own, MaterialLaw) and own.internal is not None)
            for own in laws
        )

    # traced only: the kind of law does not depend on numbers
    jax.eval_shape(look, in_strands(system, np.asarray(base))[0], np.asarray(control))
    return any(found)


def history_size(system: System) -> int:
    """Return the number of history terms at each place."""
    return system.y_layout.size * (2 if system.mixed else 1) + system.z_layout.size


def linearised_step(
    system: System, space: SpaceScheme, rows: StepRows, control: np.ndarray, c0: float
) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """Return the map of history by a linearised step from an equilibrium, a row of `rows`, and its units.

    The step is of implicit Euler with y_t = c0 (y - y_before). The map takes vectors side by side (count, m).
    """
    ny = system.y_layout.size
    used, step = used_places(system, space), Settings.of("bdf1", space, "paper", NewtonOptions())
    records = still_state(system, space, control, rows.records[0, :, :ny]).records[:used]
    steps = StepCoefficients.of(step, 1.0 / c0, step.memory)
    before = np.stack([records] * step.memory)
    unit = np.tile(np.concatenate([system.scales().y, np.ones(records.shape[1] - ny)]), used)

    def stepped(vectors: np.ndarray) -> np.ndarray:
        m = vectors.shape[1]
        d_past = np.zeros((step.memory, *records.shape, m))
        d_past[0] = vectors.reshape(*records.shape, m)
        state = TangentState(before, np.zeros_like(records), d_past, np.zeros_like(d_past[0]), 0.0)
        changes = Changes(np.zeros((1, system.control_layout.size, m)))
        solved = rows.records, rows.unknowns
        moved, _ = tangent_time_loop(steps, solved, (system, control[None]), changes, state)
        return np.asarray(moved.d_records[0].reshape(len(vectors), m))

    return stepped, unit


def largest_eigenvalues(
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
