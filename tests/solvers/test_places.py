"""Poses between nodes: the order at which their error shrinks, and what the line between nodes had."""

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.robots import Drawing
from knode_cosserat.solvers.places import Places, places_at, positions_at

#: a third or two thirds of the way between two nodes, on each grid below
FRACTIONS = np.array([1, 2, 4, 5]) / 6
TENSION = np.array([12.0, 2.0, 3.0, 9.0])
GRIDS = (5, 9, 17)


def solved(nodes):
    robot = kc.load_robot("delrin-tendon-robot").replace(nodes=nodes)
    return kc.equilibrium(robot, TENSION, space="lobatto4")


def line(rest, places: Places):
    """As it was before: on the line between two nodes."""
    p = np.asarray(rest.position)
    part = places.part[:, None]
    return (1.0 - part) * p[:, places.node] + part * p[:, places.node + 1]


@pytest.fixture(scope="module")
def errors():
    """Largest errors (m) on each grid: on lines, by y alone, by y and z; against all nodes of a fine grid."""
    fine = solved(97)
    truth = np.asarray(fine.position)[:, np.round(96 * FRACTIONS).astype(int)]
    found = []
    for nodes in GRIDS:
        rest = solved(nodes)
        places = places_at(FRACTIONS, nodes)
        each = (
            line(rest, places),
            positions_at(rest.system, rest.y, places),
            positions_at(rest.system, rest.y, places, rest.z),
        )
        found.append([float(np.linalg.norm(np.asarray(one) - truth, axis=-1).max()) for one in each])
    return np.array(found)


@pytest.mark.slow
def test_a_body_between_nodes_has_no_error_of_second_order(errors):
    orders = np.log2(errors[:-1] / errors[1:])
    lines, by_y, by_z = errors.T
    # the line is off by L² κ / 8 of a segment's length L and curvature κ
    assert orders[:, 0].mean() == pytest.approx(2.0, abs=0.1)
    assert np.all(orders[:, 2] > 3.5)
    # at 9 nodes
    assert lines[1] > 1e-3 and by_z[1] < 0.02 * lines[1] and by_y[1] < 0.05 * lines[1]


@pytest.mark.slow
def test_nodes_are_as_they_are():
    rest = solved(9)
    places = places_at(np.linspace(0.0, 1.0, 9), 9)
    np.testing.assert_allclose(positions_at(rest.system, rest.y, places), rest.position, atol=1e-15)


@pytest.mark.slow
def test_it_is_differentiable():
    rest = solved(9)
    places, y = places_at(FRACTIONS, 9), np.asarray(rest.y)

    def along(t):
        return positions_at(rest.system, y + t * np.cos(np.arange(y.size)).reshape(y.shape), places)

    slope = jax.jacfwd(along)(0.0)
    step = 1e-6
    np.testing.assert_allclose(slope, (along(step) - along(-step)) / (2 * step), rtol=1e-6, atol=1e-7)


def test_several_rods_have_a_line():
    platform = kc.load_robot("six-legged-robot")
    rest = [platform.rest(s)[0] for s in np.linspace(0.0, 1.0, platform.nodes) * np.asarray(platform.length)]
    y = np.array(rest)[None]
    places = places_at(np.array([0.33]), platform.nodes)
    p = np.asarray(Drawing.of(platform).positions(y))
    part = places.part[:, None]
    expected = (1.0 - part) * p[:, places.node] + part * p[:, places.node + 1]
    np.testing.assert_allclose(positions_at(platform, y, places), expected, atol=1e-15)
