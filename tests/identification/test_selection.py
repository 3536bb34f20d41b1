"""Selection: rows that say nothing are not used, and the next experiment tells what it promises."""

import numpy as np
import pytest

from knode_cosserat.identification.effects import library_model
from knode_cosserat.identification.experiments import experiments_of
from knode_cosserat.identification.imperfections import nominal_robot
from knode_cosserat.identification.misfit import Misfit, Rollout
from knode_cosserat.identification.next_experiment import next_experiment
from knode_cosserat.identification.posterior import Posterior
from knode_cosserat.identification.search import LARGEST, ParameterSearch
from tests.identification.recorded import measured, tensions

NOMINAL = nominal_robot()
ROWS = measured(NOMINAL, tensions(1.0, 2.0), "one")


@pytest.fixture(scope="module")
def search():
    model = library_model(NOMINAL, ROWS.control, ROWS.fractions)
    return ParameterSearch(Misfit(model, [each.rough() for each in experiments_of([ROWS], model)]))


def test_rows_that_depend_on_everything_are_not_used(search):
    """In an unstable motion, such as a robot that buckles, derivatives grow without bounds."""
    values, slopes = np.zeros((5, 3)), np.full((search.misfit.model.size, 5, 3), 0.01)
    values[1, 2], slopes[:, 3, 1] = np.nan, 2.0 * LARGEST * search.length
    every = np.ones(len(slopes), dtype=bool)
    [used] = search.used([Rollout(search.misfit.data[0], values, lambda which: slopes[which])], every)
    assert used.sum() == 11 and not used[1, 2] and not used[3].any()


@pytest.mark.slow
def test_the_next_experiment_tells_what_it_promises(search):
    """One tendon's gain is known only after an experiment in which that tendon pulls."""
    model, names = search.misfit.model, ["stiffness", "damping", "load cell gains"]
    point = search.run(np.zeros(model.size), model.mask(names), effort=(0, 0.0), equations="all")
    posterior = Posterior.of(model, point, names)
    found = next_experiment(search, posterior, point.x, ["load cell gains"])
    assert found.control.min() >= ROWS.control.min() and found.control.max() <= ROWS.control.max()
    assert set(found.deviations) == {f"load_cells.gain[{k}]" for k in range(4)}
    assert all(after < before for before, after in found.deviations.values())
    assert "deviation" in str(found)
    # the same experiment, carried out and added to the others
    more = measured(NOMINAL, found.control, "two")
    both = ParameterSearch(Misfit(model, [each.rough() for each in experiments_of([ROWS, more], model)]))
    scale = np.tile(point.scale, (2, 1))
    again = both.run(point.x, model.mask(names), effort=(0, 0.0), scale=scale, equations="all")
    share = point.problem.amount[0] / again.problem.amount[0]
    known = share * again.problem.matrix.sum(axis=0) + np.diag(point.prior)
    after = np.sqrt(np.diag(np.linalg.inv(known)))
    for label, (_, promised) in found.deviations.items():
        assert after[model.labels.index(label)] == pytest.approx(promised, rel=0.2)
