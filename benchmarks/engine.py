"""The emitted time loop (docs/engine.md) against the one in JAX: python -m benchmarks.engine.

CPU time of one core; both loops run in turn in one process, from the same states to the same rows, estimates
included: random tensions of 4 to 8 N, new in every step of 50 ms.
"""

import os
import time

import jax
import numpy as np

import knode_cosserat as kc
from knode_cosserat.engine import loops
from knode_cosserat.engine.core import Core
from knode_cosserat.engine.equations import Equations
from knode_cosserat.solvers import time_loop
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.history import resting_history
from knode_cosserat.solvers.sensitivity import TangentState, tangent_loop_in_jax, tangent_time_loop
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.sensitivity import SystemMoves
from knode_cosserat.solvers.time_loop import StepCoefficients

DT, STEPS, BATCH, ROUNDS = 0.05, 100, 64, 7
COLUMNS, TANGENT_STEPS = 32, 20
ROBOTS = {"paper's robot": "delrin-tendon-robot", "routed, ribs": "delrin-routed-tendon-robot"}
SCHEMES = {"sdirk2": "consistent", "bdf2": "paper"}


def seconds(run):
    """Return the CPU time of a run (s)."""
    before = time.process_time()
    jax.block_until_ready(run())
    return time.process_time() - before


def row_of(label, robot, scheme, batch):
    """Return a row of the table: µs a robot-step of both loops, their ratio, and CPU seconds of building."""
    settings = Settings.of(scheme, "lobatto2", SCHEMES[scheme], NewtonOptions())
    steps, past = StepCoefficients.of(settings, DT), resting_history(robot, settings)
    tensions = np.random.default_rng(0).uniform(4.0, 8.0, (BATCH, STEPS, 4))
    built = seconds(lambda: Core(robot, settings, batch).stride)
    if batch:
        pasts = jax.tree.map(lambda leaf: np.stack([leaf] * BATCH), past)
        runs = (
            lambda: time_loop.loop_many(robot, settings, steps, tensions, pasts, STEPS),
            lambda: loops.loop_many(robot, settings, steps, tensions, pasts, STEPS),
        )
    else:
        runs = (
            lambda: time_loop.loop_one(robot, settings, steps, tensions[0], past, (0, STEPS)),
            lambda: loops.loop_one(robot, settings, steps, tensions[0], past, (0, STEPS)),
        )
    for run in runs:
        run()
    times = np.median([[seconds(run) for run in runs] for _ in range(ROUNDS)], axis=0)
    in_jax, emitted = times / STEPS / (BATCH if batch else 1) * 1e6
    cells = f"{in_jax:.0f} | {emitted:.1f} | {in_jax / emitted:.1f} | {built:.1f}"
    return f"| {label} | {scheme} | {BATCH if batch else 1} | {cells} |"


def tangents_of(label, robot, scheme):
    """Return a row of the second table: ms of both, their ratio, and CPU seconds of both first calls."""
    settings = Settings.of(scheme, "lobatto2", SCHEMES[scheme], NewtonOptions())
    steps, past = StepCoefficients.of(settings, DT), resting_history(robot, settings)
    rng = np.random.default_rng(0)
    controls = rng.uniform(4.0, 8.0, (TANGENT_STEPS, 4))
    _, _, rows = loops.loop_one(robot, settings, steps, controls, past, (0, TANGENT_STEPS))
    columns = [np.zeros((*part.shape, COLUMNS)) for part in (past.records, past.rate)]
    state = TangentState.of(robot, settings.space, past, *columns)
    changes = SystemMoves(None, np.zeros((0, COLUMNS))), rng.normal(size=(*controls.shape, COLUMNS))
    given = settings, steps, rows.every_stage, (robot, controls), changes, state
    runs = lambda: tangent_loop_in_jax(*given), lambda: tangent_time_loop(*given)
    builds = [seconds(run) for run in runs]
    in_jax, emitted = 1e3 * np.median([[seconds(run) for run in runs] for _ in range(10 * ROUNDS)], axis=0)
    cells = f"{in_jax:.1f} | {emitted:.2f} | {in_jax / emitted:.1f} | {builds[0]:.1f} | {builds[1]:.1f}"
    return f"| {label} | {scheme} | {cells} |"


def main() -> None:
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    print("| robot | scheme | robots | JAX, µs a robot-step | emitted, µs | ratio | building it, CPU s |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for label, name in ROBOTS.items():
        robot = kc.load_robot(name)
        Equations(robot)  # JAX's own first call
        for scheme in SCHEMES:
            for batch in (False, True):
                print(row_of(label, robot, scheme, batch), flush=True)
    print(f"\n{COLUMNS} tangents of {TANGENT_STEPS} steps:\n")
    print("| robot | scheme | JAX, ms | emitted, ms | ratio | first call in JAX, CPU s | emitted, CPU s |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for label, name in ROBOTS.items():
        for scheme in SCHEMES:
            print(tangents_of(label, kc.load_robot(name), scheme), flush=True)


if __name__ == "__main__":
    main()
