"""A rod bent by tendons: the base of all tendon models. Symbols as in `elastic_rod`."""

from __future__ import annotations

from typing import Any

import numpy as np

from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.rod import Rod

#: angles of the paper's four tendons about the rod, π/4 + iπ/2
FOUR_TENDONS = tuple(np.pi / 4 + i * np.pi / 2 for i in range(4))


class TendonRod(Rod):
    """A rod with straight tendons around it. A subclass defines the tendons' action on the rod."""

    tendon_offset: Any = parameter(
        "m", "distance of the tendons from the rod's axis; of no use to the crude model", low=0.0, high=1.0,
        default=0.0,
    )  # fmt: skip
    tendon_angles: Any = parameter(
        "rad", "angles of the tendons about the rod", shape="list", low=-10.0, high=10.0, default=FOUR_TENDONS
    )

    @property
    def actuator_layout(self) -> Layout:
        """One tension per tendon."""
        return Layout(("tension", np.shape(self.tendon_angles)[-1], "N", "tendon tension"))
