"""A fit tells by its result what did not work, and not by NumPy's warnings."""

import importlib
import warnings

import numpy as np
import pytest

import knode_cosserat as kc
from tests.trajectories import synthetic

ROBOT = kc.load_robot("delrin-tendon-robot")


@pytest.mark.parametrize("operation", [lambda: np.exp(np.array([1e4])), lambda: np.zeros(1) / 0.0])
@pytest.mark.parametrize("recordings", [False, True])
def test_floating_point_warnings_do_not_leave_a_fit(monkeypatch, operation, recordings):
    """Trial models diverge in any search."""
    done = []

    def diverges(*_, **__):
        done.append(operation())
        raise kc.learning.FitError("enough")

    module = importlib.import_module("knode_cosserat.identification.fit")
    monkeypatch.setattr(module, "fit_states", diverges)
    monkeypatch.setattr(module, "learn_residual", diverges)
    data = kc.recordings.load_example() if recordings else synthetic()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(kc.learning.FitError, match="enough"):
            kc.fit(ROBOT, [data])
    assert len(done) == 1
