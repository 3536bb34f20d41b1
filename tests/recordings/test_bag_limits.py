"""Small bags that would take gigabytes, minutes, or the whole stack: read within bounds, or refused."""

import bz2
import contextlib
import itertools
import sqlite3
import struct
import time

import numpy as np
import pytest
from backports import zstd

from knode_cosserat._files.limits import MORE, VARIABLE
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.io.container import MOST_NESTED, ContainerError, nesting
from knode_cosserat.recordings import RecordingError, content, load_recording
from knode_cosserat.recordings.content import ALLOWANCE, EXPANDED, RATIO, Decompression
from knode_cosserat.recordings.formats import bag

TOPICS = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)"
MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data BLOB)"


@pytest.fixture(autouse=True)
def unset(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)


def stored(folder, name, data):
    path = folder / name
    path.write_bytes(data)
    return path


def record(kind, body):
    return bytes([kind]) + struct.pack("<Q", len(body)) + body


def text(word):
    return struct.pack("<I", len(word)) + word


def chunk(records, compression=b""):
    packed = {b"": bytes, b"bz2": bz2.compress}[compression](records)
    body = struct.pack("<QQQI", 0, 0, len(records), 0) + text(compression) + struct.pack("<Q", len(packed))
    return record(6, body + packed)


def mcap(count):
    """An MCAP file with messages in a chunk that is compressed by bz2."""
    schema = record(3, struct.pack("<H", 1) + text(b"std_msgs/msg/Float64MultiArray") + text(b""))
    channel = record(4, struct.pack("<HH", 1, 1) + text(b"/a") + text(b"cdr"))
    message = record(5, struct.pack("<HIQQ", 1, 0, 5, 5) + bytes(1000))
    return bag.MCAP_MAGIC + chunk(schema + channel + count * message, b"bz2") + record(15, bytes(4))


def ros1_chunk(records):
    fields = (b"op=\x05", b"compression=bz2", b"size=" + struct.pack("<I", len(records)))
    packed = bz2.compress(records)
    return text(b"".join(map(text, fields))) + text(packed)


def test_a_bag_within_the_limit_is_read_and_the_rest_is_a_finding(tmp_path, monkeypatch):
    path = stored(tmp_path, "it.mcap", mcap(100))
    monkeypatch.setattr(content, "RATIO", 0)
    monkeypatch.setattr(content, "ALLOWANCE", 20_000)
    part = bag.read_mcap(path, {"/a"})
    assert part.is_limited and part.damage == EXPANDED and 15 <= len(part.topics["/a"].raw) < 20
    monkeypatch.setattr(content, "ALLOWANCE", 50)
    with pytest.raises(KnodeCosseratError, match=f"no topic in this MCAP file can be read.*{MORE}$"):
        load_recording(path)
    monkeypatch.setenv(VARIABLE, "1e4")
    whole = bag.read_mcap(path, {"/a"})
    assert not whole.is_limited and not whole.damage and len(whole.topics["/a"].raw) == 100


def test_a_ros_1_bag_beyond_the_limit_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(content, "LARGEST_CHUNK", 10)
    path = stored(tmp_path, "it.bag", bag.ROS1_VERSION + ros1_chunk(bytes(1000)))
    with pytest.raises(KnodeCosseratError, match=f"no topic in this bag can be read.*{MORE}$"):
        load_recording(path)


def packed_by(compression, data):
    if compression == "lz4":
        return pytest.importorskip("lz4.frame").compress(data)
    return bz2.compress(data) if compression == "bz2" else zstd.compress(data)


@pytest.mark.parametrize("compression", ["bz2", "lz4", "zstd"])
@pytest.mark.parametrize("output", [1, 1000, 4096, 1 << 24])
def test_chunks_are_complete_when_their_output_comes_in_parts(monkeypatch, compression, output):
    random = np.random.default_rng(0)
    for data in (bytes(20_000), random.bytes(20_000), b"ab" * 10_000 + random.bytes(1)):
        packed = packed_by(compression, data)
        monkeypatch.setattr(content, "_OUTPUT", output)
        for size in (0, len(data)):
            file = Decompression(len(packed))
            assert file.records(packed + b"more", compression, size) == data
            assert not file.is_limited


def test_chunks_of_nothing_take_bounded_memory():
    packed = bz2.compress(bytes(1 << 26))
    file = Decompression(1000)
    assert 0 < len(file.records(packed, "bz2")) <= RATIO * 1000 + ALLOWANCE
    assert file.records(packed, "bz2") == b""
    # what recorders write is far from the limit
    usual = bytes(range(256)) * 400
    assert Decompression(len(usual)).records(bz2.compress(usual), "bz2", len(usual)) == usual


def test_chunks_within_chunks_end_at_once(tmp_path):
    began = time.monotonic()
    records = b""
    for _ in range(3000):
        records = chunk(records)
    with pytest.raises(RecordingError, match="no topic in this MCAP file can be read"):
        load_recording(stored(tmp_path, "it.mcap", bag.MCAP_MAGIC + records))
    records = b""
    for _ in range(200):
        records = ros1_chunk(records)
    with pytest.raises(RecordingError, match="no topic in this bag can be read"):
        load_recording(stored(tmp_path, "it.bag", bag.ROS1_VERSION + records))
    assert time.monotonic() - began < 60.0


@pytest.mark.parametrize("kind", ["", "STORED"])
def test_tables_that_are_computed_are_refused(tmp_path, kind):
    path = tmp_path / "it.db3"
    with contextlib.closing(sqlite3.connect(path)) as opened:
        opened.execute(TOPICS)
        columns = "id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB AS (zeroblob(900000000))"
        opened.execute(f"CREATE TABLE messages ({columns} {kind})")
        opened.execute("INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/Float64MultiArray')")
        if not kind:
            opened.executemany("INSERT INTO messages VALUES (?, 1, 0)", [(k,) for k in range(100)])
        opened.commit()
    with pytest.raises(RecordingError, match="its table messages is computed, and not stored"):
        bag.read_sqlite(path, ("/a",))


def test_pages_that_name_each_other_end(tmp_path):
    """Each of twelve pages of a SQLite file names the next one some 50 times: more than 10^20 rows."""
    path, page_size = tmp_path / "it.db3", 512
    with contextlib.closing(sqlite3.connect(path)) as opened:
        opened.execute(f"PRAGMA page_size={page_size}")
        opened.execute(TOPICS)
        opened.execute(MESSAGES)
        opened.execute("INSERT INTO topics VALUES(1, '/a', 'std_msgs/msg/String')")
        rows = ((time,) for time in range(40_000))
        opened.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, x'')", rows)
        opened.commit()
        query = "SELECT rootpage FROM sqlite_master WHERE name = 'messages'"
        root = opened.execute(query).fetchone()[0]
    whole = bag.read_sqlite(path, {"/a"})
    assert (len(whole.topics["/a"].raw), whole.damage) == (40_000, "")

    file = bytearray(path.read_bytes())
    view, count = memoryview(file), len(file) // page_size
    pages = {k + 1: view[k * page_size : (k + 1) * page_size] for k in range(count)}

    def children(page):
        """Return where an inner page names its children; none of a page with rows."""
        count = struct.unpack(">H", page[3:5])[0] if page[0] == 5 else 0
        return [8, *struct.unpack(f">{count}H", page[12 : 12 + 2 * count])] if count else []

    inner = [k for k in pages if k > root and len(children(pages[k])) > 20][:11]
    for number, named in itertools.pairwise([root, *inner]):
        for place in children(pages[number]):
            pages[number][place : place + 4] = struct.pack(">I", named)
    path.write_bytes(file)
    part = bag.read_sqlite(path, {"/a"})
    assert part.damage.endswith("(its pages repeat more rows than it can hold)")
    assert len(part.topics["/a"].raw) < 1_000_000


def test_messages_with_more_bytes_than_the_file(tmp_path, monkeypatch):
    """Damaged pages can also let many rows share one large message."""
    path = tmp_path / "it.db3"
    with contextlib.closing(sqlite3.connect(path)) as opened:
        opened.execute(TOPICS)
        opened.execute(MESSAGES)
        opened.execute("INSERT INTO topics VALUES(1, '/a', 'std_msgs/msg/String')")
        opened.executemany("INSERT INTO messages VALUES(?, 1, ?, zeroblob(500))", [(1, 1), (2, 2)])
        opened.commit()
        file = bag._Scan(bag.Bag(2), {"/a"}, Decompression(999))
        assert bag._read_tables(opened, file, 999) == "its messages have more bytes than the file"
    assert len(file.bag.topics["/a"].raw) == 1


def test_depth_of_a_header_is_known_before_it_is_read():
    assert nesting('{"a": [[1], {"b": []}]}') == 4
    assert nesting("[" * 3500) > MOST_NESTED
    assert issubclass(ContainerError, ValueError)
