"""Trajectories that the tests of the viewer share, and a browser to show them in.

Imported within fixtures: see `tests/recordings/conftest.py`.
"""

import dataclasses

import numpy as np
import pytest

from tests.viewer import browser as driver

DT = 0.05


@pytest.fixture(scope="session")
def robot():
    import knode_cosserat as kc

    return kc.load_robot("delrin-tendon-robot")


@pytest.fixture(scope="session")
def truth(robot):
    import knode_cosserat as kc

    return kc.simulate(robot, kc.controls.sine(1.5, 60, DT), DT)


@pytest.fixture(scope="session")
def prediction(robot):
    import knode_cosserat as kc

    return kc.simulate(robot.replace(length=0.5), kc.controls.sine(1.5, 60, DT), DT)


@pytest.fixture(scope="session")
def failed(truth):
    """Its rows from 40 on are not solved, as a simulation leaves them with `on_failure="return"`."""
    import knode_cosserat as kc

    result = np.array(truth.result)
    result[40:] = int(kc.Result.NOT_REACHED)
    result[40] = int(kc.Result.NO_CONVERGENCE)
    y, z = np.array(truth.y), np.array(truth.z)
    y[40:], z[40:] = np.nan, np.nan
    return kc.Trajectory(
        truth.system,
        truth.settings,
        truth.time,
        y,
        z,
        truth.control,
        result,
        truth.residual,
        truth.iterations,
    )


@pytest.fixture(scope="session")
def coarse(truth):
    """Its rows from 40 on are of too coarse a grid; those from 50 on only continue from such a row."""
    import knode_cosserat as kc

    result = np.array(truth.result)
    result[40:] = int(kc.Result.COARSE)
    error = np.full(len(result), 1e-4)
    error[40:50] = 0.02
    return kc.Trajectory(
        truth.system,
        truth.settings,
        truth.time,
        truth.y,
        truth.z,
        truth.control,
        result,
        truth.residual,
        truth.iterations,
        position_error=error,
    )


@pytest.fixture(scope="session")
def evaluation(truth):
    """A prediction of three bodies of the truth by a softer robot, with the band of three more."""
    import knode_cosserat as kc

    seen = kc.recordings.Measurements.of(truth, (0.4, 0.7, 1.0)).rows(0, 41)
    position = np.array(seen.position)
    position[30, 1] = np.nan
    stiffness = truth.system.youngs_modulus
    others = [truth.system.replace(youngs_modulus=factor * stiffness) for factor in (0.85, 0.95, 1.05)]
    softer = truth.system.replace(youngs_modulus=0.9 * stiffness)
    return kc.identification.evaluate(
        softer, dataclasses.replace(seen, position=position), ensemble=others, space="lobatto2"
    )


# one a file: a page that stays open draws on, and takes the processor from whatever is tested next
@pytest.fixture(scope="module")
def browser():
    if driver.find() is None:
        pytest.skip(f"no browser: none of {', '.join(driver.NAMES)} is installed")
    pytest.importorskip("websockets", reason="websockets, of the extra viz, drives the browser")
    started = driver.Browser()
    yield started
    started.close()
