"""Implicit time schemes: y_t at the new time is c0 y plus a history term.

    y_t,n = c0 y_n + ʰy,     ʰy = c1 y_{n-1} + c2 y_{n-2} + … + d1 y_t,{n-1}

A scheme is defined by its coefficients, of as many earlier states as its `memory`. Consecutive steps may
differ in length, so that a step can be halved. A one-step scheme of several stages (`SDIRK`) is defined by
its tableau, and solves one such problem a stage; the earlier states are then those of the stages before and
of the last row. A scheme with a `name` can be chosen by it.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from typing import ClassVar

import numpy as np

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
    #: weights of the states (newest first) in a sum d: in a step of y_t = J y the rate's error is J d, and
    #: the step adds the error J d / c0. Where the leading error is C dt^p y^(p+1), d is C dt^p y^(p) by
    #: differences of the states, for equal steps. Empty: no estimate
    defect: ClassVar[tuple[float, ...]] = ()

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
class SDIRK(TimeScheme):
    """A singly diagonally implicit Runge-Kutta scheme, stiffly accurate, defined by its tableau and order.

    No step remembers the one before. All stages have the same c0 = 1 / (γ dt), so that they share factors.
    The error estimate is that of the leading error of y_t = J y, dt^(p+1) J^p y_t with the order p. The
    equations of the step supply the last J, and damp the vibrations that a step does not resolve.
    """

    #: weights of the rates, a row a stage: γ is the last of each, and the last row is the step's own
    tableau: ClassVar[tuple[tuple[float, ...], ...]]
    #: γ dt times the rate at each stage, by the states (newest first)
    rates: ClassVar[np.ndarray]

    def __init_subclass__(cls) -> None:
        count, order = len(cls.tableau), int(cls.order)  # type: ignore[call-overload]
        A = np.array([[*row, *[0.0] * (count - len(row))] for row in cls.tableau])
        # y at stage i is Σ (A^k 1)_i dt^k J^k y, and in the exact motion Σ dt^k J^k y / k!
        powers = np.array([np.linalg.matrix_power(A, k).sum(axis=1) for k in range(order + 2)])
        excess = powers[:, -1] - [1.0 / math.factorial(k) for k in range(order + 2)]
        gamma = A[-1, -1]
        if count < 2 or gamma <= 0.0 or np.any(np.diag(A) != gamma):
            raise ValueError(
                f"{cls.__name__}: the last weights of the tableau's rows are {np.diag(A).tolist()}; allowed"
                " are two or more rows of 1, 2, … weights that end in one γ > 0, the last row for the step."
                " A scheme with an explicit stage is a TimeScheme that states its `stages`"
            )
        if np.any(abs(excess[:-1]) > 1e-9):
            lower = int(np.argmax(abs(excess) > 1e-9)) - 1
            raise ValueError(f"{cls.__name__}: the tableau has order {lower} (order states {order})")
        # combined so that only the power dt^(order - 1) of the rates remains
        wanted = np.append(np.zeros(order - 1), excess[-1] / gamma**2)
        R = gamma * np.linalg.inv(A)
        defect = np.linalg.lstsq(powers[:order], wanted)[0] @ R
        cls.memory, cls.ends = count, tuple(powers[1].tolist())
        cls.rates = np.array([[*row[i::-1], -row.sum(), *[0.0] * (count - 1 - i)] for i, row in enumerate(R)])
        cls.defect = tuple(np.append(defect[::-1], -defect.sum()).tolist())

    def coefficients(self, dt: float, *previous: float) -> Coefficients:
        """Return those of BDF2, for rows whose stages are not known."""
        return BDF2().coefficients(dt, *previous)

    def stages(self, dt: float) -> tuple[Coefficients, ...]:
        """Return the coefficients of all stages of a step of dt (s)."""
        c0 = 1.0 / (self.tableau[-1][-1] * dt)
        return tuple((*row, 0.0) for row in (c0 * self.rates).tolist())


@dataclasses.dataclass(frozen=True)
class SDIRK2(SDIRK):
    """The scheme of two stages, L-stable (Alexander 1977, γ = 1 - √½).

    Order 2 for controls that are held in each step, because no step remembers the one before.
    """

    name = "sdirk2"
    order = 2
    tableau = ((1.0 - math.sqrt(0.5),), (math.sqrt(0.5), 1.0 - math.sqrt(0.5)))


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


def check_scheme(scheme: TimeScheme) -> None:
    """Raise `ValueError` unless the coefficients have the stated order, and the defect fits them.

    Of a scheme of several stages, each stage must keep a constant.
    """
    name, order, defect = type(scheme).__name__, scheme.order, np.array(scheme.defect)
    if defect.size and (defect.shape != (scheme.memory + 1,) or abs(defect.sum()) > 1e-9 * abs(defect).max()):
        raise ValueError(
            f"{name}: defect is {scheme.defect}; allowed are memory + 1 = {scheme.memory + 1} weights"
            " with the sum zero, that of the newest state first"
        )
    stages = scheme.stages(1.0)
    for coefficients in stages:
        *c, d1 = pad_coefficients(coefficients, scheme.memory)
        if d1 and not scheme.uses_rate:
            raise ValueError(
                f"{name}: the last coefficient, of the last rate, is {d1:.4g}; allowed is 0, or"
                " uses_rate = True"
            )
        times = -np.arange(len(c), dtype=float)
        for power in range(order + 1 if len(stages) == 1 else 1):
            rate = np.dot(c, times**power) + (d1 * power * (-1.0) ** (power - 1) if power else 0.0)
            if not abs(rate - (power == 1)) < 1e-9 * np.abs(c).sum():
                raise ValueError(
                    f"{name}: for steps of 1 s, its coefficients make {rate:.4g} of the rate of t^{power} at"
                    f" t = 0, which is {int(power == 1)}; order {order} allows no error up to t^{order}."
                    " Coefficients are c0, c1, c2, … of the states, newest first, and last d1 of the last"
                    " rate (0: none)"
                )


def pad_coefficients(coefficients: Coefficients, memory: int) -> Coefficients:
    """Return the coefficients of a step with zeros for earlier states that its scheme does not use."""
    *earlier, d1 = coefficients
    return *earlier, *[0.0] * (memory + 1 - len(earlier)), d1
