"""A viscoelastic rod, such as rubber: it creeps, and is stiffer in fast motion (see `relaxation`)."""

from __future__ import annotations

from typing import Any, ClassVar

from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.parts import Contribution
from knode_cosserat.rods.relaxation import Branches
from knode_cosserat.rods.slender_rod import SlenderRod


class RodBranches(Branches):
    """Maxwell branches beside all strains."""

    strains: ClassVar[tuple[str, ...]] = ("v", "u")

    def __init__(self, stiffness: Any, time: Any):
        self.stiffness, self.time = stiffness, time


class ViscoelasticRod(SlenderRod):
    """A slender rod with a relaxing material; with `branch_stiffness` 0 it is a `SlenderRod`."""

    branch_stiffness: Any = parameter(
        "", "stiffness of the Maxwell branch over the stiffness at rest", low=0.0, high=1e3, default=0.0
    )
    relaxation_time: Any = parameter("s", "relaxation time of that branch", low=1e-6, high=1e6, default=1.0)

    def list_parts(self) -> dict[str, Contribution]:
        """Return the parts of the rod, and the Maxwell branches."""
        return super().list_parts() | {"branches": RodBranches(self.branch_stiffness, self.relaxation_time)}
