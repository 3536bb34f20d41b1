"""What the sparse regression is made of: evidence, selection, expansions."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from knode_cosserat.learning.structured.regression import (
    folds,
    held_out_error,
    moments,
    relevant,
    selected_columns,
)
from knode_cosserat.learning.structured.residual import CURVED, LINEAR, expansion
from knode_cosserat.rods.layout import Layout


def one(features, target, floor):
    """The weights of a single target, and their remainder."""
    weights, remainder = relevant(features, target[:, None], np.array([floor]), np.ones(len(target)))
    return weights[0], remainder[0]


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.lists(st.integers(0, 29), min_size=1, max_size=4, unique=True),
    st.floats(-12, -3),
)
def test_the_weights_that_made_the_data_are_found(seed, places, exponent):
    """Four of thirty features at most, with noise of any size down to rounding."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(400, 30)) * 10.0 ** rng.uniform(-4, 4, 30)
    truth = np.zeros(30)
    truth[places] = rng.uniform(0.5, 2.0, len(places)) / features.std(axis=0)[places]
    noise = 10.0**exponent
    weights, remainder = one(features, features @ truth + noise * rng.normal(size=400), floor=1e-13)
    scaled = (weights - truth) * features.std(axis=0)
    assert np.all(np.flatnonzero(truth) == np.flatnonzero(np.abs(weights) * features.std(axis=0) > 0.1))
    assert np.max(np.abs(scaled)) < 6.0 * noise / np.sqrt(400) + 1e-12
    assert remainder < 1.3 * noise + 1e-12


def test_each_of_several_targets_is_explained_on_its_own():
    rng = np.random.default_rng(3)
    features = rng.normal(size=(200, 8))
    targets = np.stack([2.0 * features[:, 1], np.zeros(200), features[:, 4] + 1e-3 * rng.normal(size=200)], 1)
    floors, weight = np.array([1e-12, 1e-12, 1e-9]), rng.exponential(size=200)
    together, remainders = relevant(features, targets, floors, weight)
    for k, weights in enumerate(together):
        alone, remainder = relevant(features, targets[:, [k]], floors[[k]], weight)
        np.testing.assert_allclose(weights, alone[0], rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(remainders[k], remainder[0], rtol=1e-3, atol=1e-13)
    assert [np.flatnonzero(weights).tolist() for weights in together] == [[1], [], [4]]


def test_pure_noise_is_not_explained():
    rng = np.random.default_rng(0)
    weights, _ = one(rng.normal(size=(300, 40)), rng.normal(size=300), floor=1e-9)
    assert np.count_nonzero(weights) <= 1


def test_what_is_below_the_floor_is_not_explained():
    features = np.random.default_rng(0).normal(size=(100, 3))
    assert not np.any(one(features, 1e-10 * features[:, 0], floor=1e-9)[0])


def test_terms_that_do_not_carry_over_are_left_out():
    """In each fold another feature goes with the noise; only the one that is true in both is taken."""
    rng = np.random.default_rng(2)
    truth, chance = rng.normal(size=200), rng.normal(size=200)
    fold = np.repeat([0, 1], 100)
    features = np.stack([truth, np.where(fold == 0, chance, -chance)], axis=1)
    values = (truth + 0.5 * chance)[:, None]
    parts = moments(features, values, fold)
    taken, error = selected_columns(parts, [np.array([0]), np.array([1])], floor=0.0)
    assert taken.tolist() == [0]
    assert error == pytest.approx(held_out_error(parts, np.array([0])))


def test_folds_are_trajectories_or_parts_of_the_only_one():
    two = np.stack([np.repeat([0, 1], 6), np.tile(np.arange(6), 2)], axis=1)
    assert folds(two).tolist() == [0] * 6 + [1] * 6
    assert folds(two[:6]).tolist() == [0, 0, 1, 1, 2, 2]


@pytest.mark.parametrize("forms", [LINEAR, CURVED])
def test_an_expansion_is_the_sum_of_its_features(forms):
    rng = np.random.default_rng(4)
    layout = Layout(("a", 3, "m", ""), ("b", 1, "s", ""))
    values = rng.normal(size=(20, 4))
    part = expansion(layout, values, dict.fromkeys(layout.names, forms), 2)
    weights = rng.normal(size=part.weights.shape)
    part = type(part)(weights, part.scales, part.terms)
    for x in values[:5]:
        np.testing.assert_allclose(part(x), weights @ np.asarray(part.features(x)), rtol=1e-12)


def test_pruning_changes_nothing_but_the_size():
    rng = np.random.default_rng(5)
    layout = Layout(("a", 3, "m", ""), ("b", 3, "s", ""))
    values = rng.normal(size=(20, 6))
    part = expansion(layout, values, dict.fromkeys(layout.names, CURVED), 3)
    weights = np.zeros(part.weights.shape)
    weights[1, 5] = weights[2, 0] = 1.0
    full = type(part)(weights, part.scales, part.terms)
    small = full.pruned()
    assert small.weights.shape[1] < weights.shape[1] and len(small.terms) == 1
    np.testing.assert_array_equal(full(values[0]), small(values[0]))
    assert type(part)(0 * weights, part.scales, part.terms).pruned() is None
