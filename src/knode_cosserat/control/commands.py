"""Interface of controllers: commands with their status, limits, lag of motors, and controllers by name."""

from __future__ import annotations

import abc
import copy
import dataclasses
import enum
import inspect
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import numpy as np
from jaxtyping import Float

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.yaml_text import UNKNOWN_HERE, did_you_mean
from knode_cosserat.control.references import Reference
from knode_cosserat.rods.system import System

#: longest time constant of motors that is looked for (s)
LONGEST_LAG = 2.0


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
    status: Status = Status.OPTIMAL
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
        count = robot.control_layout.size
        arrays = {}
        for name in ("low", "high", "rate", "safe"):
            value = getattr(self, name)
            value = self.low if value is None else value
            try:
                arrays[name] = np.array(np.broadcast_to(np.asarray(value, dtype=float), (count,)))
            except (TypeError, ValueError):
                raise ValueError(f"{name} is {value!r}; allowed is a number or {count} numbers") from None
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
    """A controller of a robot: a command in each period, from measurements and a reference.

    `register_controller` gives a subclass a name for `controller_named` and the command line.
    """

    #: True if `for_tip` takes `adapt` and `measured`, the adapted parameters and the output of an observer
    has_observer: ClassVar[bool] = False
    #: of a registered controller: a line of help, and its options with their defaults
    help: ClassVar[str]
    options: ClassVar[dict[str, int | float]]
    #: period (s)
    dt: float
    #: control that acts now
    _control: Any

    @classmethod
    def for_tip(cls, robot: System, dt: float, limits: ControlLimits, **options: Any) -> Self:
        """Return a controller of the tip's position; by default the constructor with these arguments."""
        return cls(robot, dt, limits, **options)  # type: ignore[call-arg]

    @abc.abstractmethod
    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Start from a control that acts now; compile everything that the loop needs."""

    @property
    def settings(self) -> dict[str, int]:
        """Settings as plain numbers by name, for the log: arguments that make such a controller again."""
        return {}

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

    def fallback(self, reason: str) -> Command:
        """Return a command for a period without a solution: by default the control that acts now."""
        return Command(self._control, Status.HELD, reason)


# controllers by name


#: controllers by name, for `controller_named`, the command line and the documentation
CONTROLLERS: dict[str, type[Controller]] = {}

AnyController = TypeVar("AnyController", bound=type[Controller])


def register_controller(name: str, help: str) -> Callable[[AnyController], AnyController]:
    """Return a decorator that registers a controller class under a name.

    Its options are the keyword arguments of its constructor that have numbers as defaults:

        @register_controller("slow", "integral of the tip's error")
        class Slow(Controller):
            def __init__(self, robot, dt, limits, *, gain: float = 0.5): ...

        controller_named("slow:gain=0.2", robot, 0.05, limits)

    Raises:
        ValueError: the name belongs to another class.
    """

    def register(cls: AnyController) -> AnyController:
        if name in CONTROLLERS and CONTROLLERS[name].__qualname__ != cls.__qualname__:
            raise ValueError(f"the controller {name!r} is registered already; allowed is another name")
        keywords = [it for it in inspect.signature(cls).parameters.values() if it.kind is it.KEYWORD_ONLY]
        cls.help = help
        cls.options = {it.name: it.default for it in keywords if type(it.default) in (int, float)}
        CONTROLLERS[name] = cls
        return cls

    return register


def controller_named(
    name: str,
    robot: System,
    dt: float,
    limits: ControlLimits,
    adapt: Sequence[Any] = (),
    measured: Any = None,
) -> Controller:
    """Return a controller of the tip's position by its name.

    Args:
        name: one of `CONTROLLERS`, perhaps with options: "predictive:horizon=10,knots=5".
        robot: the model.
        dt: period (s).
        limits: limits of the controls.
        adapt: names of parameters, or `Adapted` ones, that a controller with an observer adapts.
        measured: the measurement of an observer, with its noise; None: the tip's position. The noise of an
            identified model's measurement includes the error of its predictions.

    Raises:
        ValueError: an unknown name or option, or parameters for a controller that adapts none.
        SimulationError: the model has no equilibrium that the controller needs.
    """
    check_arguments(controller_named, locals())
    name, _, text = name.partition(":")
    if name not in CONTROLLERS:
        hint = did_you_mean(name, CONTROLLERS) or UNKNOWN_HERE
        raise ValueError(f"there is no controller {name!r}; there are {', '.join(CONTROLLERS)}{hint}")
    cls = CONTROLLERS[name]
    if adapt and not cls.has_observer:
        observing = ", ".join(key for key, entry in CONTROLLERS.items() if entry.has_observer)
        raise ValueError(
            f"the controller {name!r} adapts no parameters; those with an observer do: {observing}"
        )
    options: dict[str, Any] = {"adapt": adapt, "measured": measured} if cls.has_observer else {}
    for word in filter(None, text.split(",")):
        key, _, number = (part.strip() for part in word.partition("="))
        if key not in cls.options:
            raise ValueError(
                f"the controller {name!r} has no option {key!r}; there are {', '.join(cls.options) or 'none'}"
                f"{did_you_mean(key, cls.options)}"
            )
        kind = type(cls.options[key])
        try:
            options[key] = kind(number)
        except ValueError:
            words = "a whole number" if kind is int else "a number"
            raise ValueError(f"{name}: {key} is {number!r}; allowed is {words}") from None
    return cls.for_tip(robot, dt, limits, **options)


# lag of motors


def remaining_part(lag: float, dt: float) -> float:
    """Return the remaining part of the distance from a command after a time `dt` (s)."""
    return float(np.exp(-dt / lag)) if lag > 0.0 else 0.0


def mean_part(lag: float, dt: float) -> float:
    """Return the mean remaining part of the distance from a command over a time `dt` (s).

    A step of a motion holds its controls: those of motors that lag count by their mean.
    """
    return lag / dt * (1.0 - remaining_part(lag, dt)) if lag > 0.0 else 0.0


def apply_lag(
    commanded: Float[np.ndarray, "T c"], dt: float, lag: float, initial: Float[np.ndarray, " c"]
) -> Float[np.ndarray, "T c"]:
    """Return the controls at the end of each row of commands, after a first-order lag.

    Args:
        commanded: held from row to row.
        dt: time from row to row (s).
        lag: time constant (s); 0: none.
        initial: controls before the first row.
    """
    rows, acting, remaining = [], np.asarray(initial, dtype=float), remaining_part(lag, dt)
    for command in commanded:
        acting = command + (acting - command) * remaining
        rows.append(acting)
    return np.array(rows)


def identified_lag(
    commanded: Float[np.ndarray, "T c"],
    measured: Float[np.ndarray, "T c"],
    dt: float,
    initial: Float[np.ndarray, " c"],
) -> float:
    """Return the time constant (s) of the motors, by least squares of the measured tensions.

    Args:
        commanded: tensions, held from row to row.
        measured: tensions at the end of each row; NaN: not measured.
        dt: time from row to row (s).
        initial: tensions before the first row.
    """
    from scipy.optimize import minimize_scalar

    def cost(lag: float) -> float:
        return float(np.nansum((apply_lag(commanded, dt, lag, initial) - measured) ** 2))

    return float(
        minimize_scalar(cost, bounds=(0.0, LONGEST_LAG), method="bounded", options={"xatol": 1e-5}).x
    )
