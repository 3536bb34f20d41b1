"""Training data. Imported within fixtures: see `tests/recordings/conftest.py`."""

import numpy as np
import pytest


@pytest.fixture(scope="module")
def training():
    from tests.identification.motions import ROBOT, sines

    return sines(ROBOT)


@pytest.fixture(scope="module")
def swings():
    from tests.learning.bar import pulled

    return [pulled(1.0), pulled(2.0)]


@pytest.fixture(scope="module")
def string_swing():
    import knode_cosserat as kc
    from examples.hanging_string import HangingString
    from tests.identification.motions import DT

    string = HangingString(length=1.0, density=0.1, stiffness=1e3, friction=0.05, nodes=21)
    hand = np.array([0.6, -0.1]) + 0.05 * np.sin(np.pi * np.arange(1, 31) * DT)[:, None] ** 2
    return kc.simulate(string, hand, DT, initial=kc.equilibrium(string, hand[0]))
