"""Formats of recordings: a module of this package defines one, and registers it.

    register(RecordingFormat("Motive CSV", recognise=…, read=…))

A module that is added to this package is found by itself; other programs call `register`. The content of a
file decides its format. The name decides only if the first bytes are damaged. Lists of formats, in the help
of commands and in errors, come from here, so these modules import slow libraries only in their functions.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from knode_cosserat.recordings.content import beginning
from knode_cosserat.recordings.table import Table

if TYPE_CHECKING:
    from knode_cosserat.recordings.messages import Bag
    from knode_cosserat.recordings.streams import Outgoing

__all__ = [
    "RecordingFormat",
    "Table",
    "format_of",
    "formats",
    "read_suffixes",
    "register",
    "written_suffixes",
]


class RecordingFormat(NamedTuple):
    """Format of recordings.

    Attributes:
        name: name in messages.
        recognise: True for the first bytes (up to 4096, decompressed) of a file of this format.
        read: function from the path and the wanted topics to the messages of a bag, or to a table. Tables
            have all columns. Raises `RecordingError`.
        suffixes: ends of names, for lists; they stand for the format if the first bytes are damaged.
        write: function that writes a recording to a path; None: the format is only read.
        written: ends of names that are written in this format.
        is_folder: True if the recording is a folder.
        is_fallback: True if any other file is of this format.
    """

    name: str
    recognise: Callable[[bytes], bool]
    read: Callable[[Path, Collection[str]], Bag | Table]
    suffixes: tuple[str, ...] = ()
    write: Callable[[Path, Outgoing], None] | None = None
    written: tuple[str, ...] = ()
    is_folder: bool = False
    is_fallback: bool = False


_registered: list[RecordingFormat] = []


def register(kind: RecordingFormat) -> None:
    """Add a format."""
    _registered.append(kind)


@functools.cache
def _import_modules() -> None:
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")


def formats() -> tuple[RecordingFormat, ...]:
    """Return all formats, after an import of the modules that define them."""
    _import_modules()
    return tuple(sorted(_registered, key=lambda kind: (kind.is_fallback, not kind.suffixes, kind.suffixes)))


def read_suffixes() -> tuple[str, ...]:
    """Return the ends of names of all formats."""
    return tuple(suffix for kind in formats() for suffix in kind.suffixes)


def written_suffixes() -> tuple[str, ...]:
    """Return the ends of names that can be written."""
    return tuple(suffix for kind in formats() for suffix in kind.written)


def format_of(path: Path) -> RecordingFormat:
    """Return the format of a file or folder. Raises `RecordingError` if it cannot be read."""
    head = beginning(path)
    if path.is_dir():
        return next(kind for kind in formats() if kind.is_folder)
    by_content = [kind for kind in formats() if not kind.is_fallback and kind.recognise(head)]
    by_name = [kind for kind in formats() if kind.suffixes and path.name.lower().endswith(kind.suffixes)]
    return next(iter([*by_content, *by_name, *(kind for kind in formats() if kind.is_fallback)]))
