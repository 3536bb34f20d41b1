"""Time steps between the rows of recordings."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import knode_cosserat as kc
from knode_cosserat.identification.effects import library_model
from knode_cosserat.identification.experiments import of_measurements
from knode_cosserat.identification.misfit import Misfit
from knode_cosserat.identification.steps import (
    LONGEST,
    MOST,
    simulated_rows,
    stepped,
    steps_per_row,
    time_scheme,
)
from knode_cosserat.schemes.time import BDF2, SDIRK2
from tests.identification.recorded import measured, tensions

ROBOT = kc.load_robot("delrin-tendon-robot")


@given(dt=st.floats(1e-4, 1.0))
def test_steps_are_short_and_held_tensions_keep_their_rows(dt):
    if dt <= MOST * LONGEST:
        assert dt / steps_per_row(dt, True) <= LONGEST * (1.0 + 1e-5)
    else:
        assert steps_per_row(dt, True) == 1 and time_scheme(dt, True) == BDF2()
    assert steps_per_row(dt, False) == 1 and time_scheme(dt, False) == SDIRK2()


@given(count=st.integers(1, 8), rows=st.integers(1, 6))
def test_the_last_step_of_a_row_has_its_tension_and_lines_stay_lines(count, rows):
    rng = np.random.default_rng(count)
    tension = rng.uniform(size=(rows, 3))
    for continuous in (True, False):
        assert_allclose(stepped(tension, np.zeros(3), count, continuous)[count - 1 :: count], tension)
    line = np.arange(1.0, rows + 1)[:, None] * np.ones(3)
    steps = stepped(line, np.zeros(3), count, True)
    assert_allclose(steps[:, 0], np.arange(1, rows * count + 1) / count)
    assert_allclose(stepped(line, np.zeros(3), count, False), np.repeat(line, count, axis=0))


@pytest.mark.campaign
def test_rows_of_a_continuous_signal_are_those_of_much_finer_steps():
    """Oracle: 16 times as many steps. BDF2 from row to row is far from it."""
    robot = ROBOT.replace(bending_damping=1e-3, youngs_modulus=4e9, nodes=20)
    dt, count, finer = 0.0125, 120, 16
    time = dt * np.arange(1, count + 1)
    phase = np.arange(4) * np.pi / 2.0

    def tension(time):
        return 5.0 + np.minimum(1.0, time / 0.1)[:, None] * 1.5 * np.sin(9.0 * time[:, None] + phase)

    start = kc.equilibrium(robot, np.full(4, 5.0))
    fine = dt / finer * np.arange(1, count * finer + 1)
    exact = kc.simulate(robot, tension(fine), dt / finer, initial=start).tip_position[::finer]
    errors = [
        np.max(np.abs(np.asarray(found.tip_position) - np.asarray(exact)))
        for found in (
            simulated_rows(robot, tension(time), dt, start, np.full(4, 5.0), continuous, "lobatto2", None)
            for continuous in (True, False)
        )
    ]
    assert errors[0] < 0.2 * errors[1]


@pytest.mark.campaign
def test_recordings_of_both_kinds_are_simulated_as_each_alone_with_its_derivatives():
    """Oracle of the derivatives: differences. A trajectory may stand beside recordings (`kc.fit`)."""
    nominal = ROBOT.replace(nodes=6)
    seen = measured(kc.robots.RoutedTendonRobot.like(nominal), tensions(0.5, 1.5), "own")
    held = dataclasses.replace(seen, time=0.5 * seen.time)
    model = library_model(nominal, seen.control)
    data = [
        of_measurements(each, model, "own") for each in (dataclasses.replace(held, continuous=True), held)
    ]
    assert [each.steps for each in data] == [2, 1]
    both = Misfit(model, data)
    k = model.slice("damping").start
    one = 1e-3 * np.eye(model.size)[k]
    low, here, high = (both.differences(part * one) for part in (-1.0, 0.0, 1.0))
    for j, each in enumerate(data):
        (alone,) = Misfit(model, [each]).differences(np.zeros(model.size))
        assert_allclose(here[j].values, alone.values, rtol=0, atol=1e-12)
        slope = (high[j].values - low[j].values) / 2e-3
        assert_allclose(here[j].derivatives[k], slope, rtol=0, atol=1e-4 * np.abs(slope).max())
    assert np.abs(here[0].values - here[1].values).max() > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("apart", [0.0125, 0.02, 0.025, 0.04, 0.05])
def test_rows_farther_apart_are_predicted_as_well(apart):
    """A lightly damped robot; one step of BDF2 from row to row was 19 mm off at 20 ms."""
    robot, finest = ROBOT.replace(bending_damping=2e-3), 0.0025

    def tension(time):
        rise = np.minimum(1.0, time / 0.5)[:, None]
        return 5.0 + 1.5 * rise * np.sin(3.0 * time[:, None] + np.arange(4) * np.pi / 2.0)

    fine = finest * np.arange(1, 401)
    start = kc.equilibrium(robot, np.full(4, 5.0))
    true = kc.simulate(robot, tension(fine), finest, time="bdf-alpha", initial=start).tip_position
    count = round(apart / finest)
    rows = apart * np.arange(1, 400 // count + 1)
    found = simulated_rows(robot, tension(rows), apart, start, np.full(4, 5.0), True, "lobatto2", None)
    off = np.asarray(found.tip_position) - np.asarray(true)[::count][: len(rows) + 1]
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 2e-3
