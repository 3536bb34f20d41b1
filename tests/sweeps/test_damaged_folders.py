"""Folders of sweeps with damaged, changed or foreign files, and a full disk."""

import hashlib
import json
import os
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from knode_cosserat.sweeps import SweepError, load_sweep, run_sweep
from knode_cosserat.sweeps._shards import KEY, checksum, read_shard, require_pyarrow
from tests.sweeps.small_sweep import content, described

ROOT = Path(__file__).parents[2]


def read_or_reason(path):
    try:
        return read_shard(path)
    except SweepError as error:
        return str(error)


def rewritten(path, **changes):
    """Write a shard with other metadata."""
    pyarrow = require_pyarrow()
    table = pyarrow.parquet.read_table(path)
    about = json.loads(table.schema.metadata[KEY]) | changes
    if "sweep" in changes:
        columns = read_shard(path).columns
        about["checksum"] = checksum(columns, {k: it for k, it in about.items() if k != "checksum"})
    pyarrow.parquet.write_table(table.replace_schema_metadata({KEY: json.dumps(about).encode()}), path)


def test_a_shard_of_another_version_is_refused_and_stays(copied):
    path = copied / "shards" / "000001.parquet"
    rewritten(path, version=9)
    before = content(copied)
    for call in (lambda: run_sweep(described(), copied), lambda: load_sweep(copied).verify()):
        with pytest.raises(SweepError, match=r"000001\.parquet: the shard has the version 9; allowed is 2"):
            call()
    assert content(copied) == before


def test_a_shard_of_another_sweep_is_refused(copied):
    rewritten(copied / "shards" / "000001.parquet", sweep="other")
    for call in (lambda: run_sweep(described(), copied), lambda: load_sweep(copied)["length"]):
        with pytest.raises(SweepError, match="belongs to another sweep"):
            call()


def test_damaged_shards_are_told_and_solved_again(whole, copied):
    path = copied / "shards" / "000001.parquet"
    good, generator = path.read_bytes(), random.Random(3)
    damaged = [good[: len(good) // 2], b"", b"PAR1"]
    for _ in range(20):
        at = generator.randrange(len(good))
        damaged.append(good[:at] + bytes([good[at] ^ (1 << generator.randrange(8))]) + good[at + 1 :])
    for text in damaged:
        path.write_bytes(text)
        shard = read_or_reason(path)
        if isinstance(shard, str):
            assert str(path) in shard and "\n" not in shard
            continue
        # a change where no value depends on it, such as the name of the writer
        for name, values in read_shard(whole.folder / "shards" / "000001.parquet").columns.items():
            np.testing.assert_array_equal(shard.columns[name], values)
    path.write_bytes(good[: len(good) // 2])
    run_sweep(described(), copied, workers=1)
    assert content(copied) == content(whole.folder)


def signed(manifest):
    """Return a manifest's text with the checksum of its other keys."""
    digest = hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
    return json.dumps(manifest | {"checksum": digest})


def test_another_description_in_the_same_folder_is_refused(copied):
    with pytest.raises(SweepError, match="another sweep is here: its steps is 4; allowed is the same"):
        run_sweep(described(steps=5), copied)
    manifest = json.loads((copied / "sweep.json").read_text())
    del manifest["checksum"]
    for changes, message in (
        ({"made_by": manifest["made_by"] | {"jax": "0.1"}}, "begun with jax 0.1, and this is"),
        ({"version": 9}, "the sweep has the version 9; allowed is 1, which"),
        ({"format": "other"}, "not the manifest of a sweep"),
    ):
        (copied / "sweep.json").write_text(signed(manifest | changes))
        with pytest.raises(SweepError, match=message):
            run_sweep(described(), copied)
    (copied / "sweep.json").write_text(signed(manifest).replace('"seed": 0', '"seed": 1'))
    with pytest.raises(SweepError, match="damaged or changed: its contents do not have its checksum"):
        load_sweep(copied)
    (copied / "sweep.json").write_text("[" * 100_000)
    with pytest.raises(SweepError, match="damaged: its JSON is nested too deeply"):
        load_sweep(copied)
    (copied / "sweep.json").write_text("{")
    with pytest.raises(SweepError, match="damaged: not JSON"):
        load_sweep(copied)
    (copied / "sweep.json").unlink()
    with pytest.raises(SweepError, match="no sweep is here"):
        load_sweep(copied)
    with pytest.raises(SweepError, match=r"there are shards without their sweep\.json"):
        run_sweep(described(), copied)


@pytest.mark.slow
def test_a_disk_that_fills_up_loses_nothing(whole, copied, tmp_path):
    """The limit of a file's size stands for the full disk."""
    (copied / "shards" / "000002.parquet").unlink()
    before = content(copied)
    script = f"""
import resource, signal, sys
from pathlib import Path
from tests.sweeps.test_sweep import described
from knode_cosserat.sweeps import run_sweep
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
import jax
jax.config.update("jax_enable_compilation_cache", False)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
try:
    run_sweep(described(), Path({str(copied)!r}), workers=1)
except ValueError as error:
    print(error)
"""
    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'src'}"}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    assert "000002.parquet: cannot be written: File too large; complete shards are kept" in done.stdout
    assert content(copied) == before
    run_sweep(described(), copied, workers=1)
    assert content(copied) == content(whole.folder)
