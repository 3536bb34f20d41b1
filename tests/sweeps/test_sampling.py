"""Points by index: parts of a sequence are the sequence, and points have the samplers' properties."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from knode_cosserat.sweeps import SweepError
from knode_cosserat.sweeps._description import SAMPLERS
from knode_cosserat.sweeps._sampling import case_seeds, unit_points

POINTS = [name for name in SAMPLERS if name != "grid"]


@pytest.mark.parametrize("sampler", POINTS)
@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**40), st.integers(1, 6), st.integers(1, 200), st.data())
def test_parts_of_a_sequence_are_the_sequence(sampler, seed, dimensions, samples, data):
    first = data.draw(st.integers(0, samples - 1))
    last = data.draw(st.integers(first, samples))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = unit_points(sampler, (0, samples), dimensions, samples, seed)
        part = unit_points(sampler, (first, last), dimensions, samples, seed)
    assert whole.shape == (samples, dimensions)
    assert np.all((whole >= 0.0) & (whole < 1.0))
    np.testing.assert_array_equal(part, whole[first:last])


def test_seeds_of_cases_are_their_own():
    seeds = case_seeds(3, (0, 10_000))
    # 10,000 of 2³¹ numbers: 0.02 equal pairs are expected
    assert len(np.unique(seeds)) >= 9_998
    assert np.all((seeds >= 0) & (seeds < 2**31))
    np.testing.assert_array_equal(case_seeds(3, (50, 60)), seeds[50:60])
    assert np.count_nonzero(case_seeds(4, (0, 100)) == seeds[:100]) == 0


def test_too_many_varied_numbers_for_sobol_are_refused():
    with pytest.raises(SweepError, match="allowed is up to 21201"):
        unit_points("sobol", (0, 1), 30_000, 1, 0)
