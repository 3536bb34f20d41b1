"""What is known at nodes, between them: no interpolation goes over a cut, and a scheme keeps its order."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings

import knode_cosserat as kc
from knode_cosserat.solvers.between import at_stages
from knode_cosserat.solvers.crossing import points_of
from knode_cosserat.solvers.space import SCHEMES

BEAM = {"length": 0.5, "radius": 0.005, "density": 1200.0, "youngs_modulus": 5e6}

stages_of = jax.jit(at_stages, static_argnums=1)


def rod(cuts, nodes):
    """One whose section changes there."""
    return kc.SlenderRod(
        **BEAM, nodes=nodes, sections=tuple(kc.Stretch(end=cut, stiffness=[2.0]) for cut in cuts)
    )


@settings(max_examples=12, deadline=None)
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
    begin, end = ((points.segment + points.bounds[:, k]) / (nodes - 1) for k in (0, 1))
    found = stages_of(system, SCHEMES[space], jnp.asarray(records))
    for stage, part in zip(found, SCHEMES[space].parts, strict=True):
        at = np.append(begin + part * (end - begin), 1.0)
        far = np.append(begin, 1.0) >= cuts[0] - 1e-12
        np.testing.assert_allclose(stage[:, :ny], cubic(smooth, at), atol=1e-9)
        expected = np.where(far[:, None], cubic(after, at), cubic(before, at))
        np.testing.assert_allclose(stage[:, ny:], expected, atol=1e-9)


@settings(max_examples=8, deadline=None)
@given(st.lists(st.floats(0.001, 0.999), max_size=6, unique=True), st.integers(2, 12))
def test_what_is_the_same_everywhere_stays_so(cuts, nodes):
    """However many cuts there are, and stretches without a node."""
    system = rod(sorted(cuts), nodes)
    width = system.y_layout.size + system.z_layout.size
    for space in SCHEMES.values():
        found = stages_of(system, space, jnp.full((nodes, width), 0.7))
        np.testing.assert_allclose(found, 0.7, rtol=1e-12)
        assert found.shape == (len(space.parts), len(points_of(system).segment) + 1, width)


def test_where_stages_are_at_nodes_they_are_as_those():
    records = jnp.asarray(np.random.default_rng(0).normal(size=(10, 25)))
    start, middle, again, end = stages_of(rod([], 10), SCHEMES["rk4"], records)
    np.testing.assert_array_equal(start, records)
    np.testing.assert_array_equal(middle, again)
    np.testing.assert_array_equal(end, [*records[1:], records[-1]])
