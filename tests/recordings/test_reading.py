"""What is written is read: in every format, of any robot, and nothing in between is lost or made up."""

import dataclasses

import numpy as np
import pytest
from rosbags import rosbag2
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.recordings import RecordingConfig, RecordingError, messages
from knode_cosserat.recordings.config import ControlSource, MarkerSource
from knode_cosserat.recordings.formats import written_suffixes
from knode_cosserat.recordings.streams import Body, ControlRows
from knode_cosserat.recordings.write import write_recording
from tests.recordings.made import LAG, PAPER, SMALL, changed, compressed, moved, repacked, write


def turned_by(quaternion, rotation):
    """The angles between orientations (rad)."""
    return (Rotation.from_quat(quaternion, scalar_first=True).inv() * rotation).magnitude()


# round trips


@pytest.mark.parametrize("ending", written_suffixes())
def test_the_papers_robot_comes_back(tmp_path, exact, ending):
    recording = kc.load_recording(write(tmp_path / f"it{ending}", exact), PAPER)
    _, tension, command = exact
    np.testing.assert_allclose(recording.control.time, tension.time, rtol=0, atol=1e-9)
    np.testing.assert_allclose(recording.control.values, tension.values, rtol=0, atol=1e-12)
    np.testing.assert_allclose(recording.command.time, command.time, rtol=0, atol=1e-9)
    np.testing.assert_allclose(recording.command.values, command.values, rtol=0, atol=1e-12)
    assert [body.name for body in recording.bodies] == ["rib 1", "rib 2", "rib 3", "rib 4"]
    for body, ninths in zip(recording.bodies, (3, 5, 7, 9), strict=True):
        position, rotation = moved(body.time, ninths / 9)
        np.testing.assert_allclose(body.position, position, rtol=0, atol=1e-12)
        # motion capture's translation and the bodies' own axes are taken out; the rest is not quite still
        assert turned_by(body.quaternion, rotation).max() < 1e-3
    assert recording.simulated is None
    assert [finding for finding in recording.findings if finding.severity != "note"] == []


@pytest.mark.parametrize("ending", written_suffixes())
def test_another_robot_of_three_tendons_and_one_body_that_has_no_orientation_comes_back(tmp_path, ending):
    time = np.round(np.arange(0.0, 2.0, 0.02), 6)
    position, _ = moved(time, 1.0)
    pulls = ControlRows(time[::2], 3.0 + np.random.default_rng(0).uniform(0.0, 1.0, (50, 3)))
    write_recording(tmp_path / f"it{ending}", SMALL, {"tip": Body(time, position)}, pulls, pulls)
    recording = kc.load_recording(tmp_path / f"it{ending}", SMALL)
    (tip,) = recording.bodies
    np.testing.assert_allclose(tip.position, position, rtol=0, atol=1e-12)
    assert tip.quaternion is None
    np.testing.assert_allclose(recording.control.values, pulls.values, rtol=0, atol=1e-12)
    measured = recording.sampled(0.04)
    assert measured.control.shape[1] == 3
    assert measured.position.shape[1:] == (1, 3)
    assert np.isnan(measured.quaternion).all()
    assert len(measured.parts()) == 1
    np.testing.assert_allclose(measured.tip_position[10], position[20], rtol=0, atol=1e-12)


def test_a_table_explains_itself(tmp_path, exact):
    streams = changed(exact, "rib 1", rows=slice(None, None, 2))
    config = dataclasses.replace(
        PAPER,
        markers=tuple(dataclasses.replace(it, topic=it.name.replace(" ", "")) for it in PAPER.markers),
        tension=ControlSource("tension", (1, 2, 3, 4)),
        command=ControlSource("command", (1, 2, 3, 4), latency=0.06),
        base=None,
        simulated=True,
        description="a test",
    )
    poses = {name: pose for name, pose in streams[0].items() if name != "base"}
    for ending in (".csv", ".parquet"):
        path = write(tmp_path / f"it{ending}", (poses, *streams[1:]), config)
        recording = kc.load_recording(path)
        assert recording.simulated is True
        assert recording.source == "a test"
        assert [body.fraction for body in recording.bodies] == [it.fraction for it in config.markers]
        assert recording.config.command.latency == 0.06
        assert len(recording.bodies[0].time) == len(recording.bodies[1].time) / 2
        np.testing.assert_array_equal(recording.control.values, streams[1].values)
        # what a table without configuration says is taken as it stands
        np.testing.assert_allclose(recording.bodies[3].position, poses["rib 4"].position, rtol=0, atol=1e-12)


def test_arrays_have_no_stamps_and_are_taken_when_they_were_recorded(tmp_path):
    config = dataclasses.replace(SMALL, tension=ControlSource("/pull", (2, 1)), command=None)
    time = np.round(np.arange(0.0, 1.0, 0.01), 6)
    tip = {"tip": Body(time, moved(time, 1.0)[0])}
    pulls = ControlRows(time, np.stack([5.0 + time, 6.0 - time], axis=1))
    write_recording(tmp_path / "it.mcap", config, tip, pulls)
    recording = kc.load_recording(tmp_path / "it.mcap", config)
    np.testing.assert_allclose(recording.control.values, pulls.values, rtol=0, atol=1e-12)
    assert any("have no stamps" in finding.message for finding in recording.findings)


def test_what_the_file_holds_decides_and_not_its_name(tmp_path, exact):
    write(tmp_path / "it.bag", exact).rename(tmp_path / "it.csv")
    assert len(kc.load_recording(tmp_path / "it.csv").bodies) == 4


# against rosbags, which is another reader


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_bags_are_read_as_rosbags_reads_them(tmp_path, exact, compression):
    path = write(tmp_path / "it.bag", exact)
    if compression:
        path = compressed(path, tmp_path / f"{compression}.bag", compression, 50_000)
    topic = "/vicon/continuum_3/pose"
    with AnyReader([path]) as reader:
        chosen = [each for each in reader.connections if each.topic == topic]
        expected = [
            reader.deserialize(raw, each.msgtype).pose.position
            for each, _, raw in reader.messages(connections=chosen)
        ]
    recording = kc.load_recording(path)
    seen = recording.bodies[3].position
    offset = seen[0] - [expected[0].x, expected[0].y, expected[0].z]
    assert len(seen) == len(expected) == 300
    np.testing.assert_allclose(seen - offset, [[it.x, it.y, it.z] for it in expected], rtol=0, atol=1e-12)
    assert recording.findings == ()


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("finished", [True, False])
def test_a_bag_that_is_a_folder_is_read_with_and_without_its_description(tmp_path, exact, plugin, finished):
    ending = ".mcap" if plugin == "MCAP" else ".db3"
    file = write(tmp_path / f"it{ending}", exact)
    folder = tmp_path / "bag"
    repacked(file, rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin[plugin]))
    if not finished:
        (folder / "metadata.yaml").unlink()
    recording, direct = kc.load_recording(folder), kc.load_recording(file)
    np.testing.assert_array_equal(recording.bodies[3].position, direct.bodies[3].position)


def test_a_bag_in_several_files_is_one(tmp_path, exact):
    folder = tmp_path / "bag"
    folder.mkdir()
    poses, tension, command = exact

    def part(first, last):
        def cut(it):
            chosen = (it.time >= first) & (it.time < last)
            arrays = {name: values for name, values in vars(it).items() if isinstance(values, np.ndarray)}
            return dataclasses.replace(it, **{name: values[chosen] for name, values in arrays.items()})

        return {name: cut(pose) for name, pose in poses.items()}, cut(tension), cut(command)

    write(folder / "it_0.mcap", part(0.0, 1.5))
    write(folder / "it_1.mcap", part(1.5, 2.0))
    write(folder / "it_10.mcap", part(2.0, 9.0))
    recording = kc.load_recording(folder)
    np.testing.assert_allclose(recording.control.values, tension.values, rtol=0, atol=1e-12)
    assert len(recording.bodies[0].time) == 300


def test_messages_of_types_that_other_robots_use(tmp_path):
    store = messages.typestore(2)
    types, time = store.types, np.arange(0.0, 1.0, 0.02)

    def header(t):
        stamp = types["builtin_interfaces/msg/Time"](sec=10, nanosec=round(t * 1e9))
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="")

    vector, turn = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    with rosbag2.Writer(tmp_path / "bag", version=9) as writer:
        kinds = {"/tip": "geometry_msgs/msg/TransformStamped", "/pull": "sensor_msgs/msg/JointState"}
        there = {name: writer.add_connection(name, kind, typestore=store) for name, kind in kinds.items()}
        for t in time:
            placed = types["geometry_msgs/msg/Transform"](
                translation=vector(x=0.0, y=0.0, z=0.5), rotation=turn(x=0.0, y=0.0, z=0.0, w=1.0)
            )
            told = {
                "/tip": types[kinds["/tip"]](header=header(t), child_frame_id="tip", transform=placed),
                "/pull": types[kinds["/pull"]](
                    header=header(t), name=[], position=np.zeros(0), velocity=np.zeros(0),
                    effort=np.array([4.0, 5.0 + t]),
                ),
            }  # fmt: skip
            for name, message in told.items():
                writer.write(there[name], 10**10 + round(t * 1e9), store.serialize_cdr(message, kinds[name]))
    config = RecordingConfig(
        markers=(MarkerSource("tip", "/tip", 1.0),), tension=ControlSource("/pull", (2, 1))
    )
    recording = kc.load_recording(tmp_path / "bag", config)
    np.testing.assert_allclose(recording.bodies[0].position[3], [0.0, 0.0, 0.5])
    np.testing.assert_allclose(recording.control.values[:, 0], 5.0 + time)


# frames and units


def test_another_frame_and_other_units(tmp_path, exact):
    # motion capture with y up, in millimetres: z of the robot is its y
    up = Rotation.from_euler("x", 90.0, degrees=True)
    config = dataclasses.replace(
        PAPER,
        frame_rotation=tuple(up.as_quat(scalar_first=True)),
        position_unit="mm",
        tension=ControlSource("/tension", (2, 4, 1, 3), "N"),
    )
    poses, tension, command = exact
    seen = {
        name: Body(
            it.time,
            up.inv().apply(it.position),
            (up.inv() * Rotation.from_quat(it.quaternion, scalar_first=True)).as_quat(scalar_first=True),
        )
        for name, it in poses.items()
    }
    recording = kc.load_recording(write(tmp_path / "it.bag", (seen, tension, command), config), config)
    np.testing.assert_allclose(recording.control.values, tension.values, rtol=0, atol=1e-12)
    for body in recording.bodies:
        position, rotation = moved(body.time, body.fraction)
        np.testing.assert_allclose(body.position, position, rtol=0, atol=1e-9)
        assert turned_by(body.quaternion, rotation).max() < 1e-3


def test_the_wire_has_the_tendons_in_its_own_order(tmp_path, exact):
    path = write(tmp_path / "it.bag", exact)
    with AnyReader([path]) as reader:
        chosen = [each for each in reader.connections if each.topic in ("/tension", "/rosout")]
        told = {}
        for each, _, raw in reader.messages(connections=chosen):
            told.setdefault(each.topic, reader.deserialize(raw, each.msgtype))
    _, tension, command = exact
    first = tension.values[0] / 9.81e-3
    q = told["/tension"].quaternion
    np.testing.assert_allclose([q.x, q.y, q.z, q.w], first[[3, 0, 1, 2]])
    grams = np.round(command.values[0] / 9.81e-3).astype(int)[[3, 0, 1, 2]]
    assert told["/rosout"].msg == "Serial Command: " + " ".join(map(str, grams))


def test_a_base_that_is_not_there_can_be_stated(tmp_path, exact):
    config = dataclasses.replace(PAPER, base=None, origin=(0.3, -0.2, 0.8))
    poses = {name: pose for name, pose in exact[0].items() if name != "base"}
    recording = kc.load_recording(write(tmp_path / "it.bag", (poses, *exact[1:]), config), config)
    np.testing.assert_allclose(
        recording.bodies[3].position, moved(recording.bodies[3].time, 1.0)[0], atol=1e-12
    )


def test_a_rotation_that_is_stated_needs_no_rest(tmp_path, exact):
    moving = {
        name: Body(it.time[120:], it.position[120:], it.quaternion[120:]) for name, it in exact[0].items()
    }
    streams = moving, *exact[1:]
    path = write(tmp_path / "it.bag", streams)
    without = kc.load_recording(path)
    assert without.rest is None
    assert all(body.quaternion is None for body in without.bodies)
    assert sum("not seen at rest" in finding.message for finding in without.findings) == 4
    stated = dataclasses.replace(
        PAPER.markers[1], rotation=tuple(np.array([1.0, 0.0, 0.0, 1.0]) / np.sqrt(2))
    )
    config = dataclasses.replace(PAPER, markers=(PAPER.markers[0], stated, *PAPER.markers[2:]))
    body = kc.load_recording(path, config).bodies[1]
    # from the first message on, which is a tension's
    assert body.time[0] == 1.2
    assert turned_by(body.quaternion, moved(body.time, 5 / 9)[1]).max() < 1e-9


# sampling


def test_rows_hold_tensions_and_interpolate_poses(tmp_path, exact):
    recording = kc.load_recording(write(tmp_path / "it.bag", exact))
    # times at which nothing was measured
    measured = recording.sampled(0.037, start=0.5, end=2.5)
    np.testing.assert_allclose(measured.time, 0.5 + 0.037 * np.arange(55), atol=1e-9)
    _, tension, command = exact
    held = [tension.values[np.flatnonzero(tension.time <= t + 1e-9)[-1]] for t in measured.time]
    np.testing.assert_allclose(measured.control, held, atol=1e-12)
    position, rotation = moved(measured.time, 1.0)
    # but for the kink at 1 s, cubic splines are good to 20 micrometres
    np.testing.assert_allclose(measured.tip_position, position, rtol=0, atol=2e-4)
    assert turned_by(measured.quaternion[:, -1], rotation).max() < 2e-3
    assert measured.measured.all()
    assert measured.dt == pytest.approx(0.037)
    np.testing.assert_allclose(measured.fractions, [3 / 9, 5 / 9, 7 / 9, 1.0])

    commanded = recording.sampled(0.037, 0.5, 2.5, controls="commanded")
    late = [command.values[np.flatnonzero(command.time <= t - LAG + 1e-9)[-1]] for t in measured.time]
    np.testing.assert_allclose(commanded.control, late, atol=1e-12)
    assert not np.allclose(commanded.control, measured.control, atol=0.1)


def test_quaternions_do_not_flip_from_row_to_row(tmp_path, exact):
    flipping = exact[0]["rib 4"].quaternion * np.where(np.arange(300) % 2, 1.0, -1.0)[:, None]
    recording = kc.load_recording(write(tmp_path / "it.bag", changed(exact, "rib 4", quaternion=flipping)))
    turned = recording.sampled(0.05).quaternion[:, 3]
    assert np.sum(turned[1:] * turned[:-1], axis=1).min() > 0.9


def test_short_gaps_are_bridged_and_long_ones_split(tmp_path, exact):
    time = exact[0]["rib 4"].time
    # 70 ms at 1.30 s, 300 ms at 2 s
    rows = ~(((time > 1.295) & (time < 1.355)) | ((time > 2.0) & (time < 2.295)))
    recording = kc.load_recording(write(tmp_path / "it.bag", changed(exact, "rib 4", rows=rows)))
    measured = recording.sampled(0.01)
    lost = np.flatnonzero(~measured.measured[:, 3])
    np.testing.assert_array_equal(lost, [*range(130, 136), *range(201, 230)])
    bridged = measured.tip_position[130:136]
    np.testing.assert_allclose(bridged, moved(measured.time[130:136], 1.0)[0], rtol=0, atol=2e-4)
    assert np.isnan(measured.tip_position[201:230]).all()
    assert measured.measured[:, :3].all()
    first, second = measured.parts()
    assert (first.time[0], first.time[-1], second.time[0]) == (0.0, 2.0, 2.3)
    assert np.isfinite(second.quaternion).all()
    assert [part.time[0] for part in measured.parts(shortest=1.0)] == [0.0]
    (said,) = (finding for finding in recording.findings if "too long to be bridged" in finding.message)
    assert said.topic == "/vicon/continuum_3/pose"
    assert "2.00 to 2.30 s" in said.message
    # a longer gap can be allowed
    longer = dataclasses.replace(PAPER, longest_gap=0.5)
    whole = kc.load_recording(tmp_path / "it.bag", longer).sampled(0.01)
    assert len(whole.parts()) == 1
    assert not whole.measured[201:230, 3].any()


def test_a_gap_in_the_measured_tensions_splits_too(tmp_path, exact):
    poses, tension, command = exact
    known = (tension.time < 1.5) | (tension.time > 2.0)
    streams = poses, ControlRows(tension.time[known], tension.values[known]), command
    measured = kc.load_recording(write(tmp_path / "it.bag", streams)).sampled(0.05)
    assert [round(part.time[0], 2) for part in measured.parts()] == [0.0, 2.05]


def test_frames_that_are_lost_in_the_beginning_do_not_move_the_first_row(tmp_path, exact):
    recording = kc.load_recording(write(tmp_path / "it.bag", changed(exact, "rib 2", rows=slice(3, None))))
    measured = recording.sampled(0.05)
    assert measured.time[0] == 0.0
    assert list(measured.measured[:2, 1]) == [False, True]
    assert np.isfinite(measured.position).all()
    late = kc.load_recording(write(tmp_path / "it.bag", changed(exact, "rib 2", rows=slice(50, None))))
    assert late.sampled(0.05).time[0] == 0.4


def test_trimming_and_asking_for_rows(tmp_path, exact):
    path = write(tmp_path / "it.bag", exact)
    trimmed = kc.load_recording(path, dataclasses.replace(PAPER, trim=(1.0, 2.0))).sampled(0.05)
    assert (trimmed.time[0], trimmed.time[-1]) == (1.0, 2.0)
    # and the rest is known from before
    assert np.isfinite(trimmed.quaternion).all()
    recording = kc.load_recording(path)
    assert recording.end == pytest.approx(2.98)
    assert recording.sampled(0.05).time[-1] == 2.95
    piece = recording.sampled(0.05).between(0.5, 1.0)
    assert (piece.time[0], piece.time[-1], len(piece.time)) == (0.5, 0.95, 10)
    with pytest.raises(
        RecordingError, match=r"^it\.bag: .*no rows from 7 to 8 s; there are rows from 0 to 2\.95"
    ):
        recording.sampled(0.05).between(7.0, 8.0)
    with pytest.raises(
        RecordingError, match=r"no rows of 0\.05 s from 9 s on; everything is known from 0 to"
    ):
        recording.sampled(0.05, start=9.0)
    with pytest.raises(RecordingError, match="rows of 1e-09 s; allowed is up to"):
        recording.sampled(1e-9)
    for dt in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(RecordingError, match=r"dt is .*; allowed is a time step above 0 s"):
            recording.sampled(dt)
    with pytest.raises(RecordingError, match="controls is 'guessed'; allowed is measured, commanded or none"):
        recording.sampled(controls="guessed")
    with pytest.raises(RecordingError, match="one row has no time step"):
        _ = recording.sampled(0.05, 1.0, 1.01).dt
