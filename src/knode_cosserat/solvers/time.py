"""Implicit time schemes: y_t at the new time is c0 y plus a history term.

    y_t,n = c0 y_n + ʰy,     ʰy = c1 y_{n-1} + c2 y_{n-2} + d1 y_t,{n-1}

A scheme is defined by its coefficients. Consecutive steps may differ in length, so that a step can be halved.
A one-step scheme of several stages solves one such problem a stage; the earlier states are then those of the
stage before and of the last row.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from typing import ClassVar, NamedTuple


class Coefficients(NamedTuple):
    """c0, c1, c2 in 1/s and d1 (no unit) of one step."""

    c0: float
    c1: float
    c2: float
    d1: float


@dataclasses.dataclass(frozen=True)
class TimeScheme(abc.ABC):
    """An implicit scheme in time."""

    #: true if y_t of the previous step enters, and so must be stored; if false, unresolved modes are damped
    uses_rate = False
    #: ends of the stages as parts of a step; multistep schemes have one stage
    ends: ClassVar[tuple[float, ...]] = (1.0,)

    @property
    @abc.abstractmethod
    def order(self) -> int:
        """Order of convergence in the time step."""

    @abc.abstractmethod
    def coefficients(self, dt: float, previous_dt: float) -> Coefficients:
        """Return c and d of a step of dt after previous_dt (s) (paper eq. 2, backward differentiation).

        For a scheme of several stages they are those of a scheme of one stage and of the same order, for rows
        whose stages are not known.
        """

    def stages(self, dt: float) -> tuple[Coefficients, ...]:
        """Return c and d of each stage of a step of dt (s) after an equal one."""
        return (self.coefficients(dt, dt),)


@dataclasses.dataclass(frozen=True)
class BDF1(TimeScheme):
    """Implicit Euler. Order 1, damps every vibration; it needs one earlier state only."""

    order = 1

    def coefficients(self, dt: float, previous_dt: float) -> Coefficients:
        """Return the coefficients for a step of dt (s); the previous step does not matter."""
        return Coefficients(1.0 / dt, -1.0 / dt, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class BDFAlpha(TimeScheme):
    """The family of Till, Aloi & Rucker (2019): α = 0 is BDF2, α = -1/2 the trapezoidal rule.

    Order 2. Numerical damping decreases as α approaches -1/2; at -1/2 there is none, and stiff modes ring.
    The scheme is BDF2 for unequal steps (r = dt/previous_dt) plus α times the second difference that
    approximates y_t,n - y_t,{n-1}.
    """

    alpha: float = -0.2

    order = 2

    def __post_init__(self) -> None:
        if not -0.5 <= self.alpha <= 0.0:
            raise ValueError(f"alpha is {self.alpha!r}; allowed is -0.5 (trapezoidal) to 0 (BDF2)")

    @property
    def uses_rate(self) -> bool:  # type: ignore[override]
        """True unless α is zero: BDF2 needs no y_t of the previous step."""
        return self.alpha != 0.0

    def coefficients(self, dt: float, previous_dt: float) -> Coefficients:
        """Return the coefficients for a step of dt (s) after one of previous_dt (s)."""
        a, r = self.alpha, dt / previous_dt
        scale = 1.0 / (dt * (1.0 + a))
        return Coefficients(
            c0=scale * (1.0 + 2.0 * r * (1.0 + a)) / (1.0 + r),
            c1=-scale * (1.0 + r * (1.0 + 2.0 * a)),
            c2=scale * r * r * (1.0 + 2.0 * a) / (1.0 + r),
            d1=a / (1.0 + a),
        )


@dataclasses.dataclass(frozen=True)
class BDF2(BDFAlpha):
    """The paper's scheme (paper eq. 13, BDF2). Order 2; damps vibrations faster than about 10 dt."""

    alpha: float = 0.0


@dataclasses.dataclass(frozen=True)
class Trapezoidal(BDFAlpha):
    """The trapezoidal rule. Order 2, no numerical damping: for vibrations that are well resolved in time."""

    alpha: float = -0.5


@dataclasses.dataclass(frozen=True)
class SDIRK2(TimeScheme):
    """The singly diagonally implicit Runge-Kutta scheme of two stages, L-stable and stiffly accurate.

    Order 2 for controls that are held in each step, because no step remembers the one before (Alexander 1977,
    γ = 1 - √½). Both stages have the same c0.
    """

    order = 2
    #: γ, and the end of the step
    ends: ClassVar[tuple[float, ...]] = (1.0 - math.sqrt(0.5), 1.0)

    @property
    def defect(self) -> float:
        """Error that a step of y' = J y adds, as a multiple of (γ dt J)² (difference of Y between stages)."""
        gamma = self.ends[0]
        return (3.0 * gamma**2 - 2.0 * gamma**3 - 1.0 / 6.0) / (gamma**2 * (1.0 - gamma))

    def coefficients(self, dt: float, previous_dt: float) -> Coefficients:
        """Return those of BDF2, for rows whose stages are not known."""
        return BDF2().coefficients(dt, previous_dt)

    def stages(self, dt: float) -> tuple[Coefficients, ...]:
        """Return the coefficients of both stages of a step of dt (s)."""
        gamma = self.ends[0]
        c0 = 1.0 / (gamma * dt)
        second = c0 * (1.0 - gamma) / gamma
        return Coefficients(c0, -c0, 0.0, 0.0), Coefficients(c0, -second, second - c0, 0.0)


#: for comparisons with real motions: near the trapezoidal rule, and stiff modes still decay by 18 % in a step
LIGHTLY_DAMPED = BDFAlpha(-0.45)
#: the scheme by default
TWO_STAGES = SDIRK2()

SCHEMES: dict[str, TimeScheme] = {
    "sdirk2": TWO_STAGES,
    "bdf1": BDF1(),
    "bdf2": BDF2(),
    "bdf-alpha": BDFAlpha(),
    "trapezoidal": Trapezoidal(),
}
