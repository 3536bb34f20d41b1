"""Controls by name: of robots that are driven by other things than tensions, or by more."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat import named_controls
from tests.test_controls import DT, fails, written

ROD = kc.robots.SlenderRod(
    length=0.5, radius=0.005, density=1000.0, youngs_modulus=2e7,
    base_end=kc.robots.ends.Driven(axes=("x", "z", "ry")),
)  # fmt: skip
NAMED = "time [s],base_z [m],base_ry [rad]\n"


def test_a_file_of_named_controls(tmp_path):
    path = written(tmp_path, "\ufeffbase_ry [rad], time [s] ,base_z [m]\n5,0,1\n\n 6,0.1, 2\n7,0.2,3\n")
    found = named_controls.parse(ROD, str(path), None, 0.1)
    assert found.tolist() == [[0, 1, 5], [0, 2, 6], [0, 3, 7]]
    assert np.array_equal(named_controls.parse(ROD, str(path), 2, 0.1), found[:2])
    assert named_controls.parse(ROD, str(path), 4, 0.05)[:, 1].tolist() == [1, 1, 2, 2]
    with fails("there are 3 steps of 0.1 s; 4 are requested; allowed is up to 3"):
        named_controls.parse(ROD, str(path), 4, 0.1)
    path = written(tmp_path, "time [s]\n0\n0.1\n")
    assert named_controls.parse(ROD, str(path), None, 0.1).tolist() == [[0, 0, 0]] * 2


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["the file is empty", "time [s],base_x [m],base_z [m],base_ry [rad]"]),
        (NAMED, ["no rows"]),
        (NAMED + "0,1,2,3\n0.1,1,2,3\n", ["line 2 has 4 cells", "allowed is 3, like the header"]),
        (NAMED + "0,1,2\n\n0.1,1,2,3\n", ["line 4 has 4 cells"]),
        (NAMED + "0,1,2\n0.1,1\n", ["line 3 has 2 cells"]),
        ("time [s],base_z [m], base_z [m]\n0,1,2\n", ["line 1: the columns are", "once each"]),
        ("time [s],base_z [m],base_z [m]\n0,1,2\n", ["line 1: the columns are", "once each"]),
        ("time [s],time [s] ,base_z [m]\n0,1,2\n", ["line 1: the columns are", "once each"]),
        ("time [s],base_z [mm]\n0,1\n", ["line 1: the columns are time [s], base_z [mm]", "base_z [m]"]),
        ("base_z [m]\n0\n", ["line 1: the columns are base_z [m]", "allowed is time [s]"]),
        (NAMED + "0,true,2\n0.1,false,2\n", ["line 2: base_z [m] is 'true'", "a finite number"]),
        (NAMED + "0,1,2\n0.1,,2\n", ["line 3: base_z [m] is ''"]),
        (NAMED + "0,1,nan\n", ["line 2: base_ry [rad] is 'nan'"]),
        (NAMED + "0,1,2\n0,1,2\n", ["line 3: time is 0.0 s"]),
    ],
)
def test_files_of_named_controls_that_are_not_right(tmp_path, text, parts):
    path = written(tmp_path, text)
    with fails(str(path), *parts):
        named_controls.parse(ROD, str(path), None, DT)


@pytest.mark.parametrize("file", [True, False])
@pytest.mark.parametrize(
    ("steps", "dt", "parts"),
    [
        (0, DT, ["steps is 0", "from 1 on"]),
        (-3, DT, ["steps is -3"]),
        (True, DT, ["steps is True"]),
        (2.0, DT, ["steps is 2.0", "a whole number"]),
        (2, 0, ["dt is 0", "above 0"]),
        (2, -0.1, ["dt is -0.1"]),
        (2, np.nan, ["dt is nan"]),
        (2, np.inf, ["dt is inf"]),
    ],
)
def test_steps_that_are_not_right(tmp_path, file, steps, dt, parts):
    path = written(tmp_path, NAMED + "0,1,2\n1,1,2\n")
    with fails(*parts):
        named_controls.parse(ROD, str(path) if file else "base_z=ramp:1", steps, dt)


@pytest.mark.parametrize(
    ("specification", "parts"),
    [
        ("base_z=sine:1e-320", ["'base_z=sine:1e-320'", "a value is nan", "finite"]),
        ("base_z=constant:1; base_ry=ramp:1e308,base=1e308", ["'base_ry=ramp:", "a value is inf"]),
        ("base_z=sine:0", ["period is 0.0"]),
        (
            "base_z=ramp:1; base_x=ramp:1;base_z=constant:2",
            [
                "'base_z=constant:2': base_z is given already, by 'base_z=ramp:1'",
                "allowed is each control once",
            ],
        ),
    ],
)
def test_named_signals_that_are_not_right(specification, parts):
    with fails(*parts):
        named_controls.parse(ROD, specification, 5, DT)


def test_all_numbers_of_a_field_and_one_of_them_are_given_twice():
    robot = kc.load_robot("delrin-routed-tendon-robot").replace(drive="reel")
    for words in ("reel=ramp:0.01;reel_2=constant:0", "reel_2=constant:0;reel=ramp:0.01"):
        with fails("reel_2 is given already, by"):
            named_controls.parse(robot, words, 5, DT)


def test_a_signal_without_effect_during_the_run_is_refused():
    with fails("base_z=step:1,at=2", "the step starts at 2 s, after the end of the run", "use 40 steps"):
        named_controls.parse(ROD, "base_z=step:1,at=2", 10, DT)
    with fails("ramp: start is 2.0 s", "before the last step"):
        named_controls.parse(ROD, "base_z=ramp:1,start=2", 10, DT)
    with fails("base_z=sine:0.1", "the sine has the same value at every time step"):
        named_controls.parse(ROD, "base_z=sine:0.1", 10, DT)
    assert named_controls.parse(ROD, "base_z=step:1,at=2", 40, DT)[-1, 1] == 1.0
    assert np.all(named_controls.parse(ROD, "base_z=step:1", 10, DT)[:, 1] == 1.0)


ROBOT = kc.load_robot("delrin-tendon-robot")


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("tension_4=ramp:2", {3: 2.0 * np.array([1, 3, 5, 7]) / 7}),
        (" tension_2 = 3 ; tension_1=step:1,at=0.1", {0: [0.0, 0.0, 1.0, 1.0], 1: [3.0] * 4}),
        ("tension=5", {k: [5.0] * 4 for k in range(4)}),
        ("tension_3=sine:0.2,base=2,amplitude=1", {2: 2.0 + np.sin(np.pi * (np.arange(4) + 0.5) / 2)}),
        ("none", {}),
    ],
)
def test_tendons_have_names_too_and_the_others_are_slack(word, expected):
    found = named_controls.parse(ROBOT, word, 4, 0.05)
    rows = np.zeros((4, 4))
    for column, values in expected.items():
        rows[:, column] = values
    np.testing.assert_allclose(found, rows, atol=1e-12)
    np.testing.assert_array_equal(named_controls.parse(ROBOT.control_layout, word, 4, 0.05), found)


def test_signals_of_the_paper_are_still_for_all_tendons():
    for word in ("sine:0.2,base=8", "ramp:2,tendons=4", "7,5,5,7"):
        np.testing.assert_array_equal(
            named_controls.parse(ROBOT, word, 4, 0.05), kc.controls.parse(word, 4, 0.05)
        )


@pytest.mark.parametrize(
    ("word", "parts"),
    [
        ("tension_5=ramp:2", ["the control 'tension_5' is unknown", "tension_1, tension_2"]),
        ("tension_1=sine:0.2", ["a tension is -0.7", "allowed is 0 or more"]),
        ("tension=5;tension_1=3", ["tension_1 is given already"]),
        ("tension_1=5,tension_2=3", ["the signal '5,tension_2=3' is unknown"]),
    ],
)
def test_named_tensions_that_are_not_right(word, parts):
    with fails(*parts):
        named_controls.parse(ROBOT, word, 4, 0.05)
