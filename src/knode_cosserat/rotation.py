"""Quaternions (scalar first), rotation matrices, and products of small matrices.

Everything here acts on a single point of the rod; the solvers map it over nodes, tangents and batches.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Float


def dot(matrix: Float[Any, "i j"], vector: Float[Any, " j"]) -> Float[Any, " i"]:
    """Product of a small matrix and a vector, written as a sum of scaled columns.

    XLA fuses this form with the arithmetic around it. A `matrix @ vector` becomes a kernel of its own:
    the linearisation of the rod's equations then takes three times as long.
    """
    total = matrix[:, 0] * vector[0]
    for column in range(1, matrix.shape[1]):
        total = total + matrix[:, column] * vector[column]
    return total


def cross(a: Float[Any, "3"], b: Float[Any, "3"]) -> Float[Any, "3"]:
    """Cross product: the paper's hat operator applied, a × b = â b."""
    return jnp.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
    )


def rotation_matrix(h: Float[Any, "4"]) -> Float[Any, "3 3"]:
    """Rotation matrix of a quaternion of any length (scalar first), R = I + 2/(h·h) (…).

    The division by h·h makes R orthogonal although the integration in s never normalises h.
    """
    w, x, y, z = h[0], h[1], h[2], h[3]
    k = 2.0 / (w * w + x * x + y * y + z * z)
    return jnp.stack(
        [
            jnp.stack([1.0 - k * (y * y + z * z), k * (x * y - z * w), k * (x * z + y * w)]),
            jnp.stack([k * (x * y + z * w), 1.0 - k * (x * x + z * z), k * (y * z - x * w)]),
            jnp.stack([k * (x * z - y * w), k * (y * z + x * w), 1.0 - k * (x * x + y * y)]),
        ]
    )


def quaternion_rate(h: Float[Any, "4"], u: Float[Any, "3"]) -> Float[Any, "4"]:
    """Derivative of h along s for the curvature u in the material frame: h_s = ½ h ∘ (0, u)."""
    w, x, y, z = h[0], h[1], h[2], h[3]
    return 0.5 * jnp.stack(
        [
            -x * u[0] - y * u[1] - z * u[2],
            w * u[0] + y * u[2] - z * u[1],
            w * u[1] + z * u[0] - x * u[2],
            w * u[2] + x * u[1] - y * u[0],
        ]
    )


def quaternion_product(a: Float[Any, "4"], b: Float[Any, "4"]) -> Float[Any, "4"]:
    """Hamilton product a ∘ b (rotate by b first, then by a)."""
    return jnp.concatenate(
        [
            (a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3])[None],
            a[0] * b[1:] + b[0] * a[1:] + cross(a[1:], b[1:]),
        ]
    )


def inverse(matrix: Float[Any, "3 3"]) -> Float[Any, "3 3"]:
    """Inverse of a 3×3 matrix by cofactors: for stiffness matrices, symmetric and positive."""
    columns = [matrix[:, i] for i in range(3)]
    cofactors = jnp.stack(
        [cross(columns[1], columns[2]), cross(columns[2], columns[0]), cross(columns[0], columns[1])]
    )
    return cofactors / jnp.sum(columns[0] * cofactors[0])
