"""The boundary-value problem of one time step, solved at all nodes at once.

Unknown are y at every node and the free numbers ξ at the base. Their equations:

    y_0 = base(ξ),     y_{j+1} = Φ_j(y_j)  (one segment of the space scheme),     tip(y_N) = 0

Newton's method linearises all segments side by side, F_j = ∂Φ_j/∂y_j, and one linear recursion along the
rod gives the correction. Measured against single shooting on the paper's robot this is faster (no serial
chain of nonlinear evaluations) and converges from further away. Because a linearisation costs several times
as much as the residual, it is kept for further corrections while those still converge fast. Steps are damped
by the natural monotonicity test: the correction that the old linearisation proposes at the new point must be
shorter than the last one (Deuflhard, Newton Methods for Nonlinear Problems, 2004, ch. 3).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.linear import Linearisation, LinearSolver
from knode_cosserat.solvers.problem import StepProblem
from knode_cosserat.solvers.space import SLOPES, VALUES, SpaceScheme


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
    #: begin a step with the last one's linearisation, as long as it converges: many short steps of a rod with
    #: many nodes then take less time each. Residuals end up nearer to `tolerance`.
    across_steps: bool = False

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
    """A point of the iteration; `error` is its largest residual in natural units, infinite for a NaN."""

    y: Float[Any, "points y"]
    unknowns: Float[Any, " k"]
    error: Float[Any, ""]


class Solution(NamedTuple):
    """What Newton's method ended with: solved if `error` is at most `acceptable`, and not otherwise."""

    y: Float[Any, "points y"]
    unknowns: Float[Any, " k"]
    error: Float[Any, ""]
    corrections: Int[Any, ""]
    linearisations: Int[Any, ""]


class Kept(NamedTuple):
    """The linear solver's factors of an earlier linearisation, and whether there are any."""

    factors: Any
    usable: Any


def none_kept(problem: StepProblem, y: Any, unknowns: Any, linear: LinearSolver) -> Kept:
    """What is kept before the first step."""
    y_scale = problem.system.scales().y
    like = jax.eval_shape(lambda: linear.start(linearise(problem, y, unknowns), y_scale)[0])
    return Kept(jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), like), jnp.array(False))


def _with_base(problem: StepProblem, y: Any, unknowns: Any) -> Any:
    return jnp.concatenate([problem.base(unknowns)[None], y[1:]])


def _error(problem: StepProblem, defects: Any, tip: Any) -> Any:
    scales = problem.system.scales()
    error = jnp.maximum(jnp.max(jnp.abs(defects) / scales.y), jnp.max(jnp.abs(tip) / scales.tip))
    return jnp.where(jnp.isnan(error), jnp.inf, error)


def residuals(problem: StepProblem, y: Float[Any, "points y"]) -> tuple[Any, Any]:
    """Defects y_{j+1} - Φ_j(y_j), with their sign turned, and the tip's residuals."""
    reached = problem.pieces(VALUES, y)
    return reached.reshape(y[1:].shape) - y[1:], problem.tip_residual(y[-1])


@functools.partial(jax.jit, static_argnames="space")
def static_error(system: System, space: SpaceScheme, record: Any, control: Any, t: Any) -> Any:
    """How far a record is from an equilibrium: its largest residual in natural units, all rates zero."""
    problem = StepProblem.still(system, space, control, t)
    y = problem.filled(record[:, : system.y_layout.size])
    base = problem.base(system.unknowns(y[0])) - y[0]
    error = _error(problem, *residuals(problem, y))
    return jnp.maximum(error, jnp.max(jnp.abs(base) / system.scales().y))


def linearise(problem: StepProblem, y: Float[Any, "points y"], unknowns: Any) -> Linearisation:
    """Residuals and their exact derivatives by forward mode, all segments in one batch."""
    reached, F = problem.pieces(SLOPES, y)
    if problem.system.strands > 1:
        F = F.reshape(y.shape[0] - 1, problem.system.strands, *F.shape[1:])
    tip, M = SLOPES.on(problem.tip_residual, SLOPES.begin(y[-1]))
    S = jax.jacfwd(problem.base)(unknowns)
    return Linearisation(F, S, M, reached.reshape(y[1:].shape) - y[1:], tip)


class _Search(NamedTuple):
    """State while one linearisation is in use: the point, and the correction proposed there."""

    at: Iterate
    dy: Float[Any, "points y"]
    dxi: Float[Any, " k"]
    size: Float[Any, ""]
    damping: Float[Any, ""]
    corrections: Int[Any, ""]
    fresh: Any
    go: Any
    dead: Any


def newton(
    problem: StepProblem,
    y: Float[Any, "points y"],
    unknowns: Float[Any, " k"],
    linear: LinearSolver,
    options: NewtonOptions,
) -> Solution:
    """Solve one step from a first guess. Never fails: the solution's `error` says what came of it."""
    return newton_keeping(problem, y, unknowns, linear, options, None)[0]


def newton_keeping(
    problem: StepProblem, y: Float[Any, "points y"], unknowns: Float[Any, " k"], linear: LinearSolver,
    options: NewtonOptions, kept: Kept | None,
) -> tuple[Solution, Kept | None]:  # fmt: skip
    """`newton` that begins with what is kept, and what is to be kept of it; None keeps nothing."""
    y_scale = problem.system.scales().y

    def size_of(dy: Any) -> Any:
        return jnp.max(jnp.abs(dy) / y_scale)

    def correct(factors: Any, old: Any, search: _Search) -> _Search:
        at, damping = search.at, search.damping
        xi = at.unknowns + damping * search.dxi
        y = _with_base(problem, at.y + damping * search.dy, xi)
        defects, tip = residuals(problem, y)
        trial = Iterate(y, xi, _error(problem, defects, tip))
        solved = trial.error <= options.tolerance
        dy, dxi = jax.lax.cond(
            solved, lambda: (search.dy, search.dxi), lambda: linear.solve(factors, defects, tip)
        )
        size = size_of(dy)
        accept = (size <= (1.0 - damping / 4.0) * search.size) | solved
        # corrections still to come at this rate, were the linearisation kept
        rate = jnp.log(jnp.maximum(search.size / size, 1.0 + 1e-6))
        remaining = jnp.log(trial.error / options.tolerance) / rate
        keep = accept & (damping == 1.0) & (remaining <= options.patience)
        shorten = ~accept & search.fresh & (damping > options.least_damping)
        rounding = ~accept & (at.error <= options.acceptable) & ~old
        return _Search(
            at=Iterate(*(jnp.where(accept, new, old) for new, old in zip(trial, at, strict=True))),
            dy=jnp.where(accept, dy, search.dy),
            dxi=jnp.where(accept, dxi, search.dxi),
            size=jnp.where(accept, size, search.size),
            damping=jnp.where(accept, jnp.minimum(1.0, 4.0 * damping), damping / 4.0),
            corrections=search.corrections + 1,
            fresh=search.fresh & ~accept,
            go=~solved & ~rounding & (keep | shorten),
            dead=rounding | (~accept & search.fresh & ~shorten),
        )

    def anew(at: Iterate) -> Any:
        linearisation = linearise(problem, at.y, at.unknowns)
        found = linear.start(linearisation, y_scale)
        return *found, _error(problem, linearisation.defects, linearisation.tip_residual)

    def again(factors: Any, at: Iterate) -> Any:
        defects, tip = residuals(problem, at.y)
        return factors, *linear.solve(factors, defects, tip), _error(problem, defects, tip)

    def linearised(state: tuple[_Search, Any, Kept | None]) -> tuple[_Search, Any, Kept | None]:
        search, count, kept = state
        at = search.at
        if kept is None:
            old = jnp.array(False)
            factors, dy, dxi, error = anew(at)
        else:
            old = kept.usable
            factors, dy, dxi, error = jax.lax.cond(old, again, lambda _, at: anew(at), kept.factors, at)
        at = at._replace(error=error)
        size = size_of(dy)
        usable = jnp.isfinite(size)
        # a damping that this point itself asked for is kept; one left from a stale linearisation is not
        damping = jnp.where(search.fresh, 1.0, jnp.maximum(search.damping, 0.25))
        search = _Search(
            at, dy, dxi, size, damping, search.corrections,
            fresh=~old, go=usable & (at.error > options.tolerance), dead=~usable & ~old,
        )  # fmt: skip
        search = jax.lax.while_loop(lambda s: s.go, lambda s: correct(factors, old, s), search)
        # what an old linearisation did not solve says nothing of the damping that a new one needs
        search = search._replace(fresh=search.fresh | old)
        kept = None if kept is None else Kept(factors, jnp.array(False))
        return search, jnp.where(old, count, count + 1), kept

    def unsolved(state: tuple[_Search, Any, Kept | None]) -> Any:
        search, count, _ = state
        return (search.at.error > options.tolerance) & (count < options.max_linearisations) & ~search.dead

    first = _Search(
        Iterate(_with_base(problem, y, unknowns), unknowns, jnp.array(jnp.inf)),
        jnp.zeros_like(y), jnp.zeros_like(unknowns), size=jnp.array(0.0), damping=jnp.array(1.0),
        corrections=jnp.array(0), fresh=jnp.array(True), go=jnp.array(True), dead=jnp.array(False),
    )  # fmt: skip
    search, count, kept = jax.lax.while_loop(unsolved, linearised, (first, jnp.array(0), kept))
    if kept is not None:
        kept = kept._replace(usable=search.at.error <= options.acceptable)
    return Solution(search.at.y, search.at.unknowns, search.at.error, search.corrections, count), kept
