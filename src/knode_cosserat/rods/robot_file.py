"""Robots as YAML files, and the catalog of robots in the package.

    format: 1
    kind: tendon-robot
    description: one line of text
    parameters:
      length: 0.635  # m
      …

The kind's class states names, units and allowed values (`System.parameters`). Reading runs no code. Numbers
follow YAML 1.2: `2.7e9` is a number and `1:30` is not.
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib.resources
import os
import warnings
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from knode_cosserat._files.writing import replacing
from knode_cosserat._files.yaml_text import YAMLTextError, did_you_mean, flow, mapping_of, read_yaml, shown
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.rods.parallel_robot import ParallelRobot
from knode_cosserat.rods.parameters import (
    Parameter,
    ParameterError,
    Slot,
    checked,
    choices_of,
    parameters_of,
    slots_of,
)
from knode_cosserat.rods.parts import kinds_of
from knode_cosserat.rods.routed_robot import RoutedTendonRobot
from knode_cosserat.rods.slender_rod import SlenderRod
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendon_robot import TendonRobot
from knode_cosserat.rods.virtual_robot import VirtualRobot

#: formats of files. The first had numbers only; a robot without choices and parts is still written in it
FORMATS = (1, 2)

#: classes that a file can name as its kind
KINDS: dict[str, type[System]] = {
    "tendon-robot": TendonRobot,
    "routed-tendon-robot": RoutedTendonRobot,
    "slender-rod": SlenderRod,
    "virtual-robot": VirtualRobot,
    "parallel-robot": ParallelRobot,
}

#: distance (m) of the tendons from the axis of the paper's robot
PAPER_OFFSET = 0.02


class RobotFileError(KnodeCosseratError, ValueError):
    """A robot file is invalid: one line that names file, key, value and the allowed values."""

    code = "robot-file"


def load_robot(name_or_path: str | Path) -> System:
    """Return a robot from the catalog, by name, or from a file, by path. The catalog has priority.

    A file of the paper's tendon model (`kind: tendon-robot`) with another `tendon_offset` than the paper's
    robot is warned of: the tendons of that model push the rod sideways, wherever they run.

    Raises:
        RobotFileError: there is no such robot, or its file is invalid.
    """
    robot, source = parse_robot(_text_of(name_or_path), str(name_or_path)), str(name_or_path)
    if source not in _catalog_files():
        warn_of_paper_tendons(robot, source)
    return robot


def warn_of_paper_tendons(robot: System, source: str) -> None:
    """Warn of a tendon offset that was chosen for the paper's tendon model, which ignores it."""
    if type(robot) is TendonRobot and float(robot.tendon_offset) not in (0.0, PAPER_OFFSET):
        warnings.warn(
            f"{source}: kind tendon-robot is the paper's model, whose tendons push the rod sideways: its "
            "simulation ignores tendon_offset. For tendons that run beside the rod, write kind: "
            "routed-tendon-robot",
            stacklevel=3,
        )


def file_mapping(name_or_path: str | Path) -> dict[Any, Any]:
    """Return the content of a robot's file, from the catalog or by path, as it is written there.

    Raises:
        RobotFileError: there is no such file, or it is not YAML.
    """
    return _mapping(_text_of(name_or_path), str(name_or_path))


def save_robot(robot: System, path: str | Path, *, description: str = "") -> None:
    """Write a robot to a file that `load_robot` reads back equal. The file is complete or not written.

    Raises:
        RobotFileError: the robot's class has no kind, it is a batch, or the file cannot be written.
    """
    text = format_robot(robot, description)
    try:
        with replacing(Path(path)) as temporary:
            temporary.write_text(text, encoding="utf-8")
    except OSError as error:
        raise RobotFileError(f"{path}: cannot be written: {error.strerror}") from None


def catalog() -> dict[str, str]:
    """Return the names of the catalog's robots, each with a description in one line."""
    files = sorted(_catalog_files().items())
    described = {name: _mapping(_text(file, name), name).get("description", "") for name, file in files}
    return {name: " ".join(description.split()) for name, description in described.items()}


def _catalog_files() -> dict[str, Traversable]:
    folder = importlib.resources.files("knode_cosserat.rods") / "catalog"
    return {file.name[:-5]: file for file in folder.iterdir() if file.name.endswith(".yaml")}


def _text_of(name_or_path: str | Path) -> str:
    file = _catalog_files().get(str(name_or_path)) or _existing(Path(name_or_path))
    return _text(file, str(name_or_path))


def _existing(path: Path) -> Path:
    if os.path.exists(path):
        return path
    names = sorted(_catalog_files())
    neighbours = [str(path.with_name(file.name)) for file in path.parent.glob("*.y*ml")]
    close = difflib.get_close_matches(str(path), [*names, *neighbours], n=1)
    close = close or difflib.get_close_matches(path.stem, names, n=1)
    hint = f"; did you mean {close[0]}?" if close else ""
    raise RobotFileError(f"{path}: no such file or robot; the catalog has {', '.join(names)}{hint}")


def _text(file: Traversable, source: str) -> str:
    try:
        return read_yaml(file) if isinstance(file, Path) else file.read_text(encoding="utf-8")
    except YAMLTextError as error:
        raise RobotFileError(f"{source}: {error}") from None


# text to robot


def parse_robot(text: str, source: str) -> System:
    """Return the robot of a file's text; `source` names the file in errors. Raises `RobotFileError`."""
    file = _mapping(text, source)
    number = file.get("format", FORMATS[0])
    if isinstance(number, bool) or number not in FORMATS:
        raise RobotFileError(
            f"{source}: format is {shown(number)}; allowed is {' or '.join(map(str, FORMATS))}, "
            "the formats that this version reads"
        )
    known = ("format", "kind", "description", "parameters", "hardware")
    _require_keys(file, source, known=known, required=("format", "kind", "parameters"))
    for key in ("kind", "description"):
        if not isinstance(file.get(key, ""), str):
            raise RobotFileError(f"{source}: {key} is {shown(file[key])}; allowed is text")
    # the machine around the rod, which drivers read
    if not isinstance(file.get("hardware", {}), dict | None):
        raise RobotFileError(f"{source}: hardware is {shown(file['hardware'])}; allowed is a mapping")
    kind, values = file["kind"], file["parameters"]
    if kind not in KINDS:
        raise RobotFileError(
            f"{source}: kind is {kind!r}; allowed is {', '.join(KINDS)}{did_you_mean(kind, KINDS)}"
        )
    if not isinstance(values, dict):
        raise RobotFileError(
            f"{source}: parameters is {shown(values)}; allowed is a mapping from names to values"
        )
    return _robot(KINDS[kind], values, source)


def _robot(cls: type[System], values: dict[Any, Any], source: str) -> System:
    made = _made(cls, values, source, "parameters", more=("nodes",))
    assert isinstance(made, System)
    return made


def _made(cls: type, values: dict[Any, Any], source: str, where: str, more: tuple[str, ...] = ()) -> Any:
    """Return an object of a class from a mapping of its parameters, choices and parts."""
    numbers, words, parts = parameters_of(cls), choices_of(cls), slots_of(cls)
    # an empty optional value counts as absent
    optional = {name for name, each in (numbers | parts).items() if each.optional}
    values = {key: value for key, value in values.items() if value is not None or key not in optional}
    fields = {field.name: field for field in dataclasses.fields(cls)}
    required = [key for key in numbers if fields[key].default is dataclasses.MISSING]
    _require_keys(values, f"{source}: {where}", known=(*numbers, *words, *parts, *more), required=required)
    given: dict[str, Any] = {}
    inner = "" if where == "parameters" else f"{where}."
    for key, value in values.items():
        if key in numbers:
            _require_allowed(inner + key, value, numbers[key], source)
        elif key in parts:
            value = _parts(value, parts[key], source, inner + key)
        elif key not in words and (not isinstance(value, int) or isinstance(value, bool)):
            raise RobotFileError(f"{source}: {key} is {shown(value)}; allowed is a whole number, 2 or more")
        elif key in words and not words[key].allows(value):
            raise RobotFileError(f"{source}: {inner}{key} is {shown(value)}; allowed is {words[key].words}")
        given[key] = value
    try:
        return cls(**given)
    except ParameterError as error:
        raise RobotFileError(f"{source}: {inner and where + ': '}{error}") from None


def _parts(value: Any, slot: Slot, source: str, where: str) -> Any:
    """Return a part from a mapping with its kind, or parts from a list of such mappings."""
    known = kinds_of(slot.family)
    names = ", ".join(known)
    if slot.many:
        if not isinstance(value, list):
            raise RobotFileError(
                f"{source}: {where} is {shown(value)}; "
                f"allowed is a list of mappings, each with a kind: {names}"
            )
        one = dataclasses.replace(slot, many=False)
        return tuple(_parts(each, one, source, f"{where}.{k}") for k, each in enumerate(value))
    if not isinstance(value, dict) or "kind" not in value:
        raise RobotFileError(
            f"{source}: {where} is {shown(value)}; allowed is a mapping with a kind: {names}"
        )
    kind = value["kind"]
    if not isinstance(kind, str) or kind not in known:
        raise RobotFileError(
            f"{source}: {where}.kind is {shown(kind)}; allowed is {names}{did_you_mean(kind, known)}"
        )
    return _made(known[kind], {key: each for key, each in value.items() if key != "kind"}, source, where)


def _require_keys(mapping: dict[Any, Any], source: str, *, known: Any, required: Any) -> None:
    for key in mapping:
        if key not in known:
            hint = did_you_mean(key, known)
            if "parameters" in known and any(key in parameters_of(kind) for kind in KINDS.values()):
                hint = "; a robot's parameters belong under the key parameters"
            raise RobotFileError(
                f"{source}: the key {shown(key)} is unknown; allowed is {', '.join(known)}{hint}"
            )
    missing = [key for key in required if key not in mapping]
    if missing:
        raise RobotFileError(
            f"{source}: the key {missing[0]!r} is missing; required is {', '.join(required)}"
        )


# values


def _require_allowed(key: str, value: Any, parameter: Parameter, source: str) -> None:
    array = _array(value)
    if array is not None and parameter.shape == "matrix" and array.shape in ((), (3,)):
        array = np.diag(np.broadcast_to(array, 3))
    try:
        checked(key, np.asarray(None) if array is None else array, parameter)
    except ParameterError:
        text = isinstance(value, str)
        message = (
            parameter.refusal_of_text(key, value) if text else parameter.refusal(key, shown(value), array)
        )
        raise RobotFileError(f"{source}: {message}") from None


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


# robot to text


def format_robot(robot: System, description: str = "") -> str:
    """Return the text of a robot's file, with the unit beside each value; see `save_robot` for the errors."""
    kind = next((name for name, cls in KINDS.items() if type(robot) is cls), None)
    if kind is None:
        raise RobotFileError(
            f"a {type(robot).__name__} cannot be written to a robot file; allowed is a robot of a class in "
            f"robot_file.KINDS: {', '.join(cls.__name__ for cls in KINDS.values())}"
        )
    if np.ndim(robot.length):
        raise RobotFileError("a batch of robots cannot be written to one robot file; write them one by one")
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(robot)):
        raise RobotFileError("a robot cannot be written to a file inside jit, grad or vmap")
    more = more_of(robot)
    head = {"format": FORMATS[1 if more else 0], "kind": kind, "description": description}
    lines = [f"{key}: {flow(value)}" for key, value in head.items() if value != ""]
    lines.append("parameters:")
    for name, parameter in robot.parameters().items():
        value = getattr(robot, name)
        if value is not None:
            lines.append(f"  {name}: {flow(_plain(value))}  # {parameter.unit}, {parameter.meaning}")
    lines.append(f"  nodes: {robot.nodes}  # base and tip included")
    return "\n".join(lines + more) + "\n"


def more_of(robot: System) -> list[str]:
    """Return lines for the choices and parts of a robot that differ from their defaults."""
    lines = []
    defaults = {field.name: field.default for field in dataclasses.fields(robot)}
    for name, choice in choices_of(type(robot)).items():
        value = getattr(robot, name)
        if value != defaults[name]:
            lines.append(f"  {name}: {_word(value)}  # {choice.meaning}")
    for name, slot in slots_of(type(robot)).items():
        value = getattr(robot, name)
        if value is None or eqx.tree_equal(value, defaults[name]) is True:
            continue
        if not slot.many:
            lines.append(f"  {name}: {_part_text(value)}  # {slot.meaning}")
            continue
        lines.append(f"  {name}:  # {slot.meaning}")
        lines += [f"    - {_part_text(each)}" for each in value]
    return lines


def _part_text(each: Any) -> str:
    """Return a part's text on one line."""
    if not each.kind:
        raise RobotFileError(
            f"a {type(each).__name__} cannot be written to a robot file: it is made of code, not of numbers"
        )
    entries = [f"kind: {each.kind}"]
    defaults: dict[str, Any] = {field.name: field.default for field in dataclasses.fields(each)}
    for name in parameters_of(type(each)):
        value = getattr(each, name)
        if value is not None and not np.array_equal(value, defaults[name]):
            entries.append(f"{name}: {flow(_plain(value))}")
    entries += [
        f"{name}: {_word(getattr(each, name))}"
        for name in choices_of(type(each))
        if getattr(each, name) != defaults[name]
    ]
    return "{" + ", ".join(entries) + "}"


def _word(value: Any) -> str:
    return flow(list(value) if isinstance(value, tuple) else value)


def _plain(value: Any) -> Any:
    """Return numbers in the shortest form that reads back equal: one for a multiple of the identity."""
    array = np.asarray(value, dtype=float)
    if array.shape == (3, 3) and np.array_equal(array, np.diag(np.diag(array))):
        array = np.diag(array)
        array = array[0] if np.all(array == array[0]) else array
    return array.tolist()


# YAML


def _mapping(text: str, source: str) -> dict[Any, Any]:
    """Return the file's outermost mapping."""
    try:
        return mapping_of(text, "format, kind and parameters")
    except YAMLTextError as error:
        raise RobotFileError(f"{source}: {error}") from None
