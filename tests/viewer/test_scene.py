"""What the page is given: numbers that come back, sizes, names, errors, and nothing that could run."""

import base64
import dataclasses
import gzip
import html.parser
import json
import threading
import urllib.error
import urllib.request

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.cli import main
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.viewer.pages import document, export_scene, view
from knode_cosserat.viewer.scene import (
    LEAST_ROWS,
    MOST,
    MOST_NODES,
    drawing,
    encoded_array,
    kept,
    scene,
    sliders,
    track,
)


def unpacked(array):
    """What `scene.encoded_array` says of its bytes, done in numpy."""
    kind = np.dtype(f"<{array['type']}")
    data = np.frombuffer(gzip.decompress(base64.b64decode(array["bytes"])), np.uint8)
    columns = np.ascontiguousarray(data.reshape(kind.itemsize, -1).T).view(kind).reshape(-1)
    rows = array["shape"][0]
    return columns.reshape(-1, rows).T.reshape(array["shape"])


class Scripts(html.parser.HTMLParser):
    """The scripts of a page, as a browser takes it apart."""

    def __init__(self, text):
        super().__init__()
        self.found, self.inside, self.tags = {}, None, []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag == "script":
            self.inside = dict(attributes).get("id") or dict(attributes).get("type") or "plain"
            self.found[self.inside] = ""

    def handle_data(self, data):
        if self.inside:
            self.found[self.inside] += data

    def handle_endtag(self, tag):
        if tag == "script":
            self.inside = None


@pytest.mark.parametrize("shape", [(7,), (5, 3), (4, 3, 2), (6, 0), (1, 2)])
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_arrays_come_back(shape, kind):
    values = np.random.default_rng(0).normal(size=shape).astype(kind)
    if values.size:
        values.flat[0] = np.nan
    np.testing.assert_array_equal(unpacked(encoded_array(values, kind)), values)


def test_a_track_holds_the_states_and_says_where_things_stand_in_them(truth):
    found = track(truth, "truth")
    y = unpacked(found["arrays"]["y"])
    np.testing.assert_array_equal(y, truth.y.astype(np.float32))
    np.testing.assert_array_equal(unpacked(found["time"]), truth.time)
    at = found["position"]
    assert at["array"] == "y"
    np.testing.assert_array_equal(y[..., at["offset"] : at["offset"] + 3], truth.position.astype(np.float32))
    assert set(found["arrays"]) == {"y", "z", "control"} and found["curves"] == []
    names = [field["name"] for field in found["fields"]]
    assert names == ["p", "h", "n", "m", "q", "w", "v", "u", "tension"]
    assert found["drawing"]["up"] == [0.0, 0.0, 1.0] and found["failure"] is None


def test_five_hundred_steps_are_compact(truth):
    long = kc.Trajectory(
        truth.system,
        truth.settings,
        np.arange(501) * 0.05,
        *(
            np.resize(np.asarray(value)[1:], (501, *value.shape[1:]))
            for value in (truth.y, truth.z, truth.control, truth.result, truth.residual, truth.iterations)
        ),
    )
    found = track(long, "long")
    assert found["arrays"]["y"]["shape"] == [501, 10, 19]
    assert len(json.dumps(found)) < 600_000
    # smooth numbers are smaller than their base64 without compression would be
    assert len(json.dumps(found)) < 0.95 * 4 / 3 * 4 * 501 * (10 * 25 + 4)


@pytest.mark.parametrize("shape", [(100_001, 10, 19), (50, 2000, 19), (30_000, 400, 114), (1, 2, 19)])
def test_what_is_long_is_thinned_evenly_and_keeps_its_ends(shape):
    nodes, rows = kept(shape, 6)
    for found, count in ((nodes, shape[1]), (rows, shape[0])):
        assert found[0] == 0 and found[-1] == count - 1
        assert len(found) == 1 or np.ptp(np.diff(found)) <= 1
    assert len(nodes) == min(shape[1], MOST_NODES)
    assert len(rows) == shape[0] or len(rows) >= LEAST_ROWS
    assert len(rows) * len(nodes) * (shape[2] + 6) <= 500_000 or len(rows) <= LEAST_ROWS


def test_unsolved_rows_stay_unsolved(failed):
    found = track(failed, "failed")
    assert np.all(np.isnan(unpacked(found["arrays"]["y"])[40:]))
    assert found["failure"] == {"time": pytest.approx(2.0), "message": "no solution found"}
    assert np.all(unpacked(found["result"])[40:] < 0)


def test_without_a_single_solution_there_is_nothing_to_draw(failed):
    with pytest.raises(ValueError, match="bad: no row is solved"):
        scene({"bad": failed[40:]})


def test_robots_of_a_batch_are_shown_one_by_one(truth):
    stacked = kc.Trajectory(
        truth.system,
        truth.settings,
        truth.time,
        *(
            np.stack([np.asarray(value)] * 3)
            for value in (truth.y, truth.z, truth.control, truth.result, truth.residual, truth.iterations)
        ),
    )
    assert [each["name"] for each in scene({"b": stacked})["tracks"]] == ["b [0]", "b [1]", "b [2]"]
    with pytest.raises(ValueError, match=f"15 trajectories.*1 to {MOST}"):
        scene([stacked] * 5)


@pytest.mark.parametrize(
    ("given", "message"), [([], "0 traj"), (["x.nc"], "trajectory 1 is a str"), (3, "a int")]
)
def test_what_is_no_trajectory_is_named(given, message):
    with pytest.raises(ValueError, match=message):
        scene(given)


def test_an_evaluation_brings_what_was_measured_and_its_band(evaluation):
    shown = scene({"softer": evaluation})
    (found,) = shown["tracks"]
    arrays = {name: unpacked(array) for name, array in found["measured"]["arrays"].items()}
    it = evaluation.comparison
    expected = {"seen": it.seen, "predicted": it.position, "low": it.band.low, "high": it.band.high}
    assert set(arrays) == set(expected) and found["measured"]["level"] == 0.9
    for name, values in expected.items():
        np.testing.assert_array_equal(arrays[name], values.astype(np.float32))
    assert np.isnan(arrays["seen"][30]).all() and shown["notes"] == []


def test_a_trajectory_is_shown_beside_the_recording_that_it_predicts(prediction, truth):
    seen = kc.recordings.Measurements.of(truth, (0.5, 1.0))
    later = dataclasses.replace(seen, time=seen.time + 2.0)
    for found in scene({"a": prediction, "b": truth}, measured=later)["tracks"]:
        # both have the clock of the recording
        np.testing.assert_array_equal(unpacked(found["time"]), later.time)
        np.testing.assert_array_equal(
            unpacked(found["measured"]["arrays"]["seen"]), seen.position.astype(np.float32)
        )
    with pytest.raises(ValueError, match=r"trajectory has 61 rows and the recording 5; .*predict"):
        scene(truth, measured=seen.rows(0, 5))


def test_a_prediction_that_failed_is_told(truth):
    failed = kc.identification.Evaluation(failed="no solution found")
    shown = scene({"good": truth, "bad": failed})
    assert [each["name"] for each in shown["tracks"]] == ["good"]
    assert shown["notes"] == ["bad: no prediction: no solution found"]
    with pytest.raises(ValueError, match="bad: no prediction: no solution found"):
        scene({"bad": failed})


def test_the_command_shows_predictions_of_recordings(truth, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    kc.recordings.Measurements.of(truth, (0.5, 1.0)).rows(0, 11).save("seen.csv")
    kc.save_robot(truth.system, "robot.yaml")

    def ended(*arguments):
        monkeypatch.setattr("sys.argv", ["x", "view", *arguments, "--export", "scene.html"])
        with pytest.raises(SystemExit) as end:
            main()
        return end.value.code, capsys.readouterr()

    code, _ = ended("robot.yaml", "seen.csv", "--dt", "0.05", "--seconds", "0.4")
    shown = json.loads(Scripts((tmp_path / "scene.html").read_text(encoding="utf-8")).found["scene"])
    assert code == 0 and [each["name"] for each in shown["tracks"]] == ["seen.csv"]
    seen = unpacked(shown["tracks"][0]["measured"]["arrays"]["seen"])
    np.testing.assert_allclose(seen[:, 1], truth.tip_position[:9], atol=1e-6)
    truth.save("truth.nc")
    code, said = ended("truth.nc", "seen.csv")
    assert code == 2 and "this is a trajectory; a robot or model predicts" in said.err
    code, said = ended("truth.nc", "--start", "1")
    assert code == 2 and "as --config, --start and --seconds" in said.err


def test_a_target_is_three_numbers_in_metres(truth):
    assert scene(truth)["target"] is None
    assert scene(truth, target=np.array([0.1, 0.0, 0.6]))["target"] == [0.1, 0.0, 0.6]
    for wrong in ((0.1, 0.2), (0.1, 0.2, np.nan), "tip", 3.0):
        with pytest.raises(ValueError, match=r"target must be a position \(x, y, z\)"):
            scene(truth, target=wrong)
    with pytest.raises(ValueError, match=r"got 274 m.*did you mean \(0\.1, 0\.05, 0\.25\)"):
        scene(truth, target=(100.0, 50.0, 250.0))


def test_the_estimated_error_of_each_row_is_in_the_scene(truth, coarse):
    known = unpacked(track(coarse, "coarse")["position_error"])
    np.testing.assert_allclose(known, coarse.position_error, rtol=1e-6)
    measured = kc.Trajectory(
        truth.system,
        None,
        truth.time,
        truth.y,
        truth.z,
        truth.control,
        truth.result,
        truth.residual,
        truth.iterations,
    )
    assert np.all(np.isnan(unpacked(track(measured, "measured")["position_error"])))


def test_texts_cannot_leave_their_place(truth):
    evil = "</script><script>window.hacked = 1</script><!-- @@SCENE@@ & \u2028"
    page = document(scene({evil: truth}, title=evil))
    read = Scripts(page)
    shown = json.loads(read.found["scene"])
    assert shown["title"] == evil and shown["tracks"][0]["name"] == evil
    assert sum(tag == "script" for tag, _ in read.tags) == 4
    assert "hacked = 1</script>" not in page.split('id="scene"')[1].split("</script>")[0]


def test_the_page_may_not_reach_any_network(truth, tmp_path):
    path = export_scene(truth, tmp_path / "scene.html")
    read = Scripts(path.read_text(encoding="utf-8"))
    policy = next(a["content"] for tag, a in read.tags if tag == "meta" and "http-equiv" in a)
    assert "default-src 'none'" in policy and "connect-src 'none'" in policy
    sources = [v for _, a in read.tags for k, v in a.items() if k in ("src", "href")]
    assert all(source.startswith("data:") for source in sources)
    imports = json.loads(read.found["importmap"])["imports"]
    assert all(url.startswith("data:text/javascript;base64,") for url in imports.values())
    assert path.stat().st_size < 1_500_000


class Flat(kc.System):
    """A system that says of its nodes where they are, in two numbers, and no more."""

    y_layout = kc.robots.Layout(("place", 2, "m", "place"), ("n", 1, "N", "force"))
    z_layout = kc.robots.Layout()
    control_layout = kc.robots.Layout(("pull", 1, "N", "pull"))
    base_unknowns = ("n",)

    length: float = 2.0

    def rest(self, s):
        raise NotImplementedError

    def tip(self, t, control, y, y_t):
        raise NotImplementedError


class Plane(Drawing, of=Flat):
    """Positions in two numbers."""

    def positions(self, y):
        return y[..., :2]


class Nowhere(Flat):
    """One that does not even say that."""


Drawing.register(Nowhere, Drawing)


def of(system, rows=4, nodes=5):
    y = np.random.default_rng(0).normal(size=(rows, nodes, 3))
    zero = np.zeros(rows)
    return kc.Trajectory(
        system,
        None,
        np.arange(rows) * 0.1,
        y,
        np.zeros((rows, nodes, 0)),
        np.zeros((rows, 1)),
        zero.astype(int),
        zero,
        zero.astype(int),
    )


def test_positions_of_two_numbers_stand_upright():
    moved = of(Flat(nodes=5))
    found = track(moved, "flat")
    drawn = unpacked(found["arrays"]["position"])
    np.testing.assert_array_equal(drawn[..., [0, 2]], moved.y[..., :2].astype(np.float32))
    np.testing.assert_array_equal(drawn[..., 1], 0.0)
    assert "orientation" not in found and found["drawing"]["tendons"] is None


def test_without_positions_one_line_says_so():
    with pytest.raises(ValueError, match=r"odd: Nowhere has no position.*nothing to draw"):
        scene({"odd": of(Nowhere(nodes=5))})


@pytest.mark.parametrize("name", sorted(kc.catalog()))
def test_every_robot_has_a_drawing_and_a_slider_for_each_control(name):
    robot = kc.load_robot(name)
    found = drawing(robot, np.arange(robot.nodes))
    json.dumps(found, allow_nan=False)
    assert len(found["radii"]) == robot.nodes and min(found["radii"]) > 0.0
    assert len(found["obstacles"]) == len(getattr(robot, "surroundings", ()))
    given = sliders(robot)
    assert len(given) == robot.control_layout.size
    for slider in given:
        assert slider["low"] <= slider["start"] <= slider["high"] and slider["low"] < slider["high"]


def test_tendons_are_drawn_where_their_routing_has_them():
    helix = kc.robots.routing.Helical(radius=0.01, phase=0.3, turns=1.5)
    short = kc.robots.routing.Straight(x=0.008, y=0.0, end=0.5)
    robot = kc.load_robot("delrin-routed-tendon-robot").replace(routing=(helix, short))
    tendons = drawing(robot, np.arange(10))["tendons"]
    angle = 0.3 + 2.0 * np.pi * 1.5 * np.linspace(0.0, 1.0, 10)
    wanted = 0.01 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    np.testing.assert_allclose(tendons["routes"][0], wanted, atol=1e-6)
    assert tendons["ends"] == [1.0, 0.5]


def test_the_server_gives_the_page_and_nothing_else(truth):
    address, known = [], threading.Event()

    def ready(found):
        address.append(found)
        known.set()

    threading.Thread(target=view, args=(truth,), kwargs={"open_browser": ready}, daemon=True).start()
    assert known.wait(30)
    assert address[0].startswith("http://127.0.0.1:")
    with urllib.request.urlopen(address[0]) as answer:
        assert "Scene" not in answer.headers and b'id="scene"' in answer.read()
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(address[0] + "../pyproject.toml")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no trajectory is given"),
        (["nothing.nc"], "nothing.nc: no such file"),
        (["robot.yaml"], "not a trajectory. To show a robot or model, type: knode-cosserat view --live"),
        (["truth.nc", "--export", "nowhere/scene.html"], "there is no folder nowhere"),
        (["truth.nc", "--set", "length=0.4"], "use them with --live"),
        (["--live", "--export", "a.html"], "exclude each other"),
        (["--live", "a", "b"], "one robot or model"),
        (["truth.nc", "--port", "70000", "--no-open"], "port is 70000"),
    ],
)
def test_wrong_arguments_end_in_one_line(arguments, message, truth, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    truth.save("truth.nc")
    (tmp_path / "robot.yaml").write_text("kind: tendon-robot\n")
    monkeypatch.setattr("sys.argv", ["knode-cosserat", "view", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr().err.strip()
    assert ended.value.code == 2 and message in said and "\n" not in said


def test_the_command_writes_a_scene_with_the_files_names(truth, prediction, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    truth.save("truth.nc")
    prediction.save("prediction.nc")
    monkeypatch.setattr("sys.argv", ["x", "view", "truth.nc", "prediction.nc", "--export", "scene.html"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0 and capsys.readouterr().out.strip() == "wrote scene.html"
    monkeypatch.setattr("sys.argv", ["x", "view", "truth.nc", "--export", "scene.html", "--json"])
    written = (tmp_path / "scene.html").read_text(encoding="utf-8")
    with pytest.raises(SystemExit):
        main()
    assert json.loads(capsys.readouterr().out) == {"trajectories": ["truth"], "export": "scene.html"}
    shown = json.loads(Scripts(written).found["scene"])
    assert [each["name"] for each in shown["tracks"]] == ["truth", "prediction"]
