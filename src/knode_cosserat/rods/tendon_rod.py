"""A rod bent by tendons: the base of all tendon models. Symbols as in `elastic_rod`."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.rod import Rod

#: angles of the paper's four tendons about the rod, π/4 + iπ/2
FOUR_TENDONS = tuple(np.pi / 4 + i * np.pi / 2 for i in range(4))


class TendonRod(Rod):
    """A rod with straight tendons around it. A subclass defines the tendons' action on the rod."""

    tendon_offset: Any = parameter(
        "m", "distance of the tendons from the rod's axis; the paper's tendon-robot ignores it", low=0.0,
        high=1.0, default=0.0,
    )  # fmt: skip
    tendon_angles: Any = parameter(
        "rad", "angles of the tendons about the rod", shape="list", low=-10.0, high=10.0, default=FOUR_TENDONS
    )

    @property
    def actuator_layout(self) -> Layout:
        """One tension per tendon."""
        return Layout(("tension", np.shape(self.tendon_angles)[-1], "N", "tendon tension"))

    @property
    def tendon_count(self) -> int:
        """Number of tendons."""
        return int(np.shape(self.tendon_angles)[-1])

    @property
    def tendon_ends(self) -> tuple[float, ...]:
        """Places where the tendons end, as fractions of the length."""
        return (1.0,) * self.tendon_count

    @property
    def moment_arm(self) -> float | None:
        """Largest distance (m) of a tendon from the axis at the base; None if that does not bend the rod."""
        return None

    def routes_at(self, s: Any) -> tuple[Float[Any, "c 3"], Float[Any, "c 3"]]:
        """Return the tendons' places r in the cross-section at s (m), and r′; straight at their offset."""
        angles = jnp.asarray(self.tendon_angles)
        around = jnp.stack([jnp.cos(angles), jnp.sin(angles), jnp.zeros_like(angles)], axis=-1)
        return self.tendon_offset * around, np.zeros(around.shape)
