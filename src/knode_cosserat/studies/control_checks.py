"""Checks of closed loops beside tracking: hard limits, observers, adaptation, and times."""

from __future__ import annotations

import time as clock
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.control import Sensor, SimulatedPlant, circle, run_loop, steps
from knode_cosserat.estimation import (
    Adapted,
    KalmanObserver,
    MovingHorizonObserver,
    TipPosition,
)  # fmt: skip
from knode_cosserat.estimation.observer import TENSION_DEVIATION
from knode_cosserat.recordings.estimation.estimate import estimate_states
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.rods.loads import PointWrench
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.places import places_at, positions_at, quaternions_at
from knode_cosserat.studies.control_cases import (
    DT,
    HIGH,
    LOW,
    NOMINAL,
    RATE,
    STILL,
    WRONG,
    nominal_robot,
    predictive,
)  # fmt: skip
from knode_cosserat.studies.runner import Product

#: observers by name
OBSERVERS = {"Kalman": KalmanObserver, "moving horizon": MovingHorizonObserver}
#: places of the bodies that the offline smoother uses, and the noise of their quaternions
BODIES, TURN_NOISE = (0.25, 0.5, 0.75, 1.0), 2e-3
#: unknown force at the tip (N), and the seconds after which it is compared
FORCE, FOUND = np.array([0.06, -0.04, 0.05]), 6.0


def limits(settings: Any) -> Product:
    """Return how often hard limits were exceeded in random runs.

    Robots, their models' errors, targets (some out of reach), noise, disturbances of the controls and lost
    measurements are random.
    """
    rng, nominal = np.random.default_rng(0), nominal_robot()
    exceeded, fallbacks, periods, late = 0, 0, 0, 0
    for k in range(settings["runs"]):
        model = nominal.replace(
            length=float(nominal.length) * rng.uniform(0.7, 1.2),
            radius=float(nominal.radius) * rng.uniform(0.9, 1.2),
            bending_damping=np.asarray(nominal.bending_damping) * rng.uniform(0.3, 2.0),
        )
        truth = model.replace(
            youngs_modulus=float(model.youngs_modulus) * rng.uniform(0.7, 1.4),
            **{"loads.0.mass": rng.uniform(0.0, 0.05)},
        )
        sensor = Sensor(TipPosition(), noise=rng.uniform(0.0, 3.0), dropout=rng.uniform(0.0, 0.3), seed=k)
        plant = SimulatedPlant(truth, DT, sensor, control_noise=rng.uniform(0.0, 0.3))
        reference = circle(rng.uniform(0.02, 0.4), rng.uniform(0.8, 6.0), rise=rng.uniform(0.0, 2.0))
        log = run_loop(predictive(model), plant, reference, 3.0)
        changes = np.abs(np.diff(log.control, axis=0))
        exceeded += int(
            np.sum((log.control < LOW) | (log.control > HIGH)) + np.sum(changes > RATE * DT + 1e-9)
        )
        fallbacks, periods = fallbacks + log.fallbacks, periods + len(log.time)
        late += int(np.sum(log.feedback + log.preparation > DT))
    return Product(
        {
            "runs": settings["runs"], "exceeded": exceeded, "fallbacks": fallbacks, "periods": periods,
            "late": late,
        },
        {},
    )  # fmt: skip


def observers(settings: Any) -> Product:
    """Return errors of the shape 1 s after a wrong start, from the tip's position alone, and coverage."""
    robot = load_robot(NOMINAL)
    start = equilibrium(robot, STILL)
    facts: dict[str, Any] = {}
    for name, kind in OBSERVERS.items():
        observer = kind(robot, DT, TipPosition(), start_deviation=2.0)
        worst, inside, times = [], [], []
        for seed in range(settings["runs"]):
            observer.restart()
            errors, covered, took = _observed(observer, start, seed)
            worst.append(max(errors[20:25]))
            inside += covered[20:]
            times += took[2:]
        facts[name] = {
            "shape_error_percent": 100.0 * max(worst),
            "coverage": float(np.mean(inside)),
            "step_ms": 1e3 * float(np.median(times)),
        }
    return Product(facts, {})


def _observed(observer: KalmanObserver, start: Any, seed: int) -> tuple[list[float], list[bool], list[float]]:
    """Return errors of the shape (parts of the length), whether the regions cover the tip, and times (s)."""
    robot = observer.robot
    sensor, noise = Sensor(TipPosition(), noise=1.0, seed=seed), TENSION_DEVIATION
    plant = SimulatedPlant(robot, DT, sensor, control_noise=noise, initial=start)
    errors, inside, times = [], [], []
    for control in swinging_tensions():
        measured = plant.measure()
        began = clock.perf_counter()
        observer.update(measured)
        times.append(clock.perf_counter() - began)
        found, truth = observer.estimate, plant.state
        apart = np.asarray(robot.drawing.positions(found.y)) - np.asarray(truth.position[-1])
        errors.append(float(np.sqrt(np.mean(np.sum(apart**2, axis=-1)))) / float(robot.length))
        inside.append(observer.covers(truth))
        plant.apply(control)
        began = clock.perf_counter()
        observer.predict(control)
        times[-1] += clock.perf_counter() - began
    return errors, inside, times


def swinging_tensions(steps: int = 60) -> Float[np.ndarray, "steps 4"]:
    """Return the tensions (N) of the motions that are observed."""
    swing = np.sin(np.arange(steps)[:, None] * DT * 4.0 + np.arange(4)) * 0.8
    return np.asarray(STILL + swing)


def smoother(settings: Any) -> Product:
    """Return the error of the offline smoother, which knows all measured poses of the same motions."""
    robot = load_robot(NOMINAL)
    start, places = equilibrium(robot, STILL), places_at(np.array(BODIES), robot.nodes)
    worst = []
    for seed in range(settings["runs"]):
        rng = np.random.default_rng(seed)
        plant = SimulatedPlant(
            robot, DT, Sensor(TipPosition(), seed=seed), control_noise=TENSION_DEVIATION, initial=start
        )
        controls = swinging_tensions()
        seen, turned, true = [], [], []
        for control in controls:
            y, z = np.asarray(plant.state.y), np.asarray(plant.state.z)
            seen.append(np.asarray(positions_at(robot, y, places, z))[0])
            turned.append(np.asarray(quaternions_at(robot, y, places))[0])
            true.append(np.asarray(plant.state.position[0]))
            plant.apply(control)
        position, quaternion = np.array(seen), np.array(turned)
        measured = Measurements(
            time=DT * np.arange(len(controls)), tension=controls, fractions=np.array(BODIES),
            position=position + TipPosition().sigma * rng.normal(size=position.shape),
            quaternion=quaternion + TURN_NOISE * rng.normal(size=quaternion.shape),
            measured=np.ones(position.shape[:2], dtype=bool), simulated=True, source="study of control",
            initial_tension=STILL,
        )  # fmt: skip
        apart = np.asarray(estimate_states(measured, robot).position) - np.array(true)
        errors = np.sqrt(np.mean(np.sum(apart**2, axis=-1), axis=-1)) / float(robot.length)
        worst.append(max(errors[20:25]))
    return Product({"shape_error_percent": 100.0 * float(max(worst))}, {})


def force(settings: Any) -> Product:
    """Return the relative error of an unknown force at the tip, from the noisy position of the tip alone."""
    model = load_robot(NOMINAL).replace(loads=(PointWrench(),))
    observer = KalmanObserver(model, DT, TipPosition(), adapt=[Adapted("loads.0.force", 0.1)])
    worst = 0.0
    for seed in range(settings["runs"]):
        observer.restart()
        # the force points elsewhere in each run
        acting = np.roll(FORCE, seed) * (1 if seed < len(FORCE) else -1)
        truth = model.replace(**{"loads.0.force": acting})
        plant = SimulatedPlant(truth, DT, Sensor(TipPosition(), noise=1.0, seed=seed))
        for control in swinging_tensions(round(FOUND / DT)):
            observer.update(plant.measure())
            plant.apply(control)
            observer.predict(control)
        found = np.array(list(observer.estimate.parameters.values()))
        worst = max(worst, float(np.linalg.norm(found - acting) / np.linalg.norm(acting)))
    return Product({"error": worst}, {})


def rest(settings: Any) -> Product:
    """Return the drift of the adapted stiffness of a robot that is held still, with noise."""
    model = nominal_robot()
    controller = predictive(model.replace(youngs_modulus=(1.0 + WRONG) * float(model.youngs_modulus)))
    still = steps([[0.05, 0.0, np.nan]], 1.0)
    log = run_loop(
        controller, SimulatedPlant(model, DT, Sensor(TipPosition(), noise=0.5)), still, settings["seconds"]
    )
    modulus = log.parameters["youngs_modulus"] / float(model.youngs_modulus) - 1.0
    after = log.time > 10.0
    return Product({"drift_percent": 100.0 * float(np.ptp(modulus[after])), "fallbacks": log.fallbacks}, {})


def times(settings: Any) -> Product:
    """Return times of feedback and of whole cycles, and missed deadlines, in real time."""
    model = nominal_robot()
    facts: dict[str, Any] = {}
    for dt in (0.05, 0.02):
        controller = predictive(model, dt)
        plant = SimulatedPlant(model, dt, Sensor(TipPosition(), noise=0.5))
        log = run_loop(controller, plant, circle(0.1, 4.0), settings["seconds"], paced=True)
        facts[f"{dt:g}"] = log.summary() | {"periods": len(log.time)}
    return Product(facts, {})
