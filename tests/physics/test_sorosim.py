"""Shapes and vibrations that another solver has computed; the table is in docs/validation.md."""

import numpy as np
import pytest

from benchmarks import sorosim


@pytest.mark.parametrize("name", sorosim.SIZES)
def test_static_shapes_agree(name):
    """Under gravity and wrenches at the middle and the tip; their numbers have four decimals."""
    shapes = [np.max(each.distances) / each.length for each in sorosim.statics(rods=[name])[name]]
    assert len(shapes) == 25
    assert np.mean(shapes) < 5e-4 and np.max(shapes) < 1e-3


def test_free_vibrations_agree():
    """Of 0.1 to 0.4 m, for 2 s."""
    found = sorosim.vibrations()
    assert len(found) == 6
    for name, each in found.items():
        size = 0.5 * np.ptp(each.theirs, axis=0).max()
        assert size > 0.08, name
        assert np.sqrt(np.mean(each.distances**2)) < 1.5e-3 and np.max(each.distances) < 2.5e-3, name
