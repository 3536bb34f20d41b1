"""A rod without actuators of its own: what moves it are its ends, loads, sections, and what it touches."""

from __future__ import annotations

from typing import Any

from jaxtyping import Float

from knode_cosserat.rods.rod import Rod
from knode_cosserat.rods.system import History


class SlenderRod(Rod):
    """A rod that is pushed, pulled and turned at its ends, loaded, and in contact with its surroundings.

    With `sections` whose curvature or stiffness a control changes, it is a variable-curvature robot; with a
    driven base and obstacles, the soft slender robot of Xun, Zheng & Kruszewski (2024).
    """

    def strains(
        self, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> Float[Any, " z"]:
        """v and u (paper eq. 15)."""
        return self.linear_strains(s, y, control, history)

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """C, D, f2 of the material's law."""
        return self.linear_law(s, y, control)
