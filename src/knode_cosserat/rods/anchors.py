"""Tendons that are anchored before the tip."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Float

from knode_cosserat.rods.parameters import parameter, place
from knode_cosserat.rods.parts import Part, RodPoint
from knode_cosserat.rods.tendon_parts import TendonContribution


class EarlyAnchors(TendonContribution, Part):
    """A place with early anchors: beyond it each tendon keeps a part of its tension, 0 if anchored there."""

    kind: ClassVar[str] = "early-anchors"

    at: float = place("where tendons are anchored")
    share: Any = parameter(
        "", "part of each tendon's tension beyond that place", shape="list", low=-1.0, high=2.0,
        default=(1.0, 1.0, 1.0, 1.0),
    )  # fmt: skip

    @property
    def cuts(self) -> tuple[float, ...]:
        """Place of the anchors."""
        return (self.at,)

    def running(self, point: RodPoint, values: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return each tendon's share of the values beyond that place."""
        return values * jnp.where(point.s < self.at * point.rod.length, 1.0, self.share)
