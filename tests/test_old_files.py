"""Files of earlier versions go on loading, and mean what they meant (tests/files/make.py made them)."""

import json
from pathlib import Path

import numpy as np
import pytest

import knode_cosserat as kc

FILES = Path(__file__).with_name("files")
TOLD = json.loads((FILES / "told.json").read_text())


def test_a_robot_of_format_1():
    robot = kc.load_robot(FILES / "robot-1.yaml")
    assert isinstance(robot, kc.TendonRobot) and robot.nodes == 5
    assert float(robot.youngs_modulus) == pytest.approx(2.757903e9)


def test_a_robot_of_format_2():
    robot = kc.load_robot(FILES / "robot-2.yaml")
    assert [load.kind for load in robot.loads] == ["point-wrench", "attached-mass"]
    assert float(robot.loads[0].at) == 0.5 and float(robot.loads[1].mass) == 0.001


def test_a_trajectory():
    found = kc.load_trajectory(FILES / "trajectory-1.nc")
    assert found.all_valid and found.dt == pytest.approx(0.05)
    np.testing.assert_allclose(found.tip_position[-1], TOLD["tip"], rtol=1e-12)
    np.testing.assert_allclose(found.control[-1], TOLD["tension"])


def test_a_model_predicts_what_it_did():
    model = kc.load_model(FILES / "model-1.model")
    before = kc.load_trajectory(FILES / "prediction-1.nc")
    found = kc.simulate(model, np.asarray(before.control)[1:], before.dt)
    np.testing.assert_allclose(found.tip_position[-1], TOLD["predicted tip"], atol=1e-9)
    np.testing.assert_allclose(found.y, before.y, atol=1e-7)
