"""Message types of poses and tensions, parts of messages, tendons by name, and compressed messages."""

import math

import numpy as np
import pytest

from knode_cosserat.recordings import RecordingConfig, RecordingError, load_recording, proposed_config
from knode_cosserat.recordings.config import ControlSource, MarkerSource
from knode_cosserat.recordings.messages import typestore
from tests.commands import succeeded
from tests.recordings.formats.exported import bent, times

rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")

TIME = times()
START = 1_760_000_000
#: tensions that differ from each other by 5 N and more
PULLS = np.stack([10.0 * k + np.sin(TIME + k) for k in range(1, 5)], axis=1)
NAMES = [f"tendon_{k}" for k in range(1, 5)]
POSITION, ROTATION = bent(TIME)
QUATERNION = ROTATION.as_quat(scalar_first=True)
TIP = (MarkerSource("tip", "/tip", 1.0, rotation=(1.0, 0.0, 0.0, 0.0)),)


class Messages:
    """Messages by name of their type; stamps count from the start of a bag."""

    def __init__(self, ros):
        self.ros, self.store = ros, typestore(ros)

    def make(self, kind, **fields):
        return self.store.types[kind](**fields)

    def time(self, at):
        ns = START * 10**9 + round(at * 1e9)
        return self.make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)

    def header(self, at, frame="world"):
        more = {"seq": 0} if self.ros == 1 else {}
        return self.make("std_msgs/msg/Header", stamp=self.time(at), frame_id=frame, **more)

    def vector(self, values, kind="Vector3"):
        return self.make(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", map(float, values), strict=True)))

    def quaternion(self, wxyz):
        return self.make("geometry_msgs/msg/Quaternion", **dict(zip("wxyz", map(float, wxyz), strict=True)))

    def pose(self, place, wxyz):
        point = self.vector(place, "Point")
        return self.make("geometry_msgs/msg/Pose", position=point, orientation=self.quaternion(wxyz))

    def pose_stamped(self, at, place, wxyz):
        made = self.pose(place, wxyz)
        return self.make("geometry_msgs/msg/PoseStamped", header=self.header(at), pose=made)

    def with_covariance(self, place, wxyz):
        made = self.pose(place, wxyz)
        return self.make("geometry_msgs/msg/PoseWithCovariance", pose=made, covariance=np.zeros(36))

    def transform(self, at, parent, child, place, wxyz):
        moved = self.make(
            "geometry_msgs/msg/Transform", translation=self.vector(place), rotation=self.quaternion(wxyz)
        )
        head = self.header(at, parent)
        return self.make(
            "geometry_msgs/msg/TransformStamped", header=head, child_frame_id=child, transform=moved
        )

    def joints(self, at, names, effort, position=()):
        return self.make(
            "sensor_msgs/msg/JointState",
            header=self.header(at),
            name=list(names),
            position=np.array(position, dtype=float),
            velocity=np.zeros(0),
            effort=np.array(effort, dtype=float),
        )


def write(path, entries, ros=2, mode=None, plugin="MCAP"):
    """Write a bag of (topic, type, seconds, message), and return the path of what is read."""
    store = typestore(ros)
    if ros == 1:
        writer = rosbag1.Writer(path)
    else:
        writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[plugin])
        if mode:
            writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind, at, message in sorted(entries, key=lambda entry: entry[2]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            data = store.serialize_ros1(message, kind) if ros == 1 else store.serialize_cdr(message, kind)
            writer.write(connections[topic], START * 10**9 + round(at * 1e9), data)
    return path


def series(topic, kind, make, time=TIME):
    """Return entries of a bag: the message of each row, from its time and its number."""
    return [(topic, kind, at, make(at, row)) for row, at in enumerate(time)]


def poses(ros=2, topic="/tip", position=POSITION, quaternion=QUATERNION):
    it = Messages(ros)
    return series(
        topic,
        "geometry_msgs/msg/PoseStamped",
        lambda at, row: it.pose_stamped(at, position[row], quaternion[row]),
    )


def joint_states(order=(0, 1, 2, 3), names=NAMES, ros=2, change=None):
    """Joint states whose joints are in some order; from the row `change` on in the opposite order."""
    it = Messages(ros)
    for row, (at, pull) in enumerate(zip(TIME, PULLS, strict=True)):
        at_row = list(order) if change is None or row < change else list(order)[::-1]
        message = it.joints(at, [names[k] for k in at_row], pull[at_row])
        yield "/joint_states", "sensor_msgs/msg/JointState", at, message


def config(tension=None, **changes):
    source = tension or ControlSource("/joint_states", (1, 2, 3, 4))
    return RecordingConfig(markers=TIP, tension=source, **changes)


def measured(recording):
    np.testing.assert_allclose(recording.control.time, TIME, atol=1e-9)
    return recording.control.values


# tendons by name


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize(
    ("order", "change"), [((0, 1, 2, 3), None), ((2, 0, 3, 1), None), ((3, 2, 1, 0), 70), ((0, 1, 2, 3), 1)]
)
def test_joints_are_matched_by_name(tmp_path, ros, order, change):
    path = write(tmp_path / "it", [*poses(ros), *joint_states(order, ros=ros, change=change)], ros)
    recording = load_recording(path, config())
    np.testing.assert_allclose(measured(recording), PULLS, atol=1e-12)
    said = [each for each in recording.findings if "matched by name" in each.message]
    assert bool(said) == (order != (0, 1, 2, 3))


@pytest.mark.parametrize(
    ("names", "order", "stated", "expected"),
    [
        # the order of the wire, and of the names, say the same
        (NAMES, (3, 0, 1, 2), (4, 1, 2, 3), (0, 1, 2, 3)),
        # numbers of motors in their own order: the configuration states the tendon of each
        (["motor1", "motor2", "motor3", "motor4"], (0, 1, 2, 3), (4, 1, 2, 3), (1, 2, 3, 0)),
        # counted from zero
        (["j0", "j1", "j2", "j3"], (1, 3, 0, 2), (1, 2, 3, 4), (0, 1, 2, 3)),
        (["l_2_joint", "l_3_joint", "l_4_joint", "l_1_joint"], (0, 1, 2, 3), (1, 2, 3, 4), (3, 0, 1, 2)),
    ],
)
def test_numbers_in_names_and_the_order_of_the_wire(tmp_path, names, order, stated, expected):
    path = write(tmp_path / "it", [*poses(), *joint_states(order, names)])
    recording = load_recording(path, config(ControlSource("/joint_states", stated)))
    np.testing.assert_allclose(measured(recording), PULLS[:, expected], atol=1e-12)


def test_names_in_the_configuration_decide(tmp_path):
    names = ["flexor", "extensor", "left", "right"]
    path = write(tmp_path / "it", [*poses(), *joint_states((2, 0, 3, 1), names, change=50)])
    recording = load_recording(path, config(ControlSource("/joint_states", names=tuple(names))))
    np.testing.assert_allclose(measured(recording), PULLS, atol=1e-12)
    two = ControlSource("/joint_states", (2, 1), names=("right", "flexor"))
    np.testing.assert_allclose(measured(load_recording(path, config(two))), PULLS[:, [0, 3]], atol=1e-12)
    # without names the first message's order counts for all, and is reported
    recording = load_recording(path, config())
    np.testing.assert_allclose(measured(recording), PULLS[:, [2, 0, 3, 1]], atol=1e-12)
    assert any(
        "left, flexor, right, extensor are taken in this order" in it.message for it in recording.findings
    )
    with pytest.raises(RecordingError, match="no joint is called extensr; its joints are extensor, flexor"):
        load_recording(path, config(ControlSource("/joint_states", names=("flexor", "extensr"))))


def test_names_that_contradict_the_order_are_refused(tmp_path):
    path = write(tmp_path / "it", [*poses(), *joint_states((2, 0, 3, 1))])
    with pytest.raises(
        RecordingError, match=r"tendon_3, tendon_1, tendon_4, tendon_2, .* \[2, 1, 3, 4\]; allowed"
    ):
        load_recording(path, config(ControlSource("/joint_states", (2, 1, 3, 4))))


def test_joint_states_of_others_are_left_out_and_messages_without_names_are_in_order(tmp_path):
    it = Messages(2)
    joints = "/joint_states", "sensor_msgs/msg/JointState"
    arm = series(*joints, lambda at, _: it.joints(at, ["elbow", "wrist"], [70.0, 80.0]), TIME + 0.004)
    entries = sorted([*joint_states((3, 2, 1, 0)), *arm], key=lambda entry: entry[2])
    path = write(tmp_path / "it", [*poses(), *entries])
    np.testing.assert_allclose(measured(load_recording(path, config())), PULLS, atol=1e-12)
    nameless = series(*joints, lambda at, row: it.joints(at, [], PULLS[row]))
    path = write(tmp_path / "other", [*poses(), *nameless])
    reversed_order = config(ControlSource("/joint_states", (4, 3, 2, 1)))
    np.testing.assert_allclose(measured(load_recording(path, reversed_order)), PULLS[:, ::-1], atol=1e-12)


def test_motors_are_positions_of_joints(tmp_path):
    it = Messages(2)
    names = ["motor_2", "motor_1"]
    entries = series(
        "/motors",
        "sensor_msgs/msg/JointState",
        lambda at, _: it.joints(at, names, [9.0, 9.0], [20.0 + at, 10.0 - at]),
    )
    path = write(tmp_path / "it", [*poses(), *entries])
    motors = RecordingConfig(markers=TIP, angle=ControlSource("/motors", (1, 2)))
    expected = np.stack([10.0 - TIME, 20.0 + TIME], axis=1)
    np.testing.assert_allclose(measured(load_recording(path, motors)), expected, atol=1e-12)


# a topic for each tendon


@pytest.mark.parametrize("kind", ["Float64", "Float32", "WrenchStamped"])
def test_each_tendon_has_its_topic(tmp_path, kind):
    it = Messages(2)

    def message(at, value, k):
        if kind != "WrenchStamped":
            return it.make(f"std_msgs/msg/{kind}", data=float(value))
        # a load cell pulls along some axis of its own
        force = it.vector(value * np.eye(3)[k % 3] * (-1.0) ** k)
        wrench = it.make("geometry_msgs/msg/Wrench", force=force, torque=it.vector([5.0, 0.0, 0.0]))
        return it.make("geometry_msgs/msg/WrenchStamped", header=it.header(at), wrench=wrench)

    package = "geometry_msgs" if kind == "WrenchStamped" else "std_msgs"
    entries = []
    for k, name in enumerate(("a", "b", "c")):
        pulls = [message(at + 0.001 * k, 10.0 * (k + 1) + at, k) for at in TIME]
        topic = f"/cells/{name}/force", f"{package}/msg/{kind}"
        entries += series(*topic, lambda _, row, pulls=pulls: pulls[row], TIME + 0.001 * k)
    path = write(tmp_path / "it", [*poses(), *entries])
    source = ControlSource("/cells/{}/force", names=("c", "a", "b"))
    recording = load_recording(path, config(source))
    # tendon 3 is sampled first; the others are interpolated to its times
    seen = recording.control
    expected = np.stack([30.0 + seen.time - 0.002, 10.0 + seen.time, 20.0 + seen.time - 0.001], axis=1)
    inside = slice(2, -2)
    np.testing.assert_allclose(seen.values[inside], expected[inside], atol=1e-5)
    with pytest.raises(
        RecordingError, match=r"topic /cells/1/force \(tension\) is missing; the bag has /cells/a"
    ):
        load_recording(path, config(ControlSource("/cells/{}/force", (1, 2, 3))))


def test_commands_of_each_tendon_hold_until_the_next(tmp_path):
    it = Messages(1)
    sent = {1: [(0.0, 5.0), (0.5, 7.0)], 2: [(0.2, 6.0), (1.0, 8.0)]}
    entries = [
        (f"/cmd_{k}", "std_msgs/msg/Float64", at, it.make("std_msgs/msg/Float64", data=value))
        for k, rows in sent.items()
        for at, value in rows
    ]
    path = write(tmp_path / "it.bag", [*poses(1), *entries], ros=1)
    command = ControlSource("/cmd_{}", (1, 2))
    recording = load_recording(path, RecordingConfig(markers=TIP, command=command, controls="commanded"))
    np.testing.assert_allclose(recording.command.time, [0.2, 0.5, 1.0], atol=1e-9)
    np.testing.assert_allclose(recording.command.values, [[5.0, 6.0], [7.0, 6.0], [7.0, 8.0]])


# poses


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("kind", ["nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped"])
def test_poses_with_covariance(tmp_path, ros, kind):
    it = Messages(ros)

    def message(at, place, wxyz):
        pose = it.with_covariance(place, wxyz)
        if kind.endswith("PoseWithCovarianceStamped"):
            return it.make(kind, header=it.header(at), pose=pose)
        still = it.make("geometry_msgs/msg/Twist", linear=it.vector([9, 9, 9]), angular=it.vector([9, 9, 9]))
        twist = it.make("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=np.zeros(36))
        return it.make(kind, header=it.header(at), child_frame_id="tip", pose=pose, twist=twist)

    entries = series("/tip", kind, lambda at, row: message(at, POSITION[row], QUATERNION[row]))
    same(load_recording(write(tmp_path / "it", [*entries, *joint_states(ros=ros)], ros), config()))


def same(recording, rows=slice(None)):
    """The only body of a recording has the true poses."""
    (body,) = recording.bodies
    np.testing.assert_allclose(body.time, TIME[rows], atol=1e-9)
    np.testing.assert_allclose(body.position, POSITION[rows], atol=1e-9)
    turned = np.sum(body.quaternion * QUATERNION[rows], axis=1)
    np.testing.assert_allclose(np.abs(turned), 1.0, atol=1e-9)


def array(ros=2, lost=(), short=()):
    """The base, the tip and another body in one message; the tip lost in some rows, or a body absent."""
    it = Messages(ros)
    for row, (at, place, wxyz) in enumerate(zip(TIME, POSITION, QUATERNION, strict=True)):
        where = np.full(3, math.nan) if row in lost else place
        bodies = [it.pose([0, 0, 0], [1, 0, 0, 0]), it.pose(where, wxyz), it.pose([1, 1, 1], [1, 0, 0, 0])]
        head = it.header(at)
        made = it.make(
            "geometry_msgs/msg/PoseArray", header=head, poses=bodies[1:] if row in short else bodies
        )
        yield "/poses", "geometry_msgs/msg/PoseArray", at, made


def of(topic, **changes):
    tip = MarkerSource("tip", topic, 1.0, rotation=(1.0, 0.0, 0.0, 0.0))
    return config().replace(markers=(tip,), **changes)


def test_a_body_of_a_pose_array(tmp_path):
    path = write(tmp_path / "it", [*array(lost=(90, 91)), *joint_states()])
    recording = load_recording(path, of("/poses[1]"))
    same(recording, np.delete(np.arange(len(TIME)), [90, 91]))
    assert any("2 poses are not finite" in each.message for each in recording.findings)
    # where a source leaves out what it does not see, the others' numbers change: these messages are not used
    path = write(tmp_path / "short", [*array(short=(90, 91)), *joint_states()])
    recording = load_recording(path, of("/poses[1]"))
    same(recording, np.delete(np.arange(len(TIME)), [90, 91]))
    assert any("2 messages could not be understood" in each.message for each in recording.findings)
    for topic, words in (
        ("/poses", r"topic /poses has 3 bodies; allowed is /poses\[0\], /poses\[1\], /poses\[2\]"),
        ("/poses[3]", r"topic /poses has no part \[3\]; allowed"),
        ("/poses[tip]", r"topic /poses has no part \[tip\]; allowed"),
        ("/joint_states[1]", "its messages are sensor_msgs/JointState; allowed for a pose is"),
    ):
        other = of(topic, tension=ControlSource("/other", (1,))) if "joint" in topic else of(topic)
        with pytest.raises(RecordingError, match=words):
            load_recording(path, other)
    path = write(tmp_path / "poses", [*poses(), *joint_states()])
    with pytest.raises(
        RecordingError, match=r"a geometry_msgs/PoseStamped has no part \[1\]; allowed is /tip"
    ):
        load_recording(path, of("/tip[1]"))


def test_the_bridges_own_poses_are_read(tmp_path):
    """Bytes of the DDS bridge, as a recorder stores them."""
    idl = pytest.importorskip("knode_cosserat_hardware.middleware.idl")
    store = typestore(2)
    kind = "geometry_msgs/msg/PoseArray"
    with rosbag2.Writer(tmp_path / "it", version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/poses", kind, typestore=store)
        other = writer.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        for (at, place, wxyz), (*_, states) in zip(
            zip(TIME, POSITION, QUATERNION, strict=True), joint_states(), strict=True
        ):
            w, x, y, z = map(float, wxyz)
            pose = idl.Pose(idl.Point(*map(float, place)), idl.Quaternion(x, y, z, w))
            ns = START * 10**9 + round(at * 1e9)
            head = idl.Header(idl.Time(ns // 10**9, ns % 10**9), "world")
            data = idl.PoseArray(head, [pose]).serialize(use_version_2=False)
            writer.write(connection, ns, bytes(data))
            writer.write(other, ns, store.serialize_cdr(states, "sensor_msgs/msg/JointState"))
    # the only pose needs no number
    same(load_recording(tmp_path / "it", of("/poses")))


TF = "tf2_msgs/msg/TFMessage"


def transforms(ros=2, kind=None, moving=False, static=False):
    """The tip in the frame of a base, which stands or moves in the world."""
    from scipy.spatial.transform import Rotation

    it, kind = Messages(ros), kind or TF
    base = Rotation.from_rotvec(np.outer(0.2 * TIME if moving else 0.5 + 0.0 * TIME, [0.0, 0.0, 1.0]))
    place = np.array([0.3, 0.0, 0.2]) + np.outer(0.1 * TIME if moving else 0.0 * TIME, [1.0, 0.0, 0.0])
    inside = base.inv().apply(POSITION - place)
    turned = (base.inv() * ROTATION).as_quat(scalar_first=True)
    for row, at in enumerate(TIME):
        tip = it.transform(at, "base", "tip", inside[row], turned[row])
        other = it.transform(at, "world", "camera", [7, 7, 7], [1, 0, 0, 0])
        yield "/tf", kind, at, it.make(kind, transforms=[other, tip])
        # the base is sent at other times
        if not static:
            quaternion = base[row].as_quat(scalar_first=True)
            below = it.transform(at, "world", "/base", place[row], quaternion)
            yield "/tf", kind, at, it.make(kind, transforms=[below])
    if static:
        below = it.transform(0.0, "world", "base", place[0], base[0].as_quat(scalar_first=True))
        yield "/tf_static", kind, 0.0, it.make(kind, transforms=[below])


@pytest.mark.parametrize(
    ("ros", "kind", "moving", "static"),
    [
        (2, None, False, True),
        (2, None, True, False),
        (1, None, True, False),
        (1, "tf/msg/tfMessage", False, True),
    ],
)
def test_a_frame_of_tf_is_given_in_the_root_of_its_tree(tmp_path, ros, kind, moving, static):
    entries = [*transforms(ros, kind, moving, static), *joint_states(ros=ros)]
    path = write(tmp_path / "it", entries, ros)
    same(load_recording(path, of("/tf[tip]")))
    with pytest.raises(
        RecordingError, match=r"topic /tf has no part \[tipp\]; allowed is /tf\[base\], /tf\[camera\]"
    ):
        load_recording(path, of("/tf[tipp]"))


@pytest.mark.parametrize(
    ("edges", "words"),
    [
        (
            [("world", "tip"), ("base", "tip")],
            "the frame tip has two parents, world and base; allowed is one",
        ),
        ([("base", "tip"), ("tip", "base")], "are in a circle"),
    ],
)
def test_a_frame_with_two_parents_or_a_circle_is_refused(tmp_path, edges, words):
    it = Messages(2)
    rows = [it.transform(0.0, parent, child, [0, 0, 0], [1, 0, 0, 0]) for parent, child in edges]
    entries = [("/tf", TF, 0.0, it.make(TF, transforms=rows)), *joint_states()]
    with pytest.raises(RecordingError, match=words):
        load_recording(write(tmp_path / "it", entries), of("/tf[tip]"))


def test_the_types_of_tf_are_those_of_ros_1():
    # published by ROS: rosmsg md5 tf2_msgs/TFMessage
    for kind in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
        assert typestore(1).generate_msgdef(kind)[1] == "94810edda583a504dfda3829e70d7eec"


# compression


@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
@pytest.mark.parametrize("mode", ["MESSAGE", "FILE"])
def test_bags_compressed_by_zstd_are_read(tmp_path, plugin, mode):
    compression = rosbag2.CompressionMode[mode]
    if plugin == "MCAP" and mode == "FILE":
        compression = rosbag2.CompressionMode.MESSAGE
    path = write(tmp_path / "it", [*poses(), *joint_states((1, 0, 3, 2))], 2, compression, plugin)
    if plugin == "MCAP" and mode == "FILE":
        pytest.importorskip("backports.zstd")
        from backports import zstd

        (file,) = path.glob("*.mcap")
        (path / f"{file.name}.zstd").write_bytes(zstd.compress(file.read_bytes()))
        file.unlink()
    recording = load_recording(path, config())
    same(recording)
    np.testing.assert_allclose(measured(recording), PULLS, atol=1e-12)
    assert not [each for each in recording.findings if each.severity != "note"]
    # a file alone is a bag too
    (file,) = (file for file in path.iterdir() if file.suffix != ".yaml")
    same(load_recording(file, config()))


def test_damaged_compressed_messages_are_counted(tmp_path):
    import sqlite3

    path = write(tmp_path / "it", [*poses(), *joint_states()], 2, rosbag2.CompressionMode.MESSAGE, "SQLITE3")
    (file,) = path.glob("*.db3")
    with sqlite3.connect(file) as opened:
        rows = opened.execute(
            "SELECT id, data FROM messages WHERE topic_id = 1 ORDER BY id LIMIT 3"
        ).fetchall()
        for number, data in rows:
            opened.execute("UPDATE messages SET data = ? WHERE id = ?", (data[:12] + b"\xff" * 8, number))
    opened.close()
    recording = load_recording(path, config())
    (body,) = recording.bodies
    assert len(body.time) == len(TIME) - 3
    assert any("3 messages could not be understood" in each.message for each in recording.findings)


def test_compressed_messages_stay_within_the_limits(tmp_path, monkeypatch):
    path = write(tmp_path / "it", [*poses(), *joint_states()], 2, rosbag2.CompressionMode.MESSAGE)
    monkeypatch.setattr("knode_cosserat.recordings.content.RATIO", 0)
    monkeypatch.setattr("knode_cosserat.recordings.content.ALLOWANCE", 4000)
    recording = load_recording(path, config())
    assert len(recording.bodies[0].time) < len(TIME)
    assert any("KNODE_COSSERAT_LIMITS" in each.message for each in recording.findings)


def test_parts_of_messages_are_not_written(tmp_path):
    from knode_cosserat.recordings.streams import Body, ControlRows
    from knode_cosserat.recordings.write import write_recording

    config = of("/poses[1]")
    poses = {"tip": Body(TIME, POSITION, QUATERNION)}
    with pytest.raises(
        RecordingError, match=r"topic /poses\[1\] cannot be written; allowed is one topic for each"
    ):
        write_recording(tmp_path / "it.bag", config, poses, ControlRows(TIME, PULLS))
    assert not list(tmp_path.iterdir())


# proposals


def test_a_bag_with_other_topics_gets_a_proposal(tmp_path):
    it = Messages(2)
    still = np.zeros((len(TIME), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(TIME), 1))
    base = poses(2, "/mocap/base_plate/pose", *still)
    position, rotation = bent(TIME, 0.5)
    rib = poses(2, "/mocap/rib/pose", position, rotation.as_quat(scalar_first=True))
    noise = [("/chatter", "std_msgs/msg/String", 0.0, it.make("std_msgs/msg/String", data="hello"))]
    path = write(tmp_path / "it", [*poses(), *base, *rib, *joint_states((1, 0, 3, 2)), *noise])
    found = proposed_config(path)
    assert [(each.topic, each.fraction) for each in found.markers] == [
        ("/mocap/rib/pose", 0.5),
        ("/tip", 1.0),
    ]
    assert (found.base.topic, found.tension.topic) == ("/mocap/base_plate/pose", "/joint_states")
    assert found.tension.names == ("tendon_1", "tendon_2", "tendon_3", "tendon_4")
    assert any("places on the rod (fractions) are guessed" in each for each in found.remarks)
    recording = load_recording(path, found)
    np.testing.assert_allclose(recording.bodies[1].position, POSITION, atol=1e-9)
    np.testing.assert_allclose(measured(recording), PULLS, atol=1e-12)
    # inspect writes it, and its text is a configuration
    text = succeeded("inspect", path).partition("--config:\n")[2]
    (tmp_path / "it.yaml").write_text(text)
    assert RecordingConfig.load(tmp_path / "it.yaml") == found


def test_parts_and_topics_of_tendons_are_proposed(tmp_path):
    it = Messages(2)
    cells = [
        (f"/cell{k}/force", "std_msgs/msg/Float64", at, it.make("std_msgs/msg/Float64", data=5.0 * k + at))
        for at in TIME
        for k in (1, 2)
    ]
    path = write(tmp_path / "it", [*array(), *cells])
    found = proposed_config(path)
    assert [each.topic for each in found.markers] == ["/poses[0]", "/poses[1]", "/poses[2]"]
    assert (found.tension.topic, found.tension.names) == ("/cell{}/force", ("1", "2"))
    assert any("no body is called base" in each for each in found.remarks)
    seen = load_recording(path, found).control
    np.testing.assert_allclose(seen.values, seen.time[:, None] + [5.0, 10.0], atol=1e-9)
    path = write(tmp_path / "tf", [*transforms(), *cells])
    found = proposed_config(path)
    assert sorted(each.topic for each in found.markers) == ["/tf[camera]", "/tf[tip]"]
    assert found.base.topic == "/tf[base]"
    with pytest.raises(
        RecordingError, match=r"no topic has poses; the bag has /cell1/force \(std_msgs/Float64\)"
    ):
        proposed_config(write(tmp_path / "cells", cells))


@pytest.mark.parametrize("ros", [1, 2])
def test_sensors_beside_motion_capture_are_read_from_bags(tmp_path, ros):
    it = Messages(ros)
    zero, no = it.vector(np.zeros(3)), np.zeros(9)

    def imu(at, row):
        return it.make(
            "sensor_msgs/msg/Imu",
            header=it.header(at),
            orientation=it.quaternion(QUATERNION[row]),
            orientation_covariance=no,
            angular_velocity=zero,
            angular_velocity_covariance=no,
            linear_acceleration=zero,
            linear_acceleration_covariance=no,
        )

    def wrench(at, row):
        made = it.make(
            "geometry_msgs/msg/Wrench", force=it.vector(PULLS[row, :3]), torque=it.vector(PULLS[row, 1:])
        )
        return it.make("geometry_msgs/msg/WrenchStamped", header=it.header(at), wrench=made)

    entries = series("/imu", "sensor_msgs/msg/Imu", imu)
    entries += series("/wrench", "geometry_msgs/msg/WrenchStamped", wrench)
    entries += series("/pull", "sensor_msgs/msg/JointState", lambda at, row: it.joints(at, NAMES, PULLS[row]))
    path = write(tmp_path / ("it.bag" if ros == 1 else "it"), entries, ros)
    kinds = {"orientation": "/imu", "base_wrench": "/wrench"}
    config = RecordingConfig(
        tension=ControlSource("/pull", (1, 2, 3, 4)),
        sensors=[{"kind": kind, "topic": topic} for kind, topic in kinds.items()],
    )
    turned, force = load_recording(path, config).sensors
    np.testing.assert_allclose(np.abs(np.sum(turned.values * QUATERNION, axis=1)), 1.0, rtol=1e-12)
    np.testing.assert_allclose(force.values, np.hstack([PULLS[:, :3], PULLS[:, 1:]]), rtol=1e-12)
    wrong = [{"kind": "orientation", "topic": "/pull"}]
    with pytest.raises(RecordingError, match="topic /pull"):
        load_recording(path, RecordingConfig(sensors=wrong, controls="none"))
