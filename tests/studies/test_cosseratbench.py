"""The solver for `cosseratbench`, run by the suite itself."""

import numpy as np
import pytest

experiment = pytest.importorskip("cosseratbench.experiment")
registry = pytest.importorskip("cosseratbench.registry")


@pytest.fixture(autouse=True)
def _entry_point(monkeypatch):
    from benchmarks.cosseratbench_solver import ENTRY_POINT

    # first: an environment may have the entry point of another checkout
    monkeypatch.syspath_prepend(ENTRY_POINT)


def ran(name, n_elements=20):
    found = experiment.run(
        registry.load_experiment(name), registry.load_solver("knode-cosserat"), n_elements=n_elements
    )
    assert found.outcome == "completed"
    return found


@pytest.mark.campaign
def test_cantilever():
    # what is left is that the suite's reference neither shears nor bends far
    assert ran("cantilever").metrics["tip_deflection_error"] < 1e-3


@pytest.mark.campaign
def test_catenary_is_that_of_finer_elements():
    fine, coarse = (ran("catenary", n).trajectory.positions[0][-1] for n in (160, 20))
    assert np.linalg.norm(fine[::8] - coarse, axis=1).max() < 1e-6


@pytest.mark.campaign
def test_pendulum_keeps_its_period_and_its_energy():
    found = ran("pendulum").metrics
    assert found["period_error"] < 2e-4
    assert abs(found["amplitude_change"]) < 1e-5


@pytest.mark.campaign
def test_twist_finds_where_a_rod_buckles():
    # the suite puts the uncertainty of this measurement near half a per cent
    assert ran("twist").metrics["critical_twist_error"] < 5e-3


def test_the_suite_finds_the_solver():
    assert registry.load_solver("knode-cosserat").__class__.__module__ == "benchmarks.cosseratbench_solver"
