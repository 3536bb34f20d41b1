"""Warning about undamped motion."""

import warnings

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.solvers.damping import UndampedWarning, warn_if_undamped

ROBOT = kc.load_robot("delrin-tendon-robot").replace(nodes=5)
BARE = ROBOT.replace(bending_damping=0.0)


def warned(robot, dt=0.05):
    """True if a simulation would warn; the caller of `simulate` is outside the package."""

    def simulate():
        warn_if_undamped(robot, dt)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        simulate()
    return [each.category for each in caught] == [UndampedWarning]


def test_undamped_robots():
    assert not warned(ROBOT)
    assert warned(BARE)
    assert warned([ROBOT, BARE])
    assert warned(kc.load_robot("six-legged-robot").replace(bending_damping=0.0))
    assert warned(kc.robots.RoutedTendonRobot.like(BARE))


@pytest.mark.parametrize(
    "change",
    [
        {"shear_damping": 0.1},
        {"linear_drag": 0.1},
        {"drag": 0.1},
        {"surroundings": [kc.robots.surroundings.Plane()]},
    ],
)
def test_other_damping(change):
    assert not warned(BARE.replace(**change))


def test_the_suggested_value_damps():
    with pytest.warns(UndampedWarning, match=r"Set bending_damping, such as 0\.0006 N m2 s") as caught:
        kc.simulate(BARE, np.full((2, 4), 5.0), 0.05)
    assert caught[0].filename == __file__
    assert not warned(BARE.replace(bending_damping=6e-4))


def test_statics_and_callers_in_the_package_do_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error", UndampedWarning)
        kc.equilibrium(BARE, np.full(4, 5.0))
        scope = {"__name__": "knode_cosserat.identification.search", "simulate": kc.simulate, "robot": BARE}
        exec("simulate(robot, [[5.0] * 4] * 2, 0.05)", scope)
