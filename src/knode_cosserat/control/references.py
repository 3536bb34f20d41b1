"""References: the wanted output of a robot over time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat._arguments import check_arguments, numbers_of
from knode_cosserat._units import UnitError, in_unit
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
        rows = np.asarray(self.values(times), dtype=float)
        if rows.shape != (len(times), self.size):
            raise ReferenceFormatError(
                f"the reference {self.name} gives shape {rows.shape} for {len(times)} times; "
                f"allowed is ({len(times)}, {self.size})"
            )
        return rows

    def expected(self, time: float, later: Any) -> Float[np.ndarray, "T p"]:
        """Return the values (T, p) that are expected at a time (s), some seconds `later` (T,)."""
        later = np.atleast_1d(np.asarray(later, dtype=float))
        return self.at(time + later if self.announced else np.full(len(later), time))


def constant(value: Sequence[float]) -> Reference:
    """Return a reference that does not change."""
    check_arguments(constant, locals())
    one = numbers_of("value", value, "a list of numbers, such as the tip's position (m)")
    if one.ndim != 1:
        raise ReferenceFormatError(f"value has shape {one.shape}; allowed is (p,); see `steps` and `table`")
    return Reference(lambda t: np.tile(one, (len(t), 1)), len(one), f"constant {one.tolist()}")


def circle(
    radius: float, period: float, centre: Sequence[float] | None = None, rise: float = 2.0, plane: str = "xy"
) -> Reference:
    """Return a circle in a plane of two axes of the robot's frame.

    Args:
        radius: radius (m).
        period: time of one turn (s).
        centre: centre (m); NaN leaves a coordinate free. None: zero in the plane, and free across it. The tip
            of a robot along z circles about z by default; others need the centre near their tip.
        rise: time (s) in which the radius grows from zero, so that the start is at the centre.
        plane: the two axes, such as "xy" or "yz"; the turn is from the first to the second.

    Raises:
        ReferenceFormatError: a radius, period, centre or plane that is not allowed.
    """
    check_arguments(circle, locals())
    return _closed_path("circle", lambda a: (np.cos(a), np.sin(a)), (radius, period, rise), (plane, centre))


def figure_eight(
    radius: float, period: float, centre: Sequence[float] | None = None, rise: float = 2.0, plane: str = "xy"
) -> Reference:
    """Return a figure of eight (Gerono's lemniscate) of half-width `radius` (m); see `circle`."""
    check_arguments(figure_eight, locals())
    eight = "figure of eight"
    return _closed_path(
        eight, lambda a: (np.sin(a), np.sin(a) * np.cos(a)), (radius, period, rise), (plane, centre)
    )


def _closed_path(
    name: str, shape: Callable[[Any], tuple[Any, Any]], size: tuple[float, float, float], place: Any
) -> Reference:
    """Return a path of the tip by the two coordinates of a unit shape (from an angle) in a plane.

    `size` has the radius, the period and the rise, `place` the plane and the centre.
    """
    (radius, period, rise), (plane, centre) = size, place
    _require_positive(radius=radius, period=period)
    axes = ["xyz".find(axis) for axis in plane]
    if len(axes) != 2 or -1 in axes or axes[0] == axes[1]:
        raise ReferenceFormatError(f"plane is {plane!r}; allowed is two different axes, such as xy, yz or xz")
    middle = np.full(3, np.nan)
    middle[axes] = 0.0
    if centre is not None:
        middle = numbers_of("centre", centre, "three numbers (m)")
        if middle.shape != (3,) or np.any(np.isinf(middle)):
            raise ReferenceFormatError(f"centre is {centre}; allowed is three numbers (m), NaN if free")

    def values(t: Any) -> Any:
        part = np.clip(t / rise, 0.0, 1.0) if rise else np.ones_like(t)
        # with continuous acceleration
        growing = radius * part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
        offset = np.zeros((len(t), 3))
        offset[:, axes] = (growing * np.stack(shape(2.0 * np.pi * t / period))).T
        return middle + offset

    usual = plane == "xy" and np.array_equal(middle, [0.0, 0.0, np.nan], equal_nan=True)
    where = "" if usual else f" in {plane} about {middle.tolist()} m"
    return Reference(values, 3, f"{name} of {radius:g} m, period {period:g} s{where}")


def steps(points: Sequence[Sequence[float]], hold: float, announced: bool = False) -> Reference:
    """Return points (m) that are each held for some time (s), the last one for ever.

    A predictive controller leaves a point before an `announced` step, for the mean error is then smaller.
    """
    check_arguments(steps, locals())
    _require_positive(hold=hold)
    table = numbers_of("points", points, "(points, p) in m")
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
    check_arguments(table, locals())
    t, rows = numbers_of("time", time, "(T,) in s"), numbers_of("values", values, "(T, numbers)")
    if t.ndim != 1 or rows.ndim != 2 or len(rows) != len(t) or not len(t):
        raise ReferenceFormatError(
            f"time has shape {t.shape} and values {rows.shape}; allowed is (T,) and (T, numbers)"
        )
    if np.any(np.diff(t) <= 0.0) or not np.all(np.isfinite(t)):
        raise ReferenceFormatError("the times of a reference must increase")

    def interpolated(at: Any) -> Any:
        return np.stack([np.interp(at, t, column) for column in rows.T], axis=1)

    return Reference(interpolated, rows.shape[1], f"table of {len(t)} rows")


def _require_positive(**numbers: float) -> None:
    for name, number in numbers.items():
        if not (np.isfinite(number) and number > 0.0):
            raise ReferenceFormatError(f"{name} is {number}; allowed is a positive number")


#: references by name, for the command line, and their options
NAMED: dict[str, Callable[..., Reference]] = {"circle": circle, "eight": figure_eight}
OPTIONS = ("radius", "period", "rise", "plane", "x", "y", "z")
#: units of options that are not in m
_UNITS = {"period": "s", "rise": "s"}


def parse_reference(text: str) -> Reference:
    """Return a reference from a text such as "circle:radius=0.1,period=4".

    Options are radius and period, rise, plane, and the coordinates of the centre: x, y and z (m). The centre
    is at zero in the plane, and free across it, unless they are given: `circle:radius=0.05,period=4,plane=yz,
    x=0.28`. Numbers are in m and s, or have a unit: `circle:radius=60mm,period=4`.

    Raises:
        ReferenceFormatError: a name or option that does not exist, or a value that is not a number.
    """
    name, _, rest = text.partition(":")
    if name not in NAMED:
        raise ReferenceFormatError(
            f"there is no reference {name!r}; there are {', '.join(NAMED)}, or a CSV file"
        )
    options: dict[str, Any] = {}
    for part in filter(None, rest.split(",")):
        key, _, value = (word.strip() for word in part.partition("="))
        if key not in OPTIONS:
            raise ReferenceFormatError(f"{name} has no option {key!r}; there are {', '.join(OPTIONS)}")
        try:
            number = None if key == "plane" else in_unit(value, _UNITS.get(key, "m"))
            options[key] = value if key == "plane" else float(value) if number is None else number
        except UnitError as error:
            raise ReferenceFormatError(f"{key} is {value!r}: {error}") from None
        except ValueError:
            raise ReferenceFormatError(f"{key} is {value!r}; allowed is a number") from None
    for key in ("radius", "period"):
        if key not in options:
            raise ReferenceFormatError(f"{name} needs {key}, such as {name}:radius=0.1,period=4")
    plane = options.get("plane", "xy")
    centre = [options.pop(axis, 0.0 if axis in plane else np.nan) for axis in "xyz"]
    return NAMED[name](**options, centre=centre)
