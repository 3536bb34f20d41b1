"""Robot files of earlier versions load as the same robot, or say what is wrong with them as usual."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.rods.robot_file import RobotFileError, format_robot, parse_robot

OLD = """format: 2
kind: routed-tendon-robot
parameters:
  length: 0.5
  radius: 0.002
  density: 8000.0
  youngs_modulus: 2.0e9
  tendon_offset: 0.02
  sleeve_stiffening: {sleeve}
  sleeve_length: 0.05
  friction_wobble: {friction}
  friction_reach: 0.2
  vibration_tension: 12.0
  vibration_rate: {vibration}
  nodes: 9
"""


def old(sleeve="null", friction="null", vibration="null"):
    return parse_robot(OLD.format(sleeve=sleeve, friction=friction, vibration=vibration), "old.yaml")


def test_an_old_file_is_today_s_robot():
    found = old("1.5", "0.3", "0.7")
    assert (float(found.friction.wobble), float(found.friction.reach)) == (0.3, 0.2)
    assert (float(found.vibration.tension), float(found.vibration.rate)) == (12.0, 0.7)
    (sleeve,) = found.sections
    assert float(sleeve.stiffening) == 1.5 and float(sleeve.length) == pytest.approx(0.1)
    # as stiff at its base as it was, and as long
    plain = old()
    for s, factor in ((0.0, 2.5), (0.05, 1.0 + 1.5 * np.exp(-1.0)), (0.4, 1.0)):
        bending = found.material(s, np.zeros(4)).Kbt[0, 0] / plain.material(s, np.zeros(4)).Kbt[0, 0]
        assert float(bending) == pytest.approx(factor, rel=1e-6)
    assert parse_robot(format_robot(found), "new.yaml").friction == found.friction


def test_parts_without_a_value_are_none():
    found = old()
    assert found.friction is None and found.vibration is None and not found.sections


def test_a_wrong_value_is_refused():
    with pytest.raises(
        RobotFileError, match=r"^old.yaml: friction.wobble must be between 0 and 100 1/m \(got -1"
    ):
        old(friction="-1.0")
    assert issubclass(RobotFileError, ValueError) and kc.robots.RobotFileError is RobotFileError
