"""The shape of rods with real tendons: closed forms, and Rucker & Webster's own equations as an oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root

import knode_cosserat as kc
from knode_cosserat.robots import routing
from knode_cosserat.rods.tendon_law import TendonLaw, tendon_strains
from tests.rods import rucker_webster as oracle

DELRIN = kc.load_robot("delrin-tendon-robot")
L = 0.635
ROD = oracle.Rod(
    L,
    np.asarray(DELRIN.Kse),
    np.asarray(DELRIN.Kbt),
    float(DELRIN.mass_per_length) * np.array([0.0, 0.0, -9.81]),
)
LIGHT = oracle.Rod(L, ROD.Kse, ROD.Kbt, np.zeros(3))
A_SOFT_RADIUS = 0.008
#: silicone that its tendons compress by a fifth
SOFT = oracle.Rod(
    0.2,
    np.pi * A_SOFT_RADIUS**2 * 3e5 * np.diag([1 / 3, 1 / 3, 1.0]),
    np.pi / 4 * A_SOFT_RADIUS**4 * 3e5 * np.diag([1.0, 1.0, 2 / 3]),
    np.pi * A_SOFT_RADIUS**2 * 1100.0 * np.array([0.0, 0.0, 9.81]),
)


def shape(rod, routings, tensions, tolerance=1e-11):
    """[p, R, v, u] at the tip by the package's law: n and m carry rod and tendons, and have no jumps."""
    anchored = np.array(routing.RoutedPaths(routings, rod.length).ends)
    stops = sorted({*(anchored * rod.length), rod.length})

    @jax.jit
    def rates(s, x, tension):
        R, m = x[3:12].reshape(3, 3), x[12:]
        n = rod.weight * (rod.length - s)
        r, r_s = routing.routes(routings, s / rod.length, rod.length)
        load = jnp.concatenate([R.T @ n + rod.Kse @ oracle.V_STAR, R.T @ m])
        v, u = tendon_strains(TendonLaw(rod.Kse, rod.Kbt, load, r, r_s, tension))
        R_s = jnp.stack([jnp.cross(row, u) for row in R])
        return jnp.concatenate([R @ v, R_s.ravel(), -jnp.cross(R @ v, n)]), jnp.concatenate([v, u])

    def integrate(m):
        x, s = np.concatenate([np.zeros(3), np.eye(3).ravel(), m]), 0.0
        for stop in stops:
            running = np.where(anchored * rod.length > s, tensions, 0.0)
            along = solve_ivp(
                lambda at, x, running=running: np.asarray(rates(at, x, running)[0]),
                (s, stop),
                x,
                method="DOP853",
                rtol=tolerance,
                atol=tolerance,
            )
            x, s = along.y[:, -1], stop
        return np.concatenate([x[:12], np.asarray(rates(s, x, running)[1])]), x[12:]

    scale = rod.Kbt[0, 0] / rod.length
    found = root(lambda m: integrate(m * scale)[1] / scale, np.zeros(3), tol=1e-12)
    assert np.max(np.abs(found.fun)) < 1e-9
    return integrate(found.x * scale)[0]


@pytest.mark.parametrize("tension", [0.5, 5.0, 40.0])
def test_the_oracle_bends_a_rod_with_a_straight_tendon_to_a_circle(tension):
    """Tangents stay along d₃, so that exactly EI κ = T r and EA (v - 1) = -T."""
    offset = 0.02
    tip = oracle.shape(LIGHT, [oracle.polynomial([offset], [0.0], L, tension)])
    curvature, v = tension * offset / LIGHT.Kbt[1, 1], 1.0 - tension / LIGHT.Kse[2, 2]
    across, along = v / curvature * (1 - np.cos(curvature * L)), v / curvature * np.sin(curvature * L)
    np.testing.assert_allclose(tip[:3], [across, 0.0, along], atol=1e-9)
    np.testing.assert_allclose(tip[12:], [0.0, 0.0, v, 0.0, curvature, 0.0], atol=1e-8)


QUARTERS = [k * np.pi / 2 for k in range(4)]
CASES = {
    "straight": (
        [routing.Straight(0.02 * np.cos(a), 0.02 * np.sin(a)) for a in QUARTERS],
        lambda T: [
            oracle.polynomial([0.02 * np.cos(a)], [0.02 * np.sin(a)], L, t)
            for a, t in zip(QUARTERS, T, strict=True)
        ],
    ),
    "tapered": (
        [routing.Tapered(0.02, 0.008, a) for a in QUARTERS],
        lambda T: [
            oracle.polynomial(
                [0.02 * np.cos(a), -0.012 * np.cos(a)], [0.02 * np.sin(a), -0.012 * np.sin(a)], L, t
            )
            for a, t in zip(QUARTERS, T, strict=True)
        ],
    ),
    "helical": (
        [routing.Helical(0.02, a, 1.0) for a in QUARTERS],
        lambda T: [oracle.helix(0.02, a, 1.0, L, t) for a, t in zip(QUARTERS, T, strict=True)],
    ),
    "of all kinds, two end early": (
        [
            routing.Polynomial([0.01, 0.02, -0.03], [0.0, 0.015]),
            routing.Tapered(0.02, 0.01, np.pi / 2, end=0.4),
            routing.Helical(0.015, 3.0, -0.5, end=0.7),
            routing.FunctionRouting(lambda sigma: (0.004 + 0.01 * sigma**3, -0.02 + 0.0 * sigma)),
        ],
        lambda T: [
            oracle.polynomial([0.01, 0.02, -0.03], [0.0, 0.015], L, T[0]),
            oracle.polynomial([0.0], [0.02, -0.025], L, T[1], end=0.4),
            oracle.helix(0.015, 3.0, -0.5, L, T[2], end=0.7),
            oracle.polynomial([0.004, 0.0, 0.0, 0.01], [-0.02], L, T[3]),
        ],
    ),
}


@pytest.mark.parametrize(
    "tensions", [(8.0, 4.0, 0.0, 2.0), pytest.param((2.0, 0.0, 1.0, 0.5), marks=pytest.mark.campaign)]
)
@pytest.mark.parametrize("case", CASES)
def test_the_law_agrees_with_rucker_and_webster(case, tensions):
    routings, paths = CASES[case]
    expected = oracle.shape(ROD, paths(tensions))
    found = shape(ROD, routings, np.array(tensions))
    np.testing.assert_allclose(found[:12], expected[:12], atol=1e-8)
    np.testing.assert_allclose(found[12:], expected[12:], atol=1e-8)
    assert np.linalg.norm(found[:3] - [0.0, 0.0, L]) > 5e-3


@pytest.mark.slow
def test_a_soft_rod_that_its_tendons_compress():
    tensions = np.array([4.0, 3.0, 3.5, 3.0])
    routings = [routing.Straight(0.006 * np.cos(a), 0.006 * np.sin(a)) for a in QUARTERS]
    paths = [
        oracle.polynomial([0.006 * np.cos(a)], [0.006 * np.sin(a)], 0.2, t)
        for a, t in zip(QUARTERS, tensions, strict=True)
    ]
    expected, found = oracle.shape(SOFT, paths), shape(SOFT, routings, tensions)
    assert 0.7 < expected[14] < 0.85
    np.testing.assert_allclose(found[:12], expected[:12], atol=1e-8)
