"""Points and places along a rod with discontinuities, and the scheme's equations over its pieces."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as given_settings

import knode_cosserat as kc
from knode_cosserat.schemes.grid import Grid, at_places, grid_of, take_rows
from knode_cosserat.schemes.problem import StepProblem
from knode_cosserat.schemes.settings import schemes
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers import Settings
from knode_cosserat.solvers.rest import constant_history, rest_record

SCHEMES = {name: scheme() for name, scheme in schemes(SpaceScheme).items()}
CUTS = st.lists(st.floats(1e-3, 1.0 - 1e-3), min_size=1, max_size=8, unique=True)
#: of a scheme with two stages between the ends of a piece
STAGES = (0.25, 0.5)


@given_settings(max_examples=300, deadline=None)
@given(CUTS, st.integers(2, 30))
def test_pieces_follow_each_other_from_base_to_tip(places, nodes):
    cuts = tuple(sorted(places))
    grid = Grid(cuts, nodes, STAGES)
    begin, end = (grid.segment[:, None] + grid.bounds).T
    # without a gap, none empty
    np.testing.assert_array_equal(end[:-1], begin[1:])
    assert begin[0] == 0.0 and end[-1] == nodes - 1 and np.all(end > begin)
    # nodes are where nodes are, and every cut acts once, where it is
    along = np.append(begin, nodes - 1)
    np.testing.assert_array_equal(along[grid.nodes], np.arange(nodes))
    np.testing.assert_array_equal(np.sort(np.concatenate([grid.nodes, grid.between])), np.arange(len(along)))
    np.testing.assert_array_equal(grid.acting.sum(axis=0), 1.0)
    at = begin[np.argmax(grid.acting, axis=0)]
    np.testing.assert_allclose(at, np.array(cuts) * (nodes - 1), atol=1e-8)
    # no point but for a reason
    assert set(grid.between.tolist()) <= set(np.flatnonzero(grid.acting.any(axis=1)).tolist())


@given_settings(max_examples=200, deadline=None)
@given(CUTS, st.integers(2, 30))
def test_every_piece_has_places_of_its_own(places, nodes):
    """At its start on the far side of a discontinuity, at its end on the near side, and at the stages."""
    grid = Grid(tuple(sorted(places)), nodes, STAGES)
    found = grid.places_of(np.arange(grid.tip))
    assert found.shape == (grid.tip, 2 + len(STAGES))
    # every place is used, and shared only where the rod is smooth
    np.testing.assert_array_equal(np.unique(found), np.arange(grid.count))
    np.testing.assert_array_equal(found[:, 0], np.arange(grid.tip))
    smooth = ~grid.acting[1:].any(axis=1)
    np.testing.assert_array_equal(found[:-1, 1] == found[1:, 0], smooth)
    # pieces of each segment, without gaps
    for j, own in enumerate(grid.parts):
        np.testing.assert_array_equal(np.unique(own), np.arange(grid.nodes[j], grid.nodes[j + 1]))


@given_settings(max_examples=15, deadline=None)
@given(CUTS, st.integers(2, 30))
def test_what_is_linear_along_the_rod_is_spread_exactly(places, nodes):
    grid = Grid(tuple(sorted(places)), nodes, ())
    along = np.append(grid.segment + grid.bounds[:, 0], nodes - 1.0)
    found = grid.spread(jnp.stack([2.0 * np.arange(nodes), 1.0 - np.arange(nodes)], axis=1))
    np.testing.assert_allclose(found, np.stack([2.0 * along, 1.0 - along], axis=1), atol=1e-12)


@given_settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 9), max_size=20))
def test_rows_are_taken_by_their_numbers(rows):
    values = jnp.arange(30.0).reshape(10, 3)
    np.testing.assert_array_equal(
        take_rows(values, np.array(rows, dtype=int)), np.asarray(values)[np.array(rows, dtype=int)]
    )


# interpolation between nodes

BEAM = {"length": 0.5, "radius": 0.005, "density": 1200.0, "youngs_modulus": 5e6}

interpolated = jax.jit(at_places, static_argnums=1)


def changing(cuts, nodes):
    """A rod whose section changes at these parts of its length."""
    return kc.robots.SlenderRod(
        **BEAM, nodes=nodes, sections=tuple(kc.robots.Stretch(end=cut, stiffness=[2.0]) for cut in cuts)
    )


def where(grid, space):
    """Places of a grid, in segments, and the piece that each belongs to."""
    pieces, begin = np.arange(grid.tip), grid.segment + grid.bounds[:, 0]
    end, stages = grid.segment + grid.bounds[:, 1], [stage.place for stage in space.check.stages]
    at = [begin, end[-1:], end[grid.near - 1], *(begin + c * (end - begin) for c in stages)]
    piece = [pieces, pieces[-1:], pieces[grid.near - 1], *(pieces for _ in stages)]
    return np.concatenate(at), np.concatenate(piece)


@given_settings(max_examples=12, deadline=None)
@given(st.data(), st.sampled_from(["lobatto2", "lobatto4"]))
def test_what_jumps_at_discontinuities_is_exact_on_both_sides(data, name):
    """Another polynomial in each stretch, cubic if this has four nodes; in y one that goes on."""
    space = SCHEMES[name]
    nodes = data.draw(st.integers(15, 30))
    cut = data.draw(st.floats(0.6, 9.4)) / (nodes - 1.0)
    on_node = data.draw(st.booleans())
    if on_node:
        cut = round(cut * (nodes - 1)) / (nodes - 1)
    system = changing([cut], nodes)
    random = np.random.default_rng(data.draw(st.integers(0, 1000)))
    ny, nz = system.y_layout.size, system.z_layout.size
    smooth, before, after = random.normal(size=(4, ny)), *random.normal(size=(2, 4, nz))
    few = int(np.ceil(cut * (nodes - 1) - 1e-9))
    before[few:] = 0.0
    smooth[few + on_node :] = 0.0

    def cubic(numbers, s):
        return np.stack([s**k for k in range(4)], axis=1) @ numbers

    s = np.linspace(0.0, 1.0, nodes)
    beyond = (s >= cut - 1e-12)[:, None]
    records = np.concatenate([cubic(smooth, s), np.where(beyond, cubic(after, s), cubic(before, s))], axis=1)
    grid = grid_of(system, space)
    at, piece = where(grid, space)
    at = at / (nodes - 1)
    far = (grid.segment + grid.bounds.mean(axis=1))[piece] / (nodes - 1) > cut
    found = interpolated(system, space, jnp.asarray(records))
    np.testing.assert_allclose(found[:, :ny], cubic(smooth, at), atol=1e-9)
    expected = np.where(far[:, None], cubic(after, at), cubic(before, at))
    np.testing.assert_allclose(found[:, ny:], expected, atol=1e-9)


@given_settings(max_examples=8, deadline=None)
@given(st.lists(st.floats(0.001, 0.999), max_size=6, unique=True), st.integers(2, 12))
def test_what_is_the_same_everywhere_stays_so(cuts, nodes):
    """However many discontinuities there are, and stretches without a node."""
    system = changing(sorted(cuts), nodes)
    width = system.y_layout.size + system.z_layout.size
    for space in SCHEMES.values():
        found = at_places(system, space, jnp.full((nodes, width), 0.7))
        np.testing.assert_allclose(found, 0.7, rtol=1e-12)
        assert found.shape == (grid_of(system, space).count, width)


def test_where_places_are_nodes_they_are_as_those():
    records = jnp.asarray(np.random.default_rng(0).normal(size=(10, 25)))
    found = at_places(changing([], 10), SCHEMES["lobatto4"], records)
    np.testing.assert_array_equal(found[:10], records)


# equations over pieces

STIFFER = (kc.robots.Stretch(end=0.1, stiffness=[2.0]), kc.robots.Stretch(begin=0.105, stiffness=[0.8]))


def one_piece(problem):
    """Return a function of y at both ends of a piece, and what else it needs: y at its end by the scheme."""
    formula = problem.space.formula

    def reached(start, end, acting, s, h, history):
        def rates(k, y):
            return problem.point_rates(s[k], y, history[k])[0]

        far = (
            problem.jump(acting, start, history[0])
            if problem.system.discontinuities.jump is not None
            else start
        )
        f = [rates(0, far), rates(1, end)]
        for k, stage in enumerate(formula.stages):
            moved = sum(x * rate for x, rate in zip(stage.rates, f, strict=True))
            f.append(rates(2 + k, (1.0 - stage.end) * far + stage.end * end + h * moved))
        return far + h * sum(b * rate for b, rate in zip(formula.weights, f, strict=True))

    return reached


@pytest.mark.campaign
@pytest.mark.parametrize(
    "space", ["lobatto2", *(pytest.param(name, marks=pytest.mark.campaign) for name in ("lobatto4", "euler"))]
)
@pytest.mark.parametrize(
    "changes",
    [
        pytest.param(
            {"sections": STIFFER, "loads": (kc.robots.loads.AttachedMass(at=0.52, mass=0.01),)}, id="parted"
        ),
        pytest.param(
            {"loads": (kc.robots.loads.AttachedMass(at=4 / 9, mass=0.01),)},
            id="whole",
            marks=pytest.mark.campaign,
        ),
    ],
)
def test_pieces_side_by_side_as_one_after_the_other(space, changes):
    """Values, and derivatives by y at the ends."""
    space = SCHEMES[space]
    robot = kc.load_robot("delrin-routed-tendon-robot").replace(**{"sections": (), "loads": (), **changes})
    generator = np.random.default_rng(0)
    record = np.asarray(jax.jit(rest_record)(robot))
    y = record[:, : robot.y_layout.size] + 1e-2 * generator.normal(size=(robot.nodes, robot.y_layout.size))
    history = -20.0 * record + 1e-2 * generator.normal(size=record.shape)
    past = jax.jit(at_places, static_argnums=1)(robot, space, jnp.asarray(history))
    control = jnp.array([6.0, 7.0, 5.0, 6.0])
    problem = StepProblem(robot, jnp.zeros(()), control, jnp.array(20.0), past, space)
    grid, scale = problem.grid, np.asarray(robot.scales().y)

    def everything(nodes):
        y = problem.filled(nodes)
        moves = jnp.asarray(np.random.default_rng(1).normal(size=y.shape) * scale)
        return y, moves, *jax.jvp(problem.reached, (y,), (moves,))

    y_points, moves, ends, slopes = jax.jit(everything)(jnp.asarray(y))
    np.testing.assert_array_equal(y_points[grid.nodes], y)
    np.testing.assert_allclose(ends[grid.between - 1] / scale, y_points[grid.between] / scale, atol=1e-12)

    places = grid.places_of(np.arange(grid.tip))
    given = (
        y_points[:-1],
        y_points[1:],
        jnp.asarray(grid.acting),
        problem.places[places],
        problem.lengths()[:, 0],
        past[places],
    )
    one = one_piece(problem)
    np.testing.assert_allclose(jax.jit(jax.vmap(one))(*given) / scale, ends / scale, atol=1e-12)
    by_start, by_end = jax.jit(jax.vmap(jax.jacfwd(one, argnums=(0, 1))))(*given)
    wanted = sum(np.einsum("jab,jb->ja", *pair) for pair in ((by_start, moves[:-1]), (by_end, moves[1:])))
    np.testing.assert_allclose(slopes / scale, wanted / scale, rtol=1e-9, atol=1e-9)


class RememberingSlopes(kc.robots.SlenderRod):
    """The same rod, as if its equations asked for the history of y_s."""

    mixed = True


@pytest.mark.campaign
def test_a_history_of_slopes_begins_with_those_of_its_places():
    beam = {"length": 0.5, "radius": 0.005, "density": 1200.0, "youngs_modulus": 1e8, "nodes": 8}
    plain, other = (
        rod(**beam, sections=(kc.robots.Stretch(end=0.317, stiffness=[2.0]),))
        for rod in (kc.robots.SlenderRod, RememberingSlopes)
    )
    begun = jax.jit(lambda rod: constant_history(rod, Settings(), rest_record(rod), jnp.zeros(0)))
    past = begun(other)
    # straight, and so alike all along
    np.testing.assert_allclose(past.records[0, :, -plain.y_layout.size :][:, 2], 1.0, atol=1e-12)
    found, expected = (
        kc.simulate(rod, np.zeros((3, 0)), 0.02, initial="unstressed") for rod in (other, plain)
    )
    np.testing.assert_allclose(found.y, expected.y, atol=1e-9)
    # what is kept of slopes is not used, in the error neither
    np.testing.assert_allclose(found.position_error, expected.position_error, rtol=1e-6)


CLOSE = (1e-12, 9e-11, 2e-10, 9e-10, 2e-9)


@pytest.mark.campaign
@pytest.mark.parametrize("off", [side * off for off in CLOSE for side in (-1, 1)])
def test_a_discontinuity_close_beside_a_node_costs_no_accuracy(off):
    """Taken to be on the node, and looked at from beyond where it is, it was of order 1."""

    def tip(at):
        rod = kc.robots.SlenderRod(
            length=0.5,
            radius=0.005,
            density=1200.0,
            youngs_modulus=5e6,
            nodes=11,
            sections=(kc.robots.Stretch(begin=at, stiffness=[0.2]),),
            loads=(kc.robots.loads.PointWrench(force=[0.1, 0.0, 0.0]),),
        )
        return kc.equilibrium(rod, np.zeros(0), space="lobatto4").tip_position[-1]

    np.testing.assert_allclose(tip(0.5 + off), tip(0.5), atol=2e-8)
