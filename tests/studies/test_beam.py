"""The study of the silicone beam, on an extract of the recordings (MIT, tests/files/beam/LICENSE)."""

import dataclasses
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from knode_cosserat.recordings.findings import RecordingError
from studies import beam
from studies.beam import (
    NOMINAL,
    THRESHOLD,
    Beam,
    Numerics,
    beam_rod,
    find_release,
    held_beam,
    identify_beam,
    load_of,
    marker_rmse,
    predict_markers,
    read_beam,
    shear_factor,
    step_count,
    tip_drop,
    torsion_constant,
)
from tests.commands import run_study

FOLDER = Path(__file__).parents[1] / "files" / "beam"
HELD_OUT = "beam_load52_V2_b"
#: coarse enough for a test
COARSE = Numerics(nodes=6, dt=5e-3)

matplotlib = pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="needs matplotlib")


@pytest.fixture(scope="module")
def recordings():
    return beam.read_folder(FOLDER)


def first_part(recording, seconds=0.8):
    """A recording up to so long after its release."""
    rows = recording.time < recording.crossing + seconds
    return dataclasses.replace(recording, time=recording.time[rows], tip=recording.tip[rows])


def changed(tmp_path, change, name="beam_load52_x.csv"):
    """A file that differs from a recording by what is done to its lines."""
    lines = (FOLDER / f"{HELD_OUT}.csv").read_text().splitlines()
    path = tmp_path / name
    path.write_text("\n".join(change(lines)) + "\n")
    return path


def test_constants_of_the_square_section():
    assert torsion_constant(1.0) == pytest.approx(0.140577, abs=1e-6)
    assert shear_factor(0.5) == pytest.approx(15.0 / 17.5)


@pytest.mark.parametrize(
    ("name", "load"), [("beam_gravity_V2_b", 0.0), ("beam_load52_V2_a", 0.052), ("beam_load7.5_c", 0.0075)]
)
def test_the_name_tells_the_load(name, load):
    assert load_of(name) == pytest.approx(load)


def test_the_release_is_found(recordings):
    crossings = {each.name: each.crossing for each in recordings}
    expected = {"beam_gravity_V2_b": 0.665, "beam_load52_V2_a": 0.450, HELD_OUT: 0.592}
    assert crossings == pytest.approx(expected, abs=0.01)
    for each in recordings:
        assert each.drop[0] == pytest.approx(0.0, abs=1e-4)


def test_neither_glitches_nor_lost_markers_nor_creep_are_a_release():
    time = 0.01 * np.arange(200)
    tip = np.zeros((200, 3, 3))
    tip[:, :, 0] = -np.where(time > 1.2, 5e-2 * (time - 1.2), 0.0)[:, None]
    crossing, held = find_release(time, tip, "x")
    assert crossing == pytest.approx(1.2 + THRESHOLD / 5e-2) and 90 < held < 120
    tip[40, :, 0] = -0.03
    tip[60:70, 1] = np.nan
    tip[:, :, 0] -= np.minimum(time, 1.0)[:, None] * 5e-4
    assert find_release(time, tip, "x")[0] == pytest.approx(crossing, abs=5e-3)
    with pytest.raises(RecordingError, match="no release found"):
        find_release(time, np.zeros((200, 3, 3)), "x")


def test_bad_recordings_are_named_in_one_line(tmp_path):
    missing = changed(tmp_path, lambda lines: [line.rpartition(",")[0] for line in lines])
    with pytest.raises(RecordingError, match="the column m5_z_m is missing"):
        read_beam(missing)
    with pytest.raises(RecordingError, match="no release found"):
        read_beam(changed(tmp_path, lambda lines: lines[:20]))
    nameless = changed(tmp_path, lambda lines: lines, "beam_run3.csv")
    with pytest.raises(RecordingError, match=r"tells no load.*--load NAME=GRAMS"):
        read_beam(nameless)
    assert read_beam(nameless, 0.03).load == 0.03
    with pytest.raises(RecordingError, match="time_s does not grow"):
        read_beam(changed(tmp_path, lambda lines: [lines[0], *lines[:0:-1]]))


def test_the_default_training_recordings(recordings):
    assert beam.training_names(recordings) == ["beam_gravity_V2_b", "beam_load52_V2_a"]


@pytest.mark.campaign
def test_the_held_out_recording_is_predicted(recordings):
    recordings = [first_part(each) for each in recordings]
    train = [each for each in recordings if each.name != HELD_OUT]
    steps = step_count(recordings, COARSE.dt)
    [held_out] = [each for each in recordings if each.name == HELD_OUT]
    found = identify_beam(train, steps, COARSE)
    assert 2.2e5 < found.youngs_modulus < 3.0e5 and 0.0 < found.tilt < 0.15
    rmse = {
        name: marker_rmse(predict_markers(each, held_out, steps, COARSE), held_out)
        for name, each in {"nominal": NOMINAL, "identified": found}.items()
    }
    # of the wildest part of the motion; of the whole recording 0.9 mm
    assert rmse["identified"] < 2e-3 and rmse["identified"] < 0.6 * rmse["nominal"], rmse


@pytest.mark.campaign
@matplotlib
def test_the_command_writes_errors_table_and_figure(tmp_path):
    result = run_study("beam", FOLDER, "--out", tmp_path, "--json")
    assert result.exit_code == 0, result.stderr
    cells = json.loads((tmp_path / "beam.json").read_text())
    assert len(cells) == 6 and {cell["method"] for cell in cells} == {"nominal", "identified"}
    [best] = [it for it in cells if it["file"] == f"{HELD_OUT}.csv" and it["method"] == "identified"]
    assert best["use"] == "held out" and best["rmse"] < 1.5e-3
    assert HELD_OUT in (tmp_path / "beam.md").read_text()
    assert (tmp_path / "figures" / "beam.png").exists()


@pytest.mark.slow
def test_the_held_beam_is_at_its_height():
    rod = beam_rod(dataclasses.replace(NOMINAL, tilt=0.1), 0.052, COARSE.nodes)
    held = held_beam(rod, 0.052, -1e-3)
    height = held.tip_position[0, 0] - rod.rest(0.1)[0][0]
    assert height == pytest.approx(-1e-3, abs=1e-5)
    assert isinstance(NOMINAL, Beam) and tip_drop(np.zeros((2, 3, 3))).shape == (2,)
