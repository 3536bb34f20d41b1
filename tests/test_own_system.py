"""A system that a user wrote, in the general form with B not zero: the string of `examples/`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import knode_cosserat as kc
from examples.hanging_string import HangingString

HAND = np.array([0.6, -0.1])


@pytest.fixture(scope="module")
def string():
    return HangingString(length=1.0, density=0.1, stiffness=1e3, friction=0.05, nodes=21)


def catenary_tensions(hand: np.ndarray, weight: float = 0.981) -> tuple[float, float]:
    """Horizontal pull, and vertical force at the nail, of an inextensible string of length 1 m."""
    chord = np.sqrt(1.0 - hand[1] ** 2)
    a = brentq(lambda a: 2 * a * np.sinh(hand[0] / (2 * a)) - chord, 0.01, 10.0)
    low = hand[0] / 2 - a * np.arctanh(hand[1])
    return weight * a, -weight * a * np.sinh(low / a)


@pytest.mark.slow
def test_it_hangs_as_a_catenary(string):
    errors = []
    for nodes in (11, 21, 41):
        stiff = string.replace(stiffness=1e8, nodes=nodes)
        n = kc.equilibrium(stiff, HAND, space="lobatto4").part("n")[0, 0]
        errors.append(np.max(np.abs(n - catenary_tensions(HAND))))
    assert errors[-1] < 1e-6
    assert np.log2(errors[0] / errors[1]) > 3.5 and np.log2(errors[1] / errors[2]) > 3.5


@pytest.mark.campaign
def test_it_swings_and_comes_to_rest(string):
    rest = kc.equilibrium(string, HAND, space="lobatto4")
    t = np.arange(1, 201) * 0.05
    hand = HAND + np.stack([0.1 * np.sin(2 * np.pi * np.minimum(t, 1.0)), 0.0 * t], axis=1)
    moved = kc.simulate(string.replace(friction=1.0), hand, 0.05, space="lobatto4", initial=rest)
    assert moved.all_valid
    assert np.max(np.abs(moved.part("p")[10] - rest.part("p")[0])) > 0.02
    np.testing.assert_allclose(moved.part("p")[-1], rest.part("p")[0], atol=2e-4)
    np.testing.assert_allclose(moved.part("p")[1:, -1], hand, atol=1e-9)


@pytest.mark.campaign
def test_its_velocity_is_that_of_its_position(string):
    """q_s = p_st holds through the history of y_s: q is BDF2's rate of p at the nodes, on any grid."""
    t = np.arange(1, 41) * 0.05
    hand = HAND + np.stack([0.05 * np.sin(np.pi * t) ** 2, 0.0 * t], axis=1)
    errors = []
    for nodes in (21, 41):
        finer = string.replace(nodes=nodes)
        rest = kc.equilibrium(finer, HAND, space="lobatto4")
        moved = kc.simulate(finer, hand, 0.05, time="bdf2", space="lobatto4", initial=rest)
        p, q = moved.part("p"), moved.part("q")
        by_bdf2 = (1.5 * p[2:] - 2.0 * p[1:-1] + 0.5 * p[:-2]) / 0.05
        assert np.max(np.abs(q)) > 0.1
        errors.append(np.max(np.abs(q[2:] - by_bdf2)))
    # as far as steps are solved
    assert max(errors) < 1e-7


@pytest.mark.campaign
def test_it_is_differentiable_and_runs_in_batches(string):
    def sag(density):
        return jnp.min(
            kc.equilibrium(string.replace(stiffness=20.0, density=density), HAND).part("p")[..., 1]
        )

    slope = jax.grad(sag)(0.1)
    step = 1e-5
    by_differences = (sag(0.1 + step) - sag(0.1 - step)) / (2 * step)
    assert slope == pytest.approx(float(by_differences), rel=1e-5)
    both = kc.equilibrium([string, string.replace(density=0.2)], HAND)
    np.testing.assert_allclose(2 * both[0].part("n"), both[1].part("n"), rtol=2e-2)


def test_what_it_does_not_have_is_said(string):
    with pytest.raises(AttributeError, match="HangingString has no orientation"):
        _ = kc.equilibrium(string, HAND, space="lobatto4").quaternion
    with pytest.raises(kc.robots.ParameterError, match=r"no parameter 'youngs_modulus'.*stiffness"):
        string.replace(youngs_modulus=1.0)
