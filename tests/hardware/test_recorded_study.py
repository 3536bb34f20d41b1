"""The emulated robot recorded: `study recordings` identifies it, with ROS 1 the same from rosbag's file."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from knode_cosserat.recordings import load_recording
from knode_cosserat_hardware.emulation import missing
from tests.hardware import test_ros1
from tests.hardware.test_ros1 import RosBag, equal, ros

pytestmark = [
    pytest.mark.campaign,
    pytest.mark.skipif(bool(missing()), reason=f"the firmware cannot be built here: {missing()}"),
]
__all__ = ["ros"]
ROOT = Path(__file__).parents[2]
PROGRAM = Path(__file__).with_name("record_emulated.py")
#: two to learn from, and one that is predicted
MOTIONS = ("sine_1p0", "rand_0", "sine_2p0")
WITH_ROS = not test_ros1.MISSING and test_ros1.HAS_ROSPY


def table(folder, out):
    """Cells of `study recordings` with quick settings, run as a command: each time in a new process."""
    words = ["--train", "sine_1p0,rand_0", "--methods", "baseline,calibrated", "--seconds", "3"]
    words += ["--workers", "1"]
    command = [sys.executable, "-m", "studies", "recordings", str(folder), *words]
    done = subprocess.run(
        [*command, "--out", str(out)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads((out / "table2.json").read_text())


def record(motion, *target, environment=None):
    program = [sys.executable, str(PROGRAM), motion, *map(str, target)]
    subprocess.run(program, env=environment, check=True, timeout=300.0)


def studied(folder, out):
    """Cells of a study in which identification more than halves the error."""
    cells = table(folder, out)
    predicted = {cell["method"]: cell["tip_rmse"] for cell in cells if cell["recording"] == "sine_2p0"}
    assert predicted["calibrated"] < 0.5 * predicted["baseline"]
    return cells


@pytest.mark.skipif(not WITH_ROS, reason="ROS 1 is not installed: apt-get install " + test_ros1.ros1.PACKAGES)
def test_the_study_of_what_rosbag_recorded_and_replayed(tmp_path, ros):
    own, live, replayed = (tmp_path / name for name in ("own", "live", "replayed"))
    for folder in (own, live, replayed):
        folder.mkdir()
    for motion in MOTIONS:
        recorded = RosBag(live / f"{motion}.bag", ros)
        record(motion, own / f"{motion}.bag", "ros", environment=ros)
        recorded.stop()
        again = RosBag(replayed / f"{motion}.bag", ros)
        time.sleep(2.0)
        play = ["rosbag", "play", "--quiet", "--delay=2", "--rate=4", "--wait-for-subscribers"]
        subprocess.run(
            [*play, str(recorded.path)], env=ros, check=True, timeout=120.0, stdout=subprocess.DEVNULL
        )
        again.stop()
        assert equal(load_recording(recorded.path), load_recording(again.path))
        one = load_recording(own / f"{motion}.bag")
        assert one.simulated and equal(load_recording(again.path), one)
    assert studied(own, tmp_path / "of-own") == studied(replayed, tmp_path / "of-replayed")


@pytest.mark.skipif(WITH_ROS, reason="with ROS 1 rosbag records too")
def test_the_study_of_what_the_driver_recorded(tmp_path):
    for motion in MOTIONS:
        record(motion, tmp_path / f"{motion}.bag")
    studied(tmp_path, tmp_path / "out")
