"""Cache of compiled programs on disk, with checksums.

JAX's own cache writes files in place and never replaces them: a file that a killed process left half written,
or that was damaged, is read in vain by every later process, which compiles the program again. Here a file is
written whole, and a damaged one is removed, so that the program is stored anew.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from knode_cosserat._files.writing import replacing

#: end of the names of files; JAX's own files have another
SUFFIX = "-program"


class ProgramCache:
    """Compiled programs in a folder, with the interface of JAX's cache: `get` and `put`.

    Args:
        path: the folder; created if it does not exist.

    Raises:
        OSError: the folder cannot be created.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._path.mkdir(parents=True, exist_ok=True)

    def path(self, key: str) -> Path:
        """Return the path of a program's file."""
        return self._path / f"{key}{SUFFIX}"

    def get(self, key: str) -> bytes | None:
        """Return a stored program; None if there is none, or a damaged one, which is removed."""
        try:
            content = self.path(key).read_bytes()
        except FileNotFoundError:
            return None
        size = hashlib.sha256().digest_size
        program, digest = content[:-size], content[-size:]
        if hashlib.sha256(program).digest() != digest:
            self.path(key).unlink(missing_ok=True)
            return None
        return program

    def put(self, key: str, value: bytes) -> None:
        """Store a program, whole or not at all. One that is already there is kept."""
        if not self.path(key).exists():
            with replacing(self.path(key)) as temporary:
                temporary.write_bytes(value + hashlib.sha256(value).digest())


def install(directory: Path) -> None:
    """Use this cache for a directory, in place of JAX's own; with a JAX that has other internals, do nothing.

    JAX has no public interface for caches of others.
    """
    try:
        from jax._src import compilation_cache

        original = compilation_cache.get_file_cache
    except (ImportError, AttributeError):
        return

    def get_file_cache(path):  # type: ignore[no-untyped-def]
        return (ProgramCache(path), path) if Path(path) == directory else original(path)

    compilation_cache.get_file_cache = get_file_cache
