"""Failure of steps and its recovery: result codes, methods, and the budget of time."""

import re

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.schemes.history import TimeStep
from knode_cosserat.schemes.settings import MEASURED
from knode_cosserat.solvers.recovery import Budget, StepRecovery
from knode_cosserat.solvers.rest import resting_history
from tests.trajectories import HOPELESS

DT = 0.05


def test_a_hopeless_load_raises_one_clear_line(robot):
    tensions = np.tile(HOPELESS, (5, 1))
    with pytest.raises(kc.SimulationError) as caught:
        kc.simulate(robot, tensions, DT)
    error = caught.value
    assert "\n" not in str(error)
    assert re.search(r"step \d \(t = 0\.\d+ s\): no solution found; residual .* natural scale", str(error))
    assert "cause" in str(error)
    assert error.residual > 1e-8 and error.result is kc.Result.NO_CONVERGENCE


def test_on_request_the_rest_is_marked_invalid(robot):
    tensions = np.array([[7.0, 5.0, 5.0, 7.0]] * 2 + [HOPELESS] * 3)
    found = kc.simulate(robot, tensions, DT, on_failure="return")
    first = int(np.argmax(found.result < 0))
    assert first == 3 and found.result[first] == kc.Result.NO_CONVERGENCE
    assert np.all(found.result[first + 1 :] == kc.Result.NOT_REACHED)
    assert np.all(np.isfinite(found.y[:first])) and np.all(np.isnan(found.y[first:]))
    assert np.all(found.residual[:first] <= 1e-8)
    with pytest.raises(ValueError, match=f"row {first}"):
        found.require_valid()
    with pytest.raises(ValueError, match="invalid"):
        kc.metrics.tip_rmse(found, found)


def _step(robot, past, coefficients):
    return StepRecovery(robot, MEASURED, TimeStep(past, coefficients, DT), DT, Budget(60.0))


BDF2 = kc.solvers.BDF2().coefficients(DT, DT)


def test_load_continuation_reaches_the_solution_that_newton_finds(robot):
    step = _step(robot, resting_history(robot, MEASURED), BDF2)
    control = np.array([30.0, 5.0, 5.0, 30.0])
    direct = step.solve(control, step.guesses()[0])
    assert step.solved(direct)
    parts = step.continue_load(np.zeros(4), control)
    np.testing.assert_allclose(parts.row.records, direct.row.records, atol=1e-7)
    # by the last linearisation of each, which is near the solution
    np.testing.assert_allclose(parts.row.position_error, direct.row.position_error, rtol=0.05)


def test_a_divided_step_is_the_same_motion_in_smaller_steps(robot):
    """Two halves by hand, with the coefficients for unequal steps, give the row that dividing gives."""
    past = resting_history(robot, MEASURED)
    control = np.array([7.0, 5.0, 5.0, 7.0])
    _, found = _step(robot, past, BDF2).last_method((control, control))
    by_hand = past
    for previous in (DT, DT / 2):
        half = _step(robot, by_hand, kc.solvers.BDF2().coefficients(DT / 2, previous))
        by_hand = half.solve(control, half.guesses()[0]).state
    np.testing.assert_allclose(found.state.records[0], by_hand.records[0], atol=1e-9)
    np.testing.assert_allclose(found.state.error[0], by_hand.error[0], atol=1e-9)
    # history of the next whole step is of whole steps
    np.testing.assert_array_equal(found.state.records[1], past.records[0])
    np.testing.assert_array_equal(found.state.error[1], past.error[0])


def test_recovery_ends_within_its_budget(robot, monkeypatch):
    """Here each attempt takes 20 ms. Each of two stages ends with the attempt that exceeds the budget."""
    spend, attempts = Budget.spend, []

    def spend_20_ms(self, seconds):
        attempts.append(self.seconds)
        spend(self, 0.02)

    monkeypatch.setattr(Budget, "spend", spend_20_ms)
    controls = np.array([np.zeros(4), HOPELESS, HOPELESS])
    for budget in (0.01, 0.05):
        attempts.clear()
        with pytest.raises(
            kc.SimulationError, match=rf"stopped after {budget:g} s \(recovery_budget\)"
        ) as caught:
            kc.simulate(robot, controls, DT, recovery_budget=budget)
        assert budget < 0.02 * attempts.count(budget) <= budget + 2 * 0.02
        assert caught.value.step == 2


def test_without_a_budget_a_step_is_given_up_at_once(robot, monkeypatch):
    """Nothing is tried, and so nothing compiled for it; solved rows stay."""
    monkeypatch.setattr("knode_cosserat.solvers.recovery.Recovery.solve", None)
    controls = np.array([np.zeros(4), HOPELESS, HOPELESS])
    with pytest.raises(kc.SimulationError) as caught:
        kc.simulate(robot, controls, DT, recovery_budget=0.0)
    assert caught.value.step == 2
    found = kc.simulate(robot, controls, DT, recovery_budget=0.0, on_failure="return")
    assert found.result[1] >= 0 and found.result[2] < 0 and np.all(np.isnan(found.y[2:]))


def test_time_of_recovery_is_in_proportion_to_that_of_the_run():
    budget = Budget(None)
    assert budget.seconds == 5.0
    budget.ran(10.0)
    assert budget.seconds == 200.0
    budget.spend(150.0)
    with pytest.raises(TimeoutError):
        budget.spend(60.0)
    assert Budget(3.0).seconds == 3.0


@pytest.mark.campaign
@pytest.mark.parametrize("space", ["lobatto2", "lobatto4"])
def test_short_time_steps_on_few_long_segments(space):
    """Forward Euler was unstable there: solved to rounding, and nonsense."""
    soft = kc.robots.TendonRobot(
        length=0.87,
        radius=4.77e-3,
        density=1411.7,
        youngs_modulus=18.6e6,
        bending_damping=0.03,
        drag=1e-4,
        gravity=(0.0, 0.0, -0.15),
        nodes=5,
    )
    dt = 1.23e-3
    tensions = 0.03 * kc.controls.sine(0.05, 16, dt, base=1.0)
    found = kc.simulate(soft, tensions, dt, space=space)
    assert np.all(found.result == kc.Result.CONVERGED)
    fine = kc.simulate(soft.replace(nodes=65), tensions, dt, space="lobatto4")
    moved = np.max(np.abs(fine.tip_position - fine.tip_position[0]))
    assert np.max(np.abs(found.tip_position - fine.tip_position)) < 0.2 * moved
