"""Predictions whose size is chosen for a period of control. Times come from fake clocks and costs."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.control import (
    ControlLimits,
    PredictiveController,
    RealtimeError,
    Sensor,
    SimulatedPlant,
    circle,
    controller_named,
    realtime,
    run_loop,
)
from knode_cosserat.control.planning import Knots
from knode_cosserat.control.realtime import Size, candidates, choose_size, seconds_in_period
from knode_cosserat.estimation import KalmanObserver, TipPosition
from tests import commands

DT = 0.02
ROBOT = kc.load_robot("delrin-tendon-robot")
LIMITS = ControlLimits(0.0, 10.0, 40.0)


def seconds(size):
    """A computer that takes 10 µs for each knot in each step."""
    return 1e-5 * size.horizon * size.knots


@pytest.mark.parametrize("dt", [0.005, 0.01, 0.02, 0.05, 0.1, 0.5])
def test_candidates_take_less_and_less_time(dt):
    sizes = candidates(dt)
    times = [seconds(size) for size in sizes]
    assert times == sorted(times, reverse=True) and len(set(sizes)) == len(sizes)
    assert sizes[0].stride == 1 and all(size.knots <= size.horizon for size in sizes)
    horizons = [size.horizon * size.stride * dt for size in sizes]
    assert max(horizons) <= max(realtime.LONGEST, realtime.FEWEST * dt) + 1e-9
    assert min(horizons) >= realtime.SHORTEST - 1e-9
    assert all(size.stride == 1 or size.stride * dt <= realtime.COARSEST + 1e-9 for size in sizes)


@pytest.mark.parametrize(("dt", "share"), [(0.02, 0.6), (0.01, 0.2), (0.01, 0.05), (0.02, 0.04)])
def test_the_first_size_that_fits_is_chosen(dt, share):
    choice = choose_size(seconds, dt, share)
    sizes = candidates(dt)
    assert choice.size == next(size for size in sizes if seconds(size) <= share * dt)
    assert choice.seconds == seconds(choice.size)
    assert choice == choose_size(seconds, dt, share)
    assert f"{choice.size.knots} knots" in str(choice) and f"ms of {1e3 * dt:g} ms a period" in str(choice)


def test_a_computer_that_is_too_slow_is_told_with_the_shortest_period():
    with pytest.raises(RealtimeError, match=r"60 % of the period of 20 ms.*a period of at least 53\.3 ms"):
        choose_size(lambda size: 1e-3 * size.horizon * size.knots, DT, 0.6)
    with pytest.raises(ValueError, match=r"realtime is 2; allowed is above 0 to 1"):
        choose_size(seconds, DT, 2)


def test_steps_of_several_periods_hold_the_means_of_the_controls():
    knots = Knots.spaced(6, 4, 3)
    assert knots.horizon == 18 and all(sample % 3 == 0 for sample in knots.samples)
    plan = np.random.default_rng(0).normal(size=(4, 2))
    samples = knots.controls(plan)
    np.testing.assert_allclose(knots.means(knots.basis) @ plan, samples.reshape(6, 3, 2).mean(axis=1))
    np.testing.assert_allclose(samples[list(knots.samples)], plan)


@pytest.fixture(scope="module")
def observer():
    return KalmanObserver(ROBOT, DT, TipPosition())


def test_the_median_of_a_clock_is_measured_without_moving_the_controller(observer):
    own = PredictiveController(observer, TipPosition(), LIMITS, horizon=4, knots=3)
    before, plan = observer.belief, own._plan
    ticks = iter(range(10_000))
    # each of the two parts of a period takes one tick
    assert seconds_in_period(own, lambda: float(next(ticks))) == 2.0
    assert observer.belief is before and own._plan is plan


def test_a_chosen_controller_runs_and_its_numbers_make_it_again(observer, monkeypatch):
    def fake(controller):
        return 2e-4 * controller.knots.steps * controller.knots.count

    monkeypatch.setattr("knode_cosserat.control.predictive.seconds_in_period", fake)
    own = PredictiveController(observer, TipPosition(), LIMITS, realtime=True)
    assert own.choice is not None and own.choice.size == Size(**own.settings) == Size(10, 5, 2)
    assert "horizon 0.4 s in 10 steps of 40 ms, 5 knots: 10.0 ms of 20 ms a period" in repr(own)

    def closed(controller):
        controller.observer.restart()
        return run_loop(controller, SimulatedPlant(ROBOT, DT, Sensor(TipPosition())), circle(0.1, 1.5), 1.0)

    log = closed(own)
    assert log.fallbacks == 0 and log.settings == log.summary()["settings"] == own.settings
    again = closed(PredictiveController(observer, TipPosition(), LIMITS, **log.settings))
    np.testing.assert_array_equal(again.control, log.control)
    # a larger share, by the name of the controller
    named = controller_named("predictive:realtime=1", ROBOT, DT, LIMITS)
    assert named.settings["horizon"] > own.settings["horizon"]
    with pytest.raises(ValueError, match="give either realtime or these numbers"):
        PredictiveController(observer, TipPosition(), LIMITS, realtime=True, horizon=12)


def test_the_command_says_what_was_chosen(monkeypatch):
    monkeypatch.setattr("knode_cosserat.control.predictive.seconds_in_period", lambda controller: 4e-3)
    words = "control", commands.ROBOT, "--dt", "0.1", "--reference", "circle:radius=0.05,period=4"
    said = commands.succeeded(*words, "--seconds", "0.3", "--realtime")
    assert "horizon 1 s in 10 steps of 100 ms, 5 knots: 4.0 ms of 100 ms a period" in said
    given = said.split("--method ")[1].split()[0]
    again = commands.told(*words, "--seconds", "0.3", "--method", given)
    assert again["settings"] == {"horizon": 10, "knots": 5, "stride": 1}
    failed = commands.run(*words, "--method", "pid", "--realtime")
    assert failed.exit_code != 0 and "has no option 'realtime'" in failed.stderr
