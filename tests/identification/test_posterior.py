"""Probabilities of effects: calibrated on linear problems, and honest where data do not decide."""

import numpy as np
import pytest

from knode_cosserat.estimation.parameters import Number, ParameterModel, PossibleEffect
from knode_cosserat.identification.imperfections import nominal_robot
from knode_cosserat.identification.information import NormalEquations, dispersion
from knode_cosserat.identification.misfit import Rollout
from knode_cosserat.identification.posterior import SURE, Posterior
from knode_cosserat.identification.search import SearchEnd

EFFECTS, ROWS = 8, 60


def model_of(needs=(), count=EFFECTS):
    """A model whose effects change nothing: their numbers are those of a linear problem."""

    def effect(k):
        numbers = (Number(f"n{k}", "", 0.0, 1.0),)
        wanted = ("e0",) if k in needs else ()
        return PossibleEffect(f"e{k}", numbers, lambda robot, values: robot, needs=wanted)

    return ParameterModel(nominal_robot(), [effect(k) for k in range(count)])


def point_of(slopes, rows, x):
    """The end of a search where rows = slopes @ truth + white noise of deviation one."""
    off = slopes @ x - rows
    problem = NormalEquations(
        np.array([off @ off]), np.array([float(len(off))]), (slopes.T @ off)[None], (slopes.T @ slopes)[None]
    )
    return SearchEnd(x, np.ones((1, 1)), problem, np.ones(len(x), dtype=bool), np.ones(len(x)))


def drawn(rng, model, size):
    """A truth from the prior: any number of effects is as likely as any other."""
    count = rng.integers(EFFECTS + 1)
    present = np.isin(np.arange(EFFECTS), rng.choice(EFFECTS, count, replace=False))
    truth = np.where(present, rng.normal(size=EFFECTS), 0.0)
    slopes = size * rng.normal(size=(ROWS, EFFECTS)) / np.sqrt(ROWS)
    rows = slopes @ truth + rng.normal(size=ROWS)
    return present, truth, Posterior.of(model, point_of(slopes, rows, rng.normal(size=EFFECTS)))


def test_probabilities_and_intervals_are_those_of_repeated_experiments():
    rng, model = np.random.default_rng(0), model_of()
    shares, truths, inside = [], [], []
    for _ in range(60):
        present, truth, posterior = drawn(rng, model, rng.choice([2.0, 6.0, 20.0]))
        shares += posterior.probability.values()
        truths += present.tolist()
        low, high = posterior.interval(0.95)
        inside += ((low - 1e-9 <= truth) & (truth <= high + 1e-9)).tolist()
    shares, truths = np.array(shares), np.array(truths)
    for low, high in ((0.0, 0.2), (0.2, 0.5), (0.5, 0.8), (0.8, 1.01)):
        group = (shares >= low) & (shares < high)
        error = 3.0 * np.sqrt(0.25 / group.sum())
        assert np.mean(truths[group]) == pytest.approx(np.mean(shares[group]), abs=error)
    assert np.mean(~truths[shares >= SURE]) <= 0.05
    assert 0.92 <= np.mean(inside) <= 1.0


def test_data_do_not_decide_between_two_effects_that_look_alike():
    rng, model = np.random.default_rng(1), model_of()
    slopes = 30.0 * rng.normal(size=(ROWS, EFFECTS)) / np.sqrt(ROWS)
    slopes[:, 1] = slopes[:, 0] + 0.01 * slopes[:, 2]
    rows = slopes[:, 0] + rng.normal(size=ROWS)
    posterior = Posterior.of(model, point_of(slopes, rows, np.zeros(EFFECTS)))
    assert all(0.2 < posterior.probability[name] < SURE for name in ("e0", "e1"))
    assert max(posterior.probability[f"e{k}"] for k in range(2, EFFECTS)) < 0.5
    # their mean predicts what the rows show
    assert posterior.mean[:2].sum() == pytest.approx(1.0, abs=0.1)


def test_an_effect_is_never_without_those_that_it_needs():
    rng, model = np.random.default_rng(2), model_of(needs=(1,))
    slopes = 20.0 * rng.normal(size=(ROWS, EFFECTS)) / np.sqrt(ROWS)
    posterior = Posterior.of(model, point_of(slopes, slopes[:, 1] + rng.normal(size=ROWS), np.zeros(EFFECTS)))
    assert posterior.probability["e1"] > SURE
    assert posterior.probability["e0"] >= posterior.probability["e1"]
    assert {"e0", "e1"} <= {*posterior.names()}


def test_the_shape_of_an_effect_that_is_hardly_there_is_no_evidence_for_it():
    """rows = a curve(s): the evidence against a small a is that without its derivative by the shape s."""
    numbers = Number("a", "", 0.0, 1.0), Number("s", "", 0.0, 1.0, shape=True)
    model = ParameterModel(nominal_robot(), [PossibleEffect("bent", numbers, lambda robot, values: robot)])
    rng, places, small, shape = np.random.default_rng(6), np.linspace(0.0, 3.0, ROWS), 0.1, 2.0
    rows = rng.normal(size=ROWS)
    curve, slope = np.sin(places + shape), np.cos(places + shape)
    slopes, off = np.stack([curve, small * slope], axis=1), small * curve - rows
    problem = NormalEquations(
        np.array([off @ off]), np.array([float(ROWS)]), (slopes.T @ off)[None], (slopes.T @ slopes)[None]
    )
    x = np.array([small, shape])
    posterior = Posterior.of(
        model, SearchEnd(x, np.ones((1, 1)), problem, np.ones(2, dtype=bool), np.ones(2))
    )
    # exact: costs with a = 0 and with the mode, whatever the shape
    at_mode = posterior.mode(["bent"])
    with_it = np.sum((slopes @ (at_mode - x) + off) ** 2) + at_mode @ at_mode
    matrix = slopes.T @ slopes + np.eye(2)
    exact = 0.5 * (rows @ rows - with_it) - 0.5 * np.linalg.slogdet(matrix)[1]
    found = posterior.evidence(["bent"]) - posterior.evidence([])
    assert found == pytest.approx(exact, abs=1e-9)


def test_about_other_coordinates_it_has_the_same_spread():
    posterior = drawn(np.random.default_rng(3), model_of(), 6.0)[2]
    x = np.linspace(-1.0, 1.0, EFFECTS)
    moved = posterior.about(x)
    for before, after, at in zip(posterior.draws.T, moved.draws.T, x, strict=True):
        present = before != 0.0
        assert not after[~present].any()
        if present.any():
            assert np.mean(after[present]) == pytest.approx(at) and moved.probability == posterior.probability
            np.testing.assert_allclose(np.std(after[present]), np.std(before[present]), rtol=1e-9)


def test_a_known_set_has_the_intervals_of_least_squares():
    rng, model = np.random.default_rng(3), model_of()
    point = point_of(rng.normal(size=(ROWS, EFFECTS)), rng.normal(size=ROWS), np.zeros(EFFECTS))
    posterior = Posterior.of(model, point, model.names)
    assert np.all(posterior.mean == point.x)
    low, high = posterior.interval(0.95)
    assert high - low == pytest.approx(2.0 * 2.007 * np.sqrt(np.diag(point.covariance())), rel=1e-3)


@pytest.mark.parametrize("memory", [0.0, 0.6, 0.9])
def test_correlated_rows_count_less(memory):
    """Of a constant, (1 + a) / (1 - a) rows of an autoregressive process count as one."""
    rng, rows, found = np.random.default_rng(4), 1200, []
    for _ in range(12):
        noise, values = rng.normal(size=rows) * np.sqrt(1.0 - memory**2), np.zeros(rows)
        for k in range(1, rows):
            values[k] = memory * values[k - 1] + noise[k]
        rollout = Rollout(None, values[:, None], lambda which: np.ones((1, rows, 1)))
        found.append(dispersion([rollout], [np.ones(1)], [0.05], np.array([True])))
    assert np.mean(found) == pytest.approx((1.0 + memory) / (1.0 - memory), rel=0.25)


def test_bodies_that_move_together_count_as_one():
    rng = np.random.default_rng(5)
    values = np.repeat(rng.normal(size=(600, 1)), 4, axis=1)
    rollout = Rollout(None, values, lambda which: np.ones((1, 600, 4)))
    assert dispersion([rollout], [np.ones(4)], [0.05], np.array([True])) == pytest.approx(4.0, rel=0.25)
