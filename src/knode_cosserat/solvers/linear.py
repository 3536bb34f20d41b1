"""The linear equations of one Newton correction, solved along the rod.

    δy_0 = S δξ,     δy_{j+1} = F_j δy_j + G_j r_j,     M δy_N = -tip

From base to tip every solution is written as δy_j = X_j α_j + w_j. α_j are the values at node j of the fields
that are unknown at the base. For a clamped rod these are force and moment, and X is the compliance of the rod
behind the node. After every few pieces α changes to the values at the node that is reached. Waves that grow
along the rod are thereby kept apart, and rounding errors stay small. This is the Riccati form of the method
of particular solutions (Ascher, Mattheij & Russell 1995, ch. 4).

Strands (`System.strands`) meet at the ends only: F_j has a block for each strand, S and M cover all strands.
A single rod's F has no axis of strands: with an axis of length one a step takes 1.3 times longer.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rotation import small_inverse
from knode_cosserat.solvers.grid import taken

#: pieces between two changes of α
GROUPS = (3, 4, 5)
#: matrices larger than this are inverted in halves
HALVED = 10


class Linearisation(NamedTuple):
    """Derivatives of the residuals: of each piece, of the base and of the tip."""

    F: Float[Any, "pieces *strands b b"]
    #: None for an explicit scheme, where it is the identity
    G: Any
    base: Float[Any, "y k"]
    tip: Float[Any, "k y"]


class Factors(NamedTuple):
    """A linearisation in groups of pieces, factored."""

    #: Fᵀ and Gᵀ
    Ft: Float[Any, "groups each *strands b b"]
    Gt: Any
    #: X after each piece, for the α at its group's start; at a group's end, for the next group's α
    X: Float[Any, "groups each y k"]
    #: α at a group's start is T (α at its end - β), β the values of these fields in w
    T: Float[Any, "groups k k"]
    base: Float[Any, "y k"]
    tip: Float[Any, "k y"]
    inverse: Float[Any, "k k"]


# Sums of products: for one vector the library's products are twice as slow. With Fᵀ the rows of F are
# contiguous, and XLA vectorises over them. For 48 vectors side by side the library's take a
# fifth of the time.


def _product(Ft: Any, X: Any) -> Any:
    """F X."""
    return jnp.sum(Ft[..., :, :, None] * X[..., :, None, :], axis=-3)


def _times(Ft: Any, x: Any) -> Any:
    """F x, of a vector or of many in the columns of x."""
    if x.ndim == Ft.ndim:
        return jnp.swapaxes(Ft, -1, -2) @ x
    return jnp.sum(Ft * x[..., :, None], axis=-2)


def _apply(F: Any, x: Any) -> Any:
    """F x, of a vector or of many in the columns of x."""
    if x.ndim == F.ndim:
        return F @ x
    return jnp.sum(F * x[..., None, :], axis=-1)


def matrix_products(A: Float[Any, "a b n"], B: Float[Any, "b c n"]) -> Float[Any, "a c n"]:
    """Return the products of n pairs of small matrices, which are last.

    For square matrices of 19 rows the library's product takes a quarter of the time of a sum of products.
    """
    return jnp.moveaxis(jnp.moveaxis(A, -1, 0) @ jnp.moveaxis(B, -1, 0), 0, -1)


def inverted(matrices: Float[Any, "b b n"]) -> Float[Any, "b b n"]:
    """Return the inverses of n small matrices, which are last, without pivoting.

    Matrices I - h J of a scheme need no pivoting. Large ones are inverted by blocks, small ones by
    Gauss-Jordan elimination. For 9 and 39 matrices of 16 rows this took a fifth of the time of the library's
    factorisation.
    """
    size = matrices.shape[0]
    if size <= HALVED:
        return _by_turns(matrices)
    k = size // 2
    A, B, C, D = matrices[:k, :k], matrices[:k, k:], matrices[k:, :k], matrices[k:, k:]
    inverse = inverted(A)
    across = matrix_products(inverse, B)
    rest = inverted(D - matrix_products(C, across))
    down = matrix_products(rest, matrix_products(C, inverse))
    upper = jnp.concatenate([inverse + matrix_products(across, down), -matrix_products(across, rest)], axis=1)
    return jnp.concatenate([upper, jnp.concatenate([-down, rest], axis=1)])


def _by_turns(matrices: Float[Any, "b b n"]) -> Float[Any, "b b n"]:
    """Return inverses by Gauss-Jordan elimination. In each turn the first row and column become the last."""
    ones = jnp.ones((1, matrices.shape[-1]))

    def turn(A: Any, _: None) -> tuple[Any, None]:
        column = jnp.concatenate([A[1:, 0], -ones])
        row = jnp.concatenate([A[0, 1:], ones]) / A[0, 0]
        return jnp.pad(A[1:, 1:], ((0, 1), (0, 1), (0, 0))) - column[:, None] * row[None], None

    return jax.lax.scan(turn, matrices, None, length=matrices.shape[0])[0]


# A matrix that differs from the identity in the columns `used` only is given by these columns.


def filled_up(columns: Float[Any, "b used n"], used: np.ndarray) -> Float[Any, "b b n"]:
    """Return full matrices from the columns that differ from the identity's."""
    size, count = columns.shape[0], columns.shape[-1]
    others = np.setdiff1d(np.arange(size), used)
    if not len(others):
        return columns
    rest = jnp.broadcast_to(jnp.eye(size)[:, others, None], (size, len(others), count))
    order = np.argsort(np.concatenate([used, others]))
    return jnp.swapaxes(taken(jnp.swapaxes(jnp.concatenate([columns, rest], axis=1), 0, 1), order), 0, 1)


def quotient(
    A: Float[Any, "b used n"], B: Float[Any, "b used n"], used: np.ndarray
) -> tuple[Float[Any, "b used n"], Float[Any, "b used n"]]:
    """Return B⁻¹ A and B⁻¹ of matrices that differ from the identity in the columns `used` only."""
    size = A.shape[0]
    others = np.setdiff1d(np.arange(size), used)
    order = np.argsort(np.concatenate([used, others]))
    own = inverted(taken(B, used))
    by_others = taken(B, others)
    upper, lower = (
        matrix_products(own, taken(A, used)),
        -matrix_products(by_others, own) if len(others) else by_others,
    )
    both = taken(jnp.concatenate([own, lower]), order)
    if not len(others):
        return upper, both
    lower = matrix_products(lower, taken(A, used)) + taken(A, others)
    return taken(jnp.concatenate([upper, lower]), order), both


def _each(pieces: int) -> int:
    """Return the number of pieces in a group."""
    # a change of α costs about two pieces
    return min(GROUPS, key=lambda each: -(-pieces // each) * (each + 2))


def _in_groups(values: Any, each: int, filling: Any) -> Any:
    """Reshape (pieces, …) to (groups, each, …), padded."""
    missing = -values.shape[0] % each
    filled = jnp.broadcast_to(filling, (missing, *values.shape[1:]))
    values = jnp.concatenate([values, filled]) if missing else values
    return values.reshape(-1, each, *values.shape[1:])


def factored(linearisation: Linearisation, pivots: Any) -> Factors:
    """Return the factors of a linearisation; `pivots` are the fields of y that are unknown at the base."""
    F, G, S, M = jax.lax.optimization_barrier(linearisation)
    each, eye = _each(F.shape[0]), jnp.eye(F.shape[-1])
    Ft = _in_groups(jnp.swapaxes(F, -1, -2), each, eye)
    Gt = None if G is None else _in_groups(jnp.swapaxes(G, -1, -2), each, jnp.zeros_like(eye))
    of_strands = (*F.shape[1:-1], S.shape[1])

    def along(X: Any, Ft: Any) -> Any:
        found = []
        for k in range(each):
            X = _product(Ft[k], X.reshape(of_strands)).reshape(S.shape)
            found.append(X)
        T = small_inverse(X[pivots])
        X = jnp.sum(X[:, :, None] * T[None], axis=1)
        return X, (jnp.stack([*found[:-1], X]), T)

    # α at the base are the unknowns themselves
    last, (X, T) = jax.lax.scan(along, S, Ft)
    at_tip = jnp.sum(M[:, :, None] * last[None], axis=1)
    return Factors(Ft, Gt, X, T, S, M, small_inverse(at_tip))


def solved_correction(
    factors: Factors, pivots: Any, defects: Float[Any, "pieces y ..."],
    tip: Float[Any, "k ..."], base: Any = None,
) -> tuple[Float[Any, "points y ..."], Float[Any, "k ..."]]:  # fmt: skip
    """Return the correction (δy, δξ); `base` is added to δy_0, for a base that moves by itself.

    One correction, or many at once in columns (one more axis, the last).
    """
    Ft, Gt, X, T, S, M, inverse = factors
    each, of_strands, columns = Ft.shape[1], Ft.shape[2:-1], tip.shape[1:]
    r = _in_groups(defects, each, 0.0)
    r = r.reshape(*r.shape[:2], *of_strands, *columns)

    def along(w: Any, group: Any) -> Any:
        Ft, Gt, r, X = group
        # inside the loop: outside, XLA would evaluate the defects again for each use
        r = r if Gt is None else _times(Gt, r)
        found = []
        for k in range(each):
            w = _times(Ft[k], w) + r[k]
            found.append(w)
        β = w.reshape(-1, *columns)[pivots]
        w = w - _apply(X, β).reshape(w.shape)
        return w, (jnp.stack([*found[:-1], w]), β)

    at_base = jnp.zeros((*of_strands, *columns)) if base is None else base.reshape(*of_strands, *columns)
    last, (w, β) = jax.lax.scan(along, at_base, (Ft, Gt, r, X[:, -1]), unroll=2)
    α = -_apply(inverse, tip + _apply(M, last.reshape(-1, *columns)))

    def back(α: Any, group: Any) -> Any:
        T, β = group
        before = _apply(T, α - β)
        return before, (before, α)

    dxi, (before, after) = jax.lax.scan(back, α, (T, β), reverse=True)
    held = jnp.broadcast_to(before[:, None], (X.shape[0], each - 1, *α.shape))
    own = jnp.concatenate([held, after[:, None]], axis=1)
    dy = (w.reshape(*X.shape[:-1], *columns) + _apply(X, own)).reshape(-1, X.shape[2], *columns)
    first = _apply(S, dxi) if base is None else _apply(S, dxi) + base
    return jnp.concatenate([first[None], dy[: defects.shape[0]]]), dxi
