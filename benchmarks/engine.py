"""The emitted time loop (docs/engine.md) against `simulate`: python -m benchmarks.engine.

CPU time of one core. Both run in turn in one process, with the paper's scheme of order 2 (BDF2), the error
estimate included: random tensions of 4 to 8 N, new in every step of 50 ms.
"""

import ctypes
import os
import time
import warnings

import numpy as np

import knode_cosserat as kc
from knode_cosserat.engine.core import Core, Equations
from knode_cosserat.solvers.time import BDF2

DT, STEPS, ROUNDS = 0.05, 100, 7
ROBOTS = {"paper's robot": "delrin-tendon-robot", "routed, ribs": "delrin-routed-tendon-robot"}


def core_seconds(core, robot, controls):
    """Return a function that runs one vector of robots, and returns its CPU time (s)."""
    function = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 5, ctypes.c_long)(core.compiled.address("run"))
    begun = core.memory([robot] * core.P)
    raw = np.zeros(begun.size + 8)
    memory = raw[(-raw.ctypes.data // 8) % 8 :][: begun.size]
    own = np.ascontiguousarray(np.moveaxis(controls[: core.P], 0, -1))
    coefficients = np.tile(BDF2().coefficients(DT, DT)[:3], (STEPS, 1))
    times = np.concatenate([coefficients, (1.0 + np.arange(STEPS))[:, None] * DT], axis=1)
    rows = np.empty((STEPS, robot.nodes, core.equations.numbers, core.P))
    arrays = memory, own, times, rows, np.empty((STEPS, 5, core.P))

    def run():
        memory[:] = begun
        before = time.process_time()
        function(*(each.ctypes.data for each in arrays), STEPS)
        return time.process_time() - before

    return run


def package_seconds(robot, controls):
    """Return a function that simulates, and returns its CPU time (s)."""

    def run():
        before = time.process_time()
        kc.simulate(robot, controls, DT, time="bdf2", start="paper")
        return time.process_time() - before

    run()
    return run


def main() -> None:
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    warnings.simplefilter("ignore")
    tensions = np.random.default_rng(0).uniform(4.0, 8.0, (64, STEPS, 4))
    print("| robot | robots | simulate, µs a robot-step | emitted, µs | ratio | building it, CPU s |")
    print("| --- | --- | --- | --- | --- | --- |")
    for label, name in ROBOTS.items():
        robot = kc.load_robot(name)
        Equations(robot)  # JAX's own first call
        for robots in (False, True):
            before = time.process_time()
            core = Core(robot, robots)
            built = time.process_time() - before
            count = 64 if robots else 1
            runs = (
                package_seconds(robot, tensions if robots else tensions[0]),
                core_seconds(core, robot, tensions),
            )
            times = np.array([[run() for run in runs] for _ in range(ROUNDS)])
            package, emitted = np.median(times, axis=0) / STEPS / [count, core.P] * 1e6
            ratio = package / emitted
            print(
                f"| {label} | {count} | {package:.0f} | {emitted:.1f} | {ratio:.1f} | {built:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
