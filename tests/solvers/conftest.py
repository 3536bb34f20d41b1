"""A robot and its motion; imported within fixtures, for JAX comes after the tests' settings."""

import pytest


@pytest.fixture(scope="module")
def robot():
    import knode_cosserat as kc

    return kc.load_robot("delrin-tendon-robot")


@pytest.fixture(scope="module")
def sine():
    import knode_cosserat as kc

    return kc.controls.sine(1.5, 100, 0.05)


@pytest.fixture(scope="module")
def truth(robot, sine):
    import knode_cosserat as kc

    return kc.simulate(robot, sine, 0.05)
