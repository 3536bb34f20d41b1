"""Units of users: numbers with a unit, such as `250 mm` or `50 GPa`, in SI units."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

from knode_cosserat._numbers import numbers_in
from knode_cosserat.errors import KnodeCosseratError

#: exponents of m, kg, s, A and rad
Dimension = tuple[int, int, int, int, int]


class Unit(NamedTuple):
    """Factor to SI units, and dimension."""

    factor: float
    dimension: Dimension


class UnitError(KnodeCosseratError, ValueError):
    """A unit that is not known, or of another kind; a phrase for the end of a message."""

    code = "unit"


#: prefixes, with their factors
PREFIXES = {
    "n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1,
    "h": 1e2, "k": 1e3, "M": 1e6, "G": 1e9,
}  # fmt: skip
#: units that take prefixes
PREFIXED = {
    "m": Unit(1.0, (1, 0, 0, 0, 0)),
    "g": Unit(1e-3, (0, 1, 0, 0, 0)),
    "s": Unit(1.0, (0, 0, 1, 0, 0)),
    "A": Unit(1.0, (0, 0, 0, 1, 0)),
    "rad": Unit(1.0, (0, 0, 0, 0, 1)),
    "N": Unit(1.0, (1, 1, -2, 0, 0)),
    "Pa": Unit(1.0, (-1, 1, -2, 0, 0)),
    "bar": Unit(1e5, (-1, 1, -2, 0, 0)),
    "J": Unit(1.0, (2, 1, -2, 0, 0)),
    "W": Unit(1.0, (2, 1, -3, 0, 0)),
    "T": Unit(1.0, (0, 1, -2, -1, 0)),
    "Hz": Unit(1.0, (0, 0, -1, 0, 0)),
    "l": Unit(1e-3, (3, 0, 0, 0, 0)),
    "L": Unit(1e-3, (3, 0, 0, 0, 0)),
    # as in the recordings of the paper's robot
    "gf": Unit(9.81 / 1000.0, (1, 1, -2, 0, 0)),
}
#: other units
PLAIN = {
    "deg": Unit(math.pi / 180.0, (0, 0, 0, 0, 1)),
    "°": Unit(math.pi / 180.0, (0, 0, 0, 0, 1)),
    "degrees": Unit(math.pi / 180.0, (0, 0, 0, 0, 1)),
    "rev": Unit(2.0 * math.pi, (0, 0, 0, 0, 1)),
    "min": Unit(60.0, (0, 0, 1, 0, 0)),
    "in": Unit(0.0254, (1, 0, 0, 0, 0)),
    "inch": Unit(0.0254, (1, 0, 0, 0, 0)),
    "psi": Unit(6894.757293168361, (-1, 1, -2, 0, 0)),
    "%": Unit(0.01, (0, 0, 0, 0, 0)),
    "1": Unit(1.0, (0, 0, 0, 0, 0)),
}
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_WITH_UNIT = re.compile(rf"\s*((?>{_NUMBER}))(?:\s*([A-Za-zµμ°%].*?)|\s+(1 ?/.*?))\s*")
#: a group of units that are all divided by
_DIVIDED = re.compile(r"/ *\(([^()]*)\)")
#: a unit with its exponent, after a sign of multiplication or division
_PART = re.compile(r"\s*([*·/]?)\s*([A-Za-zµμ°%]+|1)\s*(?:\^|\*\*)?\s*(-?\d|[²³])?")


def unit_of(text: str) -> Unit:
    """Return the unit of a text, such as `mm`, `kg/m3`, `N m^2` or `1/m`.

    Raises:
        UnitError: it has a unit that is not known.
    """
    factor, exponents, end, sign = 1.0, [0] * 5, 0, 1
    plain = _DIVIDED.sub(lambda match: "/" + match[1], text.strip())
    while end < len(plain):
        match = _PART.match(plain, end)
        if match is None:
            raise UnitError(f"the unit {text!r} is not known")
        # as in kg/(m s), what follows a stroke is divided by
        sign = {"": sign, "/": -1}.get(match[1], 1)
        power = sign * int((match[3] or "1").translate({ord("²"): "2", ord("³"): "3"}))
        unit = _simple(match[2])
        factor *= unit.factor**power
        exponents = [old + power * new for old, new in zip(exponents, unit.dimension, strict=True)]
        end = match.end()
    m, kg, s, A, rad = exponents
    return Unit(factor, (m, kg, s, A, rad))


def _simple(symbol: str) -> Unit:
    for known in (PREFIXED, PLAIN):
        if symbol in known:
            return known[symbol]
    prefix, rest = symbol[:1], symbol[1:]
    if prefix in PREFIXES and rest in PREFIXED:
        return Unit(PREFIXES[prefix] * PREFIXED[rest].factor, PREFIXED[rest].dimension)
    raise UnitError(f"the unit {symbol!r} is not known")


def factors_of(*units: str) -> dict[str, float]:
    """Return the factors of units to SI units, by unit."""
    return {unit: unit_of(unit).factor for unit in units}


def _shortest(number: float) -> float:
    """Return the shortest decimal number of those that only rounding distinguishes: 1.4 mm is 0.0014 m."""
    shortest = float(f"{number:.15g}")
    return shortest if math.isclose(shortest, number, rel_tol=4e-16) else number


def in_unit(text: str, unit: str) -> float | None:
    """Return the number of a text such as `250 mm` in an SI unit; None if it is not a number with a unit.

    Raises:
        UnitError: the unit is not known, or of another kind: a length in place of a pressure, say.
    """
    match = _WITH_UNIT.fullmatch(text)
    if match is None:
        return None
    symbols = match[2] or match[3]
    given, wanted = unit_of(symbols), unit_of(unit or "1")
    if given.dimension != wanted.dimension:
        raise UnitError(f"{symbols} is no unit of a number in {unit}" if unit else "this number has no unit")
    return _shortest(float(match[1]) * given.factor / wanted.factor)


def numbers_with_units(text: str, units: Sequence[str]) -> list[float] | None:
    """Return the numbers of a text in SI units: `7 5 5 7`, or, separated by commas, `5 N, 200 gf`.

    The last unit is that of further numbers, too. None if the text has other words.

    Raises:
        UnitError: a unit is not known, or of another kind.
    """
    plain = numbers_in(text)
    if plain is not None or not units:
        return plain
    numbers = []
    for k, word in enumerate(re.split("[,;]", text.strip().strip("[]()"))):
        number = in_unit(word, units[min(k, len(units) - 1)])
        one = numbers_in(word) if number is None else [number]
        if one is None or len(one) != 1:
            return None
        numbers += one
    return numbers
