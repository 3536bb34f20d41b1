"""Telling the user: facts as JSON, or the same in words, and the files that were written."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import typer


def tell(as_json: bool, facts: dict[str, Any], lines: list[str], **written: Path | None) -> None:
    """Facts as JSON, or the same in words; and the files that were written."""
    if as_json:
        files = {name: str(path) if path else None for name, path in written.items()}
        typer.echo(json.dumps(facts | files, allow_nan=False))
        return
    for line in [*lines, *(f"wrote {path}" for path in written.values() if path)]:
        typer.echo(line)


def table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines with the cells of each column below each other."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = ((cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)
    return ["  ".join(row).rstrip() for row in padded]


def vector(values: list[float]) -> str:
    """Numbers in words, without those that are rounding errors beside the largest."""
    size = max(map(abs, values))
    return "(" + ", ".join(f"{value if abs(value) > 1e-9 * size else 0.0:.6g}" for value in values) + ")"


def shown(value: Any) -> str:
    """A parameter's value in words."""
    if value is None:
        return "not given"
    array = np.asarray(value)
    if array.ndim == 2 and np.array_equal(array, np.diag(np.diag(array))):
        return f"diag {shown(np.diag(array).tolist())}"
    if array.ndim:
        return "[" + ", ".join(shown(each) for each in value) + "]"
    return f"{value:.6g}"
