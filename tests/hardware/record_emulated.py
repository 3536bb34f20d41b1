"""Program that moves the emulated robot, and records it twice at once.

    python record_emulated.py MOTION OWN.bag OTHER.bag|ros

The driver's `Recorder` writes one bag. The other is written by `rosbag record`, which listens to the node of
ROS 1, or by rosbags from the same messages.
"""

import contextlib
import sys
import time
from pathlib import Path

import numpy as np

import knode_cosserat as kc
from knode_cosserat.hardware import Limits, Recorder, SerialBoard
from knode_cosserat.hardware.clock import HostClock
from knode_cosserat.hardware.emulation import EmulatedPort, EmulatedRobot
from knode_cosserat.hardware.middleware.simulated_capture import SimulatedCapture
from knode_cosserat.recordings import RecordingConfig
from knode_cosserat.recordings.write import MessageEncoder

#: time between commands (s); time at rest before a motion, and duration of the motion (s)
DT, REST, SECONDS = 0.05, 1.5, 3.5
CONFIG = RecordingConfig.paper_robot().replace(simulated=True)


def tensions(motion):
    """Rows of commands (N): rest, then a sine or random tensions."""
    kind, _, number = motion.partition("_")
    rows = round(SECONDS / DT)
    if kind == "sine":
        moving = kc.controls.sine(float(number.replace("p", ".")), rows, DT, base=3.5, amplitude=2.0)
    else:
        moving = kc.controls.random(rows, low=2.0, high=5.0, seed=int(number), hold=10)
    return np.concatenate([np.full((round(REST / DT), 4), 3.5), moving])


class RosbagsWriter:
    """Bag that rosbags writes, with the methods of the node of ROS 1."""

    def __init__(self, path, clock):
        from rosbags.rosbag1 import Writer

        from knode_cosserat.recordings.messages import typestore

        self.clock, self.encoder = clock, MessageEncoder(CONFIG)
        self._writer = Writer(path)
        self._writer.open()
        self._connections = {
            topic.name: self._writer.add_connection(topic.name, topic.type, typestore=typestore(1))
            for topic in self.encoder.topics
        }

    def __enter__(self):
        self._send(self.encoder.simulation(self.clock.stamp(self.clock.now())))
        return self

    def __exit__(self, *_):
        self._writer.close()

    def publish(self, reading):
        self._send(self.encoder.tension(self.clock.stamp(reading.time), reading.tension))

    def publish_poses(self, frame):
        self._send(self.encoder.poses(self.clock.stamp(frame.time), frame.position, frame.quaternion))

    def publish_command(self, tension, now):
        self._send(self.encoder.command(self.clock.stamp(now), tension))

    def _send(self, messages):
        for each in messages:
            self._writer.write(self._connections[each.topic], self.clock.stamp(self.clock.now()), each.data)


def other_recorder(target, board, clock):
    """The node that `rosbag record` listens to, or a writer of another bag."""
    if target != "ros":
        return RosbagsWriter(Path(target), clock)
    from knode_cosserat.hardware.middleware.ros1 import ROS1Node

    node = ROS1Node(board, config=CONFIG, clock=clock)
    while min(node.subscribers(topic.name) for topic in node.encoder.topics) < 1:
        time.sleep(0.05)
    return node


def main(motion, own_path, target):
    emulated = EmulatedRobot()
    port = EmulatedPort(emulated)
    with SerialBoard(port, Limits(high=12.0, total=40.0)) as board, contextlib.ExitStack() as stack:
        board.reset()
        board.tare()
        clock = HostClock(port.now)
        capture = SimulatedCapture(emulated, CONFIG, port.now)
        other = stack.enter_context(other_recorder(target, board, clock))
        own = stack.enter_context(Recorder(own_path, CONFIG, clock=clock))
        board.arm()
        begin = port.now()
        for k, row in enumerate(tensions(motion)):
            sent, now = board.command(row), port.now()
            other.publish_command(sent, now)
            own.add_command(sent, now)
            while port.now() < begin + (k + 1) * DT - 1e-9:
                reading = board.read()
                other.publish(reading)
                own.add_reading(reading)
                for frame in capture.frames():
                    other.publish_poses(frame)
                    own.add_poses(frame)
        board.disarm()
        if target == "ros":
            time.sleep(0.5)


if __name__ == "__main__":
    main(*sys.argv[1:])
