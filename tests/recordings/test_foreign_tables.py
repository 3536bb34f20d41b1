"""Tables with other titles and without times: motors' angles, repeated poses, equilibria, compression."""

import gzip

import numpy as np
import pytest

from knode_cosserat.recordings import RecordingConfig, RecordingError, load_recording
from knode_cosserat.recordings.config import ControlSource, MarkerSource, TableSource

ROWS = 60
CONFIG = RecordingConfig(
    markers=(MarkerSource("tip", "3", 1.0),),
    angle=ControlSource("phi", (2, 1), "deg"),
    table=TableSource(rate=100.0, position=("x{}", "y{}", "z{}"), control="phi{}"),
    repeats="drop",
)


def table(positions, angles):
    lines = ["ID,x3,y3,z3,phi1,phi2"]
    rows = np.column_stack([positions, angles])
    lines += [f"{k}," + ",".join(map(repr, row.tolist())) for k, row in enumerate(rows)]
    return ("\n".join(lines) + "\n").encode()


def motion():
    time = 0.01 * np.arange(ROWS)
    rng = np.random.default_rng(0)
    position = np.stack([0.1 * np.sin(3 * time), 0.0 * time, 0.3 + 0.0 * time], axis=1)
    position = position + 5e-5 * rng.normal(size=position.shape)
    return position, np.degrees(np.stack([time, -2.0 * time], axis=1))


def test_titles_times_and_motors_of_another_laboratory(tmp_path):
    position, angles = motion()
    # a glitch, and motion capture that has lost the body and repeats its pose
    seen = position.copy()
    seen[20, 0] += 0.05
    seen[30:36] = seen[29]
    (tmp_path / "it.csv.gz").write_bytes(gzip.compress(table(seen, angles)))
    found = load_recording(tmp_path / "it.csv.gz", CONFIG)
    kept = np.delete(np.arange(ROWS), [20, *range(30, 36)])
    np.testing.assert_allclose(found.bodies[0].time, 0.01 * kept, atol=1e-9)
    np.testing.assert_allclose(found.bodies[0].position, position[kept], atol=1e-12)
    sampled = found.sampled(0.02)
    # motor 1 is in the second column, in rad
    np.testing.assert_allclose(sampled.control[:, 1], sampled.time, atol=1e-9)
    np.testing.assert_allclose(sampled.control[:, 0], -2.0 * sampled.time, atol=1e-9)
    assert not any("tension" in each.message for each in found.findings if each.severity == "problem")
    late = load_recording(
        tmp_path / "it.csv.gz", CONFIG.replace(angle=ControlSource("phi", (2, 1), "deg", latency=0.03))
    ).sampled(0.02, 0.1)
    np.testing.assert_allclose(late.control[:, 1], late.time - 0.03, atol=0.01 + 1e-9)


def test_rows_of_equilibria_are_as_they_are(tmp_path):
    rng = np.random.default_rng(1)
    position, angles = 0.2 * rng.normal(size=(9, 3)), 50.0 * rng.normal(size=(9, 2))
    (tmp_path / "it.csv").write_bytes(table(position, angles))
    found = load_recording(tmp_path / "it.csv", CONFIG.replace(static=True)).sampled(0.3, mean=True)
    assert found.static and len(found.time) == 9
    np.testing.assert_allclose(found.position[:, 0], position, atol=1e-12)
    np.testing.assert_allclose(found.control[:, [1, 0]], np.radians(angles), atol=1e-12)


def test_bad_settings_and_files_are_said(tmp_path):
    with pytest.raises(RecordingError, match="position is"):
        TableSource(position=("x", "y", "z"))
    with pytest.raises(RecordingError, match="the topic phi is there twice"):
        CONFIG.replace(tension=ControlSource("phi", (1, 2)))
    with pytest.raises(RecordingError, match="static is 'yes'; allowed is true or false"):
        CONFIG.replace(static="yes")
    (tmp_path / "it.csv.gz").write_bytes(gzip.compress(b"x3,y3\n1,2\n")[:-4])
    with pytest.raises(RecordingError, match="cannot be decompressed"):
        load_recording(tmp_path / "it.csv.gz", CONFIG)
    (tmp_path / "it.csv").write_bytes(b"ID,x3,y3,z3,phi1\n0,1,2,3,4\n")
    with pytest.raises(RecordingError, match="the column phi2 is missing"):
        load_recording(tmp_path / "it.csv", CONFIG)
