"""A rod without actuators of its own: what moves it are its ends, loads, sections, and what it touches."""

from __future__ import annotations

from knode_cosserat.rods.rod import Rod


class SlenderRod(Rod):
    """A rod that is pushed, pulled and turned at its ends, loaded, and in contact with its surroundings.

    With `sections` whose curvature or stiffness a control changes, it is a variable-curvature robot; with a
    driven base and obstacles, the soft slender robot of Xun, Zheng & Kruszewski (2024).
    """
