"""The section `hardware` of robot files: read by drivers and CAD, ignored by the simulation."""

import jax
import jsonschema
import pytest
import yaml

import knode_cosserat as kc
from knode_cosserat.rods.robot_file import RobotFileError, format_robot, parse_robot
from knode_cosserat_hardware import Dimensions, HardwareError, Limits, load_hardware
from knode_cosserat_hardware.description import HardwareDescription

TEXT = format_robot(kc.load_robot("delrin-tendon-robot"))


@pytest.fixture
def described(tmp_path, monkeypatch):
    """Function that returns the hardware of a robot file with a section."""
    monkeypatch.chdir(tmp_path)

    def load(section):
        (tmp_path / "robot.yaml").write_text(TEXT + yaml.safe_dump({"hardware": section}))
        return load_hardware("robot.yaml")

    return load


def test_values_are_read_and_others_have_defaults(described):
    section = {"tension": {"high": 9.0, "rate": 20.0}, "spool_radius": 0.012, "rib_count": 7}
    found = described(section)
    assert found.tension == Limits(0.0, 9.0, 20.0, 60.0)
    assert found.dimensions == Dimensions(spool_radius=0.012, rib_count=7)
    assert found.dimensions.rib_diameter == 0.05 and found.dimensions.base_height == 0.0635


@pytest.mark.parametrize("name", kc.catalog())
def test_robots_of_the_catalog_have_hardware(name):
    assert isinstance(load_hardware(name), HardwareDescription)


def test_no_section_means_defaults(described):
    assert load_hardware("delrin-tendon-robot") == described(None) == described({}) == HardwareDescription()


def test_the_robot_is_the_same_with_a_section():
    with_section = parse_robot(TEXT + "hardware: {spool_radius: 0.012}\n", "robot.yaml")
    plain = parse_robot(TEXT, "robot.yaml")
    assert all(
        a is b or (a == b).all()
        for a, b in zip(jax.tree.leaves(with_section), jax.tree.leaves(plain), strict=True)
    )
    check = jsonschema.Draft202012Validator(kc.robots.robot_schema())
    check.validate(yaml.safe_load(TEXT + "hardware: {tension: {low: 1.0}}\n"))


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"spool_radus": 0.01}, "did you mean spool_radius"),
        ({"tension": {"hihg": 3.0}}, "did you mean high"),
        ({"tension": 5.0}, "hardware.tension is 5.0; allowed is low, high"),
        ({"tension": {"high": "15 N"}}, "high must be between"),
        ({"tension": {"rate": float("nan")}}, "rate must be between .* N/s"),
        ({"tension": {"low": 5.0, "high": 4.0}}, "low must be below high"),
        ({"tension": {"low": 5.0, "total": 4.0}}, "total must be at least low"),
        ({"spool_radius": 10.0}, r"Did you mean 0.01 \(10 mm\)"),
        ({"rib_count": 4.5}, "rib_count must be a whole number"),
        ({"rib_count": True}, "rib_count must be a whole number"),
        ([1], "allowed is a mapping"),
        ({3: 4}, "the key 3 is unknown"),
    ],
)
def test_errors_are_one_line_with_the_file(described, section, message):
    with pytest.raises(RobotFileError, match=message) as caught:
        described(section)
    assert "\n" not in str(caught.value) and str(caught.value).startswith("robot.yaml: hardware")


def test_a_section_that_is_no_mapping_is_refused_by_the_loader_too():
    with pytest.raises(RobotFileError, match="hardware is 5; allowed is a mapping"):
        parse_robot(TEXT + "hardware: 5\n", "robot.yaml")
    parse_robot(TEXT + "hardware:\n", "robot.yaml")


def test_a_file_that_is_not_there_is_named():
    with pytest.raises(RobotFileError, match="did you mean delrin-tendon-robot"):
        load_hardware("delrin-tendon-robt")


def test_dimensions_and_limits_in_code_are_checked():
    with pytest.raises(HardwareError, match="hole_diameter must be between"):
        Dimensions(hole_diameter=-1.0)
    with pytest.raises(HardwareError, match="high must be between"):
        Limits(high=float("inf"))
