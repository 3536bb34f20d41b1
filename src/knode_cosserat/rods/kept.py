"""Results of functions of a system, kept while the system lives and its numbers stay the same."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np

from knode_cosserat.rods.system import System, is_traced

Function = TypeVar("Function", bound=Callable[..., Any])


_ENTRIES: dict[int, _KeptResult] = {}


class _KeptResult:
    """Results for one system."""

    def __init__(self, system: System):
        # its names also exist when modules are gone at the end of a process
        key, pop = id(system), _ENTRIES.pop
        self.system = weakref.ref(system, lambda _: pop(key, None) and None)
        #: arrays of the system that a user can change in place, with their numbers
        self.numbers = [
            (leaf, leaf.tobytes())
            for leaf in jax.tree.leaves(system)
            if isinstance(leaf, np.ndarray) and (leaf.flags.writeable or leaf.base is not None)
        ]
        self.results: dict[Any, Any] = {}

    def fits(self, system: System) -> bool:
        """True if the results are those of a system as it is now."""
        return self.system() is system and all(leaf.tobytes() == known for leaf, known in self.numbers)


def kept(function: Function) -> Function:
    """Return a function of a system and hashable arguments that keeps its results, with read-only arrays.

    Results with traced values are not kept.
    """

    @functools.wraps(function)
    def call(system: Any, *arguments: Any) -> Any:
        entry = _ENTRIES.get(id(system))
        if entry is None or not entry.fits(system):
            if is_traced(system):
                return function(system, *arguments)
            entry = _ENTRIES[id(system)] = _KeptResult(system)
        key = function, *arguments
        if key not in entry.results:
            result = function(system, *arguments)
            if is_traced(result):
                return result
            for leaf in jax.tree.leaves(result):
                if isinstance(leaf, np.ndarray):
                    leaf.flags.writeable = False
            entry.results[key] = result
        return entry.results[key]

    return call  # type: ignore[return-value]
