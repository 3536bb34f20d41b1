"""Packages whose public names are imported on first use."""

from __future__ import annotations

import importlib
import sys
import types
from collections.abc import Mapping
from typing import Any


class _LazyPackage(types.ModuleType):
    """A package whose public names come from the modules in `_homes` (name: module), or are submodules."""

    _homes: Mapping[str, str]

    def __getattr__(self, name: str) -> Any:
        if name in self._homes:
            value = getattr(importlib.import_module(self._homes[name]), name)
            self.__dict__[name] = value
            return value
        submodule = f"{self.__name__}.{name}"
        try:
            return importlib.import_module(submodule)
        except ModuleNotFoundError as error:
            if error.name != submodule:
                raise
        raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")

    def __setattr__(self, name: str, value: Any) -> None:
        # Python sets a submodule as an attribute of its package; a public function of the same name wins
        if not (name in self._homes and isinstance(value, types.ModuleType)):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted(self.__all__)


def make_lazy(package: str, names: Mapping[str, str]) -> None:
    """Give a package its public names, each imported from its module on first use, and its submodules.

    Args:
        package: its `__name__`; it lists its public names in `__all__`.
        names: module, and the names that come from it, separated by spaces.
    """
    module = sys.modules[package]
    module.__dict__["_homes"] = {name: home for home, listed in names.items() for name in listed.split()}
    module.__class__ = _LazyPackage
