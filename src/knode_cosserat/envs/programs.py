"""Compiled programs of environments."""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np

from knode_cosserat.envs import dynamics
from knode_cosserat.rods.system import is_traced


@functools.partial(jax.jit, static_argnames="spec")
def reset(spec: Any, arrays: Any, keys: Any) -> Any:
    """Return states and observations at the starts of episodes, for keys (B, 2)."""
    return jax.vmap(lambda key: dynamics.reset(spec, arrays, key))(keys)


def step(spec: Any, arrays: Any, states: Any, actions: Any) -> Any:
    """Return the states of many episodes after one period under actions (B, c), and the transitions."""
    if is_traced((arrays, states, actions)):
        return dynamics.step_many(spec, arrays, states, actions)
    moves = _moved(spec, arrays, states, actions)
    systems = arrays.robot if spec.is_shared else moves.system
    task, acting = dynamics.task_of(spec), np.asarray(moves.acting)[:, None]
    _, histories, rows = task.solve_many(systems, acting, moves.state.history)
    return _arrived(spec, arrays, moves, histories, rows)


_moved = jax.jit(dynamics.moved, static_argnames="spec")
_arrived = jax.jit(dynamics.arrived, static_argnames="spec")


@functools.partial(jax.jit, static_argnames="spec", donate_argnames="states")
def restart(spec: Any, arrays: Any, states: Any, where: Any, keys: Any) -> Any:
    """Return states with new episodes at some places, and their observations."""
    fresh, observations = jax.vmap(lambda key: dynamics.reset(spec, arrays, key))(keys)
    # places beyond the end are not written: they only fill up the number
    return jax.tree.map(lambda all, new: all.at[where].set(new, mode="drop"), states, fresh), observations
