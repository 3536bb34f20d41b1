"""What is known at nodes, between them: no interpolation goes over a cut, and a scheme keeps its order."""

import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings

import knode_cosserat as kc
from benchmarks.motions import soft_rod
from knode_cosserat.solvers.between import along_pieces
from knode_cosserat.solvers.crossing import points_of
from knode_cosserat.solvers.space import SCHEMES, middles

BEAM = {"length": 0.5, "radius": 0.005, "density": 1200.0, "youngs_modulus": 5e6}


def rod(cuts, nodes):
    """One whose section changes there."""
    return kc.SlenderRod(
        **BEAM, nodes=nodes, sections=tuple(kc.Stretch(end=cut, stiffness=[2.0]) for cut in cuts)
    )


@settings(max_examples=25, deadline=None)
@given(st.data(), st.sampled_from(["euler", "rk4"]))
def test_what_jumps_at_cuts_is_exact_on_both_sides(data, space):
    """Another polynomial in each stretch, cubic if this has four nodes; in y one that goes on."""
    nodes = data.draw(st.integers(15, 30))
    cuts = [data.draw(st.floats(0.6, 9.4).map(lambda x, n=nodes: x / (n - 1.0)))]
    on_node = data.draw(st.booleans())
    if on_node:
        cuts = [round(cuts[0] * (nodes - 1)) / (nodes - 1)]
    system = rod(cuts, nodes)
    random = np.random.default_rng(data.draw(st.integers(0, 1000)))
    ny, nz = system.y_layout.size, system.z_layout.size
    smooth, before, after = random.normal(size=(4, ny)), *random.normal(size=(2, 4, nz))
    few = int(np.ceil(cuts[0] * (nodes - 1) - 1e-9))
    before[few:] = 0.0
    smooth[few + on_node :] = 0.0

    def cubic(numbers, s):
        return np.stack([s**k for k in range(4)], axis=1) @ numbers

    s = np.linspace(0.0, 1.0, nodes)
    beyond = (s >= cuts[0] - 1e-12)[:, None]
    records = np.concatenate([cubic(smooth, s), np.where(beyond, cubic(after, s), cubic(before, s))], axis=1)
    points = points_of(system)
    places = (points.segment[:, None] + points.bounds) / (nodes - 1)
    places = np.stack([places[:, 0], places.mean(axis=1), places[:, 1]])
    far = places[1] > cuts[0]
    found = along_pieces(system, SCHEMES[space], jnp.asarray(records))
    for k, (each, at) in enumerate(zip(found, places, strict=True)):
        if k and not SCHEMES[space].uses_middle:
            continue
        np.testing.assert_allclose(each[:, :ny], cubic(smooth, at), atol=1e-9)
        expected = np.where(far[:, None], cubic(after, at), cubic(before, at))
        np.testing.assert_allclose(each[:, ny:], expected, atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(0.001, 0.999), max_size=6, unique=True), st.integers(2, 12))
def test_what_is_the_same_everywhere_stays_so(cuts, nodes):
    """However many cuts there are, and stretches without a node."""
    system = rod(sorted(cuts), nodes)
    width = system.y_layout.size + system.z_layout.size
    for space in SCHEMES.values():
        for each in along_pieces(system, space, jnp.full((nodes, width), 0.7)):
            np.testing.assert_allclose(each, 0.7, rtol=1e-12)
            assert each.shape == (len(points_of(system).segment), width)


def test_a_rod_without_cuts_is_as_its_nodes_and_middles():
    records = jnp.asarray(np.random.default_rng(0).normal(size=(10, 25)))
    begin, middle, end = along_pieces(rod([], 10), SCHEMES["rk4"], records)
    np.testing.assert_array_equal(begin, records[:-1])
    np.testing.assert_array_equal(middle, middles(records))
    np.testing.assert_array_equal(end, records[1:])


def test_a_damped_motion_is_as_accurate_where_sections_change():
    """On a node, and between two. With one past for both sides it was a thousandth of the length."""
    robot = soft_rod(0.3, 0.617)
    coarse, fine = (
        kc.simulate(robot.replace(nodes=nodes), np.zeros((15, 0)), 0.02, space="rk4").tip_position
        for nodes in (21, 81)
    )
    assert np.max(np.abs(coarse - fine)) < 1e-5 * robot.length
