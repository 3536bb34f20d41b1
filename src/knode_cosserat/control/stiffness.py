"""Stiffness of the pieces of a rod in equilibrium: a finite element each, with no other unknowns.

Small changes of pose x and stress f along a rod follow a linear equation, which is Hamilton's where all loads
have a potential. Over a piece it is integrated by Gauss's scheme, and solved for the stresses at both ends:

    w′ = H w,  w = (x, f)        x⁺ = A x + B f        f⁺ = C x + D f
    -f = B⁻¹A x - B⁻¹x⁺          f⁺ = (C - DB⁻¹A) x + DB⁻¹x⁺

Gauss's scheme leaves a Hamiltonian what it is: the stiffness is symmetric, that of the elastic energy at
Gauss's points, and what is stiff remains so, however slender and bent a piece is. The derivative of a step of
RK4 has an error of order h⁵κ²/EI. In a slender rod that is more than the flexibility h/EA of its axis, and
turns the sign of its stiffness.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.system import System, in_strands
from knode_cosserat.solvers.grid import grid_of, inside
from knode_cosserat.solvers.problem import StepProblem, no_history
from knode_cosserat.solvers.space import Lobatto4

#: y of a strand that has a pose and a stress
NEEDED = ("p", "h", "n", "m")
#: Gauss's scheme of order 4: places, as parts of a piece, their weights (1/2 each), and those of its stages
_APART = np.sqrt(3.0) / 6.0
PLACES = np.array([0.5 - _APART, 0.5 + _APART])
STAGES = np.array([[0.25, 0.25 - _APART], [0.25 + _APART, 0.25]])
#: from where to where y is carried: to each of them, and to the end
STEPS = np.array([[0.0, PLACES[0]], [PLACES[0], PLACES[1]], [PLACES[1], 1.0]])
#: Newton's corrections of the equilibrium, while each is at most half the one before
CORRECTIONS = 6
#: in natural units: pieces that are less apart than this need none
MET = 1e-11
#: of the largest: what of an equilibrium costs less than this to change is left as it is
NEUTRAL = 1e-3


class Ends(NamedTuple):
    """The two ends, in equilibrium."""

    #: y at the base and at the tip
    y: tuple[np.ndarray, np.ndarray]
    #: the ways in which y can change at the base (y, ways)
    base: np.ndarray
    #: by what changes of y the tip's conditions change (conditions, y), and what is left of them
    tip: np.ndarray
    left: np.ndarray


class Pieces(NamedTuple):
    """Stiffnesses of pieces, one after the other along the rod."""

    #: by poses at both ends, in natural units
    stiffness: Float[np.ndarray, "pieces strands 12 12"]
    #: in which segment each is
    segment: np.ndarray
    #: what part of the rod each is
    part: np.ndarray
    #: how fast (per length of the rod) what y has beside poses and stresses changes by those, natural units
    moved: Float[np.ndarray, " y"]
    ends: Ends


# poses and stresses, and y


def wide(strand: System, y: Any) -> Float[Any, "y 12"]:
    """δy of small changes of pose and stress (δp, θ, δn, μ), natural units; turns θ in the global frame.

    With μ = δm + ½ m × θ they are canonical: H is Hamiltonian also where there are moments.
    """
    layout, scale = strand.y_layout, strand.scales().y
    p, h, n, m = (layout.slice(name) for name in NEEDED)
    found = jnp.zeros((layout.size, 12))
    found = found.at[p, 0:3].set(jnp.diag(scale[p])).at[h, 3:6].set(_turned(y[h]))
    found = found.at[n, 6:9].set(jnp.diag(scale[n])).at[m, 9:12].set(jnp.diag(scale[m]))
    return found.at[m, 3:6].set(-0.5 * _hat(y[m]))


def narrow(strand: System, y: Any) -> Float[Any, "12 y"]:
    """The way back from δy."""
    layout, scale = strand.y_layout, strand.scales().y
    p, h, n, m = (layout.slice(name) for name in NEEDED)
    turn = 4.0 * _turned(y[h]).T / jnp.sum(y[h] * y[h])
    found = jnp.zeros((12, layout.size))
    found = found.at[0:3, p].set(jnp.diag(1.0 / scale[p])).at[3:6, h].set(turn)
    found = found.at[6:9, n].set(jnp.diag(1.0 / scale[n])).at[9:12, m].set(jnp.diag(1.0 / scale[m]))
    return found.at[9:12, h].set(0.5 * _hat(y[m]) @ turn / scale[m][:, None])


def _turned(h: Any) -> Float[Any, "4 3"]:
    """∂h/∂θ of a quaternion that is turned by small angles about the global axes."""
    w, x, y, z = h
    return 0.5 * jnp.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]])


def _hat(v: Any) -> Float[Any, "3 3"]:
    x, y, z = v
    return jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


# along the rod


def _carried(rates: Any, begin: Any, end: Any, y: Any) -> Any:
    """Return y at the end of a short stretch, by the classical Runge-Kutta scheme, inside it."""
    ds = end - begin

    def stage(reached: tuple[Any, Any], given: tuple[Any, Any]) -> Any:
        total, k = reached
        part, weight = given
        k = rates(inside(begin + part * ds, begin, end), y + part * ds * k)
        return (total + weight * ds * k, k), None

    weights = np.array([1.0, 2.0, 2.0, 1.0]) / 6.0
    (total, _), _ = jax.lax.scan(stage, (y, y), (np.array([0.0, 0.5, 0.5, 1.0]), weights))
    return total


@jax.jit
def _filled(system: System, y: Any, control: Any, history: Any) -> Any:
    """y at the nodes and at the cuts between them."""
    return StepProblem(system, jnp.zeros(()), control, jnp.zeros(()), history, Lobatto4()).filled(y)


@jax.jit
def _ends(system: System, base: Any, tip: Any, control: Any, history: Any) -> tuple[Any, Any, Any]:
    problem = StepProblem(system, jnp.zeros(()), control, jnp.zeros(()), history, Lobatto4())
    changes = jax.jacfwd(problem.base)(system.unknowns(base)), jax.jacfwd(problem.tip_residual)(tip)
    return *changes, problem.tip_residual(tip)


@jax.jit
def _along(
    system: System, y: Any, control: Any, low: Any, high: Any, acting: Any
) -> tuple[Any, Any, Any, Any]:
    """Of all pieces: y at the end, the jump where they begin, H at Gauss's places, and what else moves."""
    strand = system.strand
    layout, scale = strand.y_layout, strand.scales().y
    rest = jnp.zeros(layout.size * (2 if strand.mixed else 1) + strand.z_layout.size)
    problem = StepProblem(system, jnp.zeros(()), control, jnp.zeros(()), jnp.zeros((0, 0)), Lobatto4())
    kept = np.ones(layout.size)
    kept[layout.indices(NEEDED)] = 0.0

    def rates(s: Any, y: Any) -> Any:
        return problem.point_rates(s, y, rest)[0]

    def piece(y: Any, low: Any, high: Any, acting: Any) -> Any:
        jump = jnp.eye(12)
        if system.jumps:
            near, (y, slope) = y, (problem.crossed(acting, y, rest), jax.jacfwd(problem.crossed, 1))
            jump = narrow(strand, y) @ slope(acting, near, rest) @ wide(strand, near)

        def on(y: Any, step: Any) -> Any:
            begin, end = low + step * (high - low)
            y = _carried(rates, begin, end, y)
            ways = wide(strand, y)
            y_s, pushed = jax.linearize(lambda y: rates(end, y), y)
            ways_s = jax.vmap(pushed, in_axes=-1, out_axes=-1)(ways)
            _, turning = jax.jvp(lambda y: wide(strand, y), (y,), (y_s,))
            moved = jnp.max(jnp.abs(ways_s), axis=1) * kept / scale
            return y, (narrow(strand, y) @ (ways_s - turning), moved)

        # a loop, to be compiled once; at the end nothing is asked, but y
        y, (H, moved) = jax.lax.scan(on, y, STEPS)
        return y, jump, H[:-1], moved[:-1]

    of_strands = jax.vmap(piece, in_axes=(0, None, None, None))
    return jax.vmap(of_strands)(y, low, high, acting)


def divided(system: System, y: Any, control: Any, by: Sequence[int]) -> Iterator[Pieces]:
    """The pieces, what lies between nodes and cuts divided by each of the numbers.

    The equilibrium is made that of the pieces first, by Newton's method. By that of the nodes' scheme, a
    little off, a rod that turns for nothing would seem to gain by it.
    """
    control, history = jnp.asarray(control), no_history(system, Lobatto4())
    points, length = grid_of(system), float(system.length)
    bounds = (points.segment[:, None] + points.bounds) * length / (system.nodes - 1)
    found = np.asarray(_filled(system, jnp.asarray(y), control, history))

    def ends(y: np.ndarray) -> Ends:
        asked = _ends(system, jnp.asarray(y[0]), jnp.asarray(y[-1]), control, history)
        return Ends((y[0], y[-1]), *map(np.asarray, asked))

    def integrated(y: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """F of the pieces, how y at the ends of what was divided is off, and what else moves."""
        at, F, moved = in_strands(system, jnp.asarray(y[:-1])), [], []
        ds = (bounds[:, 1] - bounds[:, 0]) / count
        for k in range(count):
            low = bounds[:, 0] + k * ds
            acting = points.acting if k == 0 else np.zeros_like(points.acting)
            at, jump, H, also = _along(system, at, control, low, low + ds, acting)
            F.append(_integrated(np.asarray(H), ds) @ np.asarray(jump))
            moved.append(np.asarray(also).max(axis=(0, 1, 2)))
        return np.stack(F, axis=1), np.asarray(at).reshape(y[1:].shape) - y[1:], np.max(moved, axis=0)

    for count in by:
        F, off, moved = integrated(found, count)
        for _ in range(CORRECTIONS):
            if _size(system, found, off) < MET:
                break
            trial = found + _correction(system, found, F, off, ends(found))
            others = integrated(trial, count)
            if not _size(system, trial, others[1]) < _size(system, found, off) / 2.0:
                break
            found, (F, off, moved) = trial, others
        part = np.repeat((bounds[:, 1] - bounds[:, 0]) / count / length, count)
        stiffness = _stiffness(F).reshape(-1, *F.shape[2:])
        yield Pieces(stiffness, np.repeat(points.segment, count), part, length * moved, ends(found))


def _size(system: System, y: np.ndarray, off: np.ndarray) -> float:
    """In natural units; a quaternion's length, which means nothing, is not looked at."""
    return float(np.max(np.abs(_at_points(system, y, narrow)[1:] @ in_strands(system, off)[..., None])))


def _at_points(system: System, y: np.ndarray, way: Any) -> np.ndarray:
    own = jnp.asarray(in_strands(system, y))
    return np.asarray(jax.vmap(jax.vmap(lambda each: way(system.strand, each)))(own))


def _correction(system: System, y: np.ndarray, F: np.ndarray, off: np.ndarray, ends: Ends) -> np.ndarray:
    """By what y at all points has to change; the least of what would do."""
    strands, to, back = system.strands, _at_points(system, y, narrow), _at_points(system, y, wide)
    gaps = to[1:] @ in_strands(system, off)[..., None]
    ways = to[0] @ ends.base.reshape(strands, -1, ends.base.shape[1])
    # what the gaps make of no change at the base, then what each way to change there makes
    reached = [np.concatenate([np.zeros_like(ways[..., :1]), ways], axis=-1)]
    for pieces, gap in zip(F, gaps, strict=True):
        state = reached[-1]
        for each in pieces:
            state = each @ state
        reached.append(np.concatenate([state[..., :1] + gap, state[..., 1:]], axis=-1))
    size = np.asarray(system.scales().tip)[:, None]
    tip = ends.tip.reshape(len(ends.tip), strands, -1) / size[..., None]
    asked = np.einsum("ksy,syi,sic->kc", tip, back[-1], reached[-1])
    change = np.linalg.lstsq(asked[:, 1:], -ends.left / size[:, 0] - asked[:, 0], rcond=NEUTRAL)[0]
    moved = back @ (np.stack(reached) @ np.append(1.0, change))[..., None]
    return np.asarray(moved.reshape(y.shape))


def _integrated(H: np.ndarray, ds: np.ndarray) -> np.ndarray:
    """w at the ends of pieces by that where they begin, from H at Gauss's places."""
    lead, size = H.shape[:2], len(PLACES) * 12
    H = H * ds[:, None, None, None, None]
    among = np.einsum("ij,...jkl->...ikjl", STAGES, H).reshape(*lead, size, size)
    begin = np.broadcast_to(np.tile(np.eye(12), (len(PLACES), 1)), (*lead, size, 12))
    stages = np.linalg.solve(np.eye(size) - among, begin).reshape(*lead, len(PLACES), 12, 12)
    return np.asarray(np.eye(12) + 0.5 * np.sum(H @ stages, axis=2))


def _stiffness(F: np.ndarray) -> np.ndarray:
    A, B, C, D = F[..., :6, :6], F[..., :6, 6:], F[..., 6:, :6], F[..., 6:, 6:]
    inverse = np.linalg.inv(B)
    return np.block([[inverse @ A, -inverse], [C - D @ inverse @ A, D @ inverse]])


# several pieces


def firm(stiffness: np.ndarray) -> bool:
    """Whether each piece would stay as it is, held at one of its ends, whichever: then it hides nothing."""
    ends = stiffness[..., :6, :6], stiffness[..., 6:, 6:]
    return all(bool(np.all(np.linalg.eigvalsh(symmetric(end)) > 0.0)) for end in ends)


def joined(segments: Sequence[np.ndarray]) -> tuple[np.ndarray, int]:
    """The stiffness of segments, made of pieces, by their ends, and how many negative directions that hides.

    What lies between is eliminated; by Haynsworth's theorem the negative eigenvalues add up.
    """
    found, hidden = [], 0
    for pieces in segments:
        whole = pieces[0]
        for piece in pieces[1:]:
            between = whole[:, 6:, 6:] + piece[:, :6, :6]
            hidden += int(np.sum(np.linalg.eigvalsh(symmetric(between)) <= 0.0))
            rows = np.concatenate([whole[:, 6:, :6], piece[:, :6, 6:]], axis=2)
            columns = np.concatenate([whole[:, :6, 6:], piece[:, 6:, :6]], axis=1)
            apart = np.zeros_like(whole)
            apart[:, :6, :6], apart[:, 6:, 6:] = whole[:, :6, :6], piece[:, 6:, 6:]
            whole = apart - columns @ np.linalg.solve(between, rows)
        found.append(whole)
    return np.stack(found), hidden


def symmetric(matrices: np.ndarray) -> np.ndarray:
    """The symmetric part of each."""
    return (matrices + np.swapaxes(matrices, -1, -2)) / 2.0
