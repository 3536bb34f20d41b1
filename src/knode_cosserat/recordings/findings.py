"""What is found out about a recording while it is read, and the error that ends the reading."""

from __future__ import annotations

import dataclasses
from typing import Literal

Severity = Literal["note", "warning", "problem"]
#: the gravest first
SEVERITIES: tuple[Severity, ...] = ("problem", "warning", "note")


class RecordingError(ValueError):
    """A recording that cannot be read or used; the message is one line that says why."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """Something about a recording that whoever uses it should know.

    A `note` is as it should be or was mended without loss, a `warning` was mended at a cost or may be wrong,
    a `problem` leaves out a part of the recording, or makes it doubtful.
    """

    severity: Severity
    #: the topic (in a table, the columns) it is about; empty: the whole recording
    topic: str
    message: str
    #: when it was (s)
    times: tuple[float, ...] = ()

    def __str__(self) -> str:
        return ": ".join(part for part in (self.severity, self.topic, self.message) if part)
