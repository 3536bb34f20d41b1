"""Systems in files of trajectories: their description, and their reconstruction.

A robot is stored as the text of a robot file, with the parameters of a batch as variables. A system without a
robot file is stored as the bytes of another file, if there is a codec for its class. Reconstruction runs no
code from the file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from knode_cosserat._registry import load_providers
from knode_cosserat.errors import KnodeCosseratError, first_line
from knode_cosserat.rods import robot_file
from knode_cosserat.rods.parameters import Parameter, ParameterError, parameters_of, slots_of
from knode_cosserat.rods.system import System

if TYPE_CHECKING:
    import xarray

#: prefix of a parameter's name if each robot of a batch has its own value
PARAMETER = "robot_"
#: the bytes of a system with a codec; for a batch, the systems' bytes in sequence, with their sizes
BYTES, SIZES = "system_bytes", "system_sizes"


class TrajectoryFileError(KnodeCosseratError, ValueError):
    """A trajectory's file cannot be read or written; the message is one line with the reason."""

    code = "trajectory-file"


class Codec(NamedTuple):
    """Conversion of systems of a class to bytes and back; the text names the file in errors.

    Both functions raise a `ValueError` of one line on failure.
    """

    cls: type[System]
    encode: Callable[[Any, str], bytes]
    decode: Callable[[bytes, str], System]


_codecs: dict[str, Codec] = {}


def register_codec(
    cls: type[System], encode: Callable[[Any, str], bytes], decode: Callable[[bytes, str], System]
) -> None:
    """Register a codec, so that files of trajectories can hold systems of a class without a robot file."""
    _codecs[cls.__name__] = Codec(cls, encode, decode)


# writing


def described(system: System) -> tuple[dict[str, str], dict[str, Any]]:
    """Return attributes and variables that reconstruct the system, if that is possible."""
    batch = np.ndim(system.length) > 0
    if type(system) in robot_file.KINDS.values():
        try:
            robot = {"robot": robot_file.format_robot(_robot(system, 0) if batch else system)}
        except robot_file.RobotFileError as error:  # one of its parts is a Python function
            return {"system_missing": first_line(error)}, {}
        return robot, _parameters(system) if batch else {}
    load_providers()
    codec = _codecs.get(type(system).__name__)
    if codec is None or codec.cls is not type(system):
        return {}, {}
    robots = [_robot(system, i) for i in range(len(system.length))] if batch else [system]
    try:
        parts = [codec.encode(robot, f"a {type(system).__name__}") for robot in robots]
    except ValueError as error:
        return {"system_missing": first_line(error)}, {}
    meaning = {"long_name": "the system, as the bytes of a file"}
    variables = {BYTES: ("system_byte", np.frombuffer(b"".join(parts), np.uint8), meaning)}
    if batch:
        sizes = np.array([len(part) for part in parts])
        variables[SIZES] = ("batch", sizes, {"long_name": "how many bytes each system of the batch has"})
    return {}, variables


def _robot(system: System, index: int) -> System:
    """Return one robot of a batch."""
    return jax.tree.map(lambda leaf: leaf[index], system)


def _parameters(system: System) -> dict[str, Any]:
    """Return the parameters of a batch of robots, and of their parts, as variables."""
    variables: dict[str, Any] = {}
    for name, parameter, values in _numbers(system):
        values = np.asarray(values)
        dimensions = ("batch", *(f"{PARAMETER}{name}_{k}" for k in range(1, values.ndim)))
        variables[PARAMETER + name] = (dimensions, values, labels(parameter.unit, parameter.meaning))
    return variables


def _numbers(owner: Any, before: str = "") -> Iterator[tuple[str, Parameter, Any]]:
    """Yield every parameter that is set, of a robot and its parts: name for `System.replace`, and value.

    Places are left out: they are equal for all robots of a batch.
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


def labels(unit: str, meaning: str) -> dict[str, Any]:
    """Return a variable's attributes."""
    return {"units": unit, "long_name": meaning}


# reading


def system_of(path: Path, data: xarray.Dataset) -> System:
    """Return the robot, or the batch of robots, described in the file."""
    text = data.attrs.get("robot")
    if text is None:
        return _from_bytes(path, data)
    try:
        robot = robot_file.parse_robot(str(text), f"{path}: attribute 'robot'")
        if not any(str(name).startswith(PARAMETER) for name in data.variables):
            return robot
        count = data.sizes.get("batch", 0)
        values = {
            name: values_of(path, data, PARAMETER + name, (count, *np.shape(value)))
            for name, _, value in _numbers(robot)
        }
        robots = [robot.replace(**{name: each[i] for name, each in values.items()}) for i in range(count)]
    except robot_file.RobotFileError as error:
        raise TrajectoryFileError(str(error)) from None
    except ParameterError as error:
        raise TrajectoryFileError(f"{path}: a robot of the batch is not possible: {error}") from None
    return jax.tree.map(lambda *leaves: np.stack(leaves), *robots)


def _from_bytes(path: Path, data: xarray.Dataset) -> System:
    """Return the system, or the batch of systems, stored as bytes in the file."""
    name = str(data.attrs.get("system", "class unknown"))
    ask = "give it, load_trajectory(path, system=…)"
    if BYTES not in data.variables:
        why = f" ({data.attrs['system_missing']})" if "system_missing" in data.attrs else ""
        raise TrajectoryFileError(f"{path}: the file does not describe its system, a {name}{why}: {ask}")
    load_providers()
    if name not in _codecs:
        raise TrajectoryFileError(f"{path}: nothing that is imported here reads its system, a {name}: {ask}")
    content, sizes = np.asarray(data[BYTES].values), np.array([data[BYTES].size])
    if SIZES in data.variables:
        sizes = values_of(path, data, SIZES, (data.sizes.get("batch", 0),))
    whole = content.dtype == np.uint8 and content.ndim == 1 and sizes.dtype.kind in "iu" and sizes.size > 0
    if not whole or min(sizes) < 1 or max(sizes) > content.size or sum(sizes.tolist()) != content.size:
        raise TrajectoryFileError(f"{path}: the variable {BYTES!r} does not hold what it should")
    ends = np.cumsum(sizes)
    try:
        robots = [
            _codecs[name].decode(content[end - size : end].tobytes(), f"{path}: variable {BYTES!r}")
            for size, end in zip(sizes, ends, strict=True)
        ]
    except ValueError as error:
        raise TrajectoryFileError(f"{first_line(error)}; or {ask}") from None
    if SIZES not in data.variables:
        return robots[0]
    try:
        return jax.tree.map(lambda *leaves: np.stack(leaves), *robots)
    except ValueError as error:
        raise TrajectoryFileError(f"{path}: its systems are not a batch: {first_line(error)}") from None


def values_of(path: Path, data: xarray.Dataset, name: str, shape: tuple[int, ...] | None) -> Any:
    """Return the numbers of one variable; any shape is allowed if `shape` is None."""
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
