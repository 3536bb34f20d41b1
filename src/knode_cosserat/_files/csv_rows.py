"""CSV files of numbers over time, read strictly: invalid or missing cells are errors."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.limits import MORE, excess, scaled_limit
from knode_cosserat.errors import KnodeCosseratError

Rows = Float[np.ndarray, "rows columns"]
Times = Float[np.ndarray, " rows"]

#: limits of a file: bytes, lines (5.5 h at 1 kHz), columns
LARGEST_FILE, MOST_LINES, MOST_COLUMNS = 1_000_000_000, 20_000_000, 1_000

#: tolerance for equal times, as a fraction of a step: i dt is rounded, and so are times in files
SAME_TIME = 1e-4

#: largest number of sampled steps: more would not fit into memory, and dt is then a mistake
MOST_STEPS = 10**8


class CSVTextError(KnodeCosseratError, ValueError):
    """A file cannot be read or sampled; the message is one line."""

    code = "csv"


class Column(NamedTuple):
    """Specification of a file's column."""

    title: str
    #: index among the file's numbers, independent of the columns' order: 0 for the time
    place: int
    factor: float = 1.0
    low: float = -np.inf
    allowed: str = "a finite number"


def size_excess(path: Path) -> str:
    """Return the reason to refuse a file by its size, before it is read; empty if the limit allows it."""
    return excess(path.stat().st_size, LARGEST_FILE, "bytes")


def read_rows(
    path: Path, header: str, columns_of: Callable[[str, list[str]], list[Column]]
) -> tuple[Times, Rows, list[int]]:
    """Return increasing times, the other numbers of each row in the order of their places, and these places.

    `columns_of` makes columns from the header's location and titles, and raises its own error; `header` is
    the allowed one, for errors.

    Raises:
        CSVTextError: the file is invalid; the message names file, line and column.
    """
    try:
        if reason := size_excess(path):
            raise CSVTextError(f"{path}: {reason}")
        with path.open(encoding="utf-8-sig", newline="") as file:
            return _rows(path, csv.reader(file), header, columns_of)
    except FileNotFoundError:
        raise CSVTextError(f"{path}: no such file") from None
    except OSError as error:
        raise CSVTextError(f"{path}: cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise CSVTextError(f"{path}: not a CSV text file: {error}") from None


def _rows(
    path: Path, reader: Any, header: str, columns_of: Callable[[str, list[str]], list[Column]]
) -> tuple[Times, Rows, list[int]]:
    filled = (cells for cells in reader if any(cell.strip() for cell in cells))
    titles = next(filled, None)
    if titles is None:
        raise CSVTextError(f"{path}: the file is empty; allowed is {header}, then rows of numbers")
    if reason := excess(len(titles), MOST_COLUMNS, "columns"):
        raise CSVTextError(f"{path}: {reason}")
    columns = columns_of(f"{path}: line {reader.line_num}", [title.strip() for title in titles])
    order = np.argsort([column.place for column in columns])
    most = scaled_limit(MOST_LINES)
    rows: list[list[float]] = []
    for cells in filled:
        where = f"{path}: line {reader.line_num}"
        if reader.line_num > most:
            raise CSVTextError(f"{path}: it has more than {most} lines; {MORE}")
        if len(cells) != len(columns):
            raise CSVTextError(f"{where} has {len(cells)} cells; allowed is {len(columns)}, like the header")
        row = [_value(where, column, cell) for column, cell in zip(columns, cells, strict=True)]
        ordered = [row[k] for k in order]
        if rows and ordered[0] <= rows[-1][0]:
            raise CSVTextError(f"{where}: time is {ordered[0]!r} s; allowed is one after {rows[-1][0]!r} s")
        rows.append(ordered)
    if not rows:
        raise CSVTextError(f"{path}: no rows of numbers after the header")
    table = np.array(rows)
    return table[:, 0], table[:, 1:], [columns[k].place for k in order[1:]]


def _value(where: str, column: Column, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value) or value < column.low:
        raise CSVTextError(f"{where}: {column.title} is {cell.strip()!r}; allowed is {column.allowed}")
    return value * column.factor


def held_rows(path: str | Path, time: Times, dt: float) -> np.ndarray:
    """Return the index of the row held at the first time + i dt, up to the last. Raises `CSVTextError`."""
    length = float(time[-1]) - float(time[0])
    count = length / float(dt) + SAME_TIME
    most = scaled_limit(MOST_STEPS)
    if not count < most:
        raise CSVTextError(
            f"{path}: dt is {dt!r}; allowed is one of which the file's {length:g} s are at most {most}; "
            f"{MORE}"
        )
    at = time[0] + (np.arange(int(count) + 1) + SAME_TIME) * dt
    return np.searchsorted(time, at, side="right") - 1
