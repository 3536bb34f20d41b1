"""Recordings in several files: offset and drift of their clocks, against clocks that are known."""

import dataclasses
import json

import numpy as np
import pytest
import scipy.interpolate
import scipy.signal

import knode_cosserat as kc
from knode_cosserat.recordings import RecordingConfig, RecordingError, load_recording, proposed_config
from knode_cosserat.recordings.clocks import Signal, match_clocks
from knode_cosserat.recordings.config import ControlSource, MarkerSource
from knode_cosserat.recordings.streams import Body, ControlRows
from knode_cosserat.recordings.table import _continued
from knode_cosserat.recordings.write import write_recording
from tests.commands import run, succeeded

DT = 0.001


def robot_motion(seconds=20.0, seed=0, rest=1.0):
    """Controls and positions of a linear robot with two lightly damped modes, every ms, without dead time."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, DT)
    knots = np.arange(0.0, seconds + 1.0, 0.4)
    levels = rng.uniform(2.0, 8.0, (len(knots), 3))
    levels[knots < rest] = 5.0
    wanted = levels[np.searchsorted(knots, time, side="right") - 1]
    lag = np.exp(-DT / 0.05)
    pulls = scipy.signal.lfilter([1.0 - lag], [1.0, -lag], wanted - 5.0, axis=0) + 5.0
    modes = []
    for hertz, damping, mix in ((1.3, 0.15, [1.0, -0.5, -0.5]), (1.6, 0.2, [0.0, 1.0, -1.0])):
        w = 2.0 * np.pi * hertz
        mode = scipy.signal.lti([w**2], [1.0, 2.0 * damping * w, w**2])
        modes.append(0.01 * scipy.signal.lsim(mode, (pulls - 5.0) @ mix, time)[1])
    place = np.stack([*modes, 0.4 - 2.0 * (modes[0] ** 2 + modes[1] ** 2)], axis=1)
    return time, pulls, place + 1e-4 * rng.normal(size=place.shape)


def split(folder, motion, offset, drift=0.0, rates=(50.0, 100.0), since=(0.0, 0.0), lost=None):
    """Two tables: motors on the true clock, and motion capture whose clock is `offset` behind and drifts."""
    time, pulls, place = motion
    rows = [
        np.arange(begin / DT, len(time), 1.0 / (rate * DT)).astype(int)
        for begin, rate in zip(since, rates, strict=True)
    ]
    np.savetxt(
        folder / "motors.csv",
        np.column_stack([time[rows[0]], pulls[rows[0]]]),
        delimiter=",",
        header="t [s],F1 [N],F2 [N],F3 [N]",
        comments="",
    )
    seen = rows[1] if lost is None else rows[1][~((time[rows[1]] > lost[0]) & (time[rows[1]] < lost[1]))]
    clock = (time[seen] - offset) * (1.0 + drift)
    np.savetxt(
        folder / "mocap.csv",
        np.column_stack([1e3 * clock, 1e3 * place[seen]]),
        delimiter=",",
        header="stamp_ms,tip x (mm),tip y (mm),tip z (mm)",
        comments="",
        fmt="%.14g",
    )
    return [folder / "motors.csv", folder / "mocap.csv"], clock


@pytest.fixture(scope="module")
def motion():
    return robot_motion()


@pytest.mark.parametrize(
    ("offset", "drift", "rates", "since", "lost"),
    [
        (0.0, 0.0, (50.0, 100.0), (0.0, 0.0), None),
        (2.9, 5e-5, (50.0, 100.0), (0.0, 0.0), None),
        (-3.0, -5e-5, (100.0, 60.0), (0.7, 0.0), None),
        (1.234, 5e-5, (25.0, 120.0), (0.0, 1.5), (8.0, 9.5)),
        (-417.0, 0.0, (200.0, 30.0), (0.0, 0.0), None),
    ],
)
def test_the_offset_of_a_split_recording_is_found(tmp_path, motion, offset, drift, rates, since, lost):
    paths, clock = split(tmp_path, motion, offset, drift, rates, since, lost)
    recording = load_recording(paths)
    motors, mocap = recording.config.files
    assert (motors.name, motors.offset, mocap.name) == ("motors.csv", 0.0, "mocap.csv")
    # the offset holds at the file's first row
    true = clock[0] / (1.0 + drift) + offset - clock[0]
    (note,) = [it.message for it in recording.findings if "clock of mocap.csv" in it.message]
    doubt = float(note.partition("±")[2].split()[0])
    assert abs(mocap.offset - true) < max(0.005, 2.0 * doubt) and doubt < 0.02
    assert "ppm" in note and "dead time of the robot is in it" in note
    # and the rows are those of the joined recording
    rows = recording.sampled(0.05)
    time, pulls, _ = motion
    begin = max(since) if offset == 0.0 else None
    zero = min(since)
    whole = np.stack([np.interp(rows.time + zero, time, column) for column in pulls.T], axis=1)
    assert begin is None or len(rows.time) > 300
    assert np.nanmedian(np.abs(rows.control - whole)) < 0.1


def test_a_drift_is_found_where_the_length_allows():
    time, pulls, place = robot_motion(seconds=120.0, seed=3)
    clock = (time - 1.5) * (1.0 + 4e-4)
    found = match_clocks(Signal(time[::20], pulls[::20]), Signal(clock[::12], place[::12]))
    assert abs(found.drift - 4e-4) < 3.0 * found.drift_error and found.drift_error < 1e-4
    true = found.at / (1.0 + 4e-4) + 1.5 - found.at
    assert abs(found.offset - true) < max(0.005, 2.0 * found.offset_error)
    # the other way round it is the other sign
    back = match_clocks(Signal(time[::20], pulls[::20]), Signal(clock[::12], place[::12]), is_reversed=True)
    assert back.drift == pytest.approx(-found.drift) and back.offset == pytest.approx(-found.offset)


def test_stated_clocks_are_taken_as_they_are(tmp_path, motion):
    paths, _ = split(tmp_path, motion, 1.0)
    first = load_recording(paths)
    first.config.save(tmp_path / "it.yaml")
    again = load_recording(paths, tmp_path / "it.yaml")
    assert again.config.files == first.config.files
    assert not [it for it in again.findings if "clock of" in it.message]
    np.testing.assert_allclose(again.bodies[0].time, first.bodies[0].time, atol=2e-6)
    files = [
        dataclasses.replace(it, offset=0.25) if it.name == "mocap.csv" else it for it in first.config.files
    ]
    other = load_recording(paths, first.config.replace(files=tuple(files)))
    # the doubt is that of the estimate, stays with it, and is of no stated offset
    assert 0.0 < first.clock_deviation < 0.02 and again.clock_deviation == first.clock_deviation
    assert first.sampled(0.05).clock_deviation == first.clock_deviation
    known = [dataclasses.replace(it, deviation=None) for it in files]
    assert load_recording(paths, first.config.replace(files=tuple(known))).clock_deviation == 0.0
    shift = other.bodies[0].time - other.control.time[0] - (first.bodies[0].time - first.control.time[0])
    np.testing.assert_allclose(shift, 0.25 - first.config.files[1].offset, atol=2e-6)


def test_the_order_of_files_only_turns_the_sign(tmp_path, motion):
    paths, _ = split(tmp_path, motion, 0.8)
    there, back = (load_recording(each).config.files[1].offset for each in (paths, paths[::-1]))
    assert there == pytest.approx(-back, abs=0.01)


def test_unrelated_files_are_an_error_that_asks(tmp_path, motion):
    time, pulls, _ = motion
    paths, _ = split(tmp_path, (time, pulls, robot_motion(seed=9)[2]), 0.0)
    with pytest.raises(
        RecordingError, match=r"^motors.csv \+ mocap.csv: the offset of the clock of mocap.csv"
    ):
        load_recording(paths)
    result = run("inspect", *paths)
    assert (
        result.exit_code == 2 and "State it, in s: `files: [{name: mocap.csv, offset: …}]`" in result.stderr
    )


def test_a_periodic_motion_without_a_beginning_is_an_error(tmp_path):
    time = np.arange(0.0, 20.0, DT)
    phase = 2.0 * np.pi * time
    pulls = 5.0 + np.stack([np.cos(phase), np.sin(phase), -np.cos(phase)], axis=1)
    place = np.stack([0.1 * np.cos(phase - 0.4), 0.1 * np.sin(phase - 0.4), 0.4 + 0.0 * time], axis=1)
    place = place + 1e-4 * np.random.default_rng(0).normal(size=place.shape)
    paths, _ = split(tmp_path, (time, pulls, place), 0.3)
    with pytest.raises(RecordingError, match="explain the motion as well as each other"):
        load_recording(paths)


def test_clocks_since_1970_that_overlap_are_taken_and_checked(tmp_path, motion):
    time, pulls, place = motion
    paths, _ = split(tmp_path, (time + 1.7e9, pulls, place), 0.0)
    recording = load_recording(paths)
    assert [it.offset for it in recording.config.files] == [0.0, 0.0]
    assert any(
        "on one clock by their stamps, and by the motion to" in it.message for it in recording.findings
    )
    # half a second apart is told, and not taken
    paths, _ = split(tmp_path, (time + 1.7e9, pulls, place), 0.5)
    recording = load_recording(paths)
    assert recording.config.files[1].offset == pytest.approx(0.0, abs=1e-6)
    assert any(
        "by the motion it differs by 0.5" in it.message.replace("0.49", "0.5") for it in recording.findings
    )


def test_a_clock_that_was_set_back_is_matched_in_parts(tmp_path, motion):
    paths, _ = split(tmp_path, motion, 0.6)
    lines = paths[1].read_text().splitlines()
    half = len(lines) // 2
    begin = float(lines[half].split(",")[0])
    after = [
        f"{float(line.split(',')[0]) - begin + 50.0:.9g},{line.partition(',')[2]}" for line in lines[half:]
    ]
    # some frames are lost while the clock is set
    paths[1].write_text("\n".join([*lines[:half], *after[40:]]) + "\n")
    recording = load_recording(paths)
    notes = [it.message for it in recording.findings if "clock of mocap.csv" in it.message]
    assert len(notes) == 2 and "part 1" in notes[0] and "part 2" in notes[1]
    body = recording.bodies[0]
    time, _, place = motion
    shown = np.stack([np.interp(body.time, time, column) for column in place.T], axis=1)
    # 20 ms at the usual speed
    assert (
        np.median(np.linalg.norm(body.position - shown, axis=1))
        < 0.02 * np.median(np.linalg.norm(np.diff(place[::100], axis=0), axis=1) / 0.1) + 2e-4
    )


def test_rows_after_a_reset_continue():
    time = np.array([0.0, 0.1, 0.2, 7.0, 7.1, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
    found, begins = _continued(time)
    np.testing.assert_allclose(np.diff(found)[4:], 0.1, atol=1e-12)
    assert begins == pytest.approx([7.2])
    # a single row out of order is none
    other = np.array([0.0, 5.0, 1.0, 5.1, 5.2, 5.3, 5.4, 5.5, 5.6])
    np.testing.assert_array_equal(_continued(other)[0], other)


def test_several_files_are_proposed_inspected_and_evaluated(tmp_path, motion):
    paths, _ = split(tmp_path, motion, 1.0)
    config = proposed_config(paths)
    assert [(it.name, it.time) for it in config.files] == [("motors.csv", "t [s]"), ("mocap.csv", "stamp_ms")]
    text = succeeded("inspect", *paths)
    (tmp_path / "it.yaml").write_text(text.partition("--config:\n")[2])
    # other recordings have other offsets
    assert RecordingConfig.load(tmp_path / "it.yaml").files == config.files
    assert load_recording(paths, tmp_path / "it.yaml").config.files[1].offset == pytest.approx(1.0, abs=0.02)
    found = json.loads(succeeded("inspect", *paths, "--json"))
    assert found["columns"]["F2 [N]"] == "tension 2 [N]" and found["columns"]["stamp_ms"] == "time"
    named = f"{paths[0]}+{paths[1]}"
    result = run("evaluate", "delrin-tendon-robot", named, "--config", tmp_path / "it.yaml")
    assert result.exit_code == 2 and "controls tension (4); the recording has tension (3)" in result.stderr


def test_a_bag_and_a_table_are_one_recording(tmp_path, motion):
    time, pulls, _ = motion
    paths, _ = split(tmp_path, motion, -1.5)
    bag = RecordingConfig(
        markers=(MarkerSource("tip", "/tip", 1.0),), tension=ControlSource("/pull", (1, 2, 3))
    )
    still = Body(time[::100], np.tile([0.0, 0.0, 0.4], (len(time[::100]), 1)))
    write_recording(tmp_path / "motors.bag", bag, {"tip": still}, ControlRows(time[::20], pulls[::20]))
    columns = {"time": "stamp_ms", "tip": ["tip x (mm)", "tip y (mm)", "tip z (mm)"]}
    config = RecordingConfig.from_dict(
        {"columns": columns, "tension": {"topic": "/pull", "order": [1, 2, 3]}, "controls": "measured"}
    )
    recording = load_recording([tmp_path / "motors.bag", paths[1]], config)
    assert recording.config.files[1].offset == pytest.approx(1_720_000_000 - 1.5, abs=0.02)
    rows = recording.sampled(0.05)
    assert rows.complete.all() and len(rows.time) > 300


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ([], "path is an empty list; allowed is one file or more"),
        (["motors.csv", "motors.csv"], "two files are called motors.csv"),
        (["motors.csv", "none.csv"], "none.csv: no such file"),
        (["motors.csv"], "none look like a body's position"),
    ],
)
def test_bad_files_give_one_line(tmp_path, motion, files, words):
    split(tmp_path, motion, 0.0)
    with pytest.raises(RecordingError, match=words):
        load_recording([tmp_path / name for name in files])


def test_files_that_are_not_those_of_the_configuration_say_so(tmp_path, motion):
    paths, _ = split(tmp_path, motion, 0.0)
    config = proposed_config(paths)
    renamed = tuple(it.replace(name=f"other_{it.name}", offset=0.0) for it in config.files)
    with pytest.raises(RecordingError, match=r"files states the clock of other_motors\.csv; .* A pattern"):
        load_recording(paths, config.replace(files=renamed))
    with pytest.raises(RecordingError, match=r"tip is in none of the files; they have motors.csv: t \[s\]"):
        load_recording(paths, config.replace(columns=None))


def test_a_pattern_of_names_serves_several_recordings(tmp_path, motion):
    paths, _ = split(tmp_path, motion, 0.3)
    config = proposed_config(paths)
    named = dict(zip(("*motors.csv", "*mocap.csv"), config.files, strict=True))
    of_all = config.replace(files=tuple(it.replace(name=name) for name, it in named.items()))
    for word in ("first", "second"):
        moved = [path.rename(path.with_name(f"{word}_{path.name.rpartition('_')[2]}")) for path in paths]
        recording = load_recording(moved, of_all)
        assert [it.name for it in recording.config.files] == [f"{word}_motors.csv", f"{word}_mocap.csv"]
        paths = moved
    twice = (*of_all.files, of_all.files[0].replace(name="second_*"))
    with pytest.raises(RecordingError, match=r"second_motors\.csv matches \*motors\.csv and second_\*"):
        load_recording(paths, config.replace(files=twice))


@pytest.mark.parametrize("lag", [0.0, 0.02])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_robot_that_follows_its_controls_is_matched(seed, lag):
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 14.0, DT)
    wanted = rng.uniform(-1.0, 1.0, (21, 2)) * (np.arange(21)[:, None] > 2)
    knots = scipy.interpolate.PchipInterpolator(np.linspace(0.0, 14.0, 21), wanted)(time)
    angles = knots @ np.array([[1.0, -0.5, -0.5], [0.0, 0.9, -0.9]])
    keeps = np.exp(-DT / lag) if lag else 0.0
    bent = scipy.signal.lfilter([1.0 - keeps], [1.0, -keeps], knots, axis=0)
    # motor angles give the bending, and large bending is not linear
    size = np.linalg.norm(bent, axis=1, keepdims=True)
    place = 0.2 * np.concatenate([bent * (1.0 - size**2 / 8.0), 1.0 - size**2 / 6.0], axis=1)
    place = place + 2e-4 * rng.normal(size=place.shape)
    found = match_clocks(Signal(time[::20], angles[::20]), Signal(time[300::8] - 2.5, place[300::8]))
    assert abs(found.offset - 2.5) < 2.0 * found.offset_error
    assert abs(found.offset - 2.5) < lag + 0.01


@pytest.mark.campaign
def test_a_robot_is_identified_as_well_from_split_files(tmp_path):
    """A virtual tendon robot: stiffness and damping from joined and from split files agree within 2 %."""
    from knode_cosserat.recordings.virtual import record_virtual

    config = RecordingConfig.paper_robot()
    robot = kc.load_robot("delrin-tendon-robot")
    values = []
    for k, signal in enumerate(("random:1", "sine:1.5")):
        record_virtual(tmp_path / f"{k}.bag", signal, seconds=10.0, seed=k)
    for is_split in (False, True):
        rows = []
        for k, (offset, drift) in enumerate(((2.5, 5e-5), (-1.7, -5e-5))):
            joined = load_recording(tmp_path / f"{k}.bag", config)
            recording = joined
            if is_split:
                tip = joined.bodies[-1]
                folder = tmp_path / f"split{k}"
                folder.mkdir()
                pulls = np.column_stack([joined.control.time, joined.control.values])
                names = ",".join(f"F{j} [N]" for j in range(1, 5))
                np.savetxt(folder / "motors.csv", pulls, delimiter=",", header=f"t [s],{names}", comments="")
                clock = (tip.time - offset) * (1.0 + drift)
                table = np.column_stack([clock, tip.position])
                np.savetxt(
                    folder / "mocap.csv", table, delimiter=",", header="t [s],x [m],y [m],z [m]", comments=""
                )
                recording = load_recording([folder / "motors.csv", folder / "mocap.csv"])
                found = recording.config.files[1]
                doubt = next(it.message for it in recording.findings if "clock of" in it.message)
                error = float(doubt.partition("±")[2].split()[0])
                assert abs(found.offset - (clock[0] / (1.0 + drift) + offset - clock[0])) < max(
                    0.005, 2.0 * error
                )
            tip_only = dataclasses.replace(
                recording, bodies=recording.bodies[-1:], base=None,
                config=recording.config.replace(markers=recording.config.markers[-1:], base=None),
            )  # fmt: skip
            rows.append(tip_only.sampled(0.0125, mean=True))
        found = kc.identify(robot, rows, parameters=["youngs_modulus", "bending_damping"])
        values.append([float(found.robot.youngs_modulus), float(np.max(found.robot.bending_damping))])
    np.testing.assert_allclose(values[1], values[0], rtol=0.02)
