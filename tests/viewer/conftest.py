"""Trajectories that the tests of the viewer share, and a browser to show them in."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import knode_cosserat as kc

DT = 0.05


def _load_browser():
    """Beside this file: the tests are no package."""
    spec = importlib.util.spec_from_file_location("viewer_browser", Path(__file__).parent / "browser.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def robot():
    return kc.load_robot("delrin-tendon-robot")


@pytest.fixture(scope="session")
def truth(robot):
    return kc.simulate(robot, kc.controls.sine(1.5, 60, DT), DT)


@pytest.fixture(scope="session")
def prediction(robot):
    return kc.simulate(robot.replace(length=0.5), kc.controls.sine(1.5, 60, DT), DT)


@pytest.fixture(scope="session")
def failed(truth):
    """Its rows from 40 on are not solved, as a simulation leaves them with `on_failure="return"`."""
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
def browser():
    module = _load_browser()
    if module.find() is None:
        pytest.skip(f"no browser: none of {', '.join(module.NAMES)} is installed")
    pytest.importorskip("websockets", reason="websockets, of the extra viz, drives the browser")
    started = module.Browser()
    yield started
    started.close()
