"""Recordings that several modules of tests begin with.

Imported within fixtures: the flags of `tests/conftest.py` have to be set before JAX is imported, and pytest
imports this file before that if it is given a file of this folder.
"""

import pytest


@pytest.fixture(scope="session")
def virtual(tmp_path_factory):
    """The bag of 5 s of a sine of the virtual robot, and what it truly did: once, for it takes 40 s."""
    from knode_cosserat.recordings.virtual import Sensors, record_virtual

    path = tmp_path_factory.mktemp("virtual") / "sine.bag"
    return path, record_virtual(path, "sine:1.0", seconds=5.0, seed=3, sensors=Sensors(swap=3.0))


@pytest.fixture(scope="module")
def exact():
    """Streams without noise, so that what comes back is known to the last digit."""
    from tests.recordings.made import made

    return made(noise=0.0)
