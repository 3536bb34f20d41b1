"""Recordings in Parquet files: columns of numbers, and metadata in the schema."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from knode_cosserat._files import parquet_file
from knode_cosserat._files.writing import replacing
from knode_cosserat._files.yaml_text import excerpt
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.formats import RecordingFormat, register
from knode_cosserat.recordings.streams import Outgoing
from knode_cosserat.recordings.table import Table, columns_and_metadata, numbers_of

MAGIC = b"PAR1"
_NUMBERS = ("BOOLEAN", "INT32", "INT64", "FLOAT", "DOUBLE")
_PLAIN = ("NONE", "INT", "NULL", "UNKNOWN", "UNDEFINED")


def read_parquet(path: Path) -> Table:
    """Return a Parquet file's metadata and its columns of numbers.

    Raises:
        ReadError: the file cannot be read, or a limit is exceeded.
        RecordingError: a column has no numbers.
        ImportError: pyarrow is not installed.
    """
    types = _pyarrow().types
    import pandas as pd  # type: ignore[import-untyped]

    with parquet_file.open_parquet(path) as file:
        for k in range(file.metadata.num_columns):
            column = file.metadata.schema.column(k)
            flat = column.max_repetition_level == 0 and column.path == column.name
            logical = column.logical_type.type
            if not flat or column.physical_type not in _NUMBERS or logical not in _PLAIN:
                kind = (column.physical_type if logical in _PLAIN else logical).lower()
                raise RecordingError(
                    f"the column {excerpt(column.path)} has {kind if flat else 'lists'}; allowed are numbers"
                )
        parquet_file.require_limited_expansion(file.metadata, path)
        table = file.read()
        metadata = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
    numbers = (types.is_integer, types.is_floating, types.is_boolean, types.is_null)
    for field in table.schema:
        if not any(is_kind(field.type) for is_kind in numbers):
            raise RecordingError(f"the column {excerpt(field.name)} has {field.type}; allowed are numbers")
    frame = pd.DataFrame({name: table.column(k).to_numpy() for k, name in enumerate(table.column_names)})
    if frame.empty:
        raise RecordingError("no rows")
    return Table(metadata, numbers_of(frame))


def write_parquet(path: Path, outgoing: Outgoing) -> None:
    """Write a recording as a Parquet file. Raises `ImportError` if pyarrow is not installed."""
    pyarrow = _pyarrow()
    table, metadata = columns_and_metadata(outgoing)
    columns = pyarrow.Table.from_pandas(table, preserve_index=False).replace_schema_metadata(metadata)
    with replacing(path) as temporary:
        pyarrow.parquet.write_table(columns, temporary)


def _pyarrow() -> Any:
    try:
        import pyarrow  # type: ignore[import-not-found, import-untyped, unused-ignore]
        import pyarrow.parquet  # type: ignore[import-not-found, import-untyped, unused-ignore]
    except ImportError:
        raise ImportError("Parquet files need pyarrow: pip install 'knode-cosserat[parquet]'") from None
    return pyarrow


register(
    RecordingFormat(
        "Parquet table",
        recognise=lambda head: head.startswith(MAGIC),
        read=lambda path, wanted: read_parquet(path),
        suffixes=(".parquet",),
        write=write_parquet,
        written=(".parquet",),
    )
)
