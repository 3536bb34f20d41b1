"""Schemes along the rod: mono-implicit Runge-Kutta formulas.

Over a piece of length h from y_a to y_b a scheme has stages i at s_a + cᵢ h,

    Yᵢ = (1 - vᵢ) y_a + vᵢ y_b + h Σ_{k<i} xᵢₖ f(Yₖ),     y_b = y_a + h Σ bᵢ f(Yᵢ)

(Cash & Singhal 1982). Stages are explicit in y at both ends, so only y at the ends is unknown. Lobatto's
formulas are symmetric and A-stable: they never turn a growing exponential into a decaying one, or the
reverse, at any step length. Forward Euler is neither; it is kept to reproduce the paper.

Every scheme names a second formula of higher order, `check`. Its defect estimates the discretisation error.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import ClassVar, NamedTuple


class Stage(NamedTuple):
    """A stage between the ends of a piece: its place c, v, and the weights of earlier rates.

    `rates` are the weights of f at the start, f at the end, then f of earlier stages, each multiplied by h.
    """

    place: float
    end: float
    rates: tuple[float, ...]


class Formula(NamedTuple):
    """Stages between the ends, and the weights b of f at the start, at the end and at these stages."""

    stages: tuple[Stage, ...]
    weights: tuple[float, ...]


def _hermite(place: float) -> Stage:
    """Return y of the cubic through both ends with their rates."""
    c = place
    return Stage(c, c * c * (3.0 - 2.0 * c), (c * (1.0 - c) ** 2, -c * c * (1.0 - c)))


_MIDDLE = _hermite(0.5)
_SIMPSON = Formula((_MIDDLE,), (1 / 6, 1 / 6, 2 / 3))
#: order 6 (Cash & Singhal 1982, Boole's rule). The middle is evaluated again: the cubic's value has an error
#: of h⁴, which would leave an error of the same size as the one to be estimated
_BOOLE = Formula(
    (_MIDDLE, _hermite(0.25), _hermite(0.75), Stage(0.5, 0.5, (-5 / 24, 5 / 24, 0.0, 2 / 3, -2 / 3))),
    (7 / 90, 7 / 90, 0.0, 16 / 45, 16 / 45, 2 / 15),
)


@dataclasses.dataclass(frozen=True)
class SpaceScheme(abc.ABC):
    """A one-step scheme in arclength, by its formula and the formula that checks it."""

    #: name in `simulate` and on the command line; empty: none
    name: ClassVar[str] = ""
    formula: ClassVar[Formula]
    #: a formula of higher order; its stages begin with those of `formula`
    check: ClassVar[Formula]
    #: true if the scheme only reproduces results of others: large errors neither warn nor change the grid
    is_reproduction: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def order(self) -> int:
        """Order of convergence in the length of a segment."""

    @property
    def implicit(self) -> bool:
        """True if y at a piece's end enters the rates."""
        return self.formula.weights[1] != 0.0 or any(stage.end != 0.0 for stage in self.formula.stages)


@dataclasses.dataclass(frozen=True)
class Lobatto2(SpaceScheme):
    """Lobatto IIIA of order 2, the trapezoidal (box) rule: the default.

    One evaluation a node, and the fastest per step. Stable on any grid.
    """

    name = "lobatto2"
    order = 2
    formula = Formula((), (0.5, 0.5))
    check = _SIMPSON


@dataclasses.dataclass(frozen=True)
class Lobatto4(SpaceScheme):
    """Lobatto IIIA of order 4 (Hermite-Simpson): the accurate scheme.

    Two evaluations a node. Use it if the tip error must be below a thousandth of the length.
    """

    name = "lobatto4"
    order = 4
    formula = _SIMPSON
    check = _BOOLE


@dataclasses.dataclass(frozen=True)
class Euler(SpaceScheme):
    """Forward Euler, order 1: the paper's scheme, to reproduce it. Unstable where segments are long."""

    name = "euler"
    order = 1
    is_reproduction = True
    formula = Formula((), (1.0, 0.0))
    check = _SIMPSON


#: the default
LOBATTO2 = Lobatto2()
