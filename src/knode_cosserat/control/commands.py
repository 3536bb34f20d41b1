"""Interface of controllers: commands with their status."""

from __future__ import annotations

import abc
import copy
import dataclasses
import enum
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat.control.references import Reference
from knode_cosserat.rods.system import System


class Status(enum.Enum):
    """Origin of a command."""

    OPTIMAL = "optimal"
    #: the plan of an earlier period goes on
    SHIFTED = "shifted plan"
    #: the last control is held
    HELD = "held"
    #: the controls go to their safe values at the allowed rate
    SAFE = "going safe"

    @property
    def is_fallback(self) -> bool:
        """True if the command is not the controller's solution for this period."""
        return self is not Status.OPTIMAL


class Command(NamedTuple):
    """Control of one period, and its reason."""

    control: Float[np.ndarray, " c"]
    status: Status
    reason: str = ""
    #: predicted positions of the tip (N, 3), for display; None if the controller predicts nothing
    path: Any = None
    #: largest violation of soft constraints along the prediction, in their units
    violation: float = 0.0


@dataclasses.dataclass(frozen=True)
class ControlLimits:
    """Hard limits of controls, and the lag with which motors follow them.

    Attributes:
        low: least control.
        high: greatest control.
        rate: greatest change in one second.
        safe: controls that the robot goes to after a fault; None: `low`.
        lag: time constant of the motors (s); controllers that plan predict with it.
    """

    low: Any
    high: Any
    rate: Any = np.inf
    safe: Any = None
    lag: float = 0.0

    def of(self, robot: System) -> ControlLimits:
        """Return limits as arrays (c,) for a robot.

        Raises:
            ValueError: limits that contradict each other, or of a wrong shape.
        """
        count = robot.control_size
        arrays = {}
        for name in ("low", "high", "rate", "safe"):
            given = getattr(self, name)
            given = self.low if given is None else given
            try:
                arrays[name] = np.array(np.broadcast_to(np.asarray(given, dtype=float), (count,)))
            except (TypeError, ValueError):
                raise ValueError(f"{name} is {given!r}; allowed is a number or {count} numbers") from None
        if not np.all(np.isfinite(arrays["low"]) & np.isfinite(arrays["high"])):
            raise ValueError("low and high must be finite")
        if not np.all(arrays["low"] < arrays["high"]):
            raise ValueError(f"low is {self.low} and high {self.high}; low must be below high")
        if not np.all(arrays["rate"] > 0.0):
            raise ValueError(f"rate is {self.rate}; allowed is a positive number")
        if np.any(arrays["safe"] < arrays["low"]) or np.any(arrays["safe"] > arrays["high"]):
            raise ValueError(f"safe is {self.safe}; allowed is from low to high")
        if not self.lag >= 0.0:
            raise ValueError(f"lag is {self.lag}; allowed is zero or more")
        return ControlLimits(**arrays, lag=float(self.lag))

    def applied(self, wanted: Any, before: Any, dt: float) -> Float[np.ndarray, " c"]:
        """Return the nearest control within the limits, after another one `dt` (s) earlier.

        A control from outside the range, such as that of a start, comes into it at once.
        """
        most = np.asarray(self.rate) * dt
        return np.clip(np.clip(wanted, before - most, before + most), self.low, self.high)


class Controller(abc.ABC):
    """A controller of a robot: a command in each period, from measurements and a reference."""

    #: period (s)
    dt: float

    @abc.abstractmethod
    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Start from a control that acts now; compile everything that the loop needs."""

    def copied(self) -> Self:
        """Return a copy that moves independently of this controller."""
        return copy.copy(self)

    @abc.abstractmethod
    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the control from this time (s) on, from the measurement of this time."""

    def take_acting(self, measured: Float[np.ndarray, " c"], age: float) -> None:  # noqa: B027
        """Take over measured controls (c,) of an age (s), which lag behind commands; by default nothing."""

    def advance(self, control: Float[np.ndarray, " c"]) -> None:  # noqa: B027
        """Take over the control that acts from now on; by default nothing."""

    def prepare(self, time: float, reference: Reference) -> None:  # noqa: B027
        """Compute what the period from `time` on needs before its measurement; by default nothing."""

    @abc.abstractmethod
    def fallback(self, reason: str) -> Command:
        """Return a command for a period without a solution, such as a missed deadline."""
