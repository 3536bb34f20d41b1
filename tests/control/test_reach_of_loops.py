"""A loop says by how much its reference is out of reach."""

import warnings

import numpy as np
import pytest

import knode_cosserat as kc

ROBOT = kc.load_robot("delrin-tendon-robot").replace(nodes=5)
LENGTH = float(ROBOT.length)
DT = 0.05


class Slack(kc.control.Controller):
    """A controller that leaves all tendons slack."""

    dt = DT

    def __init__(self, robot=ROBOT):
        self.robot, self.limits = robot, kc.control.ControlLimits(0.0, 6.0)

    def reset(self, control):
        self._control = np.zeros(4)

    def command(self, time, measured, reference):
        return kc.control.Command(np.zeros(4))


def loop(reference, controller=None):
    plant = kc.control.SimulatedPlant(ROBOT, DT, kc.control.Sensor(kc.estimation.TipPosition()))
    return kc.control.run_loop(controller or Slack(), plant, reference, 4 * DT)


@pytest.mark.parametrize("factor", [1.2, 1.07])
def test_a_point_beyond_the_straight_robot_is_out_of_reach_by_the_rest(factor):
    """The rod does not stretch: its tip is nearest to a point above it where it stands straight."""
    with pytest.warns(UserWarning, match=r"mm out of reach at t = .* s: no controls within the limits"):
        log = loop(kc.control.constant([0.0, 0.0, factor * LENGTH]))
    np.testing.assert_allclose(log.out_of_reach, (factor - 1.0) * LENGTH, rtol=0.02)
    assert f"up to {1e3 * log.out_of_reach:.3g} mm out of reach" in repr(log)


def test_what_is_reached_or_reachable_is_not_warned_of(monkeypatch):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        near = loop(kc.control.constant([0.02 * LENGTH, 0.0, 0.999 * LENGTH]))
        assert near.out_of_reach == 0.0 and near.tip_rmse() > 2e-3 * LENGTH
        # the tip follows: nothing is searched
        monkeypatch.setattr("knode_cosserat.control.loop.distance_out_of_reach", None)
        assert loop(kc.control.constant([0.0, 0.0, LENGTH])).out_of_reach == 0.0
        assert "out of reach" not in repr(near)


def test_a_controller_without_a_model_is_not_asked():
    controller = Slack(None)
    assert loop(kc.control.constant([0.0, 0.0, 1.2 * LENGTH]), controller).out_of_reach is None
