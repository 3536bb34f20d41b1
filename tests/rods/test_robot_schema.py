"""The schema of robot files: a schema, true of every robot there is, and never stricter than the loader."""

import copy
import json
from importlib.resources import files
from pathlib import Path

import jsonschema
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import knode_cosserat as kc
from knode_cosserat._files.yaml_text import mapping_of
from knode_cosserat.recordings.virtual import virtual_robot
from knode_cosserat.robots import RobotFileError
from knode_cosserat.rods.robot_file import KINDS, format_robot, parse_robot

ROOT = Path(__file__).parents[2]
SCHEMA = kc.robots.robot_schema()
CHECK = jsonschema.Draft202012Validator(SCHEMA)
CATALOG = files("knode_cosserat.rods") / "catalog"
ROBOTS = {name: mapping_of((CATALOG / f"{name}.yaml").read_text("utf-8"), "") for name in kc.catalog()}
ROBOTS["virtual"] = mapping_of(format_robot(virtual_robot()), "")
PART = {"kind": "attached-mass", "mass": 0.01}


def loads(content):
    try:
        parse_robot(json.dumps(content), "it")
    except RobotFileError:
        return False
    return True


def changed(content, path, value):
    content = copy.deepcopy(content)
    *way, last = path
    inner = content
    for key in way:
        inner = inner[key]
    inner[last] = value
    return content


def test_it_is_a_schema():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    assert json.loads(json.dumps(SCHEMA, allow_nan=False)) == SCHEMA
    assert set(ROBOTS) - {"virtual"} == set(kc.catalog())
    assert {each["kind"] for each in ROBOTS.values()} == set(KINDS)


@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_there_is_keeps_to_it(name):
    CHECK.validate(ROBOTS[name])


def test_so_do_the_examples_and_what_is_written():
    for path in (ROOT / "examples").glob("*.yaml"):
        content = mapping_of(path.read_text("utf-8"), "")
        if "kind" in content:
            CHECK.validate(content)
    for name in kc.catalog():
        CHECK.validate(mapping_of(format_robot(kc.load_robot(name), "written"), ""))


def test_it_knows_every_parameter_of_every_kind():
    for kind, cls in KINDS.items():
        stated = SCHEMA["$defs"][kind]["properties"]
        for name, parameter in cls.parameters().items():
            assert parameter.meaning in stated[name]["description"]
            assert parameter.unit in stated[name]["description"]


@pytest.mark.parametrize(
    ("robot", "path", "value"),
    [
        ("delrin-tendon-robot", ("format",), 3),
        ("delrin-tendon-robot", ("kind",), "tendon robot"),
        ("delrin-tendon-robot", ("description",), 5),
        ("delrin-tendon-robot", ("colour",), "red"),
        ("delrin-tendon-robot", ("parameters",), [1.0]),
        ("delrin-tendon-robot", ("parameters", "lenght"), 0.6),
        ("delrin-tendon-robot", ("parameters", "length"), "long"),
        ("delrin-tendon-robot", ("parameters", "length"), True),
        ("delrin-tendon-robot", ("parameters", "length"), None),
        ("delrin-tendon-robot", ("parameters", "length"), 635.0),
        ("delrin-tendon-robot", ("parameters", "gravity"), [0.0, -9.81]),
        ("delrin-tendon-robot", ("parameters", "gravity"), -9.81),
        ("delrin-tendon-robot", ("parameters", "bending_damping"), -0.1),
        ("delrin-tendon-robot", ("parameters", "bending_damping"), [[1, 0, 0], [0, -1, 0], [0, 0, 1]]),
        ("delrin-tendon-robot", ("parameters", "tendon_angles"), []),
        ("delrin-tendon-robot", ("parameters", "nodes"), 1),
        ("delrin-tendon-robot", ("parameters", "nodes"), 10.5),
        ("delrin-tendon-robot", ("parameters", "drive"), "reel"),
        ("delrin-tendon-robot", ("parameters", "loads"), PART),
        ("delrin-tendon-robot", ("parameters", "loads"), [{"mass": 0.01}]),
        ("delrin-tendon-robot", ("parameters", "loads"), [{**PART, "kind": "plane"}]),
        ("delrin-tendon-robot", ("parameters", "loads"), [{**PART, "weight": 1.0}]),
        ("delrin-tendon-robot", ("parameters", "loads"), [{**PART, "at": 1.1}]),
        ("delrin-tendon-robot", ("parameters", "tip_end"), "free"),
        ("delrin-tendon-robot", ("parameters", "tip_end"), {"kind": "driven", "axes": ["z", "z"]}),
        ("delrin-tendon-robot", ("parameters", "tip_end"), {"kind": "driven", "axes": "rx"}),
        ("delrin-tendon-robot", ("parameters", "tip_end"), {"kind": "clamped", "orientation": [0, 0, 0, 0]}),
        ("delrin-tendon-robot", ("parameters", "base_end"), {"kind": "sliding"}),
        ("delrin-tendon-robot", ("parameters", "sections"), [{"kind": "stretch", "begin": 1.0}]),
        ("delrin-tendon-robot", ("parameters", "sections"), [{"kind": "stretch", "end": 0}]),
        ("delrin-tendon-robot", ("parameters", "loads"), [{"kind": "distributed-wrench", "end": 0.0}]),
        ("delrin-tendon-robot", ("parameters", "surroundings"), [{"kind": "plane", "normal": [0, 0.0, 0]}]),
        ("delrin-tendon-robot", ("parameters", "surroundings"), [{"kind": "cylinder", "axis": [0, 0, 0]}]),
        ("delrin-routed-tendon-robot", ("parameters", "routing"), []),
        ("soft-slender-robot", ("parameters", "surroundings", 0, "friction"), -0.1),
        ("soft-slender-robot", ("parameters", "surroundings", 1, "inside"), 1),
        ("delrin-routed-tendon-robot", ("parameters", "drive"), "motor"),
        ("delrin-routed-tendon-robot", ("parameters", "routing"), [{"kind": "straight", "x": 0.01}]),
        ("six-legged-robot", ("parameters", "loads"), []),
    ],
)
def test_what_is_not_allowed_is_refused_by_both(robot, path, value):
    content = changed(ROBOTS[robot], path, value)
    assert not CHECK.is_valid(content)
    assert not loads(content)


@pytest.mark.parametrize(
    ("robot", "path", "value"),
    [
        ("delrin-tendon-robot", ("parameters", "tip_end"), {"kind": "sliding"}),
        ("delrin-tendon-robot", ("parameters", "loads"), []),
        ("delrin-tendon-robot", ("parameters", "sections"), [{"kind": "stretch", "begin": 0.99, "end": 1.0}]),
        ("delrin-tendon-robot", ("parameters", "surroundings"), [{"kind": "plane", "normal": [0, 1e-3, 0]}]),
        ("delrin-routed-tendon-robot", ("parameters", "routing"), None),
    ],
)
def test_what_is_just_allowed_is_taken_by_both(robot, path, value):
    content = changed({**ROBOTS[robot], "format": 2}, path, value)
    assert CHECK.is_valid(content)
    assert loads(content)


@pytest.mark.parametrize("key", ["format", "kind", "parameters"])
def test_what_is_missing_is_refused_by_both(key):
    for robot in ROBOTS.values():
        content = {name: value for name, value in robot.items() if name != key}
        assert not CHECK.is_valid(content) and not loads(content)
    content = copy.deepcopy(ROBOTS["delrin-tendon-robot"])
    del content["parameters"]["radius"]
    assert not CHECK.is_valid(content) and not loads(content)


NUMBERS = st.one_of(
    st.sampled_from([0, 1, -1, 2, 3, 1e-9, 1e3, 1e9, -1e9, 10, 20.0, 10_000]),
    st.floats(allow_nan=False, allow_infinity=False, width=32),
)
ANYTHING = st.one_of(
    NUMBERS,
    st.lists(NUMBERS, max_size=4),
    st.lists(st.lists(NUMBERS, min_size=3, max_size=3), min_size=2, max_size=3),
    st.sampled_from([None, True, False, "", "z", "reel", "free", {}, [], ["z", "rx"], ["z", "z"]]),
    st.sampled_from([{"kind": "free"}, {"kind": "driven", "axes": []}, {"kind": "straight"}, [PART]]),
)


def places(content, way=()):
    """Every place of a file, to be changed: what is there, and one that is not."""
    keys = range(len(content)) if isinstance(content, list) else content
    found = [(*way, key) for key in keys]
    for key in keys:
        if isinstance(content[key], dict | list):
            found += places(content[key], (*way, key))
    return found if isinstance(content, list) else [*found, (*way, "unheard_of")]


@st.composite
def spoilt(draw):
    """A robot's file with some values, known or new, replaced by anything."""
    content = ROBOTS[draw(st.sampled_from(sorted(ROBOTS)))]
    known = SCHEMA["$defs"][content["kind"]]["properties"]
    ways = [*places(content), *(("parameters", name) for name in known)]
    for _ in range(draw(st.integers(1, 2))):
        way = draw(st.sampled_from(ways))
        try:
            content = changed(content, way, draw(ANYTHING))
        except (KeyError, IndexError, TypeError):  # the first change has taken this place away
            continue
    return content


@settings(max_examples=400, deadline=None)
@given(spoilt())
def test_what_the_schema_refuses_the_loader_refuses(content):
    if not CHECK.is_valid(content):
        assert not loads(content)


def test_an_editor_finds_what_it_needs():
    """The comment that YAML's language server reads names the schema; it leaves the file as it was."""
    text = (
        "# yaml-language-server: $schema=robot.schema.json\n"
        + (CATALOG / "six-legged-robot.yaml").read_text()
    )
    assert isinstance(parse_robot(text, "it"), kc.robots.ParallelRobot)
    assert yaml.safe_load(text)["kind"] == "parallel-robot"
