"""Recordings in Parquet files: columns of numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd  # type: ignore[import-untyped]

from knode_cosserat._files import parquet_file
from knode_cosserat._files.reading import ReadError
from knode_cosserat._files.yaml_text import shown
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.formats import RecordingFormat, register
from knode_cosserat.recordings.table import Table, numbers_of

MAGIC = b"PAR1"
_NUMBERS = ("BOOLEAN", "INT32", "INT64", "FLOAT", "DOUBLE")
_PLAIN = ("NONE", "INT", "NULL", "UNKNOWN", "UNDEFINED")


def read_parquet(path: Path) -> Table:
    """Return a Parquet file's metadata and its columns of numbers.

    Raises:
        RecordingError: the file cannot be read, a column has no numbers, or a limit is exceeded.
        ImportError: pyarrow is not installed.
    """
    pyarrow = _pyarrow()
    try:
        with parquet_file.open_parquet(path) as file:
            for k in range(file.metadata.num_columns):
                _check_column(file.metadata.schema.column(k), path)
            parquet_file.require_limited_expansion(file.metadata, path)
            table = file.read()
            said = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
    except ReadError as error:
        raise RecordingError(f"{path}: {error}") from None
    for field in table.schema:
        _check_type(pyarrow, field, path)
    frame = pd.DataFrame({name: table.column(i).to_numpy() for i, name in enumerate(table.column_names)})
    _require(len(frame) > 0, path, "no rows")
    return Table(said, numbers_of(frame))


def write_parquet(path: Path, table: pd.DataFrame, said: Mapping[str, str]) -> None:
    """Write columns and metadata as Parquet. Raises `ImportError` if pyarrow is not installed."""
    pyarrow = _pyarrow()
    written = pyarrow.Table.from_pandas(table, preserve_index=False)
    pyarrow.parquet.write_table(written.replace_schema_metadata(dict(said)), path)


def _pyarrow() -> Any:
    try:
        import pyarrow  # type: ignore[import-not-found, import-untyped, unused-ignore]
        import pyarrow.parquet  # type: ignore[import-not-found, import-untyped, unused-ignore]
    except ImportError:
        raise ImportError("Parquet files need pyarrow: pip install 'knode-cosserat[parquet]'") from None
    return pyarrow


def _require(fair: bool, path: Path, what: str) -> None:
    if not fair:
        raise RecordingError(f"{path}: {what}")


def _check_column(column: Any, path: Path) -> None:
    """Raise `RecordingError` if a column has no plain numbers."""
    flat = column.max_repetition_level == 0 and column.path == column.name
    numbers = column.physical_type in _NUMBERS and column.logical_type.type in _PLAIN
    kind = column.logical_type.type if column.logical_type.type not in _PLAIN else column.physical_type
    what = f"the column {shown(column.path)} has {kind.lower() if flat else 'lists'}; allowed are numbers"
    _require(flat and numbers, path, what)


def _check_type(pyarrow: Any, field: Any, path: Path) -> None:
    kind, types = field.type, pyarrow.types
    numbers = (types.is_integer, types.is_floating, types.is_boolean, types.is_null)
    what = f"the column {shown(field.name)} has {kind}; allowed are numbers"
    _require(any(is_kind(kind) for is_kind in numbers), path, what)


register(
    RecordingFormat(
        "Parquet table",
        recognise=lambda head: head.startswith(MAGIC),
        read=lambda path, wanted: read_parquet(path),
    )
)
