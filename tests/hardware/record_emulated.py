"""Program that moves the emulated robot, and records it, with ROS 1 twice at once.

    python record_emulated.py MOTION OWN.bag [ros]

The driver's `Recorder` writes one bag. The other is written by `rosbag record`, which listens to the node of
ROS 1.
"""

import contextlib
import sys
import time

import numpy as np

import knode_cosserat as kc
from knode_cosserat.recordings import RecordingConfig
from knode_cosserat_hardware import Limits, Recorder, SerialBoard
from knode_cosserat_hardware.driver import HostClock
from knode_cosserat_hardware.emulation import EmulatedPort, EmulatedRobot
from knode_cosserat_hardware.middleware.mocap import SimulatedCapture

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


def listened_node(board, clock):
    """The node that `rosbag record` listens to."""
    from knode_cosserat_hardware.middleware.ros1 import ROS1Node

    node = ROS1Node(board, config=CONFIG, clock=clock)
    while min(node.subscribers(topic.name) for topic in node.encoder.topics) < 1:
        time.sleep(0.05)
    return node


def main(motion, own_path, ros=""):
    emulated = EmulatedRobot()
    port = EmulatedPort(emulated)
    with SerialBoard(port, Limits(high=12.0, total=40.0)) as board, contextlib.ExitStack() as stack:
        board.reset()
        board.tare()
        clock = HostClock(port.now)
        capture = SimulatedCapture(emulated, CONFIG, port.now)
        nodes = [stack.enter_context(listened_node(board, clock))] if ros else []
        own = stack.enter_context(Recorder(own_path, CONFIG, clock=clock))
        board.arm()
        begin = port.now()
        for k, row in enumerate(tensions(motion)):
            sent, now = board.command(row), port.now()
            for node in nodes:
                node.publish_command(sent, now)
            own.add_command(sent, now)
            while port.now() < begin + (k + 1) * DT - 1e-9:
                reading = board.read()
                for node in nodes:
                    node.publish(reading)
                own.add_reading(reading)
                for frame in capture.frames():
                    for node in nodes:
                        node.publish_poses(frame)
                    own.add_poses(frame)
        board.disarm()
        if nodes:
            time.sleep(0.5)


if __name__ == "__main__":
    main(*sys.argv[1:])
