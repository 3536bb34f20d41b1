"""The paper's tendon-driven continuum robot: tendons push the rod sideways. Symbols as in `elastic_rod`."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Float

from knode_cosserat.rods.tendon_rod import TendonRod
from knode_cosserat.rods.tendons import transverse_force


class TendonRobot(TendonRod):
    """A round rod with tendons, gravity, drag and material damping, as in the paper.

    The tendons load the rod as in the paper (`tendons.transverse_force`): a force across it, no moment, so
    that `tendon_offset` does not matter. See `RoutedTendonRobot` for tendons that run beside the rod.
    """

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """Return the resultant of the tendons' forces per length (N/m), global frame: the paper's τ·φ."""
        force = self.actuator_force(control)
        count = self.actuator_layout.size
        return force if count == self.control_size else jnp.concatenate([force, control[count:]])

    def actuator_force(self, control: Float[Any, " c"]) -> Float[Any, "3"]:
        """Return the resultant of the tendons' forces per length (N/m), global frame: their only load."""
        return transverse_force(control[: self.actuator_layout.size], self.tendon_angles)
