"""The files of the real robots: they load, fit together, and predict measurements that were not used."""

import dataclasses
import runpy
from pathlib import Path

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.identification import evaluate
from knode_cosserat.recordings import RecordingConfig

EXAMPLES = Path(__file__).parents[1] / "examples"
TRUNK, CABLES, SERVOS = (EXAMPLES / name for name in ("asl_trunk", "three_cables", "servo_robot"))


def trunk(name="identified_11"):
    return kc.load_robot(TRUNK / f"{name}.yaml")


def extract():
    """Ten seconds that the robot was not identified from, 20 rows a second."""
    config = RecordingConfig.load(TRUNK / "recording.yaml")
    table = dataclasses.replace(config.table, rate=20.0)
    return kc.load_recording(TRUNK / "extract_11.csv", config.replace(table=table, longest_gap=0.2))


def test_the_trunks_files_fit_together():
    assert RecordingConfig.load(TRUNK / "recording.yaml") == RecordingConfig.asl_trunk()
    for name in ("nominal", "identified_1", "identified_11"):
        robot = trunk(name)
        assert robot.control_layout.names == ("motor",) and robot.control_layout.size == 6
        # two tendons of each motor, at opposite sides, that end at one disk; on a reel it is in or out
        taken_in = np.asarray(robot.taken_in(np.ones(6)) - robot.taken_in(np.zeros(6)))
        for k in range(6):
            one, other = robot.routing[2 * k], robot.routing[2 * k + 1]
            assert one.end == other.end and np.hypot(one.x + other.x, one.y + other.y) < 1e-6
            assert taken_in[2 * k] == pytest.approx(-taken_in[2 * k + 1])
    seen = extract().sampled(0.05)
    assert seen.control.shape[1] == 6 and np.abs(seen.control).max() < np.radians(90.0)
    # it hangs, and z goes down
    assert np.nanmax(seen.position[:, -1, 2]) > 0.3


@pytest.mark.campaign
def test_the_trunk_is_predicted():
    seen = extract().sampled(0.05, mean=True)
    found = evaluate(trunk(), seen)
    assert found.failed is None
    error = (found.tip - seen.tip_position)[seen.complete, :2]
    swing = np.nanstd(seen.tip_position[:, :2], axis=0)
    assert np.all(np.sqrt(np.mean(error**2, axis=0)) < 0.25 * swing)


def cables(name):
    config = RecordingConfig.load(CABLES / "recording.yaml")
    return kc.load_recording(CABLES / name, config).sampled()


def test_three_cables_are_read():
    used, unused = cables("identify.csv"), cables("held_out.csv")
    assert (len(used.time), len(unused.time)) == (50, 250) and used.static
    assert not {*map(tuple, used.control)} >= {*map(tuple, unused.control)}
    # one cable is always slack, and the tip hangs below the clamped end
    assert np.all(unused.control.min(axis=1) == 0.0) and np.all(unused.position[:, 0, 2] > 0.05)


@pytest.mark.campaign
def test_three_cables_are_predicted():
    unused = cables("held_out.csv")
    robots = [kc.load_robot(CABLES / f"{name}.yaml") for name in ("nominal", "identified")]
    # the scheme in which the file was identified, on its 8 nodes
    nominal, found = (evaluate(robot, unused, space="lobatto2").tip_rmse for robot in robots)
    assert found < LIMIT and found < 0.5 * nominal


#: m, the figure of docs/real-robots.md and a little
LIMIT = 2.3e-3


def test_the_order_of_servos_is_found():
    """Servos in another order, one of them wound the other way, from pulls of one tendon at a time."""
    robot, config = kc.load_robot(SERVOS / "nominal.yaml"), RecordingConfig.load(SERVOS / "recording.yaml")
    seen = kc.load_recording(SERVOS / "tendon_pull.csv", config).sampled()
    order, sides = np.array([4, 0, 8, 2, 6, 1, 3, 7, 5]), np.array([1, 1, -1, 1, 1, 1, 1, 1, 1])
    changed = dataclasses.replace(seen, control=sides * seen.control[:, order])
    motor_order = runpy.run_path(str(SERVOS / "motor_order.py"))["motor_order"]
    found = motor_order(robot, changed)
    assert np.array_equal(found.tendons, sides * (order + 1))
    assert abs(found.turn) < np.radians(15.0)
    with pytest.raises(ValueError, match="motor 1 never moves alone"):
        motor_order(robot, changed.rows(40, 60))
    with pytest.raises(ValueError, match="2 motors; the robot has 9"):
        motor_order(robot, dataclasses.replace(seen, control=seen.control[:, :2]))


@pytest.mark.campaign
def test_the_servo_robots_tip_follows_a_circle(tmp_path):
    """On a robot with friction, slack and other stiffnesses than the model has."""
    circle = runpy.run_path(str(SERVOS / "circle.py"))["main"]
    log = circle(str(SERVOS / "identified.yaml"), str(tmp_path / "circle.png"), 20.0)
    assert log.tip_rmse(10.0) < 0.01 * 0.23


@pytest.mark.campaign
def test_what_the_robot_with_three_cables_lacks_is_learned_from_its_tip():
    """50 positions teach it; the held-out ones are better than by kernel ridge (1.5 mm)."""
    robot = kc.load_robot(CABLES / "identified.yaml")
    model = kc.fit(robot, [cables("identify.csv")])
    assert model.about.facts["residual"]
    before, after = (evaluate(it, cables("held_out.csv")).tip_rmse for it in (robot, model))
    assert after < 0.75 * before
