"""Motions of a bar. Imported within fixtures: see `tests/recordings/conftest.py`."""

import pytest


@pytest.fixture(scope="session")
def bars():
    from tests.learning.bar import pulled

    return [pulled(1.0), pulled(0.7)]


@pytest.fixture(scope="session")
def unseen():
    from tests.learning.bar import pulled

    return pulled(1.4)
