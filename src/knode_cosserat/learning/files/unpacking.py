"""Reading of files in the format of `container`: the header, arrays, and objects of known classes."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from typing import Any

import equinox as eqx
import numpy as np

from knode_cosserat._files.limits import MORE, allowed
from knode_cosserat.errors import first_line
from knode_cosserat.learning.files.container import (
    MOST_ARRAYS,
    MOST_HEADER,
    MOST_OBJECTS,
    TYPES,
    Classes,
    ContainerError,
    Title,
    UnknownClassError,
    checksum,
    fields_of,
)

#: deepest nesting of a header: a KNODE of a KNODE of a KNODE has 40
MOST_NESTED = 200

_FIRST = re.compile(rb"[^\n,]{1,99}, format (\d{1,6}), package ([!-~]{1,40})\n")
_SECOND = re.compile(rb"([0-9a-f]{64})( (\d{1,12}) (\d{1,12})\n)")


class Reader:
    """A file's header, and its values with the arrays and objects in their places.

    Raises:
        ContainerError: the bytes are of another kind or version, truncated, or damaged.
    """

    def __init__(self, data: bytes, title: Title) -> None:
        text, arrays = _parts(data, title)
        if _depth(text) > MOST_NESTED:
            raise ContainerError(f"its header is nested more than {MOST_NESTED} times")
        try:
            header = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ContainerError(f"its header is not JSON: {first_line(error)}") from None
        if not isinstance(header, dict):
            raise ContainerError(f"its header is a {type(header).__name__}; allowed is a mapping")
        self.header: dict[str, Any] = header
        self._arrays = _unpacked(self.entry("arrays", list), arrays)
        self._objects, self._most_objects = 0, allowed(MOST_OBJECTS)

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
            raise UnknownClassError(f"{where} is of a class {name[:60]!r}, which is not known here", name)
        self._objects += 1
        if self._objects > self._most_objects:
            raise ContainerError(f"it has more than {self._most_objects} objects; {MORE}")
        values = {key: self._value(part, f"{where}.{key}", classes) for key, part in fields.items()}
        return _made(classes[name], values, where)


def _depth(text: bytes) -> int:
    """Return an upper bound of how deep a JSON text is nested: brackets in its strings count too."""
    opened = np.isin(np.frombuffer(text, np.uint8), list(b"[{")).astype(int)
    closed = np.isin(np.frombuffer(text, np.uint8), list(b"]}")).astype(int)
    return int(np.max(np.cumsum(opened - closed), initial=0))


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
    if len(body) > header + arrays or checksum(first[0], second[2], body) != second[1]:
        raise ContainerError("damaged: its content does not have the checksum that it states")
    most = allowed(MOST_HEADER)
    if header > most:
        raise ContainerError(f"its header takes {header} bytes; allowed is {most}; {MORE}")
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
    if not (isinstance(kind, str) and kind in TYPES and len(shape) <= 32):
        return False
    whole = all(type(size) is int and size >= 0 for size in shape)
    return whole and math.prod(max(size, 1) for size in shape) <= allowed(MOST_ARRAYS)


def _is_item(part: Any) -> bool:
    return isinstance(part, list) and len(part) == 2 and isinstance(part[0], str)


def _made(cls: Any, values: dict[str, Any], where: str) -> Any:
    """Return an object of a class from its fields; missing fields have their defaults."""
    values = {**_defaults(cls), **values}
    expected = fields_of(cls)
    for name in (*expected, *values):
        if name not in expected or name not in values:
            what = "does not have" if name in expected else "has"
            raise ContainerError(
                f"{where}, a {cls.__name__}, {what} a field {name[:60]!r}; there are {', '.join(expected)}"
            )
    if issubclass(cls, tuple):
        return cls._make(values[name] for name in expected)
    _require_hashable(cls, values, where)
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
        raise ContainerError(f"{where}, a {cls.__name__}, is not possible: {first_line(error)}") from None
    return made


def _require_hashable(cls: Any, values: dict[str, Any], where: str) -> None:
    """Raise `ContainerError` if a static field has a value that programs cannot be looked up by.

    JAX would keep it, and fail when it compares the next model with it.
    """
    for field in dataclasses.fields(cls):
        if field.metadata.get("static"):
            try:
                hash(values[field.name])
            except TypeError:
                kind = type(values[field.name]).__name__
                raise ContainerError(f"{where}.{field.name} is a {kind}; allowed is a constant") from None


def _defaults(cls: Any) -> dict[str, Any]:
    if issubclass(cls, tuple):
        return dict(cls._field_defaults)
    stated = dataclasses.fields(cls)
    made = {f.name: f.default_factory() for f in stated if f.default_factory is not dataclasses.MISSING}
    return made | {f.name: f.default for f in stated if f.default is not dataclasses.MISSING}
