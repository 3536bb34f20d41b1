"""The boundary-value problem of one time step, solved at all nodes at once.

Unknown are y at every node and the free numbers ξ at the base. Their equations:

    y_0 = base(ξ),     y_{j+1} = y_j + h Σ bᵢ f(Yᵢ)  (a piece of the space scheme),     tip(y_N) = 0

Newton's method linearises all pieces side by side, and one linear recursion along the rod gives the
correction (`engine.elimination`). A linearisation costs as much as several corrections. It is kept, also from
one time step to the next, while corrections converge fast. Corrections are damped by the natural monotonicity
test: the correction that the same linearisation proposes at the new point must be shorter than the last one
(Deuflhard, Newton Methods for Nonlinear Problems, 2004, ch. 3).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from knode_cosserat.rods.system import System

#: largest correction that may be left at a solution, relative to the state and its natural units
LARGEST_CORRECTION = 1e-5


@dataclasses.dataclass(frozen=True)
class NewtonOptions:
    """Tolerances and limits of Newton's method.

    Residuals are measured in the system's natural units (`System.scales`). A step is solved when the largest
    is below `tolerance`, or below `acceptable` where rounding allows no further progress, and the correction
    that is left is small.
    """

    tolerance: float = 1e-10
    acceptable: float = 1e-8
    max_linearisations: int = 12
    #: linearise again when the old linearisation is expected to need more corrections than this
    patience: int = 6
    least_damping: float = 1e-3

    def __post_init__(self) -> None:
        for name, allowed, holds in (
            ("tolerance", "a number above 0", lambda x: 0.0 < x < math.inf),
            ("acceptable", "a number from the tolerance on", lambda x: x >= self.tolerance),
            ("max_linearisations", "a whole number from 1", lambda x: x >= 1 and x == int(x)),
            ("patience", "a whole number from 1", lambda x: x >= 1 and x == int(x)),
            ("least_damping", "a number above 0, at most 1", lambda x: 0.0 < x <= 1.0),
        ):
            given = getattr(self, name)
            if not isinstance(given, int | float) or not holds(given):
                raise ValueError(f"NewtonOptions: {name} is {given!r}; allowed is {allowed}")


def pivots_of(system: System) -> Any:
    """Return the indices in y of the fields that are unknown at the base."""
    return np.asarray(system.y_layout.indices(system.base_unknowns))
