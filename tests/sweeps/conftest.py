"""The small sweep in a folder, and a copy to damage."""

import shutil

import pytest


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An undisturbed sweep of 48 cases in 3 shards."""
    # not before the tests have chosen how JAX compiles
    from knode_cosserat.sweeps import run_sweep
    from tests.sweeps.small_sweep import described

    return run_sweep(described(), tmp_path_factory.mktemp("whole") / "sweep", workers=1)


@pytest.fixture
def copied(whole, tmp_path):
    """A copy of the folder, to damage."""
    shutil.copytree(whole.folder, tmp_path / "copy")
    return tmp_path / "copy"
