"""Cross-sections and the stiffness and inertia that follow from them."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

#: The paper's G = E / (2 (1 + 0.3)), for a robot that gives no shear modulus.
POISSON_RATIO = 0.3


class CircularSection(NamedTuple):
    """A solid round section of the given radius (m)."""

    radius: Any

    @property
    def area(self) -> Any:
        """Area, πr² (m²)."""
        return np.pi * self.radius**2

    @property
    def second_moment(self) -> Any:
        """Second moment of area about a diameter, πr⁴/4 (m⁴)."""
        return np.pi * self.radius**4 / 4.0

    @property
    def inertia(self) -> Float[Any, "3 3"]:
        """J = diag(I, I, 2I): second moments about the material axes (m⁴)."""
        return self.second_moment * np.diag([1.0, 1.0, 2.0])

    def shear_stiffness(self, youngs_modulus: Any, shear_modulus: Any) -> Float[Any, "3 3"]:
        """Kse = diag(GA, GA, EA): shear and extension (N)."""
        return self.area * jnp.diag(jnp.stack([shear_modulus, shear_modulus, youngs_modulus]))

    def bending_stiffness(self, youngs_modulus: Any, shear_modulus: Any) -> Float[Any, "3 3"]:
        """Kbt = diag(EI, EI, 2GI): bending and twisting (N·m²)."""
        return self.second_moment * jnp.diag(jnp.stack([youngs_modulus, youngs_modulus, 2.0 * shear_modulus]))


def shear_modulus(youngs_modulus: Any) -> Any:
    """Shear modulus G = E / (2 (1 + ν)) of an isotropic material (Pa)."""
    return youngs_modulus / (2.0 * (1.0 + POISSON_RATIO))
