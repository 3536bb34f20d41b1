"""The terms that are learned from recordings: what they add, what they leave as it is, their files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from examples.hanging_string import HangingString
from knode_cosserat.learning.terms import BENT, CONTROL, PLACES, Recontrolled, _bending, hats, smooth, terms
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.semi_discrete import History, Point

ROBOT = kc.load_robot("delrin-tendon-robot").replace(bending_damping=1e-3, nodes=5)
CONTROLS = np.random.default_rng(0).uniform(0.0, 8.0, (40, 4))
EMPTY = terms(ROBOT, CONTROLS)
REELS = kc.robots.RoutedTendonRobot.like(ROBOT, drive="reel")


def drawn(empty, *names, seed=0):
    """The same with random numbers in some parts, or in all."""
    rng, parts = np.random.default_rng(seed), empty.coefficients()
    changes = {it: jnp.asarray(rng.normal(size=np.shape(parts[it]))) for it in names or parts}
    return empty.with_coefficients(changes).clamped()


def equations(model, control, seed=1):
    """y_s and z at a random point in motion."""
    rng = np.random.default_rng(seed)
    ny, nz = model.y_layout.size, model.z_layout.size
    y = np.concatenate([np.zeros(3), [1.0, 0.1, 0.2, 0.0], 0.1 * rng.normal(size=ny - 7)])
    history = History(20.0, *(0.1 * rng.normal(size=size) for size in (ny, nz, ny)))
    y_s, z = semi_discrete.derivatives(model, Point(jnp.asarray(0.3), 0.0, jnp.asarray(y), control, history))
    return np.asarray(y_s), np.asarray(z)


@pytest.mark.slow
@pytest.mark.parametrize("robot", [ROBOT, REELS], ids=["tensions", "reels"])
def test_numbers_that_are_zero_change_nothing(robot):
    controls = CONTROLS if robot is ROBOT else 1e-3 * CONTROLS
    empty = terms(robot, controls)
    for one, other in zip(
        equations(kc.KNODE(robot, empty), controls[0]), equations(robot, controls[0]), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
    assert empty.pruned().coefficients() == {}
    for name in empty.coefficients():
        only = kc.KNODE(robot, drawn(empty, name).pruned())
        assert set(only.coefficients()) == {name}
        changed = equations(only, controls[0])
        assert any(
            np.max(np.abs(one - other)) > 1e-9
            for one, other in zip(changed, equations(robot, controls[0]), strict=True)
        ), name


def test_the_curvature_has_an_energy():
    """Its derivative by the moment is symmetric, for each degree; the degree is that of the energy."""
    rng, at = np.random.default_rng(2), np.array([0.7, -0.4])
    for degree in (1, 2, 3, 4):
        weights = rng.normal(size=degree + 1)
        slope = np.asarray(jax.jacfwd(lambda x, w=weights, d=degree: _bending(d, w, x))(jnp.asarray(at)))
        np.testing.assert_allclose(slope, slope.T, atol=1e-14)
        one, twice = (np.asarray(_bending(degree, weights, k * at)) for k in (1.0, 2.0))
        np.testing.assert_allclose(twice, 2.0 ** (degree - 1) * one, rtol=1e-12)
    np.testing.assert_allclose(_bending(1, [1.0, 0.0], at), [BENT, 0.0])


def test_functions_of_the_controls_fall_to_zero_far_away():
    change = drawn(EMPTY, "near.weights").near
    assert np.max(np.abs(change(CONTROLS[0]))) > 0.0
    assert np.max(np.abs(change(CONTROLS[0] + 1e3))) < 1e-12
    # a control that never moved has no influence
    still = np.concatenate([CONTROLS, np.full((40, 1), 3.0)], axis=1)
    change = smooth(still, 3.0, np.ones(1))
    change = change.__class__(
        np.ones_like(change.weights), change.centres, change.mix, change.unit, change.size
    )
    np.testing.assert_allclose(change(still[0]), change(np.append(CONTROLS[0], 9.0)), rtol=1e-6)


def test_damping_is_not_negative():
    rows = np.array([-1.0, 0.5, 2.0, -0.1])
    clamped = EMPTY.with_coefficients({"damping": rows}).clamped()
    np.testing.assert_array_equal(clamped.damping, [0.0, 0.5, 2.0, 0.0])


def test_places_are_hat_functions():
    values = np.arange(float(PLACES))
    np.testing.assert_allclose([hats(sigma, values) for sigma in (0.0, 0.5, 1.0)], [0.0, 1.5, 3.0])


def test_what_fits_a_system():
    """A user's system has functions of its controls; a robot without motion of its controls has none."""
    string = HangingString(length=1.0, density=0.1, stiffness=1e3, friction=0.05, nodes=5)
    rows = np.random.default_rng(0).normal(size=(20, 2))
    found = terms(string, rows)
    assert set(found.coefficients()) == {f"{name}.weights" for name in CONTROL}
    assert isinstance(found.adapted(string), Recontrolled)
    still = terms(ROBOT, np.full((20, 4), 5.0), moving=False)
    assert not {"damping", *(f"{name}.weights" for name in CONTROL)} & set(still.coefficients())
    assert still.adapted(ROBOT) is ROBOT


def test_a_file_holds_a_model(tmp_path):
    model = kc.KNODE(ROBOT, drawn(EMPTY))
    model.save(tmp_path / "model")
    found = kc.load_model(tmp_path / "model")
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(model), strict=True):
        assert np.array_equal(one, other)


@pytest.mark.slow
def test_tangents_of_equilibria_are_those_of_differences():
    """Of a rod with tendons beside it, by all numbers of which the functions of controls are an array."""
    robot = kc.robots.RoutedTendonRobot.like(ROBOT, tendon_offset=0.02)
    empty = terms(robot, CONTROLS[:12], moving=False)
    begin, along = (drawn(empty, seed=seed).coefficients() for seed in (4, 5))

    def tip(part):
        coefficients = {name: 0.3 * begin[name] + part * along[name] for name in begin}
        model = kc.KNODE(robot, empty.with_coefficients(coefficients))
        return kc.equilibrium(model, CONTROLS[0], space="lobatto4").tip_position[0]

    _, slope = jax.jvp(tip, (0.0,), (1.0,))
    np.testing.assert_allclose(slope, (tip(1e-4) - tip(-1e-4)) / 2e-4, rtol=1e-5, atol=1e-9)
