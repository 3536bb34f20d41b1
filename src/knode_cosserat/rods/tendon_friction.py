"""What holds tendons in their holes, and what shakes them loose: two memories of a robot.

Friction. A tendon that slides loses tension on its way, as a rope on a capstan: τᵢ = Tᵢ exp(-λᵢ) with λᵢ_s
= fᵢ (k + μ |u|), the wobble coefficient k and the curvature friction coefficient μ. fᵢ, from -1 to 1, is
how much of the friction holds the tendon and which way. It is a memory, the part of z that remembers where
the robot has come from: it grows as the rod bends in the tendon's direction eᵢ, up to where the tendon
slides (an elastic, perfectly plastic element: Prandtl 1928)

    fᵢ_t = eᵢ·u_t / κ₀    while |fᵢ| < 1

so that a robot that is held stays where it is, whatever noise its tensions have. (Dahl's smooth law lets it
creep: with it a step of 10 s was predicted with three times the error.) An equilibrium, with all rates
zero, is the one without friction.

Vibration. Above some tension of all tendons together robots begin to shake, and what shakes does not stick:
x, from 0 to 1, is the part of the friction that is gone. It is a memory too, x_t = k_v (Σ Tᵢ - T_v), and
takes a part c x Σ Tᵢ of the rod's stiffness with it.

Rates are c0 times the value plus what the time scheme has of its past (`past`); c0 is 0 at rest.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Float

#: turns (1/m) below this hardly count in friction, so that it has a slope everywhere
STRAIGHT = 1e-2


def held(bending: Float[Any, " c"], past: Float[Any, " c"], c0: Any) -> Float[Any, " c"]:
    """fᵢ from eᵢ·u_t / κ₀ (1/s): none at rest."""
    return jnp.clip(_grown(bending, past, c0, at_rest=0.0), -1.0, 1.0)


def loss_rates(u: Float[Any, "3"], f: Float[Any, " c"], wobble: Any, curvature: Any) -> Float[Any, " c"]:
    """λᵢ_s (1/m) where the curvature is u (1/m) and f of the friction holds; k and μ may be None."""
    turn = jnp.sqrt(u[0] * u[0] + u[1] * u[1] + STRAIGHT**2) - STRAIGHT
    return (_or_zero(wobble) + _or_zero(curvature) * turn) * f


def shaking(growth: Any, past: Float[Any, " 1"], c0: Any) -> Float[Any, " 1"]:
    """x from its rate k_v (Σ Tᵢ - T_v) (1/s): at rest it has grown as far as it will."""
    return jnp.clip(_grown(growth, past, c0, at_rest=jnp.sign(growth)), 0.0, 1.0)


def _grown(rate: Any, past: Any, c0: Any, at_rest: Any) -> Any:
    """What a memory is by its rate, were there no bounds."""
    moving = c0 > 0.0
    return jnp.where(moving, (rate - past) / jnp.where(moving, c0, 1.0), at_rest)


def _or_zero(value: Any) -> Any:
    return 0.0 if value is None else value
