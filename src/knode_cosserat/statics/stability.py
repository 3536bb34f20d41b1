"""Stability of an equilibrium: by its energy, or for loads without a potential by its linearised motion.

Each segment is a finite element (`stiffness`). The sum over the segments, restricted by the boundary
conditions, is the stiffness of the robot. With a potential it is symmetric, the second variation of the
energy, and an equilibrium is stable if this has no negative eigenvalue. Segments are divided until the number
of negative eigenvalues is constant. Buckling between two nodes is counted too.

Loads that follow the rod may have no potential. The stiffness is then unsymmetric on any grid, and its
eigenvalues decide nothing: Beck's column flutters at 20.05 EI/L² and has no other critical load. The
eigenvalues of its linearised motion decide (`dynamics`), with the robot's own damping. They also decide for
robots with further unknowns than forces and moments, such as tensions of reels or torsions of tubes, and if
the energy of a spinning robot has no minimum: gyroscopic forces may stabilise it, and damping of the material
undoes that (Thomson and Tait).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from knode_cosserat._arguments import check_arguments
from knode_cosserat._reprs import count_of
from knode_cosserat.rods.aspects import Observed
from knode_cosserat.rods.strands import in_strands, of_rods, strand_count, strand_of
from knode_cosserat.rods.system import System, unknowns_of
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.schemes.problem import StepProblem
from knode_cosserat.schemes.result import Result
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.schemes.space import Lobatto4, SpaceScheme
from knode_cosserat.solvers.equilibrium import equilibrium as rests
from knode_cosserat.solvers.refinement import fix_grid
from knode_cosserat.solvers.replay import still_state
from knode_cosserat.statics.dynamics import displacements, linearised_modes, normalise
from knode_cosserat.statics.stiffness import (
    NEEDED,
    Pieces,
    divide,
    firm,
    join_segments,
    narrow,
    symmetric,
    wide,
)
from knode_cosserat.trajectory import Trajectory

#: largest residual of an equilibrium, in natural units
BALANCED = 1e-6
#: time (s) at which an equilibrium must still be one; no common rate of a frame makes whole turns in it
LATER = 0.618
#: singular value of an end's motion below which it counts as held, as a fraction of the largest
HELD = 1e-9
#: largest rate, in natural units, of a quantity that does not depend on poses and stresses
RESTING = 1e-9
#: divisions of segments, until two in a row give the same result
DIVISIONS = (1, 2, 4, 8, 16)
#: number of points over all strands for which eigenvalues take seconds; division by 2 always runs
POINTS = 400
#: rounding as a fraction of the largest eigenvalue, which may change the sign of a small one
ROUNDING = 1e-14
#: if rounding exceeds this, in natural units, a least eigenvalue within rounding is not decided
SEEN = 1e-3
#: asymmetry above which loads have no potential; that of a scheme's error falls as segments are divided, at
#: order 4 to a sixteenth
UNSYMMETRIC, FALLING = 1e-6, 0.25
#: number of slowest directions in which the asymmetry is measured
SLOWEST = 60
#: results of a solve that converged to a nearby solution
NEARBY = (Result.CONVERGED, Result.COARSE, Result.RECOVERED_LOAD_CONTINUATION)


class Stability(NamedTuple):
    """Stability of an equilibrium: the second variation of its energy, or its linearised motion."""

    #: number of directions in which it is unstable, zero for a stable equilibrium, -1 if undecided: negative
    #: eigenvalues of the second variation (in the nodes' displacements only, if segments would buckle even in
    #: 16 parts), or for loads without a potential growing modes
    unstable_directions: int
    #: the smallest eigenvalue of the stiffness's symmetric part, in natural units (EI/L): with a potential it
    #: is zero at the onset of buckling or snapping; NaN for a robot with further unknowns, such as reels and
    #: tubes, whose energy is not of poses alone: its margin is the decay of `eigenvalue`
    least: float
    #: (nodes, 3): displacement of the line in the direction of the smallest eigenvalue, or in the fastest
    #: growing mode, with maximum 1; for several rods (nodes, rods, 3)
    mode: np.ndarray
    #: work of the loads around a small cycle of two displacements, over the energies of both: zero for loads
    #: with a potential; it does not depend on the nodes
    asymmetry: float
    #: for loads without a potential and further unknowns: growth rate + i · angular frequency (1/s) of the
    #: mode that grows most or decays least
    eigenvalue: complex | None = None
    #: reason why stability is undecided
    reason: str = ""
    #: number of directions whose eigenvalue is zero within the error of the segments, such as rotations of a
    #: closed ring
    neutral_directions: int = 0

    def __repr__(self) -> str:
        count = f"unstable in {count_of(max(self.unstable_directions, 0), 'direction')}"
        kind = {
            "stable": "stable",
            "neutral": "neutral",
            "divergence": count,
            "flutter": f"{count} by flutter",
            "undecided": f"undecided: {self.reason}",
        }[self.kind]
        if self.eigenvalue is None:
            return f"Stability: {kind}; smallest eigenvalue {self.least:.4g} (in units of EI/L)"
        growth, frequency = self.eigenvalue.real, abs(self.eigenvalue.imag) / (2.0 * np.pi)
        text = f"Stability: {kind}; growth rate {growth:.4g} 1/s at {frequency:.4g} Hz"
        if np.isnan(self.least):
            text += "; no eigenvalue of the stiffness, because the energy is not of poses alone"
        return text

    @property
    def kind(self) -> str:
        """Kind: "stable", "neutral", "divergence" or "flutter" if it is unstable, or "undecided".

        A robot with a potential can only diverge. With several growing modes, the fastest decides the kind.
        """
        if self.unstable_directions < 1:
            return "undecided" if not self.stable else "neutral" if self.neutral_directions else "stable"
        return "divergence" if self.eigenvalue is None or self.eigenvalue.imag == 0.0 else "flutter"

    @property
    def stable(self) -> bool:
        """True if it is decided that nothing grows; neutral directions count as stable."""
        return self.unstable_directions == 0


def stability(equilibrium: Trajectory, row: int = -1) -> Stability:
    """Return the stability of a robot's equilibrium under small perturbations.

    It holds for any boundary conditions: buckling between clamps, an arch about to snap, a column about to
    fall. An equilibrium from another scheme along the rod is solved again by Lobatto4. Loads with a potential
    are decided by the energy; friction is then ignored, because it can only stabilise. Other loads, such as
    those that follow the rod, are decided by the eigenvalues of the linearised motion: it may grow without
    oscillation (divergence) or with one (flutter). So is a robot in a spinning frame whose energy has no
    minimum, which its spin may stabilise. The robot's own damping enters, also if it is zero.

    Args:
        equilibrium: result of `kc.equilibrium` for one robot, or a trajectory that has come to rest.
        row: index of the row.

    Returns:
        A `Stability`. Its kind is "undecided", with a reason, if rounding exceeds the stiffness, if there are
        too few nodes for the loads, or if two grids disagree on the growth of a motion.

    Raises:
        ValueError: the row is no equilibrium; the system is not made of rods with positions and orientations;
            or it has further unknowns, and its motions are not resolved.
    """
    check_arguments(stability, locals())
    system, y, z, control = checked_equilibrium(equilibrium, row)
    space = (equilibrium.settings or Settings()).space
    result = equilibrium.result[row]
    if not isinstance(space, Lobatto4):
        one = Trajectory(
            system=system,
            settings=equilibrium.settings,
            time=np.zeros(1),
            y=y[None],
            z=z[None],
            control=control[None],
            result=np.zeros(1, int),
            residual=np.zeros(1),
            iterations=np.zeros(1, int),
        )
        found = rests(
            fix_grid(system),
            control,
            space="lobatto4",
            initial=one,
            on_failure="return",
            with_stability=False,
        )
        if found.result[0] not in NEARBY:
            raise ValueError(
                f"row {row} cannot be decided: by Lobatto4 along the rod no equilibrium is found near it; "
                'allowed is one that was solved with space="lobatto4"'
            )
        y, result = np.asarray(found.y[0]), found.result[0]
    if result == Result.COARSE:
        reason = f"the grid of {system.nodes} nodes is too coarse for the shape; more nodes can decide"
        unknown = np.full(np.shape(of_rods(system, y, "p")), np.nan)
        return Stability(
            -1, np.nan, unknown[:, 0] if unknown.shape[1] == 1 else unknown, np.nan, None, reason
        )
    # the velocities of an equilibrium are rounding of the solver
    y, layout = y.copy(), strand_of(system).y_layout
    for name in set(Observed.of(strand_of(system)).velocities) & set(layout.names):
        in_strands(system, y)[..., layout.slice(name)] = 0.0
    if set(strand_of(system).base_unknowns) - set(NEEDED):
        return _by_motion(system, y, control)
    by = [count for count in DIVISIONS if count <= 2 or count * system.nodes * strand_count(system) <= POINTS]
    return _decide(system, y, control, by)


def checked_equilibrium(equilibrium: Any, row: Any) -> tuple[System, np.ndarray, np.ndarray, np.ndarray]:
    """Return system, y, z and control of a row that is an equilibrium.

    Raises:
        ValueError: it is none, or not one of rods with positions and orientations.
    """
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
    layout = strand_of(system).y_layout
    if not all(map(layout.ranges, NEEDED)):
        names = ", ".join(layout.names)
        raise ValueError(f"a {type(system).__name__} has y = {names}; allowed are rods with p, h, n and m")
    y, z, control = y[row], np.asarray(equilibrium.z)[row], np.asarray(equilibrium.control)[row]
    space = (equilibrium.settings or Settings()).space
    found, scales = still_state(system, space, control, y), system.scales()
    tip, base = found.tip / scales.tip, (_base(system, space, control, y[0]) - y[0]) / scales.y
    off = float(np.max([found.error, np.max(np.abs(tip)), np.max(np.abs(base))]))
    if not off <= BALANCED:
        raise ValueError(
            f"row {row} is no equilibrium: {off:.2g} of natural size is left when every rate is zero; "
            f"allowed is {BALANCED:g}"
        )
    later = still_state(system, space, control, y, LATER)
    off = float(np.max([later.error, np.max(np.abs(later.tip / scales.tip))]))
    if not off <= BALANCED:
        raise ValueError(
            f"row {row} is no equilibrium at later times: loads turn in the robot's frame; allowed in a "
            "spinning frame are gravity and dead loads along its axis"
        )
    return system, y, z, control


@functools.partial(jax.jit, static_argnames="space")
def _base(system: System, space: SpaceScheme, control: Any, y: Any) -> Any:
    """Return y at the base for its own unknowns."""
    return StepProblem.still(system, space, control).base(unknowns_of(system, y))


def _require_rest(system: System, base: np.ndarray, moved: np.ndarray) -> None:
    """Raise `ValueError` if other fields of y, such as velocities, depend on poses and stresses."""
    layout = strand_of(system).y_layout
    base = base.reshape(strand_count(system), layout.size, -1)
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
    """The second variation in the free coordinates."""

    energy: np.ndarray
    #: poses of all points for each free coordinate, strands inside (6 points strands, free)
    free: np.ndarray
    #: fraction of the rod that each point represents, so that eigenvalues do not depend on the points
    part: np.ndarray
    #: indices of the nodes among the points
    nodes: np.ndarray

    @functools.cached_property
    def spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues of the symmetric part in natural units, and directions in the free coordinates."""
        weight = np.repeat(self.part, len(self.free) // len(self.part))
        root = 1.0 / np.sqrt(np.sum(self.free**2 * weight[:, None], axis=0))
        values, vectors = np.linalg.eigh(root[:, None] * symmetric(self.energy) * root)
        return values, root[:, None] * vectors

    @property
    def rounding(self) -> float:
        """Rounding error of the largest eigenvalue, which may change the sign of a small one."""
        return ROUNDING * float(np.max(np.abs(self.spectrum[0]), initial=0.0))

    @property
    def count(self) -> int:
        """Number of negative eigenvalues."""
        return int(np.sum(self.spectrum[0] < -self.rounding))

    @functools.cached_property
    def asymmetry(self) -> float:
        """Largest work around a cycle of two displacements, over the energies of both.

        The slowest directions have nearly all of it: with more of them, or more nodes, it converges.
        """
        values, vectors = self.spectrum
        slow = np.argsort(np.abs(values))[:SLOWEST]
        own = vectors[:, slow] / np.sqrt(np.maximum(np.abs(values[slow]), 1.0))
        return float(np.linalg.norm(own.T @ (self.energy - self.energy.T) @ own / 2.0, 2))

    def by_energy(self, system: System, count: int, neutral: int = 0, reason: str = "") -> Stability:
        """Return the stability of a robot with a potential, from the numbers of eigenvalues."""
        values, vectors = self.spectrum
        least = float(values[0])
        if not reason and self.rounding > SEEN and abs(least) <= self.rounding:
            count = -1
            reason = (
                f"the least eigenvalue, {least:.2g} EI/L, is within the rounding of the largest, "
                f"{self.rounding:.2g} EI/L; a rod that is less slender can be decided"
            )
        moves = (self.free @ vectors[:, 0]).reshape(-1, strand_count(system), 6)[self.nodes, :, :3]
        return Stability(count, least, normalise(moves), self.asymmetry, None, reason, neutral)

    def by_motion(self, system: System, y: np.ndarray, control: np.ndarray) -> Stability:
        """Return the stability of a robot whose loads have no potential."""
        try:
            found = _by_motion(system, y, control)
        except ValueError as error:
            return self.by_energy(system, -1, reason=f"loads without a potential; {error}")
        reason = found.reason and f"loads without a potential; {found.reason}"
        return found._replace(least=float(self.spectrum[0][0]), asymmetry=self.asymmetry, reason=reason)


def _by_motion(system: System, y: np.ndarray, control: np.ndarray) -> Stability:
    """Return the stability by growth rates, without the energy's `least` and `asymmetry`."""
    modes = linearised_modes(system, y, control)
    first, growing, doubtful = modes.values[0], modes.growing, modes.undecided
    directions, reason = int(np.sum(growing)), ""
    if not directions and np.any(doubtful):
        directions, first = -1, modes.values[doubtful][0]
        reason = (
            f"a mode's growth rate of {first.real:.2g} 1/s is uncertain by "
            f"{modes.uncertainty[doubtful][0]:.2g} 1/s"
        )
    moves = normalise(displacements(system, modes.motions[0]))
    return Stability(directions, np.nan, moves, np.nan, complex(first), reason)


def _decide(system: System, y: np.ndarray, control: np.ndarray, by: list[int]) -> Stability:
    """Return the stability if two divisions in a row agree, or if the last ones are all unstable."""
    found: list[_Variation] = []
    sure, parts = False, getattr(strand_of(nominal_model(system)), "parts", {})
    gyroscopic = any(part.gyroscopic for part in parts.values())
    for pieces in divide(system, y, control, by):
        _require_rest(system, pieces.ends.base, pieces.moved)
        found.append(_variation(system, pieces))
        asymmetry = [each.asymmetry for each in found[-2:]]
        least = max(UNSYMMETRIC, found[-1].rounding)
        # an equilibrium without a minimum of the energy may be stable if it spins
        spins = gyroscopic and found[-1].count > 0
        if len(found) > 1 and (spins or asymmetry[1] > max(least, FALLING * asymmetry[0])):
            return found[-1].by_motion(system, y, control)
        # a piece that is unstable by itself may hide negative eigenvalues
        before, sure = sure, firm(pieces.stiffness)
        if before and sure:
            coarse, fine = found[-2:]
            values, error = fine.spectrum[0], fine.rounding
            if len(coarse.spectrum[0]) == len(values):
                error = error + np.abs(values - coarse.spectrum[0])
            count, neutral = int(np.sum(values < -error)), int(np.sum(np.abs(values) <= error))
            if count <= coarse.count <= count + neutral:
                return fine.by_energy(system, count, neutral)
    counts = [each.count for each in found]
    if all(counts[-2:]):
        return found[-1].by_energy(system, counts[-1])
    reason = (
        f"with segments divided in {', '.join(map(str, by))} it has {', '.join(map(str, counts))} unstable "
        f"directions; more nodes than {system.nodes}, by which no segment buckles alone, can decide"
    )
    return found[-1].by_energy(system, -1, reason=reason)


def _variation(system: System, pieces: Pieces) -> _Variation:
    """Return the second variation in the nodes' poses, or in all pieces' if the nodes hide a direction."""
    elements, part = pieces.stiffness, pieces.part
    nodes = np.searchsorted(pieces.segment, np.arange(system.nodes))
    whole, hidden = join_segments(np.split(elements, nodes[1:-1]))
    if system.nodes > 2 and not hidden and firm(whole):
        elements, part, nodes = whole, np.full(len(whole), 1.0 / len(whole)), np.arange(system.nodes)
    count, points = 6 * strand_count(system), len(elements) + 1
    K = np.zeros((count * points, count * points))
    for j, element in enumerate(elements):
        for k, own in enumerate(element):
            spot = np.arange(6) + count * j + 6 * k
            spots = np.append(spot, spot + count)
            K[np.ix_(spots, spots)] += own
    ends = pieces.ends
    base = _freedom(_at_end(system, ends.y[0], narrow, ends.base))
    # null space of the tip's conditions: its dimension is the number of conditions
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
    """Return columns of y in poses and stresses, all poses first; by `wide`, of linear forms on y."""
    strands, moved = strand_count(system), columns.reshape(strand_count(system), -1, columns.shape[1])
    own = np.stack([np.asarray(way(strand_of(system), jnp.asarray(each))) for each in in_strands(system, y)])
    if way is wide:
        own = np.swapaxes(own, 1, 2)
    found = (own @ moved).reshape(strands, 2, 6, -1)
    return np.swapaxes(found, 0, 1).reshape(12 * strands, -1)


def _freedom(ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an end's admissible poses, and δf of each, from its changes (δx over δf, in columns)."""
    x, f = np.split(ways, 2)
    U, size, V = np.linalg.svd(x)
    rank = int(np.sum(size > HELD * max(1.0, size.max(initial=0.0))))
    return U[:, :rank], f @ V[:rank].T / size[:rank]
