"""The material's law of a rod together with its tendons: v and u if n and m include both.

Chambers are tendons that push: their tension is negative. At one point of the rod, in the material frame,
with tendon i at rᵢ(s) = (x, y, 0) under the tension Tᵢ,

    K_v v + Σ Tᵢ tᵢ = a,     K_u u + Σ Tᵢ rᵢ × tᵢ = b,     tᵢ = ṗᵢ/|ṗᵢ|,     ṗᵢ = v + u × rᵢ + rᵢ′

where K_v and K_u are stiffnesses, and a and b come from n and m (Rucker & Webster 2011, in the form that
keeps the paper's y and z). For K positive definite and Tᵢ ≥ 0 there is exactly one solution: the
minimum of the strictly convex energy ½ vᵀK_v v + ½ uᵀK_u u + Σ Tᵢ |ṗᵢ| - aᵀv - bᵀu. Its second derivative is

    J = diag(K_v, K_u) + Σ Tᵢ/|ṗᵢ| (WᵢᵀWᵢ - gᵢgᵢᵀ),     Wᵢ = [I, -r̂ᵢ],     gᵢ = Wᵢᵀtᵢ = (tᵢ, rᵢ × tᵢ)

A tension may depend on the stretch λᵢ = |ṗᵢ|: the energy then has ∫Tᵢ dλᵢ, and J the term Tᵢ′ gᵢgᵢᵀ.

Tendons rotate little relative to the rod, so J is nearly constant. Three or four corrections with J of the
unbent rod and tendons, `unbent_flexibility`, usually solve the law. This J does not change during the
solvers' iterations, and is evaluated once for a step (`engine`). If this converges slowly
because tendons rotate far, a damped Newton's method continues from the last iterate. Errors are measured by
the relative change of ṗᵢ in a correction.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float

from knode_cosserat.rods.law import Elastic, Fields
from knode_cosserat.rotation import dot, dot_by_rows, inverse, small_inverse

#: largest number of Newton corrections
ROUNDS = 50
#: largest ratio of successive corrections with a constant J
LESS = 0.1
#: rotation of a tendon below which a correction is not damped
SMALL = 0.05
#: tolerance of a tendon's tangent
MISSING = 1e-14
#: v and u of an unbent rod
UNBENT = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


class TendonLaw(NamedTuple):
    """The law in the module's docstring at one point of a rod."""

    #: stiffness of shear and extension (N), symmetric and positive definite
    K_v: Float[Any, "3 3"]
    #: stiffness of bending and twisting (N·m²), likewise
    K_u: Float[Any, "3 3"]
    #: a (N) and b (N·m)
    load: Float[Any, "6"]
    #: the tendons' places (m) and their derivative along the rod; the third components are not used
    r: Float[Any, "c 3"]
    r_s: Float[Any, "c 3"]
    #: T (N), negative for a chamber; 0 for a tendon that has ended
    tension: Float[Any, " c"]
    #: increase of T by the stretch (`Stretching`); None: none
    stretching: Any = None


class Stretching(NamedTuple):
    """Increase of the tension by the stretch λ of its path: slope λ + EA (σ(λ)/E - (λ - 1)).

    σ is Yeoh's stress of an incompressible material (1993) for C₁ = E/6, and ratios c₂ and c₃ of C₂ and C₃ to
    it: σ/E = (λ - λ⁻²)/3 (1 + 2 c₂ J + 3 c₃ J²), J = λ² + 2/λ - 3. With c₂ = c₃ = 0 it is neo-Hookean.
    """

    #: N
    slope: Float[Any, " c"]
    #: EA (N), c₂ and c₃
    axial: Float[Any, " c"]
    second: Float[Any, " c"]
    third: Float[Any, " c"]

    def tension(self, stretch: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return the increase of T (N)."""
        shorter = 1.0 / stretch
        J = stretch * stretch + 2.0 * shorter - 3.0
        stress = (stretch - shorter * shorter) / 3.0 * (1.0 + J * (2.0 * self.second + 3.0 * self.third * J))
        return self.slope * stretch + self.axial * (stress - stretch + 1.0)


def stretches(
    v: Float[Any, "3"], u: Float[Any, "3"], r: Float[Any, "c 3"], r_s: Float[Any, "c 3"]
) -> Float[Any, " c"]:
    """Return |ṗᵢ|: metres of tendon per metre of rod; its integral is the tendon's length in the rod."""
    x, y, z = _rates(jnp.concatenate([v, u]), r, r_s)
    return jnp.sqrt(x * x + y * y + z * z)


def tendon_wrench(
    v: Float[Any, "3"], u: Float[Any, "3"], r: Float[Any, "c 3"], r_s: Float[Any, "c 3"], tension: Any
) -> tuple[Float[Any, "3"], Float[Any, "3"]]:
    """Return Σ Tᵢ tᵢ (N) and Σ Tᵢ rᵢ × tᵢ (N·m), material frame: the tendons' part of Rᵀn and Rᵀm."""
    loads = dot(_levers(jnp.concatenate([v, u]), r, r_s)[0], tension)
    return loads[:3], loads[3:]


def unbent_flexibility(law: TendonLaw) -> Float[Any, "6 6"]:
    """Return J⁻¹ of the unbent rod and tendons; the load is not used."""
    return small_inverse(_stiffness(*_levers(UNBENT, law.r, law.r_s), law))


def tendon_strains(
    law: TendonLaw, flexibility: Float[Any, "6 6"] | None = None
) -> tuple[Float[Any, "3"], Float[Any, "3"]]:
    """Return the v and u (1/m) that satisfy a law, solved to rounding; NaN if Newton's method fails.

    `flexibility` is `unbent_flexibility` of the law, or an approximation that is not zero. It affects the
    speed of convergence, not the solution. Derivatives of any order and mode are those of the solution.
    """
    if flexibility is None:
        flexibility = unbent_flexibility(law)
    x = _solution(jax.lax.stop_gradient(flexibility), law)
    return x[:3], x[3:]


class Tendons(NamedTuple):
    """Tendons beside the rod at one point: they couple its strains v and u (`MaterialLaw.coupling`)."""

    r: Float[Any, "c 3"]
    r_s: Float[Any, "c 3"]
    #: T (N)
    tension: Float[Any, " c"]
    #: T without friction: an approximation that is often known before y
    nominal_tension: Float[Any, " c"]
    #: increase of T by the stretch; None: none
    stretching: Stretching | None = None

    def joined(self, others: Tendons | None) -> Tendons:
        """Return these and other tendons of the rod."""
        if others is None:
            return self
        sets = others, self
        stretching = None
        if others.stretching is not None or self.stretching is not None:
            parts = (one.stretching or Stretching(*np.zeros((4, *one.tension.shape))) for one in sets)
            stretching = Stretching(*map(jnp.concatenate, zip(*parts, strict=True)))
        r, r_s, tension, nominal = map(jnp.concatenate, zip(*(one[:4] for one in sets), strict=True))
        return Tendons(r, r_s, tension, nominal, stretching)

    def strains(self, elastic: dict[str, Elastic]) -> Fields:
        """Return v and u of the rod's elastic laws with the tendons."""
        v, u = elastic["v"], elastic["u"]
        load = jnp.concatenate([v.stress, u.stress])
        paths, stretching = (load, self.r, self.r_s), self.stretching
        nominal = TendonLaw(v.stiffness, u.stiffness, *paths, self.nominal_tension, stretching)
        law = TendonLaw(v.softened, u.softened, *paths, self.tension, stretching)
        return dict(zip("vu", tendon_strains(law, unbent_flexibility(nominal)), strict=True))

    def stresses(self, strains: Fields) -> Fields:
        """Return the tendons' part of Rᵀn and Rᵀm."""
        g, shorter = _levers(jnp.concatenate([strains["v"], strains["u"]]), self.r, self.r_s)
        loads = dot(g, _pull(shorter, self))
        return {"v": loads[:3], "u": loads[3:]}


# x is the concatenation of v and u


def _columns(vectors: Float[Any, "c 3"]) -> tuple[Any, Any]:
    return tuple(jax.lax.index_in_dim(vectors, k, 1, keepdims=False) for k in range(2))  # type: ignore[return-value]


def _attachment_motion(x: Float[Any, "6"], r: Float[Any, "c 3"]) -> tuple[Any, Any, Any]:
    """Return the components (c,) of Wᵢ x = v + u × rᵢ."""
    vx, vy, vz, ux, uy, uz = (jax.lax.index_in_dim(x, k, 0, keepdims=False) for k in range(6))
    rx, ry = _columns(r)
    return vx - uz * ry, vy + uz * rx, vz + ux * ry - uy * rx


def _rates(x: Float[Any, "6"], r: Float[Any, "c 3"], r_s: Float[Any, "c 3"]) -> tuple[Any, Any, Any]:
    (px, py, pz), (dx, dy) = _attachment_motion(x, r), _columns(r_s)
    return px + dx, py + dy, pz


def _levers(x: Float[Any, "6"], r: Float[Any, "c 3"], r_s: Float[Any, "c 3"]) -> tuple[Any, Any]:
    """Return gᵢ = (tᵢ, rᵢ × tᵢ), (6, c), and 1/|ṗᵢ|."""
    rates = jnp.stack(_rates(x, r, r_s))
    shorter = 1.0 / jnp.sqrt(jnp.sum(rates * rates, axis=0))
    (tx, ty, tz), (rx, ry) = rates * shorter, _columns(r)
    return jnp.stack([tx, ty, tz, ry * tz, -rx * tz, rx * ty - ry * tx]), shorter


def _pull(shorter: Any, law: TendonLaw | Tendons) -> Float[Any, " c"]:
    """Return Tᵢ, from 1/|ṗᵢ|."""
    if law.stretching is None:
        return law.tension
    return law.tension + law.stretching.tension(1.0 / shorter)


def _residual(x: Any, g: Any, shorter: Any, law: TendonLaw) -> Float[Any, "6"]:
    """Return the law's residual at x."""
    elastic = jnp.concatenate([dot(law.K_v, x[:3]), dot(law.K_u, x[3:])])
    return elastic + dot(g, _pull(shorter, law)) - law.load


def _stiffness(g: Any, shorter: Any, law: TendonLaw) -> Float[Any, "6 6"]:
    """Return J."""
    rx, ry = _columns(law.r)
    o, one = jnp.zeros_like(rx), jnp.ones_like(rx)
    # rows of Wᵢ: independent of x, and so constant if r is
    W = [jnp.stack(row) for row in ((one, o, o, o, o, -ry), (o, one, o, o, o, rx), (o, o, one, ry, -rx, o))]
    spread = sum(row[:, None] * row[None, :] for row in W)
    along, pulled = g[:, None] * g[None, :], _pull(shorter, law) * shorter
    stiffer = jnp.sum(pulled * (spread - along), axis=2)
    if law.stretching is not None:
        stretch = 1.0 / shorter
        growth = jax.jvp(law.stretching.tension, (stretch,), (jnp.ones_like(stretch),))[1]
        stiffer = stiffer + jnp.sum(growth * along, axis=2)
    nothing = np.zeros((3, 3))
    upper = jnp.concatenate([law.K_v, nothing], axis=1)
    lower = jnp.concatenate([nothing, law.K_u], axis=1)
    return jnp.concatenate([upper, lower]) + stiffer


#: optimisation barrier: without it XLA would recompute early results at each later use
_in_turn = jax.lax.optimization_barrier


def _turn(dx: Any, shorter: Any, r: Any) -> Any:
    """Return the rotation of a tendon by dx: the largest |Wᵢ dx|/|ṗᵢ|."""
    turned = jnp.stack(_attachment_motion(dx, r)) * shorter
    return jnp.sqrt(jnp.max(jnp.sum(turned * turned, axis=0)))


def _initial_solution(law: TendonLaw) -> Float[Any, "6"]:
    """Return the solution with unrotated tendons: a better initial guess far from the unbent rod."""
    free = -_residual(np.zeros(6), *_levers(UNBENT, law.r, law.r_s), law)
    return jnp.concatenate([dot(inverse(law.K_v), free[:3]), dot(inverse(law.K_u), free[3:])])


def _solve(flexibility: Any, law: TendonLaw) -> Float[Any, "6"]:
    """Return the law's solution, starting from the unbent rod and tendons."""
    known = flexibility, law

    def correction(x: Any, known: Any) -> tuple[Any, Any]:
        """Return minus the flexibility times the residual at x, and the rotation of a tendon by it."""
        flexibility, law = known
        g, shorter = _levers(x, law.r, law.r_s)
        dx = -jnp.sum(flexibility * _residual(x, g, shorter, law), axis=1)
        return dx, _turn(dx, shorter, law.r)

    def unsolved(reached: Any) -> Any:
        count, _, missing = reached
        return (count < ROUNDS) & ~(missing <= MISSING)

    def corrected(reached: Any) -> Any:
        """Return the next iterate of Newton's method, damped."""
        (count, x, _), (_, law) = _in_turn((reached, known))
        x = jnp.where(count == 0, _initial_solution(law), x)
        g, shorter = _levers(x, law.r, law.r_s)
        # slower than a written-out inverse, but quick to compile
        root = jnp.linalg.cholesky(_stiffness(g, shorter, law))
        dx = -jax.scipy.linalg.cho_solve((root, True), _residual(x, g, shorter, law))
        turned = _turn(dx, shorter, law.r)
        # damping that guarantees descent for a convex function with |f‴| ≤ 3 f″ (Sun & Tran-Dinh 2019)
        near = turned < SMALL
        x = x + jnp.where(near, 1.0, jnp.log1p(3.0 * turned) / jnp.maximum(3.0 * turned, 1e-300)) * dx
        # estimate of the next correction: this one times the change of J (|t″| ≤ 3)
        return count + 1, x, jnp.where(near, 3.0 * turned * turned, jnp.inf)

    def left_over(turned: Any, before: Any) -> Any:
        """Return the chord iteration's error estimate: corrections shrink by a constant ratio."""
        less = turned * (turned / jnp.maximum(before, 1e-300))
        # after convergence both are rounding errors
        return jnp.where(turned <= jnp.maximum(LESS * before, MISSING), jnp.minimum(less, turned), jnp.inf)

    def converges(reached: Any) -> Any:
        _, _, missing = reached
        return (missing > MISSING) & (missing < jnp.inf)

    def once_more(reached: Any) -> Any:
        # the barrier includes the law: XLA would otherwise evaluate it before a loop that may not need it
        (x, before, _), later = _in_turn((reached, known))
        dx, turned = correction(x, later)
        return x + dx, turned, left_over(turned, before)

    # the usual first corrections are written out: a loop's bookkeeping takes as long as a correction
    x = _in_turn(UNBENT + correction(UNBENT, known)[0])
    dx, first = correction(x, known)
    x, first = _in_turn((x + dx, first))
    dx, turned = correction(x, known)
    x, turned = _in_turn((x + dx, turned))
    x, turned, missing = jax.lax.while_loop(converges, once_more, (x, turned, left_over(turned, first)))
    # continue from x if it is close to the solution
    begun = jnp.where(turned < SMALL, 1, 0)
    _, x, missing = jax.lax.while_loop(unsolved, corrected, (begun, x, missing))
    return jnp.where(missing <= MISSING, x, jnp.nan)


_solution = jax.custom_jvp(_solve)


def _slope(primals: Any, tangents: Any) -> tuple[Any, Any]:
    """Return the solution's derivative, J dx = -d(law), for the arguments with tangents (mostly the load)."""
    x = _solution(*primals)
    # the derivative does not depend on the initial flexibility
    (_, law), (_, tangents) = primals, tangents
    leaves, shape = jax.tree.flatten(law)
    changes = jax.tree.leaves(tangents, is_leaf=lambda leaf: isinstance(leaf, SymbolicZero))
    flags = [not isinstance(change, SymbolicZero) for change in changes]
    moves = jax.tree.unflatten(shape, flags)
    g, shorter = _in_turn(_levers(x, law.r, law.r_s))

    def residual(*moving: Any) -> Any:
        values = iter(moving)
        changed = jax.tree.unflatten(
            shape, [next(values) if moved else leaf for moved, leaf in zip(flags, leaves, strict=True)]
        )
        levers = _levers(x, changed.r, changed.r_s) if moves.r or moves.r_s else (g, shorter)
        return _residual(x, *levers, changed)

    moving = [leaf for moved, leaf in zip(flags, leaves, strict=True) if moved]
    along = [change for moved, change in zip(flags, changes, strict=True) if moved]
    _, change = jax.jvp(residual, moving, along)
    return x, -dot_by_rows(small_inverse(_stiffness(g, shorter, law)), change)


_solution.defjvp(_slope, symbolic_zeros=True)
