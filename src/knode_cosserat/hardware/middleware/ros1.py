"""Node of ROS 1 with the paper's topics: what `rosbag record` writes, `load_recording` reads.

    python -m knode_cosserat.hardware.middleware.ros1 /dev/ttyACM0

It runs in this package's Python. If rospy is not found there, Debian's packages are added to the end of the
path: only rospy, its messages and their pure-Python dependencies are missing here, and so come from there.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import threading
import urllib.parse
import xmlrpc.client
from http.client import HTTPConnection
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.hardware.clock import HostClock
from knode_cosserat.hardware.driver import Driver, HardwareError, Reading
from knode_cosserat.hardware.middleware.commands import CommandGate
from knode_cosserat.hardware.middleware.dds import Source
from knode_cosserat.hardware.middleware.mocap import MotionCapture, PoseFrame
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.write import Encoded, MessageEncoder

#: folder of Debian's Python packages
DEBIAN = Path("/usr/lib/python3/dist-packages")
PACKAGES = "python3-rospy rosout python3-geometry-msgs python3-sensor-msgs python3-std-msgs"
COMMAND_TOPIC = "/tendon_commands"
MASTER = "http://127.0.0.1:11311"


def import_rospy() -> Any:
    """Return the module rospy, of the environment or of Debian's packages.

    Raises:
        ImportError: ROS 1 is not installed.
    """
    try:
        return importlib.import_module("rospy")
    except ImportError:
        if (DEBIAN / "rospy").is_dir() and str(DEBIAN) not in sys.path:
            # at the end: this environment's packages come first
            sys.path.append(str(DEBIAN))
        try:
            return importlib.import_module("rospy")
        except ImportError as error:
            raise ImportError(
                f"the node needs ROS 1 (missing: {error.name}): on Debian, apt-get install {PACKAGES}; "
                "elsewhere, source its setup.bash"
            ) from None


def require_master(timeout: float = 2.0) -> str:
    """Return the address of the ROS master, which must run; this host's without ROS_MASTER_URI.

    Without ROS_IP and ROS_HOSTNAME the node is reachable from this host only.

    Raises:
        HardwareError: there is no master.
    """
    address = os.environ.setdefault("ROS_MASTER_URI", MASTER)
    if "ROS_HOSTNAME" not in os.environ:
        os.environ.setdefault("ROS_IP", "127.0.0.1")

    class Transport(xmlrpc.client.Transport):
        def make_connection(self, host: Any) -> HTTPConnection:
            return HTTPConnection(str(host), timeout=timeout)

    try:
        if not urllib.parse.urlsplit(address).hostname:
            raise OSError("no host")
        xmlrpc.client.ServerProxy(address, transport=Transport()).getPid("/knode_cosserat")
    except (OSError, xmlrpc.client.Error, ValueError) as error:
        raise HardwareError(
            f"no ROS master at {address} ({error!s:.60}); start roscore, or set ROS_MASTER_URI"
        ) from None
    return address


class ROS1Node:
    """Node of ROS 1 that publishes readings, poses and commands on a recording's topics.

        with ROS1Node(robot) as node:
            node.run(60.0)

    With `commands=True` the efforts (N) of `/tendon_commands` (sensor_msgs/JointState) are sent to the armed
    driver, which applies its limits. The node never arms a robot. A process has one node.

    Args:
        source: a connected driver, or another source of readings.
        name: name of the node.
        config: topics, order and units; the paper's robot if None.
        commands: True accepts commands; the source must be a driver.
        capture: motion capture, in the order of the configuration's bodies: base, then markers.
        clock: clock of the stamps; a program's recorders share it.

    Raises:
        HardwareError: there is no ROS master, or a value is not allowed.
        ImportError: ROS 1 or rosbags is not installed.
    """

    def __init__(
        self,
        source: Source,
        *,
        name: str = "knode_cosserat",
        config: RecordingConfig | None = None,
        commands: bool = False,
        capture: MotionCapture | None = None,
        clock: HostClock | None = None,
    ):
        if commands and not isinstance(source, Driver):
            raise HardwareError(f"commands need a driver (got {type(source).__name__})")
        self.source, self.capture = source, capture
        self.clock = HostClock() if clock is None else clock
        self.encoder = MessageEncoder(RecordingConfig.paper_robot() if config is None else config)
        self._rospy = rospy = import_rospy()
        require_master()
        # signals are left to the program
        rospy.init_node(name, disable_signals=True)
        message_class = importlib.import_module("roslib.message").get_message_class
        self._kinds: dict[str, Any] = {}
        self._publishers: dict[str, Any] = {}
        for topic in self.encoder.topics:
            kind = message_class(topic.type.replace("/msg/", "/"))
            if kind is None:
                raise ImportError(f"{topic.type} is missing in ROS: on Debian, apt-get install {PACKAGES}")
            self._kinds[topic.name] = kind
            self._publishers[topic.name] = rospy.Publisher(topic.name, kind, queue_size=100)
        #: gate of commands, with counts; None without commands
        self.gate: CommandGate | None = None
        self._lock = threading.Lock()
        self._newest: Any = None
        if commands:
            assert isinstance(source, Driver)
            self.gate = CommandGate(source, self.clock)
            kind = message_class("sensor_msgs/JointState")
            self._subscriber = rospy.Subscriber(COMMAND_TOPIC, kind, self._take, queue_size=1)
        if self.encoder.config.simulated:
            self._send(self.encoder.simulation(self.clock.stamp(self.clock.now())))

    def publish(self, reading: Reading) -> None:
        """Publish the measured tensions of a reading. Raises `RecordingError` for a wrong number."""
        self._send(self.encoder.tension(self.clock.stamp(reading.time), reading.tension))

    def publish_poses(self, frame: PoseFrame) -> None:
        """Publish the poses of all bodies; a lost body has no message. Raises `RecordingError`."""
        self._send(self.encoder.poses(self.clock.stamp(frame.time), frame.position, frame.quaternion))

    def publish_command(self, tension: Float[np.ndarray, " c"], time: float | None = None) -> None:
        """Publish commanded tensions (N) at a time (s, monotonic; now if None): a line of the log."""
        at = self.clock.now() if time is None else time
        self._send(self.encoder.command(self.clock.stamp(at), tension))

    def handle_commands(self) -> None:
        """Send the newest command to the driver, and publish the tensions sent."""
        if self.gate is None:
            return
        with self._lock:
            message, self._newest = self._newest, None
        if message is not None:
            sent = self.gate.pass_on(message.name, message.effort, message.header.stamp.to_nsec())
            if sent is not None:
                self.publish_command(sent)
        self.gate.watch()

    def step(self, timeout: float = 1.0) -> Reading:
        """Read, publish the reading and new poses, and handle commands; return the reading.

        Raises:
            HardwareError: the robot or motion capture does not answer.
        """
        self.handle_commands()
        reading = self.source.read(timeout)
        self.publish(reading)
        for frame in self.capture.frames() if self.capture is not None else ():
            self.publish_poses(frame)
        self.handle_commands()
        return reading

    def run(self, duration: float = float("inf")) -> int:
        """Step for a time (s), or until ROS stops the node, and return the number of readings.

        Raises:
            HardwareError: the robot or motion capture does not answer.
        """
        end, count = self.clock.now() + duration, 0
        while self.clock.now() < end and not self._rospy.is_shutdown():
            self.step()
            count += 1
        return count

    def close(self) -> None:
        """Leave ROS. The driver is left as it is."""
        self._rospy.signal_shutdown("closed")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def subscribers(self, topic: str) -> int:
        """Return the number of connections to a topic's subscribers."""
        return int(self._publishers[topic].get_num_connections())

    def _take(self, message: Any) -> None:
        with self._lock:
            if self._newest is not None and self.gate is not None:
                self.gate.refused["superseded"] += 1
            self._newest = message

    def _send(self, messages: list[Encoded]) -> None:
        for encoded in messages:
            message = self._kinds[encoded.topic]()
            message.deserialize(encoded.data)
            self._publishers[encoded.topic].publish(message)


def main(arguments: list[str] | None = None) -> int:
    """Run the node with a tension board on a serial port, and return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m knode_cosserat.hardware.middleware.ros1")
    parser.add_argument("port", help="serial port of the tension board, such as /dev/ttyACM0")
    parser.add_argument("--config", help="recording's configuration (YAML); the paper's robot by default")
    parser.add_argument(
        "--commands", action="store_true", help=f"accept commands on {COMMAND_TOPIC}, and arm"
    )
    parser.add_argument("--duration", type=float, default=float("inf"), help="time (s)")
    chosen = parser.parse_args(arguments)
    from knode_cosserat.hardware.serial_board import SerialBoard

    try:
        config = None if chosen.config is None else RecordingConfig.load(chosen.config)
        import_rospy()
        require_master()
        with (
            SerialBoard(chosen.port) as robot,
            ROS1Node(robot, config=config, commands=chosen.commands) as node,
        ):
            if chosen.commands:
                robot.arm()
            print(f"{node.run(chosen.duration)} readings")
    except KeyboardInterrupt:
        return 130
    except (KnodeCosseratError, ImportError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
