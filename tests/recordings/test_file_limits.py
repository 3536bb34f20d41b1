"""Limits of files of recordings: tables, bags, Parquet, pickles and archives."""

import gzip
import pickle

import numpy as np
import pandas as pd
import pytest

from knode_cosserat._files import csv_rows, parquet_file
from knode_cosserat.recordings import content, load, recording
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.formats import parquet
from studies.beam import read_beam
from studies.cables import pickles
from studies.cables import recordings as cables
from tests.limits import Readers, assert_limited, limit_size

READERS = Readers()
ROWS = "".join(f"{k / 20},5,0.1,0,{0.4 + k / 1e3}\n" for k in range(20))
TABLE = f"time [s],tension_1 [N],tip_x [m],tip_y [m],tip_z [m]\n{ROWS}".encode()
MARKERS = np.random.default_rng(0).normal(size=(9, 5, 3))


def table(folder, data=TABLE, name="it.csv"):
    path = folder / name
    path.write_bytes(data)
    return path


@READERS
def table_size(folder, patch):
    patch.setattr(csv_rows, "LARGEST_FILE", len(TABLE) - 1)
    return lambda: load.load_recording(table(folder))


@READERS
def table_lines(folder, patch):
    patch.setattr(csv_rows, "MOST_LINES", 20)
    return lambda: load.load_recording(table(folder))


@READERS
def table_columns(folder, patch):
    patch.setattr(csv_rows, "MOST_COLUMNS", 4)
    return lambda: load.load_recording(table(folder))


@READERS
def table_size_when_decompressed(folder, patch):
    packed = gzip.compress(TABLE)
    patch.setattr(csv_rows, "LARGEST_FILE", len(packed) + 1)
    return lambda: load.load_recording(table(folder, packed, "it.csv.gz"))


@READERS
def gzip_expansion(folder, patch):
    patch.setattr(content, "RATIO", 1)
    patch.setattr(content, "ALLOWANCE", 0)
    return lambda: load.load_recording(table(folder, gzip.compress(TABLE), "it.csv.gz"))


@READERS
def rows_of_a_recording(folder, patch):
    patch.setattr(recording, "MOST_ROWS", 15)
    return lambda: load.load_recording(table(folder)).sampled(0.05)


@READERS
def beam_size(folder, patch):
    rows = np.column_stack([0.01 * np.arange(60), np.zeros((60, 18))])
    rows[30:, 1::3] -= 1.0
    titles = ["time_s", *(f"m{k}_{axis}_m" for k in range(6) for axis in "xyz")]
    path = folder / "beam_load52.csv"
    pd.DataFrame(rows, columns=titles).to_csv(path, index=False)
    limit_size(patch, csv_rows, path)
    return lambda: read_beam(path)


@READERS
def bag_size(folder, patch):
    path = folder / "it.bag"
    load.load_example().sampled(0.05).save(path)
    config = RecordingConfig.load(path.with_suffix(".yaml"))
    patch.setattr(content, "LARGEST_BAG", path.stat().st_size - 1)
    return lambda: load.load_recording(path, config)


@READERS
def sqlite_bag_size(folder, patch):
    path = folder / "it.db3"
    load.load_example().sampled(0.05).save(path)
    config = RecordingConfig.load(path.with_suffix(".yaml"))
    patch.setattr(content, "LARGEST_BAG", path.stat().st_size - 1)
    return lambda: load.load_recording(path, config)


def columns_file(folder):
    pytest.importorskip("pyarrow")
    path = folder / "it.parquet"
    pd.DataFrame({f"c{k}": np.arange(50.0) for k in range(5)}).to_parquet(path)
    return path


@READERS
def parquet_size(folder, patch):
    path = columns_file(folder)
    limit_size(patch, parquet_file, path)
    return lambda: parquet.read_parquet(path)


@READERS
def parquet_columns(folder, patch):
    patch.setattr(parquet_file, "MOST_COLUMNS", 4)
    return lambda: parquet.read_parquet(columns_file(folder))


@READERS
def parquet_rows(folder, patch):
    patch.setattr(parquet_file, "MOST_ROWS", 49)
    return lambda: parquet.read_parquet(columns_file(folder))


@READERS
def parquet_expansion(folder, patch):
    patch.setattr(parquet_file, "RATIO", 0)
    patch.setattr(parquet_file, "ALLOWANCE", 8 * 50 * 5 - 1)
    return lambda: parquet.read_parquet(columns_file(folder))


@READERS
def parquet_entries_of_metadata(folder, patch):
    patch.setattr(parquet_file, "MOST_ENTRIES", 5)
    return lambda: parquet.read_parquet(columns_file(folder))


@READERS
def parquet_texts_of_metadata(folder, patch):
    patch.setattr(parquet_file, "LONGEST_TEXT", 400)
    return lambda: parquet.read_parquet(columns_file(folder))


@READERS
def pickle_size(folder, patch):
    path = table(folder, pickle.dumps(MARKERS))
    limit_size(patch, pickles, path)
    return lambda: pickles.read_pickled_array(path)


@READERS
def pickle_numbers(folder, patch):
    patch.setattr(pickles, "MOST_NUMBERS", MARKERS.size - 1)
    return lambda: pickles.read_pickled_array(table(folder, pickle.dumps(MARKERS)))


@READERS
def archive_of_cables(folder, patch):
    np.savez(folder / "cable.npz", train=MARKERS[None], eval=MARKERS[None])
    patch.setattr(cables, "LARGEST_FILE", MARKERS.nbytes // 2)
    return lambda: cables.load_cables(folder)


@pytest.mark.parametrize("name", READERS)
def test_a_refusal_names_the_setting_and_the_setting_allows_the_file(name, tmp_path, monkeypatch):
    assert_limited(READERS[name], tmp_path, monkeypatch)
