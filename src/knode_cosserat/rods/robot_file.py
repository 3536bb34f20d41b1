"""Robots as YAML files, their JSON Schema, and the catalog of robots in the package.

    format: 1
    kind: tendon-robot
    description: one line of text
    parameters:
      length: 0.635  # m
      …

The kind's class states names, units and allowed values (`parameters`). Reading runs no code. Numbers follow
YAML 1.2: `2.7e9` is a number and `1:30` is not.
"""

from __future__ import annotations

import difflib
import importlib.resources
import json
import os
import warnings
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.writing import replacing
from knode_cosserat._files.yaml_text import (
    YAMLTextError,
    did_you_mean,
    excerpt,
    flow,
    mapping_of,
    read_yaml,
)
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.rods import chambers, fluids, frame, insertion, magnets  # noqa: F401 (files name their kinds)
from knode_cosserat.rods.assembly import Assembly
from knode_cosserat.rods.ends import End
from knode_cosserat.rods.parallel_robot import ParallelRobot
from knode_cosserat.rods.parameters import (
    ParameterError,
    in_order,
    kinds_of,
    object_schema,
    parameters_of,
    read_object,
    require_keys,
    schema_if_kind,
    slots_of,
)
from knode_cosserat.rods.passport import Passport, with_passport
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.rods.system import FEWEST_NODES, MOST_NODES, ChosenNodes, System, is_traced
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot, TendonRobot, VirtualRobot
from knode_cosserat.rods.tubes import ConcentricTubeRobot

#: formats of files. The first had numbers only; a robot without choices and parts is still written in it
FORMATS = (1, 2)

#: keys of a file, and those that it must have
KEYS = ("format", "kind", "description", "parameters", "hardware", "passport")
REQUIRED = ("format", "kind", "parameters")

#: classes that a file can name as its kind
KINDS: dict[str, type[System]] = {
    cls.kind: cls
    for cls in (
        TendonRobot,
        RoutedTendonRobot,
        SlenderRod,
        VirtualRobot,
        ParallelRobot,
        ConcentricTubeRobot,
        Assembly,
    )
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
    check_arguments(load_robot, locals())
    robot, source = parse_robot(_text_of(name_or_path), str(name_or_path)), str(name_or_path)
    if source not in _catalog_files():
        warn_of_paper_tendons(robot, source)
        warn_of_places_in_metres(robot, source)
    return robot


def warn_of_places_in_metres(robot: System, source: str) -> None:
    """Warn of parts whose last end, a fraction, equals the robot's length in m: the tip is at 1."""
    length = float(getattr(robot, "length", 1.0))
    for name in slots_of(type(robot)):
        value = getattr(robot, name)
        parts = value if isinstance(value, tuple) else (value,)
        ends = [it for part in parts if isinstance(it := getattr(part, "end", None), float)]
        end = max(ends, default=1.0)
        if end < 1.0 and np.isclose(end, length, rtol=1e-9, atol=0.0):
            warnings.warn(
                f"{source}: the last of {name} ends at {end:g} of the length, {1e3 * end * length:.4g} mm "
                f"from the base; the robot is {length:g} m long, places are fractions. Did you mean end: 1?",
                stacklevel=3,
            )


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

    Nodes are stated in it unless the robot's parts alone chose them.

    Raises:
        RobotFileError: the robot's class has no kind, it is a batch, or the file cannot be written.
    """
    check_arguments(save_robot, locals())
    chosen = isinstance(robot.nodes, ChosenNodes) and robot.nodes == robot.needed_nodes
    text = format_robot(robot, description, with_nodes=not chosen)
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
    try:
        return _robot(file)
    except ParameterError as error:
        raise RobotFileError(f"{source}: {error}") from None


def _robot(file: dict[Any, Any]) -> System:
    number = file.get("format", FORMATS[0])
    if isinstance(number, bool) or number not in FORMATS:
        raise ParameterError(
            f"format is {excerpt(number)}; allowed is {' or '.join(map(str, FORMATS))}, "
            "the formats that this version reads"
        )
    for key in file:
        if key not in KEYS and any(key in parameters_of(kind) for kind in KINDS.values()):
            raise ParameterError(
                f"the key {excerpt(key)} is unknown; allowed is {', '.join(KEYS)}; "
                "a robot's parameters belong under the key parameters"
            )
    require_keys(file, KEYS, REQUIRED)
    for key in ("kind", "description"):
        if not isinstance(file.get(key, ""), str):
            raise ParameterError(f"{key} is {excerpt(file[key])}; allowed is text")
    # the machine around the rod, which drivers read
    if not isinstance(file.get("hardware", {}), dict | None):
        raise ParameterError(f"hardware is {excerpt(file['hardware'])}; allowed is a mapping")
    kind, values = file["kind"], file["parameters"]
    if kind not in KINDS:
        raise ParameterError(f"kind is {kind!r}; allowed is {', '.join(KINDS)}{did_you_mean(kind, KINDS)}")
    if not isinstance(values, dict):
        raise ParameterError(f"parameters is {excerpt(values)}; allowed is a mapping from names to values")
    robot: System = read_object(KINDS[kind], values, "")
    passport = file.get("passport")
    return robot if passport is None else with_passport(robot, Passport.from_dict(passport))


def _mapping(text: str, source: str) -> dict[Any, Any]:
    """Return the file's outermost mapping."""
    try:
        return mapping_of(text, "format, kind and parameters")
    except YAMLTextError as error:
        raise RobotFileError(f"{source}: {error}") from None


# robot to text


def format_robot(robot: System, description: str = "", with_nodes: bool = True) -> str:
    """Return the text of a robot's file, with the unit beside each value; see `save_robot` for the errors.

    Without nodes, the robot that is read chooses them.
    """
    kind = next((name for name, cls in KINDS.items() if type(robot) is cls), None)
    if kind is None:
        raise RobotFileError(
            f"a {type(robot).__name__} cannot be written to a robot file; allowed is a robot of a class in "
            f"robot_file.KINDS: {', '.join(cls.__name__ for cls in KINDS.values())}"
        )
    if np.ndim(robot.length):
        raise RobotFileError("a batch of robots cannot be written to one robot file; write them one by one")
    if is_traced(robot):
        raise RobotFileError("a robot cannot be written to a file inside jit, grad or vmap")
    more = more_of(robot)
    head = {"format": FORMATS[1 if more else 0], "kind": kind, "description": description}
    lines = [f"{key}: {flow(value)}" for key, value in head.items() if value != ""]
    lines.append("parameters:")
    for name, parameter in robot.parameters().items():
        value = getattr(robot, name)
        if value is not None:
            lines.append(f"  {name}: {parameter.written(value)}  # {parameter.unit}, {parameter.meaning}")
    if with_nodes:
        lines.append(f"  nodes: {robot.nodes}  # base and tip included")
    return "\n".join(lines + more + _passport_lines(robot.passport)) + "\n"


def _passport_lines(passport: Passport | None) -> list[str]:
    """Return the lines of a passport."""
    if passport is None:
        return []
    lines = ["passport:  # what it was learned from, and the range of controls and strains there"]
    for key, value in passport.to_dict().items():
        # JSON is YAML in which every text is quoted
        if isinstance(value, list):
            lines += [f"  {key}:", *(f"    - {json.dumps(one, ensure_ascii=False)}" for one in value)]
        else:
            lines.append(f"  {key}: {json.dumps(value, ensure_ascii=False)}")
    return lines


def more_of(robot: System) -> list[str]:
    """Return lines for the choices and parts of a robot that differ from their defaults."""
    lines = []
    defaults = {name: field.default for name, field in type(robot).__dataclass_fields__.items()}
    for name, stated in in_order(type(robot)).items():
        value = getattr(robot, name)
        if name in robot.parameters() or value is None or eqx.tree_equal(value, defaults[name]) is True:
            continue
        try:
            text = stated.written(value)
        except ParameterError as error:
            raise RobotFileError(str(error)) from None
        first, *others = text.split("\n")
        lines += [f"  {name}: {first}".rstrip() + f"  # {stated.meaning}", *others]
    return lines


# schema

DIALECT = "https://json-schema.org/draft/2020-12/schema"
NODES = {
    "type": "integer",
    "minimum": FEWEST_NODES,
    "maximum": MOST_NODES,
    "description": "nodes along the rod, base and tip included; by default as many as parts and shapes need",
}


def robot_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of robot files, as a mapping that `json.dumps` writes.

    It completes names and marks errors in an editor. It is weaker than the loader, which refuses every file
    that the schema refuses: it does not check the eigenvalues of a matrix, for example.
    `knode-cosserat schema` prints it. A robot file names it in a comment for the editor:
    `# yaml-language-server: $schema=robot.schema.json`.
    """
    parts: dict[str, Any] = {}
    robots = {name: object_schema(cls, parts, nodes=NODES) for name, cls in KINDS.items()}
    for name, allowed in ("base_end", "anywhere"), ("tip_end", "at_tip"):
        refused = [kind for kind, end in kinds_of(End).items() if not getattr(end, allowed)]
        kind = {"properties": {"kind": {"enum": refused}}, "required": ["kind"]}
        for robot in robots.values():
            if name in robot["properties"]:
                robot["properties"][name]["not"] = kind
    return {
        "$schema": DIALECT,
        "title": "robot file of KNODE-Cosserat",
        "type": "object",
        "required": list(REQUIRED),
        "additionalProperties": False,
        "properties": {
            "format": {"enum": list(FORMATS), "description": "2 if there are choices or parts, else 1"},
            "kind": {"enum": list(KINDS), "description": "class of the robot"},
            "description": {"type": "string", "description": "description in one line"},
            "parameters": {"type": "object", "description": "names and values, in SI units and radians"},
            "hardware": {
                "type": ["object", "null"],
                "description": "limits of tensions and dimensions of parts, in SI units, for drivers and CAD",
            },
            "passport": {
                "type": ["object", "null"],
                "description": "what the robot was learned from, as identification writes it",
            },
        },
        "allOf": [
            schema_if_kind(name, {"properties": {"parameters": {"$ref": f"#/$defs/{name}"}}})
            for name in robots
        ],
        "$defs": robots | parts,
    }
