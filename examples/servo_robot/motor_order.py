"""Find the tendon and the direction of each motor from a recording that pulls one tendon at a time.

    python examples/servo_robot/motor_order.py ROBOT RECORDING CONFIG

The row of each motor's largest displacement of the tip is compared with the nominal robot's equilibria, each
with another tendon pulled by the same length. The assignment with the least difference is printed, for any
rotation of the tendons about the rod. CONFIG may list the motors in any order.
"""

from __future__ import annotations

import sys
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

import knode_cosserat as kc


class Order(NamedTuple):
    """Tendon (from 1 on) of each motor, negative if its motor lets out, and the rotation (rad)."""

    tendons: tuple[int, ...]
    turn: float
    #: root mean square difference of the tip (m)
    error: float


def motor_order(robot: Any, measured: kc.recordings.Measurements) -> Order:
    """Return the assignment of motors to the tendons of a robot with one reel a tendon.

    Raises:
        ValueError: another number of motors, or a motor that never moves further than all others.
    """
    control, tip = measured.control, measured.position[:, -1]
    count = robot.control_layout.size
    if control.shape[1] != count:
        raise ValueError(f"the recording has {control.shape[1]} motors; the robot has {count}")
    away, moved = control - np.median(control, axis=0), np.linalg.norm(tip - np.median(tip, axis=0), axis=1)
    pulled = np.argmax(np.abs(away), axis=1)
    missing = [k + 1 for k in range(count) if k not in pulled]
    if missing:
        raise ValueError(f"motor {missing[0]} never moves alone; a recording that pulls each one is needed")
    rows = [max(np.flatnonzero(pulled == k), key=lambda row: moved[row]) for k in range(count)]
    signs = np.sign(away[rows, range(count)])
    own = signs * control[rows, range(count)]
    others = [np.mean(np.delete(signs * control[row], k)) for k, row in enumerate(rows)]
    tips = np.empty((count, count, 3))
    for k in range(count):
        inputs = others[k] + (own[k] - others[k]) * np.eye(count)
        for j in range(count):
            tips[k, j] = kc.equilibrium(robot, inputs[j]).position[-1, -1]
    best = Order((), 0.0, np.inf)
    # a rotation that takes tendons to each other gives the same error: the smallest one counts
    for turn in np.deg2rad(sorted(range(-180, 180), key=abs)):
        off = np.sum((tip[rows][:, None] - Rotation.from_euler("z", turn).apply(
            tips.reshape(-1, 3)).reshape(tips.shape)) ** 2, axis=-1)  # fmt: skip
        _, tendon = linear_sum_assignment(off)
        error = float(np.sqrt(off[range(count), tendon].mean()))
        if error < 0.99 * best.error:
            best = Order(tuple((signs * (tendon + 1)).astype(int).tolist()), float(turn), error)
    return best


if __name__ == "__main__":
    robot_file, recording, config = sys.argv[1:]
    robot = kc.load_robot(robot_file)
    meaning = kc.recordings.RecordingConfig.load(config)
    order = motor_order(robot, kc.recordings.load_recording(recording, meaning).sampled())
    print(f"order: {[abs(it) for it in order.tendons]}")
    print(f"motors that let out: {[k + 1 for k, it in enumerate(order.tendons) if it < 0]}")
    print(f"turn of the tendons: {np.rad2deg(order.turn):.0f} degrees, tip {1e3 * order.error:.0f} mm off")
