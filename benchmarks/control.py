"""Closed-loop control, its study and the times of its parts: `python -m benchmarks.control [--full]`.

Writes benchmarks/control.json and prints the tables of docs/control.md. The quick study takes ten minutes.

`python -m benchmarks.control --periods [--against CHECKOUT]` prints the times of 1,000 periods at 50 and
100 Hz only, beside those of another checkout: a process for each, which take turns.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.run import machine

RESULTS = Path("benchmarks/control.json")
ROUNDS = 200
#: this checkout
HERE = str(Path(__file__).resolve().parents[1])
#: periods (s) of control, number of periods, and periods in a turn
PERIODS, COUNT, TURN = (0.02, 0.01), 1000, 100
#: predictive controllers: the default, which earlier versions have, and one whose size is chosen
SIZES = {"20 steps, 8 knots": "predictive", "chosen": "predictive:realtime=0.6"}


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


def loops(source: str) -> None:
    """Close a loop of the paper's robot, a turn for each line of input, and print its times."""
    sys.path.insert(0, f"{source}/src")
    import knode_cosserat as kc
    from knode_cosserat import control as kcc
    from knode_cosserat.control.loop import Loop

    made = json.loads(sys.stdin.readline())
    robot, tip = kc.load_robot("delrin-tendon-robot"), kc.estimation.TipPosition()
    try:
        controller = kcc.controller_named(made["name"], robot, made["dt"], kcc.ControlLimits(0.0, 10.0, 40.0))
    except ValueError as error:
        print(json.dumps([False, str(error)]), flush=True)
        return
    spent = [0.0]

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            before = time.process_time()
            result = function(*arguments)
            spent[0] += time.process_time() - before
            return result

        return call

    plant = kcc.SimulatedPlant(robot, made["dt"], kcc.Sensor(tip))
    loop = Loop(controller, plant, kcc.circle(0.1, 4.0))
    for name in ("command", "advance", "prepare"):
        setattr(controller, name, timed(getattr(controller, name)))
    import gc

    gc.collect()
    gc.disable()
    cpu = []
    print(json.dumps([True, repr(controller)]), flush=True)
    for _ in sys.stdin:
        for _ in range(TURN):
            spent[0] = 0.0
            loop.period()
            cpu.append(spent[0])
        log = loop.log()
        cycle = log.feedback + log.preparation
        rows = [log.feedback.tolist(), cycle.tolist(), cpu]
        print(json.dumps([rows, log.tip_rmse(), log.fallbacks]), flush=True)


def measured_loops(
    dt: float, sizes: Mapping[str, str], sources: Mapping[str, str], count: int = COUNT
) -> dict[tuple[str, str], Any]:
    """Close loops of controllers by checkouts, which take turns.

    Returns, by the names of controller and checkout: times of feedback, of the whole cycle, and of the CPU in
    each period (s), the error of the tip (m), and the number of fallbacks.
    """
    workers: dict[tuple[str, str], Any] = {}
    answers: dict[tuple[str, str], Any] = {}
    for name, controller in sizes.items():
        for label, source in sources.items():
            environment = os.environ | {"PYTHONPATH": f"{source}/src:{source}"}
            worker = subprocess.Popen(
                [sys.executable, __file__, "--loops", source],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env=environment,
            )
            ready, said = _asked(worker, json.dumps({"name": controller, "dt": dt}))
            if ready:
                workers[name, label] = worker
            print(f"{1.0 / dt:g} Hz, {name}, {label}: {said}", flush=True)
    for _ in range(count // TURN):
        for key, worker in workers.items():
            answers[key] = _asked(worker, "")
    for worker in workers.values():
        worker.stdin.close()
        worker.wait()
    return answers


def periods(against: str | None) -> str:
    """Return a table of the times of periods, of this checkout and of another one."""
    import numpy as np

    from studies.report import markdown_table

    sources = {"this one": HERE} | ({against: against} if against else {})
    rows = []
    for dt in PERIODS:
        answers = measured_loops(dt, SIZES, sources)
        for (name, label), ((feedback, cycle, cpu), rmse, fallbacks) in answers.items():
            late = int(np.sum(np.array(cycle) > dt))
            quantiles = np.percentile([feedback, cycle, cpu], (50, 99), axis=1).T
            times = [f"{1e3 * quantile:.1f}" for quantile in quantiles.ravel()]
            own = [f"{1.0 / dt:g} Hz", name, label, *times, f"{late}", f"{fallbacks}", f"{1e3 * rmse:.4f}"]
            rows.append(own)
    head = ["period", "prediction", "checkout", "feedback, ms", "p99", "cycle, ms", "p99", "CPU, ms", "p99"]
    return markdown_table([*head, "late", "fallbacks", "tip RMSE, mm"], rows)


def _asked(worker: Any, line: str) -> Any:
    worker.stdin.write(line + "\n")
    worker.stdin.flush()
    return json.loads(worker.stdout.readline())


def table(found: Mapping[str, Any]) -> str:
    """Return the tables of docs/control.md in Markdown."""
    return "\n\n".join([tracking_table(found["tracking"]), checks_table(found["checks"])])


def costs_table(cost: Mapping[str, Any]) -> str:
    """Return the times of a prediction over the horizon, with and without derivatives."""
    from studies.report import markdown_table

    rows = [
        (f"simulation of {cost['periods']} periods", cost["simulated"]),
        (f"with {cost['columns']} derivatives by the plan, `jax.jacfwd`", cost["by_jax"]),
        (f"with {cost['columns'] + 1} derivatives, tangents of the steps", cost["by_tangents"]),
        (f"with {cost['columns'] + cost['state_columns']} derivatives, as in the loop", cost["with_state"]),
    ]
    return markdown_table(["prediction", "ms"], [[name, f"{value:.1f}"] for name, value in rows])


def tracking_table(cells: Sequence[Mapping[str, Any]]) -> str:
    """Return the tracking errors of all controllers on both circles; the worst robot of a kind."""
    from studies.report import markdown_table

    def kind(robot: str) -> str:
        if robot.startswith("stiffness"):
            return "stiffness wrong by 30 %"
        return "unknown 10 or 50 g at the tip" if robot.startswith("unknown") else robot

    def worst(name: str, robot: str, path: str) -> str:
        own = (
            cell["rmse_percent"]
            for cell in cells
            if (cell["controller"], kind(cell["robot"]), cell["reference"]) == (name, robot, path)
        )
        largest = max(own, default=None)
        return "–" if largest is None else f"{largest:.2g}"

    paths = [path for path in dict.fromkeys(cell["reference"] for cell in cells) if path.startswith("circle")]
    robots = list(dict.fromkeys(kind(cell["robot"]) for cell in cells))
    rows = []
    for name in dict.fromkeys(cell["controller"] for cell in cells):
        errors = ([worst(name, robot, path) for path in paths] for robot in robots)
        rows.append([name, *("–" if set(own) == {"–"} else ", ".join(own) for own in errors)])
    return markdown_table(["controller", *robots], rows)


def checks_table(checks: Sequence[Mapping[str, Any]]) -> str:
    """Return the checks with their limits; values beyond them are bold."""
    from studies.report import markdown_table

    rows = []
    for each in checks:
        value = f"{each['value']:.2g}"
        rows.append([each["check"], value if each["ok"] else f"**{value}**", f"{each['limit']:g}"])
    return markdown_table(["check", "value", "limit"], rows)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--full", action="store_true", help="the full study, some hours")
    parser.add_argument("--periods", action="store_true", help="only the times of periods")
    parser.add_argument("--against", metavar="CHECKOUT", help="with --periods: another checkout beside it")
    parser.add_argument("--loops", metavar="CHECKOUT", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.loops:
        loops(given.loops)
        return
    if given.periods:
        print(f"{machine()}\n\n{periods(given.against)}")
        return
    from studies.control import rerun

    timed = costs()
    with tempfile.TemporaryDirectory() as folder:
        rerun(Path(folder), quick=not given.full, workers=1)
        read = {
            name: json.loads((Path(folder) / f"{name}.json").read_text()) for name in ("control", "tracking")
        }
    found = {
        "machine": machine(),
        "quick": not given.full,
        "costs": timed,
        "checks": read["control"],
        "tracking": read["tracking"],
    }
    given.out.write_text(json.dumps(found, indent=1) + "\n")
    print(f"{found['machine']}\n\n{table(found)}\n\n{costs_table(timed)}\n\nwritten: {given.out}")


if __name__ == "__main__":
    main()
