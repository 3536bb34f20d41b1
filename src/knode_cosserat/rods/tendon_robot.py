"""The paper's tendon-driven continuum robot: tendons push the rod sideways. Symbols as in `elastic_rod`."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.loads import transverse_force
from knode_cosserat.rods.parts import RodPoint, Wrench
from knode_cosserat.rods.tendon_parts import PulledTendons
from knode_cosserat.rods.tendon_rod import TendonRod


@dataclasses.dataclass(frozen=True)
class TransverseTendons(PulledTendons):
    """Tendons that push the rod sideways."""

    angles: Float[Any, " c"]

    def load(self, point: RodPoint) -> Wrench:
        """Return the resultant of the tendons' forces per length."""
        return Wrench(transverse_force(point.input, self.angles), np.zeros(3))

    def actuation(self, rod: Any, control: Any) -> Float[Any, "3"]:
        """Return the resultant of the tendons' forces per length (N/m), global frame: the paper's τ·φ."""
        return transverse_force(control, self.angles)


class TendonRobot(TendonRod):
    """A round rod with tendons, gravity, drag and material damping, as in the paper.

    The tendons load the rod as in the paper (`transverse_force`): a force across it, no moment, so that
    `tendon_offset` does not matter. See `RoutedTendonRobot` for tendons that run beside the rod.
    """

    @property
    def tendons(self) -> TransverseTendons:
        """Tendons that push the rod sideways."""
        return TransverseTendons(self.tendon_count, self.tendon_angles)
