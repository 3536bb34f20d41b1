"""A network with history inputs is one model: in time steps of any length and scheme, and in equilibria.

Five variations of the fault, from which a learned robot started 50 degrees off: an equilibrium, another time
step, another time scheme, another kind of first step, and a start by another robot's equilibrium.
"""

import dataclasses

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.learning.config import FitConfig, NetworkOptions, Training
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.residual import network
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.rods.aspects import Observed
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.semi_discrete import History, Point
from studies.recordings import _paper_motion

ROBOT = kc.load_robot("delrin-tendon-robot").replace(nodes=5)
TENSION = np.array([5.0, 5.0, 5.2, 5.4])
DT = 0.05


def learned(c0, **options):
    """The robot with a random network of history inputs that corrects y_s.

    It has no correction of z: ʰz holds corrected strains, so that one would act as a rate of strain at rest.
    """
    net = network(ROBOT, NetworkOptions(hidden=3, history=True, **options), jax.random.key(0), c0)
    rows = np.arange(len(net.output_biases)) < ROBOT.y_layout.size
    return KNODE(
        ROBOT,
        dataclasses.replace(
            net, output_weights=rows[:, None] * net.output_weights, output_biases=rows * net.output_biases
        ),
    )


def drift(model, initial, dt, time="bdf2", start="paper"):
    """Largest distance (m) of the tip from its first row while the tensions are held."""
    moved = kc.simulate(
        model, np.tile(TENSION, (5, 1)), dt, time=time, start=start, space="euler", initial=initial
    )
    tip = np.asarray(moved.tip_position)
    return np.max(np.linalg.norm(tip - tip[0], axis=1))


@pytest.mark.slow
@pytest.mark.parametrize(
    "scheme",
    [{}, {"dt": 0.02}, {"dt": 0.2}, {"time": "bdf1"}, {"start": "consistent"}],
    ids=["the training's steps", "shorter steps", "longer steps", "BDF1", "a consistent start"],
)
def test_an_equilibrium_of_a_learned_robot_stays_at_rest(scheme):
    model = learned(1.5 / DT)
    still = kc.equilibrium(model, TENSION, space="euler")
    bare = kc.equilibrium(ROBOT, TENSION, space="euler")
    assert np.linalg.norm(np.asarray(still.tip_position)[-1] - np.asarray(bare.tip_position)[-1]) > 1e-3
    assert drift(model, still, **{"dt": DT, **scheme}) < 1e-6


@pytest.mark.slow
def test_models_of_the_paper_start_in_one_rest():
    rows = 4
    measured = Measurements(
        time=DT * np.arange(rows),
        control=np.tile(TENSION, (rows, 1)),
        fractions=np.ones(1),
        position=np.zeros((rows, 1, 3)),
        quaternion=np.zeros((rows, 1, 4)),
        measured=np.ones((rows, 1), bool),
        simulated=True,
        source="none",
        initial_control=TENSION,
    )
    rest = kc.equilibrium(ROBOT, TENSION, space="euler")
    moved = _paper_motion(learned(1.5 / DT), ROBOT, measured, 0.0)
    np.testing.assert_array_equal(moved.y[0], rest.y[-1])
    assert np.linalg.norm(moved.tip_position[-1] - moved.tip_position[0]) > 1e-3


def points(count):
    """Random points of the rod in a time step; quaternions are of any length."""
    rng = np.random.default_rng(1)
    size, strains = ROBOT.y_layout.size, ROBOT.z_layout.size
    for _ in range(count):
        y = rng.normal(size=size)
        past = History(np.asarray(1.5 / DT), rng.normal(size=size), rng.normal(size=strains), np.zeros(size))
        yield Point(0.1, 0.0, y, TENSION, past)


def test_corrections_turn_a_quaternion_and_keep_its_length():
    """What turns is the network's own; all other corrections are unchanged."""
    free, kept = (learned(1.5 / DT, unit_quaternions=unit).residual for unit in (False, True))
    own = ROBOT.y_layout.slice("h")
    for point in points(5):
        z = semi_discrete.strains(ROBOT, point)
        both = [
            np.array(net.correction(ROBOT, *point[:3], point.y_t, z, point.z_t(z), TENSION))
            for net in (free, kept)
        ]
        h = point.y[own]
        assert abs(h @ both[1][own]) < 1e-12 < 1e-6 < abs(h @ both[0][own])
        across = np.eye(4) - np.outer(h, h) / (h @ h)
        np.testing.assert_allclose(both[1][own], across @ both[0][own], atol=1e-12)
        for each in both:
            each[own] = 0.0
        np.testing.assert_array_equal(*both)


def test_inputs_are_those_of_the_training_with_the_same_rates():
    model = learned(1.5 / DT)
    for point in points(3):
        z = semi_discrete.strains(ROBOT, point)
        expected = np.concatenate(
            [point.y, point.history.y, z, point.history.z, Observed.of(ROBOT).actuation(TENSION)]
        )
        inputs = model.residual.inputs(ROBOT, point.y, point.y_t, z, point.z_t(z), TENSION)
        np.testing.assert_allclose(inputs, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.05, 0.02])
def test_a_fit_keeps_c0_of_its_time_steps(dt):
    tensions = kc.controls.sine(0.5, 4, dt)
    data = kc.simulate(ROBOT, tensions, dt, time="bdf2", space="euler", start="paper")
    config = FitConfig(NetworkOptions(hidden=2, history=True), Training(epochs=1))
    assert kc.fit(ROBOT.replace(length=0.5), [data], config).residual.c0 == pytest.approx(1.5 / dt)
