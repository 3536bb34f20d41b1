"""Rows outside the range that a model was trained in are marked, wherever trajectories go."""

import dataclasses

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.engine import pattern
from knode_cosserat.learning.config import FitConfig
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.rods.passport import MARGIN, Passport, with_passport, without_passport
from tests.learning.bar import BAR, WRONG, pulled

PAPER = {"time": "bdf2", "start": "paper", "initial": "unstressed"}
SMALL = FitConfig.network(hidden=5, epochs=300)


@pytest.fixture(scope="module")
def seen():
    return [pulled(period, **PAPER) for period in (1.0, 0.7)]


@pytest.fixture(scope="module")
def ensemble(seen):
    return kc.fit(WRONG, seen, dataclasses.replace(SMALL, seed=(0, 1)))


@pytest.fixture(scope="module")
def model(ensemble):
    return ensemble[0]


@pytest.fixture(scope="module")
def beyond():
    """More pull than in training, at first within its range."""
    pull = 2.0 * np.sin(2 * np.pi * np.arange(1, 21) * 0.1) * np.linspace(0.2, 1.6, 20)
    return kc.simulate(BAR, pull[:, None], 0.1, **PAPER)


@pytest.fixture(scope="module")
def predicted(model, beyond):
    return kc.simulate(model, beyond.held_control[:-1], beyond.dt, **PAPER)


def test_the_range_is_that_of_the_trajectories(model, seen):
    rates = np.concatenate([np.diff(each.z, axis=0) / each.dt for each in seen])
    for part, layout, values in (
        ("strains", BAR.z_layout, np.concatenate([each.z for each in seen]).reshape(-1, 1)),
        ("controls", BAR.control_layout, np.concatenate([each.control[1:] for each in seen])),
        ("rates", BAR.z_layout, rates.reshape(-1, 1)),
    ):
        low, high = model.passport.bounds(part, layout)
        np.testing.assert_allclose(low, values.min(axis=0), atol=1e-12)
        np.testing.assert_allclose(high, values.max(axis=0), atol=1e-12)


def test_nothing_is_marked_in_what_it_learned_from(model, seen):
    for each in seen:
        again = kc.simulate(model, each.held_control[:-1], each.dt, **PAPER)
        assert again.extrapolated.shape == (len(each.time),) and not again.extrapolated.any()
        assert "EXTRAPOLATION" not in str(again) and again.extrapolation == ""
    # the knowledge alone was not trained
    assert kc.simulate(WRONG, seen[0].held_control[:-1], seen[0].dt).extrapolated is None


def test_rows_beyond_are_marked_and_said(model, seen, predicted):
    low, high = model.passport.bounds("controls", BAR.control_layout)
    slack = MARGIN * (high - low).max()
    driven = (predicted.control > high + slack).any(axis=1)
    driven |= (predicted.control < low - slack).any(axis=1)
    assert driven.any() and not driven.all()
    # wherever the control is beyond, and where strains or rates are
    assert np.all(predicted.extrapolated[1:][driven[1:]]) and not predicted.extrapolated.all()
    count = int(predicted.extrapolated.sum())
    assert f"EXTRAPOLATION: {count} of {len(predicted.time)} rows" in str(predicted)
    first = predicted.time[np.argmax(predicted.extrapolated)]
    assert f"first at {first:g} s: " in predicted.extrapolation
    # and how far in which control
    over = np.maximum(predicted.control - high, low - predicted.control)[1:, 0]
    most = predicted.control[1 + np.argmax(over), 0]
    assert f"pull is {most:.4g} N (learned {low[0]:.4g} to {high[0]:.4g})" in predicted.extrapolation


@pytest.mark.slow
def test_marks_survive_slices_files_continuing_batches_and_equilibria(
    model, ensemble, beyond, predicted, tmp_path
):
    marks, controls = predicted.extrapolated, beyond.held_control[:-1]
    np.testing.assert_array_equal(predicted[3:9].extrapolated, marks[3:9])
    predicted.save(tmp_path / "predicted.nc")
    loaded = kc.load_trajectory(tmp_path / "predicted.nc", system=model)
    assert loaded.extrapolated.dtype == bool
    np.testing.assert_array_equal(loaded.extrapolated, marks)
    assert loaded.extrapolation == predicted.extrapolation != ""
    half = len(controls) // 2
    first = kc.simulate(model, controls[:half], beyond.dt, **PAPER)
    second = kc.simulate(model, controls[half:], beyond.dt, **PAPER | {"initial": first})
    np.testing.assert_array_equal(np.concatenate([first.extrapolated, second.extrapolated[1:]]), marks)
    assert second.extrapolated[0] == first.extrapolated[-1]
    both = kc.simulate(model, np.stack([controls, 0.2 * controls]), beyond.dt, **PAPER)
    np.testing.assert_array_equal(both.extrapolated[0], marks)
    assert not both[1].extrapolated[1:].all() and "2 robots" in str(both)
    prediction = ensemble.predict(controls, beyond.dt, **PAPER)
    np.testing.assert_array_equal(
        prediction.extrapolated, prediction.members[0].extrapolated | prediction.members[1].extrapolated
    )
    top = 2.0 * model.passport.bounds("controls", BAR.control_layout)[1]
    rest = kc.equilibrium(model, top)
    assert rest.extrapolated.shape == (1,) and rest.extrapolated[0]
    traced = jax.jit(lambda part: kc.simulate(model, part * controls, beyond.dt, **PAPER).extrapolated)(1.0)
    np.testing.assert_array_equal(traced, marks)


def test_a_range_needs_no_program_of_its_own(model, beyond):
    bare = KNODE(model.knowledge, model.residual, model.about)
    assert jax.tree.structure(without_passport(model)) == jax.tree.structure(bare)
    kc.simulate(bare, beyond.held_control[:-1], beyond.dt, **PAPER)
    cores = set(pattern._CODES)
    kc.simulate(model, beyond.held_control[:-1], beyond.dt, **PAPER)
    assert set(pattern._CODES) == cores


def test_files_keep_the_passport(model, ensemble, tmp_path):
    model.save(tmp_path / "model")
    again = kc.load_model(tmp_path / "model", knowledge=WRONG)
    assert again.passport.to_dict() == model.passport.to_dict()
    ensemble.save(tmp_path / "models")
    members = kc.learning.load_ensemble(tmp_path / "models", knowledge=WRONG)
    assert all(it.passport.to_dict() == model.passport.to_dict() for it in members)
    # a model of an identified robot has that robot's passport until it is trained itself
    known = with_passport(BAR, model.passport)
    assert KNODE(known, model.residual).passport is known.passport
    assert KNODE(known, model.residual, None, Passport("fit")).passport.command == "fit"


@pytest.mark.parametrize("down", [(0.0, 0.0, -9.81), (9.81, 0.0, 0.0)], ids=["upright", "lying"])
def test_tendons_that_pull_together_are_outside_where_each_is_within(down):
    """Opposite tendons took turns in training: together they compress the rod as nothing did there."""
    robot = kc.load_robot("delrin-routed-tendon-robot").replace(gravity=down, nodes=5)
    angle = 2.0 * np.pi * np.arange(24) / 24
    turns = 4.0 + 3.0 * np.stack([np.cos(angle + 0.5 * np.pi * k) for k in range(4)], axis=1)
    seen = kc.solvers.equilibria(robot, turns)
    robot = with_passport(robot, Passport.of("identify", [], robot, [seen]))
    again = kc.equilibrium(robot, np.concatenate([turns, np.full((1, 4), 6.9)]))
    assert again.extrapolated[:, 0].tolist() == [False] * 24 + [True]
    assert "1 of 25 rows" in again.extrapolation
