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
import jax.numpy as jnp
import numpy as np
import scipy.linalg

import knode_cosserat as kc
from knode_cosserat.rods.system import unknowns_of
from knode_cosserat.schemes.problem import StepProblem
from knode_cosserat.schemes.settings import schemes
from knode_cosserat.schemes.space import SpaceScheme

#: part of the load by which its derivative is taken
STEP = 1e-4


@functools.partial(jax.jit, static_argnames="space")
def _tip_response(system: Any, control: Any, y: Any, space: Any) -> Any:
    problem = StepProblem.still(system, space, control)
    y = problem.filled(y)
    # a piece depends on its ends only: points of even number move together, and so do the others
    odd, pieces = np.arange(len(y)) % 2, np.arange(len(y) - 1)
    moves = np.eye(2)[:, odd][:, None, :, None] * np.eye(y.shape[1])[:, None]
    slopes = jax.vmap(jax.vmap(lambda move: jax.jvp(problem.reached, (y,), (move,))[1], out_axes=-1))(moves)
    by_start, by_end = slopes[odd[:-1], pieces], slopes[odd[1:], pieces]
    by_start = jnp.linalg.solve(jnp.eye(y.shape[1]) - by_end, by_start)
    base = jax.jacfwd(problem.base)(unknowns_of(system, y[0]))
    last, _ = jax.lax.scan(lambda X, F: (F @ X, None), base, by_start)
    return jax.jacfwd(problem.tip_residual)(y[-1]) @ last


def tip_response(rest: kc.Trajectory, space: str = "lobatto4") -> np.ndarray:
    """A = ∂tip/∂ξ at an equilibrium (a trajectory of one row)."""
    return np.asarray(_tip_response(rest.system, rest.control[-1], rest.y[-1], schemes(SpaceScheme)[space]()))


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
