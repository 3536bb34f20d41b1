"""Study of closed-loop control: tracking, adaptation, observers, faults and times, with their limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from knode_cosserat.control import CONTROLLERS, Controller, LoopLog, Sensor, SimulatedPlant, run_loop
from knode_cosserat.control.planning import PlanController
from knode_cosserat.estimation import TipPosition
from knode_cosserat.evaluation.tables import markdown_table
from knode_cosserat.studies import stand_in
from knode_cosserat.studies.control_cases import (
    ADAPTIVE,
    DT,
    HOLD,
    LIMITS,
    NOMINAL,
    SECONDS,
    SETTLED,
    SLOW,
    TRANSIT,
    cases_of,
    controller_of_study,
    references,
    true_robots,
)  # fmt: skip
from knode_cosserat.studies.control_checks import force, limits, observers, rest, smoother, times
from knode_cosserat.studies.report import Report, as_json, check_row, checks_table, write_texts
from knode_cosserat.studies.runner import Job, Product, run


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
    names, paths = [ADAPTIVE, *CONTROLLERS], references()
    # a loop around the stand-in takes almost as long as the robot would
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
        ("external force at the tip after 6 s (relative error)", facts["force"]["error"], 0.1),
        (f"hard limits exceeded in {facts['limits']['runs']} runs (times)", facts["limits"]["exceeded"], 0),
        *(
            (f"shape 1 s after a wrong start, {name} (% of length)", found["shape_error_percent"], 0.5)
            for name, found in facts["observer"].items()
        ),
        *(
            (
                f"the same, {name}, relative to the offline smoother with all bodies",
                found["shape_error_percent"] / facts["smoother"]["shape_error_percent"],
                2.0,
            )
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
    return "\n\n".join(
        [
            "# Closed-loop control",
            f"Simulated robots, exact measurements of the tip, control at {1.0 / DT:.0f} Hz. Tip RMSE in "
            f"% of the length from {SETTLED:g} to {SECONDS:g} s; after a step from {TRANSIT:g} s on.",
            markdown_table(["robot", "controller", *paths], rows),
            checks_table(made),
            *([] if any(cell["robot"] == stand_in.ROBOT for cell in cells) else [stand_in.MISSING]),
        ]
    ) + "\n"  # fmt: skip
