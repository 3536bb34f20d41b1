"""Study of closed-loop control: tracking, adaptation, observers, faults and times, with their limits.

One controller with default settings serves all cases. It adapts Young's modulus and a mass at the tip, so
that the cases also show what adaptation costs where nothing is wrong.
"""

from __future__ import annotations

import time as clock
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from knode_cosserat.control import (
    ControlLimits,
    LoopLog,
    PredictiveController,
    Reference,
    Sensor,
    SimulatedPlant,
    circle,
    figure_eight,
    run_loop,
    steps,
)
from knode_cosserat.control.commands import Controller
from knode_cosserat.control.named import NAMES, controller_named
from knode_cosserat.control.planning import PlanController
from knode_cosserat.estimation import Adapted, KalmanObserver, MovingHorizonObserver, TipPosition
from knode_cosserat.estimation.observer import TENSION_DEVIATION
from knode_cosserat.evaluation.tables import markdown_table
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.tendon_rod import TendonRod
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.studies import stand_in
from knode_cosserat.studies.report import Report, as_json, write_texts
from knode_cosserat.studies.runner import Job, Product, run

#: the robot, period (s) of control, and limits of the tensions (N, N/s)
NOMINAL, DT = "delrin-tendon-robot", 0.05
LOW, HIGH, RATE = 0.0, 10.0, 40.0
LIMITS = ControlLimits(LOW, HIGH, RATE)
#: name of the controller that adapts parameters
ADAPTIVE = "predictive, adaptive"
#: time (s) that each step is held, and that the robot may take to get there
HOLD, TRANSIT = 3.0, 1.0
#: duration of a case, and time from which errors count (s)
SECONDS, SETTLED = 12.0, 5.0
#: mass at the tip (kg): its deviation in the controller, and the unknown masses that are tried
MASS, PAYLOADS = 0.03, (0.01, 0.05)
#: relative errors of the model
WRONG = 0.3
#: tensions (N) of the equilibrium in which observers begin, without knowing it; observers by name
STILL = np.array([4.0, 1.0, 1.0, 2.0])
OBSERVERS = {"Kalman": KalmanObserver, "moving horizon": MovingHorizonObserver}


def references() -> dict[str, Reference]:
    """Return the references of the study by name."""
    points = [[0.0, 0.0], [0.08, 0.0], [0.0, 0.08], [-0.05, -0.05]]
    return {
        "circle, 4 s": circle(0.1, 4.0),
        "circle, 1.5 s": circle(0.1, 1.5),
        "figure of eight, 5 s": figure_eight(0.1, 5.0),
        "steps": steps([[*point, np.nan] for point in points], HOLD),
    }


def nominal_robot() -> TendonRod:
    """Return the model of the study: the paper's robot with a mass of zero at its tip."""
    robot = load_robot(NOMINAL)
    assert isinstance(robot, TendonRod)
    return robot.replace(loads=(AttachedMass(mass=0.0),))


def true_robots() -> dict[str, TendonRod]:
    """Return the controlled robots by name: the model itself, and others."""
    model = nominal_robot()
    stiff = float(model.youngs_modulus)
    found = {"exact model": model}
    for factor in (1.0 - WRONG, 1.0 + WRONG):
        # the model is wrong by this factor
        found[f"stiffness {factor - 1.0:+.0%}"] = model.replace(youngs_modulus=stiff / factor)
    for mass in PAYLOADS:
        found[f"unknown {1e3 * mass:.0f} g at the tip"] = model.replace(**{"loads.0.mass": mass})
    return found


def predictive(model: TendonRod, dt: float = DT) -> PredictiveController:
    """Return the controller of the study, which adapts stiffness and a mass at the tip."""
    found = controller_named(
        "predictive", model, dt, LIMITS, ["youngs_modulus", Adapted("loads.0.mass", MASS)]
    )
    assert isinstance(found, PredictiveController)
    return found


def _controller(name: str) -> Controller:
    """Return a controller of the study by its name."""
    if name == ADAPTIVE:
        return predictive(nominal_robot())
    return controller_named(name, nominal_robot(), DT, LIMITS)


#: controllers that are slower than real time: a quick study has only these robots and references for them
SLOW = ("ilqr", "mppi")
FEW = ("exact model", "stiffness +30%"), ("circle, 4 s", "circle, 1.5 s")


# jobs


def jobs(quick: bool) -> list[Job]:
    """Return one job for each controller, and one for each further check."""
    made = [
        Job(f"tracking-{name}", tracking, {"controller": name, "few": quick and name in SLOW})
        for name in (ADAPTIVE, *NAMES)
    ]
    if stand_in.is_available():
        made.append(Job("tracking-stand-in", on_stand_in, {"quick": quick}))
    made.append(Job("limits", limits, {"runs": 20 if quick else 1000}))
    made.append(Job("observer", observers, {"runs": 6 if quick else 50}))
    made.append(Job("rest", rest, {"seconds": 30.0 if quick else 600.0}))
    made.append(Job("times", times, {"seconds": 20.0 if quick else 600.0}))
    return made


def rerun(out: Path, quick: bool = False, **how: Any) -> Report:
    """Run the study, and write control.json, control.md and tracking.json; interrupted runs are continued.

    Args:
        out: the folder.
        quick: fewer and shorter runs.
        how: `workers`, `dask`, `progress` as `runner.run` has them.
    """
    facts = run(jobs(quick), out, **how)
    cells = [cell for name, found in facts.items() if name.startswith("tracking-") for cell in found["cells"]]
    made = checks(facts, cells)
    texts = {
        "control.md": as_markdown(cells, made),
        "control.json": as_json(made),
        "tracking.json": as_json(cells),
    }
    return Report(made, write_texts(out, texts), [])


def tracking(settings: Any) -> Product:
    """Return a controller's tracking errors for all robots and references."""
    controller = _controller(settings["controller"])
    cells = []
    few = settings["few"]
    for name, truth in true_robots().items():
        if few and name not in FEW[0]:
            continue
        plant = SimulatedPlant(truth, DT, Sensor(TipPosition()))
        for path, reference in references().items():
            if few and path not in FEW[1]:
                continue
            _fresh(controller)
            log = run_loop(controller, plant, reference, SECONDS)
            found = {name: values[-1] for name, values in log.parameters.items()}
            cells.append(
                {
                    "controller": settings["controller"],
                    "robot": name,
                    "reference": path,
                    "rmse_percent": 100.0 * _rmse(log, path) / float(truth.length),
                    "offset_percent": 100.0 * float(log.tip_distance[-1] / truth.length),
                    "fallbacks": log.fallbacks,
                    "parameters": found,
                    "true_modulus": float(truth.youngs_modulus),
                }
            )
    return Product({"cells": cells}, {})


def on_stand_in(settings: Any) -> Product:
    """Return the tracking errors of all controllers on the PyElastica stand-in, with its identified model."""
    given = {"robot": NOMINAL, "controllers": [ADAPTIVE, *NAMES], "adaptive": ADAPTIVE}
    given["few"] = SLOW if settings["quick"] else ()
    return Product(stand_in.tracked(given, references(), DT, LIMITS, SECONDS, _rmse), {})


def _fresh(controller: Controller) -> None:
    """Let the observer forget the parameters of the run before."""
    if isinstance(controller, PlanController):
        controller.observer.restart()


def _rmse(log: LoopLog, path: str) -> float:
    """Return the RMSE (m) of settled rows; after a jump of the reference, those from `TRANSIT` on."""
    rows = log.time >= SETTLED
    if path == "steps":
        rows &= log.time % HOLD >= TRANSIT
    return float(np.sqrt(np.mean(log.tip_distance[rows] ** 2)))


def limits(settings: Any) -> Product:
    """Return how often hard limits were exceeded in random runs with noise, lost and wrong measurements."""
    rng, model = np.random.default_rng(0), nominal_robot()
    controller = predictive(model)
    exceeded, fallbacks, periods = 0, 0, 0
    for k in range(settings["runs"]):
        controller.observer.restart()
        truth = model.replace(
            youngs_modulus=float(model.youngs_modulus) * rng.uniform(0.7, 1.4),
            **{"loads.0.mass": rng.uniform(0.0, 0.05)},
        )
        sensor = Sensor(TipPosition(), noise=rng.uniform(0.0, 3.0), dropout=rng.uniform(0.0, 0.3), seed=k)
        reference = circle(rng.uniform(0.02, 0.4), rng.uniform(0.8, 6.0), rise=rng.uniform(0.0, 2.0))
        log = run_loop(controller, SimulatedPlant(truth, DT, sensor), reference, 3.0)
        changes = np.abs(np.diff(log.control, axis=0))
        exceeded += int(
            np.sum((log.control < LOW) | (log.control > HIGH)) + np.sum(changes > RATE * DT + 1e-9)
        )
        fallbacks, periods = fallbacks + log.fallbacks, periods + len(log.time)
    return Product(
        {"runs": settings["runs"], "exceeded": exceeded, "fallbacks": fallbacks, "periods": periods}, {}
    )


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
    for control in STILL + np.sin(np.arange(60)[:, None] * DT * 4.0 + np.arange(4)) * 0.8:
        measured = plant.measure()
        began = clock.perf_counter()
        observer.update(measured)
        times.append(clock.perf_counter() - began)
        found, truth = observer.estimate, plant.state
        apart = np.asarray(robot.positions(found.y)) - np.asarray(truth.position[-1])
        errors.append(float(np.sqrt(np.mean(np.sum(apart**2, axis=-1)))) / float(robot.length))
        inside.append(observer.covers(truth))
        plant.apply(control)
        began = clock.perf_counter()
        observer.predict(control)
        times[-1] += clock.perf_counter() - began
    return errors, inside, times


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


# the report


def checks(facts: Mapping[str, Any], cells: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the figures of the study with their limits: check, value, limit, ok."""
    own = [cell for cell in cells if cell["controller"] == ADAPTIVE]

    def worst(robot: str, field: str = "rmse_percent") -> float:
        return max(cell[field] for cell in own if cell["robot"].startswith(robot))

    modulus = [
        abs(cell["parameters"]["youngs_modulus"] / cell["true_modulus"] - 1.0)
        for cell in own if cell["robot"].startswith("stiffness") and "steps" not in cell["reference"]
    ]  # fmt: skip
    slow, fast = facts["times"]["0.05"], facts["times"]["0.02"]
    steady = max(
        cell["offset_percent"]
        for cell in own
        if cell["robot"].startswith("unknown") and cell["reference"] == "steps"
    )
    listed = [
        ("tip RMSE, exact model (% of length)", worst("exact"), 0.1),
        ("tip RMSE, stiffness wrong by 30 % (% of length)", worst("stiffness"), 0.5),
        ("steady offset, unknown 10 and 50 g at the tip (% of length)", steady, 0.1),
        ("stiffness after 12 s (relative error)", max(modulus), 0.03),
        ("hard limits exceeded (times)", facts["limits"]["exceeded"], 0),
        *(
            (f"shape 1 s after a wrong start, {name} (% of length)", found["shape_error_percent"], 0.5)
            for name, found in facts["observer"].items()
        ),
        *(
            (
                f"95 % regions, {name}: distance of their coverage from 94 % (%)",
                abs(100.0 * found["coverage"] - 94.0),
                4.0,
            )
            for name, found in facts["observer"].items()
        ),
        *((f"step, {name} (ms)", found["step_ms"], 5.0) for name, found in facts["observer"].items()),
        ("drift of the stiffness at rest (%)", facts["rest"]["drift_percent"], 3.0),
        ("feedback at 20 Hz, p99 (ms)", slow["feedback_p99_ms"], 5.0),
        ("cycle at 20 Hz, p99 (ms)", slow["cycle_p99_ms"], 25.0),
        ("cycle at 50 Hz, p99 (ms)", fast["cycle_p99_ms"], 12.0),
        ("missed deadlines at 20 Hz", slow["missed"], 0),
        *stand_in.checks(cells, ADAPTIVE),
    ]  # fmt: skip
    return [
        {"check": name, "value": float(value), "limit": limit, "ok": bool(value <= limit)}
        for name, value, limit in listed
    ]


def as_markdown(cells: Sequence[Mapping[str, Any]], made: Sequence[Mapping[str, Any]]) -> str:
    """Return the tables in Markdown: tracking errors, and the checks."""
    paths = list(references())
    rows = []
    for name in dict.fromkeys(cell["robot"] for cell in cells):
        for controller in dict.fromkeys(cell["controller"] for cell in cells):
            own = {c["reference"]: c for c in cells if c["robot"] == name and c["controller"] == controller}
            if own:
                tracked = [f"{own[path]['rmse_percent']:.3g}" if path in own else "not run" for path in paths]
                rows.append([name, controller, *tracked])
    checked = [[c["check"], f"{c['value']:.3g}", f"{c['limit']:g}", "yes" if c["ok"] else "no"] for c in made]
    return "\n\n".join(
        [
            "# Closed-loop control",
            f"Simulated robots, exact measurements of the tip, control at {1.0 / DT:.0f} Hz. Tip RMSE in "
            f"% of the length from {SETTLED:g} to {SECONDS:g} s; after a step from {TRANSIT:g} s on.",
            markdown_table(["robot", "controller", *paths], rows),
            markdown_table(["check", "value", "limit", "met"], checked),
            *([] if any(cell["robot"] == stand_in.ROBOT for cell in cells) else [stand_in.MISSING]),
        ]
    ) + "\n"  # fmt: skip
