"""Base class of all errors that this package raises on purpose."""

from __future__ import annotations

from typing import ClassVar


class KnodeCosseratError(Exception):
    """Base class of the package's errors.

    Every public error also has a built-in base, such as `ValueError` for wrong input or `RuntimeError` for a
    computation that failed.
    """

    #: short, stable name of the class of error, such as "parameter" or "simulation"
    code: ClassVar[str] = "error"

    def __str__(self) -> str:
        """Return the message in one line: names that come from files may have line breaks."""
        return " ".join(super().__str__().splitlines())


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message (300 characters at most), or the name of its class."""
    lines = str(error).strip().splitlines()
    return lines[0][:300] if lines else type(error).__name__
