"""Parquet files, whose limits are checked before anything is decompressed.

A few bytes may stand for a billion rows (runs of one value), and a page of a few kilobytes may be expanded to
gigabytes. Rows, columns and the expanded sizes are therefore read first, from the file's metadata.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from knode_cosserat._files.limits import MORE, scaled_limit
from knode_cosserat._files.reading import ReadError, require_limit
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
        require_limit(size, LARGEST_FILE, "bytes")
        # not memory-mapped: a file that is cut off while it is read would end the process
        with pyarrow.parquet.ParquetFile(
            path,
            memory_map=False,
            thrift_string_size_limit=min(scaled_limit(LONGEST_TEXT), _INT32),
            thrift_container_size_limit=min(scaled_limit(MOST_ENTRIES), _INT32),
            **options,
        ) as file:
            require_limit(file.metadata.num_columns, MOST_COLUMNS, "columns")
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
    require_limit(rows, MOST_ROWS, "rows")
    chunks = [group.column(k) for group in groups for k in range(metadata.num_columns)]
    # a list has several values in a row
    values = max(rows * metadata.num_columns, sum(chunk.num_values for chunk in chunks))
    most, words = expansion_limit(path)
    _require(8 * values <= most, f"its columns have {8 * values} bytes; {words}")
    expanded = sum(chunk.total_uncompressed_size for chunk in chunks)
    _require(expanded <= most, f"its pages expand to {expanded} bytes; {words}")


def expansion_limit(path: Path) -> tuple[int, str]:
    """Return the largest expanded size of a file (bytes), and the limit as text."""
    ratio, allowance = scaled_limit(RATIO), scaled_limit(ALLOWANCE)
    words = f"allowed are {ratio} times the file and {allowance}; {MORE}"
    return ratio * path.stat().st_size + allowance, words


def _require(fair: bool, what: str) -> None:
    if not fair:
        raise ReadError(what)
