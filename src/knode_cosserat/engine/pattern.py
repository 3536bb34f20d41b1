"""Machine code of a process, kept by the pattern of a system."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterable
from typing import Any, Self, TypeVar

import jax
import numpy as np

from knode_cosserat.engine.equations import constant_zeros
from knode_cosserat.engine.program import EngineError
from knode_cosserat.rods.system import System, is_traced

#: compiled code, or the reason why there is none, by what it depends on; the last used come last
_CODES: dict[Any, Any] = {}
#: number of codes that a process keeps: that of a time loop takes about 5 MB
MOST_CODES = 100
_COMPILING = threading.Lock()

Code = TypeVar("Code")


@dataclasses.dataclass(frozen=True)
class Pattern:
    """Structure of a system, and its parameters that are zero: constants of the code."""

    structure: Any
    #: shape of each leaf, and its zeros as bits
    zeros: tuple[tuple[tuple[int, ...], bytes], ...]

    @classmethod
    def of(cls, system: System) -> Self:
        """Return the pattern of a system; zeros of a batch are those of all, and no traced value is one."""
        leaves, structure = jax.tree.flatten(system)
        axis, zeros = np.ndim(system.length), []
        for leaf in leaves:
            known = np.ones(np.shape(leaf)) if is_traced(leaf) else np.asarray(leaf, float)
            zeros.append(constant_zeros(np.max(np.abs(known), axis=tuple(range(axis)))))
        return cls(structure, masks_of(zeros))

    @property
    def system(self) -> System:
        """A system of this pattern, with ones for all other parameters."""
        leaves = []
        for shape, bits in self.zeros:
            size = int(np.prod(shape))
            mask = np.unpackbits(np.frombuffer(bits, np.uint8), count=size).reshape(shape)
            leaves.append(1.0 - mask)
        return jax.tree.unflatten(self.structure, leaves)


def masks_of(masks: Iterable[np.ndarray]) -> Any:
    """Return shapes and bits of masks, which can be compared."""
    return tuple((mask.shape, np.packbits(mask).tobytes()) for mask in masks)


def compiled(key: Any, build: Callable[[], Code]) -> Code:
    """Return compiled code that is kept by a key.

    Raises:
        EngineError: the engine does not cover the system or the settings.
    """
    with _COMPILING:
        code: Any = _CODES.pop(key, None)
        if code is None:
            try:
                # also while JAX traces a caller: equations are traced by themselves
                with jax.core.eval_context():
                    code = build()
            except EngineError as error:
                # without the frames that a traceback keeps alive
                code = error.with_traceback(None)
        _CODES[key] = code
        if len(_CODES) > MOST_CODES:
            del _CODES[next(iter(_CODES))]
    if isinstance(code, EngineError):
        raise code.with_traceback(None)
    return code


def parameters_of(system: System) -> np.ndarray:
    """Return all numeric parameters of a system in one vector."""
    return np.concatenate([np.asarray(leaf, float).reshape(-1) for leaf in jax.tree.leaves(system)])
