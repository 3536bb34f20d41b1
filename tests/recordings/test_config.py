import dataclasses
import os

import jsonschema
import numpy as np
import pytest
import yaml

import knode_cosserat as kc
from knode_cosserat.recordings import RecordingConfig, RecordingError
from knode_cosserat.recordings.config import BaseSource, ControlSource, MarkerSource

FULL = RecordingConfig(
    markers=(
        MarkerSource("middle", "/mocap/middle", 0.5, rotation=(0.0, 1.0, 0.0, 0.0)),
        MarkerSource("tip: the last", "/mocap/tip", 1.0),
    ),
    tension=ControlSource("/cells", (3, 1, 2), "N"),
    command=ControlSource("/motors", (1, 2, 3), "gf", text="go {} now", latency=0.1),
    base=None,
    controls="commanded",
    position_unit="mm",
    origin=(0.1, 0.2, -0.3),
    frame_rotation=(0.6, 0.8, 0.0, 0.0),
    clock="received",
    longest_gap=0.25,
    rest=(0.0, 0.75),
    trim=(1.0, None),
    simulated=True,
    description="a robot: 'ours', #1",
)


@pytest.mark.parametrize(
    "config",
    [
        FULL,
        RecordingConfig.paper_robot(),
        RecordingConfig.asl_trunk(),
        FULL.replace(simulated=None, rest=None, base=BaseSource("/b", 0.1)),
    ],
)
def test_settings_come_back_from_their_file(tmp_path, config):
    config.save(tmp_path / "it.yaml")
    assert RecordingConfig.load(tmp_path / "it.yaml") == config


def test_the_papers_robot_is_as_the_specification_has_it():
    paper = kc.recordings.RecordingConfig.paper_robot()
    assert [marker.topic for marker in paper.markers] == [f"/vicon/continuum_{k}/pose" for k in range(4)]
    np.testing.assert_allclose([marker.fraction * 9 for marker in paper.markers], [3, 5, 7, 9])
    assert (paper.base.topic, paper.base.height) == ("/vicon/continuum_base/pose", 0.0635)
    assert (paper.tension.topic, paper.tension.unit, paper.tension.order) == ("/tension", "gf", (4, 1, 2, 3))
    assert (paper.command.order, paper.command.latency) == ((4, 1, 2, 3), 0.06)
    assert paper.controls == "measured"
    # it may be a test robot, which has the same topics
    assert paper.simulated is None
    assert paper.count == 4


def test_a_short_file_is_enough(tmp_path):
    (tmp_path / "it.yaml").write_text(
        "format: 1\n"
        "tension: {topic: /cells, unit: N, order: [1, 2, 3]}\n"
        "markers:\n"
        "  - {name: middle, topic: /mocap/middle, fraction: 4/9}\n"
        "  - {name: tip, topic: /mocap/tip, fraction: 1}\n"
    )
    config = RecordingConfig.load(tmp_path / "it.yaml")
    assert config.markers[0].fraction == 4 / 9
    assert config.command is None
    assert config.simulated is None
    assert config.count == 3


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("format: 1", "format: 2", "format is 2; allowed is 1"),
        ("format: 1", "formats: 1", "the key 'formats' is unknown; allowed is markers, tension,"),
        ("unit: N", "unit: lb", "tension: unit is 'lb'; allowed is N or gf"),
        ("order: [1, 2]", "order: [0, 1]", "tension: order is [0, 1]; allowed is the numbers 1, 2, 3"),
        ("order: [1, 2]", "order: 2", "tension: order is 2; allowed"),
        ("order: [1, 2]", "orders: [1, 2]", "'orders' is unknown; allowed is topic, order, unit, held, na"),
        ("order: [1, 2], ", "", "tension: the key order is missing; required is topic, order"),
        ("fraction: 1", "fraction: 1.5", "number 1: fraction is 1.5; allowed is a number from 0 to 1"),
        ("fraction: 1", "fraction: 1/0", "fraction is '1/0'; allowed"),
        ("fraction: 1", "fraction: .nan", "fraction is nan; allowed"),
        ("name: tip", "name: ''", "name is ''; allowed is text on one line"),
        ("markers:", "marker:", "the key 'marker' is unknown"),
        ("  - {name: tip, topic: /tip, fraction: 1}", "  []", "markers is (); allowed is a list of one"),
        ("  - {name: tip, topic: /tip, fraction: 1}", "  - tip", "number 1 is 'tip'; allowed is a Marker"),
        ("topic: /tip", "topic: /pull", "the topic /pull is there twice"),
        ("tension:", "command:", "tension is missing; required where controls is measured"),
        ("format: 1", "simulated: perhaps", "simulated is 'perhaps'; allowed is true or false"),
        ("format: 1", "rest: [2, 1]", "rest is [2, 1]; allowed is [start, end] in s, start before end"),
        ("format: 1", "rest: [null, 1]", "rest is [None, 1]; allowed"),
        ("format: 1", "trim: 3", "trim is 3; allowed is [start, end] in s, start before end, either"),
        ("format: 1", "frame_rotation: [1, 1, 0, 0]", "frame_rotation is [1, 1, 0, 0]; allowed is a"),
        ("format: 1", "origin: [1, 1]", "origin is [1, 1]; allowed is three numbers"),
        ("format: 1", "longest_gap: -1", "longest_gap is -1; allowed is a number from 0 to 60 s"),
        ("format: 1", "clock: sun", "clock is 'sun'; allowed is header or received"),
        ("format: 1", "base: {height: 1}", "base: the key topic is missing"),
        ("format: 1", "description: [1]", "description is [1]; allowed is text"),
        (
            "format: 1",
            "command: {topic: /c, order: [1, 2], text: 'Go'}",
            "command: text is 'Go'; allowed is text with one {} where the numbers stand",
        ),
        ("format: 1", "command: {topic: /c, order: [1]}", "order has 2 numbers in tension and 1 in command"),
        ("format: 1", "a: [", "not YAML"),
        ("format: 1", "format: 1\nformat: 1", "the key 'format' is there twice"),
    ],
)  # fmt: skip
def test_a_file_that_is_not_right_gives_one_line(tmp_path, old, new, words):
    text = (
        "format: 1\ntension: {topic: /pull, order: [1, 2], unit: N}\n"
        "markers:\n  - {name: tip, topic: /tip, fraction: 1}\n"
    )
    path = tmp_path / "it.yaml"
    path.write_text(text)
    RecordingConfig.load(path)
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(RecordingError) as raised:
        RecordingConfig.load(path)
    message = str(raised.value)
    assert message.startswith(f"{path}: ")
    assert words in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("format: 1", "format: 2"),
        ("format: 1", "formats: 1"),
        ("unit: N", "unit: lb"),
        ("order: [1, 2]", "order: [0, 1]"),
        ("fraction: 4/9", "fraction: 1.5"),
        ("name: tip, ", ""),
        ("trim: [null, 2]", "trim: 3"),
        ("format: 1", "longest_gap: -1"),
        ("format: 1", "base: {heights: 1}"),
        ("tip: [x, y, z]", "tip: x"),
    ],
)
def test_the_schema_and_the_reader_agree(old, new):
    text = (
        "format: 1\ntension: {topic: /pull, order: [1, 2], unit: N}\ntrim: [null, 2]\n"
        "columns: {time: 1, tip: [x, y, z]}\nmarkers:\n  - {name: tip, fraction: 4/9}\n"
    )
    schema = jsonschema.Draft202012Validator(RecordingConfig.json_schema())
    for config in (FULL, RecordingConfig.paper_robot(), RecordingConfig.asl_trunk()):
        schema.validate(config.to_dict())
    schema.validate(yaml.safe_load(text))
    RecordingConfig.from_dict(yaml.safe_load(text))
    wrong = yaml.safe_load(text.replace(old, new))
    assert not schema.is_valid(wrong)
    with pytest.raises(RecordingError):
        RecordingConfig.from_dict(wrong)


def test_files_that_cannot_be_read_or_written(tmp_path):
    with pytest.raises(RecordingError, match=r"nowhere\.yaml: no such file"):
        RecordingConfig.load(tmp_path / "nowhere.yaml")
    with pytest.raises(RecordingError, match="cannot be read"):
        RecordingConfig.load(tmp_path)
    (tmp_path / "it.yaml").write_bytes(b"\xff\xfe")
    with pytest.raises(RecordingError, match="not UTF-8"):
        RecordingConfig.load(tmp_path / "it.yaml")
    (tmp_path / "it.yaml").write_text("")
    with pytest.raises(RecordingError, match="the file is empty; allowed is a mapping with format, markers"):
        RecordingConfig.load(tmp_path / "it.yaml")
    with pytest.raises(RecordingError, match="cannot be written"):
        FULL.save(tmp_path)


def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch):
    FULL.save(tmp_path / "it.yaml")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RecordingError, match=r"it\.yaml: cannot be written: No space left on device"):
        FULL.replace(clock="header").save(tmp_path / "it.yaml")
    assert RecordingConfig.load(tmp_path / "it.yaml") == FULL
    assert os.listdir(tmp_path) == ["it.yaml"]


def test_settings_are_changed_by_name():
    assert FULL.replace(longest_gap=0.3) == dataclasses.replace(FULL, longest_gap=0.3)
    with pytest.raises(
        RecordingError, match=r"the key 'longest_gaps' is unknown; .* did you mean longest_gap\?"
    ):
        FULL.replace(longest_gaps=0.3)
    with pytest.raises(RecordingError, match="markers have the names"):
        FULL.replace(markers=(MarkerSource("a", "/a", 0.5), MarkerSource("a", "/b", 1.0)))
    with pytest.raises(RecordingError, match="base is '/base'; allowed is a BaseSource, or a mapping"):
        FULL.replace(base="/base")
