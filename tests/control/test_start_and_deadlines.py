"""Loops in simulation: they start at rest, and count the periods whose computation was too long."""

import time

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.control import (
    Command,
    Controller,
    ControlLimits,
    Plant,
    Sensor,
    SimulatedPlant,
    circle,
    constant,
    run_loop,
)
from knode_cosserat.control.commands import Status
from knode_cosserat.control.loop import distance_out_of_reach
from knode_cosserat.estimation import KalmanObserver, TipPosition
from knode_cosserat.robots import Drawing

#: a soft rod that is clamped sideways and sags by a twentieth of its length
SAGGING = kc.robots.SlenderRod(
    length=0.3,
    radius=0.004,
    density=1200.0,
    youngs_modulus=2e8,
    bending_damping=1e-3,
    nodes=6,
    gravity=[9.81, 0.0, 0.0],
    base_end=kc.robots.ends.Driven(axes=("x",)),
)
DT = 0.01


class Point(Plant):
    """A point that goes where it is told."""

    dt = DT

    def __init__(self, late=0):
        self.place, self.late = np.zeros(3), late

    def start(self):
        self.place, self.missed = np.zeros(3), self.late
        return np.zeros(3)

    def measure(self):
        return self.place

    def apply(self, control):
        self.place = np.array(control)

    def tip(self):
        return self.place


class Slow(Controller):
    """It commands the reference, and takes some time for the command and for its other work."""

    dt = DT

    def __init__(self, command=0.0, preparation=0.0, only=None):
        self.durations, self.only = (command, preparation), only

    def reset(self, control):
        pass

    def _work(self, at, seconds):
        if self.only is None or round(at / DT) in self.only:
            time.sleep(seconds)

    def command(self, time, measured, reference):
        self._work(time, self.durations[0])
        return Command(reference.at(time)[0], Status.OPTIMAL)

    def prepare(self, time, reference):
        self._work(time - DT, self.durations[1])

    def fallback(self, reason):
        raise AssertionError(reason)


@pytest.mark.parametrize(
    ("controller", "late", "missed"),
    [
        pytest.param(Slow(), 0, 0, id="in time"),
        pytest.param(Slow(command=0.02), 0, 8, id="slow commands"),
        pytest.param(Slow(preparation=0.02), 0, 8, id="slow preparation"),
        pytest.param(Slow(0.007, 0.007), 0, 8, id="both together"),
        pytest.param(Slow(command=0.02, only=(2, 5)), 0, 2, id="two periods"),
        pytest.param(Slow(command=0.02, only=(2, 5)), 2, 2, id="counted by the plant too"),
        pytest.param(Slow(), 3, 3, id="late for other reasons"),
    ],
)
def test_a_computation_longer_than_the_period_is_a_missed_deadline(controller, late, missed):
    log = run_loop(controller, Point(late), constant([0.1, 0.0, 0.0]), 8 * DT)
    assert log.missed == log.summary()["missed"] == missed
    assert f"{missed} missed deadlines" in repr(log)


def test_a_log_has_one_tip_rmse():
    log = run_loop(Slow(), Point(), constant([0.3, 0.4, 0.0]), 8 * DT)
    # half a metre away in the first row only
    assert log.tip_rmse() == log.summary()["tip_rmse"] == 0.0
    assert log.tip_rmse(0.0) == pytest.approx(0.5 / np.sqrt(8))
    assert "tip RMSE 0.00 mm over the second half" in repr(log)


@pytest.mark.slow
def test_a_plant_and_its_observer_start_at_rest():
    sensor = Sensor(TipPosition())
    plant = SimulatedPlant(SAGGING, DT, sensor)
    still = kc.equilibrium(SAGGING, [0.0])
    assert np.linalg.norm(plant.tip() - [0.0, 0.0, 0.3]) > 0.01
    observer = KalmanObserver(SAGGING, DT, TipPosition())
    for _ in range(10):
        plant.apply(np.zeros(1))
        observer.predict(np.zeros(1))
    for tip in (plant.tip(), Drawing.of(SAGGING).positions(observer.estimate.y[-1])):
        np.testing.assert_allclose(tip, still.tip_position[0], atol=1e-7)
    # the paper's start is there too, and moves
    fallen = SimulatedPlant(SAGGING, DT, sensor, initial="unstressed")
    np.testing.assert_allclose(fallen.tip(), [0.0, 0.0, 0.3], atol=1e-12)
    fallen.apply(np.zeros(1))
    assert fallen.tip()[0] > 1e-4


@pytest.mark.slow
def test_simulations_start_in_equilibrium():
    none = np.zeros((5, 1))
    still = kc.equilibrium(SAGGING, [0.0]).tip_position[0]
    stays = kc.simulate(SAGGING, none, DT)
    np.testing.assert_allclose(stays.tip_position, np.tile(still, (6, 1)), atol=1e-8)
    both = kc.simulate([SAGGING, SAGGING.replace(density=600.0)], none, DT)
    np.testing.assert_allclose(both[0].tip_position, stays.tip_position, atol=1e-8)
    assert np.ptp(np.asarray(both[1].tip_position)[:, 0]) < 1e-8
    falls = kc.simulate(SAGGING, none, DT, initial="unstressed")
    np.testing.assert_allclose(falls.tip_position[0], [0.0, 0.0, 0.3], atol=1e-12)
    with pytest.raises(
        ValueError,
        match=r"initial is a str 'rest'; allowed is a Trajectory or \"equilibrium\" or \"unstressed\"",
    ):
        kc.simulate(SAGGING, none, DT, initial="rest")
    # one linearisation does not find how it sags
    newton = kc.solvers.NewtonOptions(max_linearisations=1)
    heavy = SAGGING.replace(gravity=[99.0, 0.0, 0.0], youngs_modulus=1e6)
    with pytest.raises(kc.SimulationError, match=r'^equilibrium: .* initial="unstressed" starts without it'):
        kc.simulate(heavy, none, DT, newton=newton, recovery_budget=0.0)


@pytest.mark.slow
def test_a_reference_beyond_the_tips_reach_is_told_with_its_distance():
    """The tip of the paper's robot moves on a surface whose highest point is the straight rod's tip."""
    robot = kc.load_robot("delrin-tendon-robot")
    limits = ControlLimits(0.0, 10.0, 40.0)

    def lacking(reference):
        return distance_out_of_reach(robot, limits, reference, 4.0)[0]

    tip = kc.equilibrium(robot, [7.0, 5.0, 5.0, 7.0]).tip_position[0]
    assert lacking(constant(tip)) == 0.0
    assert lacking(constant([0.0, 0.0, 0.641])) == pytest.approx(0.006, abs=1e-4)
    assert lacking(constant([0.0, 0.0, 0.735])) == pytest.approx(0.1, abs=1e-4)
    # with a free height the same circle is within reach
    for height, least in ((np.nan, 0.0), (0.641, 0.006)):
        found = lacking(circle(0.02, 4.0, centre=[0.0, 0.0, height], rise=1.0))
        assert least <= found <= 1.2 * least
