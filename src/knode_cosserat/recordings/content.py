"""Content of a recording's file: its beginning, its bytes, and compressed parts, within limits."""

from __future__ import annotations

import bz2
import gzip
import io
import zlib
from pathlib import Path
from typing import Any

from knode_cosserat._files import csv_rows
from knode_cosserat._files.limits import MORE, scaled_limit
from knode_cosserat._files.reading import read_bytes, require_limit
from knode_cosserat.recordings.findings import RecordingError

GZIP_MAGIC = b"\x1f\x8b"
#: largest file of a bag (bytes), also when decompressed: ten bodies at 120 Hz make 0.4 GB in an hour
LARGEST_BAG = 4 << 30
#: bytes that a format is recognised by
HEAD = 4096
#: largest decompressed size of one compressed part (bytes): a larger stated size is more likely an error
LARGEST_CHUNK = 1 << 30
#: most bytes that all compressed parts of a file may have together: so many times the file, and these
#: besides. Recorded messages become 2 to 20 times smaller
RATIO, ALLOWANCE = 200, 1 << 24
#: damage of a file whose parts expand beyond a limit
EXPANDED = "its chunks expand beyond the limit for a file of this size"
#: compressed bytes passed to a library at a time, and bytes of output that it may allocate at a time
_PIECE, _OUTPUT = 1 << 14, 1 << 24


def beginning(path: Path) -> bytes:
    """Return the first bytes of a file, decompressed; empty for a folder. Raises `RecordingError`."""
    if path.is_dir():
        return b""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
    except FileNotFoundError:
        raise RecordingError("no such file") from None
    except OSError as error:
        raise RecordingError(f"cannot be read: {error.strerror}") from None
    if not head.startswith(GZIP_MAGIC):
        return head
    try:
        return zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(head, HEAD)
    except zlib.error as error:
        raise RecordingError(f"cannot be decompressed: {error}") from None


def file_bytes(path: Path, limit: int) -> bytes:
    """Return a file's content, decompressed; `limit` is of the bytes before and after decompression.

    Raises:
        ReadError: the file cannot be read, or is too large.
        RecordingError: it cannot be decompressed, or is then too large.
    """
    data = read_bytes(path, limit)
    if not data.startswith(GZIP_MAGIC):
        return data
    ratio, allowance = scaled_limit(RATIO), scaled_limit(ALLOWANCE)
    most = min(ratio * len(data) + allowance, scaled_limit(limit))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            content = file.read(most + 1)
    except EOFError:
        raise RecordingError("cannot be decompressed: the file was cut") from None
    except (OSError, zlib.error) as error:
        raise RecordingError(f"cannot be decompressed: {error}") from None
    if len(content) > most:
        words = f"{ratio} times the file and {allowance}" if most < scaled_limit(limit) else str(most)
        raise RecordingError(f"it has more than {most} bytes when decompressed; allowed are {words}; {MORE}")
    return content


def text_of(data: bytes, *, or_latin: bool = False) -> str:
    """Return the text of bytes in UTF-8, or with `or_latin` in the code page of Windows.

    Raises:
        ReadError: it has too many lines.
        RecordingError: it is not UTF-8.
    """
    require_limit(data.count(b"\n") + data.count(b"\r") - data.count(b"\r\n"), csv_rows.MOST_LINES, "lines")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        if or_latin:
            return data.decode("latin-1")
        raise RecordingError("not a recording: no bag, and no CSV text: it is not UTF-8") from None


def lines_of(text: str) -> list[str]:
    """Return the lines of a text."""
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


class Decompression:
    """Decompression of a file's parts, whose sizes are limited together.

    Args:
        size: size of the file (bytes).
    """

    def __init__(self, size: int) -> None:
        self._remaining = scaled_limit(RATIO) * size + scaled_limit(ALLOWANCE)
        #: true if a limit was reached: bytes may be missing
        self.is_limited = False

    def records(self, data: bytes | memoryview, compression: str, size: int = 0) -> bytes:
        """Return the decompressed bytes of a part, as far as they are readable and allowed.

        `data` may be followed by other bytes. `compression` is bz2, lz4 or zstd; of any other one nothing is
        readable. `size` is the decompressed size (bytes), zero if unknown. Raises `ImportError` without the
        library.
        """
        limit = min(scaled_limit(LARGEST_CHUNK), self._remaining)
        most = min(size or limit, limit)
        decompressor, parts, count = _decompressor(compression), list[bytes](), 0
        # in pieces, so that the data before a damaged byte are recovered
        for begin in range(0, len(data) if decompressor else 0, _PIECE):
            piece = bytes(data[begin : begin + _PIECE])
            try:
                while count < most and not decompressor.eof:
                    # a library may allocate all bytes that it is asked for
                    wanted = min(most - count, _OUTPUT)
                    part = decompressor.decompress(piece, wanted)
                    parts.append(part)
                    count += len(part)
                    if len(part) < wanted:
                        break
                    piece = b""
            # each of the three libraries has its own errors
            except Exception:
                break
        self._remaining -= count
        self.is_limited |= count >= limit != size
        return b"".join(parts)


def _decompressor(compression: str) -> Any:
    """Return a new decompressor of a library; None for an unknown compression."""
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    if compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        return lz4.frame.LZ4FrameDecompressor()
    if compression == "zstd":
        try:
            from compression import zstd  # type: ignore[import-not-found, unused-ignore]
        except ImportError:
            from backports import zstd  # type: ignore[no-redef, import-not-found, import-untyped, unused-ignore]
        return zstd.ZstdDecompressor()
    return None
