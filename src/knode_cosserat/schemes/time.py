"""Implicit time schemes: y_t at the new time is c0 y plus a history term.

    y_t,n = c0 y_n + ʰy,     ʰy = c1 y_{n-1} + c2 y_{n-2} + … + d1 y_t,{n-1}

A scheme is defined by its coefficients, of as many earlier states as its `memory`. Consecutive steps may
differ in length, so that a step can be halved. A one-step scheme of several stages solves one such problem a
stage; the earlier states are then those of the stage before and of the last row. A scheme with a `name` can
be chosen by it.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from typing import ClassVar

#: c0, c1, c2, … in 1/s and d1 (no unit) of one step
Coefficients = tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class TimeScheme(abc.ABC):
    """An implicit scheme in time."""

    #: name in `simulate` and on the command line; empty: none
    name: ClassVar[str] = ""
    #: number of earlier states that enter a step
    memory: ClassVar[int] = 2
    #: true if y_t of the previous step enters, and so must be stored; if false, unresolved modes are damped
    uses_rate = False
    #: ends of the stages as parts of a step; multistep schemes have one stage
    ends: ClassVar[tuple[float, ...]] = (1.0,)

    @property
    @abc.abstractmethod
    def order(self) -> int:
        """Order of convergence in the time step."""

    @abc.abstractmethod
    def coefficients(self, dt: float, *previous: float) -> Coefficients:
        """Return c0, c1, c2, … and d1 of a step of dt (s) (paper eq. 2, backward differentiation).

        `previous` are the steps (s) before it, the last one first: one less than the earlier states. A
        scheme of several stages returns those of a scheme of one stage and of the same order, for rows whose
        stages are not known.
        """

    def stages(self, dt: float) -> tuple[Coefficients, ...]:
        """Return the coefficients of each stage of a step of dt (s) after equal ones."""
        return (self.coefficients(dt, *[dt] * (self.memory - 1)),)

    def starter(self, known: int) -> TimeScheme:
        """Return the scheme of a step from fewer known states than the scheme needs."""
        return BDF1() if known < 2 else BDF2()


@dataclasses.dataclass(frozen=True)
class SDIRK2(TimeScheme):
    """The singly diagonally implicit Runge-Kutta scheme of two stages, L-stable and stiffly accurate.

    Order 2 for controls that are held in each step, because no step remembers the one before (Alexander 1977,
    γ = 1 - √½). Both stages have the same c0.
    """

    name = "sdirk2"
    order = 2
    #: γ, and the end of the step
    ends: ClassVar[tuple[float, ...]] = (1.0 - math.sqrt(0.5), 1.0)

    @property
    def defect(self) -> float:
        """Error that a step of y' = J y adds, as a multiple of (γ dt J)² (difference of Y between stages)."""
        gamma = self.ends[0]
        return (3.0 * gamma**2 - 2.0 * gamma**3 - 1.0 / 6.0) / (gamma**2 * (1.0 - gamma))

    def coefficients(self, dt: float, *previous: float) -> Coefficients:
        """Return those of BDF2, for rows whose stages are not known."""
        return BDF2().coefficients(dt, *previous)

    def stages(self, dt: float) -> tuple[Coefficients, ...]:
        """Return the coefficients of both stages of a step of dt (s)."""
        gamma = self.ends[0]
        c0 = 1.0 / (gamma * dt)
        second = c0 * (1.0 - gamma) / gamma
        return (c0, -c0, 0.0, 0.0), (c0, -second, second - c0, 0.0)


@dataclasses.dataclass(frozen=True)
class BDF1(TimeScheme):
    """Implicit Euler. Order 1, damps every vibration; it needs one earlier state only."""

    name = "bdf1"
    order = 1

    def coefficients(self, dt: float, *previous: float) -> Coefficients:
        """Return the coefficients for a step of dt (s); previous steps do not matter."""
        return 1.0 / dt, -1.0 / dt, 0.0, 0.0


@dataclasses.dataclass(frozen=True)
class BDFAlpha(TimeScheme):
    """The family of Till, Aloi & Rucker (2019): α = 0 is BDF2, α = -1/2 the trapezoidal rule.

    Order 2. Numerical damping decreases as α approaches -1/2; at -1/2 there is none, and stiff modes ring.
    The scheme is BDF2 for unequal steps (r = dt/previous_dt) plus α times the second difference that
    approximates y_t,n - y_t,{n-1}.
    """

    alpha: float = -0.2

    name = "bdf-alpha"
    order = 2

    def __post_init__(self) -> None:
        if not -0.5 <= self.alpha <= 0.0:
            raise ValueError(f"alpha is {self.alpha!r}; allowed is -0.5 (trapezoidal) to 0 (BDF2)")

    @property
    def uses_rate(self) -> bool:  # type: ignore[override]
        """True unless α is zero: BDF2 needs no y_t of the previous step."""
        return self.alpha != 0.0

    def coefficients(self, dt: float, *previous: float) -> Coefficients:
        """Return the coefficients for a step of dt (s) after one of another length."""
        a, r = self.alpha, dt / previous[0]
        scale = 1.0 / (dt * (1.0 + a))
        c0 = scale * (1.0 + 2.0 * r * (1.0 + a)) / (1.0 + r)
        c1 = -scale * (1.0 + r * (1.0 + 2.0 * a))
        c2 = scale * r * r * (1.0 + 2.0 * a) / (1.0 + r)
        return c0, c1, c2, a / (1.0 + a)


@dataclasses.dataclass(frozen=True)
class BDF2(BDFAlpha):
    """The paper's scheme (paper eq. 13, BDF2). Order 2; damps vibrations faster than about 10 dt."""

    alpha: float = 0.0

    name = "bdf2"


@dataclasses.dataclass(frozen=True)
class Trapezoidal(BDFAlpha):
    """The trapezoidal rule. Order 2, no numerical damping: for vibrations that are well resolved in time."""

    alpha: float = -0.5

    name = "trapezoidal"


#: for comparisons with real motions: near the trapezoidal rule, and stiff modes still decay by 18 % in a step
LIGHTLY_DAMPED = BDFAlpha(-0.45)
#: the scheme by default
TWO_STAGES = SDIRK2()


def padded(coefficients: Coefficients, memory: int) -> Coefficients:
    """Return the coefficients of a step with zeros for earlier states that its scheme does not use."""
    *earlier, d1 = coefficients
    return *earlier, *[0.0] * (memory + 1 - len(earlier)), d1
