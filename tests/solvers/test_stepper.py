"""`Stepper` gives the rows of `simulate`, one by one; what cannot be solved moves nothing."""

import numpy as np
import pytest

import knode_cosserat as kc

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


def assert_same(rows, wanted):
    for name in ("y", "z", "control", "result", "residual", "iterations", "time"):
        found = np.concatenate([getattr(row, name) for row in rows])
        np.testing.assert_array_equal(found, getattr(wanted, name), err_msg=name)


def test_its_rows_are_those_of_a_simulation_bit_for_bit(robot, sine, truth):
    stepper = kc.Stepper(robot, DT)
    rows = [stepper.state, *(stepper.step(control) for control in sine)]
    assert_same(rows, truth)
    assert stepper.state is rows[-1] and stepper.time == truth.time[-1]


def test_beyond_the_rows_of_one_program_it_goes_on_as_a_longer_simulation(robot, sine):
    controls = np.concatenate([sine, sine[:60]])
    stepper = kc.Stepper(robot, DT)
    rows = [stepper.state, *(stepper.step(control) for control in controls)]
    wanted = kc.simulate(robot, controls[100:], DT, initial=kc.simulate(robot, sine, DT))
    np.testing.assert_allclose(np.concatenate([row.y for row in rows[-60:]]), wanted.y[1:], rtol=0, atol=1e-9)
    np.testing.assert_allclose([row.time[0] for row in rows], np.arange(161) * DT, rtol=1e-12)


def test_from_a_trajectory_it_goes_on_as_a_simulation_does(robot, sine, truth):
    wanted = kc.simulate(robot, sine[:20], DT, initial=truth)
    stepper = kc.Stepper(robot, DT, initial=truth)
    assert_same([stepper.state, *(stepper.step(control) for control in sine[:20])][1:], wanted[1:])


def test_a_preview_is_the_step_that_follows_and_changes_nothing(robot, sine, truth):
    stepper = kc.Stepper(robot, DT)
    for control, other, wanted in zip(sine[:5], sine[50:55], truth.y[1:6], strict=True):
        elsewhere = stepper.preview(other)
        ahead = stepper.preview(control)
        assert np.max(np.abs(elsewhere.y - ahead.y)) > 1e-6
        np.testing.assert_array_equal(stepper.step(control).y, ahead.y)
        np.testing.assert_array_equal(ahead.y[0], wanted)


def test_recovered_steps_are_those_of_a_simulation(robot):
    """A pull that the compiled march does not solve, and that `recover` does."""
    hard = np.tile([400.0, 0.0, 0.0, 400.0], (4, 1))
    wanted = kc.simulate(robot, hard, DT)
    assert np.any(wanted.result > 0)
    stepper = kc.Stepper(robot, DT)
    assert_same([stepper.state, *(stepper.step(control) for control in hard)], wanted)


def test_a_step_without_a_solution_is_said_and_leaves_the_robot_where_it_is(robot, sine):
    hopeless = [5000.0, 0.0, 0.0, 5000.0]
    stepper, reached = kc.Stepper(robot, DT), []
    error = None
    while error is None:
        try:
            reached.append(stepper.step(hopeless))
        except kc.SimulationError as raised:
            error = raised
    assert error.step == len(reached) + 1 and error.result is kc.Result.NO_CONVERGENCE
    assert stepper.state.all_valid and (not reached or stepper.state is reached[-1])
    with pytest.raises(kc.SimulationError):
        stepper.preview(hopeless)
    other = kc.Stepper(robot, DT)
    for _ in reached:
        other.step(hopeless)
    np.testing.assert_array_equal(stepper.step(sine[0]).y, other.step(sine[0]).y)


@pytest.mark.campaign
def test_what_grows_as_an_instability_does_is_refused():
    """The robot of `test_a_run_that_blows_up_in_space_is_repeated_with_finer_segments`."""
    soft = kc.TendonRobot(
        length=0.87, radius=4.77e-3, density=1411.7, youngs_modulus=18.6e6, bending_damping=0.03, drag=1e-4,
        gravity=(0.0, 0.0, -0.15), nodes=5,
    )  # fmt: skip
    stepper = kc.Stepper(soft, 1.23e-3)
    tensions = 0.03 * kc.controls.sine(0.05, 16, 1.23e-3, base=1.0)
    with pytest.raises(kc.SimulationError, match="more nodes") as caught:
        list(map(stepper.step, tensions))
    assert caught.value.result is kc.Result.UNSTABLE


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": []}, "a stepper is of one robot"),
        ({"dt": 0.0}, "dt is 0.0"),
        ({"time": "bdf9"}, "time is 'bdf9'"),
        ({"newton": kc.NewtonOptions(across_steps=True)}, "across_steps"),
    ],
)
def test_wrong_arguments_are_named(robot, change, message):
    with pytest.raises(ValueError, match=message):
        kc.Stepper(**{"robot": robot, "dt": DT, **change})


@pytest.mark.parametrize(
    ("control", "message"),
    [([1.0], r"shape \(1,\)"), ("pull", "not numbers"), ([np.nan] * 4, "finite")],
)
def test_a_wrong_control_is_named(robot, control, message):
    with pytest.raises(ValueError, match=message):
        kc.Stepper(robot, DT).step(control)
