"""Numbers in a text: the vectors of command lines and control words."""

from __future__ import annotations

import re

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
