"""Findings on a recording, collected while it is read, and the error for an unusable recording."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from knode_cosserat._files.reading import ReadError
from knode_cosserat.errors import KnodeCosseratError

Severity = Literal["note", "warning", "problem"]
#: severities, the gravest first
SEVERITIES: tuple[Severity, ...] = ("problem", "warning", "note")


class RecordingError(KnodeCosseratError, ValueError):
    """Error for a recording that cannot be read or used; the message is one line with the reason."""

    code = "recording"


@contextlib.contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Name a file in the errors about its content. Raises `RecordingError`."""
    try:
        yield
    except (RecordingError, ReadError) as error:
        raise RecordingError(f"{path}: {error}") from None


@dataclasses.dataclass(frozen=True)
class Finding:
    """Finding on a recording that its user should know.

    A `note` is harmless or was repaired without loss. A `warning` was repaired at a cost or may be an error.
    A `problem` means that a part of the recording is left out or doubtful.
    """

    severity: Severity
    #: topic concerned (in a table, the columns' prefix); empty: the whole recording
    topic: str
    message: str
    #: times of the events (s)
    times: tuple[float, ...] = ()

    def __str__(self) -> str:
        return ": ".join(part for part in (self.severity, self.topic, self.message) if part)


def counted(count: int, one: str, several: str) -> str:
    """Return a count with its words in the singular or plural."""
    return f"{count} {one if count == 1 else several}"
