"""Physical parameters: units, meaning and allowed range, stated once beside each parameter.

`System.replace`, robot files and `knode-cosserat info` use the same statement. A robot may also have choices
(words), and parts: tendons' routings, loads, ends, obstacles, each with its own parameters.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
from collections.abc import Callable, Iterable
from typing import Any, Literal, Self

import equinox as eqx
import jax
import numpy as np

from knode_cosserat._files.yaml_text import did_you_mean, shown
from knode_cosserat._reprs import object_text
from knode_cosserat.errors import KnodeCosseratError

#: smallest length of a direction or quaternion: the square of a much smaller length underflows
SHORTEST = 1e-9


class ParameterError(KnodeCosseratError, ValueError):
    """A parameter's name or value is not allowed; the message gives the value and the allowed range."""

    code = "parameter"


Shape = Literal["scalar", "vector", "direction", "quaternion", "matrix", "list"]

#: fraction of the rod's length: a place nearer to an end than this is at the end
AT_END = 1e-9


#: largest number of elements of a list in an error message
MOST_SHOWN = 12
#: by unit: the typical range
TYPICAL: dict[str, tuple[float, float]] = {
    "m": (1e-5, 10.0),
    "Pa": (1e5, 4e11),
    "kg/m3": (100.0, 23e3),
    "m/s2": (-30.0, 30.0),
    "rad": (-2 * np.pi, 2 * np.pi),
}
#: by unit: the size of other common units, the likeliest first
_OTHER_UNITS: dict[str, dict[str, float]] = {
    "m": {"mm": 1e-3, "um": 1e-6},
    "Pa": {"GPa": 1e9, "MPa": 1e6, "kPa": 1e3},
    "kg/m3": {"g/cm3": 1e3, "g/m3": 1e-3},
    "m/s2": {"mm/s2": 1e-3},
    "rad": {"degrees": np.pi / 180.0},
}


def numbers_text(value: Any) -> str:
    """Return a number or (nested) list of numbers as text of bounded length, without needless digits."""
    if isinstance(value, list):
        more = ", …" if len(value) > MOST_SHOWN else ""
        return "[" + ", ".join(map(numbers_text, value[:MOST_SHOWN])) + more + "]"
    return f"{value:.12g}"


def in_other_unit(value: Any, unit: str, low: float, high: float) -> tuple[str, Any] | None:
    """Return the unit in which numbers were likely meant, and their values in `unit`.

    The first common unit is taken that brings all numbers between `low` and `high`. None if there is none.
    """
    for other, factor in _OTHER_UNITS.get(unit, {}).items():
        scaled = np.asarray(value, dtype=float) * factor
        if np.all((low <= scaled) & (scaled <= high)):
            return other, np.vectorize(lambda number: float(f"{number:.12g}"))(scaled).tolist()
    return None


@dataclasses.dataclass(frozen=True)
class Parameter:
    """Specification of one parameter. `low` and `high` bound each number (of a matrix, each eigenvalue)."""

    unit: str
    meaning: str
    shape: Shape
    low: float
    high: float
    optional: bool

    @property
    def bounds(self) -> str:
        """Description of the allowed range, with the unit."""
        return f"between {self.low:g} and {self.high:g}" + (f" {self.unit}" if self.unit else "")

    @property
    def allowed(self) -> str:
        """Description of the allowed values."""
        kind = {
            "scalar": "a number",
            "vector": "three numbers, each",
            "direction": f"a direction, three numbers (length above {SHORTEST:g}), each",
            "quaternion": f"four numbers, not all zero (length above {SHORTEST:g}), scalar first, each",
            "matrix": "one number, three (a diagonal) or a symmetric 3x3 matrix, with eigenvalues",
            "list": "a list of numbers, each",
        }[self.shape]
        return f"{kind} {self.bounds}"

    def refusal(self, name: str, given: str, value: Any = None) -> str:
        """Return the error message for a value: the allowed ones, the given one, and the likely value.

        Args:
            name: the parameter's name.
            given: the given value as text.
            value: the given numbers (an array), if there are any.
        """
        size = np.shape(value)
        if self.shape == "matrix" and size == (3, 3) and not _is_symmetric(value):
            given = f"{given}, not symmetric"
        scalar = value is not None and self.shape == "scalar" and size == ()
        message = f"{name} must be {self.bounds if scalar else self.allowed} (got {given})"
        if value is None or self.shape == "matrix" or (size == ()) != (self.shape == "scalar"):
            return message
        beyond = np.any((value < self.low) | (value > self.high))
        meant = self._in_other_unit(value) if beyond else None
        return f"{message}. Did you mean {numbers_text(meant[1])} ({given} {meant[0]})?" if meant else message

    def refusal_of_text(self, name: str, text: str) -> str:
        """Return the error message for a text, such as a number with its unit."""
        message = f"{name} must be {self.allowed} (got {shown(text)})"
        found = re.fullmatch(r"([-+.\deE]*\d\.?) *([a-zA-Z][\w/]*)", text.strip())
        factor = {self.unit: 1.0, **_OTHER_UNITS.get(self.unit, {})}.get(found[2]) if found else None
        if found is None or factor is None or self.shape != "scalar":
            return message
        return f"{message}. Did you mean {numbers_text(float(found[1]) * factor)}?"

    def _in_other_unit(self, value: Any) -> tuple[str, Any] | None:
        """Return the likely unit of a value and its conversion; None if no conversion would be typical."""
        low, high = TYPICAL.get(self.unit, (np.inf, -np.inf))
        return in_other_unit(value, self.unit, max(low, self.low), min(high, self.high))


def parameter(
    unit: str,
    meaning: str,
    *,
    shape: Shape = "scalar",
    low: float,
    high: float,
    default: Any = dataclasses.MISSING,
) -> Any:
    """Return a dataclass field for a physical parameter (see `Parameter`); default None makes it optional."""
    stated = Parameter(unit, meaning, shape, low, high, optional=default is None)
    extra = {} if default is dataclasses.MISSING else {"default": default}
    return eqx.field(converter=_converter(stated), metadata={"parameter": stated}, **extra)


def place(
    meaning: str, *, low: float = 0.0, default: Any = dataclasses.MISSING, kw_only: bool = False
) -> Any:
    """Return a field for a place on the rod, as a fraction of its length. It is static, not traced."""
    stated = Parameter("", f"{meaning}, as a part of the length", "scalar", low, 1.0, optional=False)
    extra: dict[str, Any] = {} if default is dataclasses.MISSING else {"default": default}
    return eqx.field(
        static=True, kw_only=kw_only, converter=_place_number, metadata={"parameter": stated}, **extra
    )


def places(meaning: str) -> Any:
    """Return an optional field for several places on the rod, as fractions of its length; static."""
    stated = Parameter("", f"{meaning}, as parts of the length", "list", 0.0, 1.0, optional=True)
    return eqx.field(static=True, default=None, converter=_place_numbers, metadata={"parameter": stated})


@dataclasses.dataclass(frozen=True)
class Choice:
    """Specification of a field that holds one or several of a set of words."""

    meaning: str
    allowed: tuple[Any, ...]
    many: bool

    def allows(self, value: Any) -> bool:
        """True if a value is one of the allowed words, or a collection of different ones."""
        if self.many and not isinstance(value, tuple | list):
            return False
        several = list(value) if self.many else [value]
        # also compare the class: 1 is not True
        known = all(
            any(type(each) is type(word) and each == word for word in self.allowed) for each in several
        )
        return known and len({str(each) for each in several}) == len(several)

    @property
    def words(self) -> str:
        """Description of the allowed values."""
        listed = ", ".join(str(value).lower() for value in self.allowed)
        return f"a list of different ones of {listed}" if self.many else listed


def choice(meaning: str, allowed: tuple[Any, ...], default: Any) -> Any:
    """Return a dataclass field with one of the allowed words, or several if the default is a tuple."""
    stated = Choice(meaning, allowed, isinstance(default, tuple))
    convert = (lambda given: tuple(given) if isinstance(given, list) else given) if stated.many else None
    extra: dict[str, Any] = {} if convert is None else {"converter": convert}
    return eqx.field(static=True, default=default, metadata={"choice": stated}, **extra)


@dataclasses.dataclass(frozen=True)
class Slot:
    """Specification of a field that holds a part, or (`many`) a tuple of parts, of a family of classes."""

    meaning: str
    family: type
    many: bool
    optional: bool


def slot(meaning: str, family: type, *, many: bool = False, default: Any) -> Any:
    """Return a dataclass field for a part, or parts (see `parts.Part`); default None makes it optional."""
    stated = Slot(meaning, family, many, optional=default is None)

    def several(given: Any) -> Any:
        if isinstance(given, family):
            return (given,)
        return tuple(given) if isinstance(given, list) else given

    convert = several if many else None
    extra: dict[str, Any] = {} if convert is None else {"converter": convert}
    return eqx.field(default=default, metadata={"part": stated}, **extra)


class Parametrised(eqx.Module):
    """Base of systems and their parts: parameters, stated in the class and passed by name."""

    def __new__(cls, *args: Any, **given: Any) -> Self:
        """Raise `ParameterError` that lists the known names; Python's own message would not."""
        for name in given.keys() - {field.name for field in dataclasses.fields(cls)}:
            # a class may define its own constructor
            stated = inspect.signature(cls.__init__).parameters
            if name in stated or any(each.kind is each.VAR_KEYWORD for each in stated.values()):
                continue
            raise ParameterError(unknown_parameter(cls, name, [each for each in stated if each != "self"]))
        return super().__new__(cls, *args, **given)

    @classmethod
    def parameters(cls) -> dict[str, Parameter]:
        """Return the physical parameters by name, with unit, meaning and allowed range."""
        return parameters_of(cls)

    def __repr__(self) -> str:
        units = {name: parameter.unit for name, parameter in parameters_of(type(self)).items()}
        return object_text(self, units, always=("nodes", "length"))


def unknown_parameter(cls: type, name: Any, known: Iterable[str]) -> str:
    """Return the error message for an unknown parameter name."""
    known = list(known)
    return (
        f"{cls.__name__} has no parameter {name!r}; there are {', '.join(known)}{did_you_mean(name, known)}"
    )


def choices_of(cls: type) -> dict[str, Choice]:
    """Return the choices of a class, by name."""
    return _stated(cls, "choice")


def slots_of(cls: type) -> dict[str, Slot]:
    """Return the slots for parts of a class, by name."""
    return _stated(cls, "part")


def check_fields(owner: Any) -> None:
    """Raise `ParameterError` unless all parameters, choices and parts of an object are allowed."""
    for name, parameter in parameters_of(type(owner)).items():
        checked(name, getattr(owner, name), parameter)
    for name, stated in choices_of(type(owner)).items():
        given = getattr(owner, name)
        if not stated.allows(given):
            raise ParameterError(f"{name} is {given!r}; allowed is {stated.words}")
    for name, slot in slots_of(type(owner)).items():
        given = getattr(owner, name)
        several = given if slot.many and isinstance(given, tuple) else (given,)
        if given is None and slot.optional:
            continue
        for each in several:
            if not isinstance(each, slot.family):
                found = type(each).__name__
                raise ParameterError(f"{name} holds a {found}; allowed is a {slot.family.__name__.lower()}")


def parameters_of(cls: type) -> dict[str, Parameter]:
    """Return the parameters of a class, by name."""
    return _stated(cls, "parameter")


def _stated(cls: type, what: str) -> dict[str, Any]:
    stated = {field.name: field.metadata.get(what) for field in dataclasses.fields(cls)}
    return {name: each for name, each in stated.items() if each is not None}


def checked(name: str, value: Any, parameter: Parameter) -> None:
    """Raise `ParameterError` unless the value is allowed. Tracers have no values and are not checked."""
    if value is None and parameter.optional:
        return
    if isinstance(value, jax.core.Tracer):
        return
    expected = {"scalar": (), "vector": (3,), "direction": (3,), "quaternion": (4,), "matrix": (3, 3)}.get(
        parameter.shape
    )
    try:
        array = np.asarray(value) if not np.ma.is_masked(value) else np.array("masked")
    except (TypeError, ValueError):
        array = np.array("ragged")
    if array.dtype.kind not in "fiu":
        if isinstance(value, str):
            raise ParameterError(parameter.refusal_of_text(name, value))
        raise ParameterError(parameter.refusal(name, shown(value)))
    if (array.ndim != 1 or array.size == 0) if expected is None else array.shape != expected:
        raise ParameterError(parameter.refusal(name, numbers_text(array.tolist())))
    if not _is_within(array, parameter):
        raise ParameterError(parameter.refusal(name, numbers_text(array.tolist()), array))


def _is_symmetric(array: np.ndarray) -> bool:
    return np.allclose(array, array.T, rtol=1e-9, atol=0.0)


def _is_within(array: np.ndarray, parameter: Parameter) -> bool:
    """True if numbers of the right shape are allowed."""
    if not np.all(np.isfinite(array)):
        return False
    if parameter.shape in ("direction", "quaternion") and not math.hypot(*array) > SHORTEST:
        return False
    if parameter.shape == "matrix":
        if not _is_symmetric(array):
            return False
        array = np.linalg.eigvalsh(array)
    return bool(np.all((parameter.low <= array) & (array <= parameter.high)))


def _converter(parameter: Parameter) -> Callable[[Any], Any]:
    def convert(value: Any) -> Any:
        if value is None or isinstance(value, jax.core.Tracer):
            return _as_matrix(value) if parameter.shape == "matrix" and value is not None else value
        try:
            array = np.asarray(value)
        except (TypeError, ValueError):  # a ragged list
            return value  # `checked` names it: a converter does not know the parameter's name
        if array.dtype.kind not in "fiu":
            return value
        array = array.astype(float)
        return _as_matrix(array) if parameter.shape == "matrix" else array

    return convert


def _plain_number(value: Any) -> Any:
    """Return a number as a Python float, which can be compared and hashed; `checked` judges anything else."""
    return (
        float(value) if isinstance(value, int | float | np.number) and not isinstance(value, bool) else value
    )


def _place_number(value: Any) -> Any:
    """Return a place as a Python float, rounded to an end of the rod if it is within `AT_END` of it."""
    number = _plain_number(value)
    near = [end for end in (0.0, 1.0) if isinstance(number, float) and abs(number - end) < AT_END]
    return near[0] if near else number


def _place_numbers(value: Any) -> Any:
    """Return places as a tuple, which can be compared and hashed; `checked` judges anything else."""
    return tuple(map(_place_number, value)) if isinstance(value, tuple | list | np.ndarray) else value


def _as_matrix(value: Any) -> Any:
    """Return one number or three as a diagonal matrix; `checked` judges anything else."""
    numeric = np if isinstance(value, np.ndarray) else jax.numpy
    if value.shape == ():
        return value * np.eye(3)
    return numeric.diag(value) if value.shape == (3,) else value


# names with dots, such as `loads.0.mass`


def value_at(owner: Any, path: str) -> Any:
    """Return a parameter, or a part, at a path such as `loads.0.mass`.

    Raises:
        ParameterError: it does not exist; the message lists the names that do.
    """
    for part in path.split("."):
        owner = _entry(owner, part, path)
    return owner


def owner_at(owner: Any, path: str) -> tuple[Any, str]:
    """Return the robot or part that a parameter belongs to, and the parameter's own name.

    Raises:
        ParameterError: there is no such part.
    """
    place, _, last = path.rpartition(".")
    return (value_at(owner, place) if place else owner), last


def parameter_at(owner: Any, path: str) -> Parameter | None:
    """Return the statement of a parameter; None if there is no such parameter or part."""
    try:
        found, name = owner_at(owner, path)
    except ParameterError:
        return None
    return parameters_of(type(found)).get(name) if dataclasses.is_dataclass(found) else None


def with_value(owner: Any, path: str, value: Any, name: str) -> Any:
    """Return a part, or a tuple of parts, with another value at a path such as `0.mass`.

    `name` is the whole name, for the error.
    """
    first, _, rest = path.partition(".")
    inner = _entry(owner, first, name)
    changed = with_value(inner, rest, value, name) if rest else value
    if isinstance(owner, tuple):
        return tuple(changed if k == int(first) else each for k, each in enumerate(owner))
    return dataclasses.replace(owner, **{first: changed})


def _entry(owner: Any, part: str, name: str) -> Any:
    """Return a field of a robot or part, or an entry of a tuple of parts. Raises `ParameterError`."""
    several = isinstance(owner, tuple)
    stated = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
    known = [str(k) for k in range(len(owner))] if several else [field.name for field in stated]
    if part not in known:
        raise ParameterError(
            f"there is no parameter {name!r}: no {part!r} among {', '.join(known) or 'nothing'}"
        )
    return owner[int(part)] if several else getattr(owner, part)
