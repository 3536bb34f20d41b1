"""Stability of equilibria by their small motions, on the grid and by the scheme that solved them.

In a small motion δy e^{λt} all rates are λ times the changes. A step of implicit Euler of any length,
y_t = c0 (y - y_before), multiplies such a motion by ζ = c0 / (c0 - λ). The eigenvalues ζ of one linearised
step therefore give λ without an error in time. Inertia, damping, relaxation, ends and all parts are those of
`simulate`; no potential is needed. An equilibrium whose motion grows is tested again on a finer grid.
"""

from __future__ import annotations

import numpy as np

from knode_cosserat._blas import one_thread
from knode_cosserat.engine.linear_step import LinearStep
from knode_cosserat.engine.loops import has_friction, linear_step
from knode_cosserat.rods.strands import of_rods, strand_of
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.history import StepRows, repeated_record_history, used_places
from knode_cosserat.schemes.result import Result, Verdict
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.solvers.energy import RodEnergy, is_tested
from knode_cosserat.solvers.refinement import is_too_coarse
from knode_cosserat.solvers.replay import still_state
from knode_cosserat.solvers.run import TimeIntegration

#: vectors side by side; most vectors for each factor that is wanted
BLOCK, MOST = 16, 16
#: growth of the basis after which its eigenvalues, which cost most, are computed again
AGAIN = 1.25
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
#: motion from an unstable equilibrium: its first change in natural units, its time step as a multiple of the
#: time in which it grows by e, and its number of steps
FIRST, GROWN, MOTION = 0.02, 0.5, 300


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
    if has_friction(system, settings.space):
        return Verdict.UNTESTED_FRICTION
    if used_places(system, settings.space) * history_size(system) > TOO_MANY:
        return Verdict.UNTESTED_SIZE
    step = linear_step(system, settings.space, control, y)
    if not step.error_at(LATER) <= BALANCED:
        return Verdict.UNTESTED_TURNING
    rate = fastest_growth(system, step)
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
    solved = rows.records[0, :, : y.shape[1]]
    off = np.max(np.abs(of_rods(system, solved[::2] - y, "p")))
    if not (rows.error[0] <= settings.newton.acceptable and off < SAME * float(system.length)):
        return Verdict.UNTESTED_GRID
    fine = fastest_growth(finer, linear_step(finer, settings.space, control, solved))
    if fine is None or not fine.real > abs(fine.real - rate.real):
        return Verdict.UNTESTED_GRID
    return Verdict.UNSTABLE if abs(fine.imag) <= fine.real else Verdict.FLUTTER


def fastest_growth(system: System, step: LinearStep) -> complex | None:
    """Return λ, in natural units, of the motion that grows most; 0 if none grows, None if not resolved."""
    step.linearise(RATE / natural_time(system, step))
    factors = _eigenvalues(step, history_size(system))
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


def stable_near(system: System, settings: Settings, row: StepRows, control: np.ndarray) -> StepRows | None:
    """Return a stable equilibrium that an unstable one moves to; None if none is found.

    The motion begins along the mode that grows fastest. Long steps of implicit Euler damp it, until it rests.
    """
    space, ny = settings.space, system.y_layout.size
    step = linear_step(system, space, control, row.records[:, :ny])
    rate = fastest_growth(system, step)
    if not rate or abs(rate.imag) > rate.real:
        return None
    image, kept = _reduce(step, history_size(system))
    with one_thread():
        factors, vectors = np.linalg.eig(image)
    mode = np.zeros(len(step.unit))
    mode[kept] = np.real(vectors[:, np.argmin(np.abs(factors - RATE / (RATE - rate)))])
    moved = step((step.unit * mode)[:, None]).reshape(-1, history_size(system))
    moved = moved[: len(step.still.y), :ny]
    y = step.still.y + FIRST * moved / np.max(np.abs(moved / step.scale_y))
    dt = GROWN * natural_time(system, step) / rate.real
    damped = Settings.of("bdf1", space, "paper", settings.newton)
    past = repeated_record_history(system, damped, still_state(system, space, control, y).records, y, 0.0)
    motion = TimeIntegration(damped, dt, MOTION)
    done, past, _ = motion.solve(system, np.repeat(control[None], MOTION, axis=0), past)
    if done < MOTION:
        return None
    _, _, rows = TimeIntegration(settings).solve(system, control[None], past.y[0])
    found = StepRows(*(leaf[0] for leaf in rows))
    if not found.error <= settings.newton.acceptable:
        return None
    if verdict_by_motion(system, settings, found, control) != Verdict.STABLE:
        return None
    coarse = found.result == Result.COARSE
    return found if coarse else found._replace(result=int(Result.RECOVERED_RELAXATION))


def _eigenvalues(step: LinearStep, size: int) -> np.ndarray:
    """Return the eigenvalues of a map of history with `size` terms at each place, but zeros."""
    with one_thread():
        return np.linalg.eigvals(_reduce(step, size)[0])


def _reduce(step: LinearStep, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a map of history, in its units, between terms that act, and the places of these terms."""
    unit = step.unit
    # terms whose rates are in no equation; a random history shows them
    random = np.random.default_rng(0).normal(size=(len(unit) // size, size, 1)) * np.eye(size)
    seen = step(unit[:, None] * random.reshape(len(unit), size)) != 0.0
    kept = np.flatnonzero(np.tile(np.any(seen, axis=0), len(unit) // size) & np.any(seen, axis=1))
    image = step((unit[:, None] * np.eye(len(unit)))[:, kept])[kept] / unit[kept, None]
    acts = np.any(image != 0.0, axis=0)
    return image[np.ix_(acts, acts)], kept[acts]


def natural_time(system: System, step: LinearStep) -> float:
    """Return the natural time (s) of a robot's first strand: that of its position over its velocity."""
    layout = strand_of(system).y_layout
    return float(step.scale_y[layout.ranges("p")[0][0]] / step.scale_y[layout.ranges("q")[0][0]])


def history_size(system: System) -> int:
    """Return the number of history terms at each place."""
    return system.y_layout.size * (2 if system.mixed else 1) + system.z_layout.size


def largest_eigenvalues(step: LinearStep, wanted: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest eigenvalues of a map of history, and their vectors (count, m).

    By a block Krylov method, which finds multiple eigenvalues as well (Saad 2011, section 6.5).

    Args:
        step: the map, linearised.
        wanted: number of eigenvalues, or more than there are.
    """
    unit = step.unit
    fresh = np.linalg.qr(np.random.default_rng(0).normal(size=(len(unit), BLOCK)))[0]
    basis = images = np.zeros((len(unit), 0))
    examined = 0
    while True:
        basis = np.concatenate([basis, fresh], axis=1)
        images = np.concatenate([images, step(unit[:, None] * fresh) / unit[:, None]], axis=1)
        last = basis.shape[1] + BLOCK > min(MOST * wanted, len(unit))
        if last or basis.shape[1] >= AGAIN * examined:
            examined = basis.shape[1]
            values, small = np.linalg.eig(basis.T @ images)
            largest = np.argsort(-np.abs(values))[:wanted]
            values, vectors = values[largest], basis @ small[:, largest]
            off = np.linalg.norm(images @ small[:, largest] - vectors * values, axis=0)
            known = (np.abs(values) > STILL) & (off <= CONVERGED * np.abs(values))
            if last or known.all():
                # none beyond one that did not converge
                count = int(np.argmin(np.append(known, False)))
                return values[:count], unit[:, None] * vectors[:, :count]
        fresh = images[:, -BLOCK:]
        for _ in range(2):
            fresh = np.linalg.qr(fresh - basis @ (basis.T @ fresh))[0]
