"""Controls in time: a trajectory, its measurements and its table hold each tension over the same interval."""

import numpy as np
import pytest

import knode_cosserat as kc
from examples.hanging_string import HangingString
from knode_cosserat.identification.evaluate import evaluate
from knode_cosserat.recordings import RecordingConfig, RecordingError
from knode_cosserat.recordings.config import ControlSource

DT, BEFORE = 0.05, np.full(4, 5.0)
FRACTIONS = (0.25, 0.6, 1.0)


@pytest.fixture(scope="module")
def robot():
    return kc.load_robot("delrin-tendon-robot")


@pytest.fixture(scope="module")
def tensions():
    return kc.controls.random(30, seed=1, hold=2)


@pytest.fixture(scope="module")
def motion(robot, tensions):
    return kc.simulate(robot, tensions, DT, initial=kc.equilibrium(robot, BEFORE))


def test_row_k_is_held_from_row_k_to_the_next(robot, tensions, motion):
    np.testing.assert_array_equal(motion.held_tension[:-1], tensions)
    assert np.all(np.isnan(motion.held_tension[-1]))
    np.testing.assert_array_equal(motion.held_control, motion.held_tension)
    again = kc.simulate(robot, motion.held_control[:-1], DT, initial=motion[:1])
    np.testing.assert_allclose(again.tip_position, motion.tip_position, rtol=0, atol=1e-9)
    part = motion[10:20]
    np.testing.assert_array_equal(part.held_tension[:-1], tensions[10:19])


def test_what_would_be_off_by_a_row_is_an_error(motion, tmp_path):
    with pytest.raises(AttributeError, match=r"held_tension\[k\] acts from row k to row k \+ 1.*until row k"):
        _ = motion.tension
    with pytest.raises(ValueError, match="rows between were left out"):
        _ = motion[::2].held_control
    motion[::2].save(tmp_path / "thinned.nc")
    with pytest.raises(ValueError, match="rows between were left out"):
        kc.recordings.Measurements.of(kc.load_trajectory(tmp_path / "thinned.nc"))
    with pytest.raises(ValueError, match="finite"):
        kc.simulate(motion.system, motion.held_tension, DT)


@pytest.mark.parametrize("ending", ["csv", "parquet", "bag", "mcap", "db3"])
def test_a_simulation_goes_through_a_file_without_error(robot, tensions, motion, tmp_path, ending):
    if ending == "parquet":
        pytest.importorskip("pyarrow")
    seen = kc.recordings.Measurements.of(motion, FRACTIONS)
    seen.save(tmp_path / f"motion.{ending}")
    in_words = tmp_path / "motion.yaml"
    assert in_words.exists() == (ending in ("bag", "mcap", "db3"))
    config = kc.recordings.RecordingConfig.load(in_words) if in_words.exists() else None
    loaded = kc.load_recording(tmp_path / f"motion.{ending}", config)
    assert loaded.simulated is True and seen.source in loaded.source
    rows = loaded.sampled(DT)
    np.testing.assert_array_equal(rows.control[:-1], tensions)
    np.testing.assert_array_equal(rows.initial_control, BEFORE)
    np.testing.assert_allclose(rows.time, motion.time, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rows.position, seen.position, rtol=0, atol=1e-9)
    np.testing.assert_allclose(rows.quaternion, seen.quaternion, rtol=0, atol=1e-9)
    assert rows.complete.all() and len(rows.time) == len(motion.time)
    # the same robot under the same tensions: nothing is left but the solver's tolerance
    found = evaluate(robot, rows, space="lobatto2")  # the scheme of the simulation
    assert found.failed is None
    assert found.tip_rmse < 1e-8 and found.pose_mse < 1e-15
    # and a row off, it is another motion
    late = np.concatenate([rows.control[:1], rows.control[:-1]])
    assert evaluate(robot, kc.recordings.Measurements(**{**vars(rows), "control": late})).tip_rmse > 1e-3


def test_a_table_written_by_hand_says_by_its_titles_that_tensions_are_held(motion, tensions, tmp_path):
    columns = [motion.time, *motion.held_tension.T, *motion.tip_position.T]
    titles = ["time [s]", *(f"held_tension_{k} [N]" for k in (1, 2, 3, 4)), *(f"tip_{x} [m]" for x in "xyz")]
    path = tmp_path / "by-hand.csv"
    np.savetxt(path, np.transpose(columns), "%.17g", ",", header=",".join(titles), comments="")
    recording = kc.load_recording(path)
    np.testing.assert_array_equal(recording.sampled(DT).control[:-1], tensions)
    # means over half rows are the tensions themselves, and not those on lines to the next
    halves = recording.sampled(DT / 2, mean=True)
    np.testing.assert_allclose(halves.control[:-1], np.repeat(tensions, 2, axis=0), rtol=1e-12)
    path.write_text(path.read_text().replace("held_", ""))
    lines = kc.load_recording(path).sampled(DT / 2, mean=True)
    assert lines.continuous and not halves.continuous
    assert np.abs(lines.control[:40] - np.repeat(tensions, 2, axis=0)[:40]).max() > 0.5


def test_controls_in_files_are_held_under_either_name(tensions, tmp_path):
    path = tmp_path / "controls.csv"
    kc.controls.save(path, tensions, DT)
    path.write_text(path.read_text().replace("tension_", "held_tension_"))
    found = kc.controls.load(path)
    np.testing.assert_array_equal(found.tensions, tensions)
    assert found.dt == DT


def test_a_table_says_one_thing_of_its_tensions(tmp_path):
    path = tmp_path / "both.csv"
    path.write_text("time [s],tension_1 [N],held_tension_1 [N],tip_x [m],tip_y [m],tip_z [m]\n0,1,1,0,0,1\n")
    with pytest.raises(RecordingError, match=r"tension_1 .* and held_tension_1 .*; allowed is one of them"):
        kc.load_recording(path)
    path.write_text("# initial control: 1 2\ntime [s],held_tension_1 [N],tip_x [m],tip_y [m],tip_z [m]\n")
    with pytest.raises(RecordingError, match="no rows"):
        kc.load_recording(path)
    path.write_text(path.read_text() + "0,1,0,0,1\n0.1,1,0,0,1\n")
    with pytest.raises(RecordingError, match=r"initial_control .*; allowed is 1 numbers \(SI units\)"):
        kc.load_recording(path)
    path.write_text(path.read_text().replace("1 2", "a"))
    with pytest.raises(RecordingError, match="initial control is 'a'; allowed is numbers"):
        kc.load_recording(path)


def test_a_configuration_says_that_tensions_are_held(tmp_path):
    config = RecordingConfig.paper_robot()
    assert config.tension is not None
    held = config.replace(tension=ControlSource("/tension", (4, 1, 2, 3), "gf", held=True))
    held.save(tmp_path / "held.yaml")
    assert RecordingConfig.load(tmp_path / "held.yaml") == held
    with pytest.raises(RecordingError, match="held is 3; allowed is true or false"):
        ControlSource("/tension", (1,), held=3)


def planar_motion():
    """Five rows of a string in a plane: no orientations, and controls of its own name; made-up numbers."""
    string = HangingString(length=1.0, density=0.1, stiffness=1e3, friction=0.05, nodes=6)
    rng, zero = np.random.default_rng(0), np.zeros(5)
    y, z = (rng.normal(size=(5, 6, each.size)) for each in (string.y_layout, string.z_layout))
    control = rng.normal(size=(5, string.control_layout.size))
    return kc.Trajectory(
        string, None, 0.1 * np.arange(5), y, z, control, zero.astype(int), zero, zero.astype(int)
    )


@pytest.mark.parametrize("fractions", [(1.0,), (0.4, 1.0), (0.2, 0.4, 0.6)])
def test_measurements_of_a_planar_system(fractions):
    moved = planar_motion()
    seen = kc.recordings.Measurements.of(moved, fractions)
    at = [round(5 * each) for each in fractions]
    np.testing.assert_allclose(seen.position, moved.part("p")[:, at], atol=1e-12)
    assert seen.position.shape == (5, len(fractions), 2) and np.all(np.isnan(seen.quaternion))
    assert seen.measured.all() and seen.complete.all()
    np.testing.assert_array_equal(seen.control[:-1], moved.control[1:])
    np.testing.assert_array_equal(seen.initial_control, moved.control[0])
    assert len(seen.rows(1, 4).parts()) == 1 and seen.tip_position.shape == (5, 2)


def test_planar_measurements_are_written_as_x_and_z(tmp_path):
    moved = planar_motion()
    seen = kc.recordings.Measurements.of(moved)
    seen.save(tmp_path / "it.csv")
    again = kc.load_recording(tmp_path / "it.csv").sampled(0.1)
    np.testing.assert_allclose(again.position[:, 0, (0, 2)], seen.position[:, 0], atol=1e-9)
    assert np.all(again.position[:, 0, 1] == 0.0)
