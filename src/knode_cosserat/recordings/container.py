"""Raw messages of a bag's file by topic, before they are decoded."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from knode_cosserat._files.limits import allowed


@dataclasses.dataclass
class Topic:
    """Raw messages of one topic."""

    name: str
    #: message type as ROS 2 writes it: geometry_msgs/msg/PoseStamped
    type: str
    #: hash of the type's definition (ROS 1); empty if unknown
    digest: str = ""
    #: recording time of each message (ns)
    received: list[int] = dataclasses.field(default_factory=list)
    raw: list[bytes | memoryview] = dataclasses.field(default_factory=list)
    #: decoded messages that several sources are read from; None before the first use
    messages: list[Any] | None = None


@dataclasses.dataclass
class Container:
    """Topics of a bag, and the number of bytes that could not be read."""

    #: ROS version of the serialisation: 1 or 2
    ros: int
    topics: dict[str, Topic] = dataclasses.field(default_factory=dict)
    #: number of bytes that could not be read
    lost: int = 0
    #: description of the damage to the file; empty: none
    damage: str = ""
    #: true if its chunks expand beyond a limit, so that a part was not read
    is_limited: bool = False

    def topic(self, name: str, kind: str, digest: str = "") -> Topic | None:
        """Return the topic of that name, created if new; None if it exists with another type."""
        kind = kind if kind.count("/") != 1 else kind.replace("/", "/msg/")
        found = self.topics.setdefault(name, Topic(name, kind, digest))
        return found if found.type == kind else None


#: largest decompressed size of a chunk (bytes): a larger stated size is more likely an error
LARGEST_CHUNK = 1 << 30
#: bytes that are decompressed at a time, and bytes of output that are requested at a time
_PIECE, _OUTPUT = 1 << 14, 1 << 24
#: damage of a file whose chunks expand beyond a limit
EXPANDED = "its chunks expand beyond the limit for a file of this size"
#: most bytes that all chunks of a file may have together: so many times the file, and these besides.
#: Recorded messages become 2 to 20 times smaller
RATIO, ALLOWANCE = 200, 1 << 24


class Decompression:
    """Decompression of a file's chunks, whose sizes are limited together."""

    def __init__(self, size: int) -> None:
        """Start with the size of the file (bytes)."""
        self._remaining = allowed(RATIO) * size + allowed(ALLOWANCE)
        self._largest = allowed(LARGEST_CHUNK)
        #: true if a limit was reached: records may be missing
        self.is_limited = False

    def records(self, data: bytes | memoryview, compression: str, size: int) -> tuple[bytes, int]:
        """Return a chunk's records as `decompressed` does; fewer if a limit is reached.

        Args:
            data: compressed bytes; other bytes may follow them.
            compression: name of the compression.
            size: decompressed size (bytes); zero if unknown.
        """
        most = min(self._largest, self._remaining)
        if most <= 0:
            self.is_limited = True
            return b"", len(data)
        records, used = decompressed(data, compression, min(size or most, most))
        self._remaining -= len(records)
        self.is_limited |= len(records) == most != size
        return records, used


def decompressed(data: bytes | memoryview, compression: str, most: int) -> tuple[bytes, int]:
    """Return a chunk's records, as far as they are readable, and the number of compressed bytes used.

    Args:
        data: compressed bytes; other bytes may follow them.
        compression: name of the compression: bz2, lz4 or zstd.
        most: largest number of decompressed bytes that are returned.

    Raises:
        ImportError: the library for this compression is not installed.
    """
    decompressor = _decompressor(compression)
    parts: list[bytes] = []
    have = used = 0
    # in pieces, so that the data before a damaged byte are recovered
    while decompressor is not None and used < len(data) and have < most:
        piece = bytes(data[used : used + _PIECE])
        try:
            for part in _outputs(decompressor, piece, most - have):
                parts.append(part)
                have += len(part)
        # each of the three libraries has its own errors
        except Exception:
            break
        used += len(piece)
        if decompressor.eof:
            used -= len(decompressor.unused_data or b"")
            break
    return b"".join(parts), used


def _outputs(decompressor: Any, piece: bytes, most: int) -> Iterator[bytes]:
    """Yield a piece's output in parts: a library may allocate all bytes that it is asked for."""
    while most > 0:
        wanted = min(most, _OUTPUT)
        part = decompressor.decompress(piece, wanted)
        yield part
        if decompressor.eof or len(part) < wanted:
            return
        most -= len(part)
        piece = b""


def _decompressor(compression: str):  # type: ignore[no-untyped-def]
    if compression == "bz2":
        import bz2

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
