"""Distributed loads of a rod, per metre of arclength."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Float

from knode_cosserat.rotation import dot


def square_law_drag(C: Float[Any, "3 3"], q: Float[Any, "3"]) -> Float[Any, "3"]:
    """Drag C q ⊙ |q| against the velocity q, both in the material frame (N/m); C in kg/m²."""
    return dot(C, q * jnp.abs(q))
