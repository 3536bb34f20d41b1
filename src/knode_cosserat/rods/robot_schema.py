"""JSON Schema of robot files, for completion of names and marking of errors in an editor.

It is built from the same statements that the loader checks (`parameters`, `parts`). The schema is weaker than
the loader: it does not check the eigenvalues of a matrix, for example. The loader refuses every file that the
schema refuses.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from knode_cosserat.rods.ends import End
from knode_cosserat.rods.parameters import Choice, Parameter, Slot, choices_of, parameters_of, slots_of
from knode_cosserat.rods.parts import kinds_of
from knode_cosserat.rods.robot_file import FORMATS, KINDS
from knode_cosserat.rods.system import FEWEST_NODES, MOST_NODES

DIALECT = "https://json-schema.org/draft/2020-12/schema"
NODES = {
    "type": "integer",
    "minimum": FEWEST_NODES,
    "maximum": MOST_NODES,
    "default": 10,
    "description": "nodes along the rod, base and tip included",
}
#: constraint on an array
NOT_ALL_ZERO = {"contains": {"not": {"const": 0}}}


def robot_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of robot files, as a mapping that `json.dumps` writes.

    `knode-cosserat schema` prints it. A robot file names it in a comment for the editor:
    `# yaml-language-server: $schema=robot.schema.json`.
    """
    parts: dict[str, Any] = {}
    robots = {name: _mapping(cls, parts, nodes=NODES) for name, cls in KINDS.items()}
    return {
        "$schema": DIALECT,
        "title": "robot file of KNODE-Cosserat",
        "type": "object",
        "required": ["format", "kind", "parameters"],
        "additionalProperties": False,
        "properties": {
            "format": {"enum": list(FORMATS), "description": "2 if there are choices or parts, else 1"},
            "kind": {"enum": list(KINDS), "description": "what robot it is"},
            "description": {"type": "string", "description": "what it is, in one line"},
            "parameters": {"type": "object", "description": "names and values, in SI units and radians"},
            "hardware": {
                "type": ["object", "null"],
                "description": "limits of tensions and dimensions of parts, in SI units, for drivers and CAD",
            },
        },
        "allOf": [
            _if_kind(name, {"properties": {"parameters": {"$ref": f"#/$defs/{name}"}}}) for name in robots
        ],
        "$defs": robots | parts,
    }


def _mapping(cls: type, parts: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Return the schema of a class's mapping; the families of its parts are added to `parts`."""
    fields = {field.name: field.default for field in dataclasses.fields(cls)}
    numbers = parameters_of(cls)
    known = {name: _number(each, fields[name]) for name, each in numbers.items()}
    known |= {name: _word(each, fields[name]) for name, each in choices_of(cls).items()}
    known |= {name: _slot(each, parts) for name, each in slots_of(cls).items()}
    if {"begin", "end"} <= known.keys():
        # begin < end leaves no room for these values
        known["begin"]["exclusiveMaximum"], known["end"]["exclusiveMinimum"] = 1.0, 0.0
    if "base_end" in known:
        ends: Any = kinds_of(End)
        tip_only = [kind for kind, end in ends.items() if not end.anywhere]
        known["base_end"]["not"] = {"properties": {"kind": {"enum": tip_only}}, "required": ["kind"]}
    return {
        "type": "object",
        "description": (cls.__doc__ or cls.__name__).splitlines()[0],
        "properties": known | more,
        "required": [name for name in numbers if fields[name] is dataclasses.MISSING],
        "additionalProperties": False,
    }


def _number(stated: Parameter, default: Any) -> dict[str, Any]:
    one = {"type": "number", "minimum": stated.low, "maximum": stated.high}
    shape: dict[str, Any] = {
        "scalar": one,
        "vector": _array(one, 3),
        "direction": {**_array(one, 3), **NOT_ALL_ZERO},
        "quaternion": {**_array(one, 4), **NOT_ALL_ZERO},
        "list": {"type": "array", "items": one, "minItems": 1},
        "matrix": {"anyOf": [one, _array(one, 3), _square(one, stated.high)]},
    }[stated.shape]
    unit = f" ({stated.unit})" if stated.unit else ""
    found = {**_or_null(shape, stated.optional), "description": f"{stated.meaning}{unit}"}
    if default is not dataclasses.MISSING and default is not None:
        found["default"] = np.asarray(default, dtype=float).tolist()
    return found


def _array(one: Any, count: int) -> dict[str, Any]:
    return {"type": "array", "items": one, "minItems": count, "maxItems": count}


def _square(one: Any, high: float) -> dict[str, Any]:
    """Schema of a 3x3 matrix: diagonal within the eigenvalues' bounds, entries within the upper one."""
    other = {"type": "number", "minimum": -high, "maximum": high}
    rows = [[one if row == column else other for column in range(3)] for row in range(3)]
    whole = [{"type": "array", "prefixItems": row, "minItems": 3, "maxItems": 3} for row in rows]
    return {"type": "array", "prefixItems": whole, "minItems": 3, "maxItems": 3}


def _word(stated: Choice, default: Any) -> dict[str, Any]:
    one = {"enum": list(stated.allowed)}
    if not stated.many:
        return {**one, "description": stated.meaning, "default": default}
    several = {"type": "array", "items": one, "uniqueItems": True}
    return {**several, "description": stated.meaning, "default": list(default)}


def _slot(slot: Slot, parts: dict[str, Any]) -> dict[str, Any]:
    family = slot.family.__name__.lower()
    if family not in parts:
        kinds = kinds_of(slot.family)
        parts[family] = {}  # before its members, which may hold parts of the same family
        for kind, cls in kinds.items():
            named = {"const": kind, "description": "what it is"}
            made = _mapping(cls, parts, kind=named)
            parts[f"{family}.{kind}"] = {**made, "required": ["kind", *made["required"]]}
        parts[family] = {
            "type": "object",
            "required": ["kind"],
            "properties": {"kind": {"enum": list(kinds)}},
            "allOf": [_if_kind(kind, {"$ref": f"#/$defs/{family}.{kind}"}) for kind in kinds],
        }
    one = {"$ref": f"#/$defs/{family}"}
    shape: dict[str, Any] = {"type": "array", "items": one} if slot.many else one
    if slot.many and slot.optional:
        # an absent key means none, so an empty list is refused
        shape["minItems"] = 1
    return {**_or_null(shape, slot.optional), "description": slot.meaning}


def _or_null(shape: dict[str, Any], optional: bool) -> dict[str, Any]:
    return {"anyOf": [shape, {"type": "null"}]} if optional else shape


def _if_kind(kind: str, then: dict[str, Any]) -> dict[str, Any]:
    return {"if": {"properties": {"kind": {"const": kind}}, "required": ["kind"]}, "then": then}
