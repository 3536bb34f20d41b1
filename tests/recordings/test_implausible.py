"""Tables with rows that have no time, comments between rows, impossible tensions, and times in ms."""

import gzip

import numpy as np
import pytest
import typer.testing

from knode_cosserat.cli import app
from knode_cosserat.recordings import RecordingError, load_recording
from knode_cosserat.recordings.checks import implausible_tensions
from knode_cosserat.recordings.content import ALLOWANCE

ROWS = 40


def rows(dt=0.05, scale=1.0, count=ROWS):
    """Rows of a moving robot; `scale` multiplies the times."""
    time = np.arange(count) * dt
    # at rest in the beginning, which the orientation of bodies needs
    swing = 0.1 * np.sin(2.0 * np.maximum(0.0, np.arange(count) - 6) * dt)
    tensions = 5.0 + np.stack([swing, -swing], axis=1)
    values = np.column_stack([time * scale, tensions, swing, 0.0 * time, 0.4 + 0.0 * time])
    return [",".join(repr(value) for value in row) for row in values.tolist()]


def written(path, lines, title="tension"):
    header = f"time [s],{title}_1 [N],{title}_2 [N],tip_x [m],tip_y [m],tip_z [m]"
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


def messages(recording):
    return [str(finding) for finding in recording.findings]


def test_nothing_is_found_in_a_good_table(tmp_path):
    recording = load_recording(written(tmp_path / "it.csv", rows()))
    assert recording.findings == () and len(recording.control.time) == ROWS


def test_rows_without_a_time_are_a_finding(tmp_path):
    lines = rows()
    for k in (3, 7):
        lines[k] = "nan" + lines[k][lines[k].index(",") :]
    lines[9] = lines[9][lines[9].index(",") :]
    recording = load_recording(written(tmp_path / "it.csv", lines))
    assert messages(recording) == ["warning: 3 rows have no time (4, 8, 10); left out"]
    assert len(recording.control.time) == ROWS - 3


def test_text_after_a_hash_is_a_finding(tmp_path):
    lines = rows()
    lines[4] = "#" + lines[4]
    lines[6] += " # the cable slipped"
    path = written(tmp_path / "it.csv", lines)
    path.write_text("# source: it\n\n# latency: 0.02\n" + path.read_text())
    recording = load_recording(path)
    assert recording.source == "it" and len(recording.control.time) == ROWS - 1
    assert messages(recording) == [
        "warning: 1 line begins with # after the header (9); left out",
        "warning: 1 line has a # (11); the text after it is left out",
    ]
    # the command that looks at a recording prints them
    found = typer.testing.CliRunner().invoke(app, ["inspect", str(path)])
    assert found.exit_code == 0 and "1 line begins with # after the header" in found.output


@pytest.mark.parametrize("value", [-500.0, 500.0])
def test_a_tension_that_no_tendon_has_is_left_out(tmp_path, value):
    lines = rows()
    cells = lines[10].split(",")
    lines[10] = ",".join([cells[0], repr(value), *cells[2:]])
    recording = load_recording(written(tmp_path / "it.csv", lines))
    (finding,) = recording.findings
    assert finding.severity == "warning" and finding.times == (0.5,) and finding.topic == "tension"
    assert finding.message == (
        f"1 row has a tension that is not plausible, {value:g} N among tensions of 5 N; left out"
    )
    assert np.all(np.abs(recording.control.values - 5.0) < 0.2)
    # a held tension lasts until the next row: it is kept, and said to be doubtful
    recording = load_recording(written(tmp_path / "it.csv", lines, "held_tension"))
    (finding,) = recording.findings
    assert finding.severity == "problem" and finding.message.endswith("among tensions of 5 N; kept")
    assert np.any(recording.control.values == value)


@pytest.mark.parametrize(
    ("tensions", "wrong"),
    [
        ([5.0, 5.0, 40.0, 5.0], []),  # a strong pull
        ([0.2, 0.2, 100.0, 0.2], []),  # a strong pull among slack tendons
        ([5.0, 5.0, -0.4, 5.0], []),  # a load cell's offset
        ([5.0, 5.0, -6.0, 5.0], [2]),
        ([5.0, 5.0, 150.0, 5.0], [2]),
        ([80.0, 80.0, 150.0, 80.0], []),
        ([-5.0, -5.0, -500.0, -5.0], []),  # the sign is wrong; this is another finding
        ([0.0, 0.0, 0.0, 0.0], []),
        ([5.0, -6.0, -6.0, 5.0], []),  # too many for an accident
    ],
)
def test_implausible_tensions(tensions, wrong):
    assert np.flatnonzero(implausible_tensions(np.array(tensions)[:, None])).tolist() == wrong


@pytest.mark.parametrize("dt", [0.001, 0.02, 0.05])
def test_times_in_milliseconds_are_a_finding(tmp_path, dt):
    recording = load_recording(written(tmp_path / "it.csv", rows(dt, 1e3)))
    (finding,) = recording.findings
    assert finding.severity == "problem"
    assert f"poses are {1e3 * dt:g} s apart" in finding.message and "are the times in ms?" in finding.message


@pytest.mark.parametrize(
    ("scale", "start", "unit"), [(1e6, 0.0, "µs"), (1e9, 0.0, "ns"), (1e3, 1.7e12, "ms"), (1e9, 1.7e18, "ns")]
)
def test_times_that_cannot_be_seconds_are_refused(tmp_path, scale, start, unit):
    lines = rows(0.02, scale)
    if start:
        lines = [f"{start + float(line.split(',')[0])!r}{line[line.index(',') :]}" for line in lines]
    with pytest.raises(RecordingError, match=rf"allowed is up to .*\. Are the times in {unit}\?$"):
        load_recording(written(tmp_path / "it.csv", lines))


def test_a_small_compressed_table_does_not_fill_the_memory(tmp_path):
    path = tmp_path / "it.csv.gz"
    path.write_bytes(gzip.compress(b"0" * (2 * ALLOWANCE), 9))
    assert path.stat().st_size < 100_000
    with pytest.raises(RecordingError, match="when decompressed; allowed are 200 times the file"):
        load_recording(path)
