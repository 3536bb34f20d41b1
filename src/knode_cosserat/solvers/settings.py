"""What the user may choose of the numerics, in one hashable value."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, Self

from knode_cosserat.solvers import space as space_schemes
from knode_cosserat.solvers import time as time_schemes
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.linear import ELIMINATIONS, Condensed, LinearSolver
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


def _scheme(what: str, given: Any, kind: Any, known: Any) -> Any:
    if isinstance(given, kind):
        return given
    if isinstance(given, str) and given in known:
        return known[given]
    names = ", ".join(f'"{name}"' for name in known)
    raise ValueError(f"{what} is {given!r}; allowed is {names}, or a {kind.__name__}")
