"""Histories of a robot that rests, or stays in one state."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.engine.pattern import values_along
from knode_cosserat.rods.kept import kept
from knode_cosserat.rods.system import System, array_module, is_traced
from knode_cosserat.schemes.grid import at_places, grid_of
from knode_cosserat.schemes.history import StateHistory, repeated_record_history
from knode_cosserat.schemes.problem import Evaluated, StepProblem, row_of
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.schemes.space import LOBATTO2, SpaceScheme

#: a row counts as an equilibrium of its grid if its residuals are at most this (natural units); it is larger
#: than the solver's `acceptable`
SOLVED = 2e-8


def unloaded_state(
    system: System, space: SpaceScheme
) -> tuple[Float[Any, "... nodes x"], Float[Any, "... places x"]]:
    """Return y and z of the unloaded system, or of a batch of robots, at the nodes and at all places."""
    along = np.concatenate([np.linspace(0.0, 1.0, system.nodes), grid_of(system, space).along])
    if is_traced(system):
        if np.ndim(system.length):
            return map_robots(lambda one: unloaded_state(one, space), system)
        found: Any = jnp.concatenate(jax.vmap(system.rest)(along * system.length), axis=1)
    else:
        rest = values_along(_rest, system, np.multiply.outer(system.length, along))
        found = np.concatenate(rest, axis=-1)
    return found[..., : system.nodes, :], found[..., system.nodes :, :]


def unloaded_shape(system: System, space: SpaceScheme) -> Any:
    """Return y at all points (points, y) of the unloaded robot, or of a batch of robots."""
    return unloaded_state(system, space)[1][..., : grid_of(system).tip + 1, : system.y_layout.size]


def map_robots(function: Callable[..., Any], system: System, *arguments: Any) -> Any:
    """Return the results of a function for each robot of a batch, with its part of the arguments."""
    if is_traced((system, arguments)):
        return jax.vmap(function)(system, *arguments)
    leaves, structure = jax.tree.flatten((system, *arguments))
    leaves = [np.asarray(leaf) for leaf in leaves]
    robots = [jax.tree.unflatten(structure, own) for own in zip(*leaves, strict=True)]
    return jax.tree.map(lambda *parts: np.stack(parts), *(function(*own) for own in robots))


def _rest(system: System, s: Any, _: Any) -> Any:
    return system.rest(s)


@kept
def rest_record(system: System) -> Float[Any, "... nodes x"]:
    """Return y and z (nodes, y + z) of the system at rest, or of a batch of robots."""
    return unloaded_state(system, LOBATTO2)[0]


@kept
def resting_history(system: System, settings: Settings) -> StateHistory:
    """Return the history of the robot at rest under zero control, at time 0, or of a batch of robots."""
    if system.mixed:
        control = np.zeros(system.control_layout.size)

        def begun(one: System) -> StateHistory:
            return constant_history(one, settings, rest_record(one), control)

        return map_robots(begun, system) if np.ndim(system.length) else begun(system)
    _, records = unloaded_state(system, settings.space)
    y = records[..., : grid_of(system).tip + 1, : system.y_layout.size]
    return repeated_record_history(system, settings, records, y, 0.0)


@functools.partial(jax.jit, static_argnames="settings")
def constant_history(
    system: System, settings: Settings, row: Any, control: Any, t0: Any = 0.0
) -> StateHistory:
    """Return a history in which all earlier states equal one state, given by y and z at the nodes.

    Between nodes, an equilibrium under this control is evaluated from its equations; any other state is
    interpolated.
    """
    still = StepProblem.still(system, settings.space, control, t0)
    found = still.evaluated(row[:, : system.y_layout.size])
    records = still_records(system, settings.space, row, found)
    return repeated_record_history(system, settings, records, found.y, t0)


def still_records(
    system: System, space: SpaceScheme, row: Float[Any, "nodes x"], still: Evaluated
) -> Float[Any, "places x"]:
    """Return records of a row at all places.

    They are those of the state at rest if the row is an equilibrium. If not, they are interpolated.
    """
    numeric = array_module((system, row, still))
    ny, own = system.y_layout.size, row_of(system, still.y, still.records)
    nodes = numeric.concatenate([row, own[:, row.shape[1] :]], axis=1)
    # the strains must also equal the equilibrium's: otherwise the state moves
    bent = numeric.max(abs(nodes - own)[:, ny:]) <= SOLVED * (1.0 + numeric.max(abs(own[:, ny:])))
    solved = (still.error <= SOLVED) & bent
    return numeric.where(solved, still.records, at_places(system, space, nodes))
