"""Schemes in time of three steps and of three stages, a class each: the examples of CONTRIBUTING.md."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.linalg import expm

import knode_cosserat as kc
from knode_cosserat.schemes.history import StepCoefficients, TimeStep
from knode_cosserat.schemes.time import BDF2, SDIRK, TimeScheme
from knode_cosserat.solvers.recovery import Budget, StepRecovery
from tests.physics.test_closed_forms import Bar


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


@dataclasses.dataclass(frozen=True)
class EstimatedBDF2(BDF2):
    """BDF2 with an estimate of its error: the rate's is dt² y_ttt / 3, which is J d with d = dt² y_tt / 3."""

    name = "bdf2-estimated"
    # dt² y_tt is the second difference of the states
    defect = (1 / 3, -2 / 3, 1 / 3)


#: root of γ³ - 3γ² + 3γ/2 - 1/6, for which the scheme is L-stable (Alexander 1977)
G = 0.43586652150845967


@dataclasses.dataclass(frozen=True)
class SDIRK3(SDIRK):
    """The scheme of three stages and order 3, with an estimate of its error."""

    name = "sdirk3"
    order = 3
    tableau = ((G,), ((1.0 - G) / 2.0, G), (-1.5 * G**2 + 4.0 * G - 0.25, 1.5 * G**2 - 5.0 * G + 1.25, G))


SECONDS = 0.8
ROBOT = kc.load_robot("delrin-tendon-robot").replace(bending_damping=0.05)


def pulled(count):
    """Tensions that begin and end smoothly, and the time step."""
    t = (np.arange(count) + 1) * SECONDS / count
    controls = np.zeros((count, 4))
    controls[:, 0] = 5.0 * np.sin(np.pi * t / SECONDS) ** 4
    return controls, SECONDS / count


@pytest.fixture(params=["bdf3", "sdirk3"])
def time(request):
    return request.param


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


@pytest.mark.parametrize(("time", "order"), [("sdirk2", 2), ("sdirk3", 3)])
def test_a_tableau_has_its_order_and_the_estimate_of_its_error(time, order):
    """Against the closed form of a bar's standing wave under a load that is held."""
    bar, s, largest = Bar(damping=0.1, nodes=41), np.linspace(0.0, 1.0, 41), []
    square = bar.wave_number**2
    matrix = np.array([[0.0, 1.0, 0.0], [-square, -bar.damping * square, 1.0], [0.0, 0.0, 0.0]])
    for count in (20, 40):
        found = kc.simulate(bar, np.ones((count, 1)), 1.0 / count, time=time, space="lobatto4")
        exact = np.array([expm(matrix * t)[0, 2] for t in found.time])
        errors = found.part("p")[..., 0] - s - exact[:, None] * np.sin(bar.wave_number * s)
        largest.append(np.abs(errors).max())
        assert found.time_error[1:].max() == pytest.approx(largest[-1], rel=0.1)
    assert np.log2(largest[0] / largest[1]) == pytest.approx(order, abs=0.1)


def test_a_scheme_of_several_steps_estimates_its_error_by_its_defect():
    """Against the same closed form; the error of the first step, by BDF1, is not estimated."""
    bar, s, largest = Bar(damping=0.1, nodes=41), np.linspace(0.0, 1.0, 41), []
    square = bar.wave_number**2
    matrix = np.array([[0.0, 1.0, 0.0], [-square, -bar.damping * square, 1.0], [0.0, 0.0, 0.0]])
    for count in (40, 80):
        found = kc.simulate(bar, np.ones((count, 1)), 1.0 / count, time="bdf2-estimated", space="lobatto4")
        exact = np.array([expm(matrix * t)[0, 2] for t in found.time])
        errors = found.part("p")[..., 0] - s - exact[:, None] * np.sin(bar.wave_number * s)
        largest.append(np.abs(errors).max())
        assert found.time_error[1:].max() == pytest.approx(largest[-1], rel=0.25)
    assert np.log2(largest[0] / largest[1]) == pytest.approx(2, abs=0.2)


@pytest.mark.parametrize(
    ("tableau", "message"),
    [
        (((0.5,), (0.5, 0.5)), r"Wrong: the tableau has order 1 \(order states 2\)"),
        (((G,), (1.0 - G, 0.5)), r"Wrong: the last weights of the tableau's rows are \[.*; allowed are two"),
        # TR-BDF2, of order 2, has an explicit stage
        (((0.0,), (0.29, 0.29), (0.35, 0.36, 0.29)), "Wrong: the last weights .* a TimeScheme that"),
        (((1.0,),), "Wrong: the last weights .*; allowed are two or more rows"),
    ],
)
def test_a_tableau_of_another_form_or_order_is_refused(tableau, message):
    with pytest.raises(ValueError, match=message):
        type("Wrong", (SDIRK,), {"order": 2, "tableau": tableau})


@pytest.mark.parametrize(
    ("coefficients", "more", "message"),
    [
        ((1.5, -2.0, 0.5), {}, "the last coefficient, of the last rate, is .*; allowed is 0, or uses_r"),
        ((1.5, -2.0, 0.4, 0.0), {}, r"of the rate of t\^0 .* which is 0; order 2 allows no error up to t\^2"),
        ((1.0, -1.0, 0.0, 0.0), {}, r"of the rate of t\^2 .* which is 0; order 2 allows no error up to t\^2"),
        ((1.5, -2.0, 0.5, 0.0), {"defect": (1.0, -1.0)}, r"defect is .*; allowed are memory \+ 1 = 3 w"),
        ((1.5, -2.0, 0.5, 0.0), {"defect": (1.0, -1.0, 1.0)}, "allowed are .* with the sum zero"),
    ],
)
def test_coefficients_of_another_order_are_refused(coefficients, more, message):
    """A scheme that forgot the last zero ran, and its motion was wrong without a word."""

    def stated(self, dt, *previous):
        return tuple(np.array(coefficients) / dt)

    wrong = type("Wrong", (TimeScheme,), {"order": 2, "coefficients": stated, **more})
    with pytest.raises(ValueError, match=f"Wrong: .*{message}"):
        kc.simulate(ROBOT, *pulled(4), time=wrong())


@pytest.mark.parametrize("cut", [1, 2, 5])
def test_a_motion_continues_exactly(cut, time, tmp_path):
    controls, dt = pulled(8)
    whole = moved(8, time)
    kc.simulate(ROBOT, controls[:cut], dt, time=time, initial="equilibrium").save(tmp_path / "part.nc")
    part = kc.load_trajectory(tmp_path / "part.nc")
    rest = kc.simulate(ROBOT, controls[cut:], dt, time=time, initial=part)
    np.testing.assert_allclose(rest.y[1:], whole.y[cut + 1 :], rtol=0.0, atol=1e-7)
    cut_later = kc.simulate(ROBOT, controls[cut:], dt, time=time, initial=whole[: cut + 1])
    np.testing.assert_allclose(cut_later.y[1:], whole.y[cut + 1 :], rtol=0.0, atol=1e-7)


def test_steps_one_at_a_time_and_a_batch_are_the_same(time):
    controls, dt = pulled(6)
    stepper = kc.solvers.Stepper(ROBOT, dt, time=time, initial="equilibrium")
    rows = np.stack([stepper.step(control).y[0] for control in controls])
    batch = kc.simulate(ROBOT, np.stack([controls] * 2), dt, time=time, initial="equilibrium")
    for y in (rows, batch.y[1, 1:]):
        np.testing.assert_allclose(y, moved(6, time).y[1:], rtol=0.0, atol=1e-7)


def test_gradients_are_those_of_differences(time):
    controls, dt = pulled(6)

    def tip(modulus):
        robot = ROBOT.replace(youngs_modulus=modulus)
        return kc.simulate(robot, controls, dt, time=time, initial="equilibrium").tip_position[-1, 0]

    modulus, step = float(ROBOT.youngs_modulus), 1e4
    differences = (tip(modulus + step) - tip(modulus - step)) / (2.0 * step)
    np.testing.assert_allclose(jax.grad(tip)(modulus), differences, rtol=1e-5)
    np.testing.assert_allclose(jax.jacfwd(tip)(modulus), differences, rtol=1e-5)


def test_a_step_may_be_divided():
    (controls, dt), whole = pulled(80), moved(80)
    settings, begun = whole.settings, controls[:40]
    state = kc.simulate(ROBOT, begun, dt, time="bdf3", initial="equilibrium").final_state
    step = TimeStep.of(StepCoefficients.of(settings, dt, 3), state.history, 0)
    recovery = StepRecovery(ROBOT, settings, step, dt, Budget(None))
    result, found = recovery.last_method((controls[39], controls[40]))
    assert result == kc.Result.RECOVERED_STEP_HALVING
    # the substeps' errors are of another size, and the first is made by BDF1
    np.testing.assert_allclose(found.row.records[:, :3], whole.y[41, :, :3], atol=2e-4)
    assert np.max(np.abs(whole.y[41, :, :3] - whole.y[40, :, :3])) > 1e-3
    np.testing.assert_array_equal(found.state.records[1:], state.history.records[:2])
