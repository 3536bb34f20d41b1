"""Small bags that would take gigabytes, minutes, or the whole stack: read within bounds, or refused."""

import bz2
import sqlite3
import struct
import time

import pytest

from knode_cosserat.io.container import MOST_NESTED, ContainerError, nesting
from knode_cosserat.recordings.container import ALLOWANCE, RATIO, Decompression
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.formats.ros1 import CHUNK as CHUNK_1
from knode_cosserat.recordings.formats.ros1 import VERSION, read_ros1
from knode_cosserat.recordings.formats.ros2 import CHUNK, MCAP_MAGIC, read_mcap, read_sqlite

LEVELS = 3000


def test_chunks_of_nothing_take_bounded_memory():
    packed = bz2.compress(bytes(1 << 26))
    file = Decompression(1000)
    records, _ = file.records(packed, "bz2", 0)
    assert 0 < len(records) <= RATIO * 1000 + ALLOWANCE
    assert file.records(packed, "bz2", 0) == (b"", len(packed))
    # what recorders write is far from the limit
    usual = bytes(range(256)) * 400
    assert Decompression(len(usual)).records(bz2.compress(usual), "bz2", len(usual))[0] == usual


def mcap_chunk(records):
    body = struct.pack("<QQQI", 0, 0, len(records), 0) + struct.pack("<I", 0)
    body += struct.pack("<Q", len(records)) + records
    return bytes([CHUNK]) + struct.pack("<Q", len(body)) + body


def ros1_chunk(records):
    fields = {"op": bytes([CHUNK_1]), "compression": b"bz2", "size": struct.pack("<I", len(records))}
    parts = [name.encode() + b"=" + value for name, value in fields.items()]
    header = b"".join(struct.pack("<I", len(part)) + part for part in parts)
    packed = bz2.compress(records)
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(packed)) + packed


def test_chunks_within_chunks_end_at_once():
    began = time.monotonic()
    records = b""
    for _ in range(LEVELS):
        records = mcap_chunk(records)
    with pytest.raises(RecordingError, match="no topic in this MCAP file can be read"):
        read_mcap(MCAP_MAGIC + records, (), "it.mcap")
    records = b""
    for _ in range(200):
        records = ros1_chunk(records)
    with pytest.raises(RecordingError, match="no topic in this bag can be read"):
        read_ros1(VERSION + records, (), "it.bag")
    assert time.monotonic() - began < 60.0


@pytest.mark.parametrize(
    "columns",
    [
        "id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB AS (zeroblob(900000000))",
        "id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB AS (zeroblob(900000000)) STORED",
    ],
)
def test_tables_that_are_computed_are_refused(tmp_path, columns):
    path = tmp_path / "it.db3"
    with sqlite3.connect(path) as made:
        made.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT)")
        made.execute(f"CREATE TABLE messages ({columns})")
        made.execute("INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/Float64MultiArray')")
        if "STORED" not in columns:
            made.executemany("INSERT INTO messages VALUES (?, 1, 0)", [(k,) for k in range(100)])
    made.close()
    with pytest.raises(RecordingError, match="its table messages is computed, and not stored"):
        read_sqlite(path, ("/a",), "it.db3")


def test_depth_of_a_header_is_known_before_it_is_read():
    assert nesting('{"a": [[1], {"b": []}]}') == 4
    assert nesting("[" * 3500) > MOST_NESTED
    assert issubclass(ContainerError, ValueError)
