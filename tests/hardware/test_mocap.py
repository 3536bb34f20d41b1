"""Motion capture: NatNet packets, sound and damaged, a VRPN server, axes, lost bodies, times."""

import contextlib
import importlib.util
import socket
import struct
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.middleware import natnet
from knode_cosserat_hardware.middleware.mocap import VRPN, PoseFrame, SimulatedCapture, upright
from knode_cosserat_hardware.middleware.natnet import (
    NatNet,
    NatNetAddress,
    PacketError,
    parse_frame,
    parse_server_info,
)
from knode_cosserat_hardware.simulated import SimulatedRobot
from tests.hardware.vrpn_server import VRPNServer
from tests.hardware.waiting import wait_for

with_vrpn = pytest.mark.skipif(
    importlib.util.find_spec("motioncapture") is None,
    reason="VRPN needs motioncapture: pip install 'knode-cosserat-hardware[mocap]'",
)
VERSIONS = [(3, 0), (3, 1), (4, 0), (4, 1), (4, 2)]
#: identity, position, quaternion (scalar last), tracked
BODIES = [
    (7, (0.125, 0.25, 0.5), (0.0, 0.0, 0.0, 1.0), True),
    (3, (1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5), True),
    (9, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), False),
]


# packets, by the layout that NaturalPoint documents


def section(version, items):
    """A count, from version 4.1 on the size, and the items."""
    content = b"".join(items)
    size = struct.pack("<i", len(content)) if version >= (4, 1) else b""
    return struct.pack("<i", len(items)) + size + content


def rigid_body(identity, position, quaternion, is_tracked):
    return struct.pack("<i7ffh", identity, *position, *quaternion, 0.001, int(is_tracked))


def channels(identity):
    """A force plate or another device, with two channels of values."""
    return struct.pack("<iii2fi3f", identity, 2, 2, 1.0, 2.0, 3, 1.0, 2.0, 3.0)


def frame_packet(version, bodies=BODIES, others=True, exposure=1_000_000, transmission=1_050_000, end=True):
    """A frame of data: rigid bodies, and, with `others`, something in every other section."""
    marker = struct.pack("<3f", 1.0, 2.0, 3.0)
    sets = [b"all\0" + struct.pack("<i", 2) + 2 * marker, b"rod\0" + struct.pack("<i", 0)]
    skeleton = struct.pack("<ii", 1, 2) + 2 * rigid_body(*BODIES[0])
    labelled = struct.pack("<i3ffhf", 65537, 1.0, 2.0, 3.0, 0.01, 2, 0.0002)
    content = struct.pack("<i", 4711)
    content += section(version, sets if others else [])
    content += section(version, [marker] * 3 if others else [])
    content += section(version, [rigid_body(*each) for each in bodies])
    content += section(version, [skeleton] if others else [])
    if version >= (4, 1):
        content += section(version, [b"asset" * 9] if others else [])
    content += section(version, [labelled] * 4 if others else [])
    content += section(version, [channels(1)] if others else [])
    content += section(version, [channels(2), channels(3)] if others else [])
    content += struct.pack("<IIdQQQ", 0, 0, 12.5, exposure, exposure + 100, transmission)
    if version >= (4, 1):
        content += struct.pack("<II", 12, 500)
    content += struct.pack("<h", 0) + (struct.pack("<i", 0) if end else b"")
    return struct.pack("<HH", natnet.FRAME, len(content)) + content


def server_packet(version=(4, 1), frequency=10_000_000):
    content = b"Motive".ljust(256, b"\0") + bytes([3, 1, 0, 0]) + bytes([*version, 0, 0])
    content += struct.pack("<QHB4B", frequency, natnet.DATA_PORT, 1, 239, 255, 42, 99)
    return struct.pack("<HH", natnet.SERVER_INFO, len(content)) + content


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("others", [False, True])
@pytest.mark.parametrize("end", [False, True])
def test_rigid_bodies_of_a_packet(version, others, end):
    frame = parse_frame(frame_packet(version, others=others, end=end), version)
    assert frame.number == 4711
    assert [tuple(body) for body in frame.bodies] == BODIES
    assert (frame.exposure, frame.transmission) == (1_000_000, 1_050_000)


@pytest.mark.parametrize("version", VERSIONS)
def test_every_cut_packet_is_an_error(version):
    packet = frame_packet(version)
    # the last bytes are flags, which are not read
    for size in range(len(packet)):
        with pytest.raises(PacketError):
            parse_frame(packet[:size], version)
        # and one that states its cut size
        if 4 <= size < len(packet) - 18:
            with pytest.raises(PacketError):
                parse_frame(packet[:2] + struct.pack("<H", size - 4) + packet[4:size], version)


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=400), st.sampled_from(VERSIONS))
def test_garbage_is_no_traceback(data, version):
    for packet in (data, struct.pack("<HH", natnet.FRAME, len(data)) + data):
        with contextlib.suppress(PacketError):
            frame = parse_frame(packet, version)
            assert all(np.isfinite(body.position).all() for body in frame.bodies)


@settings(max_examples=300, deadline=None)
@given(st.data(), st.sampled_from(VERSIONS))
def test_a_changed_byte_is_no_traceback(data, version):
    packet = bytearray(frame_packet(version))
    for _ in range(data.draw(st.integers(1, 4))):
        packet[data.draw(st.integers(0, len(packet) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(PacketError):
        parse_frame(bytes(packet), version)


def test_poses_that_are_not_finite_are_an_error():
    bad = [(7, (np.nan, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), True)]
    with pytest.raises(PacketError, match="not finite"):
        parse_frame(frame_packet((4, 1), bad), (4, 1))


def test_the_server_states_its_version():
    info = parse_server_info(server_packet())
    assert info == ("Motive", (4, 1), 10_000_000)
    # old servers state no frequency
    assert (
        parse_server_info(server_packet()[:2] + struct.pack("<H", 264) + server_packet()[4:268]).frequency
        == 0
    )
    with pytest.raises(PacketError, match="cut"):
        parse_server_info(server_packet()[:100])
    with pytest.raises(PacketError, match="no answer"):
        parse_server_info(frame_packet((4, 1)))


# sockets


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def sender():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        yield opened


def capture_on(port, server=None, multicast=None, **options):
    address = NatNetAddress(server, multicast, "127.0.0.1", port)
    defaults = {"version": (4, 1), "up": "z"}
    return NatNet({"tip": 3, "lost": 9, "base": 7}, address, **(defaults | options))


def test_unicast_packets_in_the_order_of_names(sender):
    port = free_port()
    with capture_on(port, latency=0.25) as capture:
        begin = time.monotonic()
        sender.sendto(frame_packet((4, 1)), ("127.0.0.1", port))
        frame = capture.poses(5.0)
        # half a second may pass on a busy machine
        assert begin - 0.25 <= frame.time <= time.monotonic() - 0.25
    np.testing.assert_array_equal(frame.position[[0, 2]], [[1.0, 2.0, 3.0], [0.125, 0.25, 0.5]])
    np.testing.assert_array_equal(frame.quaternion[[0, 2]], [[0.5] * 4, [1.0, 0.0, 0.0, 0.0]])
    assert np.isnan(frame.position[1]).all() and np.isnan(frame.quaternion[1]).all()
    assert capture.names == ("tip", "lost", "base") and capture.ignored == 0


def test_multicast_packets(sender):
    port = free_port()
    try:
        capture = capture_on(port, multicast="239.255.42.99")
        capture.open()
    except HardwareError as error:
        pytest.skip(f"no multicast on this machine: {error}")
    with capture:
        sender.sendto(frame_packet((4, 1)), ("239.255.42.99", port))
        assert capture.poses(5.0).position[0].tolist() == [1.0, 2.0, 3.0]


def test_damaged_packets_are_counted(sender):
    port = free_port()
    with capture_on(port) as capture:
        for data in (b"", b"\1", b"\7\0\xff\xff", frame_packet((4, 1))[:-30], frame_packet((3, 0))):
            sender.sendto(data, ("127.0.0.1", port))
        wait_for(lambda: capture.ignored == 5)
        assert capture.problem.startswith("a packet is damaged: ")
        with pytest.raises(HardwareError, match=r"no frame .* 5 packets were ignored: a packet is damaged"):
            capture.poses(0.1)
        sender.sendto(frame_packet((4, 1)), ("127.0.0.1", port))
        wait_for(lambda: len(capture.frames()) == 1)
        # packets of another kind are no damage
        sender.sendto(server_packet(), ("127.0.0.1", port))
        sender.sendto(frame_packet((4, 1)), ("127.0.0.1", port))
        wait_for(lambda: len(capture.frames()) == 1)
        assert capture.ignored == 5


def test_the_server_is_asked_and_its_clock_used(sender, monkeypatch):
    port, commands = free_port(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    commands.bind(("127.0.0.1", 0))
    monkeypatch.setattr(NatNet.ask_server, "__defaults__", (3.0, commands.getsockname()[1]))

    def answer():
        data, address = commands.recvfrom(100)
        assert struct.unpack("<HH", data[:4]) == (natnet.CONNECT, 0)
        commands.sendto(server_packet((3, 1), frequency=100_000), address)

    thread = threading.Thread(target=answer)
    thread.start()
    with commands, capture_on(port, server="localhost", version=None) as capture:
        thread.join()
        assert capture.version == (3, 1)
        before = time.monotonic()
        # half a second from exposure to transmission
        sender.sendto(frame_packet((3, 1)), ("127.0.0.1", port))
        frame = capture.poses(5.0)
        assert before - 0.5 <= frame.time <= time.monotonic() - 0.5


def test_a_server_that_does_not_answer_is_an_error():
    with pytest.raises(HardwareError, match=r"127.0.0.1: no answer of Motive on port \d+"):
        capture_on(free_port(), server="127.0.0.1", version=None).ask_server(0.3, free_port())
    with pytest.raises(HardwareError, match="there is no host of this name"):
        capture_on(free_port(), server="no.such.host.invalid").open()


def test_wrong_values():
    for options, message in (
        ({"version": None}, "version must be given"),
        ({"version": (2, 9)}, r"NatNet 2\.9 is not supported"),
        ({"latency": -1.0}, "latency must be"),
        ({"up": "x"}, "up must be"),
    ):
        with pytest.raises(HardwareError, match=message):
            capture_on(1, **options)
    with pytest.raises(HardwareError, match="different identities"):
        NatNet({"a": 1, "b": 1}, "localhost")
    with pytest.raises(HardwareError, match="names must be"):
        NatNet({}, "localhost")


# axes


def test_y_up_becomes_z_up():
    rng = np.random.default_rng(0)
    position, rotation = rng.normal(size=(5, 3)), Rotation.random(5, random_state=1)
    found = upright(PoseFrame(1.0, position, rotation.as_quat(scalar_first=True)), "y")
    turn = Rotation.from_euler("x", 90.0, degrees=True)
    np.testing.assert_allclose(found.position, turn.apply(position), atol=1e-15)
    np.testing.assert_allclose(turn.apply([0.0, 1.0, 0.0]), [0.0, 0.0, 1.0], atol=1e-15)
    expected = (turn * rotation).as_matrix()
    np.testing.assert_allclose(
        Rotation.from_quat(found.quaternion, scalar_first=True).as_matrix(), expected, atol=1e-14
    )
    frame = PoseFrame(1.0, position, rotation.as_quat(scalar_first=True))
    assert upright(frame, "z") is frame


# VRPN


@with_vrpn
def test_a_vrpn_server():
    names = ["base", "tip", "other"]
    with VRPNServer(names) as server, VRPN(["tip", "base"], "127.0.0.1", port=server.port) as capture:

        def move(k):
            server.poses["tip"] = (1.0, 2.0, 3.0 + 0.001 * k), (0.5, 0.5, 0.5, 0.5)
            if k < 10:
                server.poses["base"] = (0.0, 0.0, 0.001 * k), (0.0, 0.0, 0.0, 1.0)
            server.poses["other"] = (9.0, 9.0, 0.001 * k), (0.0, 0.0, 0.0, 1.0)
            time.sleep(0.03)

        for k in range(10):
            move(k)
        wait_for(lambda: {"tip", "base", "other"} <= capture.trackers)
        frame = capture.poses(5.0)
        np.testing.assert_allclose(frame.position[0, :2], [1.0, 2.0], atol=1e-6)
        np.testing.assert_allclose(frame.quaternion[1], [1.0, 0.0, 0.0, 0.0], atol=1e-6)
        # a body without a new pose is lost after 0.1 s
        for k in range(10, 40):
            move(k)
        frame = capture.frames()[-1]
        assert np.isnan(frame.position[1]).all() and np.isfinite(frame.position[0]).all()


@with_vrpn
def test_a_vrpn_server_that_is_not_there():
    with (
        VRPN(["tip"], "127.0.0.1", port=free_port()) as capture,
        pytest.raises(
            HardwareError, match=r"no frame of motion capture within 0\.2 s; check that it streams tip"
        ),
    ):
        capture.poses(0.2)


# simulation


def test_a_simulated_capture():
    with SimulatedRobot(kc.load_robot("delrin-tendon-robot")) as robot:
        capture = SimulatedCapture(robot)
        (frame,) = capture.frames()
        assert capture.frames() == [] and capture.names[0] == "base"
        np.testing.assert_allclose(frame.position[0], [0.0, 0.0, 0.0635])
        assert frame.position.shape == (5, 3) and frame.position[-1, 2] > 0.6
        robot.advance(0.1)
        assert capture.frames()[0].time == pytest.approx(frame.time + 0.1)
