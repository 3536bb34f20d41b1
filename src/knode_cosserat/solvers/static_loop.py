"""Compiled solution of static equilibria: no rates, no time step, no history."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from knode_cosserat.rods.system import System, unknowns_of
from knode_cosserat.solvers.boundary import Kept, newton
from knode_cosserat.solvers.evaluation import map_robots
from knode_cosserat.solvers.grid import grid_of
from knode_cosserat.solvers.history import unloaded
from knode_cosserat.solvers.problem import StepProblem
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.time_loop import (
    StepRows,
    no_factors,
    no_rows,
    solve_until_failure,
    solved_row,
)


def unloaded_shape(system: System, space: SpaceScheme) -> Float[Any, "points y"]:
    """Return y at all points of the unloaded robot, or of a batch of robots."""
    if jnp.ndim(system.length):
        return map_robots(lambda one: unloaded_shape(one, space), system)
    return unloaded(system, space)[1][: grid_of(system).tip + 1, : system.y_layout.size]


def static_loop(
    system: System, settings: Settings, controls: Any, y: Float[Any, "points y"], span: tuple[Any, Any]
) -> tuple[Any, Float[Any, "points y"], StepRows]:  # fmt: skip
    """Solve the equilibria under controls (T, c) of a span in turn, each from the last, until one fails.

    The first starts from y at all points. Returns the number of equilibria done, the last y, and the rows.
    """

    def solve(y: Any, kept: Kept, i: Any) -> tuple[Any, StepRows, Kept]:
        problem = StepProblem.still(system, settings.space, controls[i]).ready()
        solution, kept = newton(problem, y, unknowns_of(system, y[0]), settings.newton, kept)
        return solution.y, solved_row(problem, settings.newton, solution, kept.factors)[0], kept

    kept = no_factors(system, settings, y, controls[0])
    return solve_until_failure(solve, y, kept, no_rows(system, controls.shape[:1]), *span)


@functools.partial(jax.jit, static_argnames="settings")
def static_one(system, settings, controls, y, span):  # type: ignore[no-untyped-def]
    """Run `static_loop` as a compiled program."""
    return static_loop(system, settings, controls, y, span)


@functools.partial(jax.jit, static_argnames="settings")
def static_many(system, settings, controls, y, stop):  # type: ignore[no-untyped-def]
    """Solve a batch as one compiled program: controls (B, T, c), and one system or a batch of them."""
    many = jnp.ndim(system.length) > 0

    def one(given: Any) -> Any:
        return static_loop(given[0] if many else system, settings, given[-2], given[-1], (0, stop))

    given = (system, controls, y) if many else (controls, y)
    return jax.lax.map(one, given)
