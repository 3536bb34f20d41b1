"""Segments on which something begins, ends or pulls: how they are parted, and shared out among rounds."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

import knode_cosserat as kc
from knode_cosserat.solvers.crossing import Crossing, carried, crossings, rounds_of, taken
from knode_cosserat.solvers.march import rest_record
from knode_cosserat.solvers.problem import StepProblem
from knode_cosserat.solvers.space import SCHEMES, SLOPES, VALUES, middles

CUTS = st.lists(st.floats(1e-3, 1.0 - 1e-3), min_size=1, max_size=8, unique=True)


@settings(max_examples=300, deadline=None)
@given(CUTS, st.integers(2, 30))
def test_every_part_has_its_turn_after_the_one_before_it(places, nodes):
    cuts = tuple(sorted(places))
    bounds, acting = crossings(cuts, nodes)
    shared = rounds_of(cuts, nodes)
    parts = [[each for each in np.stack([row[:-1], row[1:]], axis=1) if each[1] > each[0]] for row in bounds]
    assert len(shared.segment) == max(map(len, parts))
    for j, own in enumerate(parts):
        last, place = divmod(shared.last[j], shared.segment.shape[1])
        first = last - len(own) + 1
        turns = slice(first, last + 1)
        assert np.all(shared.segment[turns, place] == j)
        np.testing.assert_array_equal(shared.begins[turns, place], [True, *[False] * (len(own) - 1)])
        np.testing.assert_array_equal(shared.bounds[turns, place], own)
        np.testing.assert_array_equal(shared.acting[turns, place], acting[j, : len(own)])
    # what is left over has nothing to do
    busy = np.sum(shared.bounds[..., 1] > shared.bounds[..., 0])
    assert busy == sum(map(len, parts)) and np.sum(shared.acting) == len(cuts)
    # and there is less of it than a place per segment that is parted
    assert shared.segment.size - busy < len(shared.segment) * (1 + sum(len(own) > 1 for own in parts))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 9), min_size=1, max_size=20))
def test_rows_are_taken_by_their_numbers(rows):
    values = jnp.arange(30.0).reshape(10, 3)
    np.testing.assert_array_equal(taken(values, np.array(rows)), np.asarray(values)[rows])


STIFFER = (kc.Stretch(end=0.1, stiffness=[2.0]), kc.Stretch(begin=0.105, stiffness=[0.8]))


@pytest.mark.parametrize("space", ["euler", "rk4"])
@pytest.mark.parametrize(
    "changes",
    [
        {"sections": STIFFER, "loads": (kc.loads.AttachedMass(at=0.52, mass=0.01),)},
        {"loads": (kc.loads.AttachedMass(at=4 / 9, mass=0.01),)},
    ],
    ids=["parted", "whole"],
)
def test_side_by_side_as_one_after_the_other(space, changes):
    robot = kc.load_robot("delrin-routed-tendon-robot").replace(**{"sections": (), "loads": (), **changes})
    generator = np.random.default_rng(0)
    record = np.asarray(rest_record(robot))
    y = record[:, : robot.y_layout.size] + 1e-2 * generator.normal(size=(robot.nodes, robot.y_layout.size))
    history = -20.0 * record + 1e-2 * generator.normal(size=record.shape)
    problem = StepProblem(
        robot, jnp.zeros(()), jnp.array([6.0, 7.0, 5.0, 6.0]), jnp.array(20.0), jnp.asarray(history),
        SCHEMES[space],
    )  # fmt: skip
    inner = middles(history) if SCHEMES[space].uses_middle else history[:-1]
    ds = robot.length / (robot.nodes - 1)

    def one(j, crossing, y_j, past):
        def rates(*at):
            return problem.point_rates(*at)[0]

        return carried(SCHEMES[space], rates, problem.crossed, crossing, (j * ds, ds), y_j, past)

    own = [
        (float(j), Crossing(bounds, acting), y[j], (history[j], inner[j], history[j + 1]))
        for j, (bounds, acting) in enumerate(zip(*crossings(robot.cuts, robot.nodes), strict=True))
    ]
    value, slope = jax.jit(one), jax.jit(jax.jacfwd(one, argnums=2))
    scale = np.asarray(robot.scales().y)
    reached = np.stack([value(*each) for each in own]) / scale
    slopes = np.stack([slope(*each) for each in own])
    values = jax.jit(lambda y: problem.segments(VALUES, y))(y)
    np.testing.assert_allclose(values / scale, reached, atol=1e-12)
    values, found = jax.jit(lambda y: problem.segments(SLOPES, y))(y)
    np.testing.assert_allclose(values / scale, reached, atol=1e-12)
    natural = scale / scale[:, None]
    np.testing.assert_allclose(found * natural, slopes * natural, rtol=1e-9, atol=1e-9)
