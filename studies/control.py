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
from jaxtyping import Float

from knode_cosserat.control import (
    Controller,
    ControlLimits,
    LoopLog,
    PredictiveController,
    Reference,
    Sensor,
    SimulatedPlant,
    circle,
    controller_named,
    figure_eight,
    run_loop,
    steps,
)
from knode_cosserat.control.commands import CONTROLLERS
from knode_cosserat.control.planning import PlanController
from knode_cosserat.estimation import Adapted, KalmanObserver, MovingHorizonObserver, TipPosition
from knode_cosserat.estimation.observer import TENSION_DEVIATION
from knode_cosserat.recordings.estimation.estimate import estimate_states
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.loads import AttachedMass, PointWrench
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.tendon_robots import TendonRod
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.places import places_at, positions_at, quaternions_at
from studies import stand_in
from studies.report import Report, as_json, check_row, checks_table, markdown_table, write_report
from studies.runner import Job, Product, run

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
#: tensions (N) of the equilibrium in which observers begin, without knowing it
STILL = np.array([4.0, 1.0, 1.0, 2.0])


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


def controller_of_study(name: str) -> Controller:
    """Return a controller of the study by its name."""
    if name == ADAPTIVE:
        return predictive(nominal_robot())
    return controller_named(name, nominal_robot(), DT, LIMITS)


#: controllers that are slower than real time
SLOW = ("ilqr", "mppi")
#: robots that a quick study has for the controllers that it compares with
FEW = ("exact model", "stiffness +30%", "unknown 50 g at the tip")


def cases_of(name: str, quick: bool) -> tuple[list[str], list[str]]:
    """Return the names of robots and references of a controller: all, or the few of a quick study."""
    robots, paths = list(true_robots()), list(references())
    if not quick or name == ADAPTIVE:
        return robots, paths
    return list(FEW), paths[:1] if name in SLOW else paths


def jobs(quick: bool) -> list[Job]:
    """Return one job for each controller, and one for each further check."""
    made = [
        Job(f"tracking-{name}", tracking, {"controller": name, "quick": quick})
        for name in (ADAPTIVE, *CONTROLLERS)
    ]
    if stand_in.is_available():
        made.append(Job("tracking-stand-in", on_stand_in, {"quick": quick}))
    made.append(Job("limits", limits, {"runs": 20 if quick else 1000}))
    made.append(Job("observer", observers, {"runs": 20 if quick else 50}))
    made.append(Job("smoother", smoother, {"runs": 3 if quick else 20}))
    made.append(Job("force", force, {"runs": 3 if quick else 6}))
    made.append(Job("rest", rest, {"seconds": 30.0 if quick else 600.0}))
    made.append(Job("times", times, {"seconds": 20.0 if quick else 600.0}))
    return made


def rerun(out: Path, quick: bool = False, **how: Any) -> Report:
    """Run the study, and write control.json, control.md and tracking.json; interrupted runs are continued.

    Args:
        out: the folder; an earlier run in it is continued.
        quick: fewer and shorter runs.
        how: as `runner.run` has it.
    """
    facts = run(jobs(quick), out, **how)
    cells = [cell for name, found in facts.items() if name.startswith("tracking-") for cell in found["cells"]]
    made = checks(facts, cells)
    return write_report(
        out, "control", made, as_markdown(cells, made), others={"tracking.json": as_json(cells)}
    )


def tracking(settings: Any) -> Product:
    """Return a controller's tracking errors for all robots and references."""
    controller = controller_of_study(settings["controller"])
    cells = []
    robots, paths = cases_of(settings["controller"], settings["quick"])
    for name, truth in true_robots().items():
        if name not in robots:
            continue
        plant = SimulatedPlant(truth, DT, Sensor(TipPosition()))
        for path in paths:
            reference = references()[path]
            _fresh(controller)
            log = run_loop(controller, plant, reference, SECONDS)
            at = {"controller": settings["controller"], "robot": name, "reference": path}
            offset = float(log.tip_distance[-1])
            cells.append(at | stand_in.tracking_facts(log, _rmse(log, path), offset, truth))
    return Product({"cells": cells}, {})


def on_stand_in(settings: Any) -> Product:
    """Return the tracking errors of all controllers on the PyElastica test robot, with its model."""
    names, paths = [ADAPTIVE, *CONTROLLERS], references()
    # a loop around the test robot takes almost as long as the robot would
    few = {name: [] if name in SLOW else list(paths)[:2] for name in CONTROLLERS} if settings["quick"] else {}
    given = {"robot": NOMINAL, "controllers": names, "adaptive": ADAPTIVE, "few": few}
    return Product(stand_in.tracked(given, paths, DT, LIMITS, SECONDS, _rmse), {})


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


# the report


def checks(facts: Mapping[str, Any], cells: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the figures of the study with their limits: check, value, limit, ok."""
    own = [cell for cell in cells if cell["controller"] == ADAPTIVE]

    def worst(robot: str, field: str = "rmse_percent") -> float:
        return max(cell[field] for cell in own if cell["robot"].startswith(robot))

    modulus = [
        abs(cell["parameters"]["youngs_modulus"] / cell["true_modulus"] - 1.0)
        for cell in own
        if cell["robot"].startswith("stiffness") and "steps" not in cell["reference"]
    ]
    slow, fast = facts["times"]["0.05"], facts["times"]["0.02"]
    smooth = facts["smoother"]["shape_error_percent"]
    observed = []
    for name, found in facts["observer"].items():
        error = found["shape_error_percent"]
        observed += [
            (f"shape 1 s after a wrong start, {name} (% of length)", error, 0.5),
            (f"the same, {name}, relative to the offline smoother with all bodies", error / smooth, 2.0),
            (
                f"95 % regions, {name}: distance of their coverage from 94 % (%)",
                abs(100.0 * found["coverage"] - 94.0), 4.0,
            ),
            (f"step, {name} (ms)", found["step_ms"], 5.0),
        ]  # fmt: skip
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
        ("external force at the tip after 6 s (relative error)", facts["force"]["error"], 0.1),
        (f"hard limits exceeded in {facts['limits']['runs']} runs (times)", facts["limits"]["exceeded"], 0),
        *observed,
        ("drift of the stiffness at rest (%)", facts["rest"]["drift_percent"], 3.0),
        ("feedback at 20 Hz, p99 (ms)", slow["feedback_p99_ms"], 5.0),
        ("cycle at 20 Hz, p99 (ms)", slow["cycle_p99_ms"], 25.0),
        ("cycle at 50 Hz, p99 (ms)", fast["cycle_p99_ms"], 12.0),
        ("missed deadlines at 20 Hz", slow["missed"], 0),
        *stand_in.checks(cells, ADAPTIVE),
    ]  # fmt: skip
    return [check_row(name, float(value), limit) for name, value, limit in listed]


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
    return (
        "\n\n".join(
            [
                "# Closed-loop control",
                f"Simulated robots, exact measurements of the tip, control at {1.0 / DT:.0f} Hz. Tip RMSE in "
                f"% of the length from {SETTLED:g} to {SECONDS:g} s; after a step from {TRANSIT:g} s on.",
                markdown_table(["robot", "controller", *paths], rows),
                checks_table(made),
                *([] if any(cell["robot"] == stand_in.ROBOT for cell in cells) else [stand_in.MISSING]),
            ]
        )
        + "\n"
    )


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
            "runs": settings["runs"],
            "exceeded": exceeded,
            "fallbacks": fallbacks,
            "periods": periods,
            "late": late,
        },
        {},
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
    for control in swinging_tensions():
        measured = plant.measure()
        began = clock.perf_counter()
        observer.update(measured)
        times.append(clock.perf_counter() - began)
        found, truth = observer.estimate, plant.state
        apart = np.asarray(Drawing.of(robot).positions(found.y)) - np.asarray(truth.position[-1])
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
            time=DT * np.arange(len(controls)),
            control=controls,
            fractions=np.array(BODIES),
            position=position + TipPosition().sigma * rng.normal(size=position.shape),
            quaternion=quaternion + TURN_NOISE * rng.normal(size=quaternion.shape),
            measured=np.ones(position.shape[:2], dtype=bool),
            simulated=True,
            source="study of control",
            initial_control=STILL,
        )
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
