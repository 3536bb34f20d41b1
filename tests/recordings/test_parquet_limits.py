"""Parquet files that are small and stand for much: refused before they are decoded."""

import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from knode_cosserat._files import parquet_file
from knode_cosserat.recordings import RecordingError, load_recording
from knode_cosserat.recordings.formats import parquet

pyarrow = pytest.importorskip("pyarrow")
pyarrow_parquet = pytest.importorskip("pyarrow.parquet")
TITLES = ("time [s]", "tension_1 [N]", "tip_x [m]", "tip_y [m]", "tip_z [m]")


def written(path, columns, **options):
    pyarrow_parquet.write_table(pyarrow.table(columns), path, **options)
    return path


def good(count=50):
    time = 0.05 * np.arange(count)
    values = (time, 5.0 + np.sin(time), 0.1 * np.sin(time), 0.0 * time, 0.4 + 0.0 * time)
    return dict(zip(TITLES, values, strict=True))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": "zstd", "row_group_size": 7},
        {"compression": "gzip", "data_page_version": "2.0", "use_dictionary": False},
        {"compression": "none", "write_page_index": True, "data_page_size": 100, "write_page_checksum": True},
        {"use_dictionary": False, "use_byte_stream_split": True},
    ],
)
def test_files_of_all_kinds_are_read(tmp_path, options):
    path = written(tmp_path / "it.parquet", good(), **options)
    said, numbers, findings = parquet.read_parquet(path)[:3]
    assert said == {} and findings == () and tuple(numbers.columns) == TITLES
    for name, values in good().items():
        np.testing.assert_array_equal(numbers[name], values)


def test_runs_of_one_value_are_refused_before_they_are_written_out(tmp_path):
    """Fifteen million rows in 340 kB: 600 MB of numbers."""
    path = tmp_path / "it.parquet"
    same = np.zeros(1_000_000)
    schema = pyarrow.schema([(name, pyarrow.float64()) for name in TITLES])
    with pyarrow_parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        for _ in range(15):
            writer.write_table(pyarrow.table(dict.fromkeys(TITLES, same)))
    assert path.stat().st_size < 400_000
    with pytest.raises(RecordingError, match="its columns have 600000000 bytes; allowed are 100 times"):
        load_recording(path)


def test_too_many_rows_and_columns_are_refused(tmp_path):
    path = tmp_path / "it.parquet"
    schema = pyarrow.schema([("time [s]", pyarrow.bool_())])
    with pyarrow_parquet.ParquetWriter(path, schema) as writer:
        for _ in range(21):
            writer.write_table(pyarrow.table({"time [s]": np.zeros(1_000_000, dtype=bool)}))
    with pytest.raises(RecordingError, match="it has 21000000 rows; allowed are 20000000"):
        load_recording(path)
    written(path, {f"c{k}": [1.0] for k in range(1001)})
    with pytest.raises(RecordingError, match="it has 1001 columns; allowed are 1000"):
        load_recording(path)


def test_a_page_that_expands_to_much_is_refused(tmp_path, monkeypatch):
    """A column's page of zeros, whose stated rows are few enough."""
    path = written(
        tmp_path / "it.parquet",
        dict.fromkeys(TITLES, np.zeros(20_000)),
        use_dictionary=False,
        compression="zstd",
    )
    monkeypatch.setattr(parquet_file, "RATIO", 1)
    monkeypatch.setattr(parquet_file, "ALLOWANCE", 8 * 20_000 * len(TITLES) - path.stat().st_size)
    with pytest.raises(RecordingError, match=r"its pages expand to \d+ bytes; allowed are 1 times the file"):
        load_recording(path)


def test_a_large_file_is_not_opened(tmp_path):
    path = tmp_path / "it.parquet"
    with path.open("wb") as file:
        file.write(parquet.MAGIC)
        file.truncate(parquet_file.LARGEST_FILE + 1)
    with pytest.raises(RecordingError, match=f"bytes; allowed are {parquet_file.LARGEST_FILE}"):
        load_recording(path)


@pytest.mark.parametrize(
    ("column", "what"),
    [
        (["a"] * 50, "has string; allowed are numbers"),
        ([[1.0, 2.0]] * 50, "has lists; allowed are numbers"),
        ([{"a": 1.0}] * 50, "has lists; allowed are numbers"),
        (pd.date_range("2026-01-01", periods=50), "has timestamp; allowed are numbers"),
        (pyarrow.array(np.arange(50), pyarrow.duration("ns")), r"has duration\[ns\]; allowed are numbers"),
    ],
)
def test_columns_without_numbers_are_refused(tmp_path, column, what):
    with pytest.raises(RecordingError, match=what):
        load_recording(written(tmp_path / "it.parquet", good() | {"time [s]": column}))


BOUNDED = """
import resource
import sys
from pathlib import Path
from knode_cosserat.recordings import RecordingError, load_recording
import pyarrow.parquet
pages = int(Path("/proc/self/statm").read_text().split()[0])
limit = pages * resource.getpagesize() + 1_500_000_000
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
try:
    load_recording(sys.argv[1])
except RecordingError as error:
    print(error)
"""


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="the memory of a process is limited on Linux"
)
def test_a_page_whose_size_is_a_lie_is_not_allocated(tmp_path):
    """The header of a page claims 2 GB: the process may have 1.5 GB more than it begins with."""
    path = written(tmp_path / "it.parquet", good(), use_dictionary=False, compression="zstd")
    chunk = pyarrow_parquet.read_metadata(path).row_group(0).column(0)
    data = bytearray(path.read_bytes())
    # field 1 (type) and field 2 (expanded size), both zigzag varints: 0x15 type 0x15 size
    at = chunk.data_page_offset
    assert data[at] == data[at + 2] == 0x15
    size, end = 0, at + 3
    while True:
        size |= (data[end] & 0x7F) << (7 * (end - at - 3))
        end += 1
        if data[end - 1] < 0x80:
            break
    # the longer number takes the place of bytes of the page, which is damaged then
    lie = bytes([0xFE, 0xFF, 0xFF, 0xFF, 0x0F])
    data[at + 3 : at + 3 + len(lie) + (end - at - 3)] = lie + data[end : end + (end - at - 3)]
    path.write_bytes(data)

    done = subprocess.run([sys.executable, "-c", BOUNDED, path], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and "not a Parquet table" in done.stdout, done.stdout + done.stderr
