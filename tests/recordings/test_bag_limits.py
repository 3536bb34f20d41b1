"""Limits of what a bag expands to: the part within them is read, and the rest is a finding."""

import bz2
import contextlib
import itertools
import sqlite3
import struct

import numpy as np
import pytest

from knode_cosserat._files.limits import MORE, VARIABLE
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.recordings import container as chunks
from knode_cosserat.recordings import load
from knode_cosserat.recordings.formats import ros1, ros2


@pytest.fixture(autouse=True)
def unset(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)


def mcap(count):
    """An MCAP file with messages in a chunk that is compressed by bz2."""

    def record(kind, body):
        return bytes([kind]) + struct.pack("<Q", len(body)) + body

    def text(word):
        return struct.pack("<I", len(word)) + word

    schema = record(ros2.SCHEMA, struct.pack("<H", 1) + text(b"std_msgs/msg/Float64MultiArray") + text(b""))
    channel = record(ros2.CHANNEL, struct.pack("<HH", 1, 1) + text(b"/a") + text(b"cdr"))
    message = record(ros2.MESSAGE, struct.pack("<HIQQ", 1, 0, 5, 5) + bytes(1000))
    records = schema + channel + count * message
    packed = bz2.compress(records)
    chunk = struct.pack("<QQQI", 0, 0, len(records), 0) + text(b"bz2") + struct.pack("<Q", len(packed))
    return ros2.MCAP_MAGIC + record(ros2.CHUNK, chunk + packed) + record(ros2.DATA_END, bytes(4))


def test_a_bag_within_the_limit_is_read_and_the_rest_is_a_finding(monkeypatch):
    data = mcap(100)
    monkeypatch.setattr(chunks, "RATIO", 0)
    monkeypatch.setattr(chunks, "ALLOWANCE", 20_000)
    bag = ros2.read_mcap(data, {"/a"}, "it.mcap")
    assert bag.is_limited and 15 <= len(bag.topics["/a"].raw) < 20
    finding = load._said_damage(bag, [])
    assert finding.message.startswith(chunks.EXPANDED) and finding.message.endswith(MORE)
    monkeypatch.setattr(chunks, "ALLOWANCE", 50)
    with pytest.raises(KnodeCosseratError, match=f"no topic in this MCAP file can be read.*{MORE}$"):
        ros2.read_mcap(data, {"/a"}, "it.mcap")
    monkeypatch.setenv(VARIABLE, "1e4")
    bag = ros2.read_mcap(data, {"/a"}, "it.mcap")
    assert not bag.is_limited and not bag.damage and len(bag.topics["/a"].raw) == 100
    assert ros2.merged([bag, chunks.Container(2, is_limited=True)]).is_limited


def test_a_ros_1_bag_beyond_the_limit_says_so(monkeypatch):
    monkeypatch.setattr(chunks, "LARGEST_CHUNK", 10)
    packed = bz2.compress(bytes(1000))
    fields = (b"op=" + bytes([ros1.CHUNK]), b"compression=bz2", b"size=" + struct.pack("<I", 1000))
    header = b"".join(struct.pack("<I", len(field)) + field for field in fields)
    bag = struct.pack("<I", len(header)) + header + struct.pack("<I", len(packed)) + packed
    with pytest.raises(KnodeCosseratError, match=f"no topic in this bag can be read.*{MORE}$"):
        ros1.read_ros1(ros1.VERSION + bag, (), "it.bag")


def packed_by(compression, data):
    if compression == "bz2":
        return bz2.compress(data)
    if compression == "lz4":
        return pytest.importorskip("lz4.frame").compress(data)
    try:
        from compression import zstd
    except ImportError:
        zstd = pytest.importorskip("backports.zstd")
    return zstd.compress(data)


@pytest.mark.parametrize("compression", ["bz2", "lz4", "zstd"])
@pytest.mark.parametrize("output", [1, 1000, 4096, 1 << 24])
def test_chunks_are_complete_when_their_output_comes_in_parts(monkeypatch, compression, output):
    random = np.random.default_rng(0)
    for data in (bytes(20_000), random.bytes(20_000), b"ab" * 10_000 + random.bytes(1)):
        packed = packed_by(compression, data)
        monkeypatch.setattr(chunks, "_OUTPUT", output)
        for size in (0, len(data)):
            file = chunks.Decompression(len(packed))
            assert file.records(packed + b"more", compression, size) == (data, len(packed))
            assert not file.is_limited


def test_pages_that_name_each_other_end(tmp_path):
    """Each of twelve pages of a SQLite file names the next one some 50 times: more than 10^20 rows."""
    path, page_size = tmp_path / "it.db3", 512
    with contextlib.closing(sqlite3.connect(path)) as opened:
        opened.execute(f"PRAGMA page_size={page_size}")
        opened.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        opened.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data BLOB)")
        opened.execute("INSERT INTO topics VALUES(1, '/a', 'std_msgs/msg/String')")
        rows = ((time,) for time in range(40_000))
        opened.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, x'')", rows)
        opened.commit()
        query = "SELECT rootpage FROM sqlite_master WHERE name = 'messages'"
        root = opened.execute(query).fetchone()[0]
    whole = ros2.read_sqlite(path, {"/a"}, str(path))
    assert (len(whole.topics["/a"].raw), whole.damage) == (40_000, "")

    content = bytearray(path.read_bytes())
    view, count = memoryview(content), len(content) // page_size
    pages = {k + 1: view[k * page_size : (k + 1) * page_size] for k in range(count)}

    def children(page):
        """Return where an inner page names its children; none of a page with rows."""
        count = struct.unpack(">H", page[3:5])[0] if page[0] == 5 else 0
        return [8, *struct.unpack(f">{count}H", page[12 : 12 + 2 * count])] if count else []

    inner = [k for k in pages if k > root and len(children(pages[k])) > 20][:11]
    for number, named in itertools.pairwise([root, *inner]):
        for place in children(pages[number]):
            pages[number][place : place + 4] = struct.pack(">I", named)
    path.write_bytes(content)
    found = ros2.read_sqlite(path, {"/a"}, str(path))
    assert found.damage.endswith("(its pages repeat more rows than it can hold)")
    assert len(found.topics["/a"].raw) < 1_000_000


def test_messages_with_more_bytes_than_the_file(tmp_path):
    """Damaged pages can also let many rows share one large message."""
    path = tmp_path / "it.db3"
    with contextlib.closing(sqlite3.connect(path)) as opened:
        opened.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        opened.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data BLOB)")
        opened.execute("INSERT INTO topics VALUES(1, '/a', 'std_msgs/msg/String')")
        opened.execute("INSERT INTO messages VALUES(1, 1, 1, zeroblob(500))")
        opened.execute("INSERT INTO messages VALUES(2, 1, 2, zeroblob(500))")
        opened.commit()
        container = chunks.Container(ros=2)
        ros2._tables(opened, container, {"/a"}, 999)
    assert container.damage == "its messages have more bytes than the file"
    assert len(container.topics["/a"].raw) == 1
