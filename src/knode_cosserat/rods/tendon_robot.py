"""The paper's tendon-driven continuum robot: tendons that push the rod sideways.

Symbols as in `tendon_rod`.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Float

from knode_cosserat.rods.system import History
from knode_cosserat.rods.tendon_rod import TendonRod
from knode_cosserat.rods.tendons import transverse_force
from knode_cosserat.rotation import dot, inverse, rotation_matrix


class TendonRobot(TendonRod):
    """A clamped, round, straight rod with tendons, gravity, drag and material damping (paper eqs. 13-15).

    The tendons load the rod as in the paper (`tendons.transverse_force`): a force across it, no moment. For
    tendons as they are, see `RoutedTendonRobot`.
    """

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, "3"]:
        """The resultant of the tendons' forces per length (N/m), global frame: the paper's τ·φ."""
        return transverse_force(control, self.tendon_angles)

    def tendon_force(self, control: Float[Any, " c"]) -> Float[Any, "3"]:
        """The same: all that these tendons do."""
        return self.actuation(control)

    def strains(
        self, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> Float[Any, " z"]:
        """v and u (paper eq. 15)."""
        c0 = history.c0
        R = rotation_matrix(self.y_layout.get(y, "h"))
        n, m = self.y_layout.get(y, "n"), self.y_layout.get(y, "m")
        hv, hu = self.z_layout.split(history.z)
        Kse, Bse, Kbt, Bbt = self.Kse, self.shear_damping, self.Kbt, self.bending_damping
        v = dot(inverse(Kse + c0 * Bse), dot(R.T, n) + Kse @ self.v_star - dot(Bse, hv))
        u = dot(inverse(Kbt + c0 * Bbt), dot(R.T, m) + Kbt @ self.u_star - dot(Bbt, hu))
        return jnp.concatenate([v, u])

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """C, D, f2: the material's law, K (z - z*) + B z_t = Rᵀ (n, m)."""
        R = rotation_matrix(self.y_layout.get(y, "h"))
        n, m = self.y_layout.get(y, "n"), self.y_layout.get(y, "m")
        zero = jnp.zeros((3, 3))
        C = jnp.block([[self.Kse, zero], [zero, self.Kbt]])
        D = jnp.block([[self.shear_damping, zero], [zero, self.bending_damping]])
        f2 = jnp.concatenate([R.T @ n + self.Kse @ self.v_star, R.T @ m + self.Kbt @ self.u_star])
        return C, D, f2

    def balance(self, s, t, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """A = I, B = 0, and f1 the right-hand side of paper eq. 13."""
        size = self.y_layout.size
        return jnp.eye(size), jnp.zeros((size, size)), self._spatial_rates(y, y_t, z, z_t, control)
