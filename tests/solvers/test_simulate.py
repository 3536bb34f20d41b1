"""What `simulate` and `equilibrium` promise beyond the physics: result codes, recovery, batches, errors."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.rods.parts import ease
from knode_cosserat.rods.surroundings import Plane
from knode_cosserat.rods.tendons import TendonFriction, Vibration
from knode_cosserat.schemes.grid import at_places
from knode_cosserat.schemes.history import advance_history, history_of
from knode_cosserat.schemes.problem import StepProblem
from knode_cosserat.solvers import Settings
from knode_cosserat.solvers.rest import resting_history
from tests.trajectories import HOPELESS, synthetic

DT = 0.05


def test_rows_time_and_controls(robot, sine, truth):
    assert truth.y.shape == (101, 10, 19) and truth.z.shape == (101, 10, 6)
    np.testing.assert_allclose(truth.time, np.arange(101) * DT)
    np.testing.assert_array_equal(truth.held_tension[:-1], sine)
    np.testing.assert_array_equal(truth.part("tension")[0], 0.0)
    np.testing.assert_allclose(truth.arclength, np.linspace(0.0, 0.635, 10))
    np.testing.assert_array_equal(truth.y[0], kc.equilibrium(robot, np.zeros(4)).y[0])
    assert truth.all_valid and np.all(truth.result == kc.Result.CONVERGED)


def test_the_residual_that_is_reported_is_that_of_the_states_that_are_returned(robot, sine):
    truth = kc.simulate(robot, sine, DT, time="bdf2", start="paper")

    @jax.jit
    def residuals(t, control, history, y):
        # the scheme itself uses no history between nodes
        history = at_places(robot, Settings().space, history)
        problem = StepProblem(robot, t, control, jnp.array(1.5 / DT), history, Settings().space)
        return problem.residuals(y)

    for i in (1, 2, 50, 100):
        x = np.concatenate([truth.y, truth.z], axis=-1)
        history = jnp.asarray((-2.0 * x[i - 1] + 0.5 * x[max(i - 2, 0)]) / DT)
        defects, tip = residuals(i * DT, sine[i - 1], history, truth.y[i])
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


# linearisations are kept from step to step


def test_a_control_that_jumps_asks_for_a_new_linearisation(robot):
    """What is kept does not lead to a shape that is far away: the step is linearised anew, not failed."""
    controls = np.zeros((40, 4))
    controls[20:, 0] = 6.0
    found = kc.simulate(robot, controls, 0.01)
    assert np.all(found.result == kc.Result.CONVERGED)
    # a run that begins at the jump has nothing to keep
    begun = kc.simulate(robot, controls[:20], 0.01)
    anew = kc.simulate(robot, controls[20:], 0.01, initial=begun)
    np.testing.assert_allclose(found.position[20:], anew.position, atol=1e-7)


@pytest.mark.slow
def test_what_is_kept_is_not_seen_in_a_motion(robot, sine):
    """Solved to the tolerance, by old linearisations as by ones that are made anew in every step."""
    found = kc.simulate(robot, sine[:60], 0.01)
    anew = kc.solvers.NewtonOptions(patience=1, tolerance=1e-12)
    exact = kc.simulate(robot, sine[:60], 0.01, newton=anew)
    np.testing.assert_allclose(found.position, exact.position, atol=1e-8)


@pytest.mark.campaign
def test_a_batch_keeps_nothing_of_another_robot(robot, sine):
    controls = np.stack([sine, -0.3 * sine[::-1] + 10.0])
    both = kc.simulate(robot, controls, 0.01)
    for k in range(2):
        alone = kc.simulate(robot, controls[k], 0.01)
        np.testing.assert_allclose(both.position[k], alone.position, atol=1e-8)


# systems made gentler


def test_a_smooth_system_is_as_gentle_as_it_gets(robot):
    assert ease(robot, 1e-3) is robot


@pytest.mark.parametrize("part", [1.0, 0.1, 1e-3])
def test_easing_spreads_contact_and_friction_and_nothing_else(robot, part):
    plane = Plane(smoothing=1e-4, slip=2e-3, friction=0.3)
    slender = kc.robots.SlenderRod(
        length=0.4, radius=0.005, density=1e3, youngs_modulus=1e6, surroundings=(plane,)
    )
    easier = ease(slender, part)
    assert float(easier.surroundings[0].smoothing) == pytest.approx(1e-4 / part)
    assert float(easier.surroundings[0].slip) == pytest.approx(2e-3 / part)
    assert float(easier.surroundings[0].friction) == 0.3 and float(easier.length) == 0.4
    rubbing = kc.robots.RoutedTendonRobot.like(robot, friction=TendonFriction(curvature=0.2, reach=0.05))
    assert float(ease(rubbing, part).friction.reach) == pytest.approx(0.05 / part)


# tension that makes boundary layers much shorter than a segment


def line(nodes):
    """A thin line that is pulled at its tip, far more than bends it."""
    pull = kc.robots.loads.PointWrench(force=[0.1, 0.0, 1.0])
    return kc.robots.SlenderRod(
        length=1.0,
        radius=5e-4,
        density=1150.0,
        youngs_modulus=2e9,
        bending_damping=1e-6,
        gravity=[0.0, 0.0, 0.0],
        nodes=nodes,
        loads=(pull,),
    )


@pytest.mark.slow
@pytest.mark.parametrize("space", ["lobatto2", pytest.param("lobatto4", marks=pytest.mark.campaign)])
def test_an_equilibrium_under_strong_tension(space):
    """Solutions grow and decay by e in a segment: forward Euler turned decay into growth."""
    still = kc.equilibrium(line(41), np.zeros(0), space=space)
    assert still.all_valid and still.result[0] != kc.Result.COARSE
    # along the force but for what bends where it is held: √(EI/T) of its length
    bending = np.sqrt(2e9 * np.pi / 4 * 5e-4**4 / np.hypot(0.1, 1.0))
    lag = bending * np.array([0.1, 0.0, 1.0]) / np.hypot(0.1, 1.0)
    expected = np.array([0.1, 0.0, 1.0]) / np.hypot(0.1, 1.0) - np.array([lag[0], 0.0, 0.0])
    np.testing.assert_allclose(still.tip_position[0], expected, atol=2e-3)


@pytest.mark.slow
def test_a_motion_from_such_an_equilibrium_stays_there():
    robot = line(41)
    still = kc.equilibrium(robot, np.zeros(0))
    moved = kc.simulate(robot, np.zeros((5, 0)), 0.05, initial=still)
    assert np.max(np.abs(moved.tip_position - moved.tip_position[0])) < 1e-8
    assert np.max(np.abs(moved.velocity)) < 1e-6


@pytest.fixture(scope="module")
def jitted(robot):
    """Simulation of 100 steps within a user's jitted function: one program for the tests that need it."""
    return jax.jit(lambda tau: kc.simulate(robot, tau, DT))


@pytest.mark.slow
def test_under_transformations_unsolved_rows_are_nan(jitted):
    found = jitted(np.tile([5000.0, 0.0, 0.0, 5000.0], (100, 1)))
    first = int(np.argmax(np.asarray(found.result) < 0))
    assert 0 < first < 5
    assert np.all(np.isnan(found.y[first:])) and np.all(np.isfinite(found.y[:first]))


@pytest.mark.slow
def test_jit_equals_plain(jitted, sine, truth):
    found = jitted(sine)
    np.testing.assert_allclose(found.y, truth.y, atol=1e-9)


# batches


@pytest.mark.slow
def test_one_failing_robot_does_not_spoil_the_batch(robot, sine):
    tensions = np.stack([sine[:16], np.tile(HOPELESS, (16, 1)), 0.9 * sine[:16]])
    found = kc.simulate(robot, tensions, DT, on_failure="return")
    assert found[0].all_valid and found[2].all_valid and not found[1].all_valid
    np.testing.assert_allclose(found[2].y, kc.simulate(robot, tensions[2], DT).y, atol=1e-9)
    with pytest.raises(kc.SimulationError, match="of robot 1") as caught:
        kc.simulate(robot, tensions, DT)
    assert caught.value.robot == 1


@pytest.mark.campaign
def test_equilibria_in_a_batch(robot):
    tensions = np.array([[7.0, 5.0, 5.0, 7.0], [5.0, 7.0, 7.0, 5.0], [6.0, 6.0, 6.0, 6.0]])
    found = kc.equilibrium(robot, tensions)
    assert found.y.shape == (3, 1, 10, 19)
    np.testing.assert_allclose(found[0].tip_position * [-1, 1, 1], found[1].tip_position, atol=1e-9)
    np.testing.assert_allclose(found.velocity, 0.0, atol=1e-12)


@pytest.mark.slow
def test_a_list_of_equilibria_is_each_by_itself_in_batches_and_programs_too(robot):
    tensions = np.array([[7.0, 5.0, 5.0, 7.0], [9.0, 5.0, 5.0, 9.0], [6.0, 6.0, 8.0, 6.0]])
    found = kc.solvers.equilibria(robot, tensions)
    assert found.settings.time is None and found.final_state is None and found.all_valid
    for row, control in enumerate(tensions):
        np.testing.assert_allclose(found.y[row], kc.equilibrium(robot, control).y[0], atol=1e-8)
    np.testing.assert_array_equal(found.control, tensions)
    both = kc.solvers.equilibria(robot, np.stack([tensions, tensions[::-1]]))
    np.testing.assert_allclose(both[1].y[::-1], found.y, atol=1e-8)

    def tip(pull):
        return kc.solvers.equilibria(robot, jnp.asarray(tensions).at[:, 0].add(pull)).tip_position[2, 0]

    difference = (tip(1e-3) - tip(-1e-3)) / 2e-3
    for slope in (jax.jacfwd(tip), jax.grad(tip)):
        np.testing.assert_allclose(slope(0.0), difference, rtol=1e-5)


def test_statics_have_no_time_scheme(robot, sine):
    for run in (kc.simulate, kc.solvers.Stepper):
        arguments = (robot, DT) if run is kc.solvers.Stepper else (robot, sine, DT)
        with pytest.raises(ValueError, match=r"time is 'static'.*equilibri"):
            run(*arguments, time="static")


def test_the_past_keeps_the_newest_first(robot):
    past = resting_history(robot, Settings())
    record = past.records[0] + 1.0
    after = advance_history(past, record, past.rate, past.y[0] + 1.0, past.weights)
    np.testing.assert_array_equal(after.y[1:], past.y[:-1])
    np.testing.assert_array_equal(after.records[0], record)
    np.testing.assert_array_equal(after.records[1], past.records[0])
    ones = jnp.array([2.0, 3.0, 5.0, 0.0])
    np.testing.assert_allclose(
        history_of(after.records, after.rate, ones, Settings()),
        3.0 * after.records[0] + 5.0 * after.records[1],
    )


# bad input


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"controls": np.ones((10, 3))}, r"controls have shape \(10, 3\).*\(steps, 4\).*tension \(N\)"),
        ({"controls": np.ones((0, 4))}, r"controls have shape \(0, 4\)"),
        ({"controls": [["a"] * 4]}, "controls are not numbers"),
        ({"controls": np.full((3, 4), np.nan)}, r"controls are nan at index \(0, 0\)"),
        ({"dt": 0.0}, "dt is 0.0; allowed is a positive number of seconds"),
        ({"dt": "fast"}, "dt is 'fast'"),
        ({"time": "lobatto4"}, "time is 'lobatto4'; allowed is \"sdirk2\""),
        ({"space": "bdf2"}, 'space is \'bdf2\'; allowed is "lobatto2", "lobatto4", "euler"'),
        ({"start": "cold"}, "start is 'cold'"),
        ({"on_failure": "ignore"}, "on_failure is 'ignore'"),
        ({"robot": "delrin-tendon-robot"}, "robot is a str 'delrin-tendon-robot'; allowed is a robot"),
        ({"robot": []}, "non-empty list"),
    ],
)
def test_bad_input_is_one_clear_line(robot, change, message):
    given = {"robot": robot, "controls": np.ones((3, 4)), "dt": DT, **change}
    with pytest.raises(ValueError, match=message) as caught:
        kc.simulate(given.pop("robot"), given.pop("controls"), given.pop("dt"), **given)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
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


def solved_rows(robot):
    """Rows of a robot that need no simulation."""
    rows = synthetic(robot=robot, nodes=robot.nodes)
    return dataclasses.replace(rows, result=np.zeros_like(rows.result))


@pytest.mark.parametrize(
    ("before", "said"),
    [
        ({"length": 0.3}, "is of a robot 0.3 m long, this one is 0.635 m long"),
        ({"nodes": 12}, "has 12 nodes, the robot 10"),
    ],
)
def test_another_robot_does_not_go_on(robot, sine, before, said):
    other = solved_rows(robot.replace(**before))
    with pytest.raises(ValueError, match=said):
        kc.simulate(robot, sine, DT, initial=other)


def test_a_robot_with_more_to_remember_does_not_go_on(sine):
    robot = kc.robots.RoutedTendonRobot.like(kc.load_robot("delrin-tendon-robot"))
    before = solved_rows(robot)
    with pytest.raises(ValueError, match="numbers in z"):
        kc.simulate(robot.replace(vibration=Vibration(tension=20.0, rate=1.0)), sine, DT, initial=before)
    with pytest.raises(ValueError, match="no rows"):
        kc.simulate(robot, sine, DT, initial=before[5:])


def test_tendons_that_push_are_warned_of(robot, sine):
    with pytest.warns(UserWarning, match="a tendon only pulls"):
        kc.equilibrium(robot, np.array([5.0, -3.0, 0.0, 0.0]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # noise of what was measured
        kc.equilibrium(robot, np.array([5.0, -0.01, 0.0, 0.0]))


@pytest.mark.parametrize("time", ["sdirk2", "bdf2"])
def test_errors_that_are_not_estimated_are_said_to_be_unknown(robot, sine, time):
    """The motion is the same; no error of a row or of the state after it is a number."""
    known, by_grid, unknown = (
        kc.simulate(robot, sine[:5], DT, time=time, errors=errors) for errors in (True, "grid", False)
    )
    for motion in (by_grid, unknown):
        np.testing.assert_allclose(motion.y, known.y, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(motion.result, known.result)
        assert np.all(np.isnan(motion.time_error)) and np.all(np.isnan(motion.final_state.history.time_error))
    np.testing.assert_allclose(by_grid.position_error, known.position_error, rtol=1e-6)
    assert np.all(np.isnan(unknown.position_error)) and np.all(np.isnan(unknown.final_state.history.error))
    assert "errors not estimated" in str(unknown) and "along the rod" in str(by_grid)
    with pytest.raises(ValueError, match="needs estimates"):
        kc.simulate(robot, sine[:5], DT, errors=False, position_tolerance=1e-3)
    with pytest.raises(ValueError, match="errors is 'none'"):
        kc.simulate(robot, sine[:5], DT, errors="none")
    # a motion with estimates that continues one without has none
    after = kc.simulate(robot, sine[5:7], DT, time=time, initial=unknown)
    assert np.all(np.isnan(after.position_error[1:])) and np.all(after.result[1:] == kc.Result.COARSE)
