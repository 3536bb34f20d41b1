"""The linear equations of one Newton correction: a recursion along the rod with conditions at both ends.

    δy_0 = S δξ,     δy_{j+1} = F_j δy_j + r_j,     M δy_N = -tip

Two ways to solve them share one interface. `Condensed` carries the recursion from base to tip and solves for
δξ there: the fastest, but what grows along the rod (small time steps, soft and long rods) multiplies rounding
errors. `Decoupled` first carries the tip's conditions down to the base, orthonormalised at every node, and
projects on them on the way up: growth does no harm, at several times the cost. Every eighth node or so is
enough where segments are short: what lies between is condensed, side by side. Measured: docs/solver.md.

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
    """Fᵀ, the response X_j = ∂y_j/∂ξ at every node, the tip's matrix, and the inverse of ∂tip/∂ξ."""

    Ft: Float[Any, "segments *strands b b"]
    X: Float[Any, "nodes y k"]
    tip: Float[Any, "k y"]
    inverse: Float[Any, "k k"]


# As sums of products: for sizes this small the library's products are twice as slow. From Fᵀ XLA vectorises
# over the rows of F, which are neighbours then.


def _product(Ft: Any, X: Any) -> Any:
    """F X."""
    return jnp.sum(Ft[..., :, :, None] * X[..., :, None, :], axis=-3)


def _times(Ft: Any, x: Any) -> Any:
    """F x."""
    return jnp.sum(Ft * x[..., :, None], axis=-2)


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
        k, of_strands = S.shape[1], F.shape[1:-1]
        Ft = jnp.swapaxes(F, -1, -2)

        def along(X: Any, step: Any) -> Any:
            Ft_j, r_j = step
            X = _product(Ft_j, X).at[..., k].add(r_j)
            return X, X

        first = jnp.concatenate([S, jnp.zeros((S.shape[0], 1))], axis=1).reshape(*of_strands, k + 1)
        _, X = jax.lax.scan(along, first, (Ft, defects.reshape(-1, *of_strands)))
        X = jnp.concatenate([first[None], X]).reshape(-1, S.shape[0], k + 1)
        at_tip = _product(M.T, X[-1])
        factors = CondensedFactors(Ft, X[..., :k], M, jnp.linalg.inv(at_tip[:, :k]))
        return factors, *self._combine(factors, X[..., k], at_tip[:, k] + tip)

    @staticmethod
    def _combine(factors: CondensedFactors, w: Any, tip: Any) -> tuple[Any, Any]:
        dxi = -_apply(factors.inverse, tip)
        return w + jnp.sum(factors.X * dxi, axis=-1), dxi

    def solve(self, factors, defects, tip):  # type: ignore[no-untyped-def]
        """The recursion for the residuals alone, then δξ from the tip."""
        of_strands = factors.Ft.shape[1:-1]

        def along(w: Any, step: Any) -> Any:
            Ft, r = step
            w = _times(Ft, w) + r
            return w, w

        r = defects.reshape(-1, *of_strands)
        last, w = jax.lax.scan(along, jnp.zeros(of_strands), (factors.Ft, r))
        w = jnp.concatenate([jnp.zeros((1, defects.shape[1])), w.reshape(defects.shape)])
        return self._combine(factors, w, _apply(factors.tip, last.reshape(-1)) + tip)


class Groups(NamedTuple):
    """Segments in groups of as many each, filled up with ones that change nothing; in natural units."""

    F: Float[Any, "each groups *strands b b"]
    #: from a group's start to each of its segments' ends
    X: Float[Any, "each groups *strands b b"]


class DecoupledFactors(NamedTuple):
    """Where a group ends: orthonormal conditions Q, inverse factors N. In natural units."""

    groups: Groups
    Q: Float[Any, "groups k y"]
    N: Float[Any, "groups+1 k k"]
    base: Float[Any, "y k"]
    inverse: Float[Any, "k k"]
    y_scale: Float[Any, " y"]


@dataclasses.dataclass(frozen=True)
class Decoupled(LinearSolver):
    """From tip to base and back, stable whatever grows along the rod.

    `every` so many segments are condensed to one first, all such groups side by side, and the conditions are
    orthonormalised at their ends only. What grows within a group costs digits; the recursion is shorter.
    """

    every: int = 1

    def __post_init__(self) -> None:
        if self.every < 1:
            raise ValueError(f"every is {self.every!r}; allowed is a number of segments, 1 or more")

    def start(self, linearisation, y_scale):  # type: ignore[no-untyped-def]
        """Condense the groups, and carry the tip's conditions down to the base."""
        of_strand = y_scale.reshape(linearisation.F.shape[1:-1])
        groups = self._groups(linearisation.F * of_strand[..., None, :] / of_strand[..., :, None])
        # the conditions see all strands; a group's matrix has a block for each
        blocks = groups.X[-1].shape[1:-1]

        def normalised(conditions: Any) -> Any:
            Q, R = jnp.linalg.qr(conditions.T)
            one = jnp.eye(R.shape[0])
            return Q.T, jax.scipy.linalg.solve_triangular(R.T, one, lower=True)

        def down(Q: Any, A: Any) -> Any:
            across = jnp.sum(Q.reshape(-1, *blocks)[..., :, None] * A, axis=-2).reshape(Q.shape)
            Q, N = normalised(across)
            return Q, (Q, N)

        Q_tip, N_tip = normalised(linearisation.tip * y_scale)
        Q_base, (Q, N) = jax.lax.scan(down, Q_tip, groups.X[-1], reverse=True)
        Q, N = jnp.concatenate([Q[1:], Q_tip[None]]), jnp.concatenate([N, N_tip[None]])
        base = linearisation.base / y_scale[:, None]
        factors = DecoupledFactors(groups, Q, N, base, jnp.linalg.inv(Q_base @ base), y_scale)
        return factors, *self.solve(factors, linearisation.defects, linearisation.tip_residual)

    def solve(self, factors, defects, tip):  # type: ignore[no-untyped-def]
        """Conditions Q δy = c from the tip down, then δy from the base up, projected on them."""
        (F, X), Q, N, base, inverse, y_scale = factors
        r = self._in_groups(defects / y_scale, 0.0).reshape(F.shape[:-1])

        def within(w: Any, segment: Any) -> Any:
            F_i, r_i = segment
            w = _apply(F_i, w) + r_i
            return w, w

        _, w = _scan(within, jnp.zeros(r.shape[1:]), (F, r))
        d = w[-1].reshape(Q.shape[0], -1)

        def down(c: Any, group: Any) -> Any:
            N_g, Q_g, d_g = group
            return _apply(N_g, c - _apply(Q_g, d_g)), c

        c_base, c = jax.lax.scan(down, _apply(N[-1], -tip), (N[:-1], Q, d), reverse=True)
        dxi = inverse @ c_base

        def up(dy: Any, group: Any) -> Any:
            A_g, d_g, Q_g, c_g = group
            after = carried(A_g, dy) + d_g
            return after + jnp.sum((c_g - _apply(Q_g, after))[:, None] * Q_g, axis=0), dy

        first = base @ dxi
        _, begins = jax.lax.scan(up, first, (X[-1], d, Q, c))
        dy = _apply(X, begins.reshape(r.shape[1:])) + w
        dy = jnp.swapaxes(dy, 0, 1).reshape(-1, defects.shape[1])[: defects.shape[0]]
        return jnp.concatenate([first[None], dy]) * y_scale, dxi

    def _groups(self, F: Any) -> Groups:
        """The segments' matrices in groups, and their products from each group's start."""
        F = self._in_groups(F, jnp.eye(F.shape[-1]))

        def within(X: Any, F_i: Any) -> Any:
            # as a sum of outer products: of many matrices at once a quarter of a summed product's time
            X = sum(F_i[..., :, j, None] * X[..., j, None, :] for j in range(F_i.shape[-1]))
            return X, X

        _, X = _scan(within, F[0], F[1:])
        return Groups(F, jnp.concatenate([F[:1], X]))

    def _in_groups(self, values: Any, filling: Any) -> Any:
        """(segments, …) as (each, groups, …)."""
        left = -values.shape[0] % self.every
        filled = jnp.broadcast_to(filling, (left, *values.shape[1:]))
        values = jnp.concatenate([values, filled]) if left else values
        return jnp.swapaxes(values.reshape(-1, self.every, *values.shape[1:]), 0, 1)


#: by their names; where a scheme carries a segment safely nothing grows beyond e in it: eight cost few digits
ELIMINATIONS: dict[str, LinearSolver] = {"condensed": Condensed(), "decoupled": Decoupled(every=8)}


def _scan(along: Any, first: Any, rest: Any) -> Any:
    """`lax.scan`, without a loop where there is but one turn or none."""
    length = jax.tree.leaves(rest)[0].shape[0]
    return jax.lax.scan(along, first, rest, unroll=max(1, length) if length < 2 else 1)
