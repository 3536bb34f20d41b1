"""Numbers of users: the vectors of command lines and control words, and arrays that must be real numbers."""

from __future__ import annotations

import re
import reprlib
from typing import Any

import numpy as np

_SEPARATOR = re.compile(r"\s*[,;]\s*|\s+")
_BRACKETS = {"[": "]", "(": ")"}


def numbers_in(text: str) -> list[float] | None:
    """Return the numbers of a text, separated by commas, semicolons or spaces; None if it has other words.

    Brackets around all of them are allowed: `7,5,5,7`, `7 5 5 7` and `[7, 5, 5, 7]` are the same.
    """
    text = text.strip()
    if text and _BRACKETS.get(text[0]) == text[-1]:
        text = text[1:-1].strip()
    try:
        return [float(word) for word in _SEPARATOR.split(text)]
    except ValueError:
        return None


#: what NumPy would turn into numbers, by the kind of its type
_NO_NUMBERS = {
    "b": "true or false",
    "c": "complex",
    "U": "text",
    "S": "text",
    "M": "dates",
    "m": "durations",
    "V": "records",
}


def real_array(values: Any) -> np.ndarray:
    """Return values as an array of real numbers.

    Raises:
        ValueError: they are no numbers, or some are masked; a phrase that follows "they".
    """
    if values is None:
        raise ValueError("None")
    if isinstance(values, np.ma.MaskedArray):
        if np.ma.is_masked(values):
            raise ValueError(f"{int(np.ma.count_masked(values))} of them are masked")
        values = values.data
    try:
        array = np.asarray(values)
    except ValueError:
        raise ValueError("their rows have different lengths") from None
    kind = array.dtype.kind
    if kind == "O":
        words = next((one for one in array.ravel() if isinstance(one, (str, bytes, bool))), None)
        if words is not None:
            raise ValueError(f"one of them is {words!r}")
    elif kind in _NO_NUMBERS:
        such = f", {reprlib.repr(array.ravel()[0].item())}" if array.size else ""
        raise ValueError(f"they are {_NO_NUMBERS[kind]}{such}")
    try:
        return np.asarray(array, dtype=float)
    except (TypeError, ValueError):
        other = next((one for one in array.ravel() if not np.isscalar(one)), None)
        raise ValueError(f"one of them is {with_article(type(other).__name__)}") from None


def with_article(noun: str) -> str:
    """Return a noun with its indefinite article."""
    return f"{'an' if noun[0] in 'AEIOUaeiou' else 'a'} {noun}"
