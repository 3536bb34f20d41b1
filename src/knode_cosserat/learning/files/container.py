"""File format for arrays, plain values and objects of known classes, with a checksum.

    knode-cosserat model, format 1, package 0.1.0
    <sha256, hex> <size of the header> <size of the arrays>
    {"arrays": [["<f8", [512, 28]], …], …}                            the header: JSON, ASCII
    the arrays, one after the other, in C order

The checksum covers everything but itself. Values that JSON does not support are stored in the header as an
object with one key: {"$array": 3} is array number 3, {"$scalar": 3} the NumPy scalar in it, {"$tuple": […]} a
tuple, {"$class": "Name", "fields": {…}} an object, {"$dict": [[key, value], …]} a dictionary with keys that
begin with "$". No content of a file is ever executed or imported: class names are looked up among the given
classes.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from knode_cosserat._files import package_version, replacing
from knode_cosserat.errors import KnodeCosseratError

#: largest number of bytes of the header and of the arrays, as a limit for hostile files
MOST_HEADER = 4 * 2**20
MOST_ARRAYS = 2**30
#: largest number of objects in one file, because each takes time to be traced
MOST_OBJECTS = 5_000

#: classes of earlier versions, and the class of the same order that replaced them
EARLIER_CLASSES = {"RK4": "Lobatto4"}
#: fields that classes had in earlier versions
EARLIER_FIELDS = {"Settings": ("elimination",), "NewtonOptions": ("across_steps",)}

_SIZES = {"b": (1,), "i": (1, 2, 4, 8), "u": (1, 2, 4, 8), "f": (2, 4, 8), "c": (8, 16)}
#: accepted array types, in NumPy's notation
_TYPES = {
    np.dtype(f"{order}{kind}{size}").str for kind, sizes in _SIZES.items() for size in sizes for order in "<>"
}
_FIRST = re.compile(rb"[^\n,]{1,99}, format (\d{1,6}), package ([!-~]{1,40})\n")
_SECOND = re.compile(rb"([0-9a-f]{64})( (\d{1,12}) (\d{1,12})\n)")
_ALLOWED = "numbers, text, None, arrays of numbers, and lists, tuples and dictionaries of these"


class ContainerError(KnodeCosseratError, ValueError):
    """A value that cannot be packed or unpacked. The message is one line that does not name the file."""

    code = "file-content"

    def __init__(self, message: str):
        # text from a file may contain line ends and control characters
        line = "".join(letter if letter.isprintable() else " " for letter in message)
        super().__init__(line if len(line) <= 600 else line[:600] + "…")


class UnknownClassError(ContainerError):
    """A file has an object of an unknown class; `name` is the name of the class."""

    code = "unknown-class"

    def __init__(self, message: str, name: str):
        super().__init__(message)
        self.name = name


class Title(NamedTuple):
    """Kind of a file, and version of its format."""

    name: str
    version: int


Classes = Mapping[str, type]


# packing


class Writer:
    """Collects the arrays of values, and converts values to the form of the header."""

    def __init__(self) -> None:
        self._arrays: list[np.ndarray] = []
        self._objects = 0

    def value(self, value: Any, where: str, classes: Classes, *, others: bool = False) -> Any:
        """Return a value in the form of the header.

        Args:
            value: it may contain arrays, and objects of dataclasses and named tuples.
            where: name of the value in messages.
            classes: the known classes, by name.
            others: true to allow other classes; the reader of the file must know them.

        Raises:
            ContainerError: the value contains something that cannot be stored.
        """
        try:
            return self._value(value, where, classes, others)
        except RecursionError:
            raise ContainerError(f"{where} is nested too deep, or contains itself") from None

    def _value(self, value: Any, where: str, classes: Classes, others: bool) -> Any:
        if value is None or type(value) in (bool, int, float, str):
            return value
        if isinstance(value, np.generic):
            return {"$scalar": self._array(value, where)}
        if isinstance(value, np.ndarray | jax.Array):
            return {"$array": self._array(value, where)}
        if has_fields(type(value)):
            return self._object(value, where, classes, others)
        if type(value) in (list, tuple):
            parts = [self._value(part, f"{where}[{i}]", classes, others) for i, part in enumerate(value)]
            return parts if type(value) is list else {"$tuple": parts}
        if type(value) is dict:
            return self._dictionary(value, where, classes, others)
        raise ContainerError(f"{where} is a {type(value).__name__}; allowed is {_ALLOWED}")

    def _array(self, value: Any, where: str) -> int:
        try:
            array = np.asarray(value)
        except (TypeError, jax.errors.TracerArrayConversionError):
            array = np.array(None)
        if array.dtype.str not in _TYPES or isinstance(value, np.ma.MaskedArray):
            kind = (
                type(value).__name__
                if array.dtype.kind == "O"
                else f"{type(value).__name__} of {array.dtype}"
            )
            raise ContainerError(f"{where} is a {kind}; allowed is an array of numbers")
        self._arrays.append(array)
        return len(self._arrays) - 1

    def _object(self, value: Any, where: str, classes: Classes, others: bool) -> Any:
        cls = type(value)
        known = classes.get(cls.__name__)
        if known is None and not others:
            raise ContainerError(
                f"{where} is a {cls.__name__}, which is not a known class; allowed is {_ALLOWED}"
            )
        if known is not None and not same_class(known, cls):
            raise ContainerError(
                f"{where} is of a class {cls.__qualname__} of {cls.__module__}, but that name is taken by a "
                f"class of {known.__module__}: call it otherwise"
            )
        self._objects += 1
        if self._objects > MOST_OBJECTS:
            raise ContainerError(f"{where} is one object too many; allowed is {MOST_OBJECTS}")
        fields = {
            name: self._value(getattr(value, name), f"{where}.{name}", classes, others)
            for name in _fields(cls)
        }
        return {"$class": cls.__name__, "fields": fields}

    def _dictionary(self, value: dict[Any, Any], where: str, classes: Classes, others: bool) -> Any:
        for key in value:
            if type(key) is not str:
                raise ContainerError(f"{where} has the key {key!r}; allowed is text")
        parts = {key: self._value(part, f"{where}.{key}", classes, others) for key, part in value.items()}
        if any(key.startswith("$") for key in parts):
            return {"$dict": [list(part) for part in parts.items()]}
        return parts

    def file(self, title: Title, header: dict[str, Any]) -> bytes:
        """Return the bytes of a file whose header has these entries, which were made by `value`."""
        arrays = [[array.dtype.str, list(array.shape)] for array in self._arrays]
        try:
            text = json.dumps({**header, "arrays": arrays}, separators=(",", ":")).encode("ascii")
        except RecursionError:
            raise ContainerError("it is nested too deep") from None
        except ValueError as error:
            raise ContainerError(f"it has a number that cannot be written: {_first_line(error)}") from None
        if len(text) > MOST_HEADER:
            raise ContainerError(
                f"what is not in arrays takes {len(text)} bytes; allowed is {MOST_HEADER}: "
                "keep long lists of numbers as arrays"
            )
        total = sum(array.nbytes for array in self._arrays)
        if total > MOST_ARRAYS:
            raise ContainerError(f"the arrays take {total} bytes; allowed is {MOST_ARRAYS}")
        body = b"".join([text, *(array.tobytes() for array in self._arrays)])
        version = re.sub(r"[^!-~]", "?", package_version())[:40] or "unknown"
        first = f"{title.name}, format {title.version}, package {version}\n".encode("ascii")
        sizes = f" {len(text)} {total}\n".encode("ascii")
        return first + _checksum(first, sizes, body) + sizes + body


def write(path: Path, data: bytes) -> None:
    """Write a file atomically. Raises `ContainerError`."""
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(data)
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        raise ContainerError(f"cannot be written: {getattr(error, 'strerror', None) or error}") from None


def same_class(one: type, other: type) -> bool:
    """True if two classes are identical, or have the same module and name (redefined in a notebook)."""
    return one is other or (one.__module__, one.__qualname__) == (other.__module__, other.__qualname__)


def has_fields(cls: type) -> bool:
    """True if a class is a dataclass (such as an Equinox module) or a named tuple."""
    return dataclasses.is_dataclass(cls) or (issubclass(cls, tuple) and hasattr(cls, "_fields"))


def _fields(cls: Any) -> tuple[str, ...]:
    if issubclass(cls, tuple):
        return tuple(cls._fields)
    return tuple(field.name for field in dataclasses.fields(cls))


def _checksum(first: bytes, sizes: bytes, body: bytes) -> bytes:
    digest = hashlib.sha256(first)
    digest.update(sizes)
    digest.update(body)
    return digest.hexdigest().encode("ascii")


# unpacking


def read(path: Path) -> bytes:
    """Return the bytes of a regular file that is not too large. Raises `ContainerError`."""
    try:
        # checked first: opening a pipe would block until somebody writes
        if not path.is_file():
            what = "this is a folder; allowed is a file" if path.is_dir() else "no such file"
            raise ContainerError(what if path.is_dir() or not path.exists() else "not a file")
        size = path.stat().st_size
        if size > MOST_HEADER + MOST_ARRAYS + 300:
            raise ContainerError(f"it has {size} bytes; allowed is {MOST_HEADER + MOST_ARRAYS}")
        return path.read_bytes()
    except OSError as error:
        raise ContainerError(f"cannot be read: {error.strerror}") from None


class Reader:
    """A file's header, and its values with the arrays and objects in their places.

    Raises:
        ContainerError: the bytes are of another kind or version, truncated, or damaged.
    """

    def __init__(self, data: bytes, title: Title) -> None:
        text, arrays = _parts(data, title)
        try:
            header = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ContainerError(f"its header is not JSON: {_first_line(error)}") from None
        if not isinstance(header, dict):
            raise ContainerError(f"its header is a {type(header).__name__}; allowed is a mapping")
        self.header: dict[str, Any] = header
        self._arrays = _unpacked(self.entry("arrays", list), arrays)
        self._objects = 0

    def entry(self, name: str, kind: type, mapping: Any = None) -> Any:
        """Return an entry of the header, or of a mapping in it, checked for its type."""
        mapping = self.header if mapping is None else mapping
        if type(mapping.get(name)) is not kind:
            raise ContainerError(f"{name!r} is missing in its header, or not a {kind.__name__}")
        return mapping[name]

    def value(self, value: Any, where: str, classes: Classes) -> Any:
        """Return a value from the result of `Writer.value`. Objects are of the given classes only."""
        try:
            return self._value(value, where, classes)
        except RecursionError:
            raise ContainerError(f"{where} is nested too deep") from None

    def _value(self, value: Any, where: str, classes: Classes) -> Any:
        if isinstance(value, list):
            return [self._value(part, f"{where}[{i}]", classes) for i, part in enumerate(value)]
        if not isinstance(value, dict):
            return value
        mark = next((key for key in value if key.startswith("$")), None)
        if mark is None:
            return {key: self._value(part, f"{where}.{key}", classes) for key, part in value.items()}
        inner = value[mark]
        if mark == "$array":
            return self._array(inner, where)
        if mark == "$scalar" and self._array(inner, where).shape == ():
            return self._array(inner, where)[()]
        if mark == "$tuple" and isinstance(inner, list):
            return tuple(self._value(inner, where, classes))
        if mark == "$dict" and isinstance(inner, list) and all(_is_item(part) for part in inner):
            return {key: self._value(part, f"{where}.{key}", classes) for key, part in inner}
        if mark == "$class" and isinstance(inner, str) and isinstance(value.get("fields"), dict):
            return self._object(inner, value["fields"], where, classes)
        raise ContainerError(f"{where} is not understood")

    def _array(self, number: Any, where: str) -> np.ndarray:
        if type(number) is not int or not 0 <= number < len(self._arrays):
            raise ContainerError(f"{where} is an array that is not there")
        return self._arrays[number]

    def _object(self, name: str, fields: dict[str, Any], where: str, classes: Classes) -> Any:
        if name not in classes:
            name = EARLIER_CLASSES.get(name, name)
        if name not in classes:
            raise UnknownClassError(f"{where} is of a class {name[:60]!r}, which is not known here", name)
        self._objects += 1
        if self._objects > MOST_OBJECTS:
            raise ContainerError(f"it has more than {MOST_OBJECTS} objects")
        # not read: values of removed fields may be of classes that no longer exist
        removed = set(EARLIER_FIELDS.get(name, ())) - set(_fields(classes[name]))
        kept = {key: part for key, part in fields.items() if key not in removed}
        values = {key: self._value(part, f"{where}.{key}", classes) for key, part in kept.items()}
        return _made(classes[name], values, where)


def _parts(data: bytes, title: Title) -> tuple[bytes, bytes]:
    """Return the bytes of header and arrays, checked."""
    name = title.name.encode("ascii")
    if not data.startswith(name[: len(data)] if data else name):
        raise ContainerError(f"not a file of the kind {title.name!r}")
    first = _FIRST.match(data)
    if first is None and b"\n" in data[:200]:
        raise ContainerError("damaged: its first line is not understood")
    if first is None:
        raise ContainerError(f"truncated: only its first {len(data)} bytes are there")
    number, package = int(first[1]), first[2].decode("ascii")
    if number != title.version:
        raise ContainerError(
            f"its format is {number}; allowed is {title.version}, which this knode-cosserat reads "
            f"(the file is from knode-cosserat {package})"
        )
    second = _SECOND.match(data, first.end())
    if second is None:
        short = b"\n" not in data[first.end() :]
        raise ContainerError(f"{'truncated or ' * short}damaged: its second line is not understood")
    start, header, arrays = second.end(), int(second[3]), int(second[4])
    if len(data) - start < header + arrays:
        raise ContainerError(f"truncated: {len(data)} of {start + header + arrays} bytes are there")
    body = data[start:]
    if len(body) > header + arrays or _checksum(first[0], second[2], body) != second[1]:
        raise ContainerError("damaged: its content does not have the checksum that it states")
    if header > MOST_HEADER:
        raise ContainerError(f"its header takes {header} bytes; allowed is {MOST_HEADER}")
    return body[:header], body[header:]


def _unpacked(described: list[Any], data: bytes) -> list[np.ndarray]:
    """Return the arrays as separate copies. No more memory is allocated than the data fill."""
    arrays, offset = [], 0
    for number, entry in enumerate(described):
        if not _is_array(entry):
            raise ContainerError(f"array {number} of its header is not understood")
        dtype, shape = np.dtype(entry[0]), tuple(entry[1])
        size = math.prod(shape) * dtype.itemsize
        if offset + size > len(data):
            raise ContainerError(f"array {number} of its header is larger than what is there")
        raw = np.frombuffer(data[offset : offset + size], np.uint8)
        if dtype.kind == "b" and np.any(raw > 1):
            raise ContainerError(f"array {number} has truth values that are neither true nor false")
        arrays.append(raw.view(dtype).reshape(shape).copy() if size else np.zeros(shape, dtype))
        offset += size
    if offset != len(data):
        raise ContainerError(f"its arrays are {offset} bytes by its header, but {len(data)} are there")
    return arrays


def _is_array(entry: Any) -> bool:
    """True for an accepted type, and a shape that NumPy accepts even if the array is empty."""
    if not (isinstance(entry, list) and len(entry) == 2 and isinstance(entry[1], list)):
        return False
    kind, shape = entry
    if not (isinstance(kind, str) and kind in _TYPES and len(shape) <= 32):
        return False
    whole = all(type(size) is int and size >= 0 for size in shape)
    return whole and math.prod(max(size, 1) for size in shape) <= MOST_ARRAYS


def _is_item(part: Any) -> bool:
    return isinstance(part, list) and len(part) == 2 and isinstance(part[0], str)


def _made(cls: Any, values: dict[str, Any], where: str) -> Any:
    """Return an object of a class from its fields; missing fields have their defaults."""
    values = {**_defaults(cls), **values}
    expected = _fields(cls)
    for name in (*expected, *values):
        if name not in expected or name not in values:
            what = "does not have" if name in expected else "has"
            raise ContainerError(
                f"{where}, a {cls.__name__}, {what} a field {name[:60]!r}; there are {', '.join(expected)}"
            )
    if issubclass(cls, tuple):
        return cls._make(values[name] for name in expected)
    try:
        if not issubclass(cls, eqx.Module):
            return cls(**{field.name: values[field.name] for field in dataclasses.fields(cls) if field.init})
        # like JAX's unflattening: the constructor's arguments may differ from the fields
        made = object.__new__(cls)
        for name in expected:
            object.__setattr__(made, name, values[name])
        for base in cls.__mro__:
            if "__check_init__" in vars(base):
                vars(base)["__check_init__"](made)
    except Exception as error:  # validation in a class may raise any error
        raise ContainerError(f"{where}, a {cls.__name__}, is not possible: {_first_line(error)}") from None
    return made


def _defaults(cls: Any) -> dict[str, Any]:
    if issubclass(cls, tuple):
        return dict(cls._field_defaults)
    stated = dataclasses.fields(cls)
    made = {f.name: f.default_factory() for f in stated if f.default_factory is not dataclasses.MISSING}
    return made | {f.name: f.default for f in stated if f.default is not dataclasses.MISSING}


def _first_line(error: BaseException) -> str:
    lines = str(error).splitlines()
    return lines[0][:300] if lines else type(error).__name__
