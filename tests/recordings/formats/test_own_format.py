"""A format of recordings in one place: defined, registered, and then read, written and listed like others."""

import numpy as np
import pandas as pd
import pytest

import knode_cosserat as kc
from knode_cosserat.recordings import formats, load_example
from knode_cosserat.recordings.formats import RecordingFormat, Table, register
from knode_cosserat.recordings.table import columns_and_metadata
from tests.commands import succeeded

MARK = "tip path\n"


def read(path, wanted):
    """Return lines of a time, two tensions and the tip's position."""
    rows = np.loadtxt(path.read_text().splitlines()[1:], ndmin=2)
    titles = ["time [s]", "tension_1 [N]", "tension_2 [N]", "tip_x [m]", "tip_y [m]", "tip_z [m]"]
    return Table({"source": f"{path.name}, a path"}, pd.DataFrame(rows, columns=titles))


def write(path, outgoing):
    """Write a line for each row."""
    table, _ = columns_and_metadata(outgoing)
    path.write_text(MARK + "".join(" ".join(map(repr, row)) + "\n" for row in table.to_numpy().tolist()))


@pytest.fixture
def tip_path(monkeypatch):
    monkeypatch.setattr(formats, "_registered", list(formats.formats()))
    kind = RecordingFormat(
        "tip path",
        recognise=lambda head: head.startswith(MARK.encode()),
        read=read,
        suffixes=(".path",),
        write=write,
        written=(".path",),
    )
    register(kind)
    return kind


def test_a_registered_format_is_read_inspected_written_and_listed(tip_path, tmp_path):
    time = np.arange(0.0, 2.0, 0.02)
    rows = np.stack([time, 5 + np.sin(time), 5 - np.sin(time), 0.1 * np.sin(time), 0 * time, 0.4 + 0 * time])
    # the content decides, not the name
    path = tmp_path / "it.txt"
    path.write_text(MARK + "\n".join(" ".join(map(repr, row)) for row in rows.T.tolist()))
    recording = kc.load_recording(path)
    assert recording.source == "it.txt, a path"
    np.testing.assert_allclose(recording.bodies[0].position[:, 0], rows[3])
    np.testing.assert_allclose(recording.control.values, rows[1:3].T)
    assert "it.txt, a path" in succeeded("inspect", path)
    assert ".path" in formats.read_suffixes()
    measured = recording.sampled(0.05)
    path = tmp_path / "back.path"
    kc.recordings.Measurements(**{**vars(measured), "quaternion": measured.quaternion * np.nan}).save(path)
    config = kc.recordings.RecordingConfig.load(path.with_suffix(".yaml"))
    assert config.markers[0].name == "tip"
    assert path.read_text().startswith(MARK)
    assert formats.format_of(path) is tip_path
    with pytest.raises(kc.recordings.RecordingError, match=r"ends in \.bag, .*\.path, .*\.csv"):
        load_example().sampled(0.05).save(tmp_path / "it.nothing")
