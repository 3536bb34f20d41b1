"""Parquet files, whose limits are checked before anything is decompressed.

A few bytes may stand for a billion rows (runs of one value), and a page of a few kilobytes may be expanded to
gigabytes. Rows, columns and the pages' stated sizes are therefore read first, from the file's metadata and
from the header of each page; the decoder allocates what these state.
"""

from __future__ import annotations

import contextlib
import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from knode_cosserat._files.limits import MORE, allowed, excess
from knode_cosserat._files.reading import ReadError
from knode_cosserat.errors import KnodeCosseratError, first_line

#: limits of a file: bytes, columns, rows (5.5 h at 1 kHz)
LARGEST_FILE, MOST_COLUMNS, MOST_ROWS = 2 << 30, 1_000, 20_000_000
#: most bytes of the expanded columns, and of the expanded pages: so many times the file, and these besides.
#: Recordings with noise become 2 to 10 times smaller
RATIO, ALLOWANCE = 100, 100_000_000
#: most entries of a list, and characters of a text, in the file's metadata
MOST_ENTRIES, LONGEST_TEXT = 100_000, 10_000_000
#: largest limit that pyarrow takes for the metadata
_INT32 = 2**31 - 1
#: words of pyarrow about a text or a list in the metadata that exceeds its limit
TOO_LARGE = "Exceeded size limit"


@contextlib.contextmanager
def open_parquet(path: Path, **options: Any) -> Iterator[Any]:
    """Yield pyarrow's `ParquetFile` of a file whose size, columns and metadata are within the limits.

    Args:
        path: the file.
        **options: further ones of `ParquetFile`.

    Raises:
        ReadError: the file cannot be read, also by the body of the `with` statement, or a limit is exceeded.
        ImportError: pyarrow is not installed.
    """
    import pyarrow  # type: ignore[import-not-found, import-untyped, unused-ignore]
    import pyarrow.parquet  # type: ignore[import-not-found, import-untyped, unused-ignore]

    try:
        size = path.stat().st_size
        _require_limit(size, LARGEST_FILE, "bytes")
        # not memory-mapped: a file that is cut off while it is read would end the process
        with pyarrow.parquet.ParquetFile(
            path,
            memory_map=False,
            thrift_string_size_limit=min(allowed(LONGEST_TEXT), _INT32),
            thrift_container_size_limit=min(allowed(MOST_ENTRIES), _INT32),
            **options,
        ) as file:
            _require_limit(file.metadata.num_columns, MOST_COLUMNS, "columns")
            yield file
    except FileNotFoundError:
        raise ReadError("no such file") from None
    except KnodeCosseratError:
        raise
    except KeyError as error:
        name = error.args[0]
        text = name.decode(errors="replace") if isinstance(name, bytes) else str(name)
        raise ReadError(f"it has no column {text}") from None
    except (pyarrow.ArrowException, OSError, ValueError, IndexError) as error:
        more = f"; {MORE}" if TOO_LARGE in str(error) else ""
        raise ReadError(f"not a Parquet table: {first_line(error)}{more}") from None


def require_limited_expansion(metadata: Any, path: Path) -> None:
    """Raise `ReadError` if the expanded columns or pages exceed the limit."""
    groups = [metadata.row_group(k) for k in range(metadata.num_row_groups)]
    rows = max(metadata.num_rows, sum(group.num_rows for group in groups))
    _require_limit(rows, MOST_ROWS, "rows")
    chunks = [group.column(k) for group in groups for k in range(metadata.num_columns)]
    # a list has several values in a row
    values = max(rows * metadata.num_columns, sum(chunk.num_values for chunk in chunks))
    most, words = expansion_limit(path)
    _require(8 * values <= most, f"its columns have {8 * values} bytes; {words}")
    expanded = values = 0
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for chunk in chunks:
            for page in _pages(data, chunk):
                expanded += page.expanded
                values += page.values
                _require(expanded <= most, f"its pages expand to {expanded} bytes; {words}")
                _require(8 * values <= most, f"its pages have {values} values; {words}")


def expansion_limit(path: Path) -> tuple[int, str]:
    """Return the largest expanded size of a file (bytes), and the limit as text."""
    ratio, allowance = allowed(RATIO), allowed(ALLOWANCE)
    words = f"allowed are {ratio} times the file and {allowance}; {MORE}"
    return ratio * path.stat().st_size + allowance, words


def _require(fair: bool, what: str) -> None:
    if not fair:
        raise ReadError(what)


def _require_limit(number: int, limit: int, unit: str) -> None:
    reason = excess(number, limit, unit)
    _require(not reason, reason)


# headers of pages, in Thrift's compact protocol

_STOP, _TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = 0, 1, 2, 3, 7, 8, 9, 10, 11, 12
_INTEGERS = (4, 5, 6)
#: fields of a page's header: bytes after and before decompression
_EXPANDED, _COMPRESSED = 2, 3
#: fields for the kinds of pages (data, dictionary, data of version 2), and in these the number of values
_KINDS, _VALUES = (5, 7, 8), 1
#: deepest nesting of a header
_DEEPEST = 8


class _Page(NamedTuple):
    """Expanded size (bytes) of a page, and its number of values, from its header."""

    expanded: int
    values: int


def _pages(data: Any, chunk: Any) -> Iterator[_Page]:
    """Yield sizes from the header of each page of a column.

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
        kinds = (header.parts[k] for k in _KINDS if k in header.parts)
        yield _Page(expanded, max((each.get(_VALUES, 0) for each in kinds), default=0))
        begin = header.at + compressed


class _Header:
    """Reader of a Thrift struct: its integers, and where it ends."""

    def __init__(self, data: Any, at: int):
        self._data, self.at = data, at
        #: integer fields of the structs in this one, by their numbers
        self.parts: dict[int, dict[int, int]] = {}

    def integers(self, depth: int = 0) -> dict[int, int]:
        """Return the integer fields by number, and move to the struct's end."""
        found: dict[int, int] = {}
        for number, kind in self._fields():
            if kind in _INTEGERS:
                found[number] = self._integer()
            elif kind == _STRUCT and depth == 0:
                self.parts[number] = self.integers(1)
            else:
                self._skip(kind, depth)
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
