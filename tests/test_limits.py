"""Limits of files: a refusal names the setting, and the setting allows the same file."""

import gzip
import json
import pickle
import zipfile
from typing import NamedTuple

import h5py
import hypothesis.strategies as st
import numpy as np
import pandas as pd
import pytest
from hypothesis import given

from knode_cosserat import controls, trajectory_integrity
from knode_cosserat._files import csv_rows, limits, parquet_file, yaml_text
from knode_cosserat._files.limits import MORE, VARIABLE, LimitSettingError, allowed, excess
from knode_cosserat.cli.control import parsed_reference
from knode_cosserat.envs import policy
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.learning.files import container, unpacking
from knode_cosserat.recordings import cables, load, parquet, pickles, recording
from knode_cosserat.recordings.beam import read_beam
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.sweeps import manifest as manifests
from knode_cosserat.sweeps import shard_file

TITLE = container.Title("test", 1)
ROWS = "".join(f"{k / 20},5,0.1,0,{0.4 + k / 1e3}\n" for k in range(20))
TABLE = f"time [s],tension_1 [N],tip_x [m],tip_y [m],tip_z [m]\n{ROWS}".encode()
MARKERS = np.random.default_rng(0).normal(size=(9, 5, 3))


@pytest.fixture(autouse=True)
def unset(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)


# readers: each returns a function that reads a file above a limit, but not above ten times the limit

READERS = {}


def reader(function):
    READERS[function.__name__] = function
    return function


@reader
def yaml_characters(folder, patch):
    patch.setattr(yaml_text, "MOST_CHARACTERS", 10)
    return lambda: yaml_text.mapping_of("a: 12345678", "a")


@reader
def yaml_bytes(folder, patch):
    patch.setattr(yaml_text, "MOST_CHARACTERS", 3)
    path = table(folder, b"a: 1234567890", "it.yaml")
    return lambda: yaml_text.read_yaml(path)


@reader
def yaml_aliases(folder, patch):
    patch.setattr(yaml_text, "MOST_VALUES", 5)
    return lambda: yaml_text.mapping_of("a: &a [1, 2]\nb: *a", "a")


def tensions(folder):
    path = folder / "tensions.csv"
    controls.save(path, np.full((30, 4), 5.0), 0.05)
    return path


@reader
def controls_size(folder, patch):
    path = tensions(folder)
    patch.setattr(csv_rows, "LARGEST_FILE", path.stat().st_size - 1)
    return lambda: controls.load(path)


@reader
def controls_lines(folder, patch):
    patch.setattr(csv_rows, "MOST_LINES", 30)
    return lambda: controls.load(tensions(folder))


@reader
def controls_columns(folder, patch):
    patch.setattr(csv_rows, "MOST_COLUMNS", 4)
    return lambda: controls.load(tensions(folder))


@reader
def controls_steps(folder, patch):
    patch.setattr(csv_rows, "MOST_STEPS", 100)
    return lambda: controls.load(tensions(folder), 0.005)


def table(folder, data=TABLE, name="it.csv"):
    path = folder / name
    path.write_bytes(data)
    return path


@reader
def table_size(folder, patch):
    patch.setattr(csv_rows, "LARGEST_FILE", len(TABLE) - 1)
    return lambda: load.load_recording(table(folder))


@reader
def table_lines(folder, patch):
    patch.setattr(csv_rows, "MOST_LINES", 20)
    return lambda: load.load_recording(table(folder))


@reader
def table_columns(folder, patch):
    patch.setattr(csv_rows, "MOST_COLUMNS", 4)
    return lambda: load.load_recording(table(folder))


@reader
def table_size_when_decompressed(folder, patch):
    packed = gzip.compress(TABLE)
    patch.setattr(csv_rows, "LARGEST_FILE", len(packed) + 1)
    return lambda: load.load_recording(table(folder, packed, "it.csv.gz"))


@reader
def gzip_expansion(folder, patch):
    patch.setattr(load, "RATIO", 1)
    patch.setattr(load, "ALLOWANCE", 0)
    return lambda: load.load_recording(table(folder, gzip.compress(TABLE), "it.csv.gz"))


@reader
def rows_of_a_recording(folder, patch):
    patch.setattr(recording, "MOST_ROWS", 15)
    return lambda: load.load_recording(table(folder)).sampled(0.05)


@reader
def reference_size(folder, patch):
    patch.setattr(csv_rows, "LARGEST_FILE", 20)
    path = table(folder, b"t,x,y\n0,0.1,0.1\n1,0.1,0.2\n")
    return lambda: parsed_reference(str(path))


@reader
def beam_size(folder, patch):
    rows = np.column_stack([0.01 * np.arange(60), np.zeros((60, 18))])
    rows[30:, 1::3] -= 1.0
    titles = ["time_s", *(f"m{k}_{axis}_m" for k in range(6) for axis in "xyz")]
    path = folder / "beam_load52.csv"
    pd.DataFrame(rows, columns=titles).to_csv(path, index=False)
    patch.setattr(csv_rows, "LARGEST_FILE", path.stat().st_size - 1)
    return lambda: read_beam(path)


@reader
def bag_size(folder, patch):
    path = folder / "it.bag"
    load.load_example().sampled(0.05).save(path)
    config = RecordingConfig.load(path.with_suffix(".yaml"))
    patch.setattr(load, "LARGEST_BAG", path.stat().st_size - 1)
    return lambda: load.load_recording(path, config)


@reader
def sqlite_bag_size(folder, patch):
    path = folder / "it.db3"
    load.load_example().sampled(0.05).save(path)
    config = RecordingConfig.load(path.with_suffix(".yaml"))
    patch.setattr(load, "LARGEST_BAG", path.stat().st_size - 1)
    return lambda: load.load_recording(path, config)


def shard(folder):
    pytest.importorskip("pyarrow")
    path = folder / "000000.parquet"
    columns = {"case": np.arange(50), "reason": np.array(["none"] * 50, dtype=object)}
    path.write_bytes(shard_file.shard_bytes(columns, {}))
    return path


@reader
def shard_size(folder, patch):
    path = shard(folder)
    patch.setattr(parquet_file, "LARGEST_FILE", path.stat().st_size - 1)
    return lambda: shard_file.read_shard(path)


@reader
def shard_expansion(folder, patch):
    path = shard(folder)
    patch.setattr(parquet_file, "RATIO", 0)
    patch.setattr(parquet_file, "ALLOWANCE", 799)
    return lambda: shard_file.read_shard(path)


@reader
def shard_texts(folder, patch):
    pytest.importorskip("pyarrow")
    path = folder / "000000.parquet"
    path.write_bytes(shard_file.shard_bytes({"reason": np.array(["x" * 100] * 50, dtype=object)}, {}))
    patch.setattr(parquet_file, "RATIO", 0)
    patch.setattr(parquet_file, "ALLOWANCE", 4_999)
    return lambda: shard_file.read_shard(path)


@reader
def manifest_size(folder, patch):
    manifest = {
        "format": manifests.FORMAT, "version": 2, "identity": "", "sweep": {}, "cases": 1, "shards": 1,
        "shard_cases": 1, "robots": [{"columns": {}}],
    }  # fmt: skip
    text = json.dumps(manifest | {"checksum": manifests._checksum(manifest)})
    (folder / "sweep.json").write_text(text)
    patch.setattr(manifests, "LARGEST_MANIFEST", len(text) - 1)
    return lambda: manifests.read_manifest(folder)


def columns_file(folder):
    pytest.importorskip("pyarrow")
    path = folder / "it.parquet"
    parquet.write_parquet(path, pd.DataFrame({f"c{k}": np.arange(50.0) for k in range(5)}), {})
    return path


@reader
def parquet_size(folder, patch):
    path = columns_file(folder)
    patch.setattr(parquet_file, "LARGEST_FILE", path.stat().st_size - 1)
    return lambda: parquet.read_parquet(path)


@reader
def parquet_columns(folder, patch):
    patch.setattr(parquet_file, "MOST_COLUMNS", 4)
    return lambda: parquet.read_parquet(columns_file(folder))


@reader
def parquet_rows(folder, patch):
    patch.setattr(parquet_file, "MOST_ROWS", 49)
    return lambda: parquet.read_parquet(columns_file(folder))


@reader
def parquet_expansion(folder, patch):
    patch.setattr(parquet_file, "RATIO", 0)
    patch.setattr(parquet_file, "ALLOWANCE", 8 * 50 * 5 - 1)
    return lambda: parquet.read_parquet(columns_file(folder))


@reader
def parquet_entries_of_metadata(folder, patch):
    patch.setattr(parquet_file, "MOST_ENTRIES", 5)
    return lambda: parquet.read_parquet(columns_file(folder))


@reader
def parquet_texts_of_metadata(folder, patch):
    patch.setattr(parquet_file, "LONGEST_TEXT", 400)
    return lambda: parquet.read_parquet(columns_file(folder))


@reader
def pickle_size(folder, patch):
    path = table(folder, pickle.dumps(MARKERS))
    patch.setattr(pickles, "LARGEST_FILE", path.stat().st_size - 1)
    return lambda: pickles.read_pickled_array(path)


@reader
def pickle_numbers(folder, patch):
    patch.setattr(pickles, "MOST_NUMBERS", MARKERS.size - 1)
    return lambda: pickles.read_pickled_array(table(folder, pickle.dumps(MARKERS)))


@reader
def archive_of_cables(folder, patch):
    np.savez(folder / "cable.npz", train=MARKERS[None], eval=MARKERS[None])
    patch.setattr(cables, "LARGEST_FILE", MARKERS.nbytes // 2)
    return lambda: cables.load_cables(folder)


def saved_policy(folder, compress=False):
    path = folder / "policy.npz"
    layers = ((np.zeros((3, 500)), np.ones(500)), (np.zeros((500, 1)), np.ones(1)))
    policy.Policy(layers, np.zeros(3), np.ones(3)).save(path)
    if compress:
        with zipfile.ZipFile(path) as packed:
            content = {each: packed.read(each) for each in packed.namelist()}
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
            for name, data in content.items():
                packed.writestr(name, data)
    return path


@reader
def policy_size(folder, patch):
    path = saved_policy(folder)
    patch.setattr(policy, "LARGEST_FILE", path.stat().st_size - 1)
    return lambda: policy.Policy.load(path)


@reader
def policy_size_when_unpacked(folder, patch):
    path = saved_policy(folder, compress=True)
    with zipfile.ZipFile(path) as packed:
        size = sum(entry.file_size for entry in packed.infolist())
    patch.setattr(policy, "LARGEST_FILE", size - 1)
    return lambda: policy.Policy.load(path)


@reader
def policy_layers(folder, patch):
    patch.setattr(policy, "MOST_LAYERS", 1)
    return lambda: policy.Policy.load(saved_policy(folder))


class Thing(NamedTuple):
    """An object of a file."""

    x: int


def contained():
    writer = container.Writer()
    things = writer.value([Thing(k) for k in range(5)], "things", {"Thing": Thing})
    values = writer.value(np.arange(9.0), "values", {})
    return writer.file(TITLE, {"things": things, "values": values})


@reader
def model_size(folder, patch):
    patch.setattr(container, "MOST_HEADER", 0)
    patch.setattr(container, "MOST_ARRAYS", 100)
    path = table(folder, bytes(500), "model")
    return lambda: container.read(path)


@reader
def model_header(folder, patch):
    data = contained()
    patch.setattr(unpacking, "MOST_HEADER", 100)
    return lambda: unpacking.Reader(data, TITLE)


@reader
def model_objects(folder, patch):
    data = contained()
    patch.setattr(unpacking, "MOST_OBJECTS", 4)

    def read():
        opened = unpacking.Reader(data, TITLE)
        return opened.value(opened.header["things"], "things", {"Thing": Thing})

    return read


@reader
def objects_of_a_written_model(folder, patch):
    patch.setattr(container, "MOST_OBJECTS", 4)
    return contained


@reader
def header_of_a_written_model(folder, patch):
    patch.setattr(container, "MOST_HEADER", 100)
    return contained


@reader
def arrays_of_a_written_model(folder, patch):
    patch.setattr(container, "MOST_ARRAYS", 71)
    return contained


@reader
def trajectory_expansion(folder, patch):
    path = folder / "it.nc"
    with h5py.File(path, "w") as file:
        file.create_dataset("y", (1000,), "f8", chunks=(100,))
    patch.setattr(trajectory_integrity, "EXPANSION", 0)
    patch.setattr(trajectory_integrity, "ALLOWANCE", 7999)
    return lambda: trajectory_integrity.require_own_data(path)


@pytest.mark.parametrize("name", READERS)
def test_a_refusal_names_the_setting_and_the_setting_allows_the_file(name, tmp_path, monkeypatch):
    read = READERS[name](tmp_path, monkeypatch)
    with pytest.raises(KnodeCosseratError) as refused:
        read()
    message = str(refused.value)
    assert message.endswith(MORE) and VARIABLE in MORE and "\n" not in message
    monkeypatch.setenv(VARIABLE, "10")
    read()
    monkeypatch.setenv(VARIABLE, "ten")
    with pytest.raises(LimitSettingError, match=f"^{VARIABLE} must be a finite number above 0 "):
        read()


# the setting


@pytest.mark.parametrize("text", ["ten", "0", "-1", "nan", "inf", "1e999", "10\n20", "x" * 1000])
def test_a_wrong_setting_is_refused_in_one_line(monkeypatch, text):
    monkeypatch.setenv(VARIABLE, text)
    with pytest.raises(LimitSettingError) as refused:
        allowed(5)
    message = str(refused.value)
    assert message.startswith(f"{VARIABLE} must be a finite number above 0 (got ") and len(message) < 200
    assert "\n" not in message and isinstance(refused.value, ValueError)


def test_the_default_and_an_empty_setting_change_nothing(monkeypatch):
    assert allowed(1_000_000_000) == 1_000_000_000
    monkeypatch.setenv(VARIABLE, "")
    assert allowed(7) == 7 and excess(7, 7, "bytes") == ""
    assert excess(8, 7, "bytes") == f"it has 8 bytes; allowed are 7; {MORE}"


numbers, factors = st.integers(0, 2**40), st.floats(1e-9, 1e300)


@given(numbers, numbers, factors, factors)
def test_limits_grow_with_the_factor_and_are_integers_of_64_bits(one, other, factor, larger):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, repr(factor))
        low, high = sorted((one, other))
        found = allowed(low)
        assert type(found) is int and 0 <= found <= allowed(high) <= limits._LARGEST
        assert found == int(min(low * factor, limits._LARGEST))
        assert bool(excess(one, other, "rows")) == (one > allowed(other))
        patch.setenv(VARIABLE, repr(max(factor, larger)))
        assert found <= allowed(low)


def test_the_setting_changes_no_byte_of_a_file(monkeypatch):
    data = contained()
    monkeypatch.setenv(VARIABLE, "3")
    assert contained() == data
