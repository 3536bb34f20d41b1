"""What `simulate` and `equilibrium` promise beyond the physics: result codes, recovery, batches, errors."""

import dataclasses
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import knode_cosserat as kc
from knode_cosserat.solvers.boundary import residuals
from knode_cosserat.solvers.march import march_many, weights_by
from knode_cosserat.solvers.past import EXTRAPOLATIONS, advanced, history_of, padded_rows, resting_past
from knode_cosserat.solvers.problem import StepProblem
from knode_cosserat.solvers.recovery import _continue_load, _Step, _substeps
from knode_cosserat.solvers.settings import Settings

DT = 0.05


@pytest.fixture(scope="module")
def robot():
    return kc.load_robot("delrin-tendon-robot")


@pytest.fixture(scope="module")
def sine():
    return kc.controls.sine(1.5, 100, DT)


@pytest.fixture(scope="module")
def truth(robot, sine):
    return kc.simulate(robot, sine, DT)


def test_rows_time_and_controls(robot, sine, truth):
    assert truth.y.shape == (101, 10, 19) and truth.z.shape == (101, 10, 6)
    np.testing.assert_allclose(truth.time, np.arange(101) * DT)
    np.testing.assert_array_equal(truth.tension[1:], sine)
    np.testing.assert_array_equal(truth.tension[0], 0.0)
    np.testing.assert_allclose(truth.arclength, np.linspace(0.0, 0.635, 10))
    np.testing.assert_allclose(truth.position[0, :, 2], np.linspace(0.0, 0.635, 10))
    assert truth.all_valid and np.all(truth.result == kc.Result.CONVERGED)


def test_the_residual_that_is_reported_is_that_of_the_states_that_are_returned(robot, sine, truth):
    for i in (1, 2, 50, 100):
        x = np.concatenate([truth.y, truth.z], axis=-1)
        history = (-2.0 * x[i - 1] + 0.5 * x[max(i - 2, 0)]) / DT
        problem = StepProblem(
            robot, jnp.array(i * DT), sine[i - 1], jnp.array(1.5 / DT), history[None], kc.Euler()
        )
        defects, tip = residuals(problem, jnp.asarray(truth.y[i]))
        scales = robot.scales()
        largest = max(np.max(np.abs(defects / scales.y)), np.max(np.abs(tip / scales.tip)))
        assert largest == pytest.approx(truth.residual[i], rel=0.2, abs=2e-13)
        assert largest <= 1e-8


def test_lengths_share_a_program_and_agree(robot, sine, truth):
    shorter = kc.simulate(robot, sine[:70], DT)
    np.testing.assert_array_equal(shorter.y, truth.y[:71])


def test_progress_changes_nothing(robot, sine, truth, capfd):
    np.testing.assert_array_equal(kc.simulate(robot, sine, DT, progress=True).y, truth.y)
    assert "step" in capfd.readouterr().err


# failure and recovery


def test_a_hopeless_load_raises_one_clear_line(robot):
    tensions = np.tile([5000.0, 0.0, 0.0, 5000.0], (5, 1))
    with pytest.raises(kc.SimulationError) as caught:
        kc.simulate(robot, tensions, DT)
    error = caught.value
    assert "\n" not in str(error)
    assert re.search(r"step \d \(t = 0\.\d+ s\): no solution found; residual .* natural scale", str(error))
    assert "cause" in str(error)
    assert error.residual > 1e-8 and error.result is kc.Result.NO_CONVERGENCE


def test_on_request_the_rest_is_marked_invalid(robot):
    tensions = np.tile([5000.0, 0.0, 0.0, 5000.0], (5, 1))
    found = kc.simulate(robot, tensions, DT, on_failure="return")
    first = int(np.argmax(found.result < 0))
    assert found.result[first] == kc.Result.NO_CONVERGENCE
    assert np.all(found.result[first + 1 :] == kc.Result.NOT_REACHED)
    assert np.all(np.isfinite(found.y[:first])) and np.all(np.isnan(found.y[first:]))
    assert np.all(found.residual[:first] <= 1e-8)
    with pytest.raises(ValueError, match=f"row {first}"):
        found.require_valid()
    with pytest.raises(ValueError, match="invalid"):
        kc.tip_rmse(found, found)


def _step(robot, coefficients=None):
    past = resting_past(robot, Settings())
    coefficients = coefficients or kc.BDF2().coefficients(DT, DT)
    return _Step(robot, Settings(), past, coefficients, DT), past


def test_load_continuation_reaches_the_solution_that_newton_finds(robot):
    step, _ = _step(robot)
    control = np.array([30.0, 5.0, 5.0, 30.0])
    direct = step.solve(control, *step.guesses()[0])
    assert step.solved(direct[0])
    parts = _continue_load(step, np.zeros(4), control)
    np.testing.assert_allclose(parts[1], direct[1], atol=1e-7)


def test_a_divided_step_is_the_same_motion_in_smaller_steps(robot):
    """Two halves by hand, with the coefficients for unequal steps, give the row that dividing gives."""
    _, past = _step(robot)
    control = np.array([7.0, 5.0, 5.0, 7.0])
    whole = _Step(robot, Settings(), past, kc.BDF2().coefficients(DT, DT), DT)
    step, found = _substeps(whole, (control, control), DT)
    by_hand = past
    for previous in (DT, DT / 2):
        half = _Step(robot, Settings(), by_hand, kc.BDF2().coefficients(DT / 2, previous), DT)
        solution, record = half.solve(control, *half.guesses()[0])
        by_hand = half.after(solution, record)
    np.testing.assert_allclose(found[1], by_hand.records[0], atol=1e-9)
    # the next whole step looks back on whole steps
    after = step.after(*found)
    np.testing.assert_array_equal(after.records[1], past.records[0])


@pytest.mark.campaign
def test_a_run_that_blows_up_in_space_is_repeated_with_finer_segments():
    """Forward Euler on five long segments at a short time step: solved to rounding, and nonsense."""
    soft = kc.TendonRobot(
        length=0.87, radius=4.77e-3, density=1411.7, youngs_modulus=18.6e6, bending_damping=0.03, drag=1e-4,
        gravity=(0.0, 0.0, -0.15), nodes=5,
    )  # fmt: skip
    dt = 1.23e-3
    tensions = 0.03 * kc.controls.sine(0.05, 16, dt, base=1.0)
    found = kc.simulate(soft, tensions, dt)
    assert np.all(found.result[1:] == kc.Result.RECOVERED_FINER_SEGMENTS)
    assert found.y.shape == (17, 5, 19)
    fine = kc.simulate(soft.replace(nodes=65), tensions, dt)
    assert np.all(fine.result == kc.Result.CONVERGED)
    moved = np.max(np.abs(fine.tip_position - fine.tip_position[0]))
    assert np.max(np.abs(found.tip_position - fine.tip_position)) < 0.2 * moved


def test_under_transformations_unsolved_rows_are_nan(robot):
    tensions = np.tile([5000.0, 0.0, 0.0, 5000.0], (5, 1))
    found = jax.jit(lambda tau: kc.simulate(robot, tau, DT))(tensions)
    first = int(np.argmax(np.asarray(found.result) < 0))
    assert 0 < first < 5
    assert np.all(np.isnan(found.y[first:])) and np.all(np.isfinite(found.y[:first]))


def test_jit_equals_plain(robot, sine, truth):
    found = jax.jit(lambda tau: kc.simulate(robot, tau, DT))(sine)
    np.testing.assert_allclose(found.y, truth.y, atol=1e-9)


# batches


@pytest.mark.campaign
def test_lockstep_as_on_a_gpu_equals_one_after_the_other(robot, sine):
    past = resting_past(robot, Settings())
    tensions = np.stack([sine[:16], 1.2 * sine[:16], 0.8 * sine[:16]])
    pasts = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), past)
    table = np.array([kc.BDF2().coefficients(DT, DT)] * 2)
    arguments = (robot, Settings(), table, padded_rows(tensions), DT, pasts, 16, False)
    one_by_one, together = march_many(*arguments, lockstep=False), march_many(*arguments, lockstep=True)
    np.testing.assert_array_equal(one_by_one[0], [16, 16, 16])
    np.testing.assert_allclose(one_by_one[1].records, together[1].records, atol=1e-8)


def test_one_failing_robot_does_not_spoil_the_batch(robot, sine):
    tensions = np.stack([sine[:16], np.tile([5000.0, 0.0, 0.0, 5000.0], (16, 1)), 0.9 * sine[:16]])
    found = kc.simulate(robot, tensions, DT, on_failure="return")
    assert found[0].all_valid and found[2].all_valid and not found[1].all_valid
    np.testing.assert_allclose(found[2].y, kc.simulate(robot, tensions[2], DT).y, atol=1e-9)
    with pytest.raises(kc.SimulationError, match="of robot 1") as caught:
        kc.simulate(robot, tensions, DT)
    assert caught.value.robot == 1


def test_equilibria_in_a_batch(robot):
    tensions = np.array([[7.0, 5.0, 5.0, 7.0], [5.0, 7.0, 7.0, 5.0], [6.0, 6.0, 6.0, 6.0]])
    found = kc.equilibrium(robot, tensions)
    assert found.y.shape == (3, 1, 10, 19)
    np.testing.assert_allclose(found[0].tip_position * [-1, 1, 1], found[1].tip_position, atol=1e-9)
    np.testing.assert_allclose(found.velocity, 0.0, atol=1e-12)


def test_the_past_keeps_the_newest_first(robot):
    past = resting_past(robot, Settings())
    record = past.records[0] + 1.0
    after = advanced(past, record, past.rate, past.y[0] + 1.0, past.weights)
    np.testing.assert_array_equal(after.y[1:], past.y[:-1])
    np.testing.assert_array_equal(after.records[0], record)
    np.testing.assert_array_equal(after.records[1], past.records[0])
    ones = jnp.array([2.0, 3.0, 5.0, 0.0])
    np.testing.assert_allclose(
        history_of(after, ones, Settings()), 3.0 * after.records[0] + 5.0 * after.records[1]
    )


@pytest.mark.parametrize(("misfit", "order"), [([1e-2, 1e-5, 1e-3], 1), ([0.0, 1e-3, 1e-2], 0)])
def test_the_first_guess_trusts_what_was_right_before(misfit, order):
    weights = weights_by(np.array(misfit))
    np.testing.assert_allclose(weights, EXTRAPOLATIONS[order], atol=1e-4)


@given(st.lists(st.floats(0.0, 1e3), min_size=len(EXTRAPOLATIONS), max_size=len(EXTRAPOLATIONS)))
def test_the_first_guess_of_what_stands_still_is_where_it_stands(misfit):
    weights = np.asarray(weights_by(np.array(misfit)))
    assert weights.sum() == pytest.approx(1.0, abs=1e-12)
    assert np.abs(weights).sum() <= np.abs(EXTRAPOLATIONS).sum(axis=1).max() + 1e-12


# bad input


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"controls": np.ones((10, 3))}, r"controls have shape \(10, 3\).*\(steps, 4\).*tension \(N\)"),
        ({"controls": np.ones((0, 4))}, r"controls have shape \(0, 4\)"),
        ({"controls": [["a"] * 4]}, "controls are not numbers"),
        ({"controls": np.full((3, 4), np.nan)}, r"controls are nan at index \(0, 0\)"),
        ({"dt": 0.0}, "dt is 0.0; allowed is a positive"),
        ({"dt": "fast"}, "dt is 'fast'"),
        ({"time": "rk4"}, "time is 'rk4'; allowed is \"bdf1\""),
        ({"space": "bdf2"}, "space is 'bdf2'; allowed is \"euler\""),
        ({"start": "cold"}, "start is 'cold'"),
        ({"on_failure": "ignore"}, "on_failure is 'ignore'"),
        ({"robot": "delrin-tendon-robot"}, "robot is str; allowed is a robot"),
        ({"robot": []}, "non-empty list"),
    ],
)
def test_bad_input_is_one_clear_line(robot, change, message):
    given = {"robot": robot, "controls": np.ones((3, 4)), "dt": DT, **change}
    with pytest.raises(ValueError, match=message) as caught:
        kc.simulate(given.pop("robot"), given.pop("controls"), given.pop("dt"), **given)
    assert "\n" not in str(caught.value)


def test_batches_that_do_not_fit(robot, sine):
    with pytest.raises(ValueError, match="2 robots but 3 controls"):
        kc.simulate([robot, robot], np.stack([sine] * 3), DT)
    with pytest.raises(ValueError, match="same nodes"):
        kc.simulate([robot, robot.replace(nodes=12)], sine, DT)
    rest = kc.equilibrium(robot, sine[0])
    with pytest.raises(ValueError, match="initial"):
        kc.simulate([robot, robot], sine, DT, initial=rest)
    other = dataclasses.replace(
        kc.equilibrium(robot, sine[0]), y=np.zeros((1, 12, 19)), z=np.zeros((1, 12, 6))
    )
    with pytest.raises(ValueError, match="12 nodes"):
        kc.simulate(robot, sine, DT, initial=other)


@pytest.mark.parametrize(
    ("before", "said"),
    [
        ({"length": 0.3}, "is of a robot 0.3 m long, this one is 0.635 m long"),
        ({"nodes": 12}, "has 12 nodes, the robot 10"),
    ],
)
def test_another_robot_does_not_go_on(robot, sine, before, said):
    other = kc.simulate(robot.replace(**before), sine[:3], DT)
    with pytest.raises(ValueError, match=said):
        kc.simulate(robot, sine, DT, initial=other)


def test_a_robot_with_more_to_remember_does_not_go_on(sine):
    robot = kc.RoutedTendonRobot.like(kc.load_robot("delrin-tendon-robot"))
    before = kc.simulate(robot, sine[:3], DT)
    with pytest.raises(ValueError, match="numbers in z"):
        kc.simulate(robot.replace(vibration_tension=20.0, vibration_rate=1.0), sine, DT, initial=before)
    with pytest.raises(ValueError, match="no rows"):
        kc.simulate(robot, sine, DT, initial=before[5:])


def test_tendons_that_push_are_warned_of(robot, sine):
    with pytest.warns(UserWarning, match="a tendon only pulls"):
        kc.equilibrium(robot, np.array([5.0, -3.0, 0.0, 0.0]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # noise of what was measured
        kc.equilibrium(robot, np.array([5.0, -0.01, 0.0, 0.0]))
