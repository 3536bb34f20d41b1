"""Writing files whole, and which version of this package writes them."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import secrets
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name beside `path` to write to. What is there in the end takes the place of `path` in one go.

    If anything fails, or the process is killed, the old file is still there as it was. A link goes on to lead
    to what it led to, and what is no file, such as a pipe or /dev/null, is written to as it is.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        yield path
        return
    path = Path(os.path.realpath(path))
    temporary = path.parent / f".{path.name}.{secrets.token_hex(6)}.tmp"
    try:
        yield temporary
        # on the disk before it has the name, or a power failure could leave the name with nothing behind it
        with temporary.open("r+b") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def package_version() -> str:
    """The version of this package that is installed."""
    try:
        return importlib.metadata.version("knode-cosserat")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"  # run from a checkout that is not installed
