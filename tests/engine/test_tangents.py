"""Emitted tangents of motions: differences of motions, and the same linear equations in JAX."""

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.engine import loops
from knode_cosserat.engine.program import EngineError
from knode_cosserat.estimation.adapted import Adapted, AdaptedParameters
from knode_cosserat.estimation.online import OnlineModel
from knode_cosserat.rods.loads import AttachedMass, PointWrench
from knode_cosserat.solvers import sensitivity
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.history import resting_history
from knode_cosserat.solvers.sensitivity import TangentState, tangent_loop_in_jax, tangent_time_loop
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.tangent import SystemMoves
from knode_cosserat.solvers.time_loop import StepCoefficients
from tests.engine.networks import with_network

DT, STEPS, COLUMNS = 0.05, 6, 11
PAPER, ROUTED, CURVED = "delrin-tendon-robot", "delrin-routed-tendon-robot", "variable-curvature-robot"
NETWORK = "network of 512 units"


class Motion:
    """A motion under random controls, and random tangents of its history, controls and all parameters."""

    def __init__(self, name, scheme, **changes):
        rng = np.random.default_rng(0)
        robot = with_network(512, history=True) if name == NETWORK else kc.load_robot(name).replace(**changes)
        self.robot, self.settings = robot, Settings.of(scheme, "lobatto2", "paper", NewtonOptions())
        self.steps = StepCoefficients.of(self.settings, DT)
        self.past = jax.tree.map(np.asarray, resting_history(robot, self.settings))
        low, high = (2.0, 5.0) if name != CURVED else (0.2, 0.5)
        self.controls = rng.uniform(low, high, (STEPS, robot.control_size))
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
            self.robot, self.directions,
        )  # fmt: skip
        records, rate = np.array(self.past.records), np.array(self.past.rate)
        used = self.d_rate.shape[0]
        records[:, :used] += part * self.d_records[..., column]
        rate[:used] += part * self.d_rate[..., column]
        past = self.past._replace(records=records, rate=rate)
        controls = self.controls + part * self.d_controls[..., column]
        done, after, rows = loops.loop_one(system, self.settings, self.steps, controls, past, (0, STEPS))
        assert done == STEPS
        return after, rows

    @property
    def given(self):
        past, used = self.past, self.d_rate.shape[0]
        state = TangentState(past.records[:, :used], past.rate[:used], self.d_records, self.d_rate, past.t0)
        changes = SystemMoves(self.directions, self.weights), self.d_controls
        return self.settings, self.steps, self.solved, (self.robot, self.controls), changes, state


@pytest.mark.parametrize(
    ("name", "scheme"),
    [
        (PAPER, "bdf-alpha"), (ROUTED, "sdirk2"), (ROUTED, "bdf-alpha"), (CURVED, "bdf-alpha"),
        (NETWORK, "bdf-alpha"),
    ],
)  # fmt: skip
def test_tangents_are_differences_of_motions(name, scheme):
    motion, eps = Motion(name, scheme), 1e-4
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
    model = OnlineModel(robot, AdaptedParameters(robot, [Adapted("loads.0.mass", 0.03)]), DT)
    cores, still = [], np.zeros(robot.control_size)
    for x in (0.0, 0.5):
        system, _ = model.moved(np.array([x]))
        cores.append(loops.core_of(system, model.settings, robots=False))
        assert (
            model.task(1).solve(system, still[None], resting_history(system, model.settings), (0, 1))[0] == 1
        )
    assert cores[0] is cores[1]


def test_tangents_equal_those_in_jax(monkeypatch):
    motion = Motion(PAPER, "sdirk2")
    wanted = tangent_loop_in_jax(*motion.given)
    monkeypatch.setattr(sensitivity, "tangent_loop_in_jax", None)
    found = tangent_time_loop(*motion.given)
    for one, other in zip(jax.tree.leaves(wanted), jax.tree.leaves(found), strict=True):
        one = np.asarray(one)
        assert np.shape(other) == one.shape
        np.testing.assert_allclose(other, one, atol=1e-9 * max(np.max(np.abs(one)), 1e-300))


def test_what_the_engine_does_not_cover_is_refused():
    settings = Settings.of("bdf2", "lobatto4", "paper", NewtonOptions())
    at, changes = (kc.load_robot(PAPER), np.zeros((1, 4))), ((None, None), np.zeros((1, 4, 1)))
    with pytest.raises(EngineError, match="lobatto2"):
        loops.tangent_loop(settings, None, None, at, changes, (), 0.0)
