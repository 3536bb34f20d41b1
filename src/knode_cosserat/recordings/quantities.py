"""Quantities that drive a robot: units, plausible sizes, and the words by which columns are recognised.

One table serves the configuration, the proposal, the checks, and the messages. The names are the keys of a
configuration, and the prefixes of the columns in this package's tables, such as `pressure_1 [Pa]`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

from knode_cosserat._units import factors_of

_ANGLES, _LENGTHS = factors_of("rad", "deg"), factors_of("m", "cm", "mm")


class Quantity(NamedTuple):
    """Quantity that drives a robot.

    Attributes:
        name: key in a configuration.
        plural: word in messages.
        units: factors to the SI unit, which is the first.
        low: smallest plausible size, in the SI unit: a median of absolute values that are not zero.
        high: largest plausible size.
        guesses: units of columns that state none, each with the largest number that is taken for it.
        words: words in titles, also in other languages, that name the quantity.
        actuators: words that name what is driven by it.
        controls: names of systems' controls that it is measured for.
        drive: drive of a robot that is measured by this quantity, or by others: one of them is enough.
        pulls: True if it cannot be below zero.
    """

    name: str
    plural: str
    units: Mapping[str, float]
    low: float
    high: float
    guesses: tuple[tuple[str, float], ...]
    words: re.Pattern[str]
    actuators: re.Pattern[str]
    controls: tuple[str, ...]
    drive: str = ""
    pulls: bool = False

    @property
    def unit(self) -> str:
        """The SI unit."""
        return next(iter(self.units))


def _words(pattern: str) -> re.Pattern[str]:
    return re.compile(pattern, re.IGNORECASE)


_NONE = re.compile(r"(?!)")

#: all quantities by name; of those of one drive, the first that is there is proposed
QUANTITIES: dict[str, Quantity] = {
    quantity.name: quantity
    for quantity in (
        Quantity(
            "tension",
            "tensions",
            factors_of("N", "gf", "mN", "kgf"),
            0.12,
            120.0,
            (("N", 120.0), ("gf", math.inf)),
            _words(r"tension|tensión|force|load|effort|pull|zug|kraft|kräfte|fuerza|forza|traction|^[tf]$"),
            _words(r"tendon|cell|cable|câble|wire|seil|tirant"),
            ("tension",),
            "tendons",
            pulls=True,
        ),
        Quantity(
            "angle",
            "angles",
            _ANGLES,
            1e-4,
            1e3,
            (("rad", 7.0), ("deg", math.inf)),
            _words(
                r"phi|encoder|angle|winkel|ángulo|angulo|angolo|theta|present.?position|dxl.?pos(ition)?$|"
                r"ticks?$|^q$"
            ),
            _words(r"motor|moteur|servo|joint|gelenk"),
            ("motor", "angle", "rx", "ry", "rz"),
            "tendons",
        ),
        Quantity(
            "length",
            "lengths",
            _LENGTHS,
            1e-5,
            5.0,
            (("m", 0.5), ("mm", math.inf)),
            _words(
                r"length|länge|laenge|longueur|longitud|lunghezza|stroke|hub|course|carrera|displacement|"
                r"weg|^l$"
            ),
            _words(r"reel|spool|slider|motor|moteur|servo|tendon|cable|câble|seil"),
            ("reel", "displacement", "length"),
            "tendons",
        ),
        Quantity(
            "current",
            "currents",
            factors_of("A", "mA"),
            1e-4,
            100.0,
            (("A", 30.0), ("mA", math.inf)),
            _words(r"current|strom|ströme|courant|corriente|corrente|^i$|amps?$"),
            _NONE,
            (),
            "tendons",
        ),
        Quantity(
            "pressure",
            "pressures",
            factors_of("Pa", "hPa", "kPa", "MPa", "mbar", "bar", "psi"),
            50.0,
            5e6,
            (("bar", 15.0), ("kPa", 1500.0), ("Pa", math.inf)),
            _words(r"press|druck|drück|presión|presion|^p$"),
            _words(r"chamber|kammer|chambre|cámara|valve|ventil|vanne|válvula|valvola|regulator|muscle"),
            ("pressure",),
            "fluid",
        ),
        Quantity(
            "volume",
            "volumes",
            factors_of("m3", "l", "ml", "ul"),
            1e-9,
            1e-1,
            (("m3", 1e-3), ("ml", math.inf)),
            _words(r"vol|^v$"),
            _words(r"syringe|spritze|seringue|jeringa|siringa|pump|pompe|bomba"),
            ("volume",),
            "fluid",
        ),
        Quantity(
            "insertion",
            "insertions",
            _LENGTHS,
            1e-5,
            5.0,
            (("m", 0.5), ("mm", math.inf)),
            _words(r"insert|inserc|inserim|beta|feed|vorschub|einschub|advance|avance|avanzam|transl"),
            _words(r"tube|rohr|catheter|katheter|linear"),
            ("insertion", "x", "y", "z"),
        ),
        Quantity(
            "rotation",
            "rotations",
            _ANGLES,
            1e-4,
            1e3,
            (("rad", 7.0), ("deg", math.inf)),
            _words(r"rotat|rotac|rotaz|alpha|dreh(winkel)?|twist|torsion"),
            _words(r"tube|rohr|catheter|katheter"),
            ("rotation", "rx", "ry", "rz"),
        ),
        Quantity(
            "field",
            "fields",
            factors_of("T", "mT"),
            1e-6,
            20.0,
            (("T", 0.3), ("mT", math.inf)),
            _words(r"^b$|field|feld|champ|campo|flux|fluss|magnet"),
            _words(r"coil|spule|bobin"),
            ("Bx", "By", "Bz"),
        ),
        Quantity(
            "input",
            "inputs",
            factors_of("1"),
            0.0,
            math.inf,
            (("1", math.inf),),
            _words(r"^input$"),
            _NONE,
            ("input", "scale"),
        ),
    )
}

#: units with the factor to the SI unit, and that unit
UNITS: dict[str, tuple[float, str]] = {
    unit: (factor, quantity.unit)
    for quantity in QUANTITIES.values()
    for unit, factor in quantity.units.items()
}
#: other spellings of units in titles
_SPELLINGS = {
    **dict.fromkeys(("newton", "newtons"), "N"),
    **dict.fromkeys(("g", "gram", "grams", "gramm", "grams-force"), "gf"),
    **dict.fromkeys(("kg", "kp"), "kgf"),
    **dict.fromkeys(("°", "degree", "degrees", "degs", "grad", "grados", "degré", "degrés", "gradi"), "deg"),
    **dict.fromkeys(("radian", "radians", "rads"), "rad"),
    **dict.fromkeys(("metre", "metres", "meter", "meters", "mètre", "mètres", "metro", "metros"), "m"),
    **dict.fromkeys(("millimetre", "millimetres", "millimeter", "millimeters"), "mm"),
    **dict.fromkeys(("centimetre", "centimetres", "centimeter", "centimeters"), "cm"),
    **dict.fromkeys(("ampere", "amperes", "amps", "ampère"), "A"),
    **dict.fromkeys(("pascal", "pascals"), "Pa"),
    **dict.fromkeys(("m³", "m^3"), "m3"),
    **dict.fromkeys(("mL", "cc", "cm3", "cm³", "cm^3"), "ml"),
    **dict.fromkeys(("µl", "μl", "uL", "µL", "μL", "mm3", "mm³", "mm^3"), "ul"),
    **dict.fromkeys(("L", "liter", "litre"), "l"),
    **dict.fromkeys(("tesla",), "T"),
}
#: units in titles that are not in brackets: letters alone are more likely names
_LOOSE = [unit for unit in (*UNITS, *_SPELLINGS) if len(unit) > 1 and unit != "1"]
_BRACKETS = re.compile(r"[\[(]([^\])]*)[\])]\s*$")


def divided_title(title: str) -> tuple[str, str]:
    """Return the text of a title without its unit, and the unit's spelling; empty if it states none.

    Units stand in brackets at the end, after a slash, or after the last space, point or underscore:
    `P_A [mbar]`, `cam X (mm)`, `Weg / mm`, `valve1_kPa`.
    """
    match = _BRACKETS.search(title)
    if match and not match[1].strip().isdigit():
        return title[: match.start()].strip(), match[1].strip()
    parts = re.fullmatch(r"(.*?)\s*(?:/\s*|[\s_.]+(?:in\s+)?)([^\s_/.]+)\s*", title)
    if parts and parts[1] and known_unit(parts[2]) and (parts[2] in _LOOSE or "/" in title[len(parts[1]) :]):
        return parts[1].strip(" _."), parts[2]
    return title.strip(), ""


def known_unit(spelling: str) -> str:
    """Return a unit of `UNITS` by any of its spellings; empty if it is unknown."""
    if spelling in UNITS:
        return spelling
    if spelling in _SPELLINGS:
        return _SPELLINGS[spelling]
    # capitals count between mN and MN only
    alike = {unit for unit in UNITS if unit.lower() == spelling.lower() and len(unit) > 1}
    return _SPELLINGS.get(spelling.lower(), next(iter(alike)) if len(alike) == 1 else "")


def stated_unit(title: str, allowed: Collection[str]) -> str:
    """Return the unit that a title states, if it is an allowed one; else empty text."""
    unit = known_unit(divided_title(title)[1])
    return unit if unit in allowed else ""


def guessed_unit(quantity: Quantity, largest: float) -> str:
    """Return the unit of numbers that state none, by the largest absolute value among them."""
    return next(unit for unit, most in quantity.guesses if largest <= most)


def of_unit(unit: str) -> Quantity:
    """Return the first quantity of an SI unit."""
    return next(quantity for quantity in QUANTITIES.values() if quantity.unit == unit)


def counted_quantities(counts: Iterable[tuple[str, int]]) -> str:
    """Return names and counts in words, such as rotation (3), insertion (3)."""
    sums: dict[str, int] = {}
    for name, count in counts:
        sums[name] = sums.get(name, 0) + count
    return ", ".join(f"{name} ({count})" for name, count in sums.items()) or "none"


def labels(quantities: Iterable[tuple[str, int]]) -> list[str]:
    """Return the names of all columns, such as tension_1, tension_2."""
    named, counts = list[str](), dict[str, int]()
    for name, count in quantities:
        for _ in range(count):
            counts[name] = counts.get(name, 0) + 1
            named.append(f"{name}_{counts[name]}")
    return named


def unit_of(label: str) -> str:
    """Return the SI unit of a column by its label, such as tension_1."""
    return QUANTITIES[label.rpartition("_")[0]].unit
