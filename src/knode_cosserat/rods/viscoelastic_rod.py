"""A viscoelastic rod, such as rubber: it creeps, and is stiffer in fast motion (see `relaxation`)."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Float

from knode_cosserat.rods.elastic_rod import ElasticRod
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.relaxation import branch_share, dashpot_strain
from knode_cosserat.rods.slender_rod import SlenderRod
from knode_cosserat.rods.system import History
from knode_cosserat.rotation import dot, inverse


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

    def strains(
        self, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> Float[Any, " z"]:
        """Return v, u and the strains of the dashpot, which are eliminated first."""
        c0, (Kse, Bse, Kbt, Bbt, u_star, *_) = history.c0, self.material(s, control)
        hv, hu, hv_branch, hu_branch = self.z_layout.split(history.z)
        n, m = self.stresses(y)
        T = self.relaxation_time
        share = branch_share(self.branch_stiffness, T, c0)

        def solved(K: Any, B: Any, stress: Any, z_star: Any, h: Any, h_branch: Any) -> Any:
            right = stress + dot(K, z_star) - dot(B, h) - share * dot(K, h_branch)
            return dot(inverse(K + c0 * (B + share * K)), right)

        v = solved(Kse, Bse, n, self.v_star, hv, hv_branch)
        u = solved(Kbt, Bbt, m, u_star, hu, hu_branch)
        z, h_branch = jnp.concatenate([v, u]), jnp.concatenate([hv_branch, hu_branch])
        return jnp.concatenate([z, dashpot_strain(z, h_branch, T, c0)])

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """Return C, D, f2 of the same law."""
        C, D, f2 = super().constitutive(s, t, y, y_t, control)
        K, one, zero = self.branch_stiffness * C, jnp.eye(6), jnp.zeros((6, 6))
        return (
            jnp.block([[C + K, -K], [-one, one]]),
            jnp.block([[D, zero], [zero, self.relaxation_time * one]]),
            jnp.concatenate([f2, jnp.zeros(6)]),
        )
