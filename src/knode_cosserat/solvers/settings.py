"""What the user may choose of the numerics, in one hashable value."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, Literal, Self

from knode_cosserat.solvers import space as space_schemes
from knode_cosserat.solvers import time as time_schemes
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.linear import ELIMINATIONS, Condensed, Decoupled, LinearSolver
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.time import TimeScheme

Start = Literal["paper", "consistent"]


@dataclasses.dataclass(frozen=True)
class Settings:
    """Schemes in time and space, the first step, and Newton's options.

    `start` says how a scheme that needs two past states makes its first step from one: "paper" takes the
    state before the first to be the first, "consistent" makes the first step by BDF1 (keeps order 2).
    """

    time: TimeScheme = time_schemes.BDF2()
    space: SpaceScheme = space_schemes.Euler()
    start: Start = "paper"
    newton: NewtonOptions = NewtonOptions()
    #: of a correction's linear equations; a run changes to the stable one by itself where it needs it
    elimination: LinearSolver = Condensed()  # noqa: RUF009

    @classmethod
    def of(
        cls, time: str | TimeScheme, space: str | SpaceScheme, start: str, newton: NewtonOptions,
        elimination: str | LinearSolver = "condensed",
    ) -> Self:  # fmt: skip
        """Settings from names or schemes. `ValueError` names what is allowed."""
        if not isinstance(newton, NewtonOptions):
            raise ValueError(f"newton is {newton!r}; allowed is a NewtonOptions")
        if start not in ("paper", "consistent"):
            raise ValueError(f'start is {start!r}; allowed is "paper" or "consistent"')
        return cls(
            _scheme("time", time, TimeScheme, time_schemes.SCHEMES),
            _scheme("space", space, SpaceScheme, space_schemes.SCHEMES),
            start,  # type: ignore[arg-type]
            newton,
            _scheme("elimination", elimination, LinearSolver, ELIMINATIONS),
        )

    def described(self) -> dict[str, Any]:
        """As plain data, for a file: schemes by their class's name and options."""
        found: dict[str, Any] = {
            "time": {"scheme": type(self.time).__name__, **dataclasses.asdict(self.time)},
            "space": {"scheme": type(self.space).__name__, **dataclasses.asdict(self.space)},
            "start": self.start,
            "newton": dataclasses.asdict(self.newton),
        }
        if isinstance(self.elimination, Decoupled):
            found["elimination"] = {"scheme": Decoupled.__name__, **dataclasses.asdict(self.elimination)}
        return found

    @classmethod
    def from_description(cls, described: Any) -> Self:
        """The settings that `described` gives; `KeyError`, `TypeError` or `ValueError` if it is not that."""
        elimination = described.get("elimination", Condensed.__name__)
        if isinstance(elimination, str):  # its name alone, as files had it at first
            elimination = {"scheme": elimination}
        return cls(
            time=_named(TimeScheme, **described["time"]),
            space=_named(SpaceScheme, **described["space"]),
            start=described["start"],
            newton=NewtonOptions(**described["newton"]),
            elimination=_named(LinearSolver, **elimination),
        )


def _scheme(what: str, given: Any, kind: Any, known: Any) -> Any:
    if isinstance(given, kind):
        return given
    if isinstance(given, str) and given in known:
        return known[given]
    names = ", ".join(f'"{name}"' for name in known)
    raise ValueError(f"{what} is {given!r}; allowed is {names}, or a {kind.__name__}")


def _named(base: type, *, scheme: str, **options: Any) -> Any:
    """A scheme of a class that exists already: the package's, or one that the user has defined by now."""
    ours_last = sorted(_subclasses(base), key=lambda cls: cls.__module__.startswith("knode_cosserat."))
    known = {cls.__name__: cls for cls in ours_last}
    if scheme not in known:
        raise ValueError(f"no {base.__name__} is called {scheme!r} here; there are {', '.join(known)}")
    return known[scheme](**options)


def _subclasses(cls: type) -> Iterator[type]:
    subclasses: list[type] = cls.__subclasses__()
    for subclass in subclasses:
        yield subclass
        yield from _subclasses(subclass)
