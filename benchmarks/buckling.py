"""The load at which an equilibrium of a rod loses its stability, as the solver's own equations have it.

At an equilibrium the linearised equations say what the base's unknowns do to the tip's: A = ∂tip/∂ξ.
Where A is singular a second equilibrium branches off, or the path turns. The load where that is comes from
successive linear problems (Ruhe 1973), (A + μ dA/dload) ξ = 0, load += μ. They converge fast to multiple
roots too, which a round rod has by symmetry: there the determinant touches zero and keeps its sign.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import scipy.linalg

import knode_cosserat as kc
from knode_cosserat.rods.system import unknowns_of
from knode_cosserat.solvers.problem import StepProblem
from knode_cosserat.solvers.space import SCHEMES

#: part of the load by which its derivative is taken
STEP = 1e-4


@functools.partial(jax.jit, static_argnames="space")
def _tip_response(system: Any, control: Any, y: Any, space: Any) -> Any:
    problem = StepProblem.still(system, space, control)
    found = problem.linearise(problem.filled(y), unknowns_of(system, y[0]))
    last, _ = jax.lax.scan(lambda X, F_j: (F_j @ X, None), found.base, found.F)
    return found.tip @ last


def tip_response(rest: kc.Trajectory, space: str = "lobatto4") -> np.ndarray:
    """A = ∂tip/∂ξ at an equilibrium (a trajectory of one row)."""
    return np.asarray(_tip_response(rest.system, rest.control[-1], rest.y[-1], SCHEMES[space]))


def critical_load(
    equilibrium: Callable[[float], kc.Trajectory],
    guess: float,
    space: str = "lobatto4",
    corrections: int = 20,
) -> float:
    """The load near the guess at which `equilibrium(load)` has a neighbour under the same load."""
    load = guess
    for _ in range(corrections):
        step = STEP * abs(load)
        here, before, after = (tip_response(equilibrium(load + d), space) for d in (0.0, -step, step))
        mu = scipy.linalg.eigvals(here, -(after - before) / (2 * step))
        mu = mu[np.isfinite(mu)]
        change = float(mu[np.argmin(np.abs(mu))].real)
        load += change
        if abs(change) < 1e-10 * abs(load):
            return load
    raise ArithmeticError(f"no critical load was found near {guess:g}; the last trial is {load:g}")
