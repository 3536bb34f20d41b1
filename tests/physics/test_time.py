"""Schemes in time: their coefficients, their observed orders on the paper's robot, and a frequency."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

import knode_cosserat as kc
from benchmarks import closed_forms
from knode_cosserat.schemes.history import StepCoefficients
from knode_cosserat.solvers import Settings

SCHEMES = {
    "bdf1": kc.solvers.BDF1(),
    "bdf2": kc.solvers.BDF2(),
    "bdf-alpha": kc.solvers.BDFAlpha(),
    "trapezoidal": kc.solvers.Trapezoidal(),
}
steps_in_time = st.floats(1e-4, 10.0)
alphas = st.floats(-0.5, 0.0)


# coefficients


def differentiated(scheme, dt, previous_dt, polynomial):
    """What the scheme takes for the derivative at the end of a step, which is time 0; what it is; a size."""
    c0, c1, c2, d1 = scheme.coefficients(dt, previous_dt)
    rate = polynomial.deriv()
    found = c0 * polynomial(0.0) + c1 * polynomial(-dt) + c2 * polynomial(-dt - previous_dt) + d1 * rate(-dt)
    size = sum(abs(c) for c in polynomial) * max(1.0, dt + previous_dt) ** 2 / min(dt, previous_dt, 1.0)
    return found, rate(0.0), size


coefficients = st.lists(st.floats(-10, 10, allow_subnormal=False), min_size=3, max_size=3)


@given(steps_in_time, st.floats(0.05, 20.0), alphas, coefficients)
def test_schemes_of_order_2_are_exact_for_quadratics_at_any_ratio_of_steps(dt, ratio, alpha, numbers):
    for scheme in (kc.solvers.BDFAlpha(alpha), kc.solvers.BDF2(), kc.solvers.Trapezoidal()):
        found, expected, size = differentiated(scheme, dt, ratio * dt, np.poly1d(numbers))
        assert found == pytest.approx(expected, rel=1e-12, abs=1e-12 * size)


@given(steps_in_time, steps_in_time, coefficients)
def test_bdf1_is_exact_for_lines(dt, previous_dt, numbers):
    found, expected, size = differentiated(kc.solvers.BDF1(), dt, previous_dt, np.poly1d(numbers[:2]))
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-12 * size)


@given(steps_in_time, steps_in_time, alphas)
def test_what_does_not_move_has_no_rate(dt, previous_dt, alpha):
    for scheme in (kc.solvers.BDF1(), kc.solvers.BDFAlpha(alpha)):
        c0, c1, c2, _ = scheme.coefficients(dt, previous_dt)
        assert c0 + c1 + c2 == pytest.approx(0.0, abs=1e-14 * max(1.0, abs(c0), abs(c1), abs(c2)))


@given(steps_in_time, alphas)
def test_equal_steps_have_the_published_coefficients(dt, alpha):
    # Till, Aloi & Rucker (2019)
    c0, c1, c2 = (1.5 + alpha) / (dt * (1 + alpha)), -2 / dt, (0.5 + alpha) / (dt * (1 + alpha))
    expected = (c0, c1, c2, alpha / (1 + alpha))
    np.testing.assert_allclose(
        kc.solvers.BDFAlpha(alpha).coefficients(dt, dt), expected, rtol=1e-13, atol=1e-15 / dt
    )


@given(steps_in_time, steps_in_time)
def test_the_ends_of_the_family(dt, previous_dt):
    assert kc.solvers.BDFAlpha(0.0).coefficients(dt, previous_dt) == kc.solvers.BDF2().coefficients(
        dt, previous_dt
    )
    np.testing.assert_allclose(
        kc.solvers.BDF2().coefficients(dt, dt), (1.5 / dt, -2 / dt, 0.5 / dt, 0), rtol=1e-14
    )
    trapezoidal = kc.solvers.Trapezoidal().coefficients(dt, previous_dt)
    assert trapezoidal == kc.solvers.BDFAlpha(-0.5).coefficients(dt, previous_dt)
    # (y_t,n + y_t,{n-1}) / 2 = (y_n - y_{n-1}) / dt, whatever the step before
    np.testing.assert_allclose(trapezoidal, (2 / dt, -2 / dt, 0, -1), rtol=1e-14)


@pytest.mark.parametrize("alpha", [-0.51, 0.01, 1.0, np.nan])
def test_alpha_outside_the_family_is_refused(alpha):
    with pytest.raises(ValueError, match=r"alpha is .*; allowed is -0.5"):
        kc.solvers.BDFAlpha(alpha)


@pytest.mark.parametrize("name", SCHEMES)
def test_first_step(name):
    scheme = SCHEMES[name]
    regular = scheme.coefficients(0.05, 0.05)
    first = {"paper": regular, "consistent": kc.solvers.BDF1().coefficients(0.05, 0.05)}
    for start in ("paper", "consistent"):
        steps = StepCoefficients.of(Settings(time=scheme, start=start), 0.05)
        found = [steps.at(0.0, i)[0] for i in range(3)]
        np.testing.assert_array_equal(found, [first[start], regular, regular])


# observed orders: from rest, tendons that pull ever more, smoothly

SPAN = 0.64
#: every run has as many steps, used or not, so that one program serves all time steps
STEPS = 128


def pulled(dt, first):
    """Tensions of `STEPS` steps, from step `first` on: they rise over the span, beginning without a jolt."""
    part = np.clip((first + 1 + np.arange(STEPS)) * dt / SPAN, 0.0, 1.0)
    still = np.zeros(STEPS)
    return 5.0 + 2.0 * np.stack([np.sin(np.pi / 2 * part) ** 2, still, still, part**2], axis=1)


def motion(robot, steps, **options):
    """States, in natural units, after 1/8, 2/8 … of the span, from rest, in so many steps."""
    dt, rows = SPAN / steps, []
    state = kc.equilibrium(robot, (5.0, 5.0, 5.0, 5.0))
    for first in range(0, steps, STEPS):
        state = kc.simulate(robot, pulled(dt, first), dt, initial=state, **options)
        # a step that was recovered in parts would be another problem
        assert np.all(state.result == kc.Result.CONVERGED)
        rows.append(state.y[1:])
    every = steps // 8
    return np.concatenate(rows)[every - 1 : steps : every] / np.asarray(robot.scales().y)


@pytest.fixture(scope="module")
def robot():
    return kc.load_robot("delrin-tendon-robot")


@pytest.fixture(scope="module")
def finely_stepped(robot):
    """8 times finer than the finest run that is compared with it."""
    return motion(robot, 1024, time="bdf2")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("time", "order", "start"),
    # Before a robot's first state at rest was the same state: the paper's start is then as good as another.
    [("bdf1", 1, "paper"), ("bdf2", 2, "paper"), ("bdf-alpha", 2, "consistent"), ("trapezoidal", 2, "paper")],
)
def test_order_in_time(robot, finely_stepped, time, order, start):
    runs = [motion(robot, steps, time=time, start=start) for steps in (32, 64, 128)]
    errors = [np.abs(run - finely_stepped).max() for run in runs]
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), order, rtol=0, atol=0.2)


# a frequency


@pytest.mark.campaign
def test_free_vibration_of_the_first_mode(robot):
    EI, rhoA = float(robot.Kbt[0, 0]), float(robot.mass_per_length)
    frequency = closed_forms.frequency(1, float(robot.length), EI, rhoA)
    ratio = 0.01  # of damping to its critical value
    free = robot.replace(
        gravity=(0.0, 0.0, 0.0), drag=0.0, bending_damping=2 * ratio * EI / frequency, nodes=21
    )
    dt = 2 * np.pi / frequency / 20
    tensions = np.zeros((STEPS, 4))
    tensions[:10, 0] = 0.01  # a push, and from then on none
    swinging = kc.simulate(free, tensions, dt, time="bdf-alpha", space="lobatto4")
    sideways = swinging.position @ [np.sqrt(0.5), np.sqrt(0.5), 0.0]
    part = np.linspace(0, 1, free.nodes)
    amplitude = np.trapezoid(sideways * closed_forms.mode_shape(1, part)[0], part, axis=1)[
        50:
    ]  # higher modes have gone by then

    # amplitude[i + 1] = a amplitude[i] + b amplitude[i - 1] of a vibration whose steps multiply it by z
    past = np.stack([amplitude[1:-1], amplitude[:-2]], axis=1)
    (a, b), *_ = np.linalg.lstsq(past, amplitude[2:])
    z = np.roots([1.0, -a, -b])[0]
    # what the scheme takes for the rate of zⁿ, so that what it damps and slows is not counted
    c0, c1, c2, d1 = kc.solvers.BDFAlpha().coefficients(dt, dt)
    rate = (c0 + c1 / z + c2 / z**2) / (1 - d1 / z)
    # a beam without shear and rotary inertia swings faster by some 5e-5
    assert abs(rate) == pytest.approx(frequency, rel=2e-4)
    assert -rate.real / abs(rate) == pytest.approx(ratio, rel=1e-3)
