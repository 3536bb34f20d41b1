"""A viscoelastic rod, such as rubber: it creeps, and is stiffer in fast motion (see `relaxation`)."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Float

from knode_cosserat.rods.elastic_rod import ElasticRod
from knode_cosserat.rods.law import MaterialLaw, MaxwellBranch
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.slender_rod import SlenderRod


class ViscoelasticRod(SlenderRod):
    """A slender rod with a relaxing material; with `branch_stiffness` 0 it is a `SlenderRod`."""

    z_layout: ClassVar[Layout] = ElasticRod.z_layout + Layout(
        ("v_branch", 3, "1", "v of the dashpot of the Maxwell branch"),
        ("u_branch", 3, "1/m", "u of the dashpot of the Maxwell branch"),
    )

    branch_stiffness: Any = parameter(
        "", "stiffness of the Maxwell branch over the stiffness at rest", low=0.0, high=1e3, default=0.0
    )
    relaxation_time: Any = parameter("s", "relaxation time of that branch", low=1e-6, high=1e6, default=1.0)

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return the unloaded state at rest, with a relaxed branch."""
        y, z = super().rest(s)
        return y, jnp.concatenate([z, z])

    def unstressed(self, s: Any, control: Any) -> Float[Any, " z"]:
        """Return the strains without stress, with a relaxed branch."""
        z = super().unstressed(s, control)[:6]
        return jnp.concatenate([z, z])

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """Return the elastic rod's law with a Maxwell branch for each strain."""
        law = self.linear_law(s, y, control)
        r, time = self.branch_stiffness, self.relaxation_time
        return MaterialLaw(
            {
                name: part._replace(branch=MaxwellBranch(f"{name}_branch", r * part.stiffness, time))
                for name, part in law.strains.items()
            }
        )
