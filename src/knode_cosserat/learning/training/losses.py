"""Losses of one-segment predictions.

Arrays have numbers first and samples last, (numbers, S), like the outputs of a network.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.samples import Samples
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.system import System
from knode_cosserat.rotation import rotation_matrix

#: fields of y in the paper's loss
PAPER_FIELDS = ("p", "h", "n", "m", "q", "w")
#: a number whose spread is below this part of its field's largest is scaled by the field's spread
LEAST_PART = 1e-3
#: relative variation below which a field is constant
ROUNDING = 1e-12


class Loss(eqx.Module):
    """Loss of predictions relative to stored data; all trajectories have equal weight."""

    @abc.abstractmethod
    def __call__(self, y: Float[Any, "y S"], z: Float[Any, "z S"]) -> Float[Any, ""]:
        """Return the loss of y at the ends of all segments and z at their starts."""


class PaperLoss(Loss):
    """The paper's loss: the sum of four mean squares, with orientations as Euler angles.

    The four are positions, Euler angles, strains z, and n, m, q and ω together, all in SI units. Means are
    over the numbers of a step and over steps, sums over trajectories.
    """

    y: Float[Any, "y S"]
    z: Float[Any, "z S"]
    angles: Float[Any, "3 S"]
    weight: Float[Any, " S"]
    layout: Layout = eqx.field(static=True)

    def __call__(self, y: Float[Any, "y S"], z: Float[Any, "z S"]) -> Float[Any, ""]:
        """Return the loss (paper eq. 8, training loss), in mixed units."""
        p, h, *rest = (y[self.layout.slice(name)] for name in PAPER_FIELDS)
        p_true, _, *rest_true = (self.y[self.layout.slice(name)] for name in PAPER_FIELDS)
        squares = (
            _mean_square(p - p_true)
            + _mean_square(jnp.concatenate(rest) - jnp.concatenate(rest_true))
            + _mean_square(euler_angles(h) - self.angles)
            + _mean_square(z - self.z)
        )
        return jnp.sum(self.weight * squares)


class StandardisedLoss(Loss):
    """Mean square of all errors, each over its own spread, for any system.

    Errors of y are scaled by the spread of its increments over a segment, errors of z by the spread of z.
    """

    y: Float[Any, "y S"]
    z: Float[Any, "z S"]
    y_spread: Float[Any, " y"]
    z_spread: Float[Any, " z"]
    weight: Float[Any, " S"]

    def __call__(self, y: Float[Any, "y S"], z: Float[Any, "z S"]) -> Float[Any, ""]:
        """Return the loss (dimensionless)."""
        errors = [(y - self.y) / self.y_spread[:, None], (z - self.z) / self.z_spread[:, None]]
        return jnp.sum(self.weight * _mean_square(jnp.concatenate(errors)))


def loss_for(name: str, knowledge: System, segments: Samples) -> Loss:
    """Return the "paper" loss if y has the fields for it, otherwise the "standardised" loss."""
    y, z = segments.y_next.T, segments.z.T
    if name == "paper" and set(PAPER_FIELDS) <= set(knowledge.y_layout.names):
        angles = np.asarray(_angles(y[knowledge.y_layout.slice("h")]))
        return PaperLoss(y, z, angles, segments.weight, knowledge.y_layout)
    increments = segments.y_next - segments.y
    return StandardisedLoss(
        y,
        z,
        value_scales(increments, field_sizes(knowledge.y_layout)),
        value_scales(segments.z, field_sizes(knowledge.z_layout)),
        segments.weight,
    )


def euler_angles(h: Float[Any, "4 S"]) -> Float[Any, "3 S"]:
    """Return angles (rad) of quaternions (scalar first, any length) about the fixed z, then y, then x axis.

    The order is SciPy's "zyx". If the second angle is ±π/2 they are not unique, and have no derivative.
    """
    R = jax.vmap(rotation_matrix, in_axes=-1, out_axes=-1)(h)
    return jnp.stack(
        [
            jnp.arctan2(-R[0, 1], R[0, 0]),
            jnp.arcsin(jnp.clip(R[0, 2], -1.0, 1.0)),
            jnp.arctan2(-R[1, 2], R[2, 2]),
        ]
    )


_angles = jax.jit(euler_angles)


def field_sizes(layout: Layout) -> list[int]:
    """Return the size of each field."""
    return [field.size for field in layout.fields]


def value_scales(values: Float[Any, "S x"], fields: Sequence[int]) -> Float[np.ndarray, " x"]:
    """Return the standard deviation of every number, never zero, as a scale of errors, noise and inputs.

    Args:
        values: one row a sample.
        fields: size of each field, in order. A number that hardly varies, such as a force normal to the plane
            of motion, gets a part of its field's largest; the numbers of a constant field get one.
    """
    found = []
    for part in np.split(np.asarray(values), np.cumsum(fields)[:-1], axis=1):
        deviation = np.std(part, axis=0)
        largest = deviation.max(initial=0.0)
        varies = largest > ROUNDING * max(1e-3, np.abs(part).max(initial=0.0))
        found.append(np.maximum(deviation, LEAST_PART * largest) if varies else np.ones_like(deviation))
    return np.concatenate(found)


def _mean_square(errors: Float[Any, "x S"]) -> Float[Any, " S"]:
    return jnp.mean(errors * errors, axis=0)
