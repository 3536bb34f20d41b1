"""Output of the commands: text or JSON on stdout."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import typer


def write_output(as_json: bool, facts: dict[str, Any], lines: list[str], **written: Path | None) -> None:
    """Print the facts as one JSON object, or the lines of text; then the names of the files written."""
    if as_json:
        files = {name: str(path) if path else None for name, path in written.items()}
        typer.echo(json.dumps(facts | files, allow_nan=False))
        return
    for line in [*lines, *(f"wrote {path}" for path in written.values() if path)]:
        typer.echo(printable(line))


def best_so_far(compute: Callable[[], Any]) -> Any:
    """Return what a function computes; at Ctrl-C its best result so far, if it has one, which is said."""
    try:
        return compute()
    except KeyboardInterrupt as stop:
        best = getattr(stop, "best", None)
        if best is None:
            raise
        typer.echo("interrupted; this is the best so far", err=True)
        return best


def printable(text: str) -> str:
    """Return a text with control characters written out: names in files may hold a terminal's commands."""
    return "".join(c if c.isprintable() or c in "\n\t" else repr(c)[1:-1] for c in text)


def table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = ((cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)
    return ["  ".join(row).rstrip() for row in padded]


def vector_text(values: list[float]) -> str:
    """Return a vector as text; components below 1e-9 of the largest are printed as 0."""
    size = max(map(abs, values))
    return "(" + ", ".join(f"{value if abs(value) > 1e-9 * size else 0.0:.6g}" for value in values) + ")"


def value_text(value: Any) -> str:
    """Return a parameter's value as text."""
    if value is None:
        return "not given"
    array = np.asarray(value)
    if array.ndim == 2 and np.array_equal(array, np.diag(np.diag(array))):
        return f"diag {value_text(np.diag(array).tolist())}"
    if array.ndim:
        return "[" + ", ".join(value_text(each) for each in value) + "]"
    return f"{value:.6g}"
