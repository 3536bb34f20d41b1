"""`Stepper` gives the rows of `simulate`, one by one; what cannot be solved moves nothing."""

import copy
import pickle

import jax
import numpy as np
import pytest

import knode_cosserat as kc

DT = 0.05


def assert_same(rows, wanted):
    """To the solver's tolerance: a call begins without the linearisation of the step before."""
    found = {
        name: np.concatenate([getattr(row, name) for row in rows])
        for name in ("y", "z", "control", "result", "residual", "time", "position_error")
    }
    for name in ("control", "result", "time"):
        np.testing.assert_array_equal(found[name], getattr(wanted, name), err_msg=name)
    for name, scale in (("y", np.asarray(wanted.system.scales().y)), ("z", 1.0)):
        expected = getattr(wanted, name) / scale
        np.testing.assert_allclose(found[name] / scale, expected, rtol=1e-7, atol=1e-7, err_msg=name)
    # estimated by the linearisation that was used last, which is another one
    np.testing.assert_allclose(found["position_error"], wanted.position_error, rtol=0.1, atol=1e-9)
    assert np.all(found["residual"] <= 1e-8)


def test_its_rows_are_those_of_a_simulation(robot, sine, truth):
    stepper = kc.solvers.Stepper(robot, DT)
    rows = [stepper.state, *(stepper.step(control) for control in sine)]
    assert_same(rows, truth)
    assert stepper.state is rows[-1] and stepper.time == truth.time[-1]


def test_from_a_trajectory_it_goes_on_as_a_simulation_does(robot, sine, truth):
    wanted = kc.simulate(robot, sine[:20], DT, initial=truth)
    stepper = kc.solvers.Stepper(robot, DT, initial=truth)
    assert_same([stepper.state, *(stepper.step(control) for control in sine[:20])][1:], wanted[1:])


def test_a_preview_is_the_step_that_follows_and_changes_nothing(robot, sine, truth):
    stepper = kc.solvers.Stepper(robot, DT)
    for control, other, wanted in zip(sine[:5], sine[50:55], truth.y[1:6], strict=True):
        elsewhere = stepper.preview(other)
        ahead = stepper.preview(control)
        assert np.max(np.abs(elsewhere.y - ahead.y)) > 1e-6
        np.testing.assert_array_equal(stepper.step(control).y, ahead.y)
        np.testing.assert_allclose(ahead.y[0], wanted, rtol=0, atol=1e-7)


def test_recovered_steps_are_those_of_a_simulation(robot, caplog):
    """A pull that the compiled time loop does not solve, and that `recover` does."""
    hard = np.tile([5000.0, 0.0, 0.0, 5000.0], (4, 1))
    with caplog.at_level("INFO", logger="knode_cosserat.solvers.run"):
        wanted = kc.simulate(robot, hard, DT, recovery_budget=600.0)
    assert wanted.all_valid and "step" in caplog.text
    stepper = kc.solvers.Stepper(robot, DT, recovery_budget=600.0)
    assert_same([stepper.state, *(stepper.step(control) for control in hard)], wanted)


def test_a_step_without_a_solution_is_said_and_leaves_the_robot_where_it_is(robot, sine):
    hopeless = [1e8, 0.0, 0.0, 1e8]
    stepper, other = (kc.solvers.Stepper(robot, DT) for _ in range(2))
    for control in sine[:2]:
        row = stepper.step(control)
        other.step(control)
    with pytest.raises(kc.SimulationError) as caught:
        stepper.step(hopeless)
    assert caught.value.step == 3 and caught.value.result is kc.Result.NO_CONVERGENCE
    assert stepper.state is row and stepper.time == pytest.approx(2 * DT)
    with pytest.raises(kc.SimulationError):
        stepper.preview(hopeless)
    np.testing.assert_array_equal(stepper.step(sine[2]).y, other.step(sine[2]).y)


@pytest.mark.slow
def test_a_row_of_a_coarse_grid_says_so(robot):
    stepper = kc.solvers.Stepper(robot.replace(nodes=3), DT)
    row = stepper.step([60.0, 0.0, 0.0, 60.0])
    assert row.position_error[0] > 0.02 * robot.length
    assert row.result[0] == kc.Result.COARSE and row.all_valid


@pytest.mark.campaign
def test_rows_that_follow_a_coarse_one_are_coarse_too(robot):
    """The estimate decays with the motion, and does not know where the right one would have gone."""
    robot = robot.replace(nodes=3)
    controls = np.full((60, 4), 5.0)
    controls[:2, [0, 3]] = 60.0
    stepper = kc.solvers.Stepper(robot, DT)
    rows = [stepper.step(control) for control in controls]
    with pytest.warns(UserWarning, match="too coarse in 60 of 60 rows"):
        whole = kc.simulate(robot, controls, DT)
    with pytest.warns(UserWarning, match="too coarse in 10 of 10 rows"):
        after = kc.simulate(robot, controls[:10], DT, initial=whole)
    small = whole.position_error < 0.01 * robot.length
    assert np.count_nonzero(small) > 20
    for found in (whole.result[1:], after.result[1:], [row.result[0] for row in rows]):
        assert set(map(int, found)) == {kc.Result.COARSE}
    # an equilibrium is none of a motion's rows
    rests = kc.equilibrium(robot, controls[-1], initial=whole)
    assert rests.result[0] == kc.Result.CONVERGED


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": []}, "robot is a list; allowed is a robot"),
        ({"dt": 0.0}, "dt is 0.0"),
        ({"time": "bdf9"}, "time is 'bdf9'"),
        ({"newton": "long"}, "newton is 'long'"),
    ],
)
def test_wrong_arguments_are_named(robot, change, message):
    with pytest.raises(ValueError, match=message):
        kc.solvers.Stepper(**{"robot": robot, "dt": DT, **change})


@pytest.mark.parametrize(
    ("control", "message"), [([1.0], r"shape \(1,\)"), ("pull", "not numbers"), ([np.nan] * 4, "finite")]
)
def test_a_wrong_control_is_named(robot, control, message):
    with pytest.raises(ValueError, match=message):
        kc.solvers.Stepper(robot, DT).step(control)


def test_copies_previews_and_failures_do_not_change_what_follows(robot, sine):
    """The same state gives the same bits: in a copy, after a file, after previews and after a failed step."""
    stepper = kc.solvers.Stepper(robot, DT)
    stepper.step(sine[0])
    others = [copy.copy(stepper), copy.deepcopy(stepper), pickle.loads(pickle.dumps(stepper))]
    for other in others:
        other.preview(sine[2])
        with pytest.raises(kc.SimulationError):
            other.step([1e8, 0.0, 0.0, 1e8])
        np.testing.assert_array_equal(other.preview(sine[1]).y, stepper.preview(sine[1]).y)
    rows = [each.step(sine[1]) for each in (stepper, *others)]
    for row in rows[1:]:
        np.testing.assert_array_equal(row.y, rows[0].y)
        np.testing.assert_array_equal(row.final_state.history.records, rows[0].final_state.history.records)


def test_a_row_is_a_whole_trajectory_before_any_of_it_is_used(robot, sine):
    """Its fields are put together late: as a tree, in a pickle, and as the start of another motion."""
    rows = [kc.solvers.Stepper(robot, DT).step(sine[0]) for _ in range(4)]
    wanted = kc.simulate(robot, sine[:1], DT)
    leaves = [jax.tree.leaves(rows[0]), jax.tree.leaves(pickle.loads(pickle.dumps(rows[1])))]
    for one, other in zip(*leaves, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(copy.copy(rows[2]).y, wanted.y[1:])
    after = kc.simulate(robot, sine[1:3], DT, initial=rows[3])
    np.testing.assert_allclose(after.y[-1], kc.simulate(robot, sine[:3], DT).y[-1], rtol=0, atol=1e-7)


def test_another_robot_takes_over_the_state():
    """The same robot as a new object gives the same motion, after the first steps of the scheme too."""
    robot = kc.load_robot("delrin-tendon-robot")
    one, other = (kc.solvers.Stepper(robot, 0.05, time="bdf2") for _ in range(2))
    for _ in range(4):
        other.robot = robot.replace(length=float(robot.length))
        wanted, found = (each.step([4.0, 6.0, 5.0, 5.0]) for each in (one, other))
        np.testing.assert_allclose(found.y, wanted.y, atol=1e-9)
    row, before = other.state, float(robot.youngs_modulus)
    other.robot = robot.replace(youngs_modulus=2.0 * float(robot.youngs_modulus))
    moved = [each.step([4.0, 6.0, 5.0, 5.0]).tip_position[-1] for each in (one, other)]
    assert np.linalg.norm(np.subtract(*moved)) > 1e-3 and float(row.system.youngs_modulus) == before
