"""The linear equations of one Newton correction: a recursion along the rod with conditions at both ends.

    δy_0 = S δξ,     δy_{j+1} = F_j δy_j + r_j,     M δy_N = -tip

Two ways to solve them share one interface. `Condensed` carries the recursion from base to tip and solves for
δξ there: the fastest, but what grows along the rod (small time steps, soft and long rods) multiplies rounding
errors. `Decoupled` first carries the tip's conditions down to the base, orthonormalised at every node, and
projects on them on the way up: growth does no harm, at several times the cost. Measured: docs/solver.md.

Strands (`System.strands`) meet at the ends only: F_j has a block for each, S and M are of all of them.
A single rod's F has no axis of strands: with one of length one a step takes 1.3 times as long.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float


class Linearisation(NamedTuple):
    """Residuals at a point and their exact derivatives: of each segment, of the base and of the tip."""

    F: Float[Any, "segments *strands b b"]
    base: Float[Any, "y k"]
    tip: Float[Any, "k y"]
    defects: Float[Any, "segments y"]
    tip_residual: Float[Any, " k"]


@dataclasses.dataclass(frozen=True)
class LinearSolver(abc.ABC):
    """Factor once, solve for several residuals."""

    @abc.abstractmethod
    def start(
        self, linearisation: Linearisation, y_scale: Float[Any, " y"]
    ) -> tuple[Any, Float[Any, "nodes y"], Float[Any, " k"]]:
        """The factors, and with them the first correction (δy, δξ)."""

    @abc.abstractmethod
    def solve(
        self, factors: Any, defects: Float[Any, "segments y"], tip: Float[Any, " k"]
    ) -> tuple[Float[Any, "nodes y"], Float[Any, " k"]]:
        """The correction (δy, δξ)."""


class CondensedFactors(NamedTuple):
    """F, the response X_j = ∂y_j/∂ξ at every node, the tip's matrix, and the inverse of ∂tip/∂ξ."""

    F: Float[Any, "segments *strands b b"]
    X: Float[Any, "k nodes y"]
    tip: Float[Any, "k y"]
    inverse: Float[Any, "k k"]


def _product(F: Any, X: Any) -> Any:
    """F @ X as a fused multiply and sum: for sizes this small the library's product is twice as slow."""
    return jnp.sum(F[..., :, :, None] * X[..., None, :, :], axis=-2)


def _apply(F: Any, x: Any) -> Any:
    return jnp.sum(F * x[..., None, :], axis=-1)


def carried(F: Float[Any, "*strands b b"], dy: Float[Any, " y"]) -> Float[Any, " y"]:
    """δy at a segment's end from δy at its start."""
    return _apply(F, dy.reshape(F.shape[:-1])).reshape(-1)


@dataclasses.dataclass(frozen=True)
class Condensed(LinearSolver):
    """From base to tip in one pass."""

    def start(self, linearisation, y_scale):  # type: ignore[no-untyped-def]
        """The response of every node to ξ and, in the same pass, to the residuals."""
        F, S, M, defects, tip = linearisation
        k = S.shape[1]

        def along(X: Any, step: Any) -> Any:
            F_j, r_j = step
            X = _product(F_j, X).at[..., k].add(r_j)
            return X, X

        first = jnp.concatenate([S, jnp.zeros((S.shape[0], 1))], axis=1).reshape(*F.shape[1:-1], k + 1)
        last, X = jax.lax.scan(along, first, (F, defects.reshape(F.shape[:-1])))
        X = jnp.concatenate([first[None], X]).reshape(-1, S.shape[0], k + 1)
        X = jnp.transpose(X, (2, 0, 1))
        at_tip = _product(M, last.reshape(S.shape[0], k + 1))
        factors = CondensedFactors(F, X[:k], M, jnp.linalg.inv(at_tip[:, :k]))
        return factors, *self._combine(factors, X[k], at_tip[:, k] + tip)

    @staticmethod
    def _combine(factors: CondensedFactors, w: Any, tip: Any) -> tuple[Any, Any]:
        dxi = -_apply(factors.inverse, tip)
        return w + jnp.sum(factors.X * dxi[:, None, None], axis=0), dxi

    def solve(self, factors, defects, tip):  # type: ignore[no-untyped-def]
        """The recursion for the residuals alone, then δξ from the tip."""

        def along(w: Any, step: Any) -> Any:
            F, r = step
            w = carried(F, w) + r
            return w, w

        last, w = jax.lax.scan(along, jnp.zeros(defects.shape[1]), (factors.F, defects))
        w = jnp.concatenate([jnp.zeros((1, defects.shape[1])), w])
        return self._combine(factors, w, _apply(factors.tip, last) + tip)


class DecoupledFactors(NamedTuple):
    """Per node the orthonormal conditions Q and the triangular factors L; all in natural units."""

    F: Float[Any, "segments *strands b b"]
    Q: Float[Any, "nodes k y"]
    L: Float[Any, "nodes k k"]
    base: Float[Any, "y k"]
    inverse: Float[Any, "k k"]
    y_scale: Float[Any, " y"]


@dataclasses.dataclass(frozen=True)
class Decoupled(LinearSolver):
    """From tip to base and back, stable whatever grows along the rod."""

    def start(self, linearisation, y_scale):  # type: ignore[no-untyped-def]
        """Carry the tip's conditions down to the base."""
        of_strand = y_scale.reshape(linearisation.F.shape[1:-1])
        F = linearisation.F * of_strand[..., None, :] / of_strand[..., :, None]

        def normalised(conditions: Any) -> Any:
            Q, R = jnp.linalg.qr(conditions.T)
            return Q.T, R.T

        Q_tip, L_tip = normalised(linearisation.tip * y_scale)

        def down(Q: Any, F: Any) -> Any:
            across = jnp.einsum("k...b,...bc->k...c", Q.reshape(-1, *F.shape[:-1]), F)
            Q, L = normalised(across.reshape(Q.shape))
            return Q, (Q, L)

        _, (Q, L) = jax.lax.scan(down, Q_tip, F, reverse=True)
        Q, L = jnp.concatenate([Q, Q_tip[None]]), jnp.concatenate([L, L_tip[None]])
        base = linearisation.base / y_scale[:, None]
        factors = DecoupledFactors(F, Q, L, base, jnp.linalg.inv(Q[0] @ base), y_scale)
        return factors, *self.solve(factors, linearisation.defects, linearisation.tip_residual)

    def solve(self, factors, defects, tip):  # type: ignore[no-untyped-def]
        """Conditions Q_j δy_j = c_j from the tip down, then δy from the base up, projected on them."""
        F, Q, L, base, inverse, y_scale = factors
        r = defects / y_scale

        def triangular(L: Any, right: Any) -> Any:
            return jax.scipy.linalg.solve_triangular(L, right, lower=True)

        c_tip = triangular(L[-1], -tip)

        def down(c: Any, node: Any) -> Any:
            Q_next, L_j, r_j = node
            c = triangular(L_j, c - Q_next @ r_j)
            return c, c

        _, c = jax.lax.scan(down, c_tip, (Q[1:], L[:-1], r), reverse=True)
        dxi = inverse @ c[0]

        def up(dy: Any, node: Any) -> Any:
            F_j, r_j, Q_next, c_next = node
            dy = carried(F_j, dy) + r_j
            dy = dy + (c_next - Q_next @ dy) @ Q_next
            return dy, dy

        first = base @ dxi
        c_next = jnp.concatenate([c[1:], c_tip[None]])
        _, dy = jax.lax.scan(up, first, (F, r, Q[1:], c_next))
        return jnp.concatenate([first[None], dy]) * y_scale, dxi
