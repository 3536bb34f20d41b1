"""File format for arrays, plain values and objects of known classes, with a checksum.

    knode-cosserat model, format 1, package 0.1.0
    <sha256, hex> <size of the header> <size of the arrays>
    {"arrays": [["<f8", [512, 28]], …], …}                            the header: JSON, ASCII
    the arrays, one after the other, in C order

The checksum covers everything but itself. Values that JSON does not support are stored in the header as an
object with one key: {"$array": 3} is array number 3, {"$scalar": 3} the NumPy scalar in it, {"$tuple": […]} a
tuple, {"$class": "Name", "fields": {…}} an object, {"$dict": [[key, value], …]} a dictionary with keys that
begin with "$". No content of a file is ever executed or imported: class names are looked up among the given
classes. `unpacking` reads files.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from knode_cosserat._files.limits import MORE, allowed
from knode_cosserat._files.reading import ReadError, read_bytes
from knode_cosserat._files.writing import package_version, replacing
from knode_cosserat.errors import KnodeCosseratError, first_line

#: largest number of bytes of the header and of the arrays, as a limit for hostile files
MOST_HEADER = 4 * 2**20
MOST_ARRAYS = 2**30
#: largest number of bytes before the header
MOST_TITLE = 300
#: largest number of objects in one file, because each takes time to be traced
MOST_OBJECTS = 5_000

_SIZES = {"b": (1,), "i": (1, 2, 4, 8), "u": (1, 2, 4, 8), "f": (2, 4, 8), "c": (8, 16)}
#: accepted array types, in NumPy's notation
TYPES = {
    np.dtype(f"{order}{kind}{size}").str for kind, sizes in _SIZES.items() for size in sizes for order in "<>"
}
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
        if array.dtype.str not in TYPES or isinstance(value, np.ma.MaskedArray):
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
        most = allowed(MOST_OBJECTS)
        if self._objects > most:
            raise ContainerError(f"{where} is one object too many; allowed is {most}; {MORE}")
        fields = {
            name: self._value(getattr(value, name), f"{where}.{name}", classes, others)
            for name in fields_of(cls)
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
            raise ContainerError(f"it has a number that cannot be written: {first_line(error)}") from None
        most = allowed(MOST_HEADER)
        if len(text) > most:
            raise ContainerError(
                f"what is not in arrays takes {len(text)} bytes; allowed is {most}: "
                f"keep long lists of numbers as arrays; {MORE}"
            )
        total, most = sum(array.nbytes for array in self._arrays), allowed(MOST_ARRAYS)
        if total > most:
            raise ContainerError(f"the arrays take {total} bytes; allowed is {most}; {MORE}")
        body = b"".join([text, *(array.tobytes() for array in self._arrays)])
        version = re.sub(r"[^!-~]", "?", package_version())[:40] or "unknown"
        first = f"{title.name}, format {title.version}, package {version}\n".encode("ascii")
        sizes = f" {len(text)} {total}\n".encode("ascii")
        return first + checksum(first, sizes, body) + sizes + body


def write_container(path: Path, data: bytes) -> None:
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


def fields_of(cls: Any) -> tuple[str, ...]:
    """Return the names of the fields of a class."""
    if issubclass(cls, tuple):
        return tuple(cls._fields)
    return tuple(field.name for field in dataclasses.fields(cls))


def checksum(first: bytes, sizes: bytes, body: bytes) -> bytes:
    """Return the checksum of a file in hexadecimal digits."""
    digest = hashlib.sha256(first)
    digest.update(sizes)
    digest.update(body)
    return digest.hexdigest().encode("ascii")


def read(path: Path) -> bytes:
    """Return the bytes of a regular file that is not too large. Raises `ContainerError`."""
    try:
        # checked first: opening a pipe would block until somebody writes
        if not path.is_file():
            what = "this is a folder; allowed is a file" if path.is_dir() else "no such file"
            raise ContainerError(what if path.is_dir() or not path.exists() else "not a file")
        return read_bytes(path, MOST_HEADER + MOST_ARRAYS + MOST_TITLE)
    except OSError as error:
        raise ContainerError(f"cannot be read: {error.strerror}") from None
    except ReadError as error:
        raise ContainerError(str(error)) from None
