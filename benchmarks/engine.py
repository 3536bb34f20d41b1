"""The time loop of the engine (docs/engine.md): python -m benchmarks.engine.

CPU time of one core, estimates of errors included: random tensions of 4 to 8 N, new in every step of 50 ms.
"""

import functools
import os
import time

import jax
import numpy as np

import knode_cosserat as kc
from knode_cosserat.engine import loops
from knode_cosserat.engine.core import Core
from knode_cosserat.engine.equations import Equations
from knode_cosserat.schemes.history import StepCoefficients
from knode_cosserat.schemes.settings import NewtonOptions, Settings
from knode_cosserat.solvers.rest import resting_history
from knode_cosserat.solvers.sensitivity import Changes, TangentState, tangent_time_loop

DT, STEPS, BATCH, ROUNDS = 0.05, 100, 64, 7
COLUMNS, TANGENT_STEPS = 32, 20
ROBOTS = {"paper's robot": "delrin-tendon-robot", "routed, ribs": "delrin-routed-tendon-robot"}
SCHEMES = {"sdirk2": "consistent", "bdf2": "paper"}


def seconds(run):
    """Return the CPU time of a run (s)."""
    before = time.process_time()
    run()
    return time.process_time() - before


def row_of(label, robot, scheme, batch):
    """Return a row of the table: µs a robot-step, and CPU seconds of building."""
    settings = Settings.of(scheme, "lobatto2", SCHEMES[scheme], NewtonOptions())
    steps, past = StepCoefficients.of(settings, DT), resting_history(robot, settings)
    tensions = np.random.default_rng(0).uniform(4.0, 8.0, (BATCH, STEPS, 4))
    built = seconds(lambda: Core(robot, settings, batch).stride)
    if batch:
        pasts = jax.tree.map(lambda leaf: np.stack([leaf] * BATCH), past)
        run = functools.partial(loops.solve_steps, robot, steps, tensions, pasts, (0, STEPS))
    else:
        run = functools.partial(loops.solve_steps, robot, steps, tensions[0], past, (0, STEPS))
    run()
    taken = np.median([seconds(run) for _ in range(ROUNDS)]) / STEPS / (BATCH if batch else 1) * 1e6
    return f"| {label} | {scheme} | {BATCH if batch else 1} | {taken:.1f} | {built:.1f} |"


def tangents_of(label, robot, scheme):
    """Return a row of the second table: ms, and CPU seconds of the first call."""
    settings = Settings.of(scheme, "lobatto2", SCHEMES[scheme], NewtonOptions())
    steps, past = StepCoefficients.of(settings, DT), resting_history(robot, settings)
    rng = np.random.default_rng(0)
    controls = rng.uniform(4.0, 8.0, (TANGENT_STEPS, 4))
    _, _, rows = loops.solve_steps(robot, steps, controls, past, (0, TANGENT_STEPS))
    columns = [np.zeros((*part.shape, COLUMNS)) for part in (past.records, past.rate)]
    state = TangentState.of(robot, settings.space, past, *columns)
    changes = Changes(rng.normal(size=(*controls.shape, COLUMNS)))
    given = steps, rows.every_stage, (robot, controls), changes, state
    run = functools.partial(tangent_time_loop, *given)
    built = seconds(run)
    taken = 1e3 * np.median([seconds(run) for _ in range(10 * ROUNDS)])
    return f"| {label} | {scheme} | {taken:.2f} | {built:.1f} |"


def main() -> None:
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    print("| robot | scheme | robots | µs a robot-step | building it, CPU s |")
    print("| --- | --- | --- | --- | --- |")
    for label, name in ROBOTS.items():
        robot = kc.load_robot(name)
        Equations(robot)  # JAX's own first call
        for scheme in SCHEMES:
            for batch in (False, True):
                print(row_of(label, robot, scheme, batch), flush=True)
    print(f"\n{COLUMNS} tangents of {TANGENT_STEPS} steps:\n")
    print("| robot | scheme | ms | first call, CPU s |")
    print("| --- | --- | --- | --- |")
    for label, name in ROBOTS.items():
        for scheme in SCHEMES:
            print(tangents_of(label, kc.load_robot(name), scheme), flush=True)


if __name__ == "__main__":
    main()
