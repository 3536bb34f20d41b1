"""Container files: labelled arrays, facts and one checksum.

Trajectories, models, checkpoints of fits and workspaces are such files.

A container is a netCDF-4 file (HDF5) with:

- attributes: `format` (the kind of content), `format_version`, `knode_cosserat_version`, texts of the kind's
  own, and `facts` (JSON);
- variables: labelled arrays with units, which any netCDF tool reads;
- the group `arrays`: the arrays of the facts, such as a network's weights;
- a last line after the end of HDF5, which HDF5 ignores: kind, versions, and the SHA-256 of all bytes before.

The checksum is verified before HDF5 reads the file: damage of its internal lists can make HDF5 loop for ever.
It detects accidental damage. It is no protection against deliberate changes, because it can be recomputed.

Values that JSON does not support are in the facts as objects with one key: {"$array": "name"} is an array,
{"$scalar": "name"} the NumPy scalar in it, {"$tuple": […]} a tuple, {"$class": "Name", "fields": {…}} an
object, {"$dict": [[key, value], …]} a dictionary with keys that begin with "$". No content of a file is ever
executed or imported: class names are looked up among the given classes, and only fields are set.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from knode_cosserat._files.limits import MORE, LimitSettingError, excess, scaled_limit
from knode_cosserat._files.reading import ReadError, read_bytes
from knode_cosserat._files.writing import package_version, replacing
from knode_cosserat.errors import KnodeCosseratError, first_line

#: largest file, and largest facts (bytes)
LARGEST_FILE, MOST_FACTS = 8 << 30, 4 << 20
#: most bytes of the arrays: EXPANSION times the file and ALLOWANCE. The package does not compress
EXPANSION, ALLOWANCE = 100, 100_000_000
#: most objects in the facts, because each takes time to be traced; deepest nesting of the facts
MOST_OBJECTS, MOST_NESTED = 5_000, 200

_SIZES = {"b": (1,), "i": (1, 2, 4, 8), "u": (1, 2, 4, 8), "f": (2, 4, 8), "c": (8, 16)}
#: accepted types of arrays, in NumPy's notation
TYPES = {
    np.dtype(f"{order}{kind}{size}").str for kind, sizes in _SIZES.items() for size in sizes for order in "<>"
}
_ALLOWED = "numbers, text, None, arrays of numbers, and lists, tuples and dictionaries of these"
_MAGIC = b"\x89HDF\r\n\x1a\n"
_LAST_LINE = re.compile(
    rb"\n(knode-cosserat [a-z]{1,40}), format (\d{1,6}), package ([!-~]{1,40}), SHA-256 ([0-9a-f]{64})\n$"
)
_LONGEST_LINE = 200
#: beginning of the attribute NAME of a dimension without a variable, in netCDF-4
_ONLY_DIMENSION = "This is a netCDF dimension but not a netCDF variable"


class ContainerError(KnodeCosseratError, ValueError):
    """A value that cannot be packed or unpacked. The message is one line that does not name the file."""

    code = "file-content"

    def __init__(self, message: str):
        # text from a file may contain line ends and control characters
        line = "".join(letter if letter.isprintable() else " " for letter in message)
        super().__init__(line if len(line) <= 600 else line[:600] + "…")


class Kind(NamedTuple):
    """Kind of a file, such as "knode-cosserat model"; version of its format, and error of its files."""

    name: str
    version: int
    error: type[KnodeCosseratError]

    @contextlib.contextmanager
    def naming(self, source: str | Path) -> Iterator[None]:
        """Raise errors of the block as this kind's error, with the file's name before the reason."""
        try:
            yield
        except (ContainerError, ReadError, RecursionError) as error:
            raise self.error(f"{source}: {error}") from None


class Variable(NamedTuple):
    """A labelled array: values, names of its dimensions, and attributes such as `units`."""

    values: Any
    dimensions: tuple[str, ...]
    attributes: Mapping[str, Any] = {}


@dataclasses.dataclass(frozen=True)
class Content:
    """Content of a file. The arrays are copies, which can be changed."""

    facts: dict[str, Any]
    variables: dict[str, np.ndarray]
    attributes: dict[str, Any]

    def fact(self, name: str, kind: Any) -> Any:
        """Return a fact of a type, or of a union of types. Raises `ContainerError`."""
        if not isinstance(self.facts.get(name), kind):
            raise ContainerError(f"its {name!r} is missing or a {type(self.facts.get(name)).__name__}")
        return self.facts.get(name)

    def values(self, name: str, shape: tuple[int, ...] | None = None) -> np.ndarray:
        """Return the numbers of a variable, of any shape if `shape` is None. Raises `ContainerError`."""
        if name not in self.variables:
            raise ContainerError(f"the variable {name!r} is missing")
        values = self.variables[name]
        if shape is not None and values.shape != shape:
            raise ContainerError(f"the variable {name!r} has shape {values.shape}; allowed is {shape}")
        return values


# writing


def write(path: str | Path, content: bytes, kind: Kind) -> None:
    """Write a file atomically; a failure or a kill leaves the old file. Raises the kind's error."""
    try:
        with replacing(Path(path)) as temporary:
            temporary.write_bytes(content)
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        reason = getattr(error, "strerror", None) or first_line(error)
        raise kind.error(f"{path}: cannot be written: {reason}") from None


def encode(
    kind: Kind,
    facts: Mapping[str, Any],
    *,
    variables: Mapping[str, Variable] | None = None,
    attributes: Mapping[str, Any] | None = None,
    classes: Mapping[str, type] | None = None,
    others: bool = False,
) -> bytes:
    """Return the bytes of a file. It is made in memory: on a full disk HDF5 crashes the interpreter.

    Args:
        kind: the kind of content.
        facts: values, which may contain arrays, and objects of dataclasses and named tuples.
        variables: labelled arrays.
        attributes: further attributes of the file: text or whole numbers.
        classes: known classes of objects, by name.
        others: True to allow objects of other classes; the reader of the file must know them.

    Raises:
        ContainerError: a value cannot be stored, or the variables do not fit together.
    """
    import h5netcdf
    import h5py

    packer = _Packer(classes or {}, others)
    text = packer.text(dict(facts))
    version = re.sub(r"[^!-~]", "?", package_version())[:40] or "unknown"
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        with h5netcdf.File(file, "w") as labelled:
            labelled.attrs.update({"format": kind.name, "format_version": kind.version})
            labelled.attrs.update({"knode_cosserat_version": version, **(attributes or {}), "facts": text})
            _write_variables(labelled, variables or {})
        group = file.create_group("arrays")
        for name, array in packer.arrays.items():
            group.create_dataset(name, data=array)
    line = f"\n{kind.name}, format {kind.version}, package {version}, SHA-256 "
    content = buffer.getvalue() + line.encode("ascii")
    content += hashlib.sha256(content).hexdigest().encode("ascii") + b"\n"
    if reason := excess(len(content), LARGEST_FILE, "bytes"):
        raise ContainerError(reason)
    return content


def _write_variables(file: Any, variables: Mapping[str, Variable]) -> None:
    import h5py

    sizes: dict[str, tuple[int, str]] = {}
    for name, (values, dimensions, _) in variables.items():
        shape = np.shape(values)
        for k, dimension in enumerate(dimensions):
            size, first = sizes.setdefault(dimension, (shape[k] if k < len(shape) else 0, name))
            if len(shape) != len(dimensions) or shape[k] != size:
                raise ContainerError(
                    f"its arrays do not fit together: {name!r} has shape {shape}, with {dimension} along "
                    f"axis {k}, and {first!r} has {size} along {dimension}"
                )
    file.dimensions = {name: size for name, (size, _) in sizes.items()}
    for name, (values, dimensions, attributes) in variables.items():
        array = np.asarray(values)
        kind = h5py.string_dtype() if array.dtype.kind == "U" else array.dtype
        data = array.astype(object) if array.dtype.kind == "U" else array
        file.create_variable(name, dimensions, kind, data=data).attrs.update(attributes)


class _Packer:
    """Converts values to JSON, and collects their arrays by name."""

    def __init__(self, classes: Mapping[str, type], others: bool) -> None:
        self._classes, self._others = classes, others
        self.arrays: dict[str, np.ndarray] = {}
        self._objects, self._most_objects = 0, scaled_limit(MOST_OBJECTS)

    def text(self, facts: dict[str, Any]) -> str:
        """Return the facts as JSON. Raises `ContainerError`."""
        try:
            packed = {key: self._value(value, key) for key, value in facts.items()}
            text = json.dumps(packed, separators=(",", ":"))
        except RecursionError:
            raise ContainerError("its facts are nested too deep, or contain themselves") from None
        except KnodeCosseratError:
            raise
        except ValueError as error:
            raise ContainerError(f"it has a number that cannot be written: {first_line(error)}") from None
        if reason := excess(len(text), MOST_FACTS, "bytes of facts"):
            raise ContainerError(f"long lists of numbers must be arrays: {reason}")
        return text

    def _value(self, value: Any, where: str) -> Any:
        if value is None or type(value) in (bool, int, float, str):
            return value
        if isinstance(value, np.generic):
            return {"$scalar": self._array(value, where)}
        if isinstance(value, np.ndarray | jax.Array):
            return {"$array": self._array(value, where)}
        if has_fields(type(value)):
            return self._object(value, where)
        if type(value) in (list, tuple):
            parts = [self._value(part, f"{where}[{i}]") for i, part in enumerate(value)]
            return parts if type(value) is list else {"$tuple": parts}
        if type(value) is not dict:
            raise ContainerError(f"{where} is a {type(value).__name__}; allowed is {_ALLOWED}")
        for key in value:
            if type(key) is not str:
                raise ContainerError(f"{where} has the key {key!r}; allowed is text")
        items = {key: self._value(part, f"{where}.{key}") for key, part in value.items()}
        if any(key.startswith("$") for key in items):
            return {"$dict": [list(item) for item in items.items()]}
        return items

    def _array(self, value: Any, where: str) -> str:
        try:
            array = np.asarray(value)
        except (TypeError, jax.errors.TracerArrayConversionError):
            array = np.array(None)
        if array.dtype.str not in TYPES or isinstance(value, np.ma.MaskedArray):
            kind = type(value).__name__ + ("" if array.dtype.kind == "O" else f" of {array.dtype}")
            raise ContainerError(f"{where} is a {kind}; allowed is an array of numbers")
        name = re.sub(r"[^A-Za-z0-9_.\[\]]", "_", where)[:200]
        while name in self.arrays:
            name += "_"
        self.arrays[name] = array
        return name

    def _object(self, value: Any, where: str) -> Any:
        cls: Any = type(value)
        known = self._classes.get(cls.__name__)
        if known is None and not self._others:
            raise ContainerError(
                f"{where} is a {cls.__name__}, which is not a known class; allowed is {_ALLOWED}"
            )
        if known is not None and not same_class(known, cls):
            raise ContainerError(
                f"{where} is of a class {cls.__qualname__} of {cls.__module__}, but that name is taken by a "
                f"class of {known.__module__}: call it otherwise"
            )
        self._objects += 1
        if self._objects > self._most_objects:
            raise ContainerError(f"{where} is one object more than {self._most_objects}; {MORE}")
        fields = {name: self._value(getattr(value, name), f"{where}.{name}") for name in _fields_of(cls)}
        return {"$class": cls.__name__, "fields": fields}


def same_class(one: type, other: type) -> bool:
    """True if two classes are identical, or have the same module and name (redefined in a notebook)."""
    return one is other or (one.__module__, one.__qualname__) == (other.__module__, other.__qualname__)


def has_fields(cls: type) -> bool:
    """True if a class is a dataclass (such as an Equinox module) or a named tuple."""
    return dataclasses.is_dataclass(cls) or (issubclass(cls, tuple) and hasattr(cls, "_fields"))


def _fields_of(cls: Any) -> tuple[str, ...]:
    if issubclass(cls, tuple):
        return tuple(cls._fields)
    return tuple(field.name for field in dataclasses.fields(cls))


# reading


def kind_of(path: str | Path) -> str:
    """Return the kind of a file by its last line, such as "knode-cosserat model".

    It is "HDF5" for an HDF5 file that does not end as a container, and empty for any other file.
    """
    try:
        # checked first: opening a pipe would block until somebody writes
        if not os.path.isfile(path):
            return ""
        with open(path, "rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                return ""
            file.seek(max(0, file.seek(0, io.SEEK_END) - _LONGEST_LINE))
            line = _LAST_LINE.search(file.read())
    except OSError:
        return ""
    return line[1].decode("ascii") if line else "HDF5"


def read(path: str | Path, kind: Kind, classes: Mapping[str, type] | None = None) -> Content:
    """Read a file of a kind; see `decode`. Raises the kind's error."""
    with kind.naming(path):
        # os.path has no errors, not even for a name with a zero byte
        if not os.path.isfile(path):
            reason = "not a file" if os.path.exists(path) else "no such file"
            raise ContainerError("this is a folder; allowed is a file" if os.path.isdir(path) else reason)
        data = read_bytes(path, LARGEST_FILE)
    return decode(data, kind, str(path), classes)


def decode(data: bytes, kind: Kind, source: str, classes: Mapping[str, type] | None = None) -> Content:
    """Return the content of a file's bytes.

    Args:
        data: the bytes.
        kind: the expected kind.
        source: name of the file in errors.
        classes: classes of objects in the facts, by name.

    Raises:
        KnodeCosseratError: of the kind's class: the bytes are of another kind or version, truncated, damaged
            or too large, or their facts contain an unknown class.
    """
    import h5py

    with kind.naming(source):
        _require_whole(data, kind)
        try:
            with h5py.File(io.BytesIO(data), "r") as file:
                attributes = {name: file.attrs[name] for name in file.attrs}
                variables, arrays = _read_arrays(file, len(data))
        except (ContainerError, LimitSettingError):
            raise
        except Exception as error:  # HDF5 and its wrapper have their own exceptions for damage
            raise ContainerError(f"damaged: {first_line(error)}") from None
        facts = _Unpacker(arrays, classes or {}).facts(str(attributes.pop("facts", "")))
    return Content(facts, variables, attributes)


def _require_whole(data: bytes, kind: Kind) -> None:
    """Raise `ContainerError` unless bytes are of this kind and version, and have their checksum."""
    if not data.startswith(_MAGIC):
        raise ContainerError(f"not a netCDF-4 file; allowed is a {kind.name}")
    line = _LAST_LINE.search(data, max(0, len(data) - _LONGEST_LINE))
    if line is None:
        raise ContainerError(
            "truncated, or damaged, or written by another program: it does not end with the checksum of a "
            f"{kind.name}"
        )
    name, package = line[1].decode("ascii"), line[3].decode("ascii")
    if name != kind.name:
        raise ContainerError(f"this is a {name}; allowed is a {kind.name}")
    if int(line[2]) != kind.version:
        raise ContainerError(
            f"its format is {int(line[2])}; this knode-cosserat reads {kind.version} (the file is from "
            f"knode-cosserat {package})"
        )
    if hashlib.sha256(memoryview(data)[: line.start(4)]).hexdigest().encode("ascii") != line[4]:
        raise ContainerError("damaged or changed: its bytes do not have their checksum")


def _read_arrays(file: Any, size: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the variables that hold numbers, and the arrays of the facts.

    Raises:
        ContainerError: data of other files are named, or the arrays expand far beyond the file's size.
    """
    import h5py

    groups: list[dict[str, Any]] = []
    for group in (file, file["arrays"]):
        groups.append({})
        for name in group:
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise ContainerError(f"{name!r} is a link; allowed are variables")
            item = group[name]
            if isinstance(item, h5py.Dataset):
                if item.is_virtual or item.external:
                    raise ContainerError(f"the data of {name!r} are in another file; not read")
                groups[-1][name] = item
            elif name != "arrays":
                raise ContainerError(f"{name!r} is a group; allowed are variables")
    expanded = sum(item.size * item.dtype.itemsize for items in groups for item in items.values())
    most = scaled_limit(EXPANSION) * size + scaled_limit(ALLOWANCE)
    if expanded > most:
        raise ContainerError(
            f"its arrays take {expanded / 1e9:.3g} GB; allowed are {most / 1e9:.3g} GB for a file of this "
            f"size; {MORE}"
        )
    variables, arrays = (
        {
            name: np.asarray(item[()])
            for name, item in items.items()
            if item.dtype.str in TYPES and not str(item.attrs.get("NAME", "")).startswith(_ONLY_DIMENSION)
        }
        for items in groups
    )
    return variables, arrays


class _Unpacker:
    """Converts JSON to values, with the arrays and objects in their places."""

    def __init__(self, arrays: Mapping[str, np.ndarray], classes: Mapping[str, type]) -> None:
        self._arrays, self._classes = arrays, classes
        self._objects, self._most_objects = 0, scaled_limit(MOST_OBJECTS)

    def facts(self, text: str) -> dict[str, Any]:
        """Return the facts. Raises `ContainerError`."""
        if reason := excess(len(text), MOST_FACTS, "bytes of facts"):
            raise ContainerError(reason)
        if nesting(text) > MOST_NESTED:
            raise ContainerError(f"its facts are nested more than {MOST_NESTED} times")
        try:
            facts = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ContainerError(f"its facts are not JSON: {first_line(error)}") from None
        if not isinstance(facts, dict):
            raise ContainerError(f"its facts are a {type(facts).__name__}; allowed is a mapping")
        return {key: self._value(value, key) for key, value in facts.items()}

    def _value(self, value: Any, where: str) -> Any:
        if isinstance(value, list):
            return [self._value(part, f"{where}[{i}]") for i, part in enumerate(value)]
        if not isinstance(value, dict):
            return value
        mark = next((key for key in value if key.startswith("$")), None)
        if mark is None:
            return {key: self._value(part, f"{where}.{key}") for key, part in value.items()}
        inner = value[mark]
        if mark in ("$array", "$scalar"):
            if not isinstance(inner, str) or inner not in self._arrays:
                raise ContainerError(f"{where} is an array that is not there")
            if mark == "$array":
                return self._arrays[inner].copy()
            if self._arrays[inner].shape == ():
                return self._arrays[inner][()]
        if mark == "$tuple" and isinstance(inner, list):
            return tuple(self._value(inner, where))
        items = isinstance(inner, list) and all(
            isinstance(part, list) and len(part) == 2 and isinstance(part[0], str) for part in inner
        )
        if mark == "$dict" and items:
            return {key: self._value(part, f"{where}.{key}") for key, part in inner}
        if mark == "$class" and isinstance(inner, str) and isinstance(value.get("fields"), dict):
            return self._object(inner, value["fields"], where)
        raise ContainerError(f"{where} is not understood")

    def _object(self, name: str, fields: dict[str, Any], where: str) -> Any:
        if name not in self._classes:
            word = name if name.isidentifier() and len(name) <= 60 else "…"
            raise ContainerError(
                f"{where} is of a class {name[:60]!r}, which is not known here; load it with "
                f"residuals=[{word}]"
            )
        self._objects += 1
        if self._objects > self._most_objects:
            raise ContainerError(f"it has more than {self._most_objects} objects; {MORE}")
        values = {key: self._value(part, f"{where}.{key}") for key, part in fields.items()}
        return _object_of(self._classes[name], values, where)


def nesting(text: str) -> int:
    """Return an upper bound of the nesting of a JSON text: brackets in its strings count too."""
    letters = np.frombuffer(text.encode("utf-8", "replace"), np.uint8)
    steps = np.isin(letters, list(b"[{")).astype(int) - np.isin(letters, list(b"]}")).astype(int)
    return int(np.max(np.cumsum(steps), initial=0))


def _object_of(cls: Any, values: dict[str, Any], where: str) -> Any:
    """Return an object of a class from its fields; missing fields have their defaults."""
    import equinox as eqx

    named = issubclass(cls, tuple)
    if named:
        defaults = dict(cls._field_defaults)
    else:
        fields, missing = dataclasses.fields(cls), dataclasses.MISSING
        defaults = {f.name: f.default_factory() for f in fields if f.default_factory is not missing}
        defaults |= {f.name: f.default for f in fields if f.default is not missing}
    values, expected = {**defaults, **values}, _fields_of(cls)
    for name in (*expected, *values):
        if name not in expected or name not in values:
            verb = "does not have" if name in expected else "has"
            raise ContainerError(
                f"{where}, a {cls.__name__}, {verb} a field {name[:60]!r}; there are {', '.join(expected)}"
            )
    if named:
        return cls._make(values[name] for name in expected)
    for field in fields:
        # JAX would keep a static field that has no hash, and fail when it compares the next object with it
        if field.metadata.get("static"):
            try:
                hash(values[field.name])
            except TypeError:
                kind = type(values[field.name]).__name__
                raise ContainerError(f"{where}.{field.name} is a {kind}; allowed is a constant") from None
    try:
        if not issubclass(cls, eqx.Module):
            return cls(**{field.name: values[field.name] for field in fields if field.init})
        # as JAX rebuilds a tree: the constructor's arguments may differ from the fields
        made = object.__new__(cls)
        for name in expected:
            object.__setattr__(made, name, values[name])
        for base in cls.__mro__:
            if "__check_init__" in vars(base):
                vars(base)["__check_init__"](made)
    except Exception as error:  # validation in a class may raise any error
        raise ContainerError(f"{where}, a {cls.__name__}, is not possible: {first_line(error)}") from None
    return made
