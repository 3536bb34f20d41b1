"""Quaternions in another order than their titles say are found: rotations contradict positions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knode_cosserat.recordings import load_example, load_recording
from tests.recordings.formats.exported import bent, times
from tests.recordings.made import PAPER, made, write

TIME = times()
#: what is written under the titles of w, x, y, z
WRITTEN = {
    "right": lambda q: q,
    "scalar last": lambda q: q[:, [1, 2, 3, 0]],
    "scalar first": lambda q: q[:, [3, 0, 1, 2]],
    "inverse rotation": lambda q: q * [1.0, -1.0, -1.0, -1.0],
}
AXES = {
    "along the rod": [0.0, 0.0, 0.0],
    "turned by 90 degrees": [0.0, np.pi / 2, 0.0],
    "oblique": [0.4, -1.1, 0.7],
}


def table(folder, change, axes=(0.0, 0.0, 0.0), noise=0.0, rest=True, small=1.0):
    position, rotation = bent(TIME if rest else TIME + 0.7)
    if small < 1.0:
        rotation = Rotation.from_rotvec(small * rotation.as_rotvec())
        position = position * [small, small, 1.0]
    rng = np.random.default_rng(0)
    shaken = (
        rotation * Rotation.from_rotvec(noise * rng.normal(size=(len(TIME), 3))) * Rotation.from_rotvec(axes)
    )
    quaternion = change(shaken.as_quat(scalar_first=True))
    rows = np.column_stack([TIME, 0.0 * TIME + 5.0, position, quaternion])
    head = "time [s],tension_1 [N],tip_x [m],tip_y [m],tip_z [m],tip_qw,tip_qx,tip_qy,tip_qz"
    path = folder / "it.csv"
    np.savetxt(path, rows, delimiter=",", header=head, comments="", fmt="%.7f")
    return path


def contradictions(recording):
    return [each for each in recording.findings if "contradicts its positions" in each.message]


@pytest.mark.parametrize("rest", [True, False])
@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("written", WRITTEN)
def test_another_order_of_the_quaternion_is_named(tmp_path, written, axes, rest):
    path = table(tmp_path, WRITTEN[written], AXES[axes], 0.01, rest)
    found = contradictions(load_recording(path))
    if written == "right":
        assert not found
        return
    (finding,) = found
    assert finding.severity == "problem" and finding.topic == "tip" and written in finding.message


def test_no_order_is_named_without_evidence(tmp_path):
    # the robot bends by a degree, and by noise only
    assert not contradictions(load_recording(table(tmp_path, WRITTEN["scalar last"], small=0.015)))
    assert not contradictions(load_recording(table(tmp_path, WRITTEN["right"], noise=0.3)))


def test_recordings_with_the_right_order_have_no_such_finding(tmp_path):
    assert not contradictions(load_example())
    # a rigid rod about a hinge is no arc: its rotation is half of one's
    assert not contradictions(load_recording(write(tmp_path / "it.bag", made()), PAPER))
