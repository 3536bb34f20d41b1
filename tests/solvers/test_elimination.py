"""How a step's linear equations are solved, or kept from step to step, is not seen in a motion."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.solvers.linear import Condensed, Decoupled

DT = 0.01
KEEPING = kc.NewtonOptions(across_steps=True)
WAYS = {
    "decoupled": {"elimination": "decoupled"},
    "groups of other sizes": {"elimination": Decoupled(every=4)},
    "kept": {"newton": KEEPING},
    "decoupled and kept": {"elimination": "decoupled", "newton": KEEPING},
}


@pytest.fixture(scope="module")
def robot():
    return kc.load_robot("delrin-tendon-robot")


@pytest.fixture(scope="module")
def sine():
    return kc.controls.sine(1.5, 60, DT)


@pytest.fixture(scope="module")
def truth(robot, sine):
    return kc.simulate(robot, sine, DT)


@pytest.mark.parametrize("way", ["decoupled", "kept", "decoupled and kept"])
def test_the_motion_is_the_same(robot, sine, truth, way):
    found = kc.simulate(robot, sine, DT, **WAYS[way])
    assert np.all(np.asarray(found.result) == 0)
    np.testing.assert_allclose(found.position, truth.position, atol=1e-8)


@pytest.mark.campaign
@pytest.mark.parametrize("way", WAYS)
def test_the_motion_of_strands_is_the_same(way):
    platform = kc.load_robot("six-legged-robot")
    t = DT * (1 + np.arange(40))
    controls = 0.02 * np.sin(6.0 * t)[:, None] * np.array([1.0, -0.5, 0.3, 0.8, 0.0, -1.0])
    usual, found = kc.simulate(platform, controls, DT), kc.simulate(platform, controls, DT, **WAYS[way])
    assert np.all(np.asarray(found.result) == 0)
    np.testing.assert_allclose(found.position, usual.position, atol=1e-8)


def test_a_linearisation_is_kept_from_step_to_step(robot, sine, truth):
    """What is kept converges more slowly, so the same motion takes more corrections."""
    found = kc.simulate(robot, sine, DT, newton=KEEPING)
    assert np.sum(np.asarray(found.iterations)) > np.sum(np.asarray(truth.iterations))


def test_a_control_that_jumps_asks_for_a_new_one(robot):
    """What is kept does not lead to a shape that is far away: the step is linearised anew, not failed."""
    controls = np.zeros((40, 4))
    controls[20:, 0] = 6.0
    usual, found = kc.simulate(robot, controls, DT), kc.simulate(robot, controls, DT, newton=KEEPING)
    np.testing.assert_array_equal(found.result, usual.result)
    np.testing.assert_allclose(found.position, usual.position, atol=1e-7)


@pytest.mark.campaign
def test_a_batch_keeps_nothing_of_another_robot(robot, sine):
    controls = np.stack([sine, -0.3 * sine[::-1] + 1.0])
    both = kc.simulate(robot, controls, DT, newton=KEEPING)
    for k in range(2):
        alone = kc.simulate(robot, controls[k], DT, newton=KEEPING)
        np.testing.assert_allclose(both.position[k], alone.position, atol=1e-8)


def test_what_goes_on_begins_with_the_elimination_it_had(robot, sine):
    begun = kc.simulate(robot, sine[:30], DT, elimination="decoupled")
    on = kc.simulate(robot, sine[30:], DT, initial=begun)
    assert isinstance(on.settings.elimination, Decoupled)
    other = kc.simulate(robot, sine[30:], DT, initial=begun, elimination="condensed")
    assert isinstance(other.settings.elimination, Condensed)
    np.testing.assert_allclose(on.position, other.position, atol=1e-8)


def test_a_wrong_elimination_is_named(robot, sine):
    with pytest.raises(ValueError, match='elimination is \'qr\'; allowed is "condensed", "decoupled"'):
        kc.simulate(robot, sine, DT, elimination="qr")
    with pytest.raises(ValueError, match="every is 0"):
        Decoupled(every=0)
