"""The passive residual: what it takes up over closed cycles, what it leaves of equations, its files."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import knode_cosserat as kc
from examples.hanging_string import HangingString
from knode_cosserat.learning.passive import passive
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.semi_discrete import History, Point

ROBOT = kc.load_robot("delrin-tendon-robot").replace(bending_damping=1e-3, nodes=5)
TENSION = np.array([7.0, 5.0, 3.0, 5.0])
EMPTY = passive(ROBOT, np.tile(TENSION, (3, 1)))


def drawn(seed, size=1.0):
    """A residual with any numbers, those of damping not negative."""
    rng = np.random.default_rng(seed)
    parts = EMPTY.coefficients().items()
    changes = {name: jnp.asarray(size * rng.normal(size=np.shape(part))) for name, part in parts}
    return EMPTY.with_coefficients(changes).clamped()


@pytest.mark.slow
@given(st.integers(0, 2**31), st.floats(0.01, 30.0))
@settings(deadline=None, max_examples=30)
def test_it_takes_up_energy_over_every_closed_cycle(seed, size):
    """∮ m_r · u_t dt, of which the energy's part is zero: exact to rounding for trigonometric cycles."""
    residual, rng = drawn(seed, size), np.random.default_rng(seed)
    s, count = rng.uniform(0.0, float(ROBOT.length)), 64
    phase = 2.0 * np.pi * np.arange(count) / count
    waves = rng.normal(size=(4, 2, 3))
    u = sum(
        waves[0][:, [k]] * np.cos((k + 1) * phase) + waves[1][:, [k]] * np.sin((k + 1) * phase)
        for k in range(3)
    )
    u_t = sum(
        (k + 1) * (waves[1][:, [k]] * np.cos((k + 1) * phase) - waves[0][:, [k]] * np.sin((k + 1) * phase))
        for k in range(3)
    )
    stored, taken, size_of = 0.0, 0.0, 0.0
    for k in range(count):
        # the state is another one at every point of the cycle
        y = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], rng.normal(size=12)])
        stiffness, damping, moment = map(np.asarray, residual.terms(ROBOT, s, y, TENSION))
        spring = stiffness[:2, :2] @ u[:, k] + moment[:2]
        damper = damping[:2, :2] @ u_t[:, k]
        stored += spring @ u_t[:, k]
        taken += damper @ u_t[:, k]
        size_of += np.abs(spring) @ np.abs(u_t[:, k])
        assert np.all(np.linalg.eigvalsh(np.asarray(ROBOT.Kbt) + stiffness) > 0.0)
    assert abs(stored) <= 1e-10 * size_of
    assert taken >= 0.0


def test_the_law_has_its_moment():
    """What the knowledge's law leaves at the strains found is what the residual carries."""
    residual, rng = drawn(3, 0.5), np.random.default_rng(3)
    s, c0 = 0.4 * float(ROBOT.length), 20.0
    y = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], 0.1 * rng.normal(size=12)])
    history = History(jnp.asarray(c0), jnp.zeros(19), jnp.asarray(0.1 * rng.normal(size=6)), jnp.zeros(19))
    _, z = semi_discrete.derivatives(
        kc.KNODE(ROBOT, residual), Point(s, 0.0, jnp.asarray(y), jnp.asarray(TENSION), history)
    )
    left = np.asarray(semi_discrete.law_residual(ROBOT, Point(s, 0.0, y, TENSION, history), z))[3:]
    stiffness, damping, moment = map(np.asarray, residual.terms(ROBOT, s, y, TENSION))
    u, u_t = np.asarray(z)[3:], np.asarray(c0 * z + history.z)[3:]
    own = stiffness @ u + moment + damping @ u_t
    assert np.allclose(left, -own, rtol=1e-9, atol=1e-12)
    assert np.abs(own).max() > 1e-3


@pytest.mark.slow
def test_zeros_change_nothing_and_numbers_come_back():
    tension = kc.controls.sine(1.0, 10, 0.05)
    plain = kc.simulate(ROBOT, tension, 0.05)
    same = kc.simulate(kc.KNODE(ROBOT, EMPTY), tension, 0.05)
    assert np.allclose(same.y, plain.y, rtol=0.0, atol=1e-8)
    changed = EMPTY.with_coefficients({"levers": np.ones((2, 2, 4))}).coefficients()
    assert np.array_equal(changed["levers"], np.ones((2, 2, 4))) and not np.any(changed["energy"])
    assert set(EMPTY.pruned().coefficients()) == {*EMPTY.coefficients()} - {"dissipation"}


def test_its_file(tmp_path):
    model = kc.KNODE(ROBOT, drawn(1, 0.1).pruned())
    model.save(tmp_path / "model")
    again = kc.load_model(tmp_path / "model")
    parts = model.residual.coefficients()
    assert again.residual.coefficients().keys() == parts.keys()
    assert all(np.array_equal(again.residual.coefficients()[name], parts[name]) for name in parts)


def test_a_system_without_stiffness_is_refused():
    with pytest.raises(TypeError, match=r"ParallelRobot without h, n, .* with bending stiffness"):
        passive(kc.load_robot("six-legged-robot"), TENSION[None])
    with pytest.raises(TypeError, match=r"HangingString without bending_stiffness, bending_damping, h, m"):
        passive(HangingString(length=1.0, density=0.1, stiffness=1e3), TENSION[None])


def test_a_residual_on_a_model_starts_without_effect():
    """The nominal stiffness of a model is that of its robot; its own residual is kept."""
    model = kc.KNODE(ROBOT, drawn(3, 0.1))
    both = kc.KNODE(model, passive(model, TENSION[None]))
    rng = np.random.default_rng(3)
    y = np.concatenate([np.zeros(3), [1.0, 0.1, 0.2, 0.0], rng.normal(size=12)])
    history = History(20.0, *(0.1 * rng.normal(size=size) for size in (19, 6, 19)))
    for found, expected in zip(
        *(semi_discrete.derivatives(each, Point(0.2, 0.0, y, TENSION, history)) for each in (both, model)),
        strict=True,
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
