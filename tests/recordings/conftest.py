"""One recording of the virtual robot for all tests that need one: simulating it takes most of their time."""

import pytest

from knode_cosserat.recordings.virtual import Sensors, record_virtual

SENSORS = Sensors(swap=3.0)


@pytest.fixture(scope="session")
def virtual(tmp_path_factory):
    """The bag of 5 s of a sine, and what the robot truly did."""
    path = tmp_path_factory.mktemp("virtual") / "sine.bag"
    return path, record_virtual(path, "sine:1.0", seconds=5.0, seed=3, sensors=SENSORS)
