"""Trajectories as labelled netCDF files.

Every field of y, z and the controls is a variable under its own name, with unit and meaning, over the
dimensions (batch,) time, node and component. The robot is an attribute, as the text of a robot file, and so
are the settings, as JSON. A system that no robot file describes is there as the bytes of a file of its own,
if there is a codec for its class. Arrays come back bit for bit. Reading runs no code that a file brings.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from knode_cosserat._files import package_version, replacing
from knode_cosserat.rods import robot_file
from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.parameters import Parameter, ParameterError, parameters_of, slots_of
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.trajectory import Trajectory

if TYPE_CHECKING:
    import xarray

FORMAT = "knode-cosserat trajectory"
VERSION = 1

#: what a trajectory has one number of in each row: name, unit and meaning
_ROWS = (
    ("result", "1", "how the step ended; below zero: not solved"),
    ("residual", "1", "largest residual, in natural units"),
    ("iterations", "1", "Newton corrections"),
)
#: stands before a parameter's name where each robot of a batch has its own
_PARAMETER = "robot_"
#: the bytes of a system that has a codec; of a batch, one system's after the other's, with their sizes
_BYTES, _SIZES = "system_bytes", "system_sizes"


class TrajectoryFileError(ValueError):
    """A trajectory's file that cannot be read or written; the message is one line that says why."""


class Codec(NamedTuple):
    """How systems of a class become bytes and come back; the text is what errors call the file.

    Both raise a `ValueError` of one line for what they cannot write or read.
    """

    cls: type[System]
    encode: Callable[[Any, str], bytes]
    decode: Callable[[bytes, str], System]


_codecs: dict[str, Codec] = {}


def register_codec(
    cls: type[System], encode: Callable[[Any, str], bytes], decode: Callable[[bytes, str], System]
) -> None:
    """Let files of trajectories hold systems of a class that no robot file can name (see `Codec`)."""
    _codecs[cls.__name__] = Codec(cls, encode, decode)


# writing


def save(trajectory: Trajectory, path: str | Path) -> None:
    """Write a trajectory as a labelled netCDF-4 file that `load_trajectory` reads back equal.

    The file appears complete or not at all. A system that no file can describe does not stop it: all the
    states are written, and `load_trajectory` asks for the system.

    Raises:
        TrajectoryFileError: the arrays do not fit together, or the file cannot be written.
    """
    path = Path(path)
    data = _dataset(trajectory, str(path))
    # xarray would declare NaN to mean "missing", but here it means what `result` says
    plain = {name: {"_FillValue": None} for name in data.variables}
    try:
        with replacing(path) as temporary:
            data.to_netcdf(temporary, engine="h5netcdf", encoding=plain)
    except (OSError, RuntimeError) as error:  # HDF5 has either for a full disk
        number = error.errno if isinstance(error, OSError) else None
        reason = os.strerror(number) if number else _first_line(error)
        raise TrajectoryFileError(f"{path}: cannot be written: {reason}") from None


def _dataset(trajectory: Trajectory, source: str) -> xarray.Dataset:
    import xarray

    system = trajectory.system
    _require_names(system, source)
    batch = ("batch",) if np.ndim(trajectory.y) == 4 else ()
    rows = (*batch, "time")
    arclength = np.asarray(trajectory.arclength)
    coordinates: dict[str, Any] = {
        "time": ("time", np.asarray(trajectory.time), _labels("s", "time")),
        "arclength": ((*batch, "node")[-arclength.ndim :], arclength, _labels("m", "arclength of the nodes")),
    }
    variables: dict[str, Any] = {}
    for layout, along, packed in zip(_layouts(system), _ALONG, _packed(trajectory), strict=True):
        for field in layout.fields:
            component, names = _component(field, layout is system.control_layout)
            coordinates[component] = (component, names)
            values = layout.get(packed, field.name)
            variables[field.name] = ((*rows, *along, component), values, _labels(field.unit, field.meaning))
    for name, unit, meaning in _ROWS:
        variables[name] = (rows, np.asarray(getattr(trajectory, name)), _labels(unit, meaning))
    variables["result"][2].update(_flags(variables["result"][1].dtype))
    described, more = _described(system)
    try:
        return xarray.Dataset(variables | more, coordinates, _attributes(trajectory, source) | described)
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise TrajectoryFileError(
            f"{source}: the trajectory's arrays do not fit together: {reason}"
        ) from None


#: the dimensions of y, z and the controls beside time
_ALONG: tuple[tuple[str, ...], ...] = (("node",), ("node",), ())


def _layouts(system: System) -> tuple[Layout, Layout, Layout]:
    return system.y_layout, system.z_layout, system.control_layout


def _packed(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.asarray(trajectory.y), np.asarray(trajectory.z), np.asarray(trajectory.control)


def _component(field: Field, control: bool) -> tuple[str, list[Any]]:
    """The last dimension of a field's variable: its name, and what its places are called."""
    if field.name == "h" and field.size == 4:
        return "quaternion", ["w", "x", "y", "z"]
    if field.size == 3 and not control:
        return "axis", ["x", "y", "z"]
    return f"{field.name}_index", list(range(1, field.size + 1))


def _labels(unit: str, meaning: str) -> dict[str, Any]:
    return {"units": unit, "long_name": meaning}


def _flags(dtype: np.dtype) -> dict[str, Any]:
    """The result codes, as the CF conventions have them."""
    return {
        "flag_values": np.array([int(result) for result in Result], dtype=dtype),
        "flag_meanings": " ".join(result.name.lower() for result in Result),
    }


def _require_names(system: System, source: str) -> None:
    """A field's name must be free to be a variable's."""
    names = [field.name for layout in _layouts(system) for field in layout.fields]
    taken = {"time", "node", "batch", "arclength", "axis", "quaternion", _BYTES, _SIZES}
    taken |= {name for name, *_ in _ROWS}
    for name in names:
        if name in taken or "/" in name or name.startswith(_PARAMETER) or name.endswith("_index"):
            raise TrajectoryFileError(
                f"{source}: a {type(system).__name__} has a field {name!r}; "
                "in a file that name is taken, by another field or otherwise, or impossible"
            )
        taken.add(name)


def _described(system: System) -> tuple[dict[str, str], dict[str, Any]]:
    """Attributes and variables from which the system can be made again, if that is possible."""
    codec = _codecs.get(type(system).__name__)
    batch = np.ndim(system.length) > 0
    if type(system) in robot_file.KINDS.values():
        try:
            described = {"robot": robot_file.format_robot(_robot(system, 0) if batch else system)}
        except robot_file.RobotFileError as error:  # one of its parts is made of code
            return {"system_missing": _first_line(error)}, {}
        return described, _parameters(system) if batch else {}
    if codec is None or codec.cls is not type(system):
        return {}, {}
    robots = [_robot(system, i) for i in range(len(system.length))] if batch else [system]
    try:
        parts = [codec.encode(robot, f"a {type(system).__name__}") for robot in robots]
    except ValueError as error:
        return {"system_missing": _first_line(error)}, {}
    labels = {"long_name": "the system, as the bytes of a file"}
    variables = {_BYTES: ("system_byte", np.frombuffer(b"".join(parts), np.uint8), labels)}
    if batch:
        sizes = np.array([len(part) for part in parts])
        variables[_SIZES] = ("batch", sizes, {"long_name": "how many bytes each system of the batch has"})
    return {}, variables


def _robot(system: System, index: int) -> System:
    """One robot of a batch."""
    return jax.tree.map(lambda leaf: leaf[index], system)


def _parameters(system: System) -> dict[str, Any]:
    """The parameters of a batch of robots, and of their parts, as variables."""
    variables: dict[str, Any] = {}
    for name, parameter, values in _numbers(system):
        values = np.asarray(values)
        dimensions = ("batch", *(f"{_PARAMETER}{name}_{k}" for k in range(1, values.ndim)))
        variables[_PARAMETER + name] = (dimensions, values, _labels(parameter.unit, parameter.meaning))
    return variables


def _numbers(owner: Any, before: str = "") -> Iterator[tuple[str, Parameter, Any]]:
    """Every parameter that is set, of a robot and its parts: its name as `System.replace` has it, and value.

    Places are not among them: they are the same for all robots of a batch.
    """
    fixed = {field.name for field in dataclasses.fields(owner) if field.metadata.get("static")}
    for name, parameter in parameters_of(type(owner)).items():
        value = getattr(owner, name)
        if value is not None and name not in fixed:
            yield before + name, parameter, value
    for name in slots_of(type(owner)):
        held = getattr(owner, name)
        for k, each in enumerate(held) if isinstance(held, tuple) else [(None, held)]:
            if each is not None:
                yield from _numbers(each, f"{before}{name}." if k is None else f"{before}{name}.{k}.")


def _attributes(trajectory: Trajectory, source: str) -> dict[str, Any]:
    system = trajectory.system
    return {
        "title": f"Trajectory of a {type(system).__name__}",
        "comment": "Row 0 is the initial state, row i the state after control i; NaN if not solved.",
        "format": FORMAT,
        "format_version": VERSION,
        "knode_cosserat_version": package_version(),
        "system": type(system).__name__,
        "settings": _settings_text(trajectory.settings, source),
    }


# reading


def load_trajectory(path: str | Path, *, system: System | None = None) -> Trajectory:
    """Read a trajectory that `save` wrote.

    Args:
        path: the file.
        system: whose trajectory it is. Only needed for a system that no file can describe, such as one of a
            class of yours.

    Raises:
        TrajectoryFileError: the file cannot be read, is something else, or does not hold what it should.
    """
    path = Path(path)
    data = _read(path)
    if system is None:
        system = _system(path, data)
    time = _values(path, data, "time", None)
    rows = tuple(data.sizes[name] for name in ("batch", "time") if name in data.sizes)
    packed: list[Any] = []
    for layout, along in zip(_layouts(system), _ALONG, strict=True):
        shape = (*rows, *(data.sizes.get(name, 0) for name in along))
        fields = [_values(path, data, field.name, (*shape, field.size)) for field in layout.fields]
        packed.append(np.concatenate(fields, axis=-1) if fields else np.zeros((*shape, 0)))
    numbers = [_values(path, data, name, rows) for name, *_ in _ROWS]
    return Trajectory(system, _settings(path, data), time, *packed, *numbers)


def _read(path: Path) -> xarray.Dataset:
    import xarray

    _require_hdf5(path)
    try:
        with xarray.open_dataset(path, engine="h5netcdf", decode_cf=False, phony_dims="access") as data:
            _require_format(path, data.attrs)
            return data.load()
    except TrajectoryFileError:
        raise
    except Exception as error:  # each of three libraries has its own for a damaged file
        raise TrajectoryFileError(f"{path}: truncated or damaged: {_first_line(error)}") from error


def _require_hdf5(path: Path) -> None:
    try:
        with path.open("rb") as file:
            start = file.read(8)
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        reason = "no such file" if missing else f"cannot be read: {error.strerror}"
        raise TrajectoryFileError(f"{path}: {reason}") from None
    if start != b"\x89HDF\r\n\x1a\n":
        raise TrajectoryFileError(f"{path}: not a netCDF-4 file")


def _require_format(path: Path, attributes: dict[Any, Any]) -> None:
    if attributes.get("format") != FORMAT:
        raise TrajectoryFileError(f"{path}: not a trajectory of this package: its format is not {FORMAT!r}")
    version = attributes.get("format_version")
    if version != VERSION:
        raise TrajectoryFileError(
            f"{path}: format_version is {version}; allowed is {VERSION}, which this knode-cosserat reads "
            f"(the file is from knode-cosserat {attributes.get('knode_cosserat_version', 'unknown')})"
        )


def _values(path: Path, data: xarray.Dataset, name: str, shape: tuple[int, ...] | None) -> Any:
    if name not in data.variables:
        raise TrajectoryFileError(f"{path}: the variable {name!r} is missing")
    values = np.asarray(data[name].values)
    if values.dtype.kind not in "fiu":
        raise TrajectoryFileError(
            f"{path}: the variable {name!r} has type {values.dtype}; allowed is numbers"
        )
    if shape is not None and values.shape != shape:
        raise TrajectoryFileError(
            f"{path}: the variable {name!r} has shape {values.shape}; allowed is {shape}"
        )
    return values


def _system(path: Path, data: xarray.Dataset) -> System:
    """The robot, or the batch of robots, that the file describes."""
    text = data.attrs.get("robot")
    if text is None:
        return _from_bytes(path, data)
    try:
        robot = robot_file.parse_robot(str(text), f"{path}: attribute 'robot'")
        if not any(str(name).startswith(_PARAMETER) for name in data.variables):
            return robot
        count = data.sizes.get("batch", 0)
        values = {
            name: _values(path, data, _PARAMETER + name, (count, *np.shape(value)))
            for name, _, value in _numbers(robot)
        }
        robots = [robot.replace(**{name: each[i] for name, each in values.items()}) for i in range(count)]
    except robot_file.RobotFileError as error:
        raise TrajectoryFileError(str(error)) from None
    except ParameterError as error:
        raise TrajectoryFileError(f"{path}: a robot of the batch is not possible: {error}") from None
    return jax.tree.map(lambda *leaves: np.stack(leaves), *robots)


def _from_bytes(path: Path, data: xarray.Dataset) -> System:
    """The system, or the batch of systems, whose bytes the file holds."""
    name = str(data.attrs.get("system", "class unknown"))
    ask = "give it, load_trajectory(path, system=…)"
    if _BYTES not in data.variables:
        why = f" ({data.attrs['system_missing']})" if "system_missing" in data.attrs else ""
        raise TrajectoryFileError(f"{path}: the file does not describe its system, a {name}{why}: {ask}")
    if name not in _codecs:
        raise TrajectoryFileError(f"{path}: nothing that is imported here reads its system, a {name}: {ask}")
    content, sizes = np.asarray(data[_BYTES].values), np.array([data[_BYTES].size])
    if _SIZES in data.variables:
        sizes = _values(path, data, _SIZES, (data.sizes.get("batch", 0),))
    whole = content.dtype == np.uint8 and content.ndim == 1 and sizes.dtype.kind in "iu" and sizes.size > 0
    if not whole or min(sizes) < 1 or max(sizes) > content.size or sum(sizes.tolist()) != content.size:
        raise TrajectoryFileError(f"{path}: the variable {_BYTES!r} does not hold what it should")
    ends = np.cumsum(sizes)
    try:
        robots = [
            _codecs[name].decode(content[end - size : end].tobytes(), f"{path}: variable {_BYTES!r}")
            for size, end in zip(sizes, ends, strict=True)
        ]
    except ValueError as error:
        raise TrajectoryFileError(f"{_first_line(error)}; or {ask}") from None
    if _SIZES not in data.variables:
        return robots[0]
    try:
        return jax.tree.map(lambda *leaves: np.stack(leaves), *robots)
    except ValueError as error:
        raise TrajectoryFileError(f"{path}: its systems are not a batch: {_first_line(error)}") from None


def _first_line(error: Exception) -> str:
    lines = str(error).splitlines()
    return lines[0] if lines else type(error).__name__


# settings


def _settings_text(settings: Settings | None, source: str) -> str:
    try:
        return json.dumps(None if settings is None else settings.described())
    except (TypeError, ValueError) as error:
        raise TrajectoryFileError(f"{source}: the settings cannot be written: {error}") from None


def _settings(path: Path, data: xarray.Dataset) -> Settings | None:
    try:
        described = json.loads(data.attrs["settings"])
        return None if described is None else Settings.from_description(described)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise TrajectoryFileError(
            f"{path}: attribute 'settings' is not understood: {_first_line(error)}"
        ) from None
