"""Closed-loop control, its study and the times of its parts: `python -m benchmarks.control [--full]`.

Writes benchmarks/control.json and prints the tables of docs/control.md. The quick study takes ten minutes.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.run import machine

RESULTS = Path("benchmarks/control.json")
ROUNDS = 200


def _milliseconds(function: Callable[[], Any]) -> float:
    """Median time of a compiled function."""
    import jax

    jax.block_until_ready(function())
    taken = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        jax.block_until_ready(function())
        taken.append(time.perf_counter() - began)
    return 1e3 * statistics.median(taken)


def costs() -> dict[str, Any]:
    """A prediction over the horizon, and its derivatives by the tangents of the steps and by JAX."""
    import jax
    import numpy as np

    from knode_cosserat.control import circle
    from knode_cosserat.engine.pattern import Pattern
    from knode_cosserat.estimation.online import Spread, errors_of
    from knode_cosserat.solvers.rollout import rollout
    from knode_cosserat.solvers.run import TimeIntegration
    from studies.control import DT, nominal_robot, predictive

    controller = predictive(nominal_robot())
    observer = controller.observer
    # tensions that move the robot all the time
    plan = 3.0 + np.sin(np.arange(controller._plan.size).reshape(controller._plan.shape))
    for _ in range(3):
        observer.predict(plan[0])
    model, belief, basis = observer.model, observer.belief, controller._basis
    wanted = controller.wanted(0.0, circle(0.1, 4.0))
    task = TimeIntegration(model.settings, DT, len(wanted), recovery_budget=0)

    @jax.jit
    def errors(plan: Any) -> Any:
        system = model.parameters(belief.x)
        rows, _ = rollout(task, Pattern.of(system))(system, basis @ plan, belief.past)
        return errors_of(model.robot, controller.target, rows.records, wanted)

    by_jax = jax.jit(jax.jacfwd(errors))
    few = belief._replace(spread=Spread(*(part[:1] for part in belief.spread)))
    controls = np.asarray(basis) @ plan

    def linearised(belief: Any) -> Callable[[], Any]:
        def predict() -> Any:
            observer.belief = belief
            return controller.predicted(plan, wanted).error

        return predict

    return {
        "periods": len(wanted),
        "columns": int(plan.size),
        "state_columns": len(belief.spread.records),
        "simulated": _milliseconds(lambda: task.solve(model.robot, controls, belief.past, (0, len(wanted)))),
        "by_jax": _milliseconds(lambda: by_jax(plan)),
        "by_tangents": _milliseconds(linearised(few)),
        "with_state": _milliseconds(linearised(belief)),
    }


def table(found: Mapping[str, Any]) -> str:
    """Return the tables in Markdown."""
    from studies.report import markdown_table

    cost = found["costs"]
    rows = [
        (f"simulation of {cost['periods']} periods", cost["simulated"]),
        (f"with {cost['columns']} derivatives by the plan, `jax.jacfwd`", cost["by_jax"]),
        (f"with {cost['columns'] + 1} derivatives, tangents of the steps", cost["by_tangents"]),
        (f"with {cost['columns'] + cost['state_columns']} derivatives, as in the loop", cost["with_state"]),
    ]
    costs_table = markdown_table(["prediction", "ms"], [[name, f"{value:.1f}"] for name, value in rows])
    return "\n\n".join([tracking_table(found["tracking"]), checks_table(found["checks"]), costs_table])


def tracking_table(cells: Sequence[Mapping[str, Any]]) -> str:
    """Return the tracking errors of all controllers; the worst of robots of one kind."""
    from studies.report import markdown_table

    def kind(robot: str) -> str:
        if robot.startswith("stiffness"):
            return "stiffness wrong by 30 %"
        return "unknown 10 or 50 g at the tip" if robot.startswith("unknown") else robot

    paths = list(dict.fromkeys(cell["reference"] for cell in cells))
    rows = []
    for robot in dict.fromkeys(kind(cell["robot"]) for cell in cells):
        for name in dict.fromkeys(cell["controller"] for cell in cells):
            own = [cell for cell in cells if kind(cell["robot"]) == robot and cell["controller"] == name]
            worst = [
                max((cell["rmse_percent"] for cell in own if cell["reference"] == path), default=None)
                for path in paths
            ]
            if own:
                rows.append([robot, name, *("–" if w is None else f"{w:.2g}" for w in worst)])
    return markdown_table(["robot", "controller", *paths], rows)


def checks_table(checks: Sequence[Mapping[str, Any]]) -> str:
    """Return the checks with their limits."""
    from studies.report import markdown_table

    rows = [
        [each["check"], f"{each['value']:.2g}", f"{each['limit']:g}", "met" if each["ok"] else "**missed**"]
        for each in checks
    ]
    return markdown_table(["check", "value", "limit", "result"], rows)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--full", action="store_true", help="the full study, some hours")
    given = parser.parse_args()
    from studies.control import rerun

    timed = costs()
    with tempfile.TemporaryDirectory() as folder:
        rerun(Path(folder), quick=not given.full, workers=1)
        read = {
            name: json.loads((Path(folder) / f"{name}.json").read_text()) for name in ("control", "tracking")
        }
    found = {
        "machine": machine(), "quick": not given.full, "costs": timed, "checks": read["control"],
        "tracking": read["tracking"],
    }  # fmt: skip
    given.out.write_text(json.dumps(found, indent=1) + "\n")
    print(f"{found['machine']}\n\n{table(found)}\n\nwritten: {given.out}")


if __name__ == "__main__":
    main()
