"""Where tendons run: derivatives against differences, stacking, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
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


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: Straight(20.0, 0.0), r"Straight: x must be between -1 and 1 m \(got 20\)"),
        (lambda: Straight("left", 0.0), r"Straight: x must be a number .*'left'"),
        (lambda: Tapered(0.02, [0.01, 0.0]), r"Tapered: end_offset must be a number .*\(got \[0.01, 0\]\)"),
        (lambda: Helical(-0.01, 0.0, 1.0), r"Helical: radius must be between 0 and 1 m \(got -0.01\)"),
        (lambda: Helical(0.01, 0.0, np.nan), r"Helical: turns must be .*\(got nan\)"),
        (lambda: Polynomial([], [0.0]), r"Polynomial: x must be a list .*\(got \[\]\)"),
        (lambda: Straight(0.0, 0.0, end=0.0), r"Straight: end must be between 0.001 and 1 \(got 0\)"),
        (lambda: Straight(0.0, 0.0, end=1.2), r"Straight: end must be .*\(got 1.2\)"),
        (lambda: Straight(0.0, 0.0, end="tip"), r"Straight: end must be .*'tip'"),
        (lambda: Straight(0.0, 0.0, end=True), r"Straight: end must be .*True"),
        (lambda: FunctionRouting(0.02), "FunctionRouting: function is 0.02; allowed is a JAX-traceable"),
        (lambda: FunctionRouting(lambda sigma: sigma), "FunctionRouting: function gives shapes"),
        (lambda: FunctionRouting(lambda sigma: (sigma, [0.0])), "FunctionRouting: function"),
        (lambda: FunctionRouting(lambda sigma: (float(sigma), 0.0)), "function raises Concretization"),
    ],
)
def test_what_is_refused(wrong, message):
    with pytest.raises(kc.robots.ParameterError, match=message) as caught:
        wrong()
    assert "\n" not in str(caught.value)
