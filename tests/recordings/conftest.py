"""Recordings that several modules of tests begin with."""

import pytest

from knode_cosserat.recordings.virtual import Sensors, record_virtual
from tests.recordings.made import made

SENSORS = Sensors(swap=3.0)


@pytest.fixture(scope="session")
def virtual(tmp_path_factory):
    """The bag of 5 s of a sine of the virtual robot, and what it truly did: once, for it takes 40 s."""
    path = tmp_path_factory.mktemp("virtual") / "sine.bag"
    return path, record_virtual(path, "sine:1.0", seconds=5.0, seed=3, sensors=SENSORS)


@pytest.fixture(scope="module")
def exact():
    """Streams without noise, so that what comes back is known to the last digit."""
    return made(noise=0.0)
