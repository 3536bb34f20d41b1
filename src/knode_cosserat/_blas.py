"""Threads of NumPy's linear algebra."""

from __future__ import annotations

import contextlib
import ctypes
import functools
from collections.abc import Iterator
from typing import Any

import numpy as np

#: names of OpenBLAS's functions in NumPy's wheels and elsewhere, before and after `set_num_threads`
_NAMES = ("scipy_openblas_%s64_", "openblas_%s64_", "scipy_openblas_%s", "openblas_%s")


@functools.cache
def _functions() -> tuple[Any, Any] | None:
    """Return the functions that read and set the number of threads; None for another library."""
    with contextlib.suppress(OSError, AttributeError):
        # also finds what the module is linked to, but on Windows
        library = ctypes.CDLL(np.linalg._umath_linalg.__file__)
        for name in _NAMES:
            if hasattr(library, name % "set_num_threads"):
                return getattr(library, name % "get_num_threads"), getattr(library, name % "set_num_threads")
    return None


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Run NumPy's linear algebra in one thread, where that can be set.

    On matrices of a few hundred rows, threads wait for each other longer than they work.
    """
    functions = _functions()
    if functions is None:
        yield
        return
    get, set_ = functions
    before = get()
    set_(1)
    try:
        yield
    finally:
        set_(before)
