"""Distributed loads of a rod, per metre of arclength."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from knode_cosserat.rotation import dot


def square_law_drag(C: Float[Array, "3 3"], q: Float[Array, "3"]) -> Float[Array, "3"]:
    """Drag C q ⊙ |q| against the velocity q, both in the material frame (N/m); C in kg/m²."""
    return dot(C, q * jnp.abs(q))
