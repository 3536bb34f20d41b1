"""Recordings in Parquet files: limits that are checked before anything is decompressed, then the columns.

A few bytes may stand for a billion rows (runs of one value), and a page of a few kilobytes may be expanded to
gigabytes. Rows, columns and the pages' stated sizes are therefore read first, from the file's metadata and
from the header of each page; the decoder allocates what these state.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas as pd  # type: ignore[import-untyped]

from knode_cosserat._limits import MORE, LimitSettingError, allowed, excess
from knode_cosserat._yaml import shown
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.table import Table, numbers_of

MAGIC = b"PAR1"
#: limits of a file: bytes, columns, rows (5.5 h at 1 kHz)
LARGEST_FILE, MOST_COLUMNS, MOST_ROWS = 2 << 30, 1_000, 20_000_000
#: most bytes of the expanded columns, and of the expanded pages: so many times the file, and these besides.
#: Recordings with noise become 2 to 10 times smaller
RATIO, ALLOWANCE = 100, 100_000_000
#: most entries of a list, and characters of a text, in the file's metadata
MOST_ENTRIES, LONGEST_TEXT = 100_000, 10_000_000
_NUMBERS = ("BOOLEAN", "INT32", "INT64", "FLOAT", "DOUBLE")
_PLAIN = ("NONE", "INT", "NULL", "UNKNOWN", "UNDEFINED")
#: largest limit that pyarrow takes for the metadata
_INT32 = 2**31 - 1
#: words of pyarrow about a text or a list in the metadata that exceeds its limit
TOO_LARGE = "Exceeded size limit"


def read_parquet(path: Path) -> Table:
    """Return a Parquet file's metadata and its columns of numbers.

    Raises:
        RecordingError: the file cannot be read, a column has no numbers, or a limit is exceeded.
        ImportError: pyarrow is not installed.
    """
    pyarrow = _pyarrow()
    try:
        size = path.stat().st_size
        _require_limit(size, LARGEST_FILE, "bytes", path)
        with pyarrow.parquet.ParquetFile(
            path,
            memory_map=False,
            thrift_string_size_limit=min(allowed(LONGEST_TEXT), _INT32),
            thrift_container_size_limit=min(allowed(MOST_ENTRIES), _INT32),
        ) as file:
            _check_limits(file.metadata, path, size)
            table = file.read()
        said = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
        for field in table.schema:
            _check_type(pyarrow, field, path)
        frame = pd.DataFrame({name: table.column(i).to_numpy() for i, name in enumerate(table.column_names)})
    except (RecordingError, LimitSettingError):
        raise
    except (pyarrow.ArrowException, OSError, ValueError, IndexError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        more = f"; {MORE}" if TOO_LARGE in reason else ""
        raise RecordingError(f"{path}: not a Parquet table: {reason}{more}") from None
    _require(len(frame) > 0, path, "no rows")
    return Table(said, numbers_of(frame, str(path)))


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


def _require_limit(number: int, limit: int, unit: str, path: Path) -> None:
    reason = excess(number, limit, unit)
    _require(not reason, path, reason)


def _check_limits(metadata: Any, path: Path, size: int) -> None:
    """Raise `RecordingError` if the columns are no plain numbers, or what they expand to is too large."""
    columns, groups = metadata.num_columns, [metadata.row_group(k) for k in range(metadata.num_row_groups)]
    _require_limit(columns, MOST_COLUMNS, "columns", path)
    for k in range(columns):
        column = metadata.schema.column(k)
        flat = column.max_repetition_level == 0 and column.path == column.name
        numbers = column.physical_type in _NUMBERS and column.logical_type.type in _PLAIN
        kind = column.logical_type.type if column.logical_type.type not in _PLAIN else column.physical_type
        what = f"the column {shown(column.path)} has {kind.lower() if flat else 'lists'}; allowed are numbers"
        _require(flat and numbers, path, what)
    rows = max(metadata.num_rows, sum(group.num_rows for group in groups))
    _require_limit(rows, MOST_ROWS, "rows", path)
    ratio, allowance = allowed(RATIO), allowed(ALLOWANCE)
    most, words = ratio * size + allowance, f"allowed are {ratio} times the file and {allowance}; {MORE}"
    _require(8 * rows * columns <= most, path, f"its columns have {8 * rows * columns} bytes; {words}")
    expanded = 0
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for group in groups:
            for k in range(columns):
                for page in _page_sizes(data, group.column(k)):
                    expanded += page
                    _require(expanded <= most, path, f"its pages expand to {expanded} bytes; {words}")


def _check_type(pyarrow: Any, field: Any, path: Path) -> None:
    kind, types = field.type, pyarrow.types
    numbers = (types.is_integer, types.is_floating, types.is_boolean, types.is_null)
    what = f"the column {shown(field.name)} has {kind}; allowed are numbers"
    _require(any(is_kind(kind) for is_kind in numbers), path, what)


# headers of pages, in Thrift's compact protocol

_STOP, _TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = 0, 1, 2, 3, 7, 8, 9, 10, 11, 12
_INTEGERS = (4, 5, 6)
#: fields of a page's header: bytes after and before decompression
_EXPANDED, _COMPRESSED = 2, 3
#: deepest nesting of a header
_DEEPEST = 8


def _page_sizes(data: Any, chunk: Any) -> Iterator[int]:
    """Yield the expanded size (bytes) that the header of each page of a column states.

    Raises:
        ValueError: a header cannot be read.
    """
    begin = chunk.data_page_offset
    if chunk.has_dictionary_page and 0 < (chunk.dictionary_page_offset or 0) < begin:
        begin = chunk.dictionary_page_offset
    end = begin + chunk.total_compressed_size
    if not 0 <= begin <= end <= len(data):
        raise ValueError("a column lies outside the file")
    while begin < end:
        header = _Header(data, begin)
        fields = header.integers()
        expanded, compressed = fields.get(_EXPANDED, -1), fields.get(_COMPRESSED, -1)
        if expanded < 0 or compressed < 0:
            raise ValueError("a page has no size")
        yield expanded
        begin = header.at + compressed


class _Header:
    """Reader of a Thrift struct: its integers, and where it ends."""

    def __init__(self, data: Any, at: int):
        self._data, self.at = data, at

    def integers(self) -> dict[int, int]:
        """Return the integer fields by number, and move to the struct's end."""
        found: dict[int, int] = {}
        for number, kind in self._fields():
            if kind in _INTEGERS:
                found[number] = self._integer()
            else:
                self._skip(kind, 0)
        return found

    def _fields(self) -> Iterator[tuple[int, int]]:
        number = 0
        while (head := self._byte()) & 0x0F != _STOP:
            step = head >> 4
            number = number + step if step else self._integer()
            yield number, head & 0x0F

    def _skip(self, kind: int, depth: int) -> None:
        if depth > _DEEPEST:
            raise ValueError("a page's header is nested too deeply")
        if kind in _INTEGERS:
            self._varint()
        elif kind in (_BYTE, _DOUBLE):
            self.at += 1 if kind == _BYTE else 8
        elif kind == _BINARY:
            length = self._varint()
            self.at += length
        elif kind in (_LIST, _SET):
            head = self._byte()
            count = self._varint() if head >> 4 == 15 else head >> 4
            self._skip_many([head & 0x0F], count, depth)
        elif kind == _MAP:
            count = self._varint()
            head = self._byte() if count else 0
            self._skip_many([head >> 4, head & 0x0F], count, depth)
        elif kind == _STRUCT:
            for _, inner in self._fields():
                self._skip(inner, depth + 1)
        elif kind not in (_TRUE, _FALSE):
            raise ValueError("a page's header is damaged")

    def _skip_many(self, kinds: list[int], count: int, depth: int) -> None:
        if count > allowed(MOST_ENTRIES):
            raise ValueError(f"a page's header has {count} entries; {MORE}")
        for _ in range(count):
            for kind in kinds:
                # a boolean in a list has a byte; as a field it has none
                self._skip(_BYTE if kind in (_TRUE, _FALSE) else kind, depth + 1)

    def _byte(self) -> int:
        if not 0 <= self.at < len(self._data):
            raise ValueError("a page's header is cut")
        self.at += 1
        return int(self._data[self.at - 1])

    def _varint(self) -> int:
        value = shift = 0
        while True:
            byte = self._byte()
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
            shift += 7
            if shift > 63:
                raise ValueError("a page's header is damaged")

    def _integer(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)
