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
from tests.limits import assert_limited, limited

ROWS = "".join(f"{k / 20},5,0.1,0,{0.4 + k / 1e3}\n" for k in range(20))
TABLE = f"time [s],tension_1 [N],tip_x [m],tip_y [m],tip_z [m]\n{ROWS}".encode()
MARKERS = np.random.default_rng(0).normal(size=(9, 5, 3))


# files, and functions that read them


def table(folder, data=TABLE, name="it.csv"):
    path = folder / name
    path.write_bytes(data)
    return path, lambda: load.load_recording(path)


def packed(folder):
    return table(folder, gzip.compress(TABLE), "it.csv.gz")


def sampled(folder):
    path, _ = table(folder)
    return path, lambda: load.load_recording(path).sampled(0.05)


def beam(folder):
    rows = np.column_stack([0.01 * np.arange(60), np.zeros((60, 18))])
    rows[30:, 1::3] -= 1.0
    titles = ["time_s", *(f"m{k}_{axis}_m" for k in range(6) for axis in "xyz")]
    path = folder / "beam_load52.csv"
    pd.DataFrame(rows, columns=titles).to_csv(path, index=False)
    return path, lambda: read_beam(path)


def bag(folder, name="it.bag"):
    path = folder / name
    load.load_example().sampled(0.05).save(path)
    config = RecordingConfig.load(path.with_suffix(".yaml"))
    return path, lambda: load.load_recording(path, config)


def sqlite_bag(folder):
    return bag(folder, "it.db3")


def columns_file(folder):
    pytest.importorskip("pyarrow")
    path = folder / "it.parquet"
    pd.DataFrame({f"c{k}": np.arange(50.0) for k in range(5)}).to_parquet(path)
    return path, lambda: parquet.read_parquet(path)


def pickled(folder):
    path, _ = table(folder, pickle.dumps(MARKERS))
    return path, lambda: pickles.read_pickled_array(path)


def archive(folder):
    path = folder / "cable.npz"
    np.savez(path, train=MARKERS[None], eval=MARKERS[None])
    return path, lambda: cables.load_cables(folder)


@pytest.mark.parametrize(
    ("file", "module", "limits"),
    [
        # None: one byte less than the file has
        (table, csv_rows, {"LARGEST_FILE": None}),
        (table, csv_rows, {"MOST_LINES": 20}),
        (table, csv_rows, {"MOST_COLUMNS": 4}),
        (packed, csv_rows, {"LARGEST_FILE": len(gzip.compress(TABLE)) + 1}),
        (packed, content, {"RATIO": 1, "ALLOWANCE": 0}),
        (sampled, recording, {"MOST_ROWS": 15}),
        (beam, csv_rows, {"LARGEST_FILE": None}),
        (bag, content, {"LARGEST_BAG": None}),
        (sqlite_bag, content, {"LARGEST_BAG": None}),
        (columns_file, parquet_file, {"LARGEST_FILE": None}),
        (columns_file, parquet_file, {"MOST_COLUMNS": 4}),
        (columns_file, parquet_file, {"MOST_ROWS": 49}),
        (columns_file, parquet_file, {"RATIO": 0, "ALLOWANCE": 8 * 50 * 5 - 1}),
        (columns_file, parquet_file, {"MOST_ENTRIES": 5}),
        (columns_file, parquet_file, {"LONGEST_TEXT": 400}),
        (pickled, pickles, {"LARGEST_FILE": None}),
        (pickled, pickles, {"MOST_NUMBERS": MARKERS.size - 1}),
        (archive, cables, {"LARGEST_FILE": MARKERS.nbytes // 2}),
    ],
)
def test_a_refusal_names_the_setting_and_the_setting_allows_the_file(
    tmp_path, monkeypatch, file, module, limits
):
    assert_limited(limited(file, module, limits), tmp_path, monkeypatch)
