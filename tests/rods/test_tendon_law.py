"""The law of a rod with its tendons: it is fulfilled to rounding, its slopes are right, failure is NaN."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from knode_cosserat.rods import tendon_law
from knode_cosserat.rods.tendon_law import (
    TendonLaw,
    stretches,
    tendon_strains,
    tendon_wrench,
    unbent_flexibility,
)

COUNT = 3


def strains(K_v, K_u, a, b, *tendons, factor=None):
    """v and u; with so many times the matrix that it is solved by otherwise."""
    law = TendonLaw(K_v, K_u, jnp.concatenate([a, b]), *tendons)
    return tendon_strains(law, None if factor is None else factor * unbent_flexibility(law))


#: of many lanes at once, so that hypothesis runs one program
solve = jax.jit(jax.vmap(lambda given: strains(*given)))


@jax.jit
def solve_by(factor, rods):
    return jax.vmap(lambda *one: strains(*one, factor=factor))(*rods)


slopes = jax.jit(jax.jacfwd(lambda given: jnp.concatenate(strains(*given))))
slopes_backward = jax.jit(jax.jacrev(lambda given: jnp.concatenate(strains(*given))))
LANES = 8


def reference(K_v, K_u, a, b, r, r_s, tension, v, u):
    """What is left of the law at v, u, as a part of its largest terms; in plain NumPy."""
    p_s = v + np.cross(u, r) + r_s
    t = p_s / np.linalg.norm(p_s, axis=1, keepdims=True)
    N, M = tension @ t, tension @ np.cross(r, t)
    force = np.abs(K_v @ v + N - a).max() / (np.abs(K_v) @ np.abs(v) + np.sum(tension) + np.abs(a)).max()
    lever = np.sum(tension * np.linalg.norm(r, axis=1))
    moment = np.abs(K_u @ u + M - b).max() / (np.abs(K_u) @ np.abs(u) + lever + np.abs(b)).max()
    return max(force, moment)


def rod(rng, radius, youngs_modulus, pull, bent, offset):
    """A rod with a random frame: tensions up to `pull` EA, moments that bend it to a strain of `bent`."""
    EA = np.pi * radius**2 * youngs_modulus
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    K_v = turn @ np.diag(EA * rng.uniform(0.3, 1.0, 3)) @ turn.T
    K_u = turn @ np.diag(EA * radius**2 / 4 * rng.uniform(0.5, 1.0, 3)) @ turn.T
    tension = pull * EA * rng.uniform(0.0, 1.0, COUNT) / COUNT
    angle, distance = rng.uniform(0, 2 * np.pi, COUNT), offset * rng.uniform(0.3, 1.0, COUNT)
    r = np.stack([distance * np.cos(angle), distance * np.sin(angle), 0 * angle], axis=1)
    r_s = np.concatenate([rng.uniform(-0.3, 0.3, (COUNT, 2)), np.zeros((COUNT, 1))], axis=1)
    a = K_v @ np.array([0.0, 0.0, 1.0]) + 0.1 * pull * EA * rng.standard_normal(3)
    b = K_u @ (bent / radius * rng.standard_normal(3)) + np.cross(r, [0.0, 0.0, 1.0]).T @ tension
    return K_v, (K_u + K_u.T) / 2, a, b, r, r_s, tension


KINDS = {
    "Delrin": (0.0032, 2.76e9, 40.0 / 9e4, 5e-3, 0.02),
    "steel": (0.000675, 207e9, 20.0 / 3e5, 5e-3, 0.015),
    "silicone": (0.008, 3e5, 0.25, 0.1, 0.007),
    "slack": (0.0032, 2.76e9, 0.0, 5e-3, 0.02),
}


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_the_law_is_fulfilled_to_rounding(kind, seed):
    rng = np.random.default_rng(seed)
    rods = [rod(rng, *KINDS[kind]) for _ in range(LANES)]
    v, u = solve(tuple(np.stack(parts) for parts in zip(*rods, strict=True)))
    for k, one in enumerate(rods):
        assert reference(*one, v[k], u[k]) < 1e-12


@pytest.mark.parametrize("kind", ["Delrin", "silicone"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=5, deadline=None)
def test_slopes_are_those_of_the_solution_in_both_modes(kind, seed):
    """Along a random direction of all arguments at once, against central differences."""
    rng = np.random.default_rng(seed)
    one, other = rod(rng, *KINDS[kind]), rod(rng, *KINDS[kind])
    way = tuple(0.1 * (b - a) for a, b in zip(one, other, strict=True))
    forward, backward = slopes(one), slopes_backward(one)
    for f, b in zip(forward, backward, strict=True):
        np.testing.assert_allclose(f, b, rtol=1e-9, atol=1e-12 * np.abs(b).max())
    slope = sum(np.tensordot(d, w, axes=np.ndim(w)) for d, w in zip(forward, way, strict=True))

    def difference(h):
        ends = [tuple(a + sign * h * w for a, w in zip(one, way, strict=True)) for sign in (1, -1)]
        v, u = solve(
            tuple(np.stack([*parts, *[parts[0]] * (LANES - 2)]) for parts in zip(*ends, strict=True))
        )
        return (np.concatenate([v[0], u[0]]) - np.concatenate([v[1], u[1]])) / (2 * h)

    # of order 4
    expected = (4 * difference(5e-4) - difference(1e-3)) / 3
    for part in (slice(0, 3), slice(3, 6)):
        size = np.abs(expected[part]).max()
        np.testing.assert_allclose(slope[part], expected[part], rtol=0, atol=1e-6 * size)


@pytest.mark.campaign
def test_slopes_have_slopes():
    one = rod(np.random.default_rng(0), *KINDS["silicone"])

    def along(h):
        return jnp.sum(jnp.concatenate(strains(*one[:6], one[6] * (1.0 + h))))

    second = jax.jit(jax.grad(jax.grad(along)))(0.1)
    first = jax.jit(jax.grad(along))
    np.testing.assert_allclose(second, (first(0.1 + 1e-5) - first(0.1 - 1e-5)) / 2e-5, rtol=1e-6)


def test_a_straight_tendon_bends_by_its_moment_and_shortens_by_its_tension():
    K_v, K_u = np.diag([3e4, 3e4, 8e4]), np.diag([0.2, 0.2, 0.16])
    r = np.array([[0.02, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 0.0]])
    one = (K_v, K_u, K_v[2], np.zeros(3), r, np.zeros((3, 3)), np.array([40.0, 0.0, 0.0]))
    v, u = (lanes[0] for lanes in solve(tuple(np.stack([part] * LANES) for part in one)))
    np.testing.assert_allclose(v, [0.0, 0.0, 1.0 - 40.0 / 8e4], rtol=0, atol=1e-15)
    np.testing.assert_allclose(u, [0.0, 40.0 * 0.02 / 0.2, 0.0], rtol=0, atol=1e-12)


def test_helpers_agree_with_each_other():
    rng = np.random.default_rng(1)
    v, u, tension = rng.standard_normal(3), rng.standard_normal(3), np.array([1.0, 2.0, 3.0])
    r, r_s = (np.column_stack([rng.standard_normal((COUNT, 2)), np.zeros(COUNT)]) for _ in range(2))
    p_s = v + np.cross(u, r) + r_s
    np.testing.assert_allclose(stretches(v, u, r, r_s), np.linalg.norm(p_s, axis=1), rtol=1e-14)
    t = p_s / np.linalg.norm(p_s, axis=1, keepdims=True)
    force, moment = tendon_wrench(v, u, r, r_s, tension)
    np.testing.assert_allclose(force, tension @ t, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(moment, tension @ np.cross(r, t), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("argument", range(7))
def test_what_is_not_a_number_stays_not_a_number(argument):
    one = list(rod(np.random.default_rng(2), *KINDS["Delrin"]))
    one[argument] = np.full_like(one[argument], np.nan)
    v, u = solve(tuple(np.stack([part] * LANES) for part in one))
    assert np.all(np.isnan(v)) and np.all(np.isnan(u))


def test_a_tendon_that_the_rod_cannot_hold_is_not_a_number():
    """Along the axis with twice EA: the rod is squeezed to nothing, where the tendon has no tangent."""
    K_v, K_u, r = np.diag([3e4, 3e4, 8e4]), np.diag([0.2, 0.2, 0.16]), np.zeros((COUNT, 3))
    one = (K_v, K_u, K_v[2], np.zeros(3), r, r, np.full(COUNT, 16e4 / COUNT))
    v, u = solve(tuple(np.stack([part] * LANES) for part in one))
    assert np.all(np.isnan(v)) and np.all(np.isnan(u))


@pytest.mark.parametrize("kind", ["Delrin", "silicone"])
@given(seed=st.integers(0, 2**32 - 1), factor=st.sampled_from([1e-6, 0.97, 1.3, -1.0, 1e6, np.nan]))
@settings(max_examples=25, deadline=None)
def test_by_which_matrix_it_is_solved_does_not_matter(kind, seed, factor):
    rng = np.random.default_rng(seed)
    rods = tuple(
        np.stack(parts) for parts in zip(*(rod(rng, *KINDS[kind]) for _ in range(LANES)), strict=True)
    )
    found, expected = solve_by(factor, rods), solve(rods)
    for k, size in enumerate((1.0, 1.0 / KINDS[kind][0])):
        np.testing.assert_allclose(found[k] / size, expected[k] / size, rtol=0, atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_whatever_has_a_solution_is_solved(seed):
    """Tensions to ten times EA, strains of one: no first guess is near. a and b are made for v and u."""
    rng = np.random.default_rng(seed)
    rods, places = [], []
    while len(rods) < LANES:
        K_v, K_u, _, _, r, r_s, tension = rod(rng, 0.008, 3e5, 10.0 ** rng.uniform(-1, 1), 1.0, 0.007)
        v = np.array([0.0, 0.0, 1.0]) + 0.3 * rng.standard_normal(3)
        u = rng.standard_normal(3) / 0.008
        p_s = v + np.cross(u, r) + r_s
        long = np.linalg.norm(p_s, axis=1, keepdims=True)
        if long.min() > 0.1:
            a, b = K_v @ v + tension @ (p_s / long), K_u @ u + tension @ np.cross(r, p_s / long)
            rods.append((K_v, K_u, a, b, r, r_s, tension))
            places.append((v, u))
    found = solve(tuple(np.stack(parts) for parts in zip(*rods, strict=True)))
    v, u = (np.stack(parts) for parts in zip(*places, strict=True))
    np.testing.assert_allclose(found[0], v, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found[1] * 0.008, u * 0.008, rtol=0, atol=1e-10)


def test_rods_that_are_hardly_bent_need_no_newton(monkeypatch):
    # what is solved exactly is solved, too: what is left of it is rounding, and does not get less
    monkeypatch.setattr(tendon_law, "ROUNDS", 0)
    rng, given, expected = np.random.default_rng(0), [], []
    for bent in np.repeat([0.0, 1e-14, 1e-10, 1e-6, 1e-3], 100):
        K_v, K_u, _, _, r, r_s, tension = rod(rng, *KINDS["Delrin"][:2], 1e-4, 0.0, 0.02)
        v, u = np.array([0.0, 0.0, 1.0]), bent / 0.0032 * rng.standard_normal(3)
        p_s = v + np.cross(u, r) + r_s
        t = p_s / np.linalg.norm(p_s, axis=1, keepdims=True)
        a, b = K_v @ v + tension @ t, K_u @ u + tension @ np.cross(r, t)
        given.append((K_v, K_u, a, b, r, r_s, tension))
        expected.append(np.concatenate([v, u]))
    one_by_one = jax.jit(lambda rods: jax.lax.map(lambda each: jnp.concatenate(strains(*each)), rods))
    found = one_by_one(jax.tree.map(lambda *each: np.stack(each), *given))
    assert np.allclose(found, expected, rtol=0.0, atol=1e-10)
