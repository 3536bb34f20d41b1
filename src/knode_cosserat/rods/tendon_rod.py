"""A rod bent by tendons: the base of all tendon models. Symbols as in `elastic_rod`."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.parts import Contribution
from knode_cosserat.rods.rod import Rod
from knode_cosserat.rods.routing import OffsetPaths, RoutedPaths
from knode_cosserat.rods.tendon_parts import PulledTendons

#: angles of the paper's four tendons about the rod, π/4 + iπ/2
FOUR_TENDONS = tuple(np.pi / 4 + i * np.pi / 2 for i in range(4))


class TendonRod(Rod):
    """A rod with tendons around it. A subclass defines the part `tendons`, their action on the rod."""

    tendon_offset: Any = parameter(
        "m", "distance of the tendons from the rod's axis; the paper's tendon-robot ignores it", low=0.0,
        high=1.0, default=0.0,
    )  # fmt: skip
    tendon_angles: Any = parameter(
        "rad", "angles of the tendons about the rod", shape="list", low=-10.0, high=10.0, default=FOUR_TENDONS
    )

    @property
    def tendons(self) -> PulledTendons:
        """Tendons, with their controls and their action on the rod."""
        return PulledTendons(self.tendon_count)

    def list_parts(self) -> dict[str, Contribution]:
        """Return the tendons, and the parts of the rod."""
        return {"tendons": self.tendons} | super().list_parts()

    @property
    def paths(self) -> OffsetPaths | RoutedPaths:
        """Paths of the tendons; straight by default."""
        return OffsetPaths(self.tendon_offset, self.tendon_angles, None, self.length)

    @property
    def tendon_count(self) -> int:
        """Number of tendons."""
        return len(self.paths.ends)

    @property
    def tendon_ends(self) -> tuple[float, ...]:
        """Places where the tendons end, as fractions of the length."""
        return self.paths.ends

    @property
    def moment_arm(self) -> float | None:
        """Largest distance (m) of a tendon from the axis at the base; None if that does not bend the rod."""
        return None

    def routes_at(self, s: Any) -> tuple[Float[Any, "c 3"], Float[Any, "c 3"]]:
        """Return the tendons' places r (m) in the cross-section at s (m), and r′."""
        return self.paths.routes(s)
