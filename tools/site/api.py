"""Pages of the public names, by the room that they live in."""

from __future__ import annotations

import inspect
import types
from pathlib import Path
from typing import Any

import knode_cosserat as kc
import knode_cosserat_hardware as kch

PACKAGE = "knode_cosserat"
#: functions that most readers look for: first on their pages, in this order
MAIN = (
    "load_robot",
    "simulate",
    "equilibrium",
    "fit",
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


def public() -> dict[str, Any]:
    """All public objects by their path: those of the library, of its namespaces, and of hardware."""
    found: dict[str, Any] = {}
    for space in [kc, kch, *(thing for name in kc.__all__ if _is_namespace(thing := getattr(kc, name)))]:
        for name in space.__all__:
            thing = getattr(space, name)
            if not _is_namespace(thing) and not _is_constant(thing):
                found.setdefault(_path(space, name, thing), thing)
    return found


def _is_namespace(thing: Any) -> bool:
    """True for a module that lists its public names; a module without such a list is shown as a whole."""
    return isinstance(thing, types.ModuleType) and hasattr(thing, "__all__")


def _is_constant(thing: Any) -> bool:
    """True for a constant or an array type, which have no page of their own."""
    named = isinstance(thing, types.ModuleType) or hasattr(thing, "__qualname__")
    return not named or not getattr(inspect.getmodule(thing), "__name__", "").startswith(PACKAGE)


def rooms() -> dict[str, list[str]]:
    """Paths of all public objects by room: a folder of the library, a module at its top, or hardware."""
    found: dict[str, list[str]] = {}
    for path, thing in public().items():
        package, room = where(thing).split(".")[:2]
        found.setdefault("hardware" if package == kch.__name__ else room, []).append(path)
    return found


def where(thing: Any) -> str:
    """The path of an object's module, or of the module itself."""
    return thing.__name__ if isinstance(thing, types.ModuleType) else inspect.getmodule(thing).__name__  # type: ignore[union-attr]


def page(*named: str) -> str:
    """Return the public names of some rooms: main functions first, modules with all their members last."""
    known, things = rooms(), public()
    paths = [path for room in named for path in known[room]]
    ordered = sorted(paths, key=lambda path: _rank(path, things[path]))
    return "\n\n".join(f"::: {path}" for path in ordered)


def _rank(path: str, thing: Any) -> tuple[int, str]:
    """Return the place of a name: main functions, then functions, then classes, then modules."""
    name = path.rpartition(".")[2]
    if name in MAIN:
        return MAIN.index(name), name
    return len(MAIN) + (2 if isinstance(thing, types.ModuleType) else isinstance(thing, type)), name.lower()


def _path(space: types.ModuleType, name: str, thing: Any) -> str:
    """Return an object's path where it is defined, or where it is public if its name differs."""
    if isinstance(thing, types.ModuleType):
        return where(thing)
    return f"{where(thing) if thing.__qualname__ == name else space.__name__}.{name}"


def shown(folder: Path) -> list[str]:
    """The rooms that the pages in a folder name."""
    text = "".join(file.read_text(encoding="utf-8") for file in folder.glob("*.md"))
    lines = [line.split() for line in text.splitlines() if line.startswith("<!-- site: api ")]
    return [room for line in lines for room in line[3:-1]]
