import os
import re
import warnings
from pathlib import Path
from typing import Any, ClassVar

import hypothesis.strategies as st
import jax
import numpy as np
import pytest
import yaml
from hypothesis import given, settings

import knode_cosserat as kc
from knode_cosserat import catalog, load_robot, save_robot
from knode_cosserat.cli.arguments import modified
from knode_cosserat.robots import Observed, RobotFileError, TendonRobot, parameter
from knode_cosserat.rods import robot_file
from knode_cosserat.rods.robot_file import format_robot, parse_robot

PAPER = "delrin-tendon-robot"
HEAD = "format: 1\nkind: tendon-robot\n"
BODY = {"length": "0.635", "radius": "0.003", "density": "1400.0", "youngs_modulus": "2.0e+9"}


def text(**changes):
    """A right file's text with some parameters changed; None leaves one out."""
    values = {key: value for key, value in {**BODY, **changes}.items() if value is not None}
    return HEAD + "parameters:\n" + "".join(f"  {key}: {value}\n" for key, value in values.items())


def fails(*parts):
    """A `RobotFileError` of one line that has all the parts, in order."""
    return pytest.raises(RobotFileError, match=r"^(?!.*\n).*" + ".*".join(map(re.escape, parts)))


def assert_equal(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert np.array_equal(one, other)


# what comes with the package


def test_the_papers_robot():
    robot = load_robot(PAPER)
    assert isinstance(robot, TendonRobot)
    for name, value in {
        "length": 0.635,
        "radius": 0.003175,
        "density": 1411.6751,
        "youngs_modulus": 2.757903e9,
        "shear_damping": np.zeros((3, 3)),
        "bending_damping": 0.03 * np.eye(3),
        "drag": 1e-4 * np.eye(3),
        "gravity": [0, 0, -9.81],
        "tendon_angles": np.pi / 4 + np.arange(4) * np.pi / 2,
    }.items():
        assert np.array_equal(getattr(robot, name), value), name
    assert robot.nodes == 10
    assert robot.shear_modulus is None
    assert robot.G == 2.757903e9 / 2.6


@pytest.mark.parametrize("name", catalog())
def test_the_catalog(name):
    description = catalog()[name]
    assert description
    assert "\n" not in description
    robot = load_robot(name)
    assert_equal(robot, load_robot(Path(robot_file.__file__).parent / "catalog" / f"{name}.yaml"))
    assert_equal(robot, parse_robot(format_robot(robot), "here"))


def test_every_number_in_the_catalog_has_its_unit_beside_it():
    for file in Path(robot_file.__file__).parent.glob("catalog/*.yaml"):
        content = file.read_text(encoding="utf-8")
        stated = robot_file.KINDS[yaml.safe_load(content)["kind"]].parameters()
        for name, value in re.findall(r"^  (\w+): (.*)$", content, flags=re.MULTILINE):
            unit = stated[name].unit if name in stated else ""
            assert f"  # {unit}" in value, name


# round trips


def numbers(stated):
    return st.floats(stated.low, stated.high, allow_subnormal=False)


def values(stated):
    if stated.shape == "scalar":
        return numbers(stated)
    if stated.shape == "vector":
        return st.lists(numbers(stated), min_size=3, max_size=3)
    if stated.shape == "list":
        return st.lists(numbers(stated), min_size=1, max_size=6)
    return numbers(stated) | st.lists(numbers(stated), min_size=3, max_size=3) | st.just(coupled(stated))


def coupled(stated):
    size = min(stated.high, max(1.0, stated.low))
    return (size * np.array([[0.5, 0.1, 0], [0.1, 0.3, 1e-3 / 3], [0, 1e-3 / 3, 0.2]])).tolist()


def robots():
    stated = TendonRobot.parameters()
    required = {name: values(it) for name, it in stated.items() if name in BODY}
    optional = {name: values(it) for name, it in stated.items() if name not in BODY}
    optional |= {"nodes": st.integers(2, 200)}
    return st.fixed_dictionaries(required, optional=optional).map(lambda given: TendonRobot(**given))


@settings(max_examples=60, deadline=None)
@given(robots(), st.text(max_size=40))
def test_robots_come_back_equal(robot, description):
    content = format_robot(robot, description)
    assert_equal(parse_robot(content, "here"), robot)
    assert yaml.safe_load(content).get("description", "") == description
    # any other reader of YAML finds numbers where there are numbers
    assert isinstance(yaml.safe_load(content)["parameters"]["length"], float)


def test_files_come_back_equal(tmp_path):
    robot = load_robot(PAPER).replace(youngs_modulus=1e9 / 3, shear_stiffness=[1.0, 2.0, 3.0], nodes=7)
    path = tmp_path / "mine.yaml"
    save_robot(robot, path, description="a: strange # one")
    assert_equal(load_robot(path), robot)
    assert_equal(load_robot(str(path)), robot)
    content = path.read_text(encoding="utf-8")
    assert yaml.safe_load(content)["description"] == "a: strange # one"
    assert "\n  radius: 0.003175  # m, radius of the rod\n" in content
    assert "\n  bending_damping: 0.03  # N m2 s" in content
    assert "\n  shear_stiffness: [1.0, 2.0, 3.0]  # N" in content
    assert "shear_modulus" not in content


def test_traced_leaves_come_back_equal():
    robot = jax.tree.map(jax.numpy.asarray, load_robot(PAPER))
    assert_equal(parse_robot(format_robot(robot), "here"), robot)


# what may be left out, and how numbers may be written


def test_defaults():
    robot = parse_robot(text(), "here")
    assert robot.nodes == 10
    assert robot.shear_modulus is None
    assert np.array_equal(robot.gravity, [0, 0, -9.81])
    assert_equal(parse_robot(text(shear_modulus="null", bending_stiffness=""), "here"), robot)


@pytest.mark.parametrize(
    "number", ["2e9", "2.0e9", "2.e9", "2E+9", "2000000000", "+2e9", "20_0e7", "2000000000.0"]
)
def test_numbers_as_people_write_them(number):
    if "_" in number:
        with fails("youngs_modulus must be a number", "(got '20_0e7')"):
            parse_robot(text(youngs_modulus=number), "here")
    else:
        assert parse_robot(text(youngs_modulus=number), "here").youngs_modulus == 2e9


@pytest.mark.parametrize(
    "matrix", ["0.03", "3e-2", "[0.03, 0.03, 0.03]", "[[0.03,0,0],[0,0.03,0],[0,0,0.03]]"]
)
def test_matrices(matrix):
    assert np.array_equal(parse_robot(text(bending_damping=matrix), "here").bending_damping, 0.03 * np.eye(3))


# errors


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        # missing and unknown
        ({"radius": None}, ["radius is missing; required is radius, or a cross_section"]),
        ({"youngs_module": "1.0"}, ["the key 'youngs_module' is unknown", "did you mean youngs_modulus?"]),
        ({"nickname": "x"}, ["parameters: the key 'nickname' is unknown", "length, radius"]),
        ({"1": "2"}, ["the key 1 is unknown"]),
        # wrong types
        ({"youngs_modulus": "2.7 mm"},
         ["youngs_modulus must be", "(got '2.7 mm'): mm is no unit of a number in Pa"]),
        ({"length": "'0.6'"}, ["length must be", "a number between 0.001 and 20 m", "(got '0.6'"]),
        ({"length": "yes"}, ["length must be", "(got 'yes'"]),
        ({"length": "true"}, ["length must be", "a number between 0.001 and 20 m", "(got True"]),
        ({"length": "null"}, ["length must be", "a number between 0.001 and 20 m", "(got None"]),
        ({"length": "[0.6, 0.7]"}, ["length must be", "a number between 0.001 and 20 m", "(got [0.6, 0.7]"]),
        ({"length": "{a: 1}"}, ["length must be", "a number", "(got {'a': 1}"]),
        ({"length": "1:30"}, ["length must be", "(got '1:30'"]),
        ({"length": "2001-01-01"}, ["length must be", "(got '2001-01-01'"]),
        ({"gravity": "9.81"},
         ["gravity must be", "three numbers, each between -100 and 100 m/s2", "(got 9.81"]),
        ({"gravity": "[0, 0]"}, ["gravity must be three numbers", "m/s2 (got [0, 0])"]),
        ({"gravity": "[0, 0, x]"}, ["gravity must be", "three numbers", "(got [0, 0, 'x']"]),
        ({"gravity": "[0, 0, true]"}, ["gravity must be", "three numbers", "(got [0, 0, True]"]),
        ({"gravity": "['0', '0', '-9.81']"}, ["gravity must be", "(got ['0', '0', '-9.81']"]),
        ({"drag": "[[1, 0, 0], [0, 1]]"},
         ["drag must be", "symmetric 3x3 matrix", "(got [[1, 0, 0], [0, 1]]"]),
        ({"drag": "[[1, 0], [0, 1]]"}, ["drag must be", "symmetric 3x3 matrix", "(got [[1, 0], [0, 1]]"]),
        ({"drag": "[[[1]]]"}, ["drag must be", "symmetric 3x3 matrix", "(got [[[1]]]"]),
        ({"tendon_angles": "0.5"}, ["tendon_angles must be", "a list of numbers, each", "(got 0.5"]),
        ({"tendon_angles": "[]"}, ["tendon_angles must be", "a list of numbers, each", "(got []"]),
        ({"nodes": "ten"}, ["nodes is 'ten'", "a whole number"]),
        ({"nodes": "10.0"}, ["nodes is 10.0", "a whole number"]),
        ({"nodes": "1"}, ["nodes is 1", "a whole number from 2 to 10000"]),
        ({"nodes": "true"}, ["nodes is True"]),
        ({"nodes": "010"}, ["nodes is 10.0"]),
        # values
        ({"youngs_modulus": "-2e9"},
         ["youngs_modulus must be", "between 1000 and 2e+12 Pa", "(got -2000000000.0"]),
        ({"bending_stiffness": "-1"},
         ["bending_stiffness must be", "with eigenvalues between 1e-15 and 1e+09 N m2", "(got -1"]),
        ({"bending_damping": "[0.1, 0.1, -0.1]"},
         ["bending_damping must be", "eigenvalues between 0 and", "(got [0.1, 0.1, -0.1]"]),
        ({"drag": "[[1, 2, 0], [0, 1, 0], [0, 0, 1]]"},
         ["drag must be", "a symmetric 3x3 matrix", "(got [[1, 2, 0], [0, 1, 0], [0, 0, 1]], not symmetric"]),
        ({"drag": "[[1, 2, 0], [2, 1, 0], [0, 0, 1]]"},
         ["drag must be", "with eigenvalues between 0 and 1000 kg/m2"]),
        ({"length": ".nan"}, ["length must be", "between 0.001 and 20 m", "(got nan"]),
        ({"length": ".inf"}, ["length must be", "between 0.001 and 20 m", "(got inf"]),
        ({"length": "1e999"}, ["length must be", "between 0.001 and 20 m", "(got inf"]),
        ({"length": "1" + 400 * "0"}, ["length must be", "between 0.001 and 20 m", "(got 1000"]),
        ({"length": 5000 * "1"}, ["not YAML: "]),
        ({"gravity": "[0, 0, .nan]"}, ["gravity must be", "(got [0, 0, nan]"]),
        # the wrong unit
        ({"length": "635"},
         ["length must be between 0.001 and 20 m (got 635). Did you mean 0.635 (635 mm)?"]),
        ({"radius": "3.175"},
         ["radius must be", "and 0.5 m", "(got 3.175", "Did you mean 0.003175 (3.175 mm)?"]),
        ({"radius": "3175"}, ["radius must be", "(got 3175", "Did you mean 0.003175 (3175 um)?"]),
        ({"youngs_modulus": "2.757903"},
         ["youngs_modulus must be", "(got 2.757903", "Did you mean 2757903000 (2.757903 GPa)?"]),
        ({"youngs_modulus": "700"}, ["Did you mean 700000000 (700 MPa)?"]),
        ({"shear_modulus": "1.06"},
         ["shear_modulus must be", "(got 1.06", "Did you mean 1060000000 (1.06 GPa)?"]),
        ({"density": "1400000"}, ["density must be", "(got 1400000", "Did you mean 1400 (1400000 g/m3)?"]),
        ({"gravity": "[0, 0, -9810]"}, ["Did you mean [0, 0, -9.81] ([0, 0, -9810] mm/s2)?"]),
        ({"tendon_angles": "[0, 90, 180, 270]"},
         ["each between -10 and 10 rad", "Did you mean [0, 1.570796", "([0, 90, 180, 270] degrees)?"]),
    ],
)  # fmt: skip
def test_parameters_that_are_not_right(changes, parts):
    with fails("robots/mine.yaml: ", *parts):
        parse_robot(text(**changes), "robots/mine.yaml")


def test_no_unit_is_suggested_where_none_would_be_typical():
    with pytest.raises(RobotFileError, match=r"length must be between 0.001 and 20 m \(got -1\)$"):
        parse_robot(text(length="-1"), "here")


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        ("", ["the file is empty", "format, kind and parameters"]),
        ("just text", ["the file is 'just text'", "a mapping"]),
        ("[1, 2]", ["the file is [1, 2]", "a mapping"]),
        (text().replace("format: 1\n", ""), ["the key 'format' is missing", "format, kind, parameters"]),
        (text().replace("format: 1", "format: 3"), ["format is 3", "allowed is 1 or 2"]),
        (text().replace("format: 1", "format: 3\nrods: 3"), ["format is 3", "allowed is 1 or 2"]),
        (text().replace("format: 1", "format: true"), ["format is True", "allowed is 1 or 2"]),
        (text().replace("kind: tendon-robot\n", ""), ["the key 'kind' is missing"]),
        (text().replace("tendon-robot", "tendonrobot"),
         ["kind is 'tendonrobot'", "did you mean tendon-robot?"]),
        (text().replace("tendon-robot", "[a]"), ["kind is ['a']", "allowed is text"]),
        (HEAD, ["the key 'parameters' is missing"]),
        (HEAD + "parameters:\n", ["parameters is None", "a mapping from names to values"]),
        (HEAD + "parameters: [1]\n", ["parameters is [1]", "a mapping from names to values"]),
        (text() + "colour: red\n", ["the key 'colour' is unknown", "format, kind, description"]),
        (text() + "descripton: red\n", ["the key 'descripton' is unknown", "did you mean description?"]),
        (text() + "description: 5\n", ["description is 5", "allowed is text"]),
        (text() + "  length: 0.7\n", ["line 8: not YAML: the key 'length' is there twice"]),
        (text() + "format: 1\n", ["line 8: not YAML: the key 'format' is there twice"]),
        (HEAD + "parameters: {length: 1,\n\n", ["line 5: not YAML: "]),
        (HEAD + "parameters:\n\tlength: 1\n", ["line 4: not YAML: found character '\\t'"]),
        (HEAD + "a: b: c\n", ["line 3: not YAML: mapping values are not allowed here"]),
        (text() + "---\n" + text(), ["line 8: not YAML: "]),
        (text(length="!!python/object/apply:os.getcwd []"), ["line 4: not YAML: ", "python/object/apply"]),
        (text(length="!!float abc"), ["line 4: not YAML: 'abc' cannot be read as !!float"]),
        (text(length="!!int ''"), ["line 4: not YAML: '' cannot be read as !!int"]),
        (text(length="!!timestamp noon"), ["line 4: not YAML: 'noon' cannot be read as !!timestamp"]),
        ("kind: !!bool maybe\n", ["line 1: not YAML: 'maybe' cannot be read as !!bool"]),
        (text(length="*there"), ["line 4: not YAML: found undefined alias"]),
        ("? [a, b]\n: c\n", ["line 1: not YAML: found unhashable key"]),
        ("!!map [1]\n", ["line 1: not YAML: "]),
        ("a: \x00", ["not YAML: unacceptable character"]),
        ("[" * 5000, ["not YAML: "]),
    ],
)  # fmt: skip
def test_files_that_are_not_right(content, parts):
    with fails("robots/mine.yaml: ", *parts):
        parse_robot(content, "robots/mine.yaml")


def without_end():
    """A list that is short in a file and has 10¹⁰ members."""
    lists = ["&a [" + ", ".join(["1"] * 10) + "]"]
    lists += [
        f"&{one} [{', '.join(['*' + other] * 10)}]"
        for other, one in zip("abcdefghi", "bcdefghij", strict=True)
    ]
    return f"[{', '.join(lists)}]"


@pytest.mark.parametrize("key", ["format", "kind", "description", "parameters", "colour"])
def test_what_would_print_without_end(key):
    with pytest.raises(RobotFileError) as error:
        parse_robot(f"{key}: {without_end()}\n" + text().replace(f"{key}:", f"was_{key}:"), "here")
    assert len(str(error.value)) < 500


@pytest.mark.parametrize("key", ["length", "gravity", "drag", "tendon_angles", "nodes"])
def test_parameters_that_would_print_without_end(key):
    with fails("here: with its aliases it has 1.23e+10 values; allowed are 200000"):
        parse_robot(text(**{key: without_end()}), "here")


def test_files_that_cannot_be_read(tmp_path):
    with fails("delrin-tendn-robot: no such file or robot", PAPER, f"did you mean {PAPER}?"):
        load_robot("delrin-tendn-robot")
    (tmp_path / "mine.yaml").write_text(text())
    with fails("mine.yml: no such file or robot", "the catalog has ", f"did you mean {tmp_path}/mine.yaml?"):
        load_robot(tmp_path / "mine.yml")
    with fails("no/where.yaml: no such file or robot"):
        load_robot(tmp_path / "no" / "where.yaml")
    with fails("no such file or robot"):
        load_robot("x" * 5000)
    with fails(f"{tmp_path}: cannot be read"):
        load_robot(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\x89HDF\xff\xfe")
    with fails("binary.yaml: it is not UTF-8 text"):
        load_robot(tmp_path / "binary.yaml")


class Pendulum(kc.System):
    """A class that no file can name."""

    y_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout(("x", 1, "m", "somewhere"))
    z_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout()
    control_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout()
    base_unknowns: ClassVar[tuple[str, ...]] = ()
    length: Any = parameter("m", "length", low=0.0, high=1.0)

    def rest(self, s):
        return np.zeros(1), np.zeros(0)

    def tip(self, t, control, y, y_t):
        return np.zeros(0)


def test_what_cannot_be_saved(tmp_path):
    with fails("a Pendulum cannot be written", "KINDS: TendonRobot"):
        save_robot(Pendulum(0.5), tmp_path / "a.yaml")
    robot = load_robot(PAPER)
    with fails("a batch of robots"):
        save_robot(jax.tree.map(lambda *leaves: np.stack(leaves), robot, robot), tmp_path / "a.yaml")
    with fails("a.yaml: cannot be written"):
        save_robot(robot, tmp_path / "no" / "a.yaml")
    assert not (tmp_path / "a.yaml").exists()
    with pytest.raises(RobotFileError, match="inside jit"):
        jax.jit(format_robot)(robot)


def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch):
    robot = load_robot(PAPER)
    save_robot(robot, tmp_path / "a.yaml")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with fails("a.yaml: cannot be written: No space left on device"):
        save_robot(robot.replace(length=0.5), tmp_path / "a.yaml")
    assert_equal(load_robot(tmp_path / "a.yaml"), robot)
    assert os.listdir(tmp_path) == ["a.yaml"]


def test_other_kinds_can_join(monkeypatch):
    monkeypatch.setitem(robot_file.KINDS, "pendulum", Pendulum)
    pendulum = Pendulum(0.25, nodes=5)
    assert_equal(parse_robot(format_robot(pendulum), "here"), pendulum)
    with fails("length must be between 0 and 1 m (got 2)"):
        parse_robot("format: 1\nkind: pendulum\nparameters: {length: 2}\n", "here")


# tendons of the paper's model


def warned(call):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        call()
    return [str(each.message) for each in seen if "routed-tendon-robot" in str(each.message)]


def test_an_offset_that_the_papers_model_ignores_is_named(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(text(tendon_offset="0.012"), encoding="utf-8")
    (message,) = warned(lambda: load_robot(file))
    assert message.startswith(f"{file}: kind tendon-robot is the paper's model")
    # the offset is indeed ignored
    robot = load_robot(PAPER)
    one, other = (
        Observed.of(robot.replace(tendon_offset=each)).actuation(np.arange(4.0)) for each in (0.0, 0.05)
    )
    np.testing.assert_array_equal(one, other)
    assert len(warned(lambda: modified(robot, ["tendon_offset=0.03"]))) == 1


@pytest.mark.parametrize(
    "change", [{}, {"tendon_offset": "0.02"}, {"tendon_offset": "0.0"}, {"kind": "routed-tendon-robot"}]
)
def test_other_robots_are_not_warned_of(tmp_path, change):
    kind = change.pop("kind", "tendon-robot")
    file = tmp_path / "mine.yaml"
    words = text(**change) if kind == "tendon-robot" else text(tendon_offset="0.02")
    file.write_text(words.replace("kind: tendon-robot", f"kind: {kind}"), encoding="utf-8")
    assert warned(lambda: load_robot(file)) == []
    assert warned(lambda: load_robot(PAPER)) == []
    assert warned(lambda: modified(load_robot(PAPER), ["length=0.4"])) == []
