"""A scheme in time of three steps, defined by its coefficients alone: the example of CONTRIBUTING.md."""

import dataclasses

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.schemes.history import StepCoefficients, TimeStep
from knode_cosserat.schemes.time import TimeScheme
from knode_cosserat.solvers.recovery import Budget, StepRecovery


@dataclasses.dataclass(frozen=True)
class BDF3(TimeScheme):
    """Backward differentiation of order 3: the derivative of the cubic through four states."""

    name = "bdf3"
    order = 3
    memory = 3

    def coefficients(self, dt, *previous):
        """Return the coefficients of a step of dt (s) after steps of other lengths."""
        times = -np.cumsum([0.0, dt, *previous])
        c = []
        for k, time in enumerate(times):
            others = np.delete(times, k)
            slopes = [np.prod(-np.delete(others, j)) for j in range(len(others))]
            c.append(float(np.sum(slopes) / np.prod(time - others)))
        return *c, 0.0


SECONDS = 0.8
ROBOT = kc.load_robot("delrin-tendon-robot").replace(bending_damping=0.05)


def pulled(count):
    """Tensions that begin and end smoothly, and the time step."""
    t = (np.arange(count) + 1) * SECONDS / count
    controls = np.zeros((count, 4))
    controls[:, 0] = 5.0 * np.sin(np.pi * t / SECONDS) ** 4
    return controls, SECONDS / count


def moved(count, time="bdf3", **options):
    return kc.simulate(ROBOT, *pulled(count), time=time, initial="equilibrium", **options)


def test_its_coefficients_are_those_of_the_books():
    expected = np.array([11 / 6, -3.0, 1.5, -1 / 3, 0.0]) / 0.1
    np.testing.assert_allclose(BDF3().coefficients(0.1, 0.1, 0.1), expected, atol=1e-13)


def test_it_is_known_by_its_name():
    assert moved(4).settings.time == BDF3()
    with pytest.raises(ValueError, match=r'"bdf3"'):
        kc.simulate(ROBOT, *pulled(4), time="bdf4")


@pytest.mark.slow
def test_its_order_is_three():
    exact = moved(2560, "sdirk2", between="linear").tip_position[-1]
    errors = [np.linalg.norm(moved(count).tip_position[-1] - exact) for count in (40, 80, 160)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(orders > 2.8), orders


@pytest.mark.parametrize("cut", [1, 2, 5])
def test_a_motion_continues_exactly(cut, tmp_path):
    controls, dt = pulled(8)
    whole = moved(8)
    kc.simulate(ROBOT, controls[:cut], dt, time="bdf3", initial="equilibrium").save(tmp_path / "part.nc")
    part = kc.load_trajectory(tmp_path / "part.nc")
    rest = kc.simulate(ROBOT, controls[cut:], dt, time="bdf3", initial=part)
    np.testing.assert_allclose(rest.y[1:], whole.y[cut + 1 :], rtol=0.0, atol=1e-7)
    cut_later = kc.simulate(ROBOT, controls[cut:], dt, time="bdf3", initial=whole[: cut + 1])
    np.testing.assert_allclose(cut_later.y[1:], whole.y[cut + 1 :], rtol=0.0, atol=1e-7)


def test_steps_one_at_a_time_and_a_batch_are_the_same():
    controls, dt = pulled(6)
    stepper = kc.solvers.Stepper(ROBOT, dt, time="bdf3", initial="equilibrium")
    rows = np.stack([stepper.step(control).y[0] for control in controls])
    both = kc.simulate(ROBOT, np.stack([controls] * 2), dt, time="bdf3", initial="equilibrium")
    for y in (rows, both.y[1, 1:]):
        np.testing.assert_allclose(y, moved(6).y[1:], rtol=0.0, atol=1e-7)


def test_gradients_are_those_of_differences():
    controls, dt = pulled(6)

    def tip(modulus):
        robot = ROBOT.replace(youngs_modulus=modulus)
        return kc.simulate(robot, controls, dt, time="bdf3", initial="equilibrium").tip_position[-1, 0]

    modulus, step = float(ROBOT.youngs_modulus), 1e4
    differences = (tip(modulus + step) - tip(modulus - step)) / (2.0 * step)
    np.testing.assert_allclose(jax.grad(tip)(modulus), differences, rtol=1e-5)
    np.testing.assert_allclose(jax.jacfwd(tip)(modulus), differences, rtol=1e-5)


def test_a_step_may_be_divided():
    (controls, dt), whole = pulled(80), moved(80)
    before = whole[:41]
    state, settings = (
        kc.simulate(ROBOT, controls[:40], dt, time="bdf3", initial="equilibrium").final_state,
        whole.settings,
    )
    step = TimeStep.of(StepCoefficients.of(settings, dt, 3), state.history, 0)
    recovery = StepRecovery(ROBOT, settings, step, dt, Budget(None))
    result, found = recovery.last_method((controls[39], controls[40]))
    assert result == kc.Result.RECOVERED_STEP_HALVING
    # the substeps' errors are of another size, and the first is made by BDF1
    np.testing.assert_allclose(found.row.records[:, :3], whole.y[41, :, :3], atol=2e-4)
    assert np.max(np.abs(whole.y[41, :, :3] - before.y[-1, :, :3])) > 1e-3
    np.testing.assert_array_equal(found.state.records[1:], state.history.records[:2])
