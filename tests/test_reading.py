"""Files that are read whole: pipes, missing files, and texts that are not what they should be."""

import os

import pytest

from knode_cosserat._files import reading
from knode_cosserat._files.json_text import parse_json
from knode_cosserat._files.reading import ReadError, read_bytes, read_text


def pipe_of(content):
    """Return the path of a pipe with some content, and its number."""
    reading, writing = os.pipe()
    os.write(writing, content)
    os.close(writing)
    return f"/dev/fd/{reading}", reading


@pytest.mark.skipif(not os.path.isdir("/dev/fd"), reason="pipes have no paths on this system")
def test_a_pipe_is_read_up_to_the_limit(monkeypatch):
    monkeypatch.setattr(reading, "_PIECE", 4)
    path, number = pipe_of(b"a" * 20)
    assert read_bytes(path, 20) == b"a" * 20
    os.close(number)
    path, number = pipe_of(b"a" * 20)
    with pytest.raises(ReadError, match="it has more than 19 bytes; allowed are 19; set KNODE"):
        read_bytes(path, 19)
    os.close(number)


@pytest.mark.skipif(not os.path.exists("/dev/zero"), reason="there is no endless file on this system")
def test_an_endless_file_ends():
    with pytest.raises(ReadError, match="it has more than 1000 bytes"):
        read_bytes("/dev/zero", 1000)


def test_reasons_are_one_line(tmp_path):
    path = tmp_path / "it"
    with pytest.raises(ReadError, match=r"^no such file$"):
        read_bytes(path, 10)
    with pytest.raises(ReadError, match=r"^cannot be read: Is a directory$"):
        read_bytes(tmp_path, 10**9)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ReadError, match=r"^it is not UTF-8 text$"):
        read_text(path, 10)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "not JSON"),
        ("[" * 100_000, "nested too deeply"),
        ("1" * 10_000, "not JSON"),
        (b"\xff", "not JSON"),
    ],
)
def test_json(text, reason):
    with pytest.raises(ReadError, match=reason):
        parse_json(text)
