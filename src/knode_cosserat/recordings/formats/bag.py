"""Bags of ROS 1 (.bag, .bag.active) and ROS 2 (.mcap, .db3, folders): raw messages by topic.

rosbags decodes the messages (`messages`) and writes bags. Its readers require an index at the end of
the file, which a recorder that was killed has not written, and decompress without a limit. So records are
read here one after the other, up to the end or the first damage, with rosbags' functions for one record.
Messages, and whole files, of ROS 2 may be compressed by zstd (rosbag2's `compression_mode`): compressed
messages are recognised by their first bytes, which no encoded message has.
"""

from __future__ import annotations

import dataclasses
import heapq
import io
import sqlite3
import struct
import urllib.parse
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from knode_cosserat._files.limits import MORE
from knode_cosserat._files.reading import require_limit
from knode_cosserat._files.writing import replacing, temporary_folder
from knode_cosserat.recordings import content
from knode_cosserat.recordings.content import EXPANDED, Decompression
from knode_cosserat.recordings.findings import RecordingError, naming
from knode_cosserat.recordings.formats import RecordingFormat, register
from knode_cosserat.recordings.messages import Bag, Topic, encoder_of, message_type, typestore
from knode_cosserat.recordings.streams import Outgoing, OutgoingStream

ROS1_MAGIC, ROS1_VERSION = b"#ROSBAG V", b"#ROSBAG V2.0\n"
MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\x00"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
#: record types of ROS 1
_MESSAGE, _HEADER, _CHUNK, _CONNECTION = 0x02, 0x03, 0x05, 0x07
#: start of the header field `op`, which every record has
_KIND_FIELD = b"\x04\x00\x00\x00op="
#: record types of MCAP
_MCAP_SCHEMA, _MCAP_CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK, _MCAP_END = 0x03, 0x04, 0x05, 0x06, 0x0F
#: storage files of a bag's folder, and the end of their names when compressed as a whole
_STORAGE, _PACKED = (".mcap", ".db3"), ".zstd"
#: most steps of SQLite's machine: so many for each byte of the file, and these besides. A row takes five,
#: and at least eleven bytes; damaged pages that refer to each other can repeat rows without end
_STEPS_PER_BYTE, _MOST_STEPS, _PACE = 1, 1_000_000, 100_000
DAMAGED, CUT = "the file is damaged", "the file was cut"


@dataclasses.dataclass
class _Scan:
    """Position-independent state of reading one file."""

    bag: Bag
    wanted: Collection[str]
    chunks: Decompression
    #: topics by number of connection or channel, and message types by number of schema
    topics: dict[int, Topic | None] = dataclasses.field(default_factory=dict)
    types: dict[int, str] = dataclasses.field(default_factory=dict)
    #: position of the index by the first record of ROS 1; None without that record
    index: int | None = None
    finished: bool = False

    def add(self, topic: Topic | None, received: int, raw: bytes) -> None:
        """Add a message of a wanted topic, decompressed if it is compressed."""
        if topic is not None and topic.name in self.wanted:
            topic.received.append(received)
            topic.raw.append(self.chunks.records(raw, "zstd") if raw[:4] == ZSTD_MAGIC else raw)

    def result(self, what: str, size: int, damage: str) -> Bag:
        """Return the bag. Raises `RecordingError` if it has no topics."""
        self.bag.is_limited = self.chunks.is_limited
        self.bag.damage = EXPANDED if self.bag.is_limited else damage
        if not self.bag.topics:
            more = f"; {MORE}" if self.bag.is_limited else ""
            reason = f": {damage}" if what == "SQLite file" and damage else f"; it has {size} bytes"
            raise RecordingError(f"no topic in this {what} can be read{reason}{more}")
        return self.bag


# ROS 1


def read_ros1(path: Path, wanted: Collection[str]) -> Bag:
    """Return the wanted topics' messages, and all topics' names and types. Raises `RecordingError`."""
    data = content.file_bytes(path, content.LARGEST_BAG)
    if data.startswith(ROS1_MAGIC) and not data.startswith(ROS1_VERSION):
        version = data[len(ROS1_MAGIC) :].split(b"\n", 1)[0][:20].decode("ascii", "replace")
        raise RecordingError(f"a bag of version {version!r}; allowed is 2.0")
    typestore(1)
    file = _Scan(Bag(1), wanted, Decompression(len(data)))
    _scan_ros1(file, data, len(ROS1_VERSION) if data.startswith(ROS1_VERSION) else 0)
    if file.index == 0:
        damage = "the recorder was stopped before it had finished the file"
    elif file.index is not None and file.index > len(data):
        damage = CUT
    else:
        damage = DAMAGED if file.bag.lost or file.index is None else ""
    return file.result("bag", len(data), damage)


def _scan_ros1(file: _Scan, data: bytes, position: int, in_chunk: bool = False) -> None:
    from rosbags.rosbag1.reader import Header, ReaderError, read_bytes, read_uint32

    source = io.BytesIO(data)
    while position < len(data):
        start = source.seek(position)
        try:
            header = Header.read(source)
            kind, size, begin = header.get_uint8("op"), read_uint32(source), source.tell()
            position = begin + size
            if kind == _CHUNK:
                compression = header.get_string("compression")
                if in_chunk:  # in the format no chunk has chunks
                    file.bag.lost += size
                elif compression == "none":
                    # its records follow directly; its stated length is not trusted
                    position = begin
                else:
                    # a recorder that was killed has not yet written how long its last chunk is
                    packed = memoryview(data)[begin : position if size else len(data)]
                    position = begin + len(packed)
                    stated = header.get_uint32("size")
                    records = file.chunks.records(packed, compression, stated)
                    file.bag.lost += max(stated - len(records), 0 if records else len(packed))
                    _scan_ros1(file, records, 0, in_chunk=True)
            elif kind == _CONNECTION:
                number, about = header.get_uint32("conn"), Header.read(io.BytesIO(data[begin - 4 : position]))
                name, digest = header.get_string("topic"), about.get("md5sum", b"").decode("ascii", "replace")
                # keep the first readable one: the index repeats it
                if number not in file.topics:
                    file.topics[number] = file.bag.topic(name, about.get_string("type"), digest)
            elif kind == _MESSAGE:
                topic = file.topics.get(header.get_uint32("conn"))
                if topic is not None and topic.name in file.wanted:
                    file.add(topic, header.get_time("time"), read_bytes(source, size))
            elif kind == _HEADER and file.index is None:
                file.index = header.get_uint64("index_pos")
        except (ReaderError, ValueError):
            following = _next_record(data, start + 1)
            file.bag.lost += following - start
            position = following


def _next_record(data: bytes, position: int) -> int:
    """Return the start of the next record from a position on; the end of the data if there is none."""
    mark = position - 1
    while (mark := data.find(_KIND_FIELD, mark + 1)) >= 0:
        # an unknown number of fields may precede the type, but their lengths must fit
        for begin in range(max(position, mark - 80), mark - 3):
            end = begin + 4 + int.from_bytes(data[begin : begin + 4], "little")
            if mark + 8 <= end <= begin + 4096:
                place = begin + 4
                while place < end:
                    place += 4 + int.from_bytes(data[place : place + 4], "little")
                if place == end:
                    return begin
    return len(data)


# MCAP


def read_mcap(path: Path, wanted: Collection[str], data: bytes | None = None) -> Bag:
    """Return the same as `read_ros1` for an MCAP file. Raises `RecordingError`."""
    data = content.file_bytes(path, content.LARGEST_BAG) if data is None else data
    typestore(2)
    file = _Scan(Bag(2), wanted, Decompression(len(data)))
    _scan_mcap(file, data, len(MCAP_MAGIC))
    damage = DAMAGED if file.bag.lost and file.finished else ""
    if not file.finished:
        damage = "the recorder was stopped or the file was cut"
    return file.result("MCAP file", len(data), damage)


def _scan_mcap(file: _Scan, data: bytes, position: int, in_chunk: bool = False) -> None:
    from rosbags.rosbag2.errors import ReaderError
    from rosbags.rosbag2.storage_mcap import read_string

    while position + 9 <= len(data) and not file.finished:
        kind, size = struct.unpack_from("<BQ", data, position)
        record = io.BytesIO(data[position + 9 : position + 9 + size])
        position += 9 + size
        # of a chunk that was cut its beginning is read
        if not 0x01 <= kind <= _MCAP_END or (position > len(data) and kind != _MCAP_CHUNK):
            position -= 9 + size
            break
        try:
            if kind == _MCAP_SCHEMA:
                (number,) = struct.unpack("<H", record.read(2))
                file.types[number] = read_string(record)
            elif kind == _MCAP_CHANNEL:
                number, schema = struct.unpack("<HH", record.read(4))
                file.topics[number] = file.bag.topic(read_string(record), file.types.get(schema, "unknown"))
            elif kind == _MCAP_MESSAGE:
                number, _, received = struct.unpack("<HIQ", record.read(14))
                file.add(file.topics.get(number), received, record.getvalue()[22:])
            elif kind == _MCAP_CHUNK and in_chunk:  # in the format no chunk has chunks
                file.bag.lost += size
            elif kind == _MCAP_CHUNK:
                stated = struct.unpack("<QQQI", record.read(28))[2]
                compression = read_string(record)
                packed = record.read()[8:]
                records = file.chunks.records(packed, compression, stated) if compression else packed
                file.bag.lost += max(0, stated - len(records)) if position <= len(data) else 0
                _scan_mcap(file, records, 0, in_chunk=True)
            # the records after the data only repeat them
            file.finished |= kind == _MCAP_END
        except (ReaderError, struct.error, ValueError):
            file.bag.lost += size
    if not file.finished:
        file.bag.lost += max(0, len(data) - position)


# SQLite


def read_sqlite(path: Path, wanted: Collection[str], data: bytes | None = None) -> Bag:
    """Return the same as `read_ros1` for a SQLite file, or for its bytes. Raises `RecordingError`."""
    size = path.stat().st_size if data is None else len(data)
    require_limit(size, content.LARGEST_BAG, "bytes")
    # without a journal beside it the file is only read; with one, SQLite has to look into both
    journal = path.with_name(path.name + "-wal").exists()
    address = f"file:{urllib.parse.quote(str(path))}?mode=ro" + ("" if journal else "&immutable=1")
    try:
        connection = sqlite3.connect(address if data is None else "file::memory:", uri=True)
        if data is not None:
            connection.deserialize(data)
    except sqlite3.Error as error:
        raise RecordingError(f"cannot be read: {error}") from None
    file = _Scan(Bag(2), wanted, Decompression(size))
    # no text and no blob is longer than the file
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(size, 1 << 16))
    steps = iter(range((_STEPS_PER_BYTE * size + _MOST_STEPS) // _PACE))
    connection.set_progress_handler(lambda: next(steps, None) is None, _PACE)
    try:
        damage = _read_tables(connection, file, size)
    except (sqlite3.Error, UnicodeDecodeError, OverflowError) as error:
        reason = " ".join(str(error).split())
        if next(steps, None) is None:
            reason = "its pages repeat more rows than it can hold"
        damage = f"the file was cut or is damaged ({reason})"
    finally:
        connection.close()
    if not (damage or file.bag.topics):
        damage = "it has no tables of topics and messages"
    return file.result("SQLite file", size, damage)


def _read_tables(connection: sqlite3.Connection, file: _Scan, size: int) -> str:
    """Read topics and messages; return the damage, empty without any."""
    # without this SQLite does not open a file that is shorter than its first page states
    connection.execute("PRAGMA writable_schema = ON")
    # views are refused: reading a file must not run queries stored in it
    query = "SELECT name, sql FROM sqlite_master WHERE type = 'table' AND name IN ('topics', 'messages')"
    tables = dict(connection.execute(query).fetchall())
    if len(tables) < 2:
        return ""
    for table, stored in tables.items():
        # generated columns and virtual tables are programs too, and may make gigabytes of nothing
        columns = connection.execute(f"PRAGMA table_xinfo({table})")
        if not str(stored).upper().startswith("CREATE TABLE") or any(column[6] for column in columns):
            return f"its table {table} is computed, and not stored"
    for number, name, kind in connection.execute("SELECT id, name, type FROM topics"):
        if isinstance(name, str) and isinstance(kind, str):
            file.topics[number] = file.bag.topic(name, kind)
    # in the order of writing, so that the messages before a damaged page are the beginning
    for number, received, raw in connection.execute(
        "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
    ):
        if isinstance(raw, bytes) and isinstance(received, int):
            size -= len(raw)
            if size < 0:
                return "its messages have more bytes than the file"
            file.add(file.topics.get(number), received, raw)
    return ""


# files of ROS 2


def read_ros2(path: Path, wanted: Collection[str]) -> Bag:
    """Return the content of a file of ROS 2, also if it is compressed as a whole. Raises `RecordingError`."""
    head, data = content.beginning(path), None
    if head.startswith(ZSTD_MAGIC):
        packed = content.file_bytes(path, content.LARGEST_BAG)
        file = Decompression(len(packed))
        head = data = file.records(packed, "zstd")
        if file.is_limited:
            raise RecordingError(f"{EXPANDED}; {MORE}")
    is_sqlite = head.startswith(SQLITE_MAGIC) or (path.suffix == ".db3" and not head.startswith(MCAP_MAGIC))
    return (read_sqlite if is_sqlite else read_mcap)(path, wanted, data)


def read_folder(folder: Path, wanted: Collection[str]) -> Bag:
    """Return the files of a bag's folder in one bag. Raises `RecordingError`."""
    files = [path for path in folder.iterdir() if path.name.removesuffix(_PACKED).endswith(_STORAGE)]
    if not files:
        raise RecordingError("this folder holds no bag; allowed is one with .mcap or .db3 files")
    bags = []
    # the recorder numbers them: _0, _1 … _10
    for path in sorted(files, key=lambda path: (len(path.name), path.name)):
        with naming(path.name):
            bags.append(read_ros2(path, wanted))
    first, *others = bags
    for bag in others:
        first.lost += bag.lost
        first.is_limited |= bag.is_limited
        first.damage = first.damage or bag.damage
        for topic in bag.topics.values():
            known = first.topic(topic.name, topic.type)
            if known is not None:
                known.received += topic.received
                known.raw += topic.raw
    return first


# writing


def write_ros1(path: Path, outgoing: Outgoing) -> None:
    """Write a bag of ROS 1."""
    store = typestore(1)
    from rosbags.rosbag1 import Writer

    with replacing(path) as temporary, Writer(temporary) as writer:
        _write_messages(writer, outgoing, 1, store)


def write_ros2(path: Path, outgoing: Outgoing) -> None:
    """Write one file of a bag of ROS 2, an MCAP or SQLite file by the name's end."""
    store = typestore(2)
    from rosbags.rosbag2 import StoragePlugin, Writer

    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    # rosbags writes a folder with a description; the data file alone is complete
    with replacing(path) as temporary, temporary_folder(path) as folder:
        with Writer(folder / "bag", version=9, storage_plugin=plugin) as writer:
            _write_messages(writer, outgoing, 2, store)
        (folder / "bag" / f"bag{path.suffix}").replace(temporary)


def _write_messages(writer: Any, outgoing: Outgoing, ros: int, store: Any) -> None:
    connections = {
        stream.topic: writer.add_connection(stream.topic, message_type(stream, ros), typestore=store)
        for stream in outgoing.streams
    }
    for topic, received, message in encoded_messages(outgoing, ros):
        writer.write(connections[topic], received, message)


def encoded_messages(outgoing: Outgoing, ros: int) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, recording time (ns) and message, in the order of recording."""

    def of(stream: OutgoingStream) -> Iterator[tuple[int, int, str, bytes]]:
        encode = encoder_of(stream, ros)
        delay = round(outgoing.delays.get(stream.topic, 0.0) * 1e9)
        time, values = stream.time, stream.values
        if outgoing.config.simulated and stream.role == "command" and stream.source.text is not None:
            # a first row of NaN stands for the line on the simulation
            time = [*time[:1], *time]
            values = [np.full(len(stream.source.order), np.nan)][: len(time)] + list(values)
        for row, (at, numbers) in enumerate(zip(time, values, strict=True)):
            stamp = outgoing.start * 10**9 + round(float(at) * 1e9)
            yield stamp + delay, row, stream.topic, encode(stamp, row, numbers)

    for received, _, topic, message in heapq.merge(*map(of, outgoing.streams), key=lambda entry: entry[:3]):
        yield topic, received, message


def _starting(*magics: bytes) -> Callable[[bytes], Any]:
    return lambda head: head.startswith(magics)


register(
    RecordingFormat(
        "ROS 1 bag",
        _starting(ROS1_MAGIC),
        read_ros1,
        suffixes=(".bag", ".bag.active"),
        write=write_ros1,
        written=(".bag",),
    )
)
register(
    RecordingFormat(
        "ROS 2 bag",
        _starting(MCAP_MAGIC, SQLITE_MAGIC),
        read_ros2,
        suffixes=(*_STORAGE, *(f"{suffix}{_PACKED}" for suffix in _STORAGE)),
        write=write_ros2,
        written=_STORAGE,
    )
)
register(RecordingFormat("folder of a ROS 2 bag", lambda head: False, read_folder, is_folder=True))
