"""Relaxation of the material by a Maxwell branch: a spring in series with a dashpot (standard linear solid).

The branch acts in parallel with the elastic law. Its spring has the stiffness r K, and its dashpot the strain
z_i,

    K (z - z*) + B z_t + r K (z - z_i) = Rᵀ (n, m),      T z_i,t = z - z_i,

with the relaxation time T. The stiffness is (1 + r) K in fast motion, and K at rest.
"""

from __future__ import annotations

from typing import Any, ClassVar

from jaxtyping import Float

from knode_cosserat.rods.law import MaxwellBranch
from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.parts import Part


class Relaxation(Part):
    """Relaxation of bending and twisting; z then has the curvature of the branch's dashpot."""

    kind: ClassVar[str] = "relaxation"

    stiffness: Any = parameter(
        "", "r, stiffness of the Maxwell branch over the stiffness at rest", low=0.0, high=1e3
    )
    time: Any = parameter("s", "T, relaxation time of the branch", low=1e-6, high=1e6, default=1.0)

    def branch(self, Kbt: Float[Any, "3 3"]) -> MaxwellBranch:
        """Return the branch beside the law of bending and twisting with this stiffness (N m²)."""
        return MaxwellBranch("u_branch", self.stiffness * Kbt, self.time)
