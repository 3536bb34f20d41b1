"""Pages of the public names, by the room that they live in."""

from __future__ import annotations

import inspect
import types
from pathlib import Path
from typing import Any

import knode_cosserat as kc

PACKAGE = "knode_cosserat"
#: functions that most readers look for: first on their pages, in this order
MAIN = (
    "load_robot",
    "simulate",
    "equilibrium",
    "fit",
    "calibrate",
    "load_recording",
    "estimate_states",
    "identify",
    "tip_rmse",
    "pose_mse",
    "inverse_kinematics",
    "workspace",
    "stability",
    "view",
    "view_live",
)


def rooms() -> dict[str, list[str]]:
    """All public names by room: a folder of the package, or a module at its top."""
    found: dict[str, list[str]] = {}
    for name in kc.__all__:
        found.setdefault(where(getattr(kc, name)).split(".")[1], []).append(name)
    return found


def where(thing: Any) -> str:
    """The path of an object's module, or of the module itself."""
    return thing.__name__ if isinstance(thing, types.ModuleType) else inspect.getmodule(thing).__name__  # type: ignore[union-attr]


def page(*named: str) -> str:
    """Return the public names of some rooms: main functions first, modules with all their members last."""
    known = rooms()
    names = [name for room in named for name in known[room]]
    things = {name: getattr(kc, name) for name in names}
    ordered = sorted(names, key=lambda name: (_rank(name, things[name]), name.lower()))
    return "\n\n".join(f"::: {_path(things[name])}" for name in ordered)


def _rank(name: str, thing: Any) -> int:
    """Return the place of a name: main functions, then functions, then classes, then modules."""
    if name in MAIN:
        return MAIN.index(name)
    return len(MAIN) + (2 if isinstance(thing, types.ModuleType) else isinstance(thing, type))


def _path(thing: Any) -> str:
    return where(thing) if isinstance(thing, types.ModuleType) else f"{where(thing)}.{thing.__qualname__}"


def shown(folder: Path) -> list[str]:
    """The rooms that the pages in a folder name."""
    text = "".join(file.read_text(encoding="utf-8") for file in folder.glob("*.md"))
    lines = [line.split() for line in text.splitlines() if line.startswith("<!-- site: api ")]
    return [room for line in lines for room in line[3:-1]]
