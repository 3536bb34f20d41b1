"""Content of a recording's file: its beginning, and all of its bytes, decompressed, within limits."""

from __future__ import annotations

import gzip
import io
import zlib
from pathlib import Path

from knode_cosserat._files.limits import MORE, allowed
from knode_cosserat._files.reading import ReadError, read_bytes
from knode_cosserat.recordings.container import ALLOWANCE, RATIO
from knode_cosserat.recordings.findings import RecordingError

GZIP_MAGIC = b"\x1f\x8b"
#: largest file of a bag (bytes), also when decompressed: ten bodies at 120 Hz make 0.4 GB in an hour
LARGEST_BAG = 4 << 30
#: bytes that a format is recognised by
HEAD = 4096
#: bytes that are decompressed at a time
_PIECE = 1 << 20


def beginning(path: Path) -> bytes:
    """Return the first bytes of a file, decompressed; empty for a folder. Raises `RecordingError`."""
    if path.is_dir():
        return b""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    if not head.startswith(GZIP_MAGIC):
        return head
    try:
        return zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(head, HEAD)
    except zlib.error as error:
        raise RecordingError(f"{path}: cannot be decompressed: {error}") from None


def file_bytes(path: Path, limit: int) -> bytes:
    """Return a file's content, decompressed; `limit` is of the bytes before and after decompression.

    Raises:
        RecordingError: the file cannot be read, or is too large.
    """
    try:
        data = read_bytes(path, limit)
        return _gunzipped(data, path, limit) if data.startswith(GZIP_MAGIC) else data
    except ReadError as error:
        raise RecordingError(f"{path}: {error}") from None
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise RecordingError(f"{path}: cannot be decompressed: {error}") from None


def _gunzipped(data: bytes, path: Path, limit: int) -> bytes:
    ratio, allowance = allowed(RATIO), allowed(ALLOWANCE)
    most, words = ratio * len(data) + allowance, f"{ratio} times the file and {allowance}"
    if allowed(limit) < most:
        most = allowed(limit)
        words = str(most)
    parts, size = [], 0
    with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
        # in pieces, because all bytes that are asked for would be allocated
        while size <= most and (part := file.read(_PIECE)):
            parts.append(part)
            size += len(part)
    if size > most:
        raise RecordingError(
            f"{path}: it has more than {most} bytes when decompressed; allowed are {words}; {MORE}"
        )
    return b"".join(parts)
