"""Incremental writer of ROS 1 bags (bag format 2.0): chunks are complete on the disk as they are written.

Between two chunks the file is a bag without an index, as `rosbag record` leaves it when it is killed:
`load_recording` reads it, `rosbag reindex` completes it.
"""

from __future__ import annotations

import dataclasses
import os
import struct
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from knode_cosserat.recordings.messages import typestore
from knode_cosserat.recordings.write import BagTopic

VERSION = b"#ROSBAG V2.0\n"
#: record types
MESSAGE, BAG, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
#: size of the bag's first record (bytes), which is written again at the end
FIRST_SIZE = 4096
_long = struct.Struct("<I").pack
_longer = struct.Struct("<Q").pack


class BagMessage(NamedTuple):
    """Encoded message with its recording time (ns since 1970)."""

    received: int
    topic: str
    data: bytes


@dataclasses.dataclass
class _Chunk:
    position: int
    start: int
    end: int
    counts: dict[int, int]


class BagStream:
    """ROS 1 bag that is written in chunks.

    Args:
        path: the file; it must not exist.
        topics: topics of the messages.

    Raises:
        OSError: the file exists or cannot be written.
        ImportError: rosbags is not installed.
    """

    def __init__(self, path: Path, topics: Iterable[BagTopic]):
        store = typestore(1)
        self.path = path
        self._numbers: dict[str, int] = {}
        records = []
        for topic in topics:
            number = self._numbers.setdefault(topic.name, len(self._numbers))
            definition, digest = store.generate_msgdef(topic.type)
            fields = {
                "topic": topic.name.encode(),
                "type": topic.type.replace("/msg/", "/").encode(),
                "md5sum": digest.encode(),
                "message_definition": definition.encode(),
            }
            header = {"conn": _long(number), "topic": topic.name.encode()}
            records.append(_record(CONNECTION, header, _fields(fields)))
        self._connections = b"".join(records)
        self._chunks: list[_Chunk] = []
        # unbuffered: a failed write leaves no bytes that a later flush would write
        self._file = path.open("xb", buffering=0)
        #: end of the last complete chunk (bytes)
        self._end = 0
        try:
            self._append(VERSION + self._first(0))
            self._sync()
        except OSError:
            self._file.close()
            path.unlink(missing_ok=True)
            raise

    @property
    def size(self) -> int:
        """Size of the complete part of the file (bytes)."""
        return self._end

    def write(self, messages: list[BagMessage]) -> None:
        """Write messages as one chunk, and wait until the disk has it.

        Raises:
            OSError: the disk is full, for example; the file ends with the last complete chunk.
        """
        if not messages:
            return
        # the connections are repeated in the first chunk only
        data, index = BytesIO(b"" if self._chunks else self._connections), dict[int, list[bytes]]()
        data.seek(0, os.SEEK_END)
        for message in messages:
            number = self._numbers[message.topic]
            stamp = _stamp(message.received)
            index.setdefault(number, []).append(stamp + _long(data.tell()))
            data.write(_record(MESSAGE, {"conn": _long(number), "time": stamp}, message.data))
        content = data.getvalue()
        header = {"compression": b"none", "size": _long(len(content))}
        parts = [_record(CHUNK, header, content)]
        for number, entries in index.items():
            header = {"ver": _long(1), "conn": _long(number), "count": _long(len(entries))}
            parts.append(_record(INDEX, header, b"".join(entries)))
        times = [message.received for message in messages]
        counts = {number: len(entries) for number, entries in index.items()}
        chunk = _Chunk(self._end, min(times), max(times), counts)
        self._append(b"".join(parts))
        self._chunks.append(chunk)
        self._sync()

    def finish(self) -> None:
        """Write the index at the file's end, and close it.

        Raises:
            OSError: the disk is full, for example; the file has no index then.
        """
        if self._file.closed:
            return
        try:
            position = self._end
            parts = [self._connections]
            for chunk in self._chunks:
                header = {
                    "ver": _long(1),
                    "chunk_pos": _longer(chunk.position),
                    "start_time": _stamp(chunk.start),
                    "end_time": _stamp(chunk.end),
                    "count": _long(len(chunk.counts)),
                }
                counts = b"".join(_long(number) + _long(count) for number, count in chunk.counts.items())
                parts.append(_record(CHUNK_INFO, header, counts))
            self._append(b"".join(parts))
            self._sync()
            self._file.seek(len(VERSION))
            self._file.write(self._first(position))
            self._sync()
        finally:
            self._file.close()

    def close(self) -> None:
        """Close the file without an index. Never raises."""
        self._file.close()

    def _first(self, index: int) -> bytes:
        header = {
            "index_pos": _longer(index),
            "conn_count": _long(len(self._numbers)),
            "chunk_count": _long(len(self._chunks)),
        }
        size = len(_record(BAG, header, b""))
        return _record(BAG, header, b" " * (FIRST_SIZE - size))

    def _append(self, data: bytes) -> None:
        """Write bytes at the end; after an error the file is cut to its former size."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError:
            self._file.truncate(self._end)
            self._file.seek(self._end)
            raise
        self._end += len(data)

    def _sync(self) -> None:
        os.fsync(self._file.fileno())


def _record(kind: int, header: dict[str, bytes], data: bytes) -> bytes:
    fields = _fields({"op": bytes([kind]), **header})
    return _long(len(fields)) + fields + _long(len(data)) + data


def _fields(values: dict[str, bytes]) -> bytes:
    return b"".join(
        _long(len(name) + 1 + len(value)) + name.encode() + b"=" + value for name, value in values.items()
    )


def _stamp(time: int) -> bytes:
    return struct.pack("<II", time // 10**9, time % 10**9)
