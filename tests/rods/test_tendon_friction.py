"""The memories of tendons in their holes by themselves: elastic, perfectly plastic friction, and shaking."""

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from knode_cosserat.rods.tendons import STRAIGHT, TendonFriction, Vibration
from knode_cosserat.schemes.discrete_law import integrate_variable

REACH = 0.1
FRICTION = TendonFriction(wobble=0.6, curvature=0.1, reach=REACH)
VIBRATION = Vibration(tension=10.0, rate=0.4)
#: a tendon that bends the rod about its first axis
FIRST = np.array([[1.0, 0.0, 0.0]])
STILL = np.zeros(3)
PATHS = st.lists(st.floats(-0.5, 0.5), min_size=1, max_size=20)


def remembered(changes, dt, f=0.0):
    """f after these changes of curvature (1/m), each within a step of BDF1."""
    for change in changes:
        rate = np.array([change / dt, 0.0, 0.0])
        f = float(
            integrate_variable(FRICTION.evolution(FIRST, rate, STILL), np.array([-f / dt]), 1.0 / dt)[0]
        )
    return f


@hypothesis.given(PATHS)
@hypothesis.settings(deadline=None, max_examples=30)
def test_friction_depends_on_the_way_and_not_on_how_fast_it_was_gone(path):
    assert remembered(path, 1e-3) == pytest.approx(remembered(path, 10.0), abs=1e-9)


@hypothesis.given(PATHS)
@hypothesis.settings(deadline=None, max_examples=30)
def test_friction_is_that_of_an_elastic_perfectly_plastic_element(path):
    expected = 0.0
    for change in path:
        expected = np.clip(expected + change / REACH, -1.0, 1.0)
    assert remembered(path, 0.05) == pytest.approx(expected, abs=1e-9)


@hypothesis.given(st.floats(-1.0, 1.0), st.floats(1e-6, 1.0), st.integers(1, 20))
@hypothesis.settings(deadline=None, max_examples=20)
def test_what_shakes_within_its_reach_does_not_creep(f, part, times):
    swing = part * REACH * (1.0 - abs(f))
    assert remembered([swing, -swing] * times, 0.01, f) == pytest.approx(f, abs=1e-9)


def test_turning_round_takes_twice_the_reach():
    there = [REACH] * 5
    assert remembered(there, 0.05) == 1.0
    assert remembered([*there, -REACH], 0.05) == pytest.approx(0.0, abs=1e-12)
    assert remembered([*there, -2 * REACH], 0.05) == pytest.approx(-1.0, abs=1e-12)


def test_at_rest_nothing_holds_and_vibration_has_grown_as_far_as_it_will():
    rest = np.array(0.0)
    bent = np.array([0.5, 0.0, 0.0])
    np.testing.assert_array_equal(
        integrate_variable(FRICTION.evolution(FIRST, bent, bent), np.ones(1), rest), 0.0
    )
    grown = [
        float(integrate_variable(VIBRATION.evolution(total), np.zeros(1), rest)[0])
        for total in (8.0, 10.0, 15.0)
    ]
    assert grown == [0.0, 0.0, 1.0]


@pytest.mark.parametrize(("part", "expected"), [(0.5, 0.25), (-0.5, -0.25), (1.0, 0.5)])
def test_an_equilibrium_may_keep_a_part_of_the_friction(part, expected):
    """Of what a motion from the unloaded rod to half the reach would have built up."""
    friction = TendonFriction(wobble=0.6, reach=REACH, at_rest=part)
    bent = np.array([0.5 * REACH, 0.0, 0.0])
    assert float(
        integrate_variable(friction.evolution(FIRST, STILL, bent), np.zeros(1), np.array(0.0))[0]
    ) == pytest.approx(expected)


def test_vibration_grows_at_its_rate_and_stays_between_none_and_all():
    x, c0 = 0.0, 1.0 / 0.1
    for step in range(1, 20):
        x = float(integrate_variable(VIBRATION.evolution(12.0), np.array([-x * c0]), c0)[0])
        assert x == pytest.approx(min(1.0, 0.8 * 0.1 * step), abs=1e-12)
    for _ in range(40):
        x = float(integrate_variable(VIBRATION.evolution(8.0), np.array([-x * c0]), c0)[0])
    assert x == 0.0


def test_an_arc_loses_what_a_capstan_does():
    """λ of an arc by μ times its angle, and by k times its length; the angle less what is nearly straight."""
    u, length = np.array([3.0, 4.0, 100.0]), 0.7
    rates = FRICTION.loss_rates(u, np.array([1.0, -0.5]))
    np.testing.assert_allclose(length * rates, length * (0.6 + 0.1 * 5.0) * np.array([1.0, -0.5]), rtol=1e-3)
    straight = np.hypot(5.0, STRAIGHT) - STRAIGHT
    np.testing.assert_allclose(rates[0], 0.6 + 0.1 * straight, rtol=1e-14)
    np.testing.assert_allclose(TendonFriction(curvature=0.1).loss_rates(u, np.ones(1)), 0.1 * straight)
