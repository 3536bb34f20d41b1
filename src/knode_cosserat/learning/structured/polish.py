"""Gauss-Newton refinement of the weights of a structured residual, on the segments.

If the scheme has stages, or a discontinuity is inside a segment, y at its end is not linear in the weights.
The nonzero weights from sparse regression are then refined together, to fit y at the segments' ends.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.samples import Dataset, Samples, predict_segment
from knode_cosserat.learning.structured.residual import Structured
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.space import SpaceScheme

MOST_ROUNDS = 8


def polished(
    knowledge: System, data: Dataset, residual: Structured, sizes: Float[Any, " y"], shares: Float[Any, " S"]
) -> Structured:
    """Return the residual with stretch and load weights refined to fit y at the segments' ends.

    `sizes` (y,) are the scales of the misfit.
    """
    weights, _ = ravel_pytree(_movable(residual))
    free = np.flatnonzero(np.asarray(weights))
    if not len(free):
        return residual
    root = np.sqrt(shares)[:, None] / sizes
    best = np.inf
    for _ in range(MOST_ROUNDS):
        left, slopes = _linearised(knowledge, residual, data.space, data.segments, free)
        left = np.asarray(left) * root
        error = float(np.sqrt(np.mean(left**2)))
        if not error < 0.9 * best:
            break
        best, kept = error, residual
        columns = (np.asarray(slopes) * root).reshape(len(free), -1).T
        move, *_ = np.linalg.lstsq(columns, left.ravel(), rcond=1e-14)
        residual = _moved(residual, free, move)
    return kept


def _movable(residual: Structured) -> Any:
    load = residual.load
    parts = [load.material, load.ambient] if load is not None else []
    return residual.stretch, [part.weights for part in parts if part is not None]


def _moved(residual: Structured, free: Any, move: Any) -> Structured:
    flat, unravel = ravel_pytree(jax.tree.map(jnp.asarray, _movable(residual)))
    stretch, weights = unravel(flat.at[free].add(move))
    load = residual.load
    if load is not None:
        remaining = iter(weights)
        parts = {
            name: dataclasses.replace(part, weights=next(remaining))
            for name in ("material", "ambient")
            if (part := getattr(load, name)) is not None
        }
        load = dataclasses.replace(load, **parts)
    return dataclasses.replace(residual, stretch=stretch, load=load)


@functools.partial(jax.jit, static_argnames="space")
def _linearised(
    knowledge: System, residual: Structured, space: SpaceScheme, data: Samples, free: Any
) -> tuple[Any, Any]:
    """Return the misfit of the segments (S, y), and the derivatives of y by each free weight (w, S, y)."""

    def reached(move: Any) -> Any:
        model = KNODE(knowledge, _moved(residual, free, move))
        return jax.vmap(lambda sample: predict_segment(model, space, sample)[0])(data)

    at = jnp.zeros(free.shape[0])
    here, along = jax.linearize(reached, at)
    return data.y_next - here, jax.vmap(along)(jnp.eye(free.shape[0]))
