"""Segments on which something begins, ends or pulls: how they are parted, and carried over in pieces."""

import functools
import itertools

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as given_settings

import knode_cosserat as kc
from knode_cosserat.solvers.between import at_stages
from knode_cosserat.solvers.crossing import (
    Crossing,
    carried,
    crossings,
    parts_of,
    points_between,
    spread,
    taken,
)
from knode_cosserat.solvers.past import initial_past, rest_record
from knode_cosserat.solvers.problem import StepProblem
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import SCHEMES, SLOPES, VALUES

CUTS = st.lists(st.floats(1e-3, 1.0 - 1e-3), min_size=1, max_size=8, unique=True)


@given_settings(max_examples=300, deadline=None)
@given(CUTS, st.integers(2, 30))
def test_pieces_follow_each_other_from_base_to_tip(places, nodes):
    cuts = tuple(sorted(places))
    points = points_between(cuts, nodes)
    begin, end = (points.segment[:, None] + points.bounds).T
    # without a gap, none empty
    np.testing.assert_array_equal(end[:-1], begin[1:])
    assert begin[0] == 0.0 and end[-1] == nodes - 1 and np.all(end > begin)
    # nodes are where nodes are, and every cut acts once, where it is
    along = np.append(begin, nodes - 1)
    np.testing.assert_array_equal(along[points.nodes], np.arange(nodes))
    np.testing.assert_array_equal(
        np.sort(np.concatenate([points.nodes, points.between])), np.arange(len(along))
    )
    np.testing.assert_array_equal(points.acting.sum(axis=0), 1.0)
    at = begin[np.argmax(points.acting, axis=0)]
    np.testing.assert_allclose(at, np.array(cuts) * (nodes - 1), atol=1e-8)
    # no point but for a reason
    assert set(points.between.tolist()) <= set(np.flatnonzero(points.acting.any(axis=1)).tolist())


@given_settings(max_examples=15, deadline=None)
@given(CUTS, st.integers(2, 30))
def test_what_is_linear_along_the_rod_is_spread_exactly(places, nodes):
    points = points_between(tuple(sorted(places)), nodes)
    along = np.append(points.segment + points.bounds[:, 0], nodes - 1.0)
    found = spread(points, jnp.stack([2.0 * np.arange(nodes), 1.0 - np.arange(nodes)], axis=1))
    np.testing.assert_allclose(found, np.stack([2.0 * along, 1.0 - along], axis=1), atol=1e-12)


@given_settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 9), min_size=1, max_size=20))
def test_rows_are_taken_by_their_numbers(rows):
    values = jnp.arange(30.0).reshape(10, 3)
    np.testing.assert_array_equal(taken(values, np.array(rows)), np.asarray(values)[rows])


STIFFER = (kc.Stretch(end=0.1, stiffness=[2.0]), kc.Stretch(begin=0.105, stiffness=[0.8]))


@pytest.mark.parametrize("space", ["euler", pytest.param("rk4", marks=pytest.mark.campaign)])
@pytest.mark.parametrize(
    "changes",
    [
        pytest.param(
            {"sections": STIFFER, "loads": (kc.loads.AttachedMass(at=0.52, mass=0.01),)}, id="parted"
        ),
        pytest.param(
            {"loads": (kc.loads.AttachedMass(at=4 / 9, mass=0.01),)}, id="whole", marks=pytest.mark.campaign
        ),
    ],
)
def test_pieces_side_by_side_as_parts_one_after_the_other(space, changes):
    robot = kc.load_robot("delrin-routed-tendon-robot").replace(**{"sections": (), "loads": (), **changes})
    generator = np.random.default_rng(0)
    record = np.asarray(jax.jit(rest_record)(robot))
    y = record[:, : robot.y_layout.size] + 1e-2 * generator.normal(size=(robot.nodes, robot.y_layout.size))
    history = -20.0 * record + 1e-2 * generator.normal(size=record.shape)
    past = jax.jit(at_stages, static_argnums=1)(robot, SCHEMES[space], jnp.asarray(history))
    control = jnp.array([6.0, 7.0, 5.0, 6.0])
    problem = StepProblem(robot, jnp.zeros(()), control, jnp.array(20.0), past, SCHEMES[space])
    parts = parts_of(robot.cuts, robot.nodes)
    ds = robot.length / (robot.nodes - 1)

    def one(j, crossing, y_j, past):
        def rates(*at):
            return problem.point_rates(*at)[0]

        return carried(SCHEMES[space], rates, problem.crossed, crossing, (j * ds, ds), y_j, past)

    own = [
        (float(j), Crossing(bounds, acting), y[j], jnp.swapaxes(past, 0, 1)[parts[j]])
        for j, (bounds, acting) in enumerate(zip(*crossings(robot.cuts, robot.nodes), strict=True))
    ]
    value, slope = jax.jit(one), jax.jit(jax.jacfwd(one, argnums=2))
    scale = np.asarray(robot.scales().y)
    reached = np.stack([value(*each) for each in own]) / scale
    slopes = np.stack([slope(*each) for each in own])
    # piece by piece, from what the pieces before reached
    filled = jax.jit(lambda y: problem.filled(y))(jnp.asarray(y))
    points = problem.points
    np.testing.assert_array_equal(filled[points.nodes], y)
    values = jax.jit(lambda y: problem.pieces(VALUES, y))(filled)
    np.testing.assert_allclose(values[points.nodes[1:] - 1] / scale, reached, atol=1e-12)
    np.testing.assert_allclose(values[points.between - 1] / scale, filled[points.between] / scale, atol=1e-12)
    values, F = jax.jit(lambda y: problem.pieces(SLOPES, y))(filled)
    np.testing.assert_allclose(values[points.nodes[1:] - 1] / scale, reached, atol=1e-12)
    found = [
        functools.reduce(lambda before, after: after @ before, F[j:k])
        for j, k in itertools.pairwise(points.nodes)
    ]
    natural = scale / scale[:, None]
    np.testing.assert_allclose(found * natural, slopes * natural, rtol=1e-9, atol=1e-9)


class RememberingSlopes(kc.SlenderRod):
    """The same rod, as if its equations asked for the past of y_s."""

    mixed = True


def test_what_remembers_slopes_too_begins_with_those_of_its_nodes():
    beam = {"length": 0.5, "radius": 0.005, "density": 1200.0, "youngs_modulus": 1e8, "nodes": 8}
    plain, other = (
        rod(**beam, sections=(kc.Stretch(end=0.317, stiffness=[2.0]),))
        for rod in (kc.SlenderRod, RememberingSlopes)
    )
    begun = jax.jit(lambda rod: initial_past(rod, Settings(), rest_record(rod), jnp.zeros(0)))
    past = begun(other)
    # straight, and so alike all along
    np.testing.assert_allclose(past.records[0, 0, :, -plain.y_layout.size :][:, 2], 1.0, atol=1e-12)
    found, expected = (kc.simulate(rod, np.zeros((3, 0)), 0.02).y for rod in (other, plain))
    np.testing.assert_allclose(found, expected, atol=1e-9)


CLOSE = (1e-12, 9e-11, 2e-10, 9e-10, 2e-9)


@pytest.mark.parametrize(
    "off",
    [
        pytest.param(side * off, marks=() if side * off == 9e-10 else pytest.mark.campaign)
        for off in CLOSE
        for side in (-1, 1)
    ],
)
def test_a_cut_close_beside_a_node_costs_no_accuracy(off):
    """Taken to be on the node, and looked at from beyond where it is, it was of order 1."""

    def tip(at):
        rod = kc.SlenderRod(
            length=0.5, radius=0.005, density=1200.0, youngs_modulus=5e6, nodes=11,
            sections=(kc.Stretch(begin=at, stiffness=[0.2]),),
            loads=(kc.loads.PointWrench(force=[0.1, 0.0, 0.0]),),
        )  # fmt: skip
        return kc.equilibrium(rod, np.zeros(0), space="rk4").tip_position[-1]

    np.testing.assert_allclose(tip(0.5 + off), tip(0.5), atol=2e-8)
