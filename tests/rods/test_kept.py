"""Results that are kept for a robot: for its life, and never beyond a change of its numbers."""

import gc

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.rods import kept as module
from knode_cosserat.rods.kept import kept
from knode_cosserat.rods.passport import without_passport

ROBOT = kc.load_robot("delrin-tendon-robot")


def test_results_are_kept_until_numbers_change():
    calls = []

    @kept
    def doubled(system, factor):
        calls.append(factor)
        return np.asarray(system.gravity) * factor

    robot = ROBOT.replace(gravity=np.array([0.0, 0.0, -9.0]))
    first = doubled(robot, 2.0)
    assert doubled(robot, 2.0) is first and calls == [2.0]
    np.testing.assert_array_equal(doubled(robot, 3.0), [0.0, 0.0, -27.0])
    with pytest.raises(ValueError, match="read-only"):
        first[0] = 1.0
    robot.gravity[0] = 5.0
    np.testing.assert_array_equal(doubled(robot, 2.0), [10.0, 0.0, -18.0])


def test_a_simulation_after_a_change_in_place():
    robot = ROBOT.replace(gravity=np.array([0.0, 0.0, -9.0]))
    kc.simulate(robot, np.full((2, 4), 5.0), 0.05)
    robot.gravity[:] = [3.0, 0.0, -9.0]
    fresh = ROBOT.replace(gravity=np.array([3.0, 0.0, -9.0]))
    found, wanted = (kc.simulate(each, np.full((2, 4), 5.0), 0.05) for each in (robot, fresh))
    np.testing.assert_array_equal(found.y, wanted.y)


def test_nothing_is_kept_for_robots_that_are_gone_or_traced():
    robot = ROBOT.replace(radius=0.002)
    without_passport(robot)
    key = id(robot)
    assert key in module._ENTRIES
    del robot
    gc.collect()
    assert key not in module._ENTRIES
    before = len(module._ENTRIES)
    jax.jit(lambda radius: without_passport(ROBOT.replace(radius=radius)).radius)(0.002)
    assert len(module._ENTRIES) == before
