"""Loss of bending stiffness by tendons that are straight between ribs.

The tendons press on a bent rod between two ribs, a distance d apart, with the sum P of their tensions. The
rotation from rib to rib is that of a beam-column (Timoshenko & Gere 1961), with the effective bending
stiffness EI x cot x, x = d/2 √(P/EI). The loss is P d²/12 to leading order; the stiffness is zero where the
rod between two ribs buckles.

The distance is that of the ribs `at` stated places, from the clamped end on, or the same everywhere.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.law import Fields, MaterialLaw
from knode_cosserat.rods.parameters import ParameterError, parameter, places
from knode_cosserat.rods.parts import Part, RodPoint
from knode_cosserat.rods.tendon_parts import tension

#: below this the series of √w cot √w is exact to rounding
SMALL_PRESSURE = 1e-3
#: argument of `pressed` at which a beam-column buckles
BUCKLED = 0.25 * np.pi**2


class RibSpacing(Part):
    """Loss of bending stiffness under tension, because tendons are straight between ribs."""

    kind: ClassVar[str] = "rib-spacing"

    softening: Any = parameter(
        "m2",
        "loss of bending stiffness by small tensions, the same everywhere; d²/12 for ribs at a distance d",
        low=0.0,
        high=1e4,
        default=0.0,
    )
    at: tuple[float, ...] | None = places("where the ribs are, in order")
    share: Any = parameter(
        "", "loss between ribs at these places, over that of tendons that are straight there", low=0.0,
        high=10.0, default=1.0,
    )  # fmt: skip

    def __check_init__(self) -> None:
        super().__check_init__()
        if self.at is not None and not all(np.diff((0.0, *self.at)) > 0.0):
            raise ParameterError(
                f"at is {list(self.at)}; allowed is ribs in order, each beyond the one before"
            )

    def softening_at(self, sigma: Any) -> Any:
        """Return d²/12 over the squared length at σ, of the span between two ribs, times `share`.

        There are no tendons beyond the last rib.
        """
        if self.at is None:
            return 0.0
        ribs = np.array([0.0, *self.at])
        spans = np.append(np.diff(ribs) ** 2 / 12.0, 0.0)
        return self.share * jnp.asarray(spans)[jnp.sum(sigma >= ribs[1:])]

    @property
    def cuts(self) -> tuple[float, ...]:
        """Places of the ribs."""
        return self.at or ()

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law with the loss of bending stiffness.

        Tendons press on the bent rod, including its curvature at rest.
        """
        Kbt, length = law.strains["u"].softened, point.rod.length
        stiffness = 0.5 * (Kbt[0, 0] + Kbt[1, 1])
        softening = self.softening + self.softening_at(point.s / length) * length**2
        lost = 1.0 - pressed(3.0 * softening * jnp.sum(tension(point)) / stiffness)
        return law.with_strain("u", law.strains["u"].soften(lost * stiffness * np.diag([1.0, 1.0, 0.0])))


def pressed(w: Any) -> Any:
    """Return √w cot √w for w ≥ 0: the remaining fraction of a beam-column's stiffness under pressure.

    Beyond π²/4, where it buckles, the fraction continues below zero along the tangent.
    """
    small, buckled = w < SMALL_PRESSURE, w > BUCKLED
    root = jnp.sqrt(jnp.where(small | buckled, 1.0, w))
    series = 1.0 - w / 3.0 - w * w / 45.0 - 2.0 * w**3 / 945.0
    return jnp.where(small, series, jnp.where(buckled, 0.5 * (BUCKLED - w), root / jnp.tan(root)))
