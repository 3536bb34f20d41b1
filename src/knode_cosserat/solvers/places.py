"""Poses at places on the rod that need not be nodes."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.rods.system import System


class Places(NamedTuple):
    """M places: after which node, and by which part of the way to the next."""

    node: Int[Any, " M"]
    part: Float[Any, " M"]


def places_at(fractions: Float[np.ndarray, " M"], nodes: int) -> Places:
    """Where fractions of the rod's length lie among its nodes; beyond the ends, at the ends."""
    along = np.clip(fractions, 0.0, 1.0) * (nodes - 1)
    node = np.clip(np.ceil(along - 1e-9).astype(int) - 1, 0, nodes - 2)
    return Places(node, along - node)


def positions_at(robot: System, y: Float[Any, "T N y"], places: Places) -> Float[Any, "T M 3"]:
    """Positions (m), between nodes on a line: as Euler's method has it."""
    low, high = (robot.positions(y[..., places.node + k, :]) for k in (0, 1))
    part = places.part[:, None]
    return (1.0 - part) * low + part * high


def quaternions_at(robot: System, y: Float[Any, "T N y"], places: Places) -> Float[Any, "T M 4"]:
    """Orientations, scalar first and of length one, between nodes on the short way."""
    low, high = (robot.quaternions(y[..., places.node + k, :]) for k in (0, 1))
    same = jnp.sum(low * high, axis=-1, keepdims=True) >= 0.0
    part = places.part[:, None]
    h = (1.0 - part) * low + part * jnp.where(same, high, -high)
    return h / jnp.sqrt(jnp.sum(h * h, axis=-1, keepdims=True))
