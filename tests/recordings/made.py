"""Small recordings whose truth is known, for the tests of reading."""

import numpy as np
from rosbags import rosbag1
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from knode_cosserat.recordings import RecordingConfig
from knode_cosserat.recordings.config import ControlSource, MarkerSource
from knode_cosserat.recordings.streams import Body, ControlRows
from knode_cosserat.recordings.write import write_recording

LENGTH = 0.635
PAPER = RecordingConfig.paper_robot()
#: of three tendons and one body that has no orientation
SMALL = RecordingConfig(
    markers=(MarkerSource("tip", "tip", 1.0),),
    tension=ControlSource("tension", (1, 2, 3)),
    command=ControlSource("command", (1, 2, 3), latency=0.04),
    description="three tendons, one body",
)
#: the constant rotations of the bodies' axes, and where motion capture has the clamped end
TURNED = Rotation.from_euler("z", [[0.0], [90.0], [180.0], [-90.0]], degrees=True)
CLAMP = np.array([0.3, -0.2, 0.8])
LAG = 0.06


def moved(time, fraction):
    """Where a straight rod that swings about its base from 1 s on has a point, and how it is turned."""
    swing = 0.5 * np.sin(2 * np.pi * np.clip(time - 1.0, 0.0, None))
    rotation = Rotation.from_rotvec(swing[:, None] * [0.6, 0.8, 0.0])
    return rotation.apply([0.0, 0.0, LENGTH * fraction]), rotation


def made(seconds=3.0, noise=1e-4, seed=0, config=PAPER):
    """Streams as the paper's robot would send them: poses by name, tension, command."""
    rng = np.random.default_rng(seed)
    time = np.round(np.arange(0.0, seconds, 0.01), 6)
    poses = {}
    for k, marker in enumerate(config.markers):
        position, rotation = moved(time, marker.fraction)
        shaken = rotation * Rotation.from_rotvec(rng.normal(0.0, 10 * noise, (len(time), 3)))
        quaternion = (shaken * TURNED[k % 4]).as_quat(scalar_first=True)
        poses[marker.name] = Body(time, position + CLAMP + rng.normal(0.0, noise, position.shape), quaternion)
    if config.base is not None:
        above = np.array([0.0, 0.0, config.base.height])
        still = np.tile(CLAMP + above, (len(time), 1))
        turned = np.tile([1.0, 0.0, 0.0, 0.0], (len(time), 1))
        poses["base"] = Body(time, still + rng.normal(0.0, noise, still.shape), turned)
    sent = np.round(np.arange(0.0, seconds, 0.05), 6)
    phase = 2 * np.pi * (sent[:, None] - np.arange(config.count) / config.count)
    grams = np.round(500.0 + np.where(sent[:, None] < 1.0, 0.0, 200.0 * np.cos(phase)))
    command = ControlRows(sent, grams * 9.81e-3)
    seen = np.round(np.arange(0.0, seconds, 0.02), 6)
    return (
        poses,
        ControlRows(seen, lagged(command, seen) + rng.normal(0.0, 0.01, (len(seen), config.count))),
        command,
    )


def lagged(command, at):
    """Commands through a first-order lag, at times that are whole milliseconds."""
    fine = np.arange(0.0, at[-1] + 0.001, 0.001)
    held = command.values[np.searchsorted(command.time, fine + 1e-9, side="right") - 1]
    followed = [held[0]]
    for each in held[:-1]:
        followed.append(each + (followed[-1] - each) * np.exp(-0.001 / LAG))
    return np.array(followed)[np.round(at * 1000).astype(int)]


def write(path, streams, config=PAPER, **options):
    """The streams in a file."""
    poses, tension, command = streams
    write_recording(path, config, poses, tension, command, **options)
    return path


def changed(streams, name, rows=None, **parts):
    """The streams with another body: some of its rows, or other positions or quaternions."""
    poses, tension, command = streams
    pose = poses[name]
    new = {"time": pose.time, "position": pose.position, "quaternion": pose.quaternion} | parts
    if rows is not None:
        new = {key: value[rows] for key, value in new.items()}
    return {**poses, name: Body(**new)}, tension, command


def repacked(source, writer):
    """Write the messages of a bag once more, by a writer of rosbags."""
    with AnyReader([source]) as reader, writer:
        there = {
            each.topic: writer.add_connection(each.topic, each.msgtype, typestore=reader.typestore)
            for each in reader.connections
        }
        for connection, received, raw in reader.messages():
            writer.write(there[connection.topic], received, raw)


def compressed(source, path, compression, chunk):
    """Write a bag of ROS 1 once more, in chunks of so many bytes that are compressed by BZ2, LZ4 or not."""
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    writer.chunk_threshold = chunk
    repacked(source, writer)
    return path
