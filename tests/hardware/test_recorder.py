"""Recorder: bags equal to those of the writer; kills, full disks, names."""

import errno
import io
import os
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest

import knode_cosserat_hardware.recorder as recorder_module
from knode_cosserat.recordings import RecordingConfig, RecordingError, load_recording
from knode_cosserat_hardware.driver import DriverState, HardwareError, HostClock, Reading
from knode_cosserat_hardware.middleware.mocap import PoseFrame
from knode_cosserat_hardware.recorder import Recorder, record_robot
from tests.recordings.made import PAPER, made

pytest.importorskip("rosbags", reason="bags need rosbags: pip install 'knode-cosserat[ros]'")


class Clock:
    """A clock that a test sets."""

    def __init__(self):
        self.time = 0.0

    def __call__(self):
        return self.time


def recorded(path, streams, config=PAPER):
    """Record streams at their times, without waiting."""
    poses, tension, command = streams
    clock = Clock()
    with Recorder(path, config, clock=HostClock(clock), interval=0.02) as recorder:
        events = [(t, 0, k) for k, t in enumerate(command.time)]
        events += [(t, 1, k) for k, t in enumerate(tension.time)]
        events += [(t, 2, k) for k, t in enumerate(poses["base"].time)]
        for t, kind, k in sorted(events):
            clock.time = t
            if kind == 0:
                recorder.add_command(command.values[k])
            elif kind == 1:
                recorder.add_reading(Reading(t, tension.values[k], np.zeros(4), DriverState.ARMED))
            else:
                position = np.array([poses[name].position[k] for name in recorder.encoder.bodies])
                quaternion = np.array([poses[name].quaternion[k] for name in recorder.encoder.bodies])
                recorder.add_poses(PoseFrame(t, position, quaternion))
    return recorder


def equal(one, other):
    """True if two recordings have the same numbers at the same times."""
    for a, b in zip((*one.bodies, one.base), (*other.bodies, other.base), strict=True):
        np.testing.assert_allclose(a.time, b.time, atol=2e-9)
        np.testing.assert_array_equal(a.position, b.position)
        np.testing.assert_array_equal(a.quaternion, b.quaternion)
    for a, b in ((one.control, other.control), (one.command, other.command)):
        np.testing.assert_allclose(a.time, b.time, atol=2e-9)
        np.testing.assert_array_equal(a.values, b.values)
    return True


@pytest.fixture(scope="module")
def exact():
    """Streams without noise."""
    return made(noise=0.0)


def test_a_recording_equals_the_writers(tmp_path, exact):
    from tests.recordings.made import write

    recorder = recorded(tmp_path / "live.bag", exact)
    assert not recorder.active_path.exists()
    live, whole = load_recording(tmp_path / "live.bag"), load_recording(write(tmp_path / "all.bag", exact))
    assert equal(live, whole)
    assert not [each for each in live.findings if each.severity != "note"]
    assert live.simulated is None


def test_the_index_is_that_of_rosbag(tmp_path, exact):
    from rosbags.rosbag1 import Reader

    recorder = recorded(tmp_path / "live.bag", exact)
    with Reader(tmp_path / "live.bag") as bag:
        times = [received for _, received, _ in bag.messages()]
        assert len(times) == bag.message_count == recorder.written
        assert times == sorted(times)
        assert len(bag.chunk_infos) >= 1
        assert bag.topics["/tension"].msgtype == "geometry_msgs/msg/QuaternionStamped"


def test_a_simulated_robot_is_stated(tmp_path, exact):
    recorded(tmp_path / "live.bag", exact, PAPER.replace(simulated=True))
    assert load_recording(tmp_path / "live.bag").simulated


def test_lost_bodies_and_tensions_have_no_message(tmp_path):
    poses, tension, command = made(seconds=1.0, noise=0.0)
    poses["rib 2"].position[40:43] = np.nan
    tension.values[7, 2] = np.nan
    recorded(tmp_path / "live.bag", (poses, tension, command))
    recording = load_recording(tmp_path / "live.bag")
    assert [len(body.time) for body in recording.bodies] == [100, 97, 100, 100]
    assert len(recording.control.time) == 49


KILLED = """
import sys, time
import numpy as np
from knode_cosserat_hardware.driver import DriverState, Reading
from knode_cosserat_hardware.middleware.mocap import PoseFrame
from knode_cosserat_hardware.recorder import Recorder
recorder = Recorder(sys.argv[1])
height = np.array([0.0635, -0.42, -0.28, -0.14, 0.0]) + 0.635
k = 0
while True:
    now = time.monotonic()
    k += 1
    recorder.add_reading(Reading(now, np.full(4, 5.0), np.zeros(4), DriverState.ARMED))
    place = np.stack([np.zeros(5), np.full(5, 1e-6 * k), height], axis=1)
    recorder.add_poses(PoseFrame(now, place, np.tile([1.0, 0, 0, 0], (5, 1))))
    print(now, flush=True)
    time.sleep(0.02)
"""


def test_a_kill_loses_one_second_at_most(tmp_path):
    path = tmp_path / "run.bag"
    program = [sys.executable, "-c", textwrap.dedent(KILLED), str(path)]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as process:
        begin = last = float(process.stdout.readline())
        while last < begin + 2.5:
            last = float(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
        rest = process.stdout.read().splitlines()
    last = float(rest[-1]) if rest else last
    assert not path.exists()
    recording = load_recording(path.with_name("run.bag.active"))
    # the interval is 0.5 s; a slow disk or a busy machine adds to it
    assert last - begin - recording.control.time[-1] < 1.0
    assert any("recorder was stopped" in each.message for each in recording.findings)
    # the name of the killed one is not taken
    with pytest.raises(HardwareError, match=r"run.bag.active: this file exists"):
        Recorder(path)


def filled(monkeypatch, chunks):
    """Let writes fail as on a full disk after a number of chunks, each halfway."""
    write = io.FileIO.write
    sync, synced = recorder_module._WholeFile.sync, [0]

    def counted(file):
        synced[0] += 1
        sync(file)

    def limited(file, data):
        if synced[0] >= chunks:
            write(file, bytes(data[: len(data) // 2]))
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        while data:
            data = data[write(file, data) :]

    monkeypatch.setattr(recorder_module._WholeFile, "sync", counted)
    monkeypatch.setattr(recorder_module._WholeFile, "write", limited)


def test_a_full_disk_is_one_error_and_keeps_what_was_written(tmp_path, monkeypatch):
    filled(monkeypatch, chunks=2)
    recorder = Recorder(tmp_path / "run.bag", interval=0.02)
    reading = Reading(time.monotonic(), np.full(4, 5.0), np.zeros(4), DriverState.ARMED)
    frame = PoseFrame(0.0, np.tile([0.0, 0.0, 0.5], (5, 1)), np.tile([1.0, 0, 0, 0], (5, 1)))

    def record():
        for k in range(1000):
            recorder.add_reading(reading._replace(time=0.02 * k))
            recorder.add_poses(frame._replace(time=0.02 * k, position=frame.position + 1e-6 * k))
            time.sleep(0.005)

    with pytest.raises(HardwareError, match=r"No space left on device; \d+ messages are kept in .*active$"):
        record()
    recorder.close()  # the error was raised once
    recording = load_recording(recorder.active_path)
    assert len(recording.control.time) >= 1
    assert len(recording.control.time) + 5 * len(recording.bodies[0].time) == recorder.written


@pytest.mark.skipif(not os.path.exists("/dev/shm") or os.geteuid() != 0, reason="mounting needs root")
def test_a_disk_that_is_really_full(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)], check=False)
    if mounted.returncode:
        pytest.skip("this machine does not allow mounting")
    try:
        recorder = Recorder(disk / "run.bag", interval=0.02)
        reading = Reading(0.0, np.full(4, 5.0), np.zeros(4), DriverState.ARMED)

        def record():
            for k in range(100_000):
                recorder.add_reading(reading._replace(time=0.02 * k))
                time.sleep(0.0 if k % 100 else 0.02)

        with pytest.raises(HardwareError, match="No space left"):
            record()
        recorder.close()
        from knode_cosserat.recordings.formats.bag import read_ros1

        bag = read_ros1(recorder.active_path, ["/tension"])
        assert len(bag.topics["/tension"].received) == recorder.written > 100
        assert bag.lost == 0
    finally:
        subprocess.run(["umount", str(disk)], check=False)


def test_an_error_at_the_end_is_raised_by_close(tmp_path, monkeypatch):
    filled(monkeypatch, chunks=0)
    recorder = Recorder(tmp_path / "run.bag", interval=10.0)
    recorder.add_command(np.full(4, 5.0))
    with pytest.raises(HardwareError, match="No space left"):
        recorder.close()
    recorder.close()
    assert recorder.active_path.exists()


def test_an_error_in_the_block_is_not_hidden(tmp_path, monkeypatch):
    filled(monkeypatch, chunks=0)

    def record():
        with Recorder(tmp_path / "run.bag", interval=10.0) as recorder:
            recorder.add_command(np.full(4, 5.0))
            raise KeyError

    with pytest.raises(KeyError):
        record()


def test_wrong_names_and_values(tmp_path):
    with pytest.raises(HardwareError, match=r"must end in \.bag"):
        Recorder(tmp_path / "run.mcap")
    (tmp_path / "old.bag").write_bytes(b"")
    with pytest.raises(HardwareError, match="this file exists"):
        Recorder(tmp_path / "old.bag")
    with pytest.raises(HardwareError, match="cannot be written: No such file"):
        Recorder(tmp_path / "folder" / "run.bag")
    with pytest.raises(HardwareError, match="interval"):
        Recorder(tmp_path / "run.bag", interval=0.0)
    with pytest.raises(RecordingError, match="angle cannot be recorded"):
        Recorder(tmp_path / "run.bag", RecordingConfig.asl_trunk())
    with Recorder(tmp_path / "run.bag") as recorder:
        with pytest.raises(RecordingError, match="4 tendons"):
            recorder.add_command(np.zeros(3))
        with pytest.raises(RecordingError, match="finite"):
            recorder.add_command(np.full(4, np.nan))
        with pytest.raises(RecordingError, match="5 bodies"):
            recorder.add_poses(PoseFrame(0.0, np.zeros((4, 3)), np.zeros((4, 4))))
    with pytest.raises(HardwareError, match="closed"):
        recorder.add_command(np.zeros(4))


def test_a_robot_is_recorded_for_a_time(tmp_path):
    class Source:
        def read(self, timeout=1.0):
            clock.time += 0.02
            return Reading(clock.time, np.full(4, 5.0), np.zeros(4), DriverState.READY)

    class Capture:
        def frames(self):
            place = np.tile([0.0, 0.0, 0.5], (5, 1)) + 1e-6 * clock.time
            frame = PoseFrame(clock.time, place, np.tile([1.0, 0, 0, 0], (5, 1)))
            return [frame._replace(time=clock.time - 0.01), frame]

    clock = Clock()
    with Recorder(tmp_path / "run.bag", clock=HostClock(clock)) as recorder:
        assert record_robot(recorder, Source(), 1.0, Capture()) == 50
    assert len(load_recording(tmp_path / "run.bag").control.time) == 50
