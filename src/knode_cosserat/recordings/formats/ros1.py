"""Reader of ROS 1 bags (bag format 2.0), record by record, as far as they are readable.

The index at a bag's end is not used: a recorder that was killed has not written it. Records are read one
after the other, also those in uncompressed chunks. After an unreadable byte the next record is searched.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from typing import NamedTuple

from knode_cosserat._files.limits import MORE
from knode_cosserat.recordings import content
from knode_cosserat.recordings.container import EXPANDED, Container, Decompression
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.formats import RecordingFormat, register

MAGIC = b"#ROSBAG V"
VERSION = b"#ROSBAG V2.0\n"
#: record types
MESSAGE, BAG, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
KINDS = (MESSAGE, BAG, INDEX, CHUNK, CHUNK_INFO, CONNECTION)
#: start of the header field `op`, which every record has
_KIND_FIELD = b"\x04\x00\x00\x00op="
#: largest length of a header (bytes): a larger stated length is an error
_LONGEST_HEADER = 1 << 16
_length = struct.Struct("<I").unpack_from
_stamp = struct.Struct("<II").unpack


class _Record(NamedTuple):
    kind: int
    fields: dict[bytes, bytes]
    #: start and expected end of its data
    begin: int
    end: int


def read_ros1(data: bytes, wanted: Collection[str], source: str) -> Container:
    """Return the messages of the wanted topics, and the names and types of all topics.

    Raises:
        RecordingError: the bag has another version, or nothing in it can be read.
    """
    if data.startswith(MAGIC) and not data.startswith(VERSION):
        version = data[len(MAGIC) :].split(b"\n", 1)[0][:20]
        raise RecordingError(
            f"{source}: a bag of version {version.decode('ascii', 'replace')!r}; allowed is 2.0"
        )
    bag = _Bag(data, wanted)
    begin = len(VERSION) if data.startswith(VERSION) else 0
    bag.scan(memoryview(data), begin)
    container = bag.gathered()
    if not container.topics:
        more = f"; {MORE}" if container.is_limited else ""
        raise RecordingError(f"{source}: no topic in this bag can be read; it has {len(data)} bytes{more}")
    return container


class _Bag:
    """Messages read so far, by connection; a connection's topic may be known only later."""

    def __init__(self, data: bytes, wanted: Collection[str]) -> None:
        self.size = len(data)
        self.wanted = wanted
        self.connections: dict[int, tuple[str, str, str]] = {}
        self.messages: dict[int, list[tuple[int, memoryview]]] = {}
        self.lost = 0
        self.index: int | None = None
        self._decompression = Decompression(len(data))

    def scan(self, view: memoryview, position: int, in_chunk: bool = False) -> None:
        data = view.obj
        assert isinstance(data, bytes)
        while position < len(data):
            record = _record(data, position)
            if record is None:
                following = _next_record(data, position + 1)
                self.lost += following - position
                position = following
                continue
            position = record.end
            if record.kind == MESSAGE:
                self._message(view, record)
            elif record.kind == CONNECTION:
                self._connection(view, record)
            elif record.kind == BAG and len(record.fields.get(b"index_pos", b"")) == 8:
                self.index = int.from_bytes(record.fields[b"index_pos"], "little")
            elif record.kind == CHUNK and in_chunk:  # in the format no chunk has chunks
                self.lost += record.end - record.begin
            elif record.kind == CHUNK:
                position = self._chunk(view, record)

    def _message(self, view: memoryview, record: _Record) -> None:
        connection, stamp = record.fields.get(b"conn", b""), record.fields.get(b"time", b"")
        if len(connection) != 4 or len(stamp) != 8:
            self.lost += record.end - record.begin
            return
        number = int.from_bytes(connection, "little")
        known = self.connections.get(number)
        if known is None or known[0] in self.wanted:
            seconds, nanoseconds = _stamp(stamp)
            message = seconds * 10**9 + nanoseconds, view[record.begin : record.end]
            self.messages.setdefault(number, []).append(message)

    def _connection(self, view: memoryview, record: _Record) -> None:
        number = record.fields.get(b"conn", b"")
        fields = _fields(bytes(view[record.begin : record.end]), 0, record.end - record.begin)
        if len(number) != 4 or fields is None or b"type" not in fields:
            return
        topic = record.fields.get(b"topic") or fields.get(b"topic", b"")
        texts = (
            part.decode("utf-8", "replace") for part in (topic, fields[b"type"], fields.get(b"md5sum", b""))
        )
        # keep the first readable one: the index repeats it
        self.connections.setdefault(int.from_bytes(number, "little"), tuple(texts))  # type: ignore[arg-type]

    def _chunk(self, view: memoryview, record: _Record) -> int:
        """Read a chunk and return the position of the next record."""
        compression = record.fields.get(b"compression", b"").decode("ascii", "replace")
        if compression == "none":
            # its records follow directly; its stated length is not trusted
            return record.begin
        # a recorder that was killed has not yet written how long its last chunk is
        known = record.begin < record.end <= len(view)
        packed = view[record.begin : record.end if known else len(view)]
        size = int.from_bytes(record.fields.get(b"size", b""), "little")
        records, used = self._decompression.records(packed, compression, size)
        if records:
            self.scan(memoryview(records), 0, in_chunk=True)
        if not records or len(records) < size:
            self.lost += max(size - len(records), 0) or used
        if known or used == len(packed):
            return record.begin + len(packed)
        return _next_record(view.obj, record.begin + used)  # type: ignore[arg-type]

    def gathered(self) -> Container:
        container = Container(ros=1, lost=self.lost, is_limited=self._decompression.is_limited)
        for number, (name, kind, digest) in self.connections.items():
            topic = container.topic(name, kind, digest)
            if topic is not None and name in self.wanted:
                for received, raw in self.messages.get(number, ()):
                    topic.received.append(received)
                    topic.raw.append(raw)
        if container.is_limited:
            container.damage = EXPANDED
        elif self.index == 0:
            container.damage = "the recorder was stopped before it had finished the file"
        elif self.index is not None and self.index > self.size:
            container.damage = "the file was cut"
        elif self.lost or self.index is None:
            container.damage = "the file is damaged"
        return container


def _record(data: bytes, position: int) -> _Record | None:
    """Return the record at a position, or None if there is none."""
    if position + 4 > len(data):
        return None
    (length,) = _length(data, position)
    begin = position + 4 + length
    if not 4 < length <= _LONGEST_HEADER or begin + 4 > len(data):
        return None
    fields = _fields(data, position + 4, begin)
    if fields is None:
        return None
    kind = fields.get(b"op", b"")
    if len(kind) != 1 or kind[0] not in KINDS:
        return None
    (size,) = _length(data, begin)
    end = begin + 4 + size
    # only a chunk may be read partly
    if end > len(data) and kind[0] != CHUNK:
        return None
    return _Record(kind[0], fields, begin + 4, end)


def _fields(data: bytes, position: int, end: int) -> dict[bytes, bytes] | None:
    """Return the named fields between `position` and `end`, or None if they do not fill these bytes."""
    fields: dict[bytes, bytes] = {}
    while position + 4 <= end:
        (length,) = _length(data, position)
        position += 4
        if length > end - position:
            return None
        name, equals, value = data[position : position + length].partition(b"=")
        if not equals:
            return None
        fields[name] = value
        position += length
    return fields if position == end else None


def _next_record(data: bytes, position: int) -> int:
    """Return the start of the next record from a position on; the end of the data if there is none."""
    mark = data.find(_KIND_FIELD, position)
    while mark >= 0:
        # an unknown number of fields may precede the type, but their lengths must fit
        for begin in range(max(position, mark - 80), mark - 3):
            (length,) = _length(data, begin)
            if mark - begin <= length <= 4096 and _record(data, begin) is not None:
                return begin
        mark = data.find(_KIND_FIELD, mark + 1)
    return len(data)


register(
    RecordingFormat(
        "ROS 1 bag",
        recognise=lambda head: head.startswith(MAGIC),
        read=lambda path, wanted: read_ros1(content.file_bytes(path, content.LARGEST_BAG), wanted, str(path)),
        suffixes=(".bag", ".bag.active"),
    )
)
