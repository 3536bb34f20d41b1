"""The boundary-value problem of one time step, solved at all nodes at once.

Unknown are y at every node and the free numbers ξ at the base. Their equations:

    y_0 = base(ξ),     y_{j+1} = y_j + h Σ bᵢ f(Yᵢ)  (a piece of the space scheme),     tip(y_N) = 0

Newton's method linearises all pieces side by side, and one linear recursion along the rod gives the
correction. A linearisation costs as much as several corrections. It is kept, also from one time step to the
next, while corrections converge fast. Corrections are damped by the natural monotonicity test: the correction
that the same linearisation proposes at the new point must be shorter than the last one (Deuflhard, Newton
Methods for Nonlinear Problems, 2004, ch. 3).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.linear import Factors, factored, solved
from knode_cosserat.solvers.problem import StepProblem
from knode_cosserat.solvers.space import SpaceScheme


@dataclasses.dataclass(frozen=True)
class NewtonOptions:
    """When a step counts as solved, and how long to try.

    Residuals are measured in the system's natural units (`System.scales`). A step is solved when the largest
    is below `tolerance`, or below `acceptable` where rounding allows no further progress.
    """

    tolerance: float = 1e-10
    acceptable: float = 1e-8
    max_linearisations: int = 12
    #: linearise again when the old linearisation is expected to need more corrections than this
    patience: int = 8
    least_damping: float = 1e-3

    def __post_init__(self) -> None:
        for name, allowed, holds in (
            ("tolerance", "a number above 0", lambda x: 0.0 < x < math.inf),
            ("acceptable", "a number from the tolerance on", lambda x: x >= self.tolerance),
            ("max_linearisations", "a whole number from 1", lambda x: x >= 1 and x == int(x)),
            ("patience", "a whole number from 1", lambda x: x >= 1 and x == int(x)),
            ("least_damping", "a number above 0, at most 1", lambda x: 0.0 < x <= 1.0),
        ):
            given = getattr(self, name)
            if not isinstance(given, int | float) or not holds(given):
                raise ValueError(f"NewtonOptions: {name} is {given!r}; allowed is {allowed}")


class Iterate(NamedTuple):
    """A point of the iteration and its residuals; `error` is the largest (natural units; inf for NaN)."""

    y: Float[Any, "points y"]
    unknowns: Float[Any, " k"]
    defects: Float[Any, "pieces y"]
    tip: Float[Any, " k"]
    error: Float[Any, ""]


class Solution(NamedTuple):
    """Final iterate of Newton's method: solved if `error` is at most `acceptable`."""

    y: Float[Any, "points y"]
    unknowns: Float[Any, " k"]
    error: Float[Any, ""]
    corrections: Int[Any, ""]
    linearisations: Int[Any, ""]


class Kept(NamedTuple):
    """Factors of an earlier linearisation; not usable before the first."""

    factors: Factors
    usable: Any


def pivots_of(system: System) -> Any:
    """Return the indices in y of the fields that are unknown at the base."""
    return np.asarray(system.y_layout.indices(system.base_unknowns))


def factors_of(problem: StepProblem, y: Any, unknowns: Any) -> Factors:
    """Return the factored linearisation at a point."""
    return factored(problem.linearise(y, unknowns), pivots_of(problem.system))


def none_kept(problem: StepProblem, y: Any, unknowns: Any) -> Kept:
    """Return factors of the right shape that are not usable."""
    like = jax.eval_shape(lambda: factors_of(problem, y, unknowns))
    return Kept(jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), like), jnp.array(False))


def _iterate(problem: StepProblem, y: Any, unknowns: Any) -> Iterate:
    y = jnp.concatenate([problem.base(unknowns)[None], y[1:]])
    defects, tip = problem.residuals(y)
    return Iterate(y, unknowns, defects, tip, largest_residual(problem, defects, tip))


def largest_residual(problem: StepProblem, defects: Any, tip: Any) -> Any:
    """Return the largest residual in natural units, infinite for a NaN."""
    scales = problem.system.scales()
    error = jnp.maximum(jnp.max(jnp.abs(defects) / scales.y), jnp.max(jnp.abs(tip) / scales.tip))
    return jnp.where(jnp.isnan(error), jnp.inf, error)


@functools.partial(jax.jit, static_argnames="space")
def static_error(system: System, space: SpaceScheme, record: Any, control: Any, t: Any) -> Any:
    """Return the largest residual of a record in natural units, all rates zero."""
    problem = StepProblem.still(system, space, control, t)
    y = problem.filled(record[:, : system.y_layout.size])
    base = problem.base(system.unknowns(y[0])) - y[0]
    error = largest_residual(problem, *problem.residuals(y))
    return jnp.maximum(error, jnp.max(jnp.abs(base) / system.scales().y))


class _Search(NamedTuple):
    """State of the iteration."""

    #: the next point
    y: Float[Any, "points y"]
    unknowns: Float[Any, " k"]
    #: the last accepted point, and the correction from it
    before: Iterate
    dy: Float[Any, "points y"]
    dxi: Float[Any, " k"]
    #: its length, infinite if there is none by the same linearisation
    size: Float[Any, ""]
    damping: Float[Any, ""]
    #: a new linearisation is needed at the next point
    renew: Any
    #: the next correction is the first of its linearisation, at its point
    first: Any
    #: the last correction was made at the point of its linearisation
    fresh: Any
    #: the linearisation is from an earlier step
    old: Any
    #: solved, or no further progress
    done: Any
    corrections: Int[Any, ""]
    linearisations: Int[Any, ""]


def newton(
    problem: StepProblem, y: Float[Any, "points y"], unknowns: Float[Any, " k"], options: NewtonOptions,
    kept: Kept | None = None, batch: str | None = None,
) -> tuple[Solution, Kept]:  # fmt: skip
    """Solve one step from a first guess, beginning with kept factors if they are usable.

    `batch` is the name of the axis of robots that are solved in lockstep: they are linearised together, if
    one of them needs it. Never fails: the `error` of the solution says whether it is one.
    """
    y_scale, pivots = problem.system.scales().y, pivots_of(problem.system)
    kept = none_kept(problem, y, unknowns) if kept is None else kept

    def correct(factors: Factors, search: _Search) -> _Search:
        first, damping = search.first, search.damping
        at = _iterate(problem, search.y, search.unknowns)
        dy, dxi = solved(factors, pivots, at.defects, at.tip)
        size = jnp.max(jnp.abs(dy) / y_scale)
        good = at.error <= options.tolerance
        shorter = (size <= (1.0 - damping / 4.0) * search.size) & jnp.isfinite(size)
        accept = good | shorter
        # corrections still to come at this rate
        rate = jnp.log(jnp.maximum(search.size / size, 1.0 + 1e-6))
        slow = jnp.log(at.error / options.tolerance) / rate > options.patience
        slow = shorter & ~first & jnp.isfinite(search.size) & (slow | (damping < 1.0))
        shorten = ~accept & search.fresh & ~first & (damping > options.least_damping)
        rounding = ~accept & (search.before.error <= options.acceptable) & ~search.old & ~first
        dead = rounding | (~accept & (first | search.fresh) & ~shorten)
        # the next point: on from here, again from the one before but shorter, or a new linearisation there
        origin = _where(accept, at, search.before)
        direction = _where(accept, (dy, dxi), (search.dy, search.dxi))
        damping = jnp.where(accept, jnp.where(first, 1.0, jnp.minimum(1.0, 4.0 * damping)), damping / 4.0)
        renew = ~good & ~dead & (slow | (~accept & ~shorten))
        step = jnp.where(good | dead | renew, 0.0, damping)
        return _Search(
            y=origin.y + step * direction[0], unknowns=origin.unknowns + step * direction[1],
            before=origin, dy=direction[0], dxi=direction[1], size=jnp.where(accept, size, search.size),
            damping=jnp.where(renew, 1.0, damping), renew=renew, first=jnp.array(False),
            fresh=jnp.where(accept, first, search.fresh), old=search.old, done=good | dead,
            corrections=search.corrections + (step > 0.0), linearisations=search.linearisations,
        )  # fmt: skip

    def linearised(state: tuple[_Search, Factors]) -> tuple[_Search, Factors]:
        search, factors = state
        renew = search.renew

        def anew(at: tuple[Any, Any], old: Factors) -> Factors:
            y, unknowns = at
            y = jnp.concatenate([problem.base(unknowns)[None], y[1:]])
            found = factors_of(problem, y, unknowns)
            return found if batch is None else _where(renew, found, old)

        # by the need of any robot, which is one number: by each one's, a batch would always do both
        needed = renew if batch is None else jax.lax.psum(renew.astype(int), batch) > 0
        at = search.y, search.unknowns
        factors = jax.lax.cond(needed, anew, lambda _, old: old, at, factors)
        search = search._replace(
            size=jnp.where(renew, jnp.inf, search.size), old=search.old & ~renew, first=renew,
            renew=jnp.array(False), linearisations=search.linearisations + renew,
        )  # fmt: skip
        going = functools.partial(jax.lax.while_loop, lambda s: unsolved(s) & ~s.renew)
        return going(functools.partial(correct, factors), search), factors

    def unsolved(search: _Search) -> Any:
        return ~search.done & (search.linearisations + search.renew <= options.max_linearisations)

    zero, no = jnp.array(0), jnp.array(False)
    nowhere = Iterate(y, unknowns, jnp.zeros_like(y[1:]), jnp.zeros_like(unknowns), jnp.array(jnp.inf))
    first = _Search(
        y=y, unknowns=unknowns, before=nowhere, dy=jnp.zeros_like(y), dxi=jnp.zeros_like(unknowns),
        size=jnp.array(jnp.inf), damping=jnp.array(1.0), renew=~kept.usable, first=no, fresh=no,
        old=kept.usable, done=no, corrections=zero, linearisations=zero,
    )  # fmt: skip
    search, factors = jax.lax.while_loop(lambda state: unsolved(state[0]), linearised, (first, kept.factors))
    at = search.before
    solution = Solution(at.y, at.unknowns, at.error, search.corrections, search.linearisations)
    return solution, Kept(factors, (at.error <= options.acceptable) & ~search.renew)


def _where(condition: Any, one: Any, other: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)
