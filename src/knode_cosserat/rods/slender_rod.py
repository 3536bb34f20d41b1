"""A rod without actuators of its own: driven by its ends, loads, sections and contact."""

from __future__ import annotations

from knode_cosserat.rods.rod import Rod


class SlenderRod(Rod):
    """A rod that is pushed, pulled and turned at its ends, loaded, and in contact with its surroundings.

    With controlled curvature or stiffness of its `sections` it is a variable-curvature robot. With a driven
    base and obstacles it is the soft slender robot of Xun, Zheng & Kruszewski (2024).
    """
