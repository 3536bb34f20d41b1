"""Compiled programs of environments; those of steps overwrite the states that they receive."""

from __future__ import annotations

import functools
from typing import Any

import jax

from knode_cosserat.envs import dynamics


@functools.partial(jax.jit, static_argnames="spec")
def reset(spec: Any, arrays: Any, keys: Any) -> Any:
    """Return states and observations at the starts of episodes, for keys (B, 2)."""
    return jax.vmap(lambda key: dynamics.reset(spec, arrays, key))(keys)


@functools.partial(jax.jit, static_argnames="spec", donate_argnames="states")
def step(spec: Any, arrays: Any, states: Any, actions: Any) -> Any:
    """Return the states of many episodes after one period under actions (B, c), and the transitions."""
    return dynamics.step_many(spec, arrays, states, actions)


@functools.partial(jax.jit, static_argnames="spec", donate_argnames="states")
def restart(spec: Any, arrays: Any, states: Any, where: Any, keys: Any) -> Any:
    """Return states with new episodes at some places, and their observations."""
    fresh, observations = jax.vmap(lambda key: dynamics.reset(spec, arrays, key))(keys)
    # places beyond the end are not written: they only fill up the number
    return jax.tree.map(lambda all, new: all.at[where].set(new, mode="drop"), states, fresh), observations
