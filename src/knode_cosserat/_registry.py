"""Functions of a class that another module defines, such as a writer of its files.

An object that saves or examines itself does not import the module that does so. Instead that module registers
its function for the class:

    provide(Trajectory, "save", save)          # in the module with the file format
    provided(Trajectory, "save")(self, path)   # in the class

The modules that register functions are imported when one is missing.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

#: modules that register functions
PROVIDERS = (
    "knode_cosserat.trajectory_file",
    "knode_cosserat.recordings.health",
    "knode_cosserat.learning.files.model_file",
)

_functions: dict[tuple[type, str], Callable[..., Any]] = {}


def provide(cls: type, name: str, function: Callable[..., Any]) -> None:
    """Register a function for a class and its subclasses under a name."""
    _functions[cls, name] = function


def provided(cls: type, name: str) -> Callable[..., Any]:
    """Return the function that is registered for a class, or for one of its bases.

    Raises:
        NotImplementedError: no module has registered it.
    """
    for module in (None, *PROVIDERS):
        if module is not None:
            importlib.import_module(module)
        for base in cls.__mro__:
            if (base, name) in _functions:
                return _functions[base, name]
    raise NotImplementedError(f"no function {name!r} is registered for a {cls.__name__}")


def load_providers() -> None:
    """Import all modules that register functions."""
    for module in PROVIDERS:
        importlib.import_module(module)
