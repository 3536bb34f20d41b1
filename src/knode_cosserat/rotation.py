"""Quaternions (scalar first), rotation matrices, and products of small matrices.

Every function acts on a single point of the rod; the solvers map it over nodes, tangents and batches.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

#: squared angle (rad²) below which series are used
SMALL = 1e-8

# `lax` directly, because indexing by brackets takes ten times as long to trace, and these are traced often


def _parts(vector: Any) -> list[Any]:
    return [lax.index_in_dim(vector, i, 0, keepdims=False) for i in range(vector.shape[0])]


def _columns(matrix: Any) -> list[Any]:
    return [lax.index_in_dim(matrix, i, 1, keepdims=False) for i in range(matrix.shape[1])]


def dot(matrix: Float[Any, "i j"], vector: Float[Any, " j"]) -> Float[Any, " i"]:
    """Return the product of a small matrix and a vector, written as a sum of scaled columns.

    XLA fuses this form with the arithmetic around it. A `matrix @ vector` becomes a separate kernel: the
    linearisation of the rod's equations then takes three times as long.
    """
    columns, factors = _columns(matrix), _parts(vector)
    total = columns[0] * factors[0]
    for column, factor in zip(columns[1:], factors[1:], strict=True):
        total = total + column * factor
    return total


def dot_by_rows(matrix: Float[Any, "i j"], vector: Float[Any, " j"]) -> Float[Any, " i"]:
    """Return the same product, computed row by row.

    If one matrix multiplies many vectors, such as tangents in all directions, XLA vectorises over these.
    """
    factors = _parts(vector)
    return jnp.stack(
        [sum(a * b for a, b in zip(_parts(row), factors, strict=True)) for row in _parts(matrix)]
    )


def cross(a: Float[Any, "3"], b: Float[Any, "3"]) -> Float[Any, "3"]:
    """Return the cross product: the paper's hat operator applied, a × b = â b."""
    (ax, ay, az), (bx, by, bz) = _parts(a), _parts(b)
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def rotation_matrix(h: Float[Any, "4"]) -> Float[Any, "3 3"]:
    """Return the rotation matrix of a quaternion of any length (scalar first), R = I + 2/(h·h) (…).

    The division by h·h makes R orthogonal although the integration in s never normalises h.
    """
    w, x, y, z = _parts(h)
    k = 2.0 / (w * w + x * x + y * y + z * z)
    return jnp.stack(
        [
            jnp.stack([1.0 - k * (y * y + z * z), k * (x * y - z * w), k * (x * z + y * w)]),
            jnp.stack([k * (x * y + z * w), 1.0 - k * (x * x + z * z), k * (y * z - x * w)]),
            jnp.stack([k * (x * z - y * w), k * (y * z + x * w), 1.0 - k * (x * x + y * y)]),
        ]
    )


def quaternion_rate(h: Float[Any, "4"], u: Float[Any, "3"]) -> Float[Any, "4"]:
    """Return the derivative of h along s for the curvature u in the material frame: h_s = ½ h ∘ (0, u)."""
    (w, x, y, z), (ux, uy, uz) = _parts(h), _parts(u)
    return 0.5 * jnp.stack(
        [
            -x * ux - y * uy - z * uz,
            w * ux + y * uz - z * uy,
            w * uy + z * ux - x * uz,
            w * uz + x * uy - y * ux,
        ]
    )


def quaternion_product(a: Float[Any, "4"], b: Float[Any, "4"]) -> Float[Any, "4"]:
    """Return the rotation by b, then by a: a ∘ b."""
    (aw, ax, ay, az), (bw, bx, by, bz) = _parts(a), _parts(b)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def conjugate(h: Float[Any, "*rows 4"]) -> Float[Any, "*rows 4"]:
    """Return the inverse rotation of a unit quaternion."""
    return h * np.array([1.0, -1.0, -1.0, -1.0])


def since_first(h: Float[Any, "T M 4"]) -> Float[Any, "T M 4"]:
    """Return rotations, in the global frame, since the first row; NaN where either is not known."""
    h = jnp.asarray(h)
    first = jnp.broadcast_to(jax.vmap(conjugate)(h[0]), h.shape)
    return jax.vmap(jax.vmap(quaternion_product))(h, first)


def _half(vector: Float[Any, "3"]) -> tuple[Any, Any, Any]:
    """Return cos(angle / 2), sin(angle / 2) / angle, and angle², with the vector's length as the angle."""
    square = jnp.sum(vector * vector)
    small = square < SMALL
    # the root of zero has no derivative
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    over = jnp.where(small, 0.5 - square / 48.0, jnp.sin(angle / 2.0) / angle)
    return jnp.where(small, 1.0 - square / 8.0, jnp.cos(angle / 2.0)), over, square


def quaternion_of(vector: Float[Any, "3"]) -> Float[Any, "4"]:
    """Return the quaternion of a rotation vector (rad)."""
    real, over, _ = _half(vector)
    return jnp.concatenate([real[None], over * vector])


def rotate(h: Float[Any, "4"], vector: Float[Any, "3"]) -> Float[Any, "3"]:
    """Return a vector rotated by a quaternion of any length."""
    return dot(rotation_matrix(h), vector)


def mean_turned(turn: Float[Any, "3"], vector: Float[Any, "3"]) -> Float[Any, "3"]:
    """Return the mean of a vector over the rotation by `turn` (rad) at a constant rate."""
    real, over, square = _half(turn)
    small = square < SMALL
    # (1 - sin(angle) / angle) / angle²
    third = jnp.where(
        small, 1 / 6 - square / 120.0, (1.0 - 2.0 * over * real) / jnp.where(small, 1.0, square)
    )
    across = cross(turn, vector)
    return vector + 2.0 * over * over * across + third * cross(turn, across)


def inverse(matrix: Float[Any, "3 3"]) -> Float[Any, "3 3"]:
    """Return the inverse of a regular 3×3 matrix, by cofactors.

    Its rounding errors grow with the square of the condition number at worst. Stiffness and damping are
    diagonal or nearly so. Elimination, whose errors grow with the condition number, took 3 % longer for a
    robot with real tendons.
    """
    columns = _columns(matrix)
    cofactors = jnp.stack(
        [cross(columns[1], columns[2]), cross(columns[2], columns[0]), cross(columns[0], columns[1])]
    )
    return cofactors / jnp.sum(columns[0] * cofactors[0])


def small_inverse(matrix: Float[Any, "n n"]) -> Float[Any, "n n"]:
    """Return the inverse of a small matrix; a 6×6 matrix must have a regular upper left block of 3×3.

    It is written out because XLA fuses it: at this size the library's factorisation is several times slower.
    """
    if matrix.shape[0] != 6:
        return jnp.linalg.inv(matrix)
    A, B, C, D = matrix[:3, :3], matrix[:3, 3:], matrix[3:, :3], matrix[3:, 3:]

    def product(one: Any, other: Any) -> Any:
        return jnp.stack([dot(one, column) for column in _columns(other)], axis=1)

    inverse_A = inverse(A)
    across = product(inverse_A, B)
    rest = inverse(D - product(C, across))
    down = product(rest, product(C, inverse_A))
    upper = jnp.concatenate([inverse_A + product(across, down), -product(across, rest)], axis=1)
    return jnp.concatenate([upper, jnp.concatenate([-down, rest], axis=1)], axis=0)
