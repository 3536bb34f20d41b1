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
import math
from typing import ClassVar, NamedTuple

import numpy as np

#: orders of formulas are found up to this one
MOST = 8
#: rounding of the weights of a formula
TOLERANCE = 1e-9


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


def _order_of(formula: Formula) -> int:
    """Return the order at y' = y, and as a quadrature; an order above `MOST` counts as `MOST`.

    Raises `ValueError` if the weights of a formula or a stage are not consistent.
    """
    powers = np.array([1.0 / math.factorial(k) for k in range(MOST + 1)])
    start, places = np.eye(MOST + 1)[0], [0.0, 1.0]
    # series in h of y at the start, at the end and at each stage
    values = [start, powers]
    for stage in formula.stages:
        if len(stage.rates) > len(values) or abs(stage.end + sum(stage.rates) - stage.place) > TOLERANCE:
            raise ValueError(
                f"{stage} is not consistent; allowed are rates of the start, the end and earlier stages that,"
                " with `end`, have the sum `place`"
            )
        change = sum((w * value for w, value in zip(stage.rates, values, strict=False)), np.zeros(MOST + 1))
        values.append((1.0 - stage.end) * start + stage.end * powers + np.append(0.0, change[:-1]))
        places.append(stage.place)
    if len(formula.weights) != len(values):
        raise ValueError(
            f"a formula has {len(formula.weights)} weights; allowed are {len(values)}: of the start, the end"
            f" and {len(formula.stages)} stages"
        )
    step = np.append(0.0, np.dot(formula.weights, values)[:-1])
    moments = [np.dot(formula.weights, np.power(places, k)) - 1.0 / (k + 1) for k in range(MOST)]
    wrong = np.abs(np.append(start + step - powers, 1.0))[1:] > TOLERANCE
    return int(np.argmax(wrong | np.append(np.abs(moments) > TOLERANCE, True)))


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
    #: a formula of higher order; its stages begin with those of `formula`, whose weights may be zero
    check: ClassVar[Formula]
    #: true if the scheme only reproduces results of others: large errors neither warn nor change the grid
    is_reproduction: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        name, own, count = cls.__name__, cls.formula, len(cls.formula.stages)
        if cls.check.stages[:count] != own.stages:
            raise ValueError(
                f"{name}: the stages of check do not begin with those of formula; allowed is"
                " Formula((*formula.stages, …), weights), with weights of zero where they do not count"
            )
        least = int(cls.order)  # type: ignore[call-overload]
        for what, formula, needed in (("formula", own, least), ("check", cls.check, least + 1)):
            if (found := _order_of(formula)) < needed:
                raise ValueError(f"{name}: {what} has order {found}; allowed is {needed} or more")

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
