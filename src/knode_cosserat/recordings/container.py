"""What a bag's file holds before anybody asks what it means: raw messages by topic."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass
class Topic:
    """Messages of one topic as they were recorded."""

    name: str
    #: as ROS 2 writes it: geometry_msgs/msg/PoseStamped
    type: str
    #: the hash of the type's definition, of ROS 1; empty if unknown
    digest: str = ""
    #: when each message was recorded (ns)
    received: list[int] = dataclasses.field(default_factory=list)
    raw: list[bytes | memoryview] = dataclasses.field(default_factory=list)


@dataclasses.dataclass
class Container:
    """The topics of a bag, and how much of its file could not be read."""

    #: 1 or 2: how messages are written
    ros: int
    topics: dict[str, Topic] = dataclasses.field(default_factory=dict)
    #: how many bytes could not be read
    lost: int = 0
    #: what of the file is not as a recorder that was closed leaves it; empty: nothing
    damage: str = ""

    def topic(self, name: str, kind: str, digest: str = "") -> Topic | None:
        """The topic of that name, made if it is new; None if it is there with another type."""
        kind = kind if kind.count("/") != 1 else kind.replace("/", "/msg/")
        found = self.topics.setdefault(name, Topic(name, kind, digest))
        return found if found.type == kind else None


#: no chunk that is larger than this is taken apart (bytes): its size is more likely an error than true
LARGEST_CHUNK = 1 << 30
_PIECE = 1 << 14


def decompressed(data: bytes | memoryview, compression: str, size: int) -> tuple[bytes, int]:
    """A chunk's records, or as many as can be had if it is cut or damaged; and how many bytes they were.

    Args:
        data: what is packed; more may follow it.
        compression: how.
        size: of the records; zero if it is not known.

    Raises:
        ImportError: the library for this compression is not installed.
    """
    size = min(size or LARGEST_CHUNK, LARGEST_CHUNK)
    decompressor = _decompressor(compression)
    parts: list[bytes] = []
    have = used = 0
    # in pieces: what is before the damage then comes out
    while decompressor is not None and used < len(data) and have < size:
        piece = bytes(data[used : used + _PIECE])
        try:
            parts.append(decompressor.decompress(piece, size - have))
        # each of the three libraries has its own errors
        except Exception:
            break
        have += len(parts[-1])
        used += len(piece)
        if decompressor.eof:
            used -= len(decompressor.unused_data or b"")
            break
    return b"".join(parts), used


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
