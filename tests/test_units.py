"""Numbers with units in robot files and options: factors against definitions, round trips, bad units."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

import knode_cosserat as kc
from knode_cosserat._units import PREFIXED, PREFIXES, UnitError, in_unit, numbers_with_units, unit_of
from knode_cosserat.rods.robot_file import RobotFileError, format_robot, parse_robot

#: text, unit of the result, and the number by definition
DEFINED = [
    ("250 mm", "m", 0.25),
    ("1.4mm", "m", 0.0014),
    ("50 GPa", "Pa", 50e9),
    ("1.08 g/cm3", "kg/m3", 1080.0),
    ("1080 kg/m^3", "kg/m3", 1080.0),
    ("180 deg", "rad", math.pi),
    ("90°", "rad", math.pi / 2),
    ("18 1/m", "1/m", 18.0),
    ("2 1/(N s)", "1/(N s)", 2.0),
    ("3 g/(m s)", "kg/(m s)", 3e-3),
    ("5 N mm", "N m", 5e-3),
    ("0.3 N mm2", "N m2", 3e-7),
    ("-9810 mm/s²", "m/s2", -9.81),
    ("20 %", "", 0.2),
    ("1 bar", "Pa", 1e5),
    ("600 mbar", "Pa", 6e4),
    ("1 in", "m", 0.0254),
    ("3 ml", "m3", 3e-6),
    ("12 mT", "T", 0.012),
]


@pytest.mark.parametrize(("text", "unit", "number"), DEFINED)
def test_a_number_with_a_unit_has_its_value_in_si_units(text, unit, number):
    assert in_unit(text, unit) == pytest.approx(number, rel=1e-14)


@pytest.mark.parametrize("text", ["250", "mm", "", "1e5", "1:30", "length", "-", "0.1, 0.2", "1 2"])
def test_other_texts_are_no_numbers_with_units(text):
    assert in_unit(text, "m") is None


@pytest.mark.parametrize(
    ("text", "units", "numbers"),
    [
        ("7 5 5 7", ["N"], [7.0, 5.0, 5.0, 7.0]),
        ("5 N, 2kN;[3]", ["N"], None),
        ("[5 N, 2kN; 3]", ["N"], [5.0, 2000.0, 3.0]),
        ("90deg, -2 mm, 0.1", ("rad", "m"), [math.pi / 2, -0.002, 0.1]),
        ("5 N,b", ["N"], None),
        ("5 N,1 2", ["N"], None),
        ("5 N", (), None),
    ],
)
def test_lists_of_numbers_may_have_units(text, units, numbers):
    assert numbers_with_units(text, units) == numbers


@pytest.mark.parametrize(
    ("text", "unit", "words"),
    [
        ("250 mm", "Pa", "mm is no unit of a number in Pa"),
        ("3 furlong", "m", "'furlong' is not known"),
        ("3 mm", "", "this number has no unit"),
        ("3 m/", "m", "not known"),
        ("3 m m", "m", "m m is no unit"),
    ],
)
def test_units_of_another_kind_are_refused(text, unit, words):
    with pytest.raises(UnitError, match=words):
        in_unit(text, unit)


@given(
    st.floats(-1e6, 1e6),
    st.sampled_from(sorted(PREFIXES)),
    st.sampled_from(sorted(PREFIXED)),
    st.integers(1, 3),
)
def test_a_number_comes_back_from_any_prefixed_unit(number, prefix, symbol, power):
    text = f"{prefix}{symbol}{power if power > 1 else ''}"
    expected = unit_of(symbol).factor ** power * PREFIXES[prefix] ** power
    # a symbol with a prefix may be a unit of its own, such as min
    if prefix + symbol in {"min"}:
        return
    assert unit_of(text).factor == pytest.approx(expected, rel=1e-12)
    base = "".join(
        f" {name}{exponent}"
        for name, exponent in zip(("m", "kg", "s", "A", "rad"), unit_of(text).dimension, strict=True)
        if exponent
    )
    assert in_unit(f"{number!r} {text}", base.strip()) == pytest.approx(
        number * expected, rel=1e-12, abs=1e-300
    )


@given(st.text(max_size=12))
def test_no_text_crashes(text):
    try:
        found = in_unit(text, "m")
    except UnitError:
        return
    assert found is None or math.isfinite(found)


SI = """
format: 2
kind: routed-tendon-robot
parameters:
  length: 0.25
  radius: 0.0014
  density: 1080
  youngs_modulus: 50e9
  tendon_offset: 0.008
  tendon_angles: [0, 1.5707963267948966]
  gravity: [0, 0, -9.81]
  loads:
    - {kind: attached-mass, at: 1, mass: 0.02}
"""
WITH_UNITS = """
format: 2
kind: routed-tendon-robot
parameters:
  length: 250 mm
  radius: 1.4mm
  density: 1.08 g/cm3
  youngs_modulus: 50 GPa
  tendon_offset: 0.8 cm
  tendon_angles: [0, 90 deg]
  gravity: [0, 0, -9810 mm/s2]
  loads:
    - {kind: attached-mass, at: 1, mass: 20 g}
"""


def test_a_robot_file_with_units_is_the_same_robot():
    assert format_robot(parse_robot(WITH_UNITS, "a")) == format_robot(parse_robot(SI, "b"))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("250 mm", "250 furlong", "the unit 'furlong' is not known"),
        ("250 mm", "250 g", "g is no unit of a number in m"),
        ("20 g", "20 mm", "mm is no unit of a number in kg"),
        ("250 mm", "250 m", "length must be .*250"),
    ],
)
def test_a_robot_file_with_a_wrong_unit_is_refused_in_one_line(old, new, words):
    with pytest.raises(RobotFileError, match=words) as refused:
        parse_robot(WITH_UNITS.replace(old, new), "mine.yaml")
    assert "\n" not in str(refused.value) and str(refused.value).startswith("mine.yaml: ")


def test_options_take_units(tmp_path):
    from knode_cosserat.cli.arguments import modified

    robot = kc.load_robot("delrin-tendon-robot")
    changed = modified(robot, ["length=250 mm", "youngs_modulus=2GPa", "gravity=[0, 0, -9.81 m/s2]"])
    assert changed.length == 0.25 and changed.youngs_modulus == 2e9 and changed.gravity[2] == -9.81
    with pytest.raises(ValueError, match="kg is no unit of a number in m"):
        modified(robot, ["length=250 kg"])
