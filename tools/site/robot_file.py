"""The reference of robot files, from what each class states of its parameters, choices and parts."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from knode_cosserat.rods.parameters import (
    Choice,
    Parameter,
    in_order,
    kinds_of,
    parameters_of,
    slots_of,
    stated_of,
)
from knode_cosserat.rods.robot_file import KINDS, NODES
from knode_cosserat.rods.rod import SlenderRod

SHAPES = {
    "scalar": "number",
    "vector": "three numbers",
    "direction": "three numbers",
    "quaternion": "four numbers, scalar first",
    "matrix": "number, diagonal or 3×3",
    "list": "list of numbers",
}
HEAD = "| name | meaning | kind | unit | accepted | default |\n| --- | --- | --- | --- | --- | --- |\n"
FAMILIES = {
    "End": "Ends: `base_end`, `tip_end`",
    "Load": "Loads: `loads`",
    "MagneticField": "Magnetic fields: `field` of magnets",
    "Tube": "Tubes: `tubes`",
    "SlenderRod": "Rods: `rods` of an assembly",
    "RigidBody": "Bodies: `bodies` of an assembly",
    "NeighbourContact": "Contact of neighbours: `contacts` of an assembly",
    "Effect": "Further physics: `effects`",
    "Obstacle": "Surroundings: `surroundings`",
    "CrossSection": "Cross-section: `cross_section`",
    "SectionChange": "Sections: `sections`",
    "Routing": "Tendon routing: `routing`",
    "LoadCells": "Load cells: `load_cells`",
    "TendonFriction": "Friction of tendons: `friction`",
    "Vibration": "Vibration: `vibration`",
    "RibSpacing": "Rib spacing: `rib_spacing`",
    "Relaxation": "Relaxation of the material: `relaxation`",
    "Reels": "Reels: `reels`",
    "EarlyAnchors": "Early anchors: `anchors`",
    "Camera": "Frame and marker of the measurements: `camera`",
}


#: families on pages of their own; the others share one
LOADS = ("Load", "Obstacle", "Effect")
TENDONS = (
    "Routing", "Reels", "TendonFriction", "Vibration", "RibSpacing", "Relaxation", "EarlyAnchors",
    "LoadCells",
)  # fmt: skip


def robots() -> str:
    """Return the kinds of robots with their entries."""
    rod = set(in_order(SlenderRod))
    of_a_rod = [cls for cls in KINDS.values() if issubclass(cls, SlenderRod) and rod <= set(in_order(cls))]
    texts = [
        "## Robots of one rod",
        "Entries of all of `" + "`, `".join(kind for kind, cls in KINDS.items() if cls in of_a_rod) + "`.",
        HEAD + "\n".join([*_rows(SlenderRod, rod), _nodes()]),
    ]
    for kind, cls in KINDS.items():
        one = cls in of_a_rod
        rows = _rows(cls, None, without=rod) if one else [*_rows(cls, None), _nodes()]
        after = "No further entries." if one and not rows else HEAD + "\n".join(rows)
        texts += [f"## `{kind}`", _first(cls), after]
    return "\n\n".join(texts)


def parts(*named: str) -> str:
    """Return some families of the parts that robots hold, or those without a page, with the kinds of each."""
    families: dict[str, type] = {}
    holders: list[type] = list(KINDS.values())
    for cls in holders:  # it grows: parts may hold parts
        for slot in slots_of(cls).values():
            if slot.family.__name__ not in families:
                families[slot.family.__name__] = slot.family
                holders += _kinds(slot.family).values()
    texts = []
    elsewhere = {*LOADS, *TENDONS} - set(named)
    for name, family in families.items():
        if (name not in named) if named else (name in elsewhere):
            continue
        texts += [f"## {FAMILIES[name]}", _first(family)]
        if family is SlenderRod:
            texts.append("The kinds of robots of one rod, with [their entries](robot-kinds.md).")
            continue
        for kind, cls in _kinds(family).items():
            rows = _rows(cls, None)
            texts += [f"### `{kind}`", _first(cls), HEAD + "\n".join(rows) if rows else "No parameters."]
    return "\n\n".join(texts)


def _kinds(family: type) -> dict[str, type]:
    """Return the kinds of a family that the package has; others are of whoever runs this."""
    return {
        kind: cls for kind, cls in kinds_of(family).items() if cls.__module__.startswith("knode_cosserat")
    }


def _first(cls: type) -> str:
    return (cls.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ")


def _rows(cls: type, only: set[str] | None, without: Any = ()) -> list[str]:
    defaults = {field.name: field.default for field in dataclasses.fields(cls)}
    rows = {
        name: _row(name, each.meaning, SHAPES[each.shape], each.unit, _range(each), _default(defaults[name]))
        for name, each in parameters_of(cls).items()
    }
    for name, each in stated_of(cls, Choice).items():
        words = ", ".join(f"`{str(word).lower()}`" for word in each.allowed)
        kind = "list of different words" if each.many else "word"
        rows[name] = _row(name, each.meaning, kind, "", words, _default(defaults[name]))
    for name, slot in slots_of(cls).items():
        kind = "list of mappings" if slot.many else "mapping"
        words = ", ".join(f"`{word}`" for word in _kinds(slot.family))
        rows[name] = _row(name, slot.meaning, kind, "", words, _part(defaults[name]))
    return [row for name, row in rows.items() if name not in without and (only is None or name in only)]


def _row(*cells: str) -> str:
    name, *others = cells
    return "| " + " | ".join([f"`{name}`", *(cell.replace("|", "\\|") for cell in others)]) + " |"


def _range(stated: Parameter) -> str:
    not_all = "not all zero, each "
    each = {"scalar": "", "matrix": "eigenvalues ", "direction": not_all, "quaternion": not_all}.get(
        stated.shape, "each "
    )
    return f"{each}{stated.low:g} to {stated.high:g}"


def _default(value: Any) -> str:
    if value is dataclasses.MISSING:
        return "**required**"
    if value is None:
        return "none"
    if isinstance(value, bool | str):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple) and value and isinstance(value[0], str):
        return f"`[{', '.join(value)}]`"
    array = np.asarray(value, dtype=float)
    numbers = [f"{each:.4g}" for each in array.reshape(-1)]
    return numbers[0] if not array.ndim else f"[{', '.join(numbers)}]"


def _part(value: Any) -> str:
    if value is None or value == ():
        return "none"
    return f"`{value.kind}`"


def _nodes() -> str:
    allowed = f"{NODES['minimum']} to {NODES['maximum']}"
    return _row("nodes", str(NODES["description"]), "whole number", "", allowed, "chosen")
