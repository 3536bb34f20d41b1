"""Whether an equilibrium is stable: the second variation of its energy, by the segments' stiffness.

The derivative F of a segment tells how pose x = (p, θ) and stress f = (n, m) at its end follow from those at
its start. Solved for the stresses it is the segment's stiffness, that of a finite element with exact shapes:

    x⁺ = A x + B f        f⁺ = C x + D f        -f = B⁻¹A x - B⁻¹x⁺        f⁺ = (C - DB⁻¹A) x + DB⁻¹x⁺

Summed up over the segments, and with what the two ends allow and ask, that is the second variation of the
energy. An equilibrium is stable if it has no negative eigenvalue. Coarse segments can hide one only where a
segment buckles between its own two nodes.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.system import System, in_strands
from knode_cosserat.solvers.boundary import linearise, static_error
from knode_cosserat.solvers.crossing import points_of
from knode_cosserat.solvers.equilibrium import equilibrium as rests
from knode_cosserat.solvers.problem import StepProblem
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.space import RK4
from knode_cosserat.trajectory import Trajectory

#: in natural units: what is further than this from balance is no equilibrium
BALANCED = 1e-6
#: of the largest singular value: what counts as held
HELD = 1e-9
#: y of a strand that has a pose and a stress; whatever more there is must rest when these move
NEEDED = ("p", "h", "n", "m")
#: in natural units: what moves less than this by them rests
RESTING = 1e-9
#: roots of the equations that are found from a root nearby
NEARBY = (Result.CONVERGED, Result.RECOVERED_STABLE_ELIMINATION, Result.RECOVERED_LOAD_CONTINUATION)


class Stability(NamedTuple):
    """The second variation of an equilibrium's energy."""

    #: how many ways there are to leave it: negative eigenvalues, none of a stable one
    unstable_directions: int
    #: the least eigenvalue, in natural units (EI/L): zero where the robot is about to buckle or snap
    least: float
    #: (nodes, 3): how the line would move in the direction of the least, its largest displacement 1; of
    #: several rods (nodes, rods, 3)
    mode: np.ndarray
    #: how far the stiffness is from symmetric, as a part of its largest entry: what has a potential is
    #: symmetric but for the error of the scheme; follower loads are not
    asymmetry: float

    @property
    def stable(self) -> bool:
        """Whether there is none."""
        return self.unstable_directions == 0


def stability(equilibrium: Trajectory, row: int = -1) -> Stability:
    """Whether a robot that rests stays where it is when it is pushed a little.

    For whatever holds its ends: it finds what buckles between clamps, an arch that is about to snap, a column
    that would fall. The robot is looked at as by RK4 along the rod, whatever it was solved by, since Euler's
    scheme has no potential. Loads that follow the rod have none either: of those it sees what
    gives way, and not what flutters. Friction, which only helps, is not counted.

    Args:
        equilibrium: of one robot: what `kc.equilibrium` gives, or a trajectory that has come to rest.
        row: which row of it.

    Raises:
        ValueError: no equilibrium, a system that is not rods with positions and orientations, or one with
            more in y that moves with them (tendons on reels have an energy of their own).
    """
    system, y, z, control = _checked(equilibrium, row)
    space = equilibrium.settings.space
    if not isinstance(space, RK4):
        one = Trajectory(
            system=system, settings=equilibrium.settings, time=np.zeros(1), y=y[None], z=z[None],
            control=control[None], result=np.zeros(1, int), residual=np.zeros(1), iterations=np.zeros(1, int),
        )  # fmt: skip
        found = rests(system, control, space="rk4", initial=one, on_failure="return")
        if found.result[0] in NEARBY:
            y = np.asarray(found.y[0])
    F, base, tip = _linearised(system, jnp.asarray(y), jnp.asarray(control), z.shape[-1])
    _require_rest(system, F, base)
    return _of_stiffness(*_stiffness(system, y, F, base, tip), system)


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


@jax.jit
def _find(system: System, y: Any, control: Any, history: Any) -> tuple[Any, Any, Any]:
    problem = StepProblem(system, jnp.zeros(()), control, jnp.zeros(()), history, RK4())
    found = linearise(problem, problem.filled(y), system.unknowns(y[0]))
    return found.F, found.base, found.tip


def _linearised(system: System, y: Any, control: Any, nz: int) -> tuple[Any, Any, Any]:
    """F of the segments (segments, strands, b, b), and what base and tip ask."""
    ny = y.shape[1]
    F, base, tip = _find(system, y, control, jnp.zeros((len(y), ny + nz + (ny if system.mixed else 0))))
    pieces = np.asarray(F).reshape(-1, system.strands, *F.shape[-2:])
    between = itertools.pairwise(points_of(system).nodes)
    segments = [functools.reduce(lambda before, after: after @ before, pieces[j:k]) for j, k in between]
    return np.stack(segments), np.asarray(base), np.asarray(tip)


def _require_rest(system: System, F: np.ndarray, base: np.ndarray) -> None:
    """That what y has beside poses and stresses, such as velocities, rests whatever those do."""
    layout, scale = system.strand.y_layout, np.asarray(system.strand.scales().y)
    F = F * scale / scale[:, None]
    base = base.reshape(system.strands, layout.size, -1)
    named = layout.indices(NEEDED)
    for field in layout.fields:
        if field.name in NEEDED:
            continue
        own = layout.indices((field.name,))
        moved = np.abs(F[..., own, :][..., named]).max(), np.abs(base[:, own]).max()
        if max(moved) > RESTING:
            raise ValueError(
                f"a {type(system).__name__} has {field.name} ({field.meaning}) in y, which has an energy of "
                "its own; allowed are rods whose equilibria are of p, h, n and m alone"
            )


class _Poses:
    """Small changes of pose and stress at one node, in natural units, and of y: a strand after the other.

    δy = `wide` (δx, δf) with all δx first, turns in the global frame; `narrow` is the way back.
    """

    def __init__(self, system: System, y: np.ndarray):
        layout, scale = system.strand.y_layout, np.asarray(system.strand.scales().y)
        p, h, n, m = (layout.slice(name) for name in ("p", "h", "n", "m"))
        count, size = system.strands, layout.size
        self.wide, self.narrow = np.zeros((count * size, 12 * count)), np.zeros((12 * count, count * size))
        for k, own in enumerate(np.asarray(in_strands(system, y))):
            at, x, f = k * size, 6 * k, 6 * (count + k)
            for first, rows in ((x, p), (f, n), (f + 3, m)):
                places = np.arange(3)
                self.wide[at + rows.start + places, first + places] = scale[rows]
                self.narrow[first + places, at + rows.start + places] = 1.0 / scale[rows]
            turn = _turned(own[h])
            self.wide[at + h.start : at + h.stop, x + 3 : x + 6] = turn
            self.narrow[x + 3 : x + 6, at + h.start : at + h.stop] = 4.0 * turn.T / (own[h] @ own[h])


def _turned(h: np.ndarray) -> np.ndarray:
    """∂h/∂θ (4, 3) of a quaternion that is turned by small angles about the global axes."""
    w, x, y, z = h
    return 0.5 * np.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]])


def _stiffness(
    system: System, y: np.ndarray, F: np.ndarray, base: np.ndarray, tip: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The second variation in what is free to move, and all nodes' poses by that (6 nodes strands, free)."""
    count = 6 * system.strands
    poses = [_Poses(system, row) for row in y]
    K = np.zeros((count * len(y), count * len(y)))
    for j, F_j in enumerate(F):
        whole = np.zeros((F_j.shape[0] * F_j.shape[1],) * 2)
        for k, own in enumerate(F_j):
            spot = slice(k * len(own), (k + 1) * len(own))
            whole[spot, spot] = own
        G = poses[j + 1].narrow @ whole @ poses[j].wide
        A, B, C, D = G[:count, :count], G[:count, count:], G[count:, :count], G[count:, count:]
        inverse = np.linalg.inv(B)
        spot = slice(count * j, count * (j + 2))
        K[spot, spot] += np.block([[inverse @ A, -inverse], [C - D @ inverse @ A, D @ inverse]])
    first, pulled_first = _freedom(poses[0].narrow @ base)
    # what the tip's conditions leave free: as many ways as they have numbers
    last, pulled_last = _freedom(np.linalg.svd(tip @ poses[-1].wide)[2][tip.shape[0] :].T)
    a, b = first.shape[1], last.shape[1]
    free = np.zeros((len(K), a + count * (len(y) - 2) + b))
    free[:count, :a], free[-count:, free.shape[1] - b :] = first, last
    free[count:-count, a : free.shape[1] - b] = np.eye(count * (len(y) - 2))
    found = free.T @ K @ free
    found[:a, :a] += first.T @ pulled_first
    found[found.shape[0] - b :, found.shape[0] - b :] -= last.T @ pulled_last
    return found, free


def _freedom(ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the ways (δx over δf, in columns) in which an end can change: poses it can take, and δf of each."""
    x, f = np.split(ways, 2)
    U, size, V = np.linalg.svd(x)
    rank = int(np.sum(size > HELD * max(1.0, size.max(initial=0.0))))
    return U[:, :rank], f @ V[:rank].T / size[:rank]


def _of_stiffness(K: np.ndarray, free: np.ndarray, system: System) -> Stability:
    """By what part of the rod a node stands for, so that eigenvalues do not depend on the nodes."""
    part = np.full(system.nodes, 1.0 / (system.nodes - 1))
    part[[0, -1]] /= 2.0
    root = 1.0 / np.sqrt(np.sum(free**2 * np.repeat(part, 6 * system.strands)[:, None], axis=0))
    scaled = root[:, None] * (K + K.T) / 2.0 * root
    values, vectors = np.linalg.eigh(scaled)
    moves = (free @ (root * vectors[:, 0])).reshape(system.nodes, system.strands, 6)[..., :3]
    # what only twists does not move the line
    moves = moves / max(float(np.max(np.linalg.norm(moves, axis=-1))), np.finfo(float).tiny)
    asymmetry = float(np.max(np.abs(K - K.T)) / np.max(np.abs(K)))
    # rounding of the stiffest, which pulls, may turn the sign of a soft one
    rounding = 1e-12 * float(np.max(np.abs(values)))
    count = int(np.sum(values < -rounding))
    return Stability(count, float(values[0]), moves[:, 0] if system.strands == 1 else moves, asymmetry)
