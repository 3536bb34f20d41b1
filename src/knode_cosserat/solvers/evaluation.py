"""States evaluated by the equations of a step, in the engine or inside JAX's transformations."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from knode_cosserat.engine import loops as engine
from knode_cosserat.rods.system import System, is_traced
from knode_cosserat.solvers.grid import grid_of
from knode_cosserat.solvers.history import unloaded
from knode_cosserat.solvers.problem import Evaluated, StepProblem, no_history
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import SpaceScheme


def evaluator(system: System, settings: Settings, traced: bool = False) -> Callable[..., Evaluated]:
    """Return a function that evaluates states.

    Its arguments are c0, the time (s), the control, history terms (places, x), and y at all points, or at the
    nodes. Inside JAX's transformations, all may be `traced`.
    """
    return (
        functools.partial(_evaluated, system, settings.space)
        if traced
        else engine.evaluator(system, settings)
    )


@functools.partial(jax.jit, static_argnames="space")
def _evaluated(
    system: System, space: SpaceScheme, c0: Any, t: Any, control: Any, history: Any, y: Any
) -> Evaluated:
    return StepProblem(system, t, control, c0, history, space).evaluated(y)


def map_robots(function: Callable[..., Any], system: System, *arguments: Any) -> Any:
    """Return the results of a function for each robot of a batch, with its part of the arguments."""
    if is_traced((system, arguments)):
        return jax.vmap(function)(system, *arguments)
    leaves, structure = jax.tree.flatten((system, *arguments))
    leaves = [np.asarray(leaf) for leaf in leaves]
    robots = [jax.tree.unflatten(structure, own) for own in zip(*leaves, strict=True)]
    return jax.tree.map(lambda *parts: np.stack(parts), *(function(*own) for own in robots))


def still_state(system: System, space: SpaceScheme, control: Any, y: Any, t: Any = 0.0) -> Evaluated:
    """Return the state at rest of y at all points, or at the nodes, under a control."""
    return evaluator(system, Settings(None, space))(0.0, t, control, no_history(system, space), y)


def unloaded_shape(system: System, space: SpaceScheme) -> Any:
    """Return y at all points (points, y) of the unloaded robot, or of a batch of robots."""
    if np.ndim(system.length):
        return map_robots(lambda one: unloaded_shape(one, space), system)
    return unloaded(system, space)[1][: grid_of(system).tip + 1, : system.y_layout.size]
