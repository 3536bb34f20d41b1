"""Pages of the public names: one each, and a table of them for each room that they live in."""

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
    spaces: list[types.ModuleType] = [kc, kch]
    for space in spaces:
        for name in _names(space):
            thing = getattr(space, name)
            if isinstance(thing, types.ModuleType):
                spaces += [] if thing in spaces else [thing]
            elif not _is_constant(thing):
                found.setdefault(_path(space, name, thing), thing)
    return found


def _names(space: types.ModuleType) -> list[str]:
    """Return the names that a module lists, or else the public ones that it defines."""
    defined = [
        name for name, thing in vars(space).items() if getattr(thing, "__module__", "") == space.__name__
    ]
    return getattr(space, "__all__", [name for name in defined if not name.startswith("_")])


def _is_constant(thing: Any) -> bool:
    """True for a constant or an array type, which have no page of their own."""
    module = getattr(inspect.getmodule(thing), "__name__", "")
    return not (hasattr(thing, "__qualname__") and module.startswith(PACKAGE))


def rooms() -> dict[str, list[str]]:
    """Paths of all public objects by room: a folder of the library, a module at its top, or hardware."""
    found: dict[str, list[str]] = {}
    for path, thing in public().items():
        package, room = _module(thing).split(".")[:2]
        found.setdefault("hardware" if package == kch.__name__ else room, []).append(path)
    return found


def _module(thing: Any) -> str:
    return inspect.getmodule(thing).__name__  # type: ignore[union-attr]


def page(*named: str) -> str:
    """Return a table of the public names of some rooms, with links: main functions first."""
    things = public()
    rows = [f"| [`{_name(path)}`]({path}.md) | {_summary(things[path])} |" for path in ordered(*named)]
    return "\n".join(["| name | |", "| --- | --- |", *rows])


def pages(folder: Path) -> dict[str, str]:
    """Return a page for each public name that the pages in a folder list, by file name, with a link back."""
    found = {}
    for file in sorted(folder.glob("*.md")):
        title = file.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
        for path in ordered(*_rooms_of(file)):
            head = f"---\ntitle: {_name(path)}\n---\n\n[{title}]({file.name})"
            found[f"{path}.md"] = f"{head}\n\n::: {path}\n"
    return found


def ordered(*named: str) -> list[str]:
    """Return the paths of the public names of some rooms."""
    known, things = rooms(), public()
    paths = [path for room in named for path in known[room]]
    return sorted(paths, key=lambda path: _rank(path, things[path]))


def _name(path: str) -> str:
    return path.rpartition(".")[2]


def _summary(thing: Any) -> str:
    """Return the first sentence of a docstring."""
    return (inspect.getdoc(thing) or "").partition("\n\n")[0].replace("\n", " ").replace("|", "\\|")


def _rank(path: str, thing: Any) -> tuple[int, str]:
    """Return the place of a name: main functions, then functions, then classes."""
    name = _name(path)
    if name in MAIN:
        return MAIN.index(name), name
    return len(MAIN) + isinstance(thing, type), name.lower()


def _path(space: types.ModuleType, name: str, thing: Any) -> str:
    """Return an object's path where it is defined, or where it is public if its name differs."""
    return f"{_module(thing) if thing.__qualname__ == name else space.__name__}.{name}"


def shown(folder: Path) -> list[str]:
    """Return the rooms that the pages in a folder name."""
    return [room for file in folder.glob("*.md") for room in _rooms_of(file)]


def _rooms_of(file: Path) -> list[str]:
    lines = [line.split() for line in file.read_text(encoding="utf-8").splitlines()]
    return [room for line in lines if line[:3] == ["<!--", "site:", "api"] for room in line[3:-1]]
