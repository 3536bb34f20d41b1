"""Parameters, choices and parts of robots: each is stated once, beside its field.

A statement has the meaning, the unit and the allowed values. `System.replace`, robot files, their JSON Schema
and `knode-cosserat info` use the same statement: it checks values, reads them from a file, writes them, and
describes them in the schema.
"""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import math
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, Literal, NamedTuple, Self, get_args

import equinox as eqx
import jax
import numpy as np

from knode_cosserat._files.yaml_text import UNKNOWN_HERE, did_you_mean, excerpt, flow
from knode_cosserat._reprs import object_text
from knode_cosserat._units import UnitError, factors_of, in_unit
from knode_cosserat.errors import KnodeCosseratError

#: smallest length of a direction or quaternion: the square of a much smaller length underflows
SHORTEST = 1e-9


class ParameterError(KnodeCosseratError, ValueError):
    """A parameter's name or value is not allowed; the message gives the value and the allowed range."""

    code = "parameter"


Shape = Literal["scalar", "vector", "direction", "quaternion", "matrix", "list"]

#: fraction of the rod's length: a place nearer to an end than this is at the end
AT_END = 1e-9
#: pattern of a name, or none
NAME = "([A-Za-z][A-Za-z0-9_-]*)?"
#: pattern of a number with its unit in a robot file
WITH_UNIT = r"^\s*[-+]?[.\d]\S*\s*\S+"
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
#: by unit: other common units with their factors, the likeliest first
_OTHER_UNITS: dict[str, dict[str, float]] = {
    "m": factors_of("mm", "um"),
    "Pa": factors_of("GPa", "MPa", "kPa"),
    "kg/m3": factors_of("g/cm3", "g/m3"),
    "m/s2": factors_of("mm/s2"),
    "rad": factors_of("degrees"),
}
_SIZES = {"scalar": (), "vector": (3,), "direction": (3,), "quaternion": (4,), "matrix": (3, 3)}
#: constraint of the schema on an array
_NOT_ALL_ZERO = {"contains": {"not": {"const": 0}}}


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


class Doubt(NamedTuple):
    """Doubt of a parameter as a ruler, a data sheet or a photograph leaves it: standard deviations.

    Identification searches for a parameter with a doubt (`identification.part_effects`): `relative` is that
    of a common factor of all its numbers, `absolute` that of each number, in its unit. An optional parameter
    without a value has that of the property `of` of its owner, or else is not in doubt. A search begins at
    the number `begin` of absolute deviations, where zero has no derivative. `basic` parameters are always
    searched for. Numbers of a list, or of several parts, have an addend in `common`, unless another parameter
    states it.
    """

    relative: float = 0.0
    absolute: float = 0.0
    of: str = ""
    begin: float = 0.0
    basic: bool = False
    common: bool = True


@dataclasses.dataclass(frozen=True)
class Parameter:
    """Statement of numbers. `low` and `high` bound each number (of a matrix, each eigenvalue)."""

    unit: str
    meaning: str
    shape: Shape
    low: float
    high: float
    optional: bool
    doubt: Doubt | None = None

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

    def check(self, name: str, value: Any, text: str | None = None) -> None:
        """Raise `ParameterError` unless a value is allowed; `text` is the value as the user wrote it.

        Tracers have no values and are not checked.
        """
        if (value is None and self.optional) or isinstance(value, jax.core.Tracer):
            return
        try:
            array = np.asarray(value) if not np.ma.is_masked(value) else np.array("masked")
        except (TypeError, ValueError):
            array = np.array("ragged")
        if array.dtype.kind not in "fiu":
            hint = self._hint_of_text(value) if isinstance(value, str) else ""
            raise ParameterError(f"{name} must be {self.allowed} (got {text or excerpt(value)}){hint}")
        text, size = text or numbers_text(array.tolist()), _SIZES.get(self.shape)
        if (array.ndim != 1 or array.size == 0) if size is None else array.shape != size:
            raise ParameterError(f"{name} must be {self.allowed} (got {text})")
        if self._contains(array):
            return
        allowed, hint = self.allowed if array.ndim else self.bounds, ""
        if self.shape == "matrix":
            text += "" if _is_symmetric(array) else ", not symmetric"
        elif np.any((array < self.low) | (array > self.high)):
            low, high = TYPICAL.get(self.unit, (np.inf, -np.inf))
            meant = in_other_unit(array, self.unit, max(low, self.low), min(high, self.high))
            hint = f". Did you mean {numbers_text(meant[1])} ({text} {meant[0]})?" if meant else ""
            # a length in place of a part of the length, say
            hint = hint if self.unit else f": {self.meaning}"
        raise ParameterError(f"{name} must be {allowed} (got {text}){hint}")

    def _contains(self, array: np.ndarray) -> bool:
        """True if finite numbers of the right shape are within the bounds."""
        if not np.all(np.isfinite(array)):
            return False
        if self.shape in ("direction", "quaternion") and not math.hypot(*array) > SHORTEST:
            return False
        if self.shape == "matrix":
            if not _is_symmetric(array):
                return False
            array = np.linalg.eigvalsh(array)
        return bool(np.all((self.low <= array) & (array <= self.high)))

    def _hint_of_text(self, text: str) -> str:
        """Return the hint for a text that is a number with its unit; else an empty string."""
        with contextlib.suppress(UnitError):
            number = in_unit(text, self.unit)
            if number is not None and self.shape == "scalar":
                return f". Did you mean {numbers_text(number)}?"
        return ""

    def in_si(self, name: str, value: Any) -> Any:
        """Return a value in which numbers may have units, such as `250 mm`, without them.

        Raises:
            ParameterError: a unit that is not known, or of another kind.
        """
        if isinstance(value, list):
            return [self.in_si(name, one) for one in value]
        try:
            number = in_unit(value, self.unit) if isinstance(value, str) else None
        except UnitError as error:
            said = f"{error}" if self.unit else f"{error}, {self.meaning}"
            raise ParameterError(f"{name} must be {self.allowed} (got {excerpt(value)}): {said}") from None
        return value if number is None else number

    def read(self, name: str, value: Any) -> Any:
        """Return a value of a file, whose numbers may have units. Raises `ParameterError`."""
        value = self.in_si(name, value)
        array = _array(value)
        if array is not None and self.shape == "matrix" and array.shape in ((), (3,)):
            array = np.diag(np.broadcast_to(array, 3))
        if array is None and not isinstance(value, str):
            array = np.asarray(None)
        self.check(name, value if array is None else array, excerpt(value))
        return value

    def written(self, value: Any) -> str:
        """Return numbers in the shortest form that reads back equal: one for a multiple of the identity."""
        array = np.asarray(value, dtype=float)
        if array.shape == (3, 3) and np.array_equal(array, np.diag(np.diag(array))):
            array = np.diag(array)
            array = array[0] if np.all(array == array[0]) else array
        return flow(array.tolist())

    def schema(self, default: Any, families: dict[str, Any]) -> dict[str, Any]:
        """Return the JSON Schema of the values."""
        number = {"type": "number", "minimum": self.low, "maximum": self.high}
        one: Any = {"anyOf": [number, {"type": "string", "pattern": WITH_UNIT}]}
        shape: dict[str, Any] = {
            "scalar": one,
            "vector": _array_schema(one, 3),
            "direction": {**_array_schema(one, 3), **_NOT_ALL_ZERO},
            "quaternion": {**_array_schema(one, 4), **_NOT_ALL_ZERO},
            "list": {"type": "array", "items": one, "minItems": 1},
            "matrix": {"anyOf": [one, _array_schema(one, 3), _square_schema(one, self.high)]},
        }[self.shape]
        unit = f" ({self.unit})" if self.unit else ""
        stated = {**_or_null(shape, self.optional), "description": f"{self.meaning}{unit}"}
        if default is not dataclasses.MISSING and default is not None:
            stated["default"] = np.asarray(default, dtype=float).tolist()
        return stated


def _is_symmetric(array: np.ndarray) -> bool:
    return np.allclose(array, array.T, rtol=1e-9, atol=0.0)


def _array(value: Any) -> np.ndarray | None:
    """Return a number, a list of numbers or a list of lists as an array; None for anything else."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return np.asarray(float(value))
        except OverflowError:
            return np.asarray(np.inf)
    if not isinstance(value, list) or not value:
        return None
    # no allowed value is deeper than a list of lists; a file could nest without end
    if any(isinstance(inner, list) for row in value if isinstance(row, list) for inner in row):
        return None
    rows = [_array(row) for row in value]
    if any(row is None for row in rows) or len({row.shape for row in rows if row is not None}) > 1:
        return None
    return np.array(rows, dtype=float)


def _array_schema(one: Any, count: int) -> dict[str, Any]:
    return {"type": "array", "items": one, "minItems": count, "maxItems": count}


def _square_schema(one: Any, high: float) -> dict[str, Any]:
    """Schema of a 3x3 matrix: diagonal within the eigenvalues' bounds, entries within the upper one."""
    other = {"type": "number", "minimum": -high, "maximum": high}
    rows = [[one if row == column else other for column in range(3)] for row in range(3)]
    matrix = [{"type": "array", "prefixItems": row, "minItems": 3, "maxItems": 3} for row in rows]
    return {"type": "array", "prefixItems": matrix, "minItems": 3, "maxItems": 3}


def _or_null(shape: dict[str, Any], optional: bool) -> dict[str, Any]:
    return {"anyOf": [shape, {"type": "null"}]} if optional else shape


@dataclasses.dataclass(frozen=True)
class Choice:
    """Statement of a field that holds one or several of a set of words."""

    meaning: str
    allowed: tuple[Any, ...]
    many: bool

    optional: ClassVar[bool] = False

    @property
    def words(self) -> str:
        """Description of the allowed values."""
        listed = ", ".join(str(value).lower() for value in self.allowed)
        return f"a list of different ones of {listed}" if self.many else listed

    def check(self, name: str, value: Any, text: str | None = None) -> None:
        """Raise `ParameterError` unless a value is one of the words, or a collection of different ones."""
        several = [value] if not self.many else list(value) if isinstance(value, tuple | list) else [None]
        # also compare the class: 1 is not True
        known = [any(type(one) is type(word) and one == word for word in self.allowed) for one in several]
        if not all(known) or len({str(one) for one in several}) < len(several):
            raise ParameterError(f"{name} is {text or repr(value)}; allowed is {self.words}")

    def read(self, name: str, value: Any) -> Any:
        """Return a value of a file. Raises `ParameterError`."""
        self.check(name, value, excerpt(value))
        return value

    def written(self, value: Any) -> str:
        """Return the text of a value in a file."""
        return flow(list(value) if isinstance(value, tuple) else value)

    def schema(self, default: Any, families: dict[str, Any]) -> dict[str, Any]:
        """Return the JSON Schema of the values."""
        one: dict[str, Any] = {"enum": list(self.allowed)}
        if self.many:
            one, default = {"type": "array", "items": one, "uniqueItems": True}, list(default)
        return {**one, "description": self.meaning, "default": default}


@dataclasses.dataclass(frozen=True)
class _Text:
    """Statement of a field that holds a name, or nothing."""

    meaning: str

    optional: ClassVar[bool] = False

    def check(self, name: str, value: Any, text: str | None = None) -> None:
        """Raise `ParameterError` unless a value is a name."""
        if not isinstance(value, str) or not re.fullmatch(NAME, value):
            raise ParameterError(
                f"{name} is {text or excerpt(value)}; allowed is a name of letters, digits, - and _"
            )

    def read(self, name: str, value: Any) -> Any:
        """Return a value of a file. Raises `ParameterError`."""
        self.check(name, value, excerpt(value))
        return value

    def written(self, value: Any) -> str:
        """Return the text of a value in a file."""
        return flow(value)

    def schema(self, default: Any, families: dict[str, Any]) -> dict[str, Any]:
        """Return the JSON Schema of the values."""
        return {"type": "string", "pattern": f"^{NAME}$", "description": self.meaning, "default": default}


@dataclasses.dataclass(frozen=True)
class _Slot:
    """Statement of a field that holds a part, or (`many`) a tuple of parts, of a family of classes."""

    meaning: str
    family: Any
    many: bool
    optional: bool

    def check(self, name: str, value: Any, text: str | None = None) -> None:
        """Raise `ParameterError` unless a value is a part of the family, or parts."""
        if value is None and self.optional:
            return
        for part in value if self.many and isinstance(value, tuple) else (value,):
            if not isinstance(part, self.family):
                family = self.family.__name__.lower()
                raise ParameterError(f"{name} holds a {type(part).__name__}; allowed is a {family}")

    def read(self, name: str, value: Any) -> Any:
        """Return a part from a mapping with its kind, or parts from a list. Raises `ParameterError`."""
        if not self.many:
            return self._part(name, value)
        if not isinstance(value, list):
            known = ", ".join(kinds_of(self.family))
            raise ParameterError(
                f"{name} is {excerpt(value)}; allowed is a list of mappings, each with a kind: {known}"
            )
        return tuple(self._part(f"{name}.{k}", one) for k, one in enumerate(value))

    def _part(self, name: str, value: Any) -> Any:
        known = kinds_of(self.family)
        names = ", ".join(known)
        if not isinstance(value, dict) or "kind" not in value:
            raise ParameterError(f"{name} is {excerpt(value)}; allowed is a mapping with a kind: {names}")
        kind = value["kind"]
        if not isinstance(kind, str) or kind not in known:
            hint = did_you_mean(kind, known) or UNKNOWN_HERE
            raise ParameterError(f"{name}.kind is {excerpt(kind)}; allowed is {names}{hint}")
        return read_object(known[kind], {key: value[key] for key in value if key != "kind"}, name)

    def flowed(self, value: Any) -> str:
        """Return the text of a part, or of several, on one line."""
        return f"[{', '.join(map(_part_text, value))}]" if self.many else _part_text(value)

    def written(self, value: Any) -> str:
        """Return the text of a part in a file, or lines of several."""
        if not self.many:
            return _part_text(value)
        return "".join(f"\n    - {_part_text(part)}" for part in value)

    def schema(self, default: Any, families: dict[str, Any]) -> dict[str, Any]:
        """Return the JSON Schema of the values; the family's is added to `families`."""
        family = self.family.__name__.lower()
        if family not in families:
            kinds = kinds_of(self.family)
            families[family] = {}  # before its members, which may hold parts of the same family
            for kind, cls in kinds.items():
                made = object_schema(cls, families, kind={"const": kind, "description": "class of the part"})
                families[f"{family}.{kind}"] = {**made, "required": ["kind", *made["required"]]}
            families[family] = {
                "type": "object",
                "required": ["kind"],
                "properties": {"kind": {"enum": list(kinds)}},
                "allOf": [schema_if_kind(kind, {"$ref": f"#/$defs/{family}.{kind}"}) for kind in kinds],
            }
        one: dict[str, Any] = {"$ref": f"#/$defs/{family}"}
        if self.many:
            one = {"type": "array", "items": one}
            # an absent key means none, so an empty list is refused
            one |= {"minItems": 1} if self.optional else {}
        return {**_or_null(one, self.optional), "description": self.meaning}


def schema_if_kind(kind: str, schema: dict[str, Any]) -> dict[str, Any]:
    """Return a schema that applies to mappings of a kind."""
    return {"if": {"properties": {"kind": {"const": kind}}, "required": ["kind"]}, "then": schema}


# fields with statements


def _field(stated: Any, default: Any, convert: Callable[[Any], Any] | None = None, **options: Any) -> Any:
    options |= {} if default is dataclasses.MISSING else {"default": default}
    options |= {} if convert is None else {"converter": convert}
    return eqx.field(metadata={"stated": stated}, **options)


def parameter(
    unit: str,
    meaning: str,
    *,
    shape: Shape = "scalar",
    low: float,
    high: float,
    default: Any = dataclasses.MISSING,
    doubt: Doubt | None = None,
) -> Any:
    """Return a dataclass field for a physical parameter; default None makes it optional.

    Args:
        unit: SI unit, such as "N m2"; empty for a number without one.
        meaning: a few words, for errors, files and the schema.
        shape: "scalar" (a number), "vector" (3 numbers), "direction" (3, not all zero), "quaternion" (4,
            scalar first), "matrix" (symmetric 3 x 3; also one number, or its diagonal) or "list" (any count).
        low: lowest allowed number; of a matrix, lowest eigenvalue.
        high: highest one.
        default: value by default; without one the parameter is required.
        doubt: how well a ruler or a data sheet usually knows it; None: identification does not search it.

    Raises:
        ValueError: another shape.
    """
    if shape not in get_args(Shape):
        raise ValueError(f"shape is {shape!r}; allowed is {', '.join(get_args(Shape))}")
    stated = Parameter(unit, meaning, shape, low, high, optional=default is None, doubt=doubt)
    return _field(stated, default, _as_matrix if shape == "matrix" else _as_array)


def place(
    meaning: str, *, low: float = 0.0, default: Any = dataclasses.MISSING, kw_only: bool = False
) -> Any:
    """Return a field for a place on the rod, as a fraction of its length. It is static, not traced."""
    stated = Parameter("", f"{meaning}, as a part of the length", "scalar", low, 1.0, optional=False)
    return _field(stated, default, _as_place, static=True, kw_only=kw_only)


def places(meaning: str) -> Any:
    """Return an optional field for several places on the rod, as fractions of its length; static."""
    stated = Parameter("", f"{meaning}, as parts of the length", "list", 0.0, 1.0, optional=True)
    return _field(
        stated, None, lambda value: _as_tuple(value, (tuple, list, np.ndarray), _as_place), static=True
    )


def choice(meaning: str, allowed: tuple[Any, ...], default: Any) -> Any:
    """Return a dataclass field with one of the allowed words, or several if the default is a tuple."""
    stated = Choice(meaning, allowed, isinstance(default, tuple))
    return _field(stated, default, _as_tuple if stated.many else None, static=True)


def text(meaning: str) -> Any:
    """Return a dataclass field for a name; by default it is empty."""
    return _field(_Text(meaning), "", static=True)


def slot(meaning: str, family: type, *, many: bool = False, default: Any) -> Any:
    """Return a dataclass field for a part, or parts (see `parts.Part`); default None makes it optional."""

    def several(value: Any) -> Any:
        return (value,) if isinstance(value, family) else _as_tuple(value)

    return _field(_Slot(meaning, family, many, optional=default is None), default, several if many else None)


# Converters do not know the name of their field: a value that they cannot convert stays for `check`.


def _as_array(value: Any) -> Any:
    """Return numbers as an array of floats."""
    if value is None or isinstance(value, jax.core.Tracer):
        return value
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # a ragged list
        return value
    return array.astype(float) if array.dtype.kind in "fiu" else value


def as_number(value: Any) -> float | None:
    """Return a number as a float; None for an absent, a traced or a batched one."""
    return None if value is None or isinstance(value, jax.core.Tracer) or np.ndim(value) else float(value)


def known_size(value: Any) -> float:
    """Return the largest size of numbers, also those of a batch; 0 for absent or traced ones."""
    if value is None or isinstance(value, jax.core.Tracer):
        return 0.0
    return float(np.max(np.abs(value), initial=0.0))


def _as_matrix(value: Any) -> Any:
    """Return one number or three as a diagonal matrix."""
    value = _as_array(value)
    if not isinstance(value, np.ndarray | jax.Array) or value.dtype.kind not in "fiu":
        return value
    if value.shape == ():
        return value * np.eye(3)
    numeric = np if isinstance(value, np.ndarray) else jax.numpy
    return numeric.diag(value) if value.shape == (3,) else value


def _as_place(value: Any) -> Any:
    """Return a place as a float, which can be compared and hashed; exactly at an end if within `AT_END`."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return value
    return next((end for end in (0.0, 1.0) if abs(value - end) < AT_END), float(value))


def _as_tuple(value: Any, kinds: Any = list, convert: Callable[[Any], Any] = lambda one: one) -> Any:
    return tuple(map(convert, value)) if isinstance(value, kinds) else value


# classes with statements


def stated_of(cls: type, kind: Any = object) -> dict[str, Any]:
    """Return the statements of a class's fields by name, or those of one kind."""
    stated = {field.name: field.metadata.get("stated") for field in dataclasses.fields(cls)}
    return {name: one for name, one in stated.items() if one is not None and isinstance(one, kind)}


def parameters_of(cls: type) -> dict[str, Parameter]:
    """Return the parameters of a class, by name."""
    return stated_of(cls, Parameter)


def slots_of(cls: type) -> dict[str, _Slot]:
    """Return the slots for parts of a class, by name."""
    return stated_of(cls, _Slot)


def kinds_of(family: Any) -> dict[str, Any]:
    """Return the classes of a family that robot files can name: the family and its subclasses."""
    kind = vars(family).get("kind")  # a class without its own kind is not in files
    kinds = {} if inspect.isabstract(family) or not kind else {kind: family}
    for member in family.__subclasses__():
        kinds |= kinds_of(member)
    return dict(sorted(kinds.items()))


def in_order(cls: type) -> dict[str, Any]:
    """Return the statements of a class by name: parameters, then choices, then parts."""
    return parameters_of(cls) | stated_of(cls, Choice) | stated_of(cls, _Text) | slots_of(cls)


class Parametrised(eqx.Module):
    """Base of systems and their parts: parameters, stated in the class and passed by name."""

    #: name in robot files; empty if none can describe it
    kind: ClassVar[str] = ""
    #: for the schema: sets of optional entries, of which one is required
    alternatives: ClassVar[tuple[tuple[str, ...], ...]] = ()

    def __new__(cls, *args: Any, **fields: Any) -> Self:
        """Raise `ParameterError` that lists the known names; Python's own message would not."""
        for name in fields.keys() - {field.name for field in dataclasses.fields(cls)}:
            # a class may define its own constructor
            stated = inspect.signature(cls.__init__).parameters
            if name in stated or any(one.kind is one.VAR_KEYWORD for one in stated.values()):
                continue
            raise ParameterError(unknown_parameter(cls, name, [one for one in stated if one != "self"]))
        return super().__new__(cls, *args, **fields)

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


def check_fields(owner: Any) -> None:
    """Raise `ParameterError` unless all parameters, choices and parts of an object are allowed."""
    for name, stated in in_order(type(owner)).items():
        stated.check(name, getattr(owner, name))


# mappings of files


def require_keys(mapping: Mapping[Any, Any], known: Iterable[str], required: Iterable[str]) -> None:
    """Raise `ParameterError` for a key of a mapping that is unknown, or missing."""
    known, required = list(known), list(required)
    for key in mapping:
        if key not in known:
            raise ParameterError(
                f"the key {excerpt(key)} is unknown; allowed is {', '.join(known)}{did_you_mean(key, known)}"
            )
    for key in required:
        if key not in mapping:
            raise ParameterError(f"the key {key!r} is missing; required is {', '.join(required)}")


def read_object(cls: type, values: Mapping[Any, Any], name: str) -> Any:
    """Return an object from the mapping of its parameters, choices and parts in a file.

    `name` is that of its field, such as `loads.0`; empty for the robot itself. Raises `ParameterError`.
    """
    stated = in_order(cls)
    # an empty optional value counts as absent
    values = {k: v for k, v in values.items() if v is not None or k not in stated or not stated[k].optional}
    defaults = {field.name: field.default for field in dataclasses.fields(cls)}
    required = [key for key in parameters_of(cls) if defaults[key] is dataclasses.MISSING]
    try:
        require_keys(values, [*stated, *(() if name else ("nodes",))], required)
    except ParameterError as error:
        raise ParameterError(f"{name or 'parameters'}: {error}") from None
    inner, fields = f"{name}." if name else "", {}
    for key, value in values.items():
        if key in stated:
            fields[key] = stated[key].read(inner + key, value)
        elif isinstance(value, int) and not isinstance(value, bool):
            fields[key] = value
        else:
            raise ParameterError(f"{key} is {excerpt(value)}; allowed is a whole number, 2 or more")
    try:
        return cls(**fields)
    except ParameterError as error:
        raise ParameterError(f"{name}: {error}" if name else str(error)) from None


def _part_text(part: Any) -> str:
    """Return a part's text on one line."""
    if not part.kind:
        raise ParameterError(
            f"a {type(part).__name__} cannot be written to a robot file: it is made of code, not of numbers"
        )
    defaults: dict[str, Any] = {field.name: field.default for field in dataclasses.fields(part)}
    entries = [f"kind: {part.kind}"]
    for name, stated in in_order(type(part)).items():
        value = getattr(part, name)
        is_part = isinstance(stated, _Slot)
        equal: Any = eqx.tree_equal if is_part else np.array_equal
        if value is not None and equal(value, defaults[name]) is not True:
            entries.append(f"{name}: {stated.flowed(value) if is_part else stated.written(value)}")
    return "{" + ", ".join(entries) + "}"


def object_schema(cls: type[Parametrised], families: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Return the JSON Schema of a class's mapping; the families of its parts are added to `families`."""
    defaults = {field.name: field.default for field in dataclasses.fields(cls)}
    known = {name: one.schema(defaults[name], families) for name, one in in_order(cls).items()}
    if {"begin", "end"} <= known.keys():
        # begin < end leaves no room for these values
        known["begin"]["exclusiveMaximum"], known["end"]["exclusiveMinimum"] = 1.0, 0.0
    return {
        "type": "object",
        "description": (cls.__doc__ or cls.__name__).splitlines()[0],
        "properties": known | more,
        "required": [name for name in parameters_of(cls) if defaults[name] is dataclasses.MISSING],
        "additionalProperties": False,
        **({"anyOf": [{"required": list(names)} for names in cls.alternatives]} if cls.alternatives else {}),
    }


# names with dots, such as `loads.0.mass` or `rods.thumb.length`


def value_at(owner: Any, path: str) -> Any:
    """Return a parameter, or a part, at a path such as `loads.0.mass` or `loads.attached-mass.mass`.

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
        owner, name = owner_at(owner, path)
    except ParameterError:
        return None
    return parameters_of(type(owner)).get(name) if dataclasses.is_dataclass(owner) else None


def with_value(owner: Any, path: str, value: Any, name: str) -> Any:
    """Return a part, or a tuple of parts, with another value at a path such as `0.mass`.

    `name` is the whole name, for the error.
    """
    first, _, rest = path.partition(".")
    inner = _entry(owner, first, name)
    changed = with_value(inner, rest, value, name) if rest else value
    if isinstance(owner, tuple):
        place = _index(owner, first, name)
        return (*owner[:place], changed, *owner[place + 1 :])
    return dataclasses.replace(owner, **{first: changed})


def names_of(parts: tuple[Any, ...]) -> list[str]:
    """Return the names of parts in a path: their own names, or else their numbers."""
    return [getattr(part, "name", "") or str(k) for k, part in enumerate(parts)]


def _entry(owner: Any, part: str, name: str) -> Any:
    """Return a field of a robot or part, or an entry of a tuple of parts. Raises `ParameterError`."""
    if isinstance(owner, tuple):
        return owner[_index(owner, part, name)]
    known = [field.name for field in dataclasses.fields(owner)] if dataclasses.is_dataclass(owner) else []
    if part not in known:
        raise _unknown_path(part, name, known)
    return getattr(owner, part)


def _index(parts: tuple[Any, ...], part: str, name: str) -> int:
    """Return the place of a part by its name, its number, or its kind if it is the only one of that kind."""
    known = names_of(parts)
    if part in known:
        return known.index(part)
    same = [k for k, one in enumerate(parts) if getattr(one, "kind", "") == part]
    if len(same) > 1:
        places = ", ".join(known[k] for k in same)
        raise ParameterError(f"{name!r} may be any of several parts of the kind {part}; allowed are {places}")
    if not same:
        kinds = dict.fromkeys(kind for one in parts if (kind := getattr(one, "kind", "")))
        raise _unknown_path(part, name, [*known, *kinds])
    return same[0]


def _unknown_path(part: str, name: str, known: list[str]) -> ParameterError:
    listed = (", ".join(known) or "nothing") + did_you_mean(part, known)
    return ParameterError(f"there is no parameter {name!r}: no {part!r} among {listed}")
