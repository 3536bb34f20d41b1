"""Atomic writing of files, and the version of this package that writes them."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import os
import re
import secrets
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

#: age (s) from which a temporary file counts as abandoned
ABANDONED = 3600.0
_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{12}\.tmp")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; the file written there replaces `path` atomically.

    If anything fails, or the process is killed, the old file is unchanged. A symbolic link keeps its target,
    which is replaced. The new file has the permissions of the old one. What killed writes left behind in
    its folder is removed. A path that is not a regular file, such as a pipe, is written directly.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        yield path
        return
    path = Path(os.path.realpath(path))
    _remove_abandoned(path.parent)
    temporary = _temporary(path)
    try:
        yield temporary
        # synchronise before the rename, or a power failure could leave the name with an empty file
        with temporary.open("r+b") as file:
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder beside `path`, which is removed at the end; later writes remove it after a kill."""
    folder = _temporary(path)
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _temporary(path: Path) -> Path:
    return path.parent / f".{path.name}.{secrets.token_hex(6)}.tmp"


@functools.lru_cache(maxsize=1024)
def _remove_abandoned(folder: Path) -> None:
    """Remove temporary files and folders of killed writes into a folder; younger ones may be in use.

    Once in each process and folder: a study writes thousands of files into one.
    """
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            if _TEMPORARY.fullmatch(entry.name) and time.time() - entry.stat().st_mtime > ABANDONED:
                if entry.is_dir(follow_symlinks=False):
                    shutil.rmtree(entry.path, ignore_errors=True)
                else:
                    os.unlink(entry.path)


def package_version() -> str:
    """Return the installed version of this package."""
    try:
        return importlib.metadata.version("knode-cosserat")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"  # run from a checkout that is not installed
