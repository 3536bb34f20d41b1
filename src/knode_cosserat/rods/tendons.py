"""The paper's model of the load of tendons on a rod."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Float


def transverse_force(tension: Float[Any, " tendons"], angles: Float[Any, " tendons"]) -> Float[Any, "3"]:
    """Return the load of the paper's crude model: f = Σ τᵢ dᵢ per metre of rod (N/m), in the global frame.

    dᵢ is the unit vector at the tendon's angle (rad) in the global x-y plane. The force does not rotate with
    the rod and there is no moment: the paper's τ·φ. Tension in N.
    """
    return jnp.stack([jnp.sum(tension * jnp.cos(angles)), jnp.sum(tension * jnp.sin(angles)), jnp.zeros(())])
