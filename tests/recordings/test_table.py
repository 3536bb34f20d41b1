import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.metrics import dtw_distance
from knode_cosserat.recordings import RecordingConfig, RecordingError, load_example, load_recording
from knode_cosserat.recordings.config import ControlSource, MarkerSource

HEADER = "time [s],tension_1 [N],tension_2 [N],tip_x [m],tip_y [m],tip_z [m]"
ROW = "0,1,2,0.1,0.2,0.3"


@pytest.fixture
def table(tmp_path):
    def write(text):
        path = tmp_path / "recording.csv"
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    return write


@pytest.fixture(scope="module")
def example():
    return load_example().sampled(0.05)


def test_the_example_says_what_it_is(example):
    assert example.simulated is True
    assert "sine_1p0" in example.source


def test_nothing_is_wrong_with_the_example():
    (finding,) = load_example().findings
    assert "a simulation, and not a physical one" in finding.message


def test_the_example_has_20_rows_a_second(example):
    assert example.dt == 0.05
    np.testing.assert_allclose(example.time, np.arange(320) * 0.05, rtol=0, atol=1e-12)
    assert example.control.shape == (320, 4)
    assert example.tip_position.shape == (320, 3)
    # and they are those of the file
    (body,) = load_example().bodies
    np.testing.assert_allclose(example.tip_position, body.position, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(example.control, load_example().control.values)
    assert example.measured.all()


def test_the_example_follows_its_commands(example):
    # 500 + 300 (cos, sin, -cos, -sin) grams-force at a period of 1 s from t = 1 s on, 500 before
    resting = example.between(0.0, 1.0)
    np.testing.assert_allclose(resting.control, 4.905, atol=0.25)
    running = example.between(5.0, 15.0)
    turns = np.exp(-2j * np.pi * running.time)
    amplitude = 2 * (turns @ running.control) / len(turns)
    # the motors lag behind a little, by the same for all
    assert abs(amplitude) / 9.81e-3 == pytest.approx(300, rel=0.1)
    np.testing.assert_allclose(amplitude / amplitude[0], [1, -1j, -1, 1j], atol=0.03)


def test_the_example_is_in_the_robots_frame(example):
    # at rest it is straight up, as long as the rod: motion capture is good to about a millimetre
    np.testing.assert_allclose(example.between(0.0, 0.95).tip_position.mean(axis=0), [0, 0, 0.635], atol=1e-3)
    # and no point of a rod is further from its base than it is long
    assert np.linalg.norm(example.tip_position, axis=1).max() < 0.637


@pytest.mark.slow
def test_the_papers_knowledge_misses_the_example_by_what_the_specification_says(example):
    # 60.9 by recordings.md, which does not say how tensions and poses were put on one clock: that moves the
    # figure by 0.5 (scanned: either clock, hold or interpolation, up to a row earlier or later)
    measured = example.between(1.0, 11.0)
    assert len(measured.time) == 200
    robot = kc.load_robot("delrin-tendon-robot")
    predicted = kc.simulate(
        robot, measured.control[:-1], measured.dt, time="bdf2", space="euler", start="paper"
    )
    assert dtw_distance(predicted.tip_position, measured.tip_position) == pytest.approx(60.9, abs=0.5)


def test_a_table_is_read_by_its_titles(table):
    path = table(
        "# source: a test: of ours\n# simulated: true\n# other words\n"
        "tip_z [m], tension_2 [N],time [s],tip_x [m],tension_1 [N],tip_y [m]\n"
        "0.3,2,0,0.1,1,0.2\n\n0.6,5,0.5,0.4,4,0.5\n"
    )
    recording = load_recording(path)
    assert recording.source == "a test: of ours"
    assert recording.simulated is True
    np.testing.assert_array_equal(recording.control.time, [0, 0.5])
    np.testing.assert_array_equal(recording.control.values, [[1, 2], [4, 5]])
    np.testing.assert_allclose(recording.bodies[0].position, [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    assert recording.bodies[0].fraction == 1.0
    assert recording.sampled(0.5).dt == 0.5


def test_without_comments_nothing_is_claimed_of_the_robot(table):
    path = table(f"{HEADER}\r\n{ROW}\r\n1{ROW[1:]}\r\n")
    recording = load_recording(path)
    assert recording.simulated is None
    assert recording.source == path.name


def test_cells_that_are_empty_were_not_measured(table):
    path = table(f"{HEADER}\n0,1,2,,,\n0.1,,,0,0,0.5\n0.2,1,3,nan,nan,nan\n0.3,,,0,0.1,0.5\n0.4,1,2,0,0.2,\n")
    recording = load_recording(path)
    np.testing.assert_array_equal(recording.control.time, [0.0, 0.2, 0.4])
    np.testing.assert_array_equal(recording.bodies[0].time, [0.1, 0.3])
    assert "1 pose is not finite" in recording.findings[0].message


def test_rows_out_of_order_are_sorted(table):
    path = table(f"{HEADER}\n0,1,2,0,0,0.5\n2,3,2,0,0,0.5\n1,2,2,0,0,0.5\n1,2,2,0,0,0.5\n")
    recording = load_recording(path)
    np.testing.assert_array_equal(recording.control.values[:, 0], [1, 2, 3])
    words = " ".join(finding.message for finding in recording.findings)
    assert "the messages were sorted" in words
    assert "1 stamp is there twice" in words


def test_several_bodies_say_where_they_are(table):
    header = f"{HEADER},rib_x [m],rib_y [m],rib_z [m]\n"
    rows = "".join(f"{t},1,2,0,0,0.6,0,0,0.3\n" for t in range(3))
    recording = load_recording(table(f"# fraction rib: 0.5\n# fraction tip: 1\n{header}{rows}"))
    assert [body.name for body in recording.bodies] == ["rib", "tip"]
    assert [body.fraction for body in recording.bodies] == [0.5, 1.0]
    for said, words in (
        ("", "where on the rod tip is, is not said; allowed is a line '# fraction tip: '"),
        ("# fraction tip: 1\n# fraction rib: near\n", "fraction rib is 'near'; allowed is a number"),
        ("# fraction tip: 1\n# fraction rib: 2\n", "fraction is 2.0; allowed is a number from 0 to 1"),
        ("# fraction tip: 1\n# fraction rib: 1\n", "allowed is each above the last"),
    ):
        with pytest.raises(RecordingError, match=words):
            load_recording(table(f"{said}{header}{rows}"))


def test_a_table_with_other_titles_needs_a_configuration(table):
    path = table(
        "time [s],grip_1 [gf],end_x [mm],end_y [mm],end_z [mm],note [1]\n0,500,0,0,400,1\n1,500,0,0,400,2\n"
    )
    config = RecordingConfig(
        markers=(MarkerSource("tip", "end", 1.0),),
        tension=ControlSource("grip", (1,), "gf"),
        position_unit="mm",
        simulated=False,
    )
    recording = load_recording(path, config)
    assert recording.simulated is False
    np.testing.assert_allclose(recording.control.values, 4.905)
    np.testing.assert_allclose(recording.bodies[0].position, [[0, 0, 0.4]] * 2)
    with pytest.raises(RecordingError, match=r"the columns are time \[s\], grip_1"):
        load_recording(path)
    other = config.replace(tension=ControlSource("pull", (1,)))
    with pytest.raises(RecordingError, match=r"the column pull_1 \[N\] is missing; the columns are time"):
        load_recording(path, other)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("# source: nothing\n", "empty"),
        (f"{HEADER}\n", "no rows"),
        (f"{HEADER}\n{ROW},9\n", "Expected 6 fields"),
        (f"{HEADER}\n{ROW.replace('0.2', 'fast')}\n", "tip_y [m] is 'fast'; allowed is a finite number"),
        (f"{HEADER}\n{ROW}\n1e12{ROW[1:]}\n", "row 2: time [s] is 1e+12; allowed is up to 9e+09"),
        (f"{HEADER}\n{ROW}\n1{ROW[1:].replace('0.2', 'inf')}\n", "row 2: tip_y [m] is 'inf'; allowed is"),
        (f"{HEADER}\n{ROW}\n", "1 usable poses of tip; required is 2 or more"),
        ("tip_x [m]\n1\n", "the columns are tip_x [m]; allowed is time [s]"),
        (f"{HEADER.replace('[s]', '[ms]')}\n{ROW}\n", "time [ms]"),
        (f"{HEADER.replace('tension_2 [N]', 'tension_2 [gf]')}\n{ROW}\n", "tension_2 [gf]"),
        (f"{HEADER.replace('tension_2', 'tension_3')}\n{ROW}\n", "tension_3 [N]"),
        (f"{HEADER.replace('tip_z', 'tip_x')}\n{ROW}\n", "once each"),
        (f"# simulated: perhaps\n{HEADER}\n{ROW}\n", "simulated is 'perhaps'; allowed is true or false"),
        (b"\xff\xfe\x00", "not UTF-8"),
    ],
)
def test_a_table_that_is_not_right_gives_one_line(table, text, words):
    path = table(text)
    with pytest.raises(RecordingError) as raised:
        load_recording(path)
    message = str(raised.value)
    assert message.startswith(f"{path}: ")
    assert words in message
    assert "\n" not in message
