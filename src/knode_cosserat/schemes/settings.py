"""Numerical settings."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, Literal, Self

from knode_cosserat.schemes.space import LOBATTO2, SpaceScheme
from knode_cosserat.schemes.time import BDF2, TWO_STAGES, TimeScheme, check_scheme

Start = Literal["paper", "consistent"]
Between = Literal["held", "linear"]
Errors = Literal[True, False, "grid"]


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


@dataclasses.dataclass(frozen=True)
class Settings:
    """Schemes in time and space, the first step, and Newton's options.

    `time` is None for equilibria, which have no rates. `start` selects the first step of a scheme that needs
    two earlier states. "consistent" makes the first step by BDF1 (keeps order 2); "paper" sets the state
    before the first equal to the first, which delays a motion that begins suddenly by half a step.
    """

    time: TimeScheme | None = TWO_STAGES
    space: SpaceScheme = LOBATTO2
    start: Start = "consistent"
    newton: NewtonOptions = NewtonOptions()
    #: controls are constant from row to row, or linear (`history.at_stages`)
    between: Between = "held"
    #: True if the errors of every row are estimated, "grid" if only those by the grid are, False if none is:
    #: they are NaN then, and no row is called coarse
    errors: Errors = True

    @property
    def uses_rate(self) -> bool:
        """True if the time scheme needs y_t of the previous step."""
        return self.time is not None and self.time.uses_rate

    @property
    def memory(self) -> int:
        """Number of earlier states that enter a step."""
        return 2 if self.time is None else self.time.memory

    @property
    def estimates(self) -> int:
        """Number of estimated errors: by the grid, and by the time scheme."""
        return 1 if self.errors == "grid" else 2 * self.errors

    @property
    def stages(self) -> int:
        """Number of boundary-value problems that are solved in a step."""
        return 1 if self.time is None else len(self.time.ends)

    @classmethod
    def of(
        cls,
        time: str | TimeScheme | None,
        space: str | SpaceScheme,
        start: str,
        newton: NewtonOptions,
        between: str = "held",
        errors: Errors = True,
    ) -> Self:
        """Return settings from names or schemes; `time` is None for statics.

        Raises `ValueError` with the accepted names.
        """
        if not isinstance(newton, NewtonOptions):
            raise ValueError(f"newton is {newton!r}; allowed is a NewtonOptions")
        if start not in ("paper", "consistent"):
            raise ValueError(f'start is {start!r}; allowed is "paper" or "consistent"')
        if errors not in (True, False, "grid"):
            raise ValueError(f'errors is {errors!r}; allowed is True, False or "grid"')
        if between not in ("held", "linear"):
            raise ValueError(f'between is {between!r}; allowed is "held" or "linear"')
        in_time = None if time is None else _scheme("time", time, TimeScheme)
        if in_time is not None:
            check_scheme(in_time)
        return cls(
            in_time,
            _scheme("space", space, SpaceScheme),
            start,  # type: ignore[arg-type]
            newton,
            between,  # type: ignore[arg-type]
            errors,
        )

    def described(self) -> dict[str, Any]:
        """Return the settings as plain data, for a file: schemes by class name and options."""
        return {
            "time": _describe(self.time),
            "space": _describe(self.space),
            "start": self.start,
            "newton": dataclasses.asdict(self.newton),
            "between": self.between,
            "errors": self.errors,
        }

    @classmethod
    def from_description(cls, described: Any) -> Self:
        """Return settings from plain data; `KeyError`, `TypeError` or `ValueError` if it is not valid."""
        time = described["time"]
        return cls(
            time=None if time is None else _scheme_class(TimeScheme, **time),
            space=_scheme_class(SpaceScheme, **described["space"]),
            start=described["start"],
            newton=NewtonOptions(**described["newton"]),
            between=described["between"],
            # files of earlier versions have no other motions
            errors=described.get("errors", True),
        )


#: for rows that were not simulated: rates are differences of the rows, by the paper's scheme
MEASURED = Settings(BDF2(), start="paper")


def _describe(scheme: Any) -> dict[str, Any] | None:
    return None if scheme is None else {"scheme": type(scheme).__name__, **dataclasses.asdict(scheme)}


def schemes(kind: type) -> dict[str, type]:
    """Return the schemes in time or in space by their names, those of users among them."""
    return {cls.name: cls for cls in _subclasses(kind) if cls.name}


def _scheme(what: str, given: Any, kind: Any) -> Any:
    known = schemes(kind)
    if isinstance(given, kind):
        return given
    if isinstance(given, str) and given in known:
        return known[given]()
    names = ", ".join(f'"{name}"' for name in known)
    raise ValueError(f"{what} is {given!r}; allowed is {names}, or a {kind.__name__}")


def _scheme_class(base: type, *, scheme: str, **options: Any) -> Any:
    """Return a scheme by its class name, from the package or defined by the user."""
    ours_last = sorted(_subclasses(base), key=lambda cls: cls.__module__.startswith("knode_cosserat."))
    known = {cls.__name__: cls for cls in ours_last}
    if scheme not in known:
        raise ValueError(f"no {base.__name__} is called {scheme!r} here; there are {', '.join(known)}")
    return known[scheme](**options)


def _subclasses(cls: type) -> Iterator[Any]:
    subclasses: list[type] = cls.__subclasses__()
    for subclass in subclasses:
        yield subclass
        yield from _subclasses(subclass)
