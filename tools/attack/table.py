"""Table of an attack: tried, refused cleanly, failed."""

from __future__ import annotations

from typing import NamedTuple


class Row(NamedTuple):
    """Outcome of one kind of attack."""

    name: str
    tried: int
    #: attacks that ended with an error of the package in one line; others changed nothing
    refused: int
    failures: list[str]
    remark: str = ""


def printed_title() -> None:
    """Print the head of the table."""
    print("| attack | tried | refused in one line | failed | remark |")
    print("| --- | --- | --- | --- | --- |", flush=True)


def printed_row(row: Row) -> None:
    """Print a row of the table."""
    cells = row.name, row.tried, row.refused, len(row.failures), row.remark
    print(f"| {' | '.join(map(str, cells))} |", flush=True)
