"""Reader of ROS 2 bags: MCAP files, SQLite files (.db3) and folders of these, as far as they are readable.

Neither the summary at an MCAP file's end nor a folder's metadata.yaml is needed: a recorder that was killed
has not written them. Messages, and whole files, may be compressed by zstd (rosbag2's `compression_mode`):
compressed messages are recognised by their first bytes, which no encoded message has.
"""

from __future__ import annotations

import sqlite3
import struct
import urllib.parse
from collections.abc import Collection, Iterator
from pathlib import Path

from knode_cosserat._files.limits import MORE, excess
from knode_cosserat.recordings import content
from knode_cosserat.recordings.container import EXPANDED, Container, Decompression
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.formats import RecordingFormat, register

MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\x00"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
#: storage files of a bag's folder, and the end of their names when compressed as a whole
_STORAGE, _PACKED = (".mcap", ".db3"), ".zstd"
#: most steps of SQLite's machine: so many for each byte of the file, and these besides. A row takes five,
#: and at least eleven bytes; damaged pages that refer to each other can repeat rows without end
STEPS_PER_BYTE, MOST_STEPS = 1, 1_000_000
#: steps between two checks of that
_PACE = 100_000
#: record types of MCAP
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
_KINDS = range(0x01, 0x10)


def storage_files(folder: Path) -> list[Path]:
    """Return the files of a bag's folder, in the order of recording.

    Raises:
        RecordingError: the folder holds no files of a bag.
    """
    files = [path for path in folder.iterdir() if path.name.removesuffix(_PACKED).endswith(_STORAGE)]
    if not files:
        raise RecordingError(f"{folder}: this folder holds no bag; allowed is one with .mcap or .db3 files")
    # the recorder numbers them: _0, _1 … _10
    return sorted(files, key=lambda path: (len(path.name), path.name))


def read_folder(folder: Path, wanted: Collection[str]) -> Container:
    """Return the wanted topics' messages in all files of a folder. Raises `RecordingError`."""
    return merged([_read_file(path, wanted) for path in storage_files(folder)])


def _read_file(path: Path, wanted: Collection[str]) -> Container:
    head = content.beginning(path)
    if head.startswith(ZSTD_MAGIC):
        packed = content.file_bytes(path, content.LARGEST_BAG)
        decompression = Decompression(len(packed))
        data = decompression.records(packed, "zstd", 0)[0]
        if decompression.is_limited:
            raise RecordingError(f"{path}: {EXPANDED}; {MORE}")
        is_sqlite = data.startswith(SQLITE_MAGIC)
        return (read_sqlite_bytes if is_sqlite else read_mcap)(data, wanted, str(path))
    if head.startswith(SQLITE_MAGIC) or (path.suffix == ".db3" and not head.startswith(MCAP_MAGIC)):
        if reason := excess(path.stat().st_size, content.LARGEST_BAG, "bytes"):
            raise RecordingError(f"{path}: {reason}")
        return read_sqlite(path, wanted, str(path))
    return read_mcap(content.file_bytes(path, content.LARGEST_BAG), wanted, str(path))


def merged(containers: list[Container]) -> Container:
    """Return the files of one bag joined into one container."""
    whole = containers[0]
    for each in containers[1:]:
        whole.lost += each.lost
        whole.is_limited |= each.is_limited
        whole.damage = whole.damage or each.damage
        for topic in each.topics.values():
            known = whole.topic(topic.name, topic.type, topic.digest)
            if known is not None:
                known.received += topic.received
                known.raw += topic.raw
    return whole


# MCAP


def read_mcap(data: bytes, wanted: Collection[str], source: str) -> Container:
    """Return the wanted topics' messages, and all topics' names and types. Raises `RecordingError`."""
    file = _Mcap(wanted, len(data))
    file.scan(memoryview(data), len(MCAP_MAGIC))
    container = file.gathered()
    if not container.topics:
        more = f"; {MORE}" if container.is_limited else ""
        raise RecordingError(
            f"{source}: no topic in this MCAP file can be read; it has {len(data)} bytes{more}"
        )
    return container


class _Mcap:
    """Content of an MCAP file read so far."""

    def __init__(self, wanted: Collection[str], size: int) -> None:
        self.container = Container(ros=2)
        self._decompression = Decompression(size)
        self.wanted = wanted
        self.types: dict[int, str] = {}
        self.channels: dict[int, tuple[str, int]] = {}
        self.finished = False

    def scan(self, view: memoryview, position: int, in_chunk: bool = False) -> None:
        for kind, record in self._records(view, position):
            if kind == CHUNK and in_chunk:  # in the format no chunk has chunks
                self.container.lost += len(record)
                self.container.damage = "the file is damaged"
                continue
            try:
                self._take(kind, record)
            except (struct.error, UnicodeDecodeError):
                self.container.lost += len(record)
                self.container.damage = "the file is damaged"

    def gathered(self) -> Container:
        self.container.is_limited = self._decompression.is_limited
        if self.container.is_limited:
            self.container.damage = EXPANDED
        elif not self.finished:
            self.container.damage = self.container.damage or "the recorder was stopped or the file was cut"
        return self.container

    def _records(self, view: memoryview, position: int) -> Iterator[tuple[int, memoryview]]:
        while position + 9 <= len(view):
            kind, size = view[position], int.from_bytes(view[position + 1 : position + 9], "little")
            begin = position + 9
            if kind not in _KINDS or (begin + size > len(view) and kind != CHUNK):
                break
            yield kind, view[begin : begin + size]
            position = begin + size
            # the records after the data only repeat them
            if kind == DATA_END:
                self.finished = True
                return
        self.container.lost += max(0, len(view) - position)

    def _take(self, kind: int, record: memoryview) -> None:
        if kind == SCHEMA:
            (number,) = struct.unpack_from("<H", record)
            self.types[number], _ = _string(record, 2)
        elif kind == CHANNEL:
            number, schema = struct.unpack_from("<HH", record)
            self.channels[number] = _string(record, 4)[0], schema
            self.container.topic(self.channels[number][0], self.types.get(schema, "unknown"))
        elif kind == CHUNK:
            size, _ = struct.unpack_from("<QI", record, 16)
            compression, begin = _string(record, 28)
            length = struct.unpack_from("<Q", record, begin)[0]
            packed = record[begin + 8 : begin + 8 + length]
            records = self._decompression.records(packed, compression, size)[0] if compression else packed
            self.container.lost += max(0, min(size, length) - len(records))
            self.scan(memoryview(records), 0, in_chunk=True)
        elif kind == MESSAGE:
            number, _, received = struct.unpack_from("<HIQ", record)
            name, schema = self.channels.get(number, ("", 0))
            topic = (
                self.container.topic(name, self.types.get(schema, "unknown")) if name in self.wanted else None
            )
            if topic is not None:
                topic.received.append(received)
                topic.raw.append(_unpacked(record[22:], self._decompression))


def _string(record: memoryview, position: int) -> tuple[str, int]:
    """Return a length-prefixed text and the position of its end."""
    (length,) = struct.unpack_from("<I", record, position)
    end = position + 4 + length
    if end > len(record):
        raise struct.error("text beyond the record's end")
    return bytes(record[position + 4 : end]).decode("utf-8"), end


def _unpacked(raw: bytes | memoryview, decompression: Decompression) -> bytes | memoryview:
    """Return a message's bytes, decompressed; a damaged one comes back cut, and cannot be decoded later."""
    return decompression.records(raw, "zstd", 0)[0] if raw[:4] == ZSTD_MAGIC else raw


# SQLite


def read_sqlite(path: Path, wanted: Collection[str], source: str) -> Container:
    """Return the wanted topics' messages, and all topics' names and types. Raises `RecordingError`."""
    # without a journal beside it the file is only read; with one, SQLite has to look into both
    journal = path.with_name(path.name + "-wal").exists()
    address = f"file:{urllib.parse.quote(str(path))}?mode=ro" + ("" if journal else "&immutable=1")
    try:
        connection = sqlite3.connect(address, uri=True)
    except sqlite3.Error as error:
        raise RecordingError(f"{source}: cannot be read: {error}") from None
    return _read_connection(connection, path.stat().st_size, wanted, source)


def read_sqlite_bytes(data: bytes, wanted: Collection[str], source: str) -> Container:
    """Return the same as `read_sqlite`, from the bytes of a file. Raises `RecordingError`."""
    connection = sqlite3.connect(":memory:")
    try:
        connection.deserialize(data)
    except sqlite3.Error as error:
        raise RecordingError(f"{source}: cannot be read: {error}") from None
    return _read_connection(connection, len(data), wanted, source)


def _read_connection(
    connection: sqlite3.Connection, size: int, wanted: Collection[str], source: str
) -> Container:
    container = Container(ros=2)
    # no text and no blob is longer than the file
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(size, 1 << 16))
    steps = iter(range((STEPS_PER_BYTE * size + MOST_STEPS) // _PACE))
    connection.set_progress_handler(lambda: next(steps, None) is None, _PACE)
    try:
        _tables(connection, container, wanted, size)
    except (sqlite3.Error, UnicodeDecodeError, OverflowError) as error:
        reason = " ".join(str(error).split())
        if next(steps, None) is None:
            reason = "its pages repeat more rows than it can hold"
        container.damage = f"the file was cut or is damaged ({reason})"
    finally:
        connection.close()
    if not container.topics:
        reason = container.damage or "it has no tables of topics and messages"
        raise RecordingError(f"{source}: no topic in this SQLite file can be read: {reason}")
    return container


def _tables(connection: sqlite3.Connection, container: Container, wanted: Collection[str], size: int) -> None:
    # without this SQLite does not open a file that is shorter than its first page states
    connection.execute("PRAGMA writable_schema = ON")
    # views are refused: reading a file must not run queries stored in it
    query = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('topics', 'messages')"
    if connection.execute(query).fetchone()[0] != 2:
        return
    for table in ("topics", "messages"):
        # generated columns and virtual tables are programs too, and may make gigabytes of nothing
        stored = connection.execute("SELECT sql FROM sqlite_master WHERE name = ?", (table,)).fetchone()[0]
        columns = connection.execute(f"PRAGMA table_xinfo({table})")
        if not str(stored).upper().startswith("CREATE TABLE") or any(column[6] for column in columns):
            container.damage = f"its table {table} is computed, and not stored"
            return
    topics = {}
    for number, name, kind in connection.execute("SELECT id, name, type FROM topics"):
        if isinstance(name, str) and isinstance(kind, str):
            topics[number] = container.topic(name, kind)
    decompression = Decompression(size)
    # in the order of writing, so that the messages before a damaged page are the beginning
    for number, received, raw in connection.execute(
        "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
    ):
        topic = topics.get(number)
        size -= len(raw) if isinstance(raw, bytes) else 0
        if size < 0:
            container.damage = "its messages have more bytes than the file"
            return
        if (
            topic is not None
            and topic.name in wanted
            and isinstance(received, int)
            and isinstance(raw, bytes)
        ):
            topic.received.append(received)
            topic.raw.append(_unpacked(raw, decompression))
    if decompression.is_limited:
        container.is_limited, container.damage = True, EXPANDED


register(
    RecordingFormat(
        "ROS 2 bag",
        recognise=lambda head: head.startswith((MCAP_MAGIC, SQLITE_MAGIC)),
        read=_read_file,
        suffixes=(*_STORAGE, *(f"{suffix}{_PACKED}" for suffix in _STORAGE)),
    )
)
register(RecordingFormat("folder of a ROS 2 bag", lambda head: False, read_folder, is_folder=True))
