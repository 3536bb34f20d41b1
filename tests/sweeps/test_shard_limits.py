"""Limits of shards and manifests, and metadata that were changed."""

import json

import numpy as np
import pytest

from knode_cosserat._files import parquet_file
from knode_cosserat.sweeps import SweepError, _folder
from knode_cosserat.sweeps._shards import KEY, checksum, read_shard, shard_bytes
from tests.limits import Readers, assert_limited, limit_size

pyarrow = pytest.importorskip("pyarrow")
pyarrow_parquet = pytest.importorskip("pyarrow.parquet")

READERS = Readers()


def columns(rows=50, reason="no solution"):
    return {
        "case": np.arange(rows),
        "tip": np.random.default_rng(0).normal(size=(rows, 4, 3)),
        "reason": np.array([reason] * rows, dtype=object),
    }


def written(folder, given):
    path = folder / "000000.parquet"
    path.write_bytes(shard_bytes(given, {"failed": 1}))
    return path


def test_a_shard_is_read_as_it_was_written(tmp_path):
    given = columns()
    shard = read_shard(written(tmp_path, given))
    assert checksum(shard.columns, {}) == checksum(given, {}) and shard.about["failed"] == 1
    path = written(tmp_path, given)
    assert set(read_shard(path, ["tip"], verify=False).columns) == {"tip"}
    with pytest.raises(SweepError, match="damaged: it has no column z"):
        read_shard(path, ["z"], verify=False)
    pyarrow_parquet.write_table(pyarrow_parquet.read_table(path).drop_columns("reason"), path)
    with pytest.raises(SweepError, match="damaged: it has no column reason"):
        read_shard(path, ["case"], verify=False)


def test_a_long_text_that_all_rows_share_is_refused(tmp_path):
    """Two hundred thousand rows with a text of 10,000 characters: 2 GB in a file of 2 MB."""
    given = {"case": np.arange(200_000), "reason": np.array(["x" * 10_000] * 200_000, dtype=object)}
    path = tmp_path / "000000.parquet"
    metadata = pyarrow_parquet.read_schema(written(tmp_path, columns())).metadata
    reason = pyarrow.DictionaryArray.from_arrays(np.zeros(200_000, np.int32), ["x" * 10_000])
    table = pyarrow.table({"case": given["case"], "reason": reason}).replace_schema_metadata(metadata)
    pyarrow_parquet.write_table(table, path, compression="zstd")
    assert path.stat().st_size < 2_000_000
    with pytest.raises(SweepError, match="its texts have 2000000000 characters; allowed are 100 times"):
        read_shard(path)


def test_runs_of_one_value_are_refused(tmp_path):
    """Fifteen million numbers in lists of 300."""
    path = tmp_path / "000000.parquet"
    metadata = pyarrow_parquet.read_schema(written(tmp_path, columns())).metadata
    lists = pyarrow.FixedShapeTensorArray.from_numpy_ndarray(np.zeros((50_000, 300)))
    table = pyarrow.table({"tip": lists, "reason": [""] * len(lists)}).replace_schema_metadata(metadata)
    pyarrow_parquet.write_table(table, path, compression="zstd")
    assert path.stat().st_size < 100_000
    with pytest.raises(SweepError, match="its columns have 120400000 bytes; allowed are 100 times"):
        read_shard(path)


def test_changed_metadata_are_found(tmp_path):
    path = written(tmp_path, columns())
    table = pyarrow_parquet.read_table(path)
    for old, new in ((b'"failed": 1', b'"failed": 0'), (b'"version": 2', b'"version": 2, "more": 0')):
        text = table.schema.metadata[KEY]
        assert old in text
        pyarrow_parquet.write_table(table.replace_schema_metadata({KEY: text.replace(old, new)}), path)
        with pytest.raises(SweepError, match="damaged: its contents do not have its checksum"):
            read_shard(path, ["case"])
    pyarrow_parquet.write_table(table.replace_schema_metadata({KEY: b"[" * 100_000}), path)
    with pytest.raises(SweepError, match="its metadata are missing or damaged"):
        read_shard(path, ["case"], verify=False)


# the setting of the limits


def shard(folder):
    path = folder / "000000.parquet"
    columns = {"case": np.arange(50), "reason": np.array(["none"] * 50, dtype=object)}
    path.write_bytes(shard_bytes(columns, {}))
    return path


@READERS
def shard_size(folder, patch):
    path = shard(folder)
    limit_size(patch, parquet_file, path)
    return lambda: read_shard(path)


@READERS
def shard_expansion(folder, patch):
    path = shard(folder)
    patch.setattr(parquet_file, "RATIO", 0)
    patch.setattr(parquet_file, "ALLOWANCE", 799)
    return lambda: read_shard(path)


@READERS
def shard_texts(folder, patch):
    path = folder / "000000.parquet"
    path.write_bytes(shard_bytes({"reason": np.array(["x" * 100] * 50, dtype=object)}, {}))
    patch.setattr(parquet_file, "RATIO", 0)
    patch.setattr(parquet_file, "ALLOWANCE", 4_999)
    return lambda: read_shard(path)


@READERS
def manifest_size(folder, patch):
    manifest = {
        "format": _folder.FORMAT,
        "version": 1,
        "made_by": {},
        "machine": {},
        "identity": "",
        "sweep": {},
        "cases": 1,
        "shards": 1,
        "shard_cases": 1,
        "robots": [{"columns": {}}],
    }
    text = json.dumps(manifest | {"checksum": _folder.json_checksum(manifest)})
    (folder / "sweep.json").write_text(text)
    patch.setattr(_folder, "LARGEST_MANIFEST", len(text) - 1)
    return lambda: _folder.read_manifest(folder)


@pytest.mark.parametrize("name", READERS)
def test_a_refusal_names_the_setting_and_the_setting_allows_the_file(name, tmp_path, monkeypatch):
    assert_limited(READERS[name], tmp_path, monkeypatch)
