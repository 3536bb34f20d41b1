"""What is measured: `python -m benchmarks.cases NAME` prints one JSON object, in a process of its own.

Times are medians of several calls after compilation. Cases that compare two things call them in turn, so that
a change of the machine's speed touches both alike.
"""

from __future__ import annotations

import functools
import json
import os
import resource
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

DT = 0.05
STEPS = 100
#: the paper's scheme in time, which the transcription has: speeds are compared at the same method
PAPER: dict[str, Any] = {"time": "bdf2", "start": "paper", "initial": "unstressed"}


def one_core() -> None:
    """Before JAX starts: this process, and so XLA's thread pool, on one core."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def seconds(function: Callable[[], Any]) -> float:
    """Wall time of one call."""
    begin = time.perf_counter()
    function()
    return time.perf_counter() - begin


def medians(functions: dict[str, Callable[[], Any]], rounds: int, repeats: int = 1) -> dict[str, float]:
    """Median seconds of each function: in turn, in every round as many calls as fit the slowest's one.

    At most `repeats`: a short call after a long one of something else finds cold caches.
    """
    once = {name: min(seconds(function) for _ in range(2)) for name, function in functions.items()}
    calls = {name: max(1, min(repeats, int(max(once.values()) / taken))) for name, taken in once.items()}
    found: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            found[name] += [seconds(function) for _ in range(calls[name])]
    return {name: statistics.median(times) for name, times in found.items()}


def steps() -> dict[str, Any]:
    """100 steps against the transcription, for each kind of control; and with 40 and 100 nodes."""
    one_core()
    import knode_cosserat as kc
    from benchmarks import paper_transcription as paper

    robot, yardstick = kc.load_robot("delrin-tendon-robot"), paper.PaperRobot()
    controls = {
        "sine": kc.controls.sine(1.5, STEPS, DT, sampled="end"),
        "step": kc.controls.step(1.5, STEPS, DT, sampled="end"),
        "random": kc.controls.random(STEPS, seed=0),
    }
    found: dict[str, Any] = {}
    for name, tensions in controls.items():
        both = medians(
            {
                "package": lambda tensions=tensions: kc.simulate(robot, tensions, DT, **PAPER),
                "transcription": lambda tensions=tensions: paper.simulate(
                    yardstick, tensions, DT, retry=False
                ),
            },
            rounds=5,
            repeats=20,
        )
        found[name] = {**both, "ratio": both["transcription"] / both["package"]}
    robots = {nodes: robot.replace(nodes=nodes) for nodes in (10, 40, 100)}
    sizes = {
        f"{nodes} nodes": functools.partial(kc.simulate, sized, controls["sine"], DT, **PAPER)
        for nodes, sized in robots.items()
    }
    # two solves a step, and an estimate of the error in time
    sizes["default scheme in time"] = functools.partial(kc.simulate, robot, controls["sine"], DT)
    found["nodes"] = medians(sizes, rounds=25)
    return found


def batch() -> dict[str, Any]:
    """1024 robots, each with tensions of its own."""
    import numpy as np

    import knode_cosserat as kc

    robot = kc.load_robot("delrin-tendon-robot")
    generator = np.random.default_rng(0)
    periods, scale = generator.uniform(0.8, 3.0, 1024), generator.uniform(0.8, 1.2, 1024)
    tensions = np.stack(
        [a * kc.controls.sine(p, STEPS, DT, sampled="end") for p, a in zip(periods, scale, strict=True)]
    )
    taken = medians({"batch": lambda: kc.simulate(robot, tensions, DT, **PAPER)}, rounds=3)["batch"]
    return {"robots": 1024, "steps": STEPS, "seconds": taken, "robot_steps_per_second": 1024 * STEPS / taken}


def cantilever() -> dict[str, Any]:
    """A step of a steel rod of 0.4 m that is released straight, 40 segments, 2 ms, BDF-α: microseconds."""
    one_core()
    import numpy as np

    import knode_cosserat as kc

    rod = kc.robots.SlenderRod(
        length=0.4,
        radius=0.0012,
        density=8000.0,
        youngs_modulus=207e9,
        nodes=41,
        bending_damping=2e-3,
        gravity=(-9.81, 0.0, 0.0),
    )
    controls = np.zeros((500, 0))
    taken = medians(
        {"run": lambda: kc.simulate(rod, controls, 0.002, time="bdf-alpha", initial="unstressed")}, rounds=25
    )["run"]
    return {"steps": len(controls), "microseconds": 1e6 * taken / len(controls)}


def gradient() -> dict[str, Any]:
    """The gradient of a rollout with respect to every tension and Young's modulus, against the rollout."""
    one_core()
    import jax
    import jax.numpy as jnp

    import knode_cosserat as kc

    robot, tensions = kc.load_robot("delrin-tendon-robot"), kc.controls.sine(1.5, STEPS, DT, sampled="end")

    def loss(youngs_modulus: Any, tensions: Any) -> Any:
        tip = kc.simulate(robot.replace(youngs_modulus=youngs_modulus), tensions, DT, **PAPER).tip_position
        return jnp.sum(tip**2)

    at = (float(robot.youngs_modulus), tensions)
    value, slope = jax.jit(loss), jax.jit(jax.grad(loss, (0, 1)))
    first = seconds(lambda: jax.block_until_ready(slope(*at)))
    times = medians(
        {
            "forward": lambda: jax.block_until_ready(value(*at)),
            "gradient": lambda: jax.block_until_ready(slope(*at)),
        },
        rounds=25,
    )
    return {**times, "ratio": times["gradient"] / times["forward"], "first_call": first}


def tangents(steps: int = 20, columns: int = 32) -> dict[str, Any]:
    """A motion and its derivatives by 32 numbers, four tensions in eight blocks; those of its tip by JAX."""
    one_core()
    import jax
    import jax.numpy as jnp
    import numpy as np

    import knode_cosserat as kc
    from knode_cosserat.schemes.settings import Settings
    from knode_cosserat.solvers.rest import resting_history
    from knode_cosserat.solvers.run import TimeIntegration
    from knode_cosserat.solvers.sensitivity import Changes, TangentState, tangent_time_loop

    robot, tensions = kc.load_robot("delrin-tendon-robot"), kc.controls.sine(1.5, steps, DT, sampled="end")
    block = np.eye(columns // 4)[np.arange(steps) * (columns // 4) // steps]

    def tip(changes: Any) -> Any:
        moved = tensions + block @ changes.reshape(-1, 4)
        return kc.simulate(robot, moved, DT, **PAPER).tip_position

    slopes, none = jax.jit(jax.jacfwd(tip)), jnp.zeros(columns)
    settings = Settings.of(PAPER["time"], "lobatto2", PAPER["start"], kc.solvers.NewtonOptions())
    task, past = (
        TimeIntegration(settings, DT, steps),
        jax.tree.map(np.asarray, resting_history(robot, settings)),
    )
    used = past.error.shape[1]
    zeros = [np.zeros((*part.shape, columns)) for part in (past.records[:, :used], past.rate[:used])]
    state = TangentState(past.records[:, :used], past.rate[:used], *zeros, 0.0)
    d_controls = np.einsum("tk,ij->tikj", block, np.eye(4)).reshape(steps, 4, columns)
    changes = Changes(d_controls)

    def moved() -> Any:
        _, _, rows = task.solve(robot, tensions, past, (0, steps))
        at = rows.every_stage, (robot, tensions)
        return tangent_time_loop(task.coefficients, *at, changes, state)

    cases = {"tangents": moved, "jax": lambda: jax.block_until_ready(slopes(none))}
    taken = medians(cases, rounds=25)
    own, by_jax = (1e3 * taken[name] for name in cases)
    return {"columns": columns, "steps": steps, "milliseconds": own, "by_jax": by_jax}


def schemes() -> dict[str, Any]:
    """A step by the default scheme against forward Euler: with as many nodes, and to the same accuracy."""
    one_core()
    import numpy as np

    import knode_cosserat as kc

    robot, tensions = kc.load_robot("delrin-tendon-robot"), kc.controls.sine(1.5, STEPS, DT, sampled="end")
    finest = kc.simulate(robot.replace(nodes=97), tensions, DT, space="lobatto4", **PAPER).tip_position
    cases = {"default": (10, "lobatto2"), "euler": (10, "euler"), "fine_euler": (400, "euler")}

    def run(name: str) -> kc.Trajectory:
        nodes, space = cases[name]
        return kc.simulate(robot.replace(nodes=nodes), tensions, DT, space=space, **PAPER)

    times = medians({name: functools.partial(run, name) for name in cases}, rounds=9, repeats=10)
    off = {name: float(np.linalg.norm(run(name).tip_position - finest, axis=1).max()) for name in cases}
    return {**times, "tip_error": off, "nodes": {name: nodes for name, (nodes, _) in cases.items()}}


def first_call() -> dict[str, Any]:
    """Import and the first simulation, in this process."""
    begin = time.perf_counter()
    import knode_cosserat as kc

    imported = time.perf_counter() - begin
    robot = kc.load_robot("delrin-tendon-robot")
    tensions = kc.controls.sine(1.5, STEPS, DT, sampled="end")
    call = seconds(lambda: kc.simulate(robot, tensions, DT, **PAPER))
    ribs = kc.load_robot("delrin-routed-tendon-robot")
    family = seconds(lambda: kc.simulate(ribs, tensions, DT, **PAPER))
    return {"import": imported, "first_call": call, "ribs": family}


def memory() -> dict[str, Any]:
    """Peak resident memory of a process that simulates 1,000 steps."""
    import knode_cosserat as kc

    robot = kc.load_robot("delrin-tendon-robot")
    kc.simulate(robot, kc.controls.sine(1.5, 1000, DT, sampled="end"), DT, **PAPER)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"megabytes": peak / (1024 if sys.platform != "darwin" else 1024**2)}


def workspace(count: int = 8192) -> dict[str, Any]:
    """Equilibria of a workspace, and what memory they took beyond the package and its programs."""
    import knode_cosserat as kc

    robot = kc.load_robot("delrin-tendon-robot")
    kc.workspace(robot, 0.0, 10.0, 2048)
    unit = 1024 if sys.platform != "darwin" else 1024**2
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    taken = statistics.median(seconds(lambda: kc.workspace(robot, 0.0, 10.0, count)) for _ in range(3))
    more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / unit
    return {"equilibria": count, "seconds": taken, "per_second": count / taken, "more_megabytes": more}


def workspace_full() -> dict[str, Any]:
    """100,000 of them; not among those of `make bench`."""
    return workspace(100_000)


ALL = (steps, cantilever, batch, gradient, tangents, schemes, first_call, memory, workspace, workspace_full)
CASES = {case.__name__: case for case in ALL}

if __name__ == "__main__":
    print(json.dumps(CASES[sys.argv[1]]()))
