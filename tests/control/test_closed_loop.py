"""Closed loops around simulated robots: accuracy, limits, adaptation, and faults.

All loops share one compiled program: the same robot, outputs, horizon and adapted parameters.
"""

import time

import numpy as np
import pytest
from numpy.testing import assert_allclose

import knode_cosserat as kc
from knode_cosserat.control import (
    ControlLimits,
    PredictiveController,
    Sensor,
    SimulatedPlant,
    SoftLimit,
    circle,
    constant,
    run_loop,
    steps,
)
from knode_cosserat.control.ilqr import ILQR
from knode_cosserat.control.koopman import KoopmanController
from knode_cosserat.control.loop import check_reference, distance_out_of_reach, warm_up
from knode_cosserat.control.lqr import LQR, realize
from knode_cosserat.control.mppi import MPPI
from knode_cosserat.control.references import ReferenceFormatError
from knode_cosserat.control.tip_feedback import PID, KinematicController
from knode_cosserat.estimation import Curvatures, KalmanObserver, TipPosition
from knode_cosserat.estimation.online import split_record
from knode_cosserat.identification import evaluate
from knode_cosserat.learning.residual import Nothing
from knode_cosserat.rods.passport import LearnedRange, Passport, with_passport

pytestmark = pytest.mark.slow

DT, LENGTH = 0.05, 0.635
ROBOT = kc.load_robot("delrin-tendon-robot")
E = float(ROBOT.youngs_modulus)
LIMITS = ControlLimits(0.0, 10.0, 40.0)


def observer(model=ROBOT):
    return KalmanObserver(model, DT, TipPosition(), adapt=["youngs_modulus"])


def controller(model=ROBOT, **options):
    return PredictiveController(observer(model), TipPosition(), LIMITS, **options)


def plant(robot=ROBOT, **sensor):
    return SimulatedPlant(robot, DT, Sensor(TipPosition(), **sensor))


@pytest.fixture(scope="module")
def wrong_model():
    """A loop whose model is 30 % too stiff, with noise and lost measurements."""
    model = ROBOT.replace(youngs_modulus=1.3 * E)
    return run_loop(controller(model), plant(noise=0.5, dropout=0.05), circle(0.1, 1.5), 7.0)


@pytest.mark.campaign
def test_an_exact_model_follows_a_fast_circle():
    log = run_loop(controller(), plant(), circle(0.1, 1.5), 6.0)
    assert log.tip_rmse(5.0) <= 1e-3 * LENGTH
    assert log.fallbacks == 0


def test_a_soft_limit_that_the_start_violates_is_reached_and_then_kept():
    limit = SoftLimit(TipPosition(), low=[-np.inf, 0.3, -np.inf])
    log = run_loop(controller(soft=[limit]), plant(), circle(0.1, 4.0), 3.0)
    assert log.fallbacks == 0
    assert log.violation[0] > 0.1 and np.all(log.violation[20:] < 1e-3)
    assert np.all(log.tip[20:, 1] > 0.3 - 1e-3)


def test_an_unannounced_step_is_reached_and_held():
    log = run_loop(controller(), plant(), steps([[0.05, 0.0, np.nan], [-0.05, 0.05, np.nan]], 2.0), 4.0)
    settled = (log.time % 2.0) >= 1.0
    assert np.max(log.tip_distance[settled]) < 1e-3 * LENGTH


def test_a_wrong_stiffness_is_found_and_the_circle_followed(wrong_model):
    assert wrong_model.tip_rmse(5.0) <= 5e-3 * LENGTH
    assert_allclose(wrong_model.parameters["youngs_modulus"][wrong_model.time > 5.0], E, rtol=0.03)


def test_hard_limits_are_never_exceeded(wrong_model):
    control = wrong_model.control
    assert control.min() >= 0.0 and control.max() <= 10.0
    assert np.max(np.abs(np.diff(control, axis=0))) <= 40.0 * DT + 1e-12


def test_a_log_reports_and_is_written(wrong_model, tmp_path):
    facts = wrong_model.summary()
    assert facts["periods"] == 140 and facts["tip_rmse"] < 5e-3 * LENGTH
    wrong_model.to_csv(tmp_path / "log.csv")
    lines = (tmp_path / "log.csv").read_text().splitlines()
    assert len(lines) == 141 and lines[0].startswith("t (s),reference 0")
    assert "tip RMSE" in repr(wrong_model)
    assert wrong_model.control_layout == ROBOT.control_layout


def test_a_loop_is_a_recording_of_its_robot(tmp_path):
    log = run_loop(controller(), plant(), circle(0.1, 1.5), 2.0)
    log.measurements(simulated=True).save(tmp_path / "loop.csv")
    rows = kc.load_recording(tmp_path / "loop.csv").sampled(DT)
    assert evaluate(ROBOT, rows, space="lobatto2").tip_rmse < 1e-6  # the scheme of the simulated robot
    assert evaluate(ROBOT.replace(youngs_modulus=1.3 * E), rows).tip_rmse > 1e-3
    with pytest.raises(
        ValueError, match="a measurement has 3 numbers; allowed are the positions of 2 bodies"
    ):
        log.measurements((0.5, 1.0))


def test_a_loop_has_the_estimated_states_as_a_trajectory(tmp_path):
    robot = plant()
    log = run_loop(controller(), robot, circle(0.1, 1.5), 2.0)
    log.estimated.save(tmp_path / "loop.nc")
    found = kc.load_trajectory(tmp_path / "loop.nc")
    assert_allclose(found.time, log.time)
    # an exact model and exact measurements: the estimate is the truth, with the control that led there
    assert_allclose(found.tip_position, log.tip, rtol=0, atol=1e-5)
    assert_allclose(found.control[1:], log.control[:-1], rtol=0, atol=1e-12)
    pid = PID(ROBOT, DT, LIMITS)
    assert run_loop(pid, robot, circle(0.1, 4.0), 0.5).estimated is None


def test_a_log_says_where_the_model_extrapolates():
    """By the controls alone, or by estimated strains too."""
    known = {"tension": LearnedRange("N", np.zeros(4), np.full(4, 2.0))}
    strains = {"u": LearnedRange("1/m", np.full(3, -1e-3), np.full(3, 1e-3))}
    model = with_passport(ROBOT, Passport("identify", controls=known, strains=strains))
    words = [
        run_loop(each, plant(), circle(0.1, 1.5), 1.0).extrapolation
        for each in (PID(model, DT, LIMITS), controller(model), controller())
    ]
    assert "of 20 periods are outside what the model learned from: tension_" in words[0]
    assert " N (learned 0 to 2)" in words[0] and "strain" not in words[0]
    assert "strain u_" in words[1] and " 1/m (learned -0.001 to 0.001)" in words[1]
    assert words[2] == ""


def test_a_reference_of_other_numbers_is_not_taken_for_positions():
    bent = Curvatures((0.5,))
    found = PredictiveController(observer(), bent, LIMITS)
    check_reference(found, constant([3.0, -2.0]), 1.0)
    with pytest.raises(ReferenceFormatError, match="from the base"):
        check_reference(controller(), constant([3.0, -2.0, 0.0]), 1.0)


def test_what_cannot_be_followed_is_told_before_the_loop_starts():
    with pytest.raises(ReferenceFormatError, match=r"is 100 m from the base.*the robot is 0.635 m long"):
        run_loop(controller(), plant(), circle(100.0, 4.0), 2.0)
    within = distance_out_of_reach(ROBOT, LIMITS, circle(0.1, 4.0), 10.0)[0]
    beyond, time = distance_out_of_reach(ROBOT, LIMITS, circle(0.6, 4.0), 10.0)
    assert within == 0.0 and 0.1 < beyond < 0.2 and time > 1.0
    with pytest.raises(
        ValueError, match=r"horizon is 10000000; its derivatives need .* GB; allowed are at most"
    ):
        controller(horizon=10_000_000)


def test_columns_of_the_observer_are_derivatives_of_the_step():
    """Oracle: differences of steps with other tensions."""
    own = observer()
    tension = np.array([6.0, 3.0, 2.0, 4.0])
    h, unseen = 1e-4, np.full((1, 3), np.nan)

    def tip(control):
        none = np.zeros(4), np.zeros(1)
        found = own.model.predicted(own.belief, control[None], unseen, none, own.output)
        return np.asarray(TipPosition().value(ROBOT, *split_record(ROBOT, found.record)))

    deviations = np.ones(4), np.zeros(1)
    found = own.model.predicted(own.belief, tension[None], unseen, deviations, own.output)
    columns = np.asarray(found.by_column)[own.columns : own.columns + 4, 0]
    differences = [(tip(tension + h * one) - tip(tension - h * one)) / (2.0 * h) for one in np.eye(4)]
    assert_allclose(columns, differences, rtol=1e-5, atol=1e-9)


def test_a_failed_program_is_replaced_by_the_plan_then_held_then_safe(monkeypatch):
    monkeypatch.setattr("knode_cosserat.control.qp.solve", lambda problem: None)
    log = run_loop(controller(), plant(), circle(0.1, 4.0), 1.0)
    assert log.fallbacks == 20
    assert [log.status[k] for k in (0, 4, 5, 9, 10, 19)] == [
        "shifted plan",
        "shifted plan",
        "held",
        "held",
        "going safe",
        "going safe",
    ]
    assert set(log.reason) == {"the quadratic program was not solved"}
    assert np.all(np.isfinite(log.control))


def test_lost_measurements_do_not_stop_the_loop():
    log = run_loop(controller(), plant(dropout=0.9, seed=3), circle(0.1, 4.0), 3.0)
    assert np.isnan(log.measured).any() and log.fallbacks == 0
    assert np.all(np.isfinite(log.control))


def test_warming_up_leaves_the_observer_where_it_is():
    own = controller()
    before = own.observer.belief
    warm_up(own, plant(), circle(0.1, 4.0))
    assert own.observer.belief is before and own.observer.time == 0.0


def test_a_period_that_begins_late_is_counted():
    """The plant takes longer than a period, but less than two."""

    class Slow(SimulatedPlant):
        def apply(self, control):
            time.sleep(1.3 * DT)
            super().apply(control)

    slow = Slow(ROBOT, DT, Sensor(TipPosition()))
    log = run_loop(PID(ROBOT, DT, LIMITS), slow, circle(0.1, 4.0), 0.5, paced=True)
    assert log.missed == len(log.time) - 1


@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["model", "model of a model"])
def test_a_model_controls_a_robot(kind):
    model = kc.KNODE(ROBOT, Nothing())
    model = model if kind == "model" else kc.KNODE(model, Nothing())
    for own in (controller(model), PID(model, DT, LIMITS), KinematicController(model, DT, LIMITS)):
        log = run_loop(own, plant(), circle(0.05, 6.0), 2.0)
        assert log.fallbacks == 0 and np.all(np.isfinite(log.control))


def test_controllers_without_dynamics_hold_a_slow_circle():
    for kind in (PID, KinematicController):
        log = run_loop(kind(ROBOT, DT, LIMITS), plant(), circle(0.05, 60.0), 8.0)
        assert log.tip_rmse(4.0) < 0.02 * LENGTH, kind.__name__


@pytest.mark.campaign
def test_every_baseline_holds_a_slow_circle():
    """The exact model, so that errors are those of the method: sampling and lifting are rough."""
    target = TipPosition()
    made = {
        LQR(ROBOT, DT, LIMITS): 2e-3,
        KoopmanController(ROBOT, DT, LIMITS): 0.03,
        ILQR(KalmanObserver(ROBOT, DT, target), target, LIMITS): 5e-3,
        MPPI(KalmanObserver(ROBOT, DT, target), target, LIMITS): 0.03,
    }
    for each, most in made.items():
        log = run_loop(each, plant(), circle(0.1, 4.0), 6.0)
        assert log.tip_rmse(4.0) < most * LENGTH, type(each).__name__
        assert log.control.min() >= 0.0 and log.control.max() <= 10.0


def test_a_realized_model_has_the_responses_it_was_made_of():
    """Oracle: the responses of a known linear system of order three."""
    rng = np.random.default_rng(0)
    A = np.diag([0.9, 0.6, -0.3])
    B, C = rng.normal(size=(3, 2)), rng.normal(size=(2, 3))
    responses = np.array([C @ np.linalg.matrix_power(A, k) @ B for k in range(40)])
    found = realize(responses, least=1e-10)
    assert found[0].shape == (3, 3)
    again = [found[2] @ np.linalg.matrix_power(found[0], k) @ found[1] for k in range(40)]
    assert_allclose(again, responses, atol=1e-10)


def test_parameters_that_were_learned_from_a_broken_sensor_are_taken_back():
    """For two seconds the sensor shows a movement that is a quarter too large; then it is well again."""
    own, truth = observer(), plant()
    tension = [5.0 + 2.0 * np.sin(0.3 * k + np.arange(4) * np.pi / 2.0) for k in range(140)]
    modulus = []
    for k, control in enumerate(tension):
        seen = truth.measure()
        wrong = np.array([1.25, 1.25, 1.0]) if 40 <= k < 80 else 1.0
        own.update(wrong * seen)
        modulus.append(own.estimate.parameters["youngs_modulus"] / E)
        truth.apply(control)
        own.predict(control)
    assert abs(modulus[39] - 1.0) < 0.02 and max(abs(each - 1.0) for each in modulus[40:80]) > 0.1
    assert own.rollbacks >= 1
    assert abs(modulus[-1] - 1.0) < 0.02


def test_a_stiffness_does_not_drift_at_rest():
    """Not even when the robot is straight, so that only noise says something about it."""
    own = observer()
    rng = np.random.default_rng(0)
    tip = plant().measure()
    for _ in range(200):
        own.update(tip + 2e-4 * rng.normal(size=3))
        own.predict(np.zeros(4))
    assert own.estimate.parameters["youngs_modulus"] == pytest.approx(E, rel=0.02)


def test_nothing_is_compiled_in_the_loop(wrong_model):
    assert wrong_model.compiled == 0


def test_wrong_arguments_are_told_in_one_line():
    own = controller()
    with pytest.raises(ValueError, match=r"the controller's period is 0.05 s and the plant's 0.1 s"):
        run_loop(own, SimulatedPlant(ROBOT, 0.1, Sensor(TipPosition())), circle(0.1, 4.0), 1.0)
    with pytest.raises(ValueError, match=r"a measurement has shape \(2,\); allowed is \(3,\)"):
        own.command(0.0, np.zeros(2), circle(0.1, 4.0))
    with pytest.raises(ValueError, match="knots is 30; allowed are 2 to the horizon"):
        controller(knots=30)
    with pytest.raises(kc.KnodeCosseratError, match="no parameter 'stiffness'"):
        KalmanObserver(ROBOT, DT, TipPosition(), adapt=["stiffness"])
    with pytest.raises(ValueError, match=r"dropout is 1\.5"):
        Sensor(TipPosition(), dropout=1.5)
