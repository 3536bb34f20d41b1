"""Tables of other programs, whose columns are mapped one by one; and the map that inspect proposes."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knode_cosserat.recordings import RecordingConfig, RecordingError, load_recording, proposed_config
from knode_cosserat.recordings.config import UP, ColumnMap, ControlSource, MarkerSource
from tests.commands import run, succeeded
from tests.recordings.formats import exported

TIME = exported.times(50.0)
POSITION, ROTATION = exported.bent(TIME)
QUATERNION = ROTATION.as_quat(scalar_first=True)
PULLS = np.stack([5.0 * k + np.sin(TIME + k) for k in range(1, 7)], axis=1)


def table(columns, delimiter=",", decimal=".", header=True, end="\n", before=""):
    lines = [delimiter.join(columns)] if header else []
    for row in zip(*columns.values(), strict=True):
        cells = [cell if isinstance(cell, str) else f"{cell:.9g}" for cell in row]
        lines.append(delimiter.join(cell.replace(".", decimal) for cell in cells))
    return (before + end.join(lines) + end).encode()


def columns(time="time", pulls="T{}", place=("x", "y", "z"), scale=1.0, clock=1.0, turned=()):
    found = {time: clock * TIME} if time else {}
    found |= {pulls.format(k + 1): PULLS[:, k] for k in range(6)}
    found |= dict(zip(place, scale * POSITION.T, strict=True))
    return found | dict(zip(turned, QUATERNION.T, strict=False))


def written(folder, yaml):
    path = folder / "map.yaml"
    path.write_text(yaml, encoding="utf-8")
    return RecordingConfig.load(path)


def agrees(recording, pulls=PULLS):
    (body,) = recording.bodies
    # ns since 1970 are 256 ns apart as floats
    np.testing.assert_allclose(body.time, TIME, rtol=0.0, atol=3e-7)
    np.testing.assert_allclose(body.position, POSITION, atol=1e-7)
    np.testing.assert_allclose(recording.control.values, pulls, atol=1e-7)


T6 = "[T1, T2, T3, T4, T5, T6]"
#: file, and the map that a user writes for it
FILES = {
    "a plain file": (table(columns()), f"columns: {{time: time, tension: {T6}, tip: [x, y, z]}}\n"),
    "semicolons and decimal commas": (
        table(columns("Zeit (ms)", clock=1e3), ";", ","),
        f"columns: {{time: Zeit (ms), tension: {T6}, tip: [x, y, z]}}\n",
    ),
    "tabs, Windows' line ends and mm": (
        table(columns("t", place=("X [mm]", "Y [mm]", "Z [mm]"), scale=1e3), "\t", end="\r\n"),
        f'columns: {{time: t, tension: {T6}, tip: ["X [mm]", "Y [mm]", "Z [mm]"]}}\nposition_unit: mm\n',
    ),
    "tabs and decimal commas, a comment before": (
        table(columns("Time / s"), "\t", ",", before="# simulated: true\n"),
        f'columns: {{time: "Time / s", tension: {T6}, tip: [x, y, z]}}\n',
    ),
    "no titles": (
        table(columns(), header=False),
        "columns: {time: 1, tension: [2, 3, 4, 5, 6, 7], tip: [8, 9, 10]}\n",
    ),
    "no titles, semicolons and decimal commas": (
        table(columns(), ";", ",", header=False),
        "columns: {time: 1, tension: [2, 3, 4, 5, 6, 7], tip: [8, 9, 10]}\n",
    ),
    "nanoseconds since 1970": (
        table(
            {"stamp": [f"{1_760_000_000_000_000_000 + round(at * 1e9)}" for at in TIME], **columns(time="")}
        ),
        f"columns: {{time: stamp, time_unit: ns, tension: {T6}, tip: [x, y, z]}}\n",
    ),
    "columns with text, and a line of units": (
        table(
            {"mode": ["-"] + ["run"] * len(TIME)}
            | {
                name: [unit, *values]
                for (name, values), unit in zip(columns().items(), ["s", *["N"] * 6, *["m"] * 3], strict=True)
            }
        ),
        f"columns: {{time: time, tension: {T6}, tip: [x, y, z]}}\n",
    ),
    "a title that is there twice, and an empty last column": (
        table(columns() | {"note": TIME, "": [""] * len(TIME)}).replace(b"note", b"x"),
        f"columns: {{time: time, tension: {T6}, tip: [8, y, z]}}\n",
    ),
    "rows without times": (
        table(columns(time="")),
        f"columns: {{tension: {T6}, tip: [x, y, z]}}\ntable: {{rate: 50}}\n",
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_columns_are_mapped_one_by_one(tmp_path, name):
    data, yaml = FILES[name]
    path = tmp_path / "it.csv"
    path.write_bytes(data)
    config = written(tmp_path, f"format: 1\n{yaml}")
    agrees(load_recording(path, config))
    config.save(tmp_path / "again.yaml")
    assert RecordingConfig.load(tmp_path / "again.yaml") == config


def test_the_order_of_tendons_units_and_orientations_are_those_of_the_map(tmp_path):
    path = tmp_path / "it.csv"
    path.write_bytes(table(columns(turned=("a", "b", "c", "d"))))
    config = written(
        tmp_path,
        "columns: {time: time, tension: [T3, T1], command: [T5, T6], tip: [x, y, z, a, b, c, d]}\n"
        "tension: {unit: gf}\ncommand: {latency: 0.1}\n"
        "markers: [{name: tip, fraction: 1, rotation: [1, 0, 0, 0]}]\n",
    )
    recording = load_recording(path, config)
    agrees(recording, 9.81e-3 * PULLS[:, [2, 0]])
    np.testing.assert_allclose(recording.command.values, PULLS[:, [4, 5]], atol=1e-7)
    assert config.command.latency == 0.1
    turned = np.abs(np.sum(recording.bodies[0].quaternion * QUATERNION, axis=1))
    np.testing.assert_allclose(turned, 1.0, atol=1e-8)


def test_several_bodies_a_base_and_motors(tmp_path):
    path = tmp_path / "it.csv"
    middle = exported.bent(TIME, 0.5)[0]
    content = columns() | dict(zip(("mx", "my", "mz"), middle.T, strict=True))
    content |= {
        name: value + 0.0 * TIME for name, value in zip(("bx", "by", "bz"), (0.0, 0.0, 0.05), strict=True)
    }
    path.write_bytes(table(content))
    config = written(
        tmp_path,
        "columns: {time: time, angle: [T1, T2], tip: [x, y, z], rib: [mx, my, mz], base: [bx, by, bz]}\n"
        "base: {height: 0.05}\nangle: {unit: deg}\n"
        "markers:\n  - {name: rib, fraction: 1/2}\n  - {name: tip, fraction: 1}\n",
    )
    recording = load_recording(path, config)
    np.testing.assert_allclose(recording.bodies[0].position, middle, atol=1e-7)
    np.testing.assert_allclose(recording.bodies[1].position, POSITION, atol=1e-7)
    np.testing.assert_allclose(recording.control.values, np.radians(PULLS[:, :2]), atol=1e-7)


def test_poses_without_tensions_are_a_recording(tmp_path):
    path = tmp_path / "it.csv"
    path.write_bytes(table(columns()))
    config = written(tmp_path, "columns: {time: time, tip: [x, y, z]}\n")
    assert (config.controls, config.count) == ("none", 0)
    sampled = load_recording(path, config).sampled(0.04)
    assert sampled.control.shape == (len(sampled.time), 0) and sampled.complete.all()
    np.testing.assert_allclose(sampled.tip_position, POSITION[::2], atol=1e-7)


@pytest.mark.parametrize(
    ("yaml", "words"),
    [
        (
            "columns: [time]\n",
            "columns is .*; allowed is a mapping with time, quantities such as tension, and the names",
        ),
        (
            "columns: {time: t, tip: [x, y]}\n",
            "columns: tip is .*; allowed is 3 or 7 titles of columns, each once",
        ),
        ("columns: {time: t, tip: [x, x, z]}\n", "columns: tip is .*; allowed is 3 or 7 titles"),
        ("columns: {time: [t], tip: [x, y, z]}\n", r"columns: time is \['t'\]; allowed is text"),
        ("columns: {time_unit: h, tip: [x, y, z]}\n", "time_unit is 'h'; allowed is s or ms or us or ns"),
        (
            "columns: {a: [x, y, z], b: [u, v, w]}\n",
            "markers is missing; required with the columns of 2 bodies",
        ),
        (
            "columns: {rip: [x, y, z]}\nmarkers: [{name: rib, fraction: 1}]\n",
            "columns are of rip, and no marker has this topic; allowed is rib",
        ),
        ("columns: {tip: [x, y, z]}\ncontrols: measured\n", "tension is missing; .*`controls: none`"),
    ],
)
def test_a_map_that_is_not_right_gives_one_line(tmp_path, yaml, words):
    with pytest.raises(RecordingError, match=words) as raised:
        written(tmp_path, yaml)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("yaml", "words"),
    [
        (
            "columns: {time: tme, tip: [x, y, z]}\n",
            "the column tme is missing; the columns are time, .*mean time",
        ),
        ("columns: {time: time, tip: [x, y, 11]}\n", "the column 11 is missing; the columns are"),
        (
            "columns: {time: time, tension: [T1, T2], tip: [x, y, z]}\ntension: {order: [1, 2, 3]}\n",
            "2 columns are mapped and order has 3 numbers",
        ),
    ],
)
def test_a_column_that_is_not_there_gives_one_line(tmp_path, yaml, words):
    path = tmp_path / "it.csv"
    path.write_bytes(table(columns()))
    with pytest.raises(RecordingError, match=words) as raised:
        load_recording(path, written(tmp_path, yaml))
    assert "\n" not in str(raised.value)


def test_only_mapped_columns_have_to_be_numbers(tmp_path):
    path = tmp_path / "it.csv"
    content = columns() | {"state": ["idle"] * len(TIME)}
    content["T2"] = [*map(str, PULLS[:4, 1]), "broken", *map(str, PULLS[5:, 1])]
    path.write_bytes(table(content))
    tip = MarkerSource("tip", "tip", 1.0)
    for pulls, is_fair in ((("T1", "T3"), True), (("T1", "T2"), False)):
        mapped = ColumnMap((("tip", ("x", "y", "z")),), (("tension", pulls),), "time")
        config = RecordingConfig(markers=(tip,), tension=ControlSource("tension", (1, 2)), columns=mapped)
        if is_fair:
            assert load_recording(path, config).config.count == 2
            continue
        with pytest.raises(RecordingError, match="row 5: T2 is 'broken'; allowed is a finite number"):
            load_recording(path, config)


def test_commas_that_separate_thousands_are_not_decimal(tmp_path):
    path = tmp_path / "it.csv"
    path.write_bytes(b"time;T1;x;y;z\n0;1,000;0.5;0.0;0.4\n1;1,000;0.5;0.0;0.4\n")
    config = written(tmp_path, "columns: {time: time, tension: [T1], tip: [x, y, z]}\n")
    with pytest.raises(RecordingError, match="row 1: T1 is '1,000'; allowed is a finite number"):
        load_recording(path, config)


# proposals

#: titles that programs write, and the map expected of them
T = [f"T{k}" for k in range(1, 7)]
OF_ROS = [f"field.pose.position.{axis}" for axis in "xyz"]
TURN_OF_ROS = [f"field.pose.orientation.{axis}" for axis in "wxyz"]
MM = [f"pos_{axis} [mm]" for axis in "xyz"]
TITLES = {
    "plain": (columns(), ("time", T, ["x", "y", "z"])),
    "with units": (
        columns("Time [ms]", "tension {} (N)", MM, 1e3, 1e3),
        ("Time [ms]", [f"tension {k} (N)" for k in range(1, 7)], MM),
    ),
    "capitals": (
        columns("t", "F{}", ("TIP_X", "TIP_Y", "TIP_Z")),
        ("t", [f"F{k}" for k in range(1, 7)], ["TIP_X", "TIP_Y", "TIP_Z"]),
    ),
    "of ROS": (
        columns("%time", "field.effort{}", OF_ROS, turned=TURN_OF_ROS),
        ("%time", [f"field.effort{k}" for k in range(1, 7)], OF_ROS + TURN_OF_ROS),
    ),
    "with an orientation, and the time last": (
        {**columns("", turned=("qw", "qx", "qy", "qz")), "t_s": TIME},
        ("t_s", T, ["x", "y", "z", "qw", "qx", "qy", "qz"]),
    ),
    "with speeds and forces": (
        {"Fx": TIME, "Fy": TIME, "Fz": TIME, "vx": TIME, "vy": TIME, "vz": TIME}
        | columns(place=("px", "py", "pz")),
        ("time", T, ["px", "py", "pz"]),
    ),
}


@pytest.mark.parametrize("name", TITLES)
def test_inspect_proposes_a_map_that_reads_the_table(tmp_path, name):
    content, (time, pulls, tip) = TITLES[name]
    path = tmp_path / "it.csv"
    path.write_bytes(table(content))
    text = succeeded("inspect", path)
    proposed = text.partition("proposed configuration, for a file of --config:\n")[2]
    config = written(tmp_path, proposed)
    assert (config.columns.time, list(dict(config.columns.controls)["tension"])) == (time, pulls)
    ((_, titles),) = config.columns.bodies
    assert list(titles) == tip
    agrees(load_recording(path, config))
    # the same without the proposal, now that there is a file of it
    assert "proposed" not in succeeded("inspect", path, "--config", tmp_path / "map.yaml")
    assert json.loads(succeeded("inspect", path, "--json"))["proposed_config"] in proposed + "\n"


#: logs of MuJoCo and of Dynamixel motors: numbers that drive the robot, and what is proposed of them
LOGS = {
    "actuator_force_{}": (-PULLS, "tension", -1.0),
    "ctrl[{}]": (PULLS, "command", None),
    "present_current_{}": (PULLS, "current", 1.0),
    "dxl{}_position": (np.round(512.0 * PULLS), "angle", 360.0 / 4096.0),
    "[ID:00{}] Present Position": (np.round(512.0 * PULLS), "angle", 360.0 / 4096.0),
}


@pytest.mark.parametrize("title", LOGS)
def test_inspect_proposes_a_map_of_logs_of_simulators_and_motors(tmp_path, title):
    values, source, gain = LOGS[title]
    content = {"time": TIME} | {title.format(k + 1): values[:, k] for k in range(6)}
    content |= {f"[ID:00{k}] Goal Position": TIME for k in range(1, 7)}
    content |= {f"tip_pos_{k}": POSITION[:, k] for k in range(3)}
    content |= {f"tip_quat_{k}": QUATERNION[:, k] for k in range(4)}
    path = tmp_path / "log.csv"
    path.write_bytes(table(content))
    text = succeeded("inspect", path)
    config = written(tmp_path, text.partition("proposed configuration, for a file of --config:\n")[2])
    assert [*config.measured, config.command][0] == getattr(config, source)
    assert getattr(config, source).gain == gain and ("gain" in text) == (gain is not None)
    recording = load_recording(path, config)
    (body,) = recording.bodies
    np.testing.assert_allclose(body.position, POSITION, atol=1e-7)
    assert body.quaternion is not None
    driver = recording.command if source == "command" else recording.control
    expected = values * (gain or 1.0) * {"angle": np.pi / 180.0, "current": 1e-3}.get(source, 1.0)
    assert driver.quantities == (("angle" if source == "angle" else "tension", 6),)
    np.testing.assert_allclose(driver.values, expected, atol=1e-6)


@pytest.mark.parametrize("axis", ["x", "-x", "y", "-y", "-z"])
def test_inspect_says_that_the_frame_is_rotated(tmp_path, axis):
    upright = Rotation.from_rotvec(UP[axis])
    placed = 0.3 + upright.inv().apply(POSITION)
    content = {"time": TIME} | dict(zip(("tip_x", "tip_y", "tip_z"), placed.T, strict=True))
    content |= {f"base_{k}": np.full(len(TIME), 0.3) for k in "xyz"}
    path = tmp_path / "it.csv"
    path.write_bytes(table(content))
    text = succeeded("inspect", path)
    assert "`frame_rotation` turns this axis to z" in text
    config = written(tmp_path, text.partition("proposed configuration, for a file of --config:\n")[2])
    (body,) = load_recording(path, config).bodies
    np.testing.assert_allclose(body.position, POSITION, atol=1e-7)


def test_inspect_proposes_places_of_bodies_in_exports(tmp_path):
    path = tmp_path / "take.csv"
    path.write_bytes(exported.motive(exported.times()))
    text = succeeded("inspect", path)
    assert "length of the rod, from each body: 0.4000, 0.4000 m" in text
    config = written(tmp_path, text.partition("--config:\n")[2])
    assert [(each.topic, each.fraction) for each in config.markers] == [("rib", 0.5), ("tip", 1.0)]
    assert (config.base.topic, config.up, config.controls) == ("base", "y", "none")
    np.testing.assert_array_equal(
        load_recording(path, config).bodies[1].position, load_recording(path).bodies[1].position
    )


def test_a_table_without_positions_has_no_proposal(tmp_path):
    path = tmp_path / "it.csv"
    path.write_bytes(b"time,a,b\n0,1,2\n1,2,3\n")
    with pytest.raises(
        RecordingError, match="none look like a body's position x, y, z; no map can be proposed"
    ):
        proposed_config(path)
    result = run("inspect", path)
    assert result.exit_code == 2 and "the columns are time, a, b" in result.stderr
    assert "proposes one" not in result.stderr
    # other commands name the one that proposes
    other = run("identify", "delrin-tendon-robot", path, "--out", tmp_path / "found.yaml")
    assert other.exit_code == 2 and f"(knode-cosserat inspect {path} proposes one)" in other.stderr


def test_the_settings_in_the_documentation_are_valid(tmp_path):
    text = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    assert len(blocks) >= 4
    for block in blocks:
        config = written(tmp_path, block)
        (tmp_path / "map.yaml").write_text(config.to_yaml(brief=True))
        assert RecordingConfig.load(tmp_path / "map.yaml") == config


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({}, None),
        ({"vx": TIME}, "1 column is not read: vx"),
        ({"note": ["a"] * len(TIME)}, "1 column is not read: note"),
        ({"Temp [C]": TIME, "P1": TIME}, "2 columns are not read: Temp [C], P1"),
        ({"T7": TIME, "qw": TIME}, "2 columns are not read: T7, qw"),
        ({f"a{k}": TIME for k in range(9)}, "9 columns are not read: a0, a1, a2, a3, a4, a5, a6, a7, …"),
    ],
)
def test_columns_that_nothing_reads_are_listed(tmp_path, more, message):
    path = tmp_path / "it.csv"
    path.write_bytes(table(columns() | more))
    recording = load_recording(path, written(tmp_path, FILES["a plain file"][1]))
    agrees(recording)
    assert [each.message for each in recording.findings if "not read" in each.message] == [message] * bool(
        message
    )
    if message:
        config = tmp_path / "map.yaml"
        assert message in succeeded("inspect", path, "--config", config)


def test_columns_by_number_and_tensions_of_no_use_count_as_read_or_not(tmp_path):
    path = tmp_path / "it.csv"
    path.write_bytes(table(columns() | {"y ": POSITION[:, 1]}))
    by_number = "columns: {time: '1', tension: ['2', '3', '4', '5', '6', '7'], tip: ['8', '9', '10']}\n"
    recording = load_recording(path, written(tmp_path, by_number))
    agrees(recording)
    assert [each.message.partition(":")[0] for each in recording.findings] == ["1 column is not read"]


@pytest.mark.parametrize(("unit", "factor"), [("Pa", 1.0), ("kPa", 1e3), ("bar", 1e5)])
def test_pressures_are_not_judged_as_tensions(tmp_path, unit, factor):
    path = tmp_path / "it.csv"
    path.write_bytes(table(columns()))
    settings = FILES["a plain file"][1].replace("tension", "pressure") + f"pressure: {{unit: {unit}}}\n"
    recording = load_recording(path, written(tmp_path, settings))
    agrees(recording, factor * PULLS)
    assert recording.control.quantities == (("pressure", 6),)
    # some pascals are no pressure that moves a robot
    messages = [each.message for each in recording.findings]
    assert messages == (
        ["pressures of 17.1 Pa are not plausible: are hPa read as Pa?"] if unit == "Pa" else []
    )


def test_tensions_of_that_size_are_judged(tmp_path):
    path = tmp_path / "it.csv"
    path.write_bytes(table(columns() | {f"T{k + 1}": 1e4 * PULLS[:, k] for k in range(6)}))
    recording = load_recording(path, written(tmp_path, FILES["a plain file"][1]))
    assert any("N are not plausible" in each.message for each in recording.findings)
