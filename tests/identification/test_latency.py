"""Latency of load cells: what they read, what acts, and that it is found from recordings."""

import dataclasses

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.identification.effects import library_model
from knode_cosserat.identification.evaluate import evaluate
from knode_cosserat.identification.experiments import of_measurements
from knode_cosserat.identification.misfit import Misfit
from knode_cosserat.rods.tendons import LoadCells, remove_delay
from tests.identification.recorded import DT, measured, tensions

NOMINAL = kc.load_robot("delrin-tendon-robot").replace(
    length=0.5, radius=0.003, density=1200.0, youngs_modulus=2.0e9, tendon_offset=0.025, nodes=6
)
#: tensions in each row of a reading, for the exact means below
FINE = 50


def late(tension, latency):
    """Means over rows of what is read so much (s) later than it acts; the first row acted before."""
    fine = np.repeat(tension, FINE, axis=0)
    shift = round(latency / DT * FINE)
    at = np.clip(np.arange(len(fine)) - shift, 0, len(fine) - 1)
    return fine[at].reshape(len(tension), FINE, -1).mean(axis=1)


def cells(latency, gain=1.0):
    return LoadCells(gain=np.full(4, gain), offset=np.zeros(4), latency=latency)


def test_readings_are_put_back_to_when_they_acted():
    true = tensions(1.0, 3.0)
    # whole rows exactly, but for those that were never read
    np.testing.assert_allclose(cells(2 * DT).undelayed(late(true, 2 * DT), DT)[:-2], true[:-2], rtol=1e-12)
    np.testing.assert_allclose(cells(-DT).undelayed(late(true, -DT), DT)[1:], true[1:], rtol=1e-12)
    # parts of rows as well as a line between rows does: by the second derivative of the sine
    amplitude, turn = 0.7 * 4.0, 2 * np.pi * DT
    back = cells(1.3 * DT).undelayed(late(true, 1.3 * DT), DT)
    assert np.abs(back - true)[25:-2].max() < 0.5 * turn**2 * amplitude
    assert np.abs(late(true, 1.3 * DT) - true)[25:].max() > 5 * 0.5 * turn**2 * amplitude
    np.testing.assert_array_equal(cells(0.0).undelayed(true, DT), true)
    before = np.full(4, 9.0)
    assert np.all(cells(-10.0).undelayed(true, DT, before) == before)
    assert np.all(cells(10.0).undelayed(true, DT, before) == true[-1])


def test_robots_and_models_of_them_say_what_acts():
    true = tensions("random", 1.0)
    robot = kc.robots.RoutedTendonRobot.like(NOMINAL, load_cells=cells(0.5 * DT))
    expected = 0.5 * (true[:-1] + true[1:])
    np.testing.assert_allclose(remove_delay(robot, true, DT)[:-1], expected, rtol=1e-12)
    assert remove_delay(NOMINAL, true, DT) is true


@pytest.mark.campaign
def test_derivatives_by_latency_are_those_of_differences():
    """Where tensions rise linearly in time, what acts is linear in the latency, across rows too."""
    rising = np.concatenate([np.full((20, 4), 4.0), 4.0 + np.outer(np.arange(31), [0.2, 0.0, -0.1, 0.05])])
    seen = measured(kc.robots.RoutedTendonRobot.like(NOMINAL), rising, "own", noise=0.0)
    model = library_model(NOMINAL, seen.control)
    misfit = Misfit(model, [of_measurements(seen, model, "own")])
    k = model.slice("latency").start
    one = np.eye(model.size)[k] * DT / model.numbers[k].width
    low, here, high = (misfit.differences(part * one)[0] for part in (-0.01, 0.0, 0.01))
    slope = (high.values - low.values) / 0.02 * model.numbers[k].width / DT
    # but for the row where they begin to rise, and the last, which is held
    np.testing.assert_allclose(here.derivatives[k], slope, rtol=0, atol=0.02 * np.abs(slope).max())


@pytest.mark.campaign
def test_latency_is_found_and_kept_in_the_robots_file(tmp_path):
    true, latency = (
        kc.robots.RoutedTendonRobot.like(NOMINAL, youngs_modulus=1.5e9, bending_damping=2e-3),
        0.031,
    )
    given = [
        measured(true, pulled, f"recording {k}", seed=k, reading=lambda tension: late(tension, latency))
        for k, pulled in enumerate((tensions(1.0, 3.0), tensions("random", 3.0, seed=1)))
    ]
    found = kc.identify(NOMINAL, given, ["latency"])
    (estimate,) = (each for each in found.estimates if each.effect == "latency")
    assert estimate.value == pytest.approx(latency, abs=2e-3)
    damping = next(each.value for each in found.estimates if each.label == "bending_damping")
    assert damping == pytest.approx(2e-3, rel=0.1)
    kc.save_robot(found.robot, tmp_path / "found.yaml")
    robot = kc.load_robot(tmp_path / "found.yaml")
    prompt = robot.replace(load_cells=dataclasses.replace(robot.load_cells, latency=0.0))
    for each in given:
        assert evaluate(robot, each).tip_rmse < 0.2 * evaluate(prompt, each).tip_rmse


@pytest.mark.campaign
def test_clocks_in_doubt_are_found_with_the_robot():
    """Each recording in several files has a delay of its own; the robot has none."""
    true, late_by = kc.robots.RoutedTendonRobot.like(NOMINAL, youngs_modulus=1.5e9), (0.017, -0.012)
    pulls = (tensions(1.0, 3.0), tensions("random", 3.0, seed=1))
    given = [
        measured(true, pulled, f"recording {k}", seed=k, reading=lambda tension, by=by: late(tension, by))
        for k, (pulled, by) in enumerate(zip(pulls, late_by, strict=True))
    ]
    doubtful = [dataclasses.replace(each, clock_deviation=0.015) for each in given]
    found = kc.identify(NOMINAL, doubtful, [])
    for k, by in enumerate(late_by):
        estimate = found[f"clock of recording {k}"]
        assert estimate.value == pytest.approx(by, abs=2e-3) and not estimate.held
    damping = float(np.ravel(true.bending_damping)[0])
    assert found["bending_damping"].value == pytest.approx(damping, rel=0.1)
    # with clocks that are taken as they are stated, no robot moves like this one
    apart = kc.identify(NOMINAL, given, [])
    assert sum(found.error.values()) < 0.5 * sum(apart.error.values())
    assert found.robot.load_cells is None
