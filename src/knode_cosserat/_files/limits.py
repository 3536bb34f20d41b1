"""Limits of what is read from files, multiplied by one setting.

Every reader limits the sizes, counts and expansion of a file, because a small file can stand for more than
the memory holds. The environment variable `KNODE_COSSERAT_LIMITS` multiplies all these limits: 10 allows ten
times the default, 0.1 a tenth. It is read at each use. Limits of nesting are fixed, because they protect the
interpreter's stack, which does not grow with the memory.
"""

from __future__ import annotations

import math
import os

from knode_cosserat.errors import KnodeCosseratError

VARIABLE = "KNODE_COSSERAT_LIMITS"
#: hint at the end of each refusal
MORE = f"set {VARIABLE}=10 to allow ten times the default"
#: largest limit: more than any memory, and small enough for sizes of arrays in 64 bits
_LARGEST = 2**50


class LimitSettingError(KnodeCosseratError, ValueError):
    """The environment variable of the limits is not a positive number; the message is one line."""

    code = "limit-setting"


def scaled_limit(number: int) -> int:
    """Return a limit times the factor of the environment variable.

    Raises:
        LimitSettingError: the variable is not a finite number above 0.
    """
    chosen = os.environ.get(VARIABLE) or "1"
    try:
        factor = float(chosen)
    except ValueError:
        factor = math.nan
    if not 0.0 < factor < math.inf:
        raise LimitSettingError(f"{VARIABLE} must be a finite number above 0 (got {chosen[:60]!r})")
    return int(min(number * factor, _LARGEST))


def excess(number: int, limit: int, unit: str) -> str:
    """Return the reason to refuse a file with so many of a unit; empty if the limit allows it."""
    most = scaled_limit(limit)
    return f"it has {number} {unit}; allowed are {most}; {MORE}" if number > most else ""
