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

from knode_cosserat.rods.system import Scales, System, unknowns_of
from knode_cosserat.solvers.linear import Factors, factored, solved_correction
from knode_cosserat.solvers.problem import StepProblem
from knode_cosserat.solvers.space import SpaceScheme

#: largest correction that may be left at a solution, relative to the state and its natural units
LARGEST_CORRECTION = 1e-5


@dataclasses.dataclass(frozen=True)
class NewtonOptions:
    """Tolerances and limits of Newton's method.

    Residuals are measured in the system's natural units (`System.scales`). A step is solved when the largest
    is below `tolerance`, or below `acceptable` where rounding allows no further progress, and the correction
    that is left is small.
    """

    tolerance: float = 1e-10
    acceptable: float = 1e-8
    max_linearisations: int = 12
    #: linearise again when the old linearisation is expected to need more corrections than this
    patience: int = 6
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


def largest_residual(problem: StepProblem, defects: Any, tip: Any) -> Any:
    """Return the largest residual in natural units, infinite for a NaN."""
    return largest_of(problem.system.scales(), defects, tip)


def largest_of(scales: Scales, defects: Any, tip: Any) -> Any:
    """Return the largest residual in these units, infinite for a NaN."""
    error = jnp.maximum(jnp.max(jnp.abs(defects) / scales.y), jnp.max(jnp.abs(tip) / scales.tip))
    return jnp.where(jnp.isnan(error), jnp.inf, error)


@functools.partial(jax.jit, static_argnames="space")
def static_error(system: System, space: SpaceScheme, record: Any, control: Any, t: Any) -> Any:
    """Return the largest residual of a record in natural units, all rates zero."""
    problem = StepProblem.still(system, space, control, t)
    y = problem.filled(record[:, : system.y_layout.size])
    base = problem.base(unknowns_of(system, y[0])) - y[0]
    error = largest_residual(problem, *problem.residuals(y))
    return jnp.maximum(error, jnp.max(jnp.abs(base) / system.scales().y))


class _Progress(NamedTuple):
    """Progress of the iteration; all entries are numbers because they are stored in one vector."""

    #: residual of the last accepted point
    error: Any
    #: length of the correction from it, infinite if there is none by the same linearisation
    size: Any
    #: the same relative to the state
    left: Any
    #: damping factor of the next correction
    damping: Any
    #: a new linearisation is needed at the point
    renew: Any
    #: no correction has been made by this linearisation
    first: Any
    #: the direction is the first of its linearisation
    fresh: Any
    #: the linearisation is from an earlier step
    old: Any
    #: solved, or no further progress
    done: Any
    corrections: Any
    linearisations: Any


class _Search(NamedTuple):
    """State of the iteration, in few and long vectors: every array costs one or two kernel launches."""

    #: the last accepted point, y and unknowns, and the correction from it
    point: Float[Any, " n"]
    direction: Float[Any, " n"]
    #: `_Progress`
    numbers: Float[Any, "11"]

    @property
    def progress(self) -> _Progress:
        """The numbers by name."""
        return _Progress(*(self.numbers[k] for k in range(len(_Progress._fields))))


def _packed(progress: _Progress) -> Float[Any, "11"]:
    return jnp.stack([jnp.asarray(each, dtype=float) for each in progress])


def newton(
    problem: StepProblem, y: Float[Any, "points y"], unknowns: Float[Any, " k"], options: NewtonOptions,
    kept: Kept | None = None,
) -> tuple[Solution, Kept]:  # fmt: skip
    """Solve one step from a first guess, beginning with kept factors if they are usable.

    Never fails: the `error` of the solution tells if it is solved.
    """
    scales, pivots, size_of_y, shape = problem.system.scales(), pivots_of(problem.system), y.size, y.shape
    kept = none_kept(problem, y, unknowns) if kept is None else kept

    def unpacked(point: Any) -> tuple[Any, Any]:
        y, unknowns = point[:size_of_y].reshape(shape), point[size_of_y:]
        return jnp.concatenate([problem.base(unknowns)[None], y[1:]]), unknowns

    def correct(factors: Factors, search: _Search) -> _Search:
        last = search.progress
        first, fresh, old = last.first > 0.0, last.fresh > 0.0, last.old > 0.0
        trial = search.point + last.damping * search.direction
        y, _ = unpacked(trial)
        defects, tip = problem.residuals(y)
        error = largest_of(scales, defects, tip)
        dy, dxi = solved_correction(factors, pivots, defects, tip)
        size = jnp.max(jnp.abs(dy) / scales.y)
        left = jnp.max(jnp.abs(dy) / (scales.y + jnp.abs(y)))
        good = (error <= options.tolerance) & (left <= LARGEST_CORRECTION)
        shorter = (size <= (1.0 - last.damping / 4.0) * last.size) & jnp.isfinite(size)
        accept = good | shorter
        # corrections still to come at this rate
        rate = jnp.log(jnp.maximum(last.size / size, 1.0 + 1e-6))
        slow = jnp.log(error / options.tolerance) / rate > options.patience
        slow = shorter & ~first & jnp.isfinite(last.size) & (slow | (last.damping < 1.0))
        shorten = ~accept & fresh & ~first & (last.damping > options.least_damping)
        rounding = ~accept & (last.error <= options.acceptable) & ~old & ~first
        dead = rounding | (~accept & (first | fresh) & ~shorten)
        # continue from here, retry a shorter step from the previous point, or linearise anew there
        renew = ~good & ~dead & (slow | (~accept & ~shorten))
        longer = jnp.where(first, 1.0, jnp.minimum(1.0, 4.0 * last.damping))
        progress = _Progress(
            error=jnp.where(accept, error, last.error), size=jnp.where(accept, size, last.size),
            left=jnp.where(accept, left, last.left),
            damping=jnp.where(accept, longer, last.damping / 4.0), renew=renew, first=False,
            fresh=jnp.where(accept, first, fresh), old=old, done=good | dead,
            corrections=last.corrections + ~(good | dead | renew), linearisations=last.linearisations,
        )  # fmt: skip
        return _Search(
            jnp.where(accept, trial, search.point),
            jnp.where(accept, jnp.concatenate([dy.reshape(-1), dxi]), search.direction),
            _packed(progress),
        )

    def linearised(state: tuple[_Search, Factors]) -> tuple[_Search, Factors]:
        search, factors = state
        last = search.progress
        renew = last.renew > 0.0

        def anew(state: tuple[Any, Factors]) -> tuple[Any, Factors]:
            return jnp.array(False), factors_of(problem, *unpacked(search.point))

        # a loop of one turn at most: `cond` would copy the factors that are kept
        _, factors = jax.lax.while_loop(lambda state: state[0], anew, (renew, factors))
        progress = last._replace(
            damping=jnp.where(renew, 1.0, last.damping), size=jnp.where(renew, jnp.inf, last.size),
            old=(last.old > 0.0) & ~renew, first=renew, renew=False,
            linearisations=last.linearisations + renew,
        )  # fmt: skip
        search = _Search(search.point, jnp.where(renew, 0.0, search.direction), _packed(progress))

        def going(search: _Search) -> Any:
            return unsolved(search) & ~(search.progress.renew > 0.0)

        return jax.lax.while_loop(going, functools.partial(correct, factors), search), factors

    def unsolved(search: _Search) -> Any:
        now = search.progress
        return ~(now.done > 0.0) & (now.linearisations + now.renew <= options.max_linearisations)

    guess = jnp.concatenate([y.reshape(-1), unknowns])
    begun = _Progress(
        error=jnp.inf, size=jnp.inf, left=jnp.inf, damping=1.0, renew=~kept.usable, first=False, fresh=False,
        old=kept.usable, done=False, corrections=0, linearisations=0,
    )  # fmt: skip
    search, factors = jax.lax.while_loop(
        lambda state: unsolved(state[0]),
        linearised,
        (_Search(guess, jnp.zeros_like(guess), _packed(begun)), kept.factors),
    )
    end = search.progress
    # a small residual is no solution while the correction from it is large
    error = jnp.where(
        end.left <= LARGEST_CORRECTION, end.error, jnp.maximum(end.error, jnp.minimum(end.left, 1.0))
    )
    solution = Solution(
        *unpacked(search.point), error, end.corrections.astype(int), end.linearisations.astype(int)
    )
    return solution, Kept(factors, (error <= options.acceptable) & ~(end.renew > 0.0))
