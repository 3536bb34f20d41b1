"""Passports of all kinds of robots: what leaves the learned range is marked, also of robots from files."""

import dataclasses
import json

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.rods.parameters import ParameterError
from knode_cosserat.rods.passport import MARGIN, LearnedRange, Origin, Passport, with_passport

TENDONS = kc.load_robot("delrin-routed-tendon-robot").replace(nodes=5)
ORIGIN = Origin("a.csv", "0f" * 32, 81, 4.0, held_out_error=1.25e-3)

#: robot, controls that it learned from, the control that is raised, and its unit
KINDS = {
    "tendons": (TENDONS, 2.0 + 4.0 * np.eye(4), "tension_2", "N"),
    "chambers": (
        kc.load_robot("three-chamber-arm"),
        1e4 * (1.0 + 2.0 * np.eye(3)),
        "pressure_2",
        "Pa",
    ),
    "tubes": (
        kc.load_robot("three-tube-robot"),
        np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.3, 0.02, -0.2, 0.01, 0.1, 0.0]]),
        "insertion_1",
        "m",
    ),
    "magnets": (
        kc.load_robot("magnetic-catheter"),
        np.array([[0.0, 0.0, 0.0], [0.01, 0.01, 0.0]]),
        "load0_By",
        "T",
    ),
}


def learned_robot(robot, controls):
    """Return a robot that learned from its equilibria under controls."""
    rows = kc.solvers.equilibria(robot, controls, with_stability=False)
    return with_passport(robot, Passport.of("identify", [ORIGIN], robot, [rows]))


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_of_robot_is_marked_just_outside_and_not_inside(kind, tmp_path):
    robot, controls, name, unit = KINDS[kind]
    robot = learned_robot(robot, controls)
    column = robot.control_layout.labels.index(name)
    low, high = robot.passport.bounds("controls", robot.control_layout)
    np.testing.assert_allclose((low, high), (controls.min(axis=0), controls.max(axis=0)))
    # the tolerance is a tenth of the widest range in the field
    field = next(it for it in robot.control_layout.fields if name.startswith(it.name))
    slack = MARGIN * robot.control_layout.get(high - low, field.name).max()
    rows = np.repeat(controls[1:2], 2, axis=0)
    rows[:, column] = high[column] + slack * np.array([0.9, 1.1])
    kc.save_robot(robot, tmp_path / "robot.yaml")
    words = []
    for known in (robot, kc.load_robot(tmp_path / "robot.yaml")):
        found = kc.solvers.equilibria(known, rows, with_stability=False)
        numbers = {"control": found.control, "z": None}
        assert known.passport.outside(known, **numbers).tolist() == [False, True]
        (excess,) = known.passport.excesses(known, **numbers)
        assert excess[:2] == (name, unit)
        np.testing.assert_allclose(excess[2:5], (rows[1, column], low[column], high[column]))
        assert found.extrapolated[1] and str(excess) in found.extrapolation
        assert "EXTRAPOLATION: " in str(found)
        words.append(found.extrapolation)
    assert words[0] == words[1]
    assert not kc.solvers.equilibria(robot, controls, with_stability=False).extrapolated.any()


def test_a_stepper_marks_its_rows():
    known = {"tension": LearnedRange("N", np.full(4, 2.0), np.full(4, 6.0))}
    stepper = kc.solvers.Stepper(with_passport(TENDONS, Passport("fit", controls=known)), 0.05)
    assert stepper.step([2.0, 3.0, 2.0, 2.0]).extrapolated.tolist() == [False]
    row = stepper.step([2.0, 9.0, 2.0, 2.0])
    assert row.extrapolated.tolist() == [True] and "tension_2 is 9 N (learned 2 to 6)" in str(row)


def test_a_file_holds_all_of_it(tmp_path):
    robot = learned_robot(TENDONS, 2.0 + 4.0 * np.eye(4))
    kc.save_robot(robot, tmp_path / "robot.yaml")
    again = kc.load_robot(tmp_path / "robot.yaml")
    plain = robot.passport.to_dict()
    assert again.passport.to_dict() == plain == json.loads(json.dumps(plain))
    assert again.passport.origins == (ORIGIN,)
    assert again.replace(length=0.5).passport.to_dict() == robot.passport.to_dict()
    text = str(again.passport)
    assert "learned by identify, 20" in text and "  tension: 2 to 6, 2 to 6, 2 to 6, 2 to 6 N" in text
    assert "a.csv: 81 rows, 4 s at 20 Hz, sha256 0f0f0f0f0f0f; tip error when held out 1.25 mm" in text
    # a motion's file has the robot's passport too
    kc.simulate(robot, np.full((1, 4), 9.0), 0.05).save(tmp_path / "motion.nc")
    motion = kc.load_trajectory(tmp_path / "motion.nc")
    assert "tension_1 is 9 N" in motion.extrapolation


def test_texts_that_look_like_numbers_stay_texts(tmp_path):
    passport = Passport("fit", (Origin("1e5", "1" * 64, 3),), versions={"numpy": "2.4"}, date="2026")
    kc.save_robot(with_passport(TENDONS, passport), tmp_path / "robot.yaml")
    assert kc.load_robot(tmp_path / "robot.yaml").passport.to_dict() == passport.to_dict()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"command": 3}, "passport.command is 3; allowed is text"),
        ({"recordings": []}, "allowed is a mapping of command"),
        ({"origins": [{"name": "a"}]}, "the key sha256 is missing"),
        ({"origins": ["a"]}, "passport.origins.0 is 'a'; allowed is a mapping"),
        (
            {"controls": {"tension": {"unit": "N", "low": [0.0], "high": [1.0, 2.0]}}},
            "numbers in low",
        ),
        ({"strains": {"u": {"unit": "1/m", "low": [1.0], "high": [0.0]}}}, "low above high"),
        ({"strains": {"u": {"unit": "1/m", "low": [float("nan")], "high": [0.0]}}}, "numbers in low"),
        ({"versions": {"jax": 1}}, "passport.versions.jax is 1; allowed is text"),
    ],
)
def test_a_damaged_passport_is_refused_in_one_line(change, reason):
    with pytest.raises(ParameterError, match=reason) as error:
        Passport.from_dict(Passport("fit", (ORIGIN,)).to_dict() | change)
    assert "\n" not in str(error.value)


def test_each_kind_of_number_is_judged_with_a_margin():
    robot = TENDONS
    one = {"u": np.ones(3), "v": np.ones(3)}
    ranges = {
        "strains": {name: LearnedRange("1", -it, it) for name, it in one.items()},
        "rates": {name: LearnedRange("1", -it, it) for name, it in one.items()},
        "controls": {"tension": LearnedRange("N", np.zeros(4), np.full(4, 10.0))},
    }
    passport = Passport("fit", **ranges)
    time, control, z = np.arange(4.0) / 100, np.zeros((4, 4)), np.zeros((4, 3, 6))

    def rows(**changes):
        given = {"time": time, "control": control, "z": z} | changes
        return passport.outside(robot, **given).tolist()

    assert rows() == [False] * 4
    strained = z.copy()
    strained[2:, 1, 4] = 1.0 + 2.0 * MARGIN + 1e-6  # and so fast: row 2 for both, row 3 for the strain
    assert rows(z=strained, time=100 * time) == [False, False, True, True]
    strained[2:, 1, 4] = 1.0 + 2.0 * MARGIN - 1e-6
    assert rows(z=strained, time=1e4 * time) == [False] * 4
    assert rows(z=strained) == [False, False, True, False]
    assert "rate of strain u_2 is" in str(passport.excesses(robot, control=control, z=strained, time=time)[0])
    assert rows(z=strained, time=None) == [False] * 4
    pulling = control.copy()
    pulling[2, 3] = 10.0 + 10.0 * MARGIN + 1e-6
    assert rows(control=pulling) == [False, False, True, False]
    assert rows(z=np.full((4, 3, 6), np.nan)) == [False] * 4
    # a field that the robot has no more, or with other numbers, is not judged
    other = dataclasses.replace(passport, controls={"tension": LearnedRange("N", np.zeros(3), np.zeros(3))})
    assert other.outside(robot, control=pulling, z=z, time=time).tolist() == [False] * 4


def test_a_batch_has_a_range_for_each_robot_and_none_if_one_is_unknown():
    narrow, wide = (
        with_passport(
            TENDONS,
            Passport("fit", controls={"tension": LearnedRange("N", np.zeros(4), np.full(4, high))}),
        )
        for high in (2.0, 9.0)
    )
    controls = np.full((2, 4), 5.0)
    both = kc.simulate([narrow, wide], controls, 0.05)
    assert both.extrapolated[:, 1:].tolist() == [[True, True], [False, False]]
    assert "tension_1 is 5 N (learned 0 to 2)" in both.extrapolation
    assert kc.simulate([narrow, TENDONS], controls, 0.05).extrapolated is None


def test_a_robot_without_controls_has_a_range_of_strains():
    rod = kc.robots.SlenderRod(
        length=0.3, radius=0.002, density=1000.0, youngs_modulus=1e8, bending_damping=1e-4, nodes=5
    )
    motion = kc.simulate(rod, np.zeros((3, 0)), 0.01, initial="unstressed")
    passport = Passport.of("identify", [], rod, [motion])
    assert not passport.controls and set(passport.strains) == {"v", "u"}
