"""Where tendons run: derivatives against differences, stacking, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.parameters import kinds_of
from knode_cosserat.rods.routing import (
    FunctionRouting,
    Helical,
    Polynomial,
    RoutedPaths,
    Routing,
    Straight,
    Tapered,
    routes,
)

L = 0.4
ROUTINGS = [
    Straight(0.02, -0.01),
    Tapered(0.02, 0.005, 1.0, end=0.5),
    Helical(0.015, 0.3, -1.5, end=0.8),
    Polynomial([0.01, 0.02, -0.03], [0.005]),
    FunctionRouting(lambda sigma: (0.01 * jnp.sin(5 * sigma), 0.02 * sigma**2)),
]


def test_routes_are_where_each_routing_says():
    r, _ = routes(ROUTINGS, 0.5, L)
    angle = 0.3 - 1.5 * np.pi
    expected = [
        [0.02, -0.01, 0.0],
        [0.005 * np.cos(1.0), 0.005 * np.sin(1.0), 0.0],
        [0.015 * np.cos(angle), 0.015 * np.sin(angle), 0.0],
        [0.01 + 0.01 - 0.0075, 0.005, 0.0],
        [0.01 * np.sin(2.5), 0.005, 0.0],
    ]
    np.testing.assert_allclose(r, expected, rtol=0, atol=1e-16)
    assert RoutedPaths(ROUTINGS, 1.0).ends == (1.0, 0.5, 0.8, 1.0, 1.0)


def test_derivatives_are_those_along_the_rod():
    at = jax.jit(lambda s: routes(ROUTINGS, s / L, L))
    for s in (0.0, 0.1, 0.37):
        h = 1e-5
        differences = (np.asarray(at(s + h)[0]) - np.asarray(at(s - h)[0])) / (2 * h)
        np.testing.assert_allclose(at(s)[1], differences, rtol=0, atol=1e-8)


def test_straight_tendons_are_constants_of_every_program():
    four = [Straight(0.02 * np.cos(k), 0.02 * np.sin(k)) for k in range(4)]
    program = jax.make_jaxpr(lambda sigma: routes(four, sigma, L))(0.3)
    assert not program.eqns
    r, r_s = routes(four, 0.3, L)
    assert r.shape == (4, 3) and not np.any(r_s)


def test_offsets_have_slopes():
    def place(offset):
        return routes([Tapered(offset, 0.0, 0.0), Straight(offset, 0.0)], 0.25, L)[0][:, 0]

    np.testing.assert_allclose(jax.jacfwd(place)(0.02), [0.75, 1.0])


def test_kinds_are_named_once_each():
    assert list(kinds_of(Routing)) == ["helical", "polynomial", "straight", "tapered"]
    assert not FunctionRouting.kind
