"""Stiffness of the pieces of a rod in equilibrium: each is a finite element in its end poses.

Small changes of pose x and stress f along a rod follow a linear equation. It is Hamiltonian if all loads have
a potential. Over a piece it is integrated by Gauss's scheme, and solved for the stresses at both ends:

    w′ = H w,  w = (x, f)        x⁺ = A x + B f        f⁺ = C x + D f
    -f = B⁻¹A x - B⁻¹x⁺          f⁺ = (C - DB⁻¹A) x + DB⁻¹x⁺

Gauss's scheme preserves the Hamiltonian structure: the stiffness is symmetric, and that of the elastic energy
at Gauss's points. It stays positive for stiff directions, for any slenderness and curvature of a piece. The
derivative of a step of RK4 has an error of order h⁵κ²/EI. In a slender rod this exceeds the flexibility h/EA
of its axis, and changes the sign of its stiffness.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.strands import in_strands, strand_count, strand_of
from knode_cosserat.rods.system import System, unknowns_of
from knode_cosserat.schemes.grid import grid_of, inside
from knode_cosserat.schemes.problem import StepProblem, no_history
from knode_cosserat.schemes.space import Lobatto4
from knode_cosserat.solvers.replay import still_state

#: fields of y that a strand with pose and stress needs
NEEDED = ("p", "h", "n", "m")
#: Gauss's scheme of order 4: places as fractions of a piece (weights 1/2), and coefficients of its stages
_APART = np.sqrt(3.0) / 6.0
PLACES = np.array([0.5 - _APART, 0.5 + _APART])
STAGES = np.array([[0.25, 0.25 - _APART], [0.25 + _APART, 0.25]])
#: intervals over which y is integrated: to each place, and to the end
STEPS = np.array([[0.0, PLACES[0]], [PLACES[0], PLACES[1]], [PLACES[1], 1.0]])
#: largest number of Newton corrections of the equilibrium; each must at most halve the error
CORRECTIONS = 6
#: gap between pieces, in natural units, below which no correction is needed
MET = 1e-11
#: relative cut-off of singular values: nearly neutral changes of an equilibrium are not made
NEUTRAL = 1e-3


class _EndConditions(NamedTuple):
    """Linearised conditions at the two ends, in equilibrium."""

    #: y at the base and at the tip
    y: tuple[np.ndarray, np.ndarray]
    #: admissible changes of y at the base (y, ways)
    base: np.ndarray
    #: derivative of the tip's conditions with respect to y (conditions, y), and their residual
    tip: np.ndarray
    left: np.ndarray


class Pieces(NamedTuple):
    """Stiffness matrices of pieces in sequence along the rod."""

    #: matrices in the poses of both ends, natural units
    stiffness: Float[np.ndarray, "pieces strands 12 12"]
    #: index of the segment of each piece
    segment: np.ndarray
    #: fraction of the rod of each piece
    part: np.ndarray
    #: rates (per length of the rod) of the other fields of y under poses and stresses, natural units
    moved: Float[np.ndarray, " y"]
    ends: _EndConditions


# transformations between y and poses and stresses


def wide(strand: System, y: Any) -> Float[Any, "y 12"]:
    """Return δy of small changes of pose and stress (δp, θ, δn, μ), natural units; θ in the global frame.

    With μ = δm + ½ m × θ they are canonical: H is Hamiltonian also with moments.
    """
    layout, scale = strand.y_layout, strand.scales().y
    p, h, n, m = (layout.slice(name) for name in NEEDED)
    found = jnp.zeros((layout.size, 12))
    found = found.at[p, 0:3].set(jnp.diag(scale[p])).at[h, 3:6].set(_rotation_rates(y[h]))
    found = found.at[n, 6:9].set(jnp.diag(scale[n])).at[m, 9:12].set(jnp.diag(scale[m]))
    return found.at[m, 3:6].set(-0.5 * _hat(y[m]))


def narrow(strand: System, y: Any) -> Float[Any, "12 y"]:
    """Return the inverse of `wide`: pose and stress from δy."""
    layout, scale = strand.y_layout, strand.scales().y
    p, h, n, m = (layout.slice(name) for name in NEEDED)
    turn = 4.0 * _rotation_rates(y[h]).T / jnp.sum(y[h] * y[h])
    found = jnp.zeros((12, layout.size))
    found = found.at[0:3, p].set(jnp.diag(1.0 / scale[p])).at[3:6, h].set(turn)
    found = found.at[6:9, n].set(jnp.diag(1.0 / scale[n])).at[9:12, m].set(jnp.diag(1.0 / scale[m]))
    return found.at[9:12, h].set(0.5 * _hat(y[m]) @ turn / scale[m][:, None])


def _rotation_rates(h: Any) -> Float[Any, "4 3"]:
    """Return ∂h/∂θ of a quaternion under small rotations about the global axes."""
    w, x, y, z = h
    return 0.5 * jnp.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]])


def _hat(v: Any) -> Float[Any, "3 3"]:
    x, y, z = v
    return jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


# integration along the rod


def _integrate_interval(rates: Any, begin: Any, end: Any, y: Any) -> Any:
    """Return y at the end of a short interval, by the classical Runge-Kutta scheme, evaluated inside it."""
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
def _ends(system: System, base: Any, tip: Any, control: Any, history: Any) -> tuple[Any, Any, Any]:
    problem = StepProblem(system, jnp.zeros(()), control, jnp.zeros(()), history, Lobatto4())
    changes = jax.jacfwd(problem.base)(unknowns_of(system, base)), jax.jacfwd(problem.tip_residual)(tip)
    return *changes, problem.tip_residual(tip)


@jax.jit
def _along(
    system: System, y: Any, control: Any, bounds: tuple[Any, Any], acting: Any
) -> tuple[Any, Any, Any, Any]:
    """Return for all pieces: y at the end, the jump at the beginning, H at Gauss's places, other rates."""
    strand = strand_of(system)
    layout, scale = strand.y_layout, strand.scales().y
    rest = jnp.zeros(layout.size * (2 if strand.mixed else 1) + strand.z_layout.size)
    problem = StepProblem(system, jnp.zeros(()), control, jnp.zeros(()), jnp.zeros((0, 0)), Lobatto4())
    kept = np.ones(layout.size)
    kept[layout.indices(NEEDED)] = 0.0

    def rates(s: Any, y: Any) -> Any:
        return problem.point_rates(s, y, rest)[0]

    def piece(y: Any, low: Any, high: Any, acting: Any) -> Any:
        jump = jnp.eye(12)
        if system.discontinuities.jump is not None:
            near, (y, slope) = y, (problem.jump(acting, y, rest), jax.jacfwd(problem.jump, 1))
            jump = narrow(strand, y) @ slope(acting, near, rest) @ wide(strand, near)

        def on(y: Any, step: Any) -> Any:
            begin, end = low + step * (high - low)
            y = _integrate_interval(rates, begin, end, y)
            ways = wide(strand, y)
            y_s, pushed = jax.linearize(lambda y: rates(end, y), y)
            ways_s = jax.vmap(pushed, in_axes=-1, out_axes=-1)(ways)
            _, turning = jax.jvp(lambda y: wide(strand, y), (y,), (y_s,))
            moved = jnp.max(jnp.abs(ways_s), axis=1) * kept / scale
            return y, (narrow(strand, y) @ (ways_s - turning), moved)

        # a loop is compiled once; at the end only y is used
        y, (H, moved) = jax.lax.scan(on, y, STEPS)
        return y, jump, H[:-1], moved[:-1]

    of_strands = jax.vmap(piece, in_axes=(0, None, None, None))
    return jax.vmap(of_strands)(y, *bounds, acting)


def divide(system: System, y: Any, control: Any, by: Sequence[int]) -> Iterator[Pieces]:
    """Yield the pieces, with each interval between nodes and cuts divided by each of the numbers.

    Newton's method first solves the equilibrium of the pieces. The equilibrium of the nodes' scheme differs a
    little. With it a rod that rotates at no cost would seem to gain energy.
    """
    control, history = jnp.asarray(control), no_history(system, Lobatto4())
    points, length = grid_of(system), float(system.length)
    bounds = (points.segment[:, None] + points.bounds) * length / (system.nodes - 1)
    found = np.asarray(still_state(system, Lobatto4(), control, np.asarray(y)).y)

    def ends(y: np.ndarray) -> _EndConditions:
        asked = _ends(system, jnp.asarray(y[0]), jnp.asarray(y[-1]), control, history)
        return _EndConditions((y[0], y[-1]), *map(np.asarray, asked))

    def integrated(y: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return F of the pieces, the gaps of y at the ends of the divided intervals, and other rates."""
        at, F, moved = in_strands(system, jnp.asarray(y[:-1])), [], []
        ds = (bounds[:, 1] - bounds[:, 0]) / count
        for k in range(count):
            low = bounds[:, 0] + k * ds
            acting = points.acting if k == 0 else np.zeros_like(points.acting)
            at, jump, H, also = _along(system, at, control, (low, low + ds), acting)
            F.append(_integrate_pieces(np.asarray(H), ds) @ np.asarray(jump))
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
    """Return the size of gaps in natural units; a quaternion's length is meaningless and ignored."""
    return float(np.max(np.abs(_at_points(system, y, narrow)[1:] @ in_strands(system, off)[..., None])))


def _at_points(system: System, y: np.ndarray, way: Any) -> np.ndarray:
    own = jnp.asarray(in_strands(system, y))
    return np.asarray(jax.vmap(jax.vmap(lambda each: way(strand_of(system), each)))(own))


def _correction(
    system: System, y: np.ndarray, F: np.ndarray, off: np.ndarray, ends: _EndConditions
) -> np.ndarray:
    """Return the change of y at all points that closes the gaps; of several, the smallest."""
    strands, to, back = strand_count(system), _at_points(system, y, narrow), _at_points(system, y, wide)
    gaps = to[1:] @ in_strands(system, off)[..., None]
    ways = to[0] @ ends.base.reshape(strands, -1, ends.base.shape[1])
    # first column: the gaps' effect with no change at the base; others: each admissible change at the base
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


def _integrate_pieces(H: np.ndarray, ds: np.ndarray) -> np.ndarray:
    """Return the map of w from the beginning to the end of each piece, from H at Gauss's places."""
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


# assembly of several pieces


def firm(stiffness: np.ndarray) -> bool:
    """True if each piece is stable with either of its ends held: it then hides no negative eigenvalue."""
    ends = stiffness[..., :6, :6], stiffness[..., 6:, 6:]
    return all(bool(np.all(np.linalg.eigvalsh(symmetric(end)) > 0.0)) for end in ends)


def join_segments(segments: Sequence[np.ndarray]) -> tuple[np.ndarray, int]:
    """Return the stiffness of segments of several pieces in their end poses, and the hidden negative count.

    The inner poses are eliminated; by Haynsworth's theorem the numbers of negative eigenvalues add up.
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
    """Return the symmetric part of each matrix."""
    return (matrices + np.swapaxes(matrices, -1, -2)) / 2.0
