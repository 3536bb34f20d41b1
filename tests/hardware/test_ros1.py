"""Node of ROS 1: what rosbag records is the driver's own recording. Skipped where ROS 1 is not installed."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest

from knode_cosserat.recordings import load_recording
from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.middleware import ros1
from tests.hardware.waiting import wait_for

MISSING = [name for name in ("rosmaster", "rosbag") if shutil.which(name) is None]
HAS_ROSPY = any(os.path.isdir(os.path.join(each, "rospy")) for each in [*sys.path, str(ros1.DEBIAN)])
needs_ros = pytest.mark.skipif(
    bool(MISSING) or not HAS_ROSPY,
    reason="ROS 1 is not installed: apt-get install python3-rosmaster python3-rosbag " + ros1.PACKAGES,
)
pytest.importorskip("rosbags", reason="bags need rosbags: pip install 'knode-cosserat[ros]'")

#: a simulated robot in real time, published and recorded by the same program
ROBOT = """
import sys, time
import numpy as np
import knode_cosserat as kc
from knode_cosserat_hardware.driver import HostClock
from knode_cosserat_hardware.middleware.ros1 import ROS1Node
from knode_cosserat_hardware.middleware.mocap import SimulatedCapture
from knode_cosserat_hardware.recorder import Recorder
from knode_cosserat_hardware.simulated import SimulatedRobot
from knode_cosserat.recordings import RecordingConfig

config = RecordingConfig.paper_robot().replace(simulated=True)
clock = HostClock()
with SimulatedRobot(kc.load_robot("delrin-tendon-robot"), real_time=True) as robot:
    capture = SimulatedCapture(robot, config)
    robot.read(), capture.poses()
    node, own = ROS1Node(robot, config=config, clock=clock), Recorder(sys.argv[1], config, clock=clock)
    with node, own:
        while min(node.subscribers(topic.name) for topic in node.encoder.topics) < 1:
            time.sleep(0.05)
        print("ready", flush=True)
        time.sleep(0.5)
        robot.arm()
        begin = clock.now()
        for k in range(int(sys.argv[2])):
            if k % 10 == 0:
                wanted = np.array([5.0, 5.0, 5.0, 5.0]) + 2.0 * np.sin(0.1 * k) * np.array([1, 0, -1, 0])
                now = clock.now()
                robot.command(wanted)
                node.publish_command(wanted, now)
                own.add_command(wanted, now)
            reading = robot.read()
            node.publish(reading)
            own.add_reading(reading)
            for frame in capture.frames():
                node.publish_poses(frame)
                own.add_poses(frame)
        time.sleep(0.5)
"""


def environment(folder):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    # programs of Debian run under its own Python
    names = {name: value for name, value in os.environ.items() if not name.startswith(("ROS", "PYTHON"))}
    names |= {"ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1"}
    return names | {"ROS_HOME": str(folder / "ros"), "ROS_LOG_DIR": str(folder / "log")}, port


@pytest.fixture
def ros(tmp_path):
    """A ROS master; yields its environment."""
    env, port = environment(tmp_path)
    (tmp_path / "log").mkdir()
    with subprocess.Popen(
        ["rosmaster", "--core", "-p", str(port)], env=env, stdout=subprocess.DEVNULL
    ) as master:
        try:
            wait_for(lambda: listens(port))
            yield env
        finally:
            master.terminate()


def listens(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


class RosBag:
    """`rosbag record` of all topics of the paper's robot."""

    def __init__(self, path, env):
        self.path = path
        topics = ["/tension", "/rosout", "/vicon/continuum_base/pose"]
        topics += [f"/vicon/continuum_{k}/pose" for k in range(4)]
        program = ["rosbag", "record", "--output-name", str(path), *topics]
        self.process = subprocess.Popen(program, env=env, stdout=subprocess.DEVNULL)

    def stop(self):
        time.sleep(1.0)
        self.process.send_signal(signal.SIGINT)
        self.process.wait(30.0)
        # its own child writes the index and renames the file
        wait_for(self.path.exists)


def equal(one, other):
    """True if two recordings have the same numbers at the same times."""
    for a, b in zip((*one.bodies, one.base), (*other.bodies, other.base), strict=True):
        np.testing.assert_array_equal(a.time, b.time)
        np.testing.assert_array_equal(a.position, b.position)
        np.testing.assert_array_equal(a.quaternion, b.quaternion)
    for a, b in ((one.control, other.control), (one.command, other.command)):
        np.testing.assert_array_equal(a.time, b.time)
        np.testing.assert_array_equal(a.values, b.values)
    return one.simulated == other.simulated


@pytest.mark.slow
@needs_ros
def test_rosbag_records_what_the_driver_records(tmp_path, ros):
    recorded = RosBag(tmp_path / "recorded.bag", ros)
    program = [sys.executable, "-c", textwrap.dedent(ROBOT), str(tmp_path / "own.bag"), "100"]
    subprocess.run(program, env=ros, check=True, timeout=120.0)
    recorded.stop()
    own, live = load_recording(tmp_path / "own.bag"), load_recording(tmp_path / "recorded.bag")
    assert len(own.control.time) == 100 and own.simulated
    assert equal(live, own)

    # and played back, recorded again
    again = RosBag(tmp_path / "again.bag", ros)
    time.sleep(2.0)
    play = [
        "rosbag",
        "play",
        "--quiet",
        "--delay=2",
        "--wait-for-subscribers",
        str(tmp_path / "recorded.bag"),
    ]
    subprocess.run(play, env=ros, check=True, timeout=120.0, stdout=subprocess.DEVNULL)
    again.stop()
    assert equal(load_recording(tmp_path / "again.bag"), own)


COMMANDED = """
import time
import numpy as np
from knode_cosserat_hardware.middleware.ros1 import ROS1Node, import_rospy
import knode_cosserat as kc
from knode_cosserat_hardware.simulated import SimulatedRobot

with SimulatedRobot(kc.load_robot("delrin-tendon-robot"), real_time=True) as robot:
    robot.read()
    with ROS1Node(robot, commands=True) as node:
        rospy = import_rospy()
        from sensor_msgs.msg import JointState
        publisher = rospy.Publisher("/tendon_commands", JointState, queue_size=1)
        def command():
            message = JointState(effort=[3.0] * 4)
            message.header.stamp = rospy.Time.now()
            publisher.publish(message)
            time.sleep(0.05)
            node.step()
        for _ in range(10):
            command()
        print(node.gate.accepted, node.gate.refused["not armed"] > 0)
        robot.arm()
        for _ in range(20):
            command()
        print(node.gate.accepted > 5, robot.read().tension.min() > 1.0)
        time.sleep(0.7)
        node.step()
        print(robot.state.value)
"""


@pytest.mark.slow
@needs_ros
def test_commands_are_checked(ros):
    run = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(COMMANDED)],
        env=ros,
        check=True,
        timeout=120.0,
        text=True,
        stdout=subprocess.PIPE,
    )
    lines = run.stdout.split("\n")
    assert lines[:2] == ["0 True", "True True"]
    # the node's silence or the robot's watchdog
    assert lines[2] in ("ready", "fault")


def test_a_missing_master_is_said(monkeypatch):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        monkeypatch.setenv("ROS_MASTER_URI", f"http://127.0.0.1:{probe.getsockname()[1]}")
        monkeypatch.setenv("ROS_IP", "127.0.0.1")
        with pytest.raises(HardwareError, match=r"no ROS master at http://127.* start roscore"):
            ros1.require_master()
    monkeypatch.setenv("ROS_MASTER_URI", "nonsense")
    with pytest.raises(HardwareError, match="no ROS master at nonsense"):
        ros1.require_master()


def test_missing_packages_are_said(monkeypatch, tmp_path):
    monkeypatch.setattr(ros1, "DEBIAN", tmp_path)
    monkeypatch.setitem(sys.modules, "rospy", None)
    with pytest.raises(ImportError, match=r"needs ROS 1 \(missing: rospy\): on Debian, apt-get install"):
        ros1.import_rospy()


def test_commands_need_a_driver():
    with pytest.raises(HardwareError, match="commands need a driver"):
        ros1.ROS1Node(object(), commands=True)


@needs_ros
def test_the_program_says_what_is_wrong(ros):
    program = [sys.executable, "-m", ros1.__name__, "/dev/nothing"]
    run = subprocess.run(program, env=ros, capture_output=True, text=True, check=False, timeout=60.0)
    assert run.returncode == 1 and "/dev/nothing" in run.stderr and "Traceback" not in run.stderr
    assert len(run.stderr.strip().splitlines()) == 1
