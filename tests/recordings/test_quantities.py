"""Any actuator: quantities of columns by their titles and units, and in the order of a robot's controls."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import knode_cosserat as kc
from knode_cosserat.recordings import (
    Measurements,
    RecordingConfig,
    RecordingError,
    load_recording,
    proposed_config,
)
from knode_cosserat.recordings.config import ControlSource, MarkerSource
from knode_cosserat.recordings.quantities import QUANTITIES, UNITS, divided_title, known_unit
from knode_cosserat.rods.layout import Layout
from tests.commands import succeeded

TIP = (MarkerSource("tip", "tip", 1.0),)
TIME = np.arange(0.0, 4.0, 0.02)
SWING = np.stack([np.sin(TIME), np.cos(TIME), np.sin(2 * TIME)], axis=1)
POSITION = np.stack([0.1 * np.sin(TIME), 0.05 * np.cos(TIME), 0.4 + 0.0 * TIME], axis=1)
SHARED = Path("/work/shared/recordings")


def written(path, columns, delimiter=",", comma=False):
    """A table of columns by title."""
    rows = np.stack(list(columns.values()), axis=1)
    lines = [delimiter.join(columns), *(delimiter.join(f"{x:.9g}" for x in row) for row in rows)]
    text = "\n".join(lines) + "\n"
    path.write_text(text.replace(".", ",") if comma else text, encoding="utf-8")
    return path


def with_tip(columns, titles=("x [mm]", "y [mm]", "z [mm]"), factor=1e3, time="time [s]"):
    return {time: TIME} | columns | dict(zip(titles, factor * POSITION.T, strict=True))


# titles and units


@pytest.mark.parametrize(
    ("title", "text", "unit"),
    [
        ("P_A [mbar]", "P_A", "mbar"),
        ("cam X (mm)", "cam X", "mm"),
        ("valve1_kPa", "valve1", "kPa"),
        ("q1_deg", "q1", "deg"),
        ("Weg / mm", "Weg", "mm"),
        ("Druck 1 in bar", "Druck 1", "bar"),
        ("Volumen 2 [µl]", "Volumen 2", "ul"),
        ("courant moteur 1 (mA)", "courant moteur 1", "mA"),
        ("ctrl[1]", "ctrl[1]", ""),
        ("T", "T", ""),
        ("tip_m", "tip_m", ""),
        ("Temp [C]", "Temp", ""),
    ],
)
def test_a_title_is_divided_into_text_and_unit(title, text, unit):
    found = divided_title(title)
    assert (found[0], known_unit(found[1])) == (text, unit)


def test_every_unit_has_one_factor_and_one_quantity_of_its_si_unit():
    for quantity in QUANTITIES.values():
        assert quantity.units[quantity.unit] == 1.0
        for unit, factor in quantity.units.items():
            assert UNITS[unit] == (factor, quantity.unit)
        assert quantity.guesses[-1][1] == np.inf
    # independent of the table: definitions of the units
    assert UNITS["psi"][0] == pytest.approx(0.45359237 * 9.80665 / 0.0254**2, rel=1e-12)
    assert UNITS["deg"][0] == pytest.approx(np.radians(1.0)) and UNITS["ml"][0] == pytest.approx(0.01**3)
    assert UNITS["kgf"][0] == pytest.approx(9.81)


# proposals

#: titles of three columns, the unit and the quantity that are read from them
NAMED = {
    "valve{}_kPa": ("kPa", "pressure"),
    "P_{A} [mbar]": ("mbar", "pressure"),
    "Druck Kammer {} [bar]": ("bar", "pressure"),
    "pression chambre {} (psi)": ("psi", "pressure"),
    "q{}_deg": ("deg", "angle"),
    "Winkel Motor {} [°]": ("deg", "angle"),
    "courant moteur {} (mA)": ("mA", "current"),
    "Motorstrom {} [A]": ("A", "current"),
    "syringe {} [ml]": ("ml", "volume"),
    "volume_{}_ul": ("ul", "volume"),
    "Zugkraft Seil {} [N]": ("N", "tension"),
    "tension câble {} (kgf)": ("kgf", "tension"),
    "Seillänge {} [mm]": ("mm", "length"),
    "alpha_{} [deg]": ("deg", "rotation"),
    "Drehwinkel Rohr {} [rad]": ("rad", "rotation"),
    "beta_{} [mm]": ("mm", "insertion"),
    "Vorschub {} [mm]": ("mm", "insertion"),
    "B{x} [mT]": ("mT", "field"),
    "champ magnétique {x} (mT)": ("mT", "field"),
}


def titles_of(pattern):
    marks = "ABC" if "{A}" in pattern else "xyz" if "{x}" in pattern else "123"
    return [pattern.replace("{A}", "{}").replace("{x}", "{}").format(mark) for mark in marks]


@pytest.mark.parametrize("pattern", NAMED)
def test_columns_are_placed_by_title_and_unit(tmp_path, pattern):
    unit, name = NAMED[pattern]
    titles = titles_of(pattern)
    values = (2.0 + SWING) / UNITS[unit][0] * np.sqrt(QUANTITIES[name].low * min(QUANTITIES[name].high, 1e6))
    columns = with_tip(dict(zip(titles, values.T, strict=True)) | {"note": TIME})
    path = written(tmp_path / "it.csv", columns)
    config = proposed_config(path)
    (source,) = config.measured
    assert (source.quantity, source.unit, config.static) == (name, unit, False)
    assert dict(config.columns.controls) == {name: tuple(titles)}
    recording = load_recording(path, config)
    np.testing.assert_allclose(recording.control.values, values * source.factor, rtol=1e-6)
    np.testing.assert_allclose(recording.bodies[0].position, POSITION, atol=1e-8)
    assert recording.uses["note"] == "" and recording.uses[titles[1]] == f"{name} 2 [{unit}]"
    # the text of the configuration is read back
    assert RecordingConfig.from_dict(yaml.safe_load(config.to_yaml(brief=True))) == config


@pytest.mark.parametrize(
    ("titles", "size", "name", "unit"),
    [
        (["pressure_1", "pressure_2", "pressure_3"], 300.0, "pressure", "kPa"),
        (["p1", "p2", "p3"], 2.0, "pressure", "bar"),
        (["motor1", "motor2", "motor3"], 90.0, "angle", "deg"),
        (["motor1", "motor2", "motor3"], 1.0, "angle", "rad"),
        (["syringe_a", "syringe_b", "syringe_c"], 5.0, "volume", "ml"),
        (["Bx", "By", "Bz"], 20.0, "field", "mT"),
        (["T1", "T2", "T3"], 500.0, "tension", "gf"),
    ],
)
def test_units_that_no_title_states_are_guessed_with_a_remark(tmp_path, titles, size, name, unit):
    path = written(
        tmp_path / "it.csv", with_tip(dict(zip(titles, (size * (2.0 + SWING) / 3.0).T, strict=True)))
    )
    config = proposed_config(path)
    (source,) = config.measured
    assert (source.quantity, source.unit) == (name, unit)
    assert any(f"state no unit: {unit} is a guess by their size" in remark for remark in config.remarks)


def test_positions_without_a_unit_in_the_size_of_mm_are_mm(tmp_path):
    path = written(tmp_path / "it.csv", with_tip({"p1_kPa": 50.0 + SWING[:, 0]}, ("x", "y", "z")))
    config = proposed_config(path)
    assert config.position_unit == "mm" and any("mm is a guess" in remark for remark in config.remarks)


def test_positions_in_several_units_are_read_by_their_titles(tmp_path):
    columns = {"time [s]": TIME, "p1_kPa": 50.0 + SWING[:, 0]}
    for name, unit, factor in (("rib", "cm", 1e2), ("tip", "mm", 1e3)):
        columns |= {f"{name} {axis} [{unit}]": factor * POSITION[:, k] for k, axis in enumerate("xyz")}
    config = proposed_config(written(tmp_path / "it.csv", columns))
    for body in load_recording(tmp_path / "it.csv", config).bodies:
        np.testing.assert_allclose(body.position, POSITION, atol=1e-8)


@settings(max_examples=25, deadline=None)
@given(
    order=st.permutations(range(10)),
    unit=st.sampled_from(["deg", "rad"]),
    length=st.sampled_from(["mm", "cm", "m"]),
    semicolons=st.booleans(),
)
def test_rotations_and_insertions_in_any_order_of_columns(tmp_path_factory, order, unit, length, semicolons):
    path = tmp_path_factory.mktemp("tubes") / "it.csv"
    turns, feeds = np.radians(60.0 * SWING), 0.01 * (2.0 + SWING)
    columns = {f"alpha_{k + 1} [{unit}]": turns[:, k] / UNITS[unit][0] for k in range(3)}
    columns |= {f"beta_{k + 1} [{length}]": feeds[:, k] / UNITS[length][0] for k in range(3)}
    every = list(with_tip(columns).items())
    assert len(every) == 10
    written(path, dict(every[k] for k in order), *((";", True) if semicolons else ()))
    config = proposed_config(path)
    rows = load_recording(path, config).sampled(0.05)
    assert rows.quantities == (("insertion", 3), ("rotation", 3))
    # in the order of a robot of tubes
    names = [
        name for k in (1, 2, 3) for name in ((f"rotation_{k}", 1, "rad", ""), (f"insertion_{k}", 1, "m", ""))
    ]
    ordered = rows.controls_for(SimpleNamespace(control_layout=Layout(*names)))
    expected = np.stack([turns, feeds], axis=2).reshape(len(TIME), 6)
    shown = np.searchsorted(TIME, rows.time + 1e-9, side="right") - 1
    np.testing.assert_allclose(ordered.control, expected[shown], atol=1e-6)


def test_alternatives_of_one_drive_are_not_used_together(tmp_path):
    columns = {f"F{k} [N]": 5.0 + SWING[:, k] for k in range(3)} | {
        f"motor{k} [deg]": SWING[:, k] for k in range(3)
    }
    config = proposed_config(written(tmp_path / "it.csv", with_tip(columns)))
    assert [source.quantity for source in config.measured] == ["tension"]
    assert any("angles (motor0 [deg], …) are not used beside tensions" in remark for remark in config.remarks)


def test_columns_of_unknown_units_and_turns_are_not_placed(tmp_path):
    columns = {f"motor{k} [V]": SWING[:, 0] for k in range(3)} | {"roll [deg]": TIME, "yaw [deg]": TIME}
    path = written(tmp_path / "it.csv", with_tip(columns))
    config = proposed_config(path)
    assert config.measured == () and config.controls == "none"
    text = succeeded("inspect", path)
    assert "not placed: motor0 [V], motor1 [V], motor2 [V], roll [deg], yaw [deg]" in text


@pytest.mark.parametrize(
    ("step", "smooth", "static"), [(2.0, False, True), (2.0, True, False), (0.1, False, False)]
)
def test_rows_that_are_equilibria_are_proposed_as_such(tmp_path, step, smooth, static):
    rng = np.random.default_rng(0)
    place = POSITION if smooth else 0.1 * rng.normal(size=POSITION.shape)
    columns = {"t [s]": step * np.arange(len(TIME)), "p1_kPa": 50.0 + SWING[:, 0]}
    columns |= {f"{axis} [mm]": 1e3 * place[:, k] for k, axis in enumerate("xyz")}
    config = proposed_config(written(tmp_path / "it.csv", columns))
    assert config.static == static
    assert static == any("each is taken for an equilibrium" in remark for remark in config.remarks)


@pytest.mark.skipif(not SHARED.exists(), reason="the recordings are not here")
@pytest.mark.parametrize(
    ("name", "quantities", "first"),
    [
        # by hand from the first rows: 0; 427,7; 0 mbar, and degrees and mm
        ("pressure_arm_train.csv", (("pressure", 3),), [0.0, 42770.0, 0.0]),
        ("tubes_train.csv", (("insertion", 3), ("rotation", 3)), [0.026919, -0.0112901, -0.0046004]),
    ],
)
def test_the_two_real_examples(name, quantities, first):
    config = proposed_config(SHARED / name)
    assert config.static and [body for body, _ in config.columns.bodies] == ["tip"]
    rows = Measurements.of(load_recording(SHARED / name, config))
    assert rows.static and rows.quantities == quantities
    np.testing.assert_allclose(rows.control[0, :3], first, atol=1e-9)
    assert 0.1 < np.linalg.norm(rows.tip_position[0]) < 0.3
    found = json.loads(succeeded("inspect", SHARED / name, "--json"))
    assert all(found["columns"].values()) and not [
        it for it in found["findings"] if it["severity"] == "problem"
    ]


# configurations


def test_units_come_from_titles_and_have_to_agree():
    columns = {"time": "t", "pressure": ["P_A [mbar]", "P_B [mbar]"], "tip": ["X (mm)", "Y (mm)", "Z (mm)"]}
    config = RecordingConfig.from_dict({"columns": columns})
    assert config.pressure.unit == "mbar" and config.pressure.order == (1, 2)
    columns["pressure"] = ["P_A [mbar]", "P_B [kPa]"]
    with pytest.raises(
        RecordingError, match="pressure: the titles are in kPa and mbar; required is one unit"
    ):
        RecordingConfig.from_dict({"columns": columns})


@pytest.mark.parametrize(("more", "factor"), [({"unit": "hPa"}, 100.0), ({"unit": "bar", "gain": 1.0}, 1e5)])
def test_a_unit_that_contradicts_its_titles_is_refused(more, factor):
    columns = {"time": "t", "pressure": ["P_A [mbar]", "P_B [mbar]"], "tip": ["X (mm)", "Y (mm)", "Z (mm)"]}
    with pytest.raises(RecordingError, match="pressure: unit is bar, but the titles are in mbar"):
        RecordingConfig.from_dict({"columns": columns, "pressure": {"unit": "bar"}})
    assert RecordingConfig.from_dict({"columns": columns, "pressure": more}).pressure.factor == factor


#: settings that are wrong, and what is said
WRONG = [
    (
        {"tension": {"topic": "t", "order": [1], "unit": "kPa"}},
        "tension: unit is 'kPa'; allowed is N or .*Did you mean the key pressure",
    ),
    ({"pressure": {"topic": "t", "order": [1], "unit": "stone"}}, "unit is 'stone'; allowed is"),
    ({"pressur": {"topic": "t", "order": [1]}}, "the key 'pressur' is unknown; .*did you mean pressure"),
    ({"pressure": {"topic": "t", "order": [1], "text": "p {}"}}, "pressure: text is of commands"),
    (
        {"columns": {"time": "t", "pressures": ["a", "b"], "tip": ["x", "y", "z"]}},
        "did you mean pressure",
    ),
]


@pytest.mark.parametrize(("settings", "words"), WRONG)
def test_bad_settings_give_one_line(settings, words):
    with pytest.raises(RecordingError, match=words):
        RecordingConfig.from_dict({"markers": [{"name": "tip", "fraction": 1}]} | settings)


def test_currents_with_a_gain_are_tensions_and_others_say_so():
    source = ControlSource("I", (1, 2), "mA")
    drive = RecordingConfig(markers=TIP, current=source).measured[0]
    assert (drive.kind.name, drive.factor) == ("current", 1e-3)
    drive = RecordingConfig(markers=TIP, current=dataclasses.replace(source, gain=800.0)).measured[0]
    assert (drive.kind.name, drive.factor) == ("tension", 0.8)
    rows = measured((("current", 2),), np.ones((3, 2)))
    with pytest.raises(
        RecordingError, match=r"has current \(2\); `gain` of the current \(N/A\) makes tensions"
    ):
        rows.controls_for(SimpleNamespace(control_layout=Layout(("tension", 2, "N", ""))))


@pytest.mark.parametrize(("unit", "size"), [("kPa", 5e4), ("bar", 1.0)])
def test_implausible_sizes_are_told_by_quantity(tmp_path, unit, size):
    columns = with_tip({f"p{k} [{unit}]": size * (1.0 + 0.0 * SWING[:, k]) for k in range(3)})
    path = written(tmp_path / "it.csv", columns)
    recording = load_recording(path, proposed_config(path))
    problems = [finding.message for finding in recording.findings if finding.severity == "problem"]
    # 50 MPa burst anything; a bar does not
    expected = ["pressures of 5e+07 Pa are not plausible: are Pa read as kPa?"] if unit == "kPa" else []
    assert problems == expected


# the order of a robot's controls


def measured(quantities, control):
    rows = len(control)
    return Measurements(
        time=0.1 * np.arange(rows),
        control=np.asarray(control, dtype=float),
        fractions=np.ones(1),
        position=np.zeros((rows, 1, 3)),
        quaternion=np.full((rows, 1, 4), np.nan),
        measured=np.ones((rows, 1), dtype=bool),
        simulated=None,
        source="made",
        initial_control=np.asarray(control[0], dtype=float),
        quantities=quantities,
    )


@pytest.mark.parametrize(
    ("fields", "quantities", "order"),
    [
        ([("tension", 3, "N")], (("tension", 3),), [0, 1, 2]),
        ([("pressure", 2, "Pa")], (("pressure", 2),), [0, 1]),
        ([("motor", 2, "rad")], (("angle", 2),), [0, 1]),
        # of an assembly
        ([("a_tension", 2, "N"), ("b_tension", 1, "N")], (("tension", 3),), [0, 1, 2]),
        (
            [("Bx", 1, "T"), ("By", 1, "T"), ("insertion", 1, "m")],
            (("insertion", 1), ("field", 2)),
            [1, 2, 0],
        ),
        # two quantities of one unit are told by name
        ([("insertion_1", 1, "m"), ("reel", 2, "m")], (("length", 2), ("insertion", 1)), [2, 0, 1]),
        # one quantity of a unit is enough
        ([("rotation_1", 1, "rad"), ("tension", 1, "N")], (("tension", 1), ("angle", 1)), [1, 0]),
    ],
)
def test_columns_come_in_the_order_of_the_controls(fields, quantities, order):
    rows = measured(quantities, np.arange(12.0).reshape(4, 3)[:, : len(order)])
    robot = SimpleNamespace(control_layout=Layout(*((*field, "") for field in fields)))
    found = rows.controls_for(robot)
    np.testing.assert_array_equal(found.control, rows.control[:, order])
    np.testing.assert_array_equal(found.initial_control, rows.initial_control[order])
    # once more it changes nothing
    np.testing.assert_array_equal(found.controls_for(robot).control, found.control)


def test_another_robot_is_refused_in_one_line():
    rows = measured((("pressure", 3),), np.ones((4, 3)))
    fields = [(f"rotation_{k}", 1, "rad", "") for k in (1, 2, 3)]
    fields += [(f"insertion_{k}", 1, "m", "") for k in (1, 2, 3)]
    words = r"^made: the robot has the controls rotation \(3\), insertion \(3\); the recording has pressure"
    with pytest.raises(RecordingError, match=words):
        rows.controls_for(SimpleNamespace(control_layout=Layout(*fields)))
    robot = kc.load_robot("delrin-tendon-robot")
    words = r"the robot has the controls tension \(4\); the recording has pressure \(3\)"
    for call in (
        lambda: kc.identify(robot, [rows], parameters=["youngs_modulus"]),
        lambda: kc.identification.evaluate(robot, rows),
        lambda: kc.estimate_states(rows, robot, dt=0.1),
    ):
        with pytest.raises(ValueError, match=words):
            call()
    # without quantities the count decides
    with pytest.raises(RecordingError, match=r"tension \(4\); the recording has 3 controls"):
        dataclasses.replace(rows, quantities=()).controls_for(robot)


def test_measurements_of_tubes_come_back_from_a_table(tmp_path):
    rng = np.random.default_rng(2)
    quantities = tuple((name, 1) for _ in range(3) for name in ("rotation", "insertion"))
    rows = measured(quantities, rng.normal(size=(5, 6)))
    rows.save(tmp_path / "it.csv")
    assert "held_rotation_1 [rad]" in (tmp_path / "it.csv").read_text()
    found = load_recording(tmp_path / "it.csv").sampled(0.1)
    names = [
        name for k in (1, 2, 3) for name in ((f"rotation_{k}", 1, "rad", ""), (f"insertion_{k}", 1, "m", ""))
    ]
    robot = SimpleNamespace(control_layout=Layout(*names))
    np.testing.assert_array_equal(found.controls_for(robot).control, rows.control)
    np.testing.assert_array_equal(found.controls_for(robot).initial_control, rows.initial_control)


def test_measurements_of_a_motion_have_all_controls():
    robot = kc.load_robot("three-chamber-arm")
    still = kc.equilibrium(robot, np.full(robot.control_layout.size, 1e4))
    assert robot.control_layout.names == ("pressure",)
    moved = kc.simulate(robot, np.full((2, 3), 1e4), 0.05, initial=still)
    seen = Measurements.of(moved)
    assert seen.quantities == (("pressure", 3),)
    np.testing.assert_array_equal(seen.control[:-1], moved.held_control[:-1])


def test_a_cell_that_is_no_number_is_named_and_its_column_is_not_left_out(tmp_path):
    path = tmp_path / "bad.csv"
    rows = [f"{0.05 * k},{1 + k},{'abc' if k == 1 else 2 + k},3,{0.001 * k},0,0.4" for k in range(40)]
    path.write_text("\n".join(["t,T1,T2,T3,x,y,z", *rows]))
    config = proposed_config(path)
    assert config.tension.order == (1, 2, 3)
    with pytest.raises(RecordingError, match="row 2: T2 is 'abc'; allowed is a finite number"):
        kc.load_recording(path, config)
