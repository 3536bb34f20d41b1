"""Reading of whole files, whose size is limited."""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path

from knode_cosserat._files.limits import MORE, excess, scaled_limit
from knode_cosserat.errors import KnodeCosseratError

#: bytes that are read at a time from a pipe, which states no size
_PIECE = 1 << 20


class ReadError(KnodeCosseratError, ValueError):
    """A file or text cannot be read; the message is one line with the reason, and names no file."""

    code = "read"


def require_limit(number: int, limit: int, unit: str) -> None:
    """Raise `ReadError` if a file has more of a unit than the limit allows."""
    if reason := excess(number, limit, unit):
        raise ReadError(reason)


def read_bytes(path: str | Path, limit: int) -> bytes:
    """Return the content of a file or pipe; `limit` is the largest number of bytes.

    Raises:
        ReadError: there is no such file, it cannot be read, or it is larger.
    """
    try:
        with open(path, "rb") as file:
            status = os.fstat(file.fileno())
            require_limit(status.st_size, limit, "bytes")
            if stat.S_ISREG(status.st_mode):
                return file.read()
            most, parts, size = scaled_limit(limit), [], 0
            while size <= most and (part := file.read(_PIECE)):
                parts.append(part)
                size += len(part)
    except FileNotFoundError:
        raise ReadError("no such file") from None
    except OSError as error:
        raise ReadError(f"cannot be read: {error.strerror}") from None
    if size > most:
        raise ReadError(f"it has more than {most} bytes; allowed are {most}; {MORE}")
    return b"".join(parts)


def read_text(path: str | Path, limit: int, encoding: str = "utf-8") -> str:
    """Return the text of a file; `limit` is the largest number of bytes. Raises `ReadError`."""
    try:
        return read_bytes(path, limit).decode(encoding)
    except UnicodeDecodeError:
        raise ReadError("it is not UTF-8 text") from None


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal; of a folder, of its files in order of their names.

    It is empty for what can be read once only, such as a pipe.
    """
    digest, path = hashlib.sha256(), Path(path)
    files = sorted(it for it in path.rglob("*") if it.is_file()) if path.is_dir() else [path]
    if not all(it.is_file() for it in files):
        return ""
    for one in files:
        with one.open("rb") as file:
            while part := file.read(1 << 20):
                digest.update(part)
    return digest.hexdigest()
