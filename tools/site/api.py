"""Pages of the public names, by the room that they live in."""

from __future__ import annotations

import inspect
import types
from pathlib import Path
from typing import Any

import knode_cosserat as kc

PACKAGE = "knode_cosserat"


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
    """What is public in some rooms: classes and functions, and modules of them with all that they hold."""
    known = rooms()
    names = [name for room in named for name in known[room]]
    things = {name: getattr(kc, name) for name in sorted(names, key=str.lower)}
    # modules last: they are longest
    ordered = sorted(things, key=lambda name: isinstance(things[name], types.ModuleType))
    return "\n\n".join(f"::: {_path(things[name])}" for name in ordered)


def _path(thing: Any) -> str:
    return where(thing) if isinstance(thing, types.ModuleType) else f"{where(thing)}.{thing.__qualname__}"


def shown(folder: Path) -> list[str]:
    """The rooms that the pages in a folder name."""
    text = "".join(file.read_text(encoding="utf-8") for file in folder.glob("*.md"))
    lines = [line.split() for line in text.splitlines() if line.startswith("<!-- site: api ")]
    return [room for line in lines for room in line[3:-1]]
