"""Functions of a class that another module defines, such as a writer of its files.

An object that saves or examines itself does not import the module that does so. Instead that module registers
its function for the class:

    provide(Trajectory, "save", save)          # in the module with the file format
    provided(Trajectory, "save")(self, path)   # in the class

The packages' `__init__` import every module that registers functions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_functions: dict[tuple[type, str], Callable[..., Any]] = {}


def provide(cls: type, name: str, function: Callable[..., Any]) -> None:
    """Register a function for a class and its subclasses under a name."""
    _functions[cls, name] = function


def provided(cls: type, name: str) -> Callable[..., Any]:
    """Return the function that is registered for a class, or for the nearest of its bases.

    Raises:
        NotImplementedError: no module has registered it.
    """
    for base in cls.__mro__:
        if (base, name) in _functions:
            return _functions[base, name]
    raise NotImplementedError(
        f"no function {name!r} is registered for a {cls.__name__}; import knode_cosserat registers all"
    )
