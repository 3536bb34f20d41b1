"""Emitted tangents of motions: differences of motions, and the linearised equations in JAX."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.engine import loops
from knode_cosserat.engine.pattern import Pattern
from knode_cosserat.estimation.online import OnlineModel
from knode_cosserat.estimation.parameters import Adapted, adapted_model
from knode_cosserat.rods.loads import AttachedMass, PointWrench
from knode_cosserat.rods.strands import strand_count
from knode_cosserat.rods.system import Discontinuities
from knode_cosserat.schemes.history import StepCoefficients, history_of
from knode_cosserat.schemes.problem import StepProblem
from knode_cosserat.schemes.settings import NewtonOptions, Settings
from knode_cosserat.schemes.space import LOBATTO2
from knode_cosserat.solvers import rollout, sensitivity
from knode_cosserat.solvers.rest import resting_history, unloaded_shape
from knode_cosserat.solvers.run import TimeIntegration
from knode_cosserat.solvers.sensitivity import Changes, TangentState, tangent_time_loop
from tests.engine.networks import with_committee, with_network
from tests.engine.test_core import LEGS, Stretching, displacements, standing_history
from tests.engine.test_program import with_curved_law

DT, STEPS, COLUMNS = 0.05, 6, 11
PAPER, ROUTED, CURVED = "delrin-tendon-robot", "delrin-routed-tendon-robot", "variable-curvature-robot"
NETWORK, COMMITTEE, STRUCTURED = "network of 512 units", "committee", "structured"
BAR, CUT_LEGS = "bar", "six legs with discontinuities"


def campaign(*cases):
    """Cases whose kinds are in the others, too."""
    return [pytest.param(*case, marks=pytest.mark.campaign) for case in cases]


#: robots and schemes of which the places between ends, y_s, and several strands enter
SPACES = [
    (ROUTED, "sdirk2", "lobatto4"), (BAR, "bdf-alpha", "lobatto4"), (PAPER, "bdf2", "euler"),
    (CUT_LEGS, "bdf2", "lobatto4"), *campaign((LEGS, "bdf-alpha", "lobatto2")),
    *campaign((ROUTED, "sdirk2", "lobatto2"), (ROUTED, "bdf-alpha", "lobatto2")),
]  # fmt: skip


class CutLegs(kc.robots.ParallelRobot):
    """Legs with places of discontinuity, of which one lies on a node."""

    discontinuities = Discontinuities((0.37, 5 / 9))


def cut_legs():
    robot = kc.load_robot(LEGS)
    return CutLegs(**{name: getattr(robot, name) for name in robot.parameters()}, nodes=robot.nodes)


class Motion:
    """A motion under random controls, and random tangents of its history, controls and all parameters."""

    def __init__(self, name, scheme, space="lobatto2", **changes):
        rng = np.random.default_rng(0)
        own = {
            NETWORK: functools.partial(with_network, 512, history=True),
            COMMITTEE: with_committee,
            STRUCTURED: with_curved_law,
            BAR: Stretching,
            CUT_LEGS: cut_legs,
        }
        robot = own[name]() if name in own else kc.load_robot(name).replace(**changes)
        self.robot, self.settings = robot, Settings.of(scheme, space, "paper", NewtonOptions())
        self.steps = StepCoefficients.of(self.settings, DT)
        start = resting_history if strand_count(robot) == 1 else standing_history
        self.past = jax.tree.map(np.asarray, start(robot, self.settings))
        low, high = (2.0, 5.0) if name != CURVED else (0.2, 0.5)
        self.controls = rng.uniform(low, high, (STEPS, robot.control_layout.size))
        if strand_count(robot) > 1:
            self.controls = displacements()[0, :STEPS]
        self.directions = jax.tree.map(lambda leaf: 0.1 * leaf * rng.normal(size=(3, *np.shape(leaf))), robot)
        self.weights = rng.normal(size=(3, COLUMNS))
        self.d_controls = 0.1 * rng.normal(size=(*self.controls.shape, COLUMNS))
        used = self.past.error.shape[1]
        self.d_records = 1e-4 * rng.normal(size=(*self.past.records[:, :used].shape, COLUMNS))
        self.d_rate = 1e-4 * rng.normal(size=(*self.past.rate[:used].shape, COLUMNS))
        self.solved = self.rows()[1].every_stage

    def rows(self, column=0, part=0.0):
        """Return the state after the motion with a part of a column's tangents added, and its rows."""
        system = jax.tree.map(
            lambda leaf, moves: leaf + part * np.tensordot(self.weights[:, column], moves, 1),
            self.robot,
            self.directions,
        )
        records, rate = np.array(self.past.records), np.array(self.past.rate)
        used = self.d_rate.shape[0]
        records[:, :used] += part * self.d_records[..., column]
        rate[:used] += part * self.d_rate[..., column]
        past = self.past._replace(records=records, rate=rate)
        controls = self.controls + part * self.d_controls[..., column]
        done, after, rows = loops.solve_steps(system, self.steps, controls, past, (0, STEPS))
        assert done == STEPS
        return after, rows

    @property
    def given(self):
        past, used = self.past, self.d_rate.shape[0]
        state = TangentState(past.records[:, :used], past.rate[:used], self.d_records, self.d_rate, past.t0)
        changes = Changes(self.d_controls, self.directions, self.weights)
        return self.steps, self.solved, (self.robot, self.controls), changes, state


@pytest.mark.parametrize(
    ("name", "scheme", "space"),
    [
        (PAPER, "bdf-alpha", "lobatto2"),
        (CURVED, "bdf-alpha", "lobatto2"),
        (NETWORK, "bdf-alpha", "lobatto2"),
        *SPACES,
    ],
)
def test_tangents_are_differences_of_motions(name, scheme, space):
    motion, eps = Motion(name, scheme, space), 1e-4
    after, (d_rows, d_unknowns) = tangent_time_loop(*motion.given)
    assert d_rows.shape[-1] == d_unknowns.shape[-1] == COLUMNS
    for column in (0, COLUMNS - 1):
        ends, rows = zip(*(motion.rows(column, part) for part in (eps, -eps)), strict=True)
        used = len(after.d_rate)
        for own, pair in (
            (d_rows, [each.every_stage[0] for each in rows]),
            (d_unknowns, [each.every_stage[1] for each in rows]),
            (after.d_records, [end.records[:, :used] for end in ends]),
            (after.d_rate, [end.rate[:used] for end in ends]),
        ):
            wanted = (np.asarray(pair[0]) - np.asarray(pair[1])) / (2.0 * eps)
            # components have different units
            size = np.max(np.abs(wanted), axis=tuple(range(wanted.ndim - 1)))
            assert np.all(np.abs(own[..., column] - wanted) <= 1e-4 * size + 1e-12)


def test_a_parameter_that_is_zero_moves():
    """Zeros are constants of the code, except those that move: an unknown force at the tip."""
    motion, eps = Motion(PAPER, "sdirk2", loads=(PointWrench(),)), 1e-4
    leaves, tree = jax.tree.flatten(motion.robot)
    unit = jax.tree.leaves(motion.robot.replace(**{"loads.0.force": np.array([0.0, 1.0, 0.0])}))
    moves = [(np.asarray(b) - np.asarray(a))[None] for a, b in zip(leaves, unit, strict=True)]
    motion.directions, motion.weights = jax.tree.unflatten(tree, moves), np.ones((1, 1))
    for name in ("d_controls", "d_records", "d_rate"):
        setattr(motion, name, 0.0 * getattr(motion, name)[..., :1])
    _, (d_rows, _) = tangent_time_loop(*motion.given)
    above, below = (motion.rows(0, part)[1].every_stage[0] for part in (eps, -eps))
    wanted = (above - below) / (2.0 * eps)
    np.testing.assert_allclose(d_rows[..., 0], wanted, atol=1e-6 * np.max(np.abs(wanted)))


def test_an_adapted_zero_is_no_constant_of_the_code():
    """Otherwise the machine code would be compiled again in the loop, as soon as the zero moves."""
    robot = kc.load_robot(PAPER).replace(loads=(AttachedMass(mass=0.0),))
    model = OnlineModel(adapted_model(robot, [Adapted("loads.0.mass", 0.03)])[0].robot, DT)
    cores, still = [], np.zeros(robot.control_layout.size)
    for x in (0.0, 0.5):
        system = model.moved(np.array([x])).system
        cores.append(loops.core_of(Pattern.of(system), model.settings, robots=False))
        assert (
            model.task(1).solve(system, still[None], resting_history(system, model.settings), (0, 1))[0] == 1
        )
    assert cores[0]._functions is cores[1]._functions


def test_tangents_solve_the_linearised_equations():
    """The residuals of all stages, evaluated in JAX, stay zero along the tangents."""
    motion, k = Motion(PAPER, "sdirk2"), 0
    settings, robot, past = motion.settings, motion.robot, motion.past
    _, found = tangent_time_loop(*motion.given)
    solved, scales, ny = motion.solved, robot.scales(), robot.y_layout.size
    used = motion.d_rate.shape[0]

    def residuals(system, controls, records, rate, rows, unknowns):
        def stage(state, now):
            coefficients, t, control, y, xi = now
            history = history_of(*state, coefficients, settings)
            problem = StepProblem(system, t, control, coefficients[0], history, settings.space)
            defects, tip = problem.residuals(y)
            base, own = problem.base(xi) - y[0], problem.records(y)
            left = jnp.concatenate([base / scales.y, jnp.ravel(defects / scales.y), tip / scales.tip])
            return (jnp.stack([own, state[0][0]]), coefficients[0] * own + history), left

        tables, times = map(
            np.concatenate, zip(*(motion.steps.at(past.t0, i) for i in range(STEPS)), strict=True)
        )
        controls = jnp.repeat(jnp.asarray(controls), settings.stages, axis=0)
        return jax.lax.scan(stage, (records, rate), (tables, times, controls, rows[..., :ny], unknowns))[1]

    def places(values, moves, axis):
        """Return tangents at all places; those of the check stages do not enter."""
        whole = np.zeros(np.shape(values))
        whole[(slice(None),) * axis + (slice(used),)] = moves[..., k]
        return whole

    at = jax.tree.map(jnp.asarray, (robot, motion.controls, past.records, past.rate, *solved))
    along = (
        jax.tree.map(lambda moves: np.tensordot(motion.weights[:, k], moves, 1), motion.directions),
        motion.d_controls[..., k], places(past.records, motion.d_records, 1),
        places(past.rate, motion.d_rate, 0), *(each[..., k] for each in found),
    )  # fmt: skip
    slope = jax.jit(lambda along: jax.jvp(residuals, at, along))
    still = tuple(jax.tree.map(np.zeros_like, each) for each in along)
    value, moved = slope(along)
    size = np.max(np.abs(slope((*along[:4], *still[4:]))[1]))
    assert np.max(np.abs(value)) <= 1.1e-10 and size > 0.1
    assert np.max(np.abs(moved)) <= 1e-9 * size


def assert_transposed(function, at, along):
    """⟨v, J u⟩ = ⟨Jᵀ v, u⟩, and the part of each argument by itself."""
    results, pull = jax.vjp(function, *at)
    for k in range(len(at)):
        own = [jax.tree.map(np.zeros_like, each) if i != k else each for i, each in enumerate(along)]
        moved = jax.jvp(function, at, tuple(own))[1]
        rng = np.random.default_rng(k)
        # components have different units
        v = [rng.normal(size=each.shape) / max(float(np.max(np.abs(each))), 1e-12) for each in moved]
        products = np.concatenate([np.ravel(a * b) for a, b in zip(v, moved, strict=True)])
        pulled = zip(*map(jax.tree.leaves, (pull(v), tuple(own))), strict=True)
        found = sum(float(np.sum(np.asarray(a) * np.asarray(b))) for a, b in pulled)
        assert np.max(np.abs(products)) > 0.1
        assert found == pytest.approx(float(np.sum(products)), abs=1e-10 * np.sum(np.abs(products)))
    assert all(np.all(np.isfinite(each)) for each in results)


@pytest.mark.parametrize(
    ("name", "scheme", "space"),
    [
        (CURVED, "bdf-alpha", "lobatto2"), (NETWORK, "bdf-alpha", "lobatto2"),
        (STRUCTURED, "bdf2", "lobatto2"), *SPACES,
        *campaign((PAPER, "bdf-alpha", "lobatto2"), (COMMITTEE, "sdirk2", "lobatto2")),
    ],
)  # fmt: skip
def test_cotangents_are_those_of_the_transposed_map(name, scheme, space):
    motion = Motion(name, scheme, space)
    task = TimeIntegration(motion.settings, DT, STEPS)
    run = rollout.rollout(task, Pattern.of(motion.robot))

    def results(robot, controls, records, rate):
        rows, last = run(robot, controls, motion.past._replace(records=records, rate=rate))
        return [*rows.every_stage, last.records, last.rate]

    rng = np.random.default_rng(1)
    at = motion.robot, motion.controls, motion.past.records, motion.past.rate
    along = (
        jax.tree.map(lambda x: 0.1 * x * rng.normal(size=np.shape(x)), motion.robot),
        *(0.1 * rng.normal(size=x.shape) for x in at[1:]),
    )
    if not motion.settings.uses_rate:
        results, at, along = functools.partial(results, rate=at[3]), at[:3], along[:3]
    assert_transposed(results, at, along)


@pytest.mark.parametrize(("name", "low", "high"), [(ROUTED, 2.0, 5.0), (LEGS, 0.0, 0.02)])
def test_tangents_and_cotangents_of_equilibria(name, low, high):
    robot, rng, eps = kc.load_robot(name), np.random.default_rng(0), 1e-4
    controls, y = rng.uniform(low, high, (3, robot.control_layout.size)), unloaded_shape(robot, LOBATTO2)
    run = rollout.static_rollout(TimeIntegration(Settings(None), steps=3), Pattern.of(robot))
    along = (
        jax.tree.map(lambda x: 0.1 * x * rng.normal(size=np.shape(x)), robot),
        0.1 * high * rng.normal(size=controls.shape),
    )

    def results(robot, controls):
        return [*run(robot, controls, y)[:2]]

    assert_transposed(results, (robot, controls), along)
    moved = jax.jvp(results, (robot, controls), along)[1]
    ends = [
        results(*jax.tree.map(lambda x, dx, part=part: x + part * dx, (robot, controls), along))
        for part in (eps, -eps)
    ]
    for found, above, below in zip(moved, *ends, strict=True):
        wanted = np.asarray(above - below) / (2.0 * eps)
        size = np.max(np.abs(wanted), axis=tuple(range(wanted.ndim - 1)))
        assert np.all(np.abs(found - wanted) <= 1e-4 * size + 1e-10)


@pytest.fixture(scope="module")
def tip_height():
    robot = kc.load_robot(PAPER)

    def function(stiffness, tensions):
        moved = robot.replace(youngs_modulus=stiffness * robot.youngs_modulus)
        return kc.simulate(moved, tensions, DT, time="bdf2").tip_position[-1, 2]

    return function, np.random.default_rng(0).uniform(2.0, 5.0, (3, STEPS, 4))


def test_gradients_are_differences(tip_height):
    function, tensions = tip_height
    found, eps = jax.jit(jax.grad(function, (0, 1)))(1.0, tensions[0]), 1e-4
    slope = (function(1.0 + eps, tensions[0]) - function(1.0 - eps, tensions[0])) / (2.0 * eps)
    assert float(found[0]) == pytest.approx(float(slope), rel=1e-6)
    direction = np.random.default_rng(1).normal(size=tensions[0].shape)
    ends = [function(1.0, tensions[0] + part * direction) for part in (eps, -eps)]
    slope = float(ends[0] - ends[1]) / (2.0 * eps)
    assert float(np.sum(found[1] * direction)) == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize("hidden", [12, 64])
def test_gradients_by_weights_are_differences(hidden):
    model, tensions = with_network(hidden), np.random.default_rng(0).uniform(2.0, 5.0, (STEPS, 4))
    eps, weights = 1e-4, lambda model: (model.residual.input_weights, model.residual.output_weights)

    def height(own, tensions):
        moved = eqx.tree_at(weights, model, own)
        return kc.simulate(moved, tensions, DT, time="bdf2").tip_position[-1, 2]

    found = jax.jit(jax.grad(height))(weights(model), tensions)
    for k, slopes in enumerate(found):
        direction = np.random.default_rng(k).normal(size=slopes.shape)
        ends = []
        for part in (eps, -eps):
            own = list(weights(model))
            own[k] = own[k] + part * direction
            ends.append(float(height(tuple(own), tensions)))
        assert float(np.sum(slopes * direction)) == pytest.approx((ends[0] - ends[1]) / (2.0 * eps), rel=1e-5)


def test_transformations_agree_with_each_other(tip_height):
    function, tensions = tip_height
    one = np.asarray(jax.grad(function, 1)(1.0, tensions[0]))
    size = 1e-9 * np.max(np.abs(one))
    for transformation in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(transformation(function, 1)(1.0, tensions[0]), one, atol=size)
    # Newton's tolerance lies between robots side by side and one by one
    many = jax.jit(jax.vmap(jax.grad(function, 1), (None, 0)))(1.0, tensions)
    np.testing.assert_allclose(many[0], one, atol=1e-6 * np.max(np.abs(one)))
    total = jax.grad(lambda tensions: jnp.sum(jax.vmap(function, (None, 0))(1.0, tensions)))(tensions)
    np.testing.assert_allclose(total, many, atol=size)
    stiffness = np.array([1.0, 1.1, 0.9])
    each = jax.vmap(jax.grad(function), (0, None))(stiffness, tensions[0])
    wanted = [jax.grad(function)(value, tensions[0]) for value in stiffness]
    np.testing.assert_allclose(each, wanted, rtol=1e-6)


def test_unsolved_rows_are_nan(tip_height):
    function, tensions = tip_height
    assert np.isnan(jax.jit(function)(1.0, 1e7 * tensions[0]))


@pytest.mark.parametrize(("name", "scheme"), [(PAPER, "sdirk2"), (ROUTED, "bdf-alpha")])
def test_a_few_numbers_of_rows_have_the_tangents_that_they_have_among_all(monkeypatch, name, scheme):
    """Parts of the steps follow each other from the state before, whatever their length."""
    motion = Motion(name, scheme)
    last, (d_rows, d_unknowns) = tangent_time_loop(*motion.given)
    kept = np.random.default_rng(0).uniform(size=d_rows.shape[1:3]) < 0.1
    monkeypatch.setattr(sensitivity, "PART", 4 * kept.size * COLUMNS)
    *before, changes, state = motion.given
    after, (own, unknowns) = tangent_time_loop(*before, changes._replace(kept=kept), state)
    for found, wanted in (
        (own, d_rows[:, kept]),
        (unknowns, d_unknowns),
        (after.d_records, last.d_records),
        (after.d_rate, last.d_rate),
    ):
        np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-12 * np.max(np.abs(wanted)))
