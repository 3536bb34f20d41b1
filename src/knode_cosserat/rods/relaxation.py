"""Relaxation of the material by a Maxwell branch: a spring in series with a dashpot (standard linear solid).

The branch acts in parallel with the elastic law. Its spring has the stiffness r K, and its dashpot the strain
z_i,

    K (z - z*) + B z_t + r K (z - z_i) = Rᵀ (n, m),      T z_i,t = z - z_i,

with the relaxation time T. The stiffness is (1 + r) K in fast motion, and K at rest.
"""

from __future__ import annotations

from typing import Any, ClassVar

from jaxtyping import Float

from knode_cosserat.rods.law import Fields, MaterialLaw, MaxwellBranch
from knode_cosserat.rods.parameters import choice, parameter
from knode_cosserat.rods.parts import Effect, RodPoint

MEANINGS = {"v": ("1", "v of the dashpot"), "u": ("1/m", "curvature of the dashpot")}


class Relaxation(Effect):
    """Relaxation of bending and twisting, or of all strains; z then has the strains of the dashpots."""

    kind: ClassVar[str] = "relaxation"

    stiffness: Any = parameter(
        "", "r, stiffness of the Maxwell branch over the stiffness at rest", low=0.0, high=1e3
    )
    time: Any = parameter("s", "T, relaxation time of the branch", low=1e-6, high=1e6, default=1.0)
    shear: bool = choice("true if shear and extension relax too", (False, True), False)

    @property
    def strains(self) -> tuple[str, ...]:
        """Names of the strains with a branch."""
        return ("v", "u") if self.shear else ("u",)

    def z_fields(self, rod: Any) -> tuple[tuple[Any, ...], ...]:
        """Return the dashpots' strains."""
        return tuple(
            (f"{name}_branch", 3, MEANINGS[name][0], f"{MEANINGS[name][1]} of the Maxwell branch")
            for name in self.strains
        )

    def rest_z(self, rod: Any, strains: Float[Any, "6"]) -> Fields:
        """Return the strains of relaxed dashpots: those of the rod."""
        return {f"{name}_branch": rod.z_layout.get(strains, name) for name in self.strains}

    def law(self, point: RodPoint, law: MaterialLaw, internal: Fields) -> MaterialLaw:
        """Return the law with the branches."""
        for name in self.strains:
            strain = law.strains[name]
            branch = MaxwellBranch(f"{name}_branch", self.stiffness * strain.stiffness, self.time)
            law = law.with_strain(name, strain._replace(branch=branch))
        return law
