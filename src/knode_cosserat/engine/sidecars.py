"""Sidecars of machine code on disk: all that running it needs, so that a later process derives nothing again.

A sidecar is JSON with numbers, arrays and the fields of data classes of this package; reading one runs no
code from it. Its name is a digest of all on which the code depends: structure and zeros of a system,
settings, the sources of this package, and functions and classes from elsewhere with all to which they refer.
If something there cannot be described, such as an open file, there is no sidecar.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import enum
import functools
import hashlib
import importlib
import json
import os
import sys
import types
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from knode_cosserat.engine.codegen import Function, Module, StackVariable
from knode_cosserat.engine.counts import Counts
from knode_cosserat.engine.equations import Elimination, Sizes
from knode_cosserat.engine.machine_code import MachineCode, computer, store, stored
from knode_cosserat.errors import KnodeCosseratError

PACKAGE = "knode_cosserat"
#: packages described by their versions
LIBRARIES = ("equinox", "jax", "jaxlib", "jaxtyping", "numpy")
#: functions of a class that construct, print and compare its instances
_GENERATED = frozenset(
    ("__init__", "__repr__", "__eq__", "__hash__", "__setattr__", "__delattr__", "__replace__")
)
#: what writes code, and is not needed to run it
_WRITERS = Elimination, Function, Counts, Module, StackVariable


class UnknownError(KnodeCosseratError):
    """A value that cannot be described or stored."""

    code = "sidecar"


# names


@functools.cache
def _surroundings() -> str:
    """Return a digest of this package's sources, and versions of the libraries."""
    found, folder = hashlib.sha256(), Path(__file__).parents[1]
    for path in sorted(folder.rglob("*.py")):
        found.update(f"{path.relative_to(folder)}\0".encode() + path.read_bytes())
    versions = [sys.modules[name].__version__ for name in LIBRARIES]
    return f"{found.hexdigest()} {versions} {sys.version} {computer()}"


def name_of(key: Any) -> str | None:
    """Return the name of the sidecar of code that depends on a key; None if there can be none."""
    try:
        described = hashlib.sha256()
        for part in _describe(key, set()):
            described.update(f"{len(part)} {part}".encode())
        described.update(f"{_surroundings()} {os.environ.get('KNODE_COSSERAT_CODE')}".encode())
    except (UnknownError, OSError, RecursionError):
        return None
    return f"core-{described.hexdigest()}"


def _describe(value: Any, seen: set[int]) -> Iterator[str]:
    """Yield texts that are equal in two processes only if the value computes the same."""
    if value is None or value is ... or isinstance(value, (bool, int, float, complex, str, bytes, np.dtype)):
        yield f"{type(value).__name__} {value!r}"
    elif isinstance(value, enum.Enum):
        yield f"enum {type(value).__qualname__} {value.name}"
    elif isinstance(value, (np.ndarray, np.generic, jax.Array)) and not isinstance(value, jax.core.Tracer):
        numbers = np.asarray(value)
        if numbers.dtype.hasobject:
            raise UnknownError
        yield f"array {numbers.dtype} {numbers.shape} {hashlib.sha256(numbers.tobytes()).hexdigest()}"
    elif isinstance(value, types.CodeType):
        yield f"code {value.co_name} {value.co_code.hex()} {value.co_names} {value.co_varnames}"
        yield from _describe_all(value.co_consts, seen)
    elif id(value) in seen:
        yield "again"
    elif isinstance(value, (type, types.FunctionType)):
        seen.add(id(value))
        yield f"{value.__module__} {value.__qualname__}"
        if not _is_versioned(value.__module__) or "<" in value.__qualname__:
            yield from _class(value, seen) if isinstance(value, type) else _function(value, seen)
    elif isinstance(value, (tuple, list, set, frozenset, dict)):
        yield f"{type(value).__module__} {type(value).__qualname__} {len(value)}"
        if isinstance(value, dict):
            value = list(value.items())
        yield from _describe_all(
            sorted(value, key=repr) if isinstance(value, (set, frozenset)) else value, seen
        )
    elif isinstance(value, functools.partial):
        yield from _describe_all((value.func, value.args, value.keywords), seen)
    elif isinstance(value, (staticmethod, classmethod, types.MethodType)):
        yield f"{type(value).__qualname__}"
        yield from _describe_all((value.__func__, getattr(value, "__self__", None)), seen)
    elif isinstance(value, (property, functools.cached_property)):
        yield from _describe_all([getattr(value, part, None) for part in ("fget", "fset", "func")], seen)
    elif dataclasses.is_dataclass(value):
        yield from _describe(type(value), seen)
        for field in dataclasses.fields(value):
            yield field.name
            yield from _describe(getattr(value, field.name, None), seen)
    elif isinstance(value, types.ModuleType) and _is_versioned(value.__name__):
        yield f"module {value.__name__}"
    elif callable(inner := getattr(value, "__wrapped__", getattr(value, "method", None))):
        yield from _describe_all((type(value), inner), seen)
    elif _is_versioned(type(value).__module__) and _is_versioned(str(getattr(value, "__module__", "-"))):
        if (name := getattr(value, "__qualname__", getattr(value, "__name__", None))) is None:
            raise UnknownError
        yield f"{value.__module__} {name}"
    else:
        raise UnknownError


def _describe_all(values: Any, seen: set[int]) -> Iterator[str]:
    for value in values:
        yield from _describe(value, seen)


def _is_versioned(module: str) -> bool:
    """True for a module of this package, its libraries, and Python."""
    top = module.partition(".")[0]
    return top != "__main__" and (top == PACKAGE or top in LIBRARIES or top in sys.stdlib_module_names)


def _captures(function: Any) -> list[Any]:
    cells = getattr(function, "__closure__", None) or ()
    return [cell.cell_contents for cell in cells]


def _class(kind: type, seen: set[int]) -> Iterator[str]:
    yield from _describe_all(kind.__bases__, seen)
    for name, value in sorted(vars(kind).items()):
        is_special = name.startswith("__") and not isinstance(value, types.FunctionType)
        if not is_special and name not in _GENERATED and name != "_abc_impl":
            yield name
            yield from _describe(value, seen)


def _function(function: types.FunctionType, seen: set[int]) -> Iterator[str]:
    """Describe a function with its defaults, what it captures, and the globals to which it refers."""
    own = function.__code__, function.__defaults__, function.__kwdefaults__, _captures(function)
    yield from _describe_all(own, seen)
    todo = [function.__code__]
    for code in todo:
        todo += [each for each in code.co_consts if isinstance(each, types.CodeType)]
        for name in code.co_names:
            if name in function.__globals__:
                value = function.__globals__[name]
                yield name
                if isinstance(value, types.ModuleType) and not _is_versioned(value.__name__):
                    names = [each for each in code.co_names if hasattr(value, each)]
                    yield from _describe_all([getattr(value, each) for each in names], seen)
                else:
                    yield from _describe(value, seen)


# content


def _plain(value: Any) -> Any:
    """Return a value as JSON."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        return {"array": [value.dtype.str, value.shape, base64.b64encode(value.tobytes()).decode()]}
    if isinstance(value, slice):
        return {"slice": [_plain(each) for each in (value.start, value.stop, value.step)]}
    if isinstance(value, jax.ShapeDtypeStruct):
        return {"shape": value.shape}
    if isinstance(value, MachineCode):
        return {"code": [value.name, value.kinds]}
    kind = type(value)
    if kind.__module__.startswith(f"{PACKAGE}.") and (names := _fields(kind)) is not None:
        at = kind.__module__, kind.__qualname__
        return {"object": [*at, {each: _plain(getattr(value, each)) for each in names}]}
    if type(value) is dict and all(isinstance(name, str) for name in value):
        return {"dict": {name: _plain(each) for name, each in value.items()}}
    if type(value) in (tuple, list):
        return {type(value).__name__: [_plain(each) for each in value]}
    raise UnknownError


def _fields(kind: type) -> Sequence[str] | None:
    """Return the names of the fields of a data class or named tuple; None for another class."""
    if dataclasses.is_dataclass(kind):
        return [field.name for field in dataclasses.fields(kind)]
    return getattr(kind, "_fields", None) if issubclass(kind, tuple) else None


def _object(module: str, name: str, fields: dict[str, Any]) -> Any:
    """Return an instance of a data class or named tuple of this package, without running its code."""
    kind = getattr(importlib.import_module(module), name) if module.startswith(f"{PACKAGE}.") else None
    if kind is None or _fields(kind) is None:
        raise UnknownError
    values = {key: _restore(each) for key, each in fields.items()}
    if issubclass(kind, tuple):
        return tuple.__new__(kind, values.values())
    found = object.__new__(kind)
    for key, value in values.items():
        object.__setattr__(found, key, value)
    return found


def _restore(data: Any) -> Any:
    """Return the value of JSON."""
    if not isinstance(data, dict):
        return data
    [(name, content)] = data.items()
    if name == "array":
        kind, shape, numbers = content
        return np.frombuffer(base64.b64decode(numbers), np.dtype(kind)).reshape(shape).copy()
    if name == "shape":
        return jax.ShapeDtypeStruct(tuple(content), float)
    if name == "code":
        if (code := MachineCode.kept(*content)) is None:
            raise UnknownError
        return code
    if name == "object":
        return _object(*content)
    if isinstance(content, list):
        values = [_restore(each) for each in content]
        return slice(*values) if name == "slice" else tuple(values) if name == "tuple" else values
    return {key: _restore(each) for key, each in content.items()}


def _writes(value: Any) -> bool:
    """True for what writes code, or a list of it."""
    return isinstance(value, _WRITERS) or (type(value) is list and bool(value) and all(map(_writes, value)))


def forget_writers(found: Any) -> None:
    """Delete the attributes that wrote an object's code: programs of some 10 MB."""
    for key, value in list(vars(found).items()):
        if _writes(value):
            delattr(found, key)
        elif isinstance(value, Sizes):
            setattr(found, key, Sizes(*(getattr(value, each) for each in _fields(Sizes) or ())))


def restore(name: str) -> dict[str, Any] | None:
    """Return the attributes of an object from its sidecar; None if it is not complete on disk."""
    content = stored(name)
    try:
        return None if content is None else _restore(json.loads(content))
    except UnknownError:
        return None


def keep(name: str, found: Any, given: Collection[str]) -> None:
    """Store the attributes of an object, but for those given; nothing is stored if one of them is no data."""
    with contextlib.suppress(UnknownError):
        attributes = {key: _plain(value) for key, value in vars(found).items() if key not in given}
        store(name, json.dumps({"dict": attributes}).encode())
