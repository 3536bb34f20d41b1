"""References: the wanted output of a robot over time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.errors import KnodeCosseratError


class ReferenceFormatError(KnodeCosseratError, ValueError):
    """A reference that cannot be used; one line says why."""

    code = "reference"


@dataclasses.dataclass(frozen=True)
class Reference:
    """A wanted output as a function of time; NaN for numbers that are free.

    Attributes:
        values: function from times (T,) in s to values (T, p).
        size: p.
        name: for reports.
        announced: True if controllers know the reference ahead. If not, as for a target that somebody moves,
            they expect its present value to stay.
    """

    values: Callable[[Float[np.ndarray, " T"]], Float[np.ndarray, "T p"]]
    size: int
    name: str
    announced: bool = True

    def at(self, times: Any) -> Float[np.ndarray, "T p"]:
        """Return the values at times (s)."""
        times = np.atleast_1d(np.asarray(times, dtype=float))
        found = np.asarray(self.values(times), dtype=float)
        if found.shape != (len(times), self.size):
            raise ReferenceFormatError(
                f"the reference {self.name} gives shape {found.shape} for {len(times)} times; "
                f"allowed is ({len(times)}, {self.size})"
            )
        return found

    def expected(self, time: float, later: Any) -> Float[np.ndarray, "T p"]:
        """Return the values (T, p) that are expected at a time (s), some seconds `later` (T,)."""
        later = np.atleast_1d(np.asarray(later, dtype=float))
        return self.at(time + later if self.announced else np.full(len(later), time))


def constant(value: Sequence[float]) -> Reference:
    """Return a reference that does not change."""
    one = np.asarray(value, dtype=float)
    return Reference(lambda t: np.tile(one, (len(t), 1)), len(one), f"constant {one.tolist()}")


def _eased(t: Any, rise: float) -> Any:
    """Return a factor from 0 to 1 in the first `rise` seconds, with continuous acceleration."""
    part = np.clip(t / rise, 0.0, 1.0) if rise else np.ones_like(t)
    return part**3 * (10.0 - 15.0 * part + 6.0 * part**2)


def circle(
    radius: float, period: float, centre: Sequence[float] = (0.0, 0.0, np.nan), rise: float = 2.0
) -> Reference:
    """Return a circle about the z axis; a NaN in the centre leaves that coordinate free.

    Args:
        radius: radius (m).
        period: time of one turn (s).
        centre: centre (m).
        rise: time (s) in which the radius grows from zero, so that the start is at the centre.
    """
    _positive(radius=radius, period=period)
    middle = np.asarray(centre, dtype=float)

    def values(t: Any) -> Any:
        angle, r = 2.0 * np.pi * t / period, radius * _eased(t, rise)
        return middle + np.stack([r * np.cos(angle), r * np.sin(angle), np.zeros_like(t)], axis=1)

    return Reference(values, 3, f"circle of {radius:g} m, period {period:g} s")


def figure_eight(
    radius: float, period: float, centre: Sequence[float] = (0.0, 0.0, np.nan), rise: float = 2.0
) -> Reference:
    """Return a figure of eight (Gerono's lemniscate) in the xy plane, of half-width `radius` (m)."""
    _positive(radius=radius, period=period)
    middle = np.asarray(centre, dtype=float)

    def values(t: Any) -> Any:
        angle, r = 2.0 * np.pi * t / period, radius * _eased(t, rise)
        x, y = r * np.sin(angle), r * np.sin(angle) * np.cos(angle)
        return middle + np.stack([x, y, np.zeros_like(t)], axis=1)

    return Reference(values, 3, f"figure of eight of {radius:g} m, period {period:g} s")


def steps(points: Sequence[Sequence[float]], hold: float, announced: bool = False) -> Reference:
    """Return points (m) that are each held for some time (s), the last one for ever.

    A predictive controller leaves a point before an `announced` step, for the mean error is then smaller.
    """
    _positive(hold=hold)
    table = np.asarray(points, dtype=float)
    if table.ndim != 2:
        raise ReferenceFormatError(f"points have shape {table.shape}; allowed is (points, p)")

    def values(t: Any) -> Any:
        # a row at a switch belongs to the new point
        return table[np.clip(np.floor(t / hold + 1e-9).astype(int), 0, len(table) - 1)]

    return Reference(values, table.shape[1], f"{len(table)} steps of {hold:g} s", announced)


def table(time: Sequence[float], values: Any) -> Reference:
    """Return a reference interpolated linearly between rows; constant before the first and after the last.

    Raises:
        ReferenceFormatError: times that do not increase, or a wrong shape.
    """
    t, rows = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    if t.ndim != 1 or rows.ndim != 2 or len(rows) != len(t) or not len(t):
        raise ReferenceFormatError(
            f"time has shape {t.shape} and values {rows.shape}; allowed is (T,) and (T, numbers)"
        )
    if np.any(np.diff(t) <= 0.0) or not np.all(np.isfinite(t)):
        raise ReferenceFormatError("the times of a reference must increase")

    def interpolated(at: Any) -> Any:
        return np.stack([np.interp(at, t, column) for column in rows.T], axis=1)

    return Reference(interpolated, rows.shape[1], f"table of {len(t)} rows")


def _positive(**numbers: float) -> None:
    for name, number in numbers.items():
        if not (np.isfinite(number) and number > 0.0):
            raise ReferenceFormatError(f"{name} is {number}; allowed is a positive number")


#: references by name, for the command line
NAMED: dict[str, Callable[..., Reference]] = {"circle": circle, "eight": figure_eight}


def parse_reference(text: str) -> Reference:
    """Return a reference from a text such as "circle:radius=0.1,period=4".

    Raises:
        ReferenceFormatError: a name or option that does not exist, or a value that is not a number.
    """
    name, _, rest = text.partition(":")
    if name not in NAMED:
        raise ReferenceFormatError(
            f"there is no reference {name!r}; there are {', '.join(NAMED)}, or a CSV file"
        )
    options: dict[str, float] = {}
    for part in filter(None, rest.split(",")):
        key, _, value = part.partition("=")
        if key not in ("radius", "period", "rise"):
            raise ReferenceFormatError(f"{name} has no option {key!r}; there are radius, period, rise")
        try:
            options[key] = float(value)
        except ValueError:
            raise ReferenceFormatError(f"{key} is {value!r}; allowed is a number") from None
    for key in ("radius", "period"):
        if key not in options:
            raise ReferenceFormatError(f"{name} needs {key}, such as {name}:radius=0.1,period=4")
    return NAMED[name](**options)
