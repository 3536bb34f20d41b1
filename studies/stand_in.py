"""Closed loops around a test robot that PyElastica simulates: recordings, model, controllers.

The true robot differs from its data sheet: it is softer and less damped, its tendons rub, its motors lag, and
its sensors are noisy. The model is identified from three recordings; the lag from commanded and measured
tensions. An observer's measurement is trusted as far as the model predicts recordings left out.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import time as clock
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat import controls
from knode_cosserat.control import (
    Controller,
    ControlLimits,
    LoopLog,
    Reference,
    Sensor,
    controller_named,
    run_loop,
)
from knode_cosserat.control.commands import identified_lag
from knode_cosserat.control.planning import PlanController
from knode_cosserat.estimation.outputs import TipPosition
from knode_cosserat.estimation.parameters import Adapted
from knode_cosserat.identification import identify
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.tendon_robots import TendonRod
from knode_cosserat.rods.tendons import LoadCells
from studies.elastica.plant import ElasticaPlant, Recorded, record_elastica, sine_commands
from studies.elastica.rod import ElasticaRod, Imperfections

#: name of the robot in the study's tables, and the reason for a study without it
ROBOT = "PyElastica test robot, identified"
MISSING = "PyElastica test robot: left out, because it needs: pip install '.[studies]'"
#: true over nominal Young's modulus, and the true damping (N m² s; nominal is 0.03)
SOFTER, DAMPING = 0.8, 0.01
#: effects that are identified, beside stiffness and damping
EFFECTS = ("friction", "friction by curvature")
#: offsets of tensions that a controller adapts (N): of the size of the friction, and changing in seconds
OFFSETS = Adapted("load_cells.offset", 0.1, 0.3)
#: noise of the tip's position (m)
NOISE = 1.5e-4
#: time that a command of a recording is held, and its duration (s)
HELD, SECONDS = 0.05, 5.0


class Model(NamedTuple):
    """Identified model: the robot, the motors' lag (s), and its error on recordings left out (m)."""

    robot: TendonRod
    lag: float
    error: float


def is_available() -> bool:
    """Return True if PyElastica is installed."""
    return importlib.util.find_spec("elastica") is not None


def true_rod(nominal: TendonRod) -> ElasticaRod:
    """Return the test robot."""
    softer = nominal.replace(youngs_modulus=SOFTER * float(nominal.youngs_modulus), bending_damping=DAMPING)
    return ElasticaRod(softer, Imperfections())


def recordings(rod: ElasticaRod, seconds: float = SECONDS) -> list[Recorded]:
    """Return recordings of two sines, and of random commands, with rests before and after."""
    count = round(seconds / HELD)
    still = np.full((round(0.5 / HELD), rod.robot.tendon_count), 1.0)
    moved = controls.random(count, low=0.0, high=8.0, seed=5, hold=round(0.4 / HELD))
    signals = [
        sine_commands(seconds, HELD, 2.0, rest=3.0, swing=2.8),
        sine_commands(seconds, HELD, 0.9, rest=2.5, swing=2.2),
        np.concatenate([still, moved]),
    ]
    return [record_elastica(rod, signal, HELD, seed=k) for k, signal in enumerate(signals)]


def identified(nominal: TendonRod, recorded: Sequence[Recorded]) -> Model:
    """Return the model that these recordings give."""
    lags = []
    for commanded, measured in ((each.commanded, each.measured) for each in recorded):
        assert measured.initial_control is not None
        lags.append(identified_lag(commanded, measured.control, measured.dt, measured.initial_control))
    found = identify(nominal, [each.measured for each in recorded], EFFECTS)
    errors = [error for error in found.held_out_error.values() if error is not None]
    robot = found.robot
    assert isinstance(robot, TendonRod)
    return Model(robot, float(np.mean(lags)), float(np.mean(errors)))


def controller_of(model: Model, name: str, dt: float, limits: ControlLimits, adaptive: str) -> Controller:
    """Return a controller by its name, or the predictive one that adapts tensions by the name `adaptive`.

    Adapted offsets of the tensions stand for all errors of the model: friction that it predicts wrongly, too.
    """
    limits, robot = dataclasses.replace(limits, lag=model.lag), model.robot
    measured = TipPosition(sigma=model.error)
    if name != adaptive:
        return controller_named(name, robot, dt, limits, (), measured)
    count = robot.tendon_count
    robot = robot.replace(load_cells=LoadCells(gain=np.ones(count), offset=np.zeros(count)))
    return controller_named("predictive", robot, dt, limits, [OFFSETS], measured)


def tracked(
    settings: Mapping[str, Any],
    paths: Mapping[str, Reference],
    dt: float,
    limits: ControlLimits,
    seconds: float,
    error: Callable[[LoopLog, str], float],
) -> dict[str, Any]:
    """Return cells of the study's table for all controllers, and facts of the model.

    Args:
        settings: `robot`, the data sheet; `controllers`, names; `adaptive`, the name of the adaptive one;
            `few`, for some controllers the names of the references that they follow; all by default.
        paths: references by name.
        dt: period (s).
        limits: of the commands.
        seconds: duration of each loop (s).
        error: RMSE (m) of a log by the name of its reference.
    """
    nominal = load_robot(settings["robot"])
    assert isinstance(nominal, TendonRod)
    rod, began = true_rod(nominal), clock.perf_counter()
    recorded = recordings(rod)
    done = clock.perf_counter()
    model = identified(nominal, recorded)
    facts = {
        "lag": model.lag, "error_mm": 1e3 * model.error, "recording_s": done - began,
        "identification_s": clock.perf_counter() - done,
        "youngs_modulus": float(model.robot.youngs_modulus),
    }  # fmt: skip
    sensor = Sensor(TipPosition(), noise=NOISE / TipPosition().sigma)
    cells = []
    for name in settings["controllers"]:
        controller = controller_of(model, name, dt, limits, settings["adaptive"])
        followed = settings["few"].get(name, list(paths))
        for path in followed:
            if isinstance(controller, PlanController):
                controller.observer.restart()
            log = run_loop(controller, ElasticaPlant(rod, dt, sensor), paths[path], seconds)
            offset = float(np.median(log.tip_distance[_held(log)]))
            at = {"controller": name, "robot": ROBOT, "reference": path}
            cells.append(at | tracking_facts(log, error(log, path), offset, rod.robot))
    return {"cells": cells, "model": facts}


def tracking_facts(log: LoopLog, rmse: float, offset: float, truth: TendonRod) -> dict[str, Any]:
    """Return the tracking errors (m) of a loop as percent of the length, and what its controller adapted."""
    percent = 100.0 / float(truth.length)
    return {
        "rmse_percent": percent * rmse, "offset_percent": percent * offset, "fallbacks": log.fallbacks,
        "parameters": {name: float(values[-1]) for name, values in log.parameters.items()},
        "true_modulus": float(truth.youngs_modulus),
    }  # fmt: skip


def _held(log: LoopLog) -> Any:
    """Return True for rows from 1 to 2 s after a step of 3 s: the next one is not predicted yet."""
    within = log.time % 3.0
    return (log.time >= 5.0) & (within >= 1.0) & (within < 2.0)


def checks(cells: Sequence[Mapping[str, Any]], controller: str) -> list[tuple[str, float, float]]:
    """Return the study's checks of a controller (name, value, limit); none if the test robot was left out."""
    own = [cell for cell in cells if cell["robot"] == ROBOT and cell["controller"] == controller]
    moving = [cell["rmse_percent"] for cell in own if cell["reference"] != "steps"]
    steady = [cell["offset_percent"] for cell in own if cell["reference"] == "steps"]
    if not own:
        return []
    return [
        (f"tip RMSE, {ROBOT}, circles and figure of eight (% of length)", max(moving), 1.0),
        (f"offset, {ROBOT}, 1 to 2 s after a step (% of length)", max(steady), 0.3),
    ]
