"""Calls with all their Python: python -m benchmarks.waiting [--against CHECKOUT] [--prototype FOLDER].

CPU time of this checkout, and beside it that of another checkout and of a prototype in C++, in one run: a
process for each, which take turns. Figures are medians of the rounds, ratios are medians of each round's.
Random tensions of 4 to 8 N, new in every step of 50 ms; `machine code` is the time of the compiled functions.
"""

import argparse
import functools
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import ClassVar

import numpy as np

DT, ROUNDS = 0.05, 9
COMPILER = [
    "g++",
    "-std=c++17",
    "-O3",
    "-march=native",
    "-ffast-math",
    "-fno-finite-math-only",
    "-fPIC",
    "-shared",
    "-w",
    "-DNN=10",
]
#: the prototype's shuffles on a processor without AVX-512
SHUFFLES = """#include <immintrin.h>
#define SHUFFLED(a, b, ...) ((__m512d)__builtin_shuffle(a, b, (__m512i){__VA_ARGS__}))
#define _mm512_unpacklo_pd(a, b) SHUFFLED(a, b, 0, 8, 2, 10, 4, 12, 6, 14)
#define _mm512_unpackhi_pd(a, b) SHUFFLED(a, b, 1, 9, 3, 11, 5, 13, 7, 15)
#define _mm512_shuffle_f64x2(a, b, k) \\
  (k == 0x88 ? SHUFFLED(a, b, 0, 1, 4, 5, 8, 9, 12, 13) : SHUFFLED(a, b, 2, 3, 6, 7, 10, 11, 14, 15))
"""
SCHEMES = {"bdf2": {"time": "bdf2", "start": "paper"}, "default": {}}
#: robots and steps of simulations
SIZES = {"1 robot, 1,000 steps": (1, 1000), "1 robot, 100 steps": (1, 100), "64 robots, 100 steps": (64, 100)}
EPISODES, PERIODS, STEPS = 1024, 10, 200
BATCH, ENVIRONMENTS = "1,024 robots, 10 steps, default", "1,024 episodes, 10 periods"
ABOVE = "Stepper, above machine code"
SPENT = [0.0]


def cpu(run):
    before = time.process_time()
    run()
    return time.process_time() - before


def tensions(robots, steps):
    shape = (steps, 4) if robots == 1 else (robots, steps, 4)
    return np.random.default_rng(0).uniform(4.0, 8.0, shape)


class Timed:
    """Compiled functions whose time is added to SPENT."""

    made: ClassVar[list] = []

    def __init__(self, code):
        self.code = code
        self.made.append(code)

    def __getitem__(self, name):
        function = self.code[name]

        def call(*arguments):
            before = time.thread_time()
            function(*arguments)
            SPENT[0] += time.thread_time() - before

        return call


def package():
    """Return functions that return the µs of a robot-step, by row."""
    import knode_cosserat as kc
    from knode_cosserat.engine.codegen import Module
    from knode_cosserat.envs.gymnasium_envs import VectorEnv

    compile_ = Module.compile
    Module.compile = lambda *own: Timed(compile_(*own))
    robot, rows = kc.load_robot("delrin-tendon-robot"), {}
    for label, (robots, steps) in (SIZES | {BATCH: (EPISODES, PERIODS)}).items():
        for name, scheme in SCHEMES.items() if label != BATCH else [("", {})]:
            run = functools.partial(kc.simulate, robot, tensions(robots, steps), DT, **scheme)
            rows[f"{label}, {name}" if name else label] = lambda run=run, n=robots * steps: cpu(run) * 1e6 / n
    controls = tensions(1, STEPS)
    stepper = functools.cache(lambda: kc.solvers.Stepper(robot, DT))

    def steps():
        SPENT[0] = 0.0
        return cpu(lambda: [stepper().step(control) for control in controls])

    rows["Stepper"] = lambda: steps() * 1e6 / STEPS
    rows[ABOVE] = lambda: (steps() - SPENT[0]) * 1e6 / STEPS

    @functools.cache
    def episodes():
        found = VectorEnv(kc.envs.make("follow"), EPISODES)
        found.reset(seed=0)
        return found

    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (PERIODS, EPISODES, 4))
    rows[ENVIRONMENTS] = lambda: (
        cpu(lambda: [episodes().step(each) for each in actions]) * 1e6 / actions[..., 0].size
    )
    return rows


def prototype():
    """Return functions of the prototype, which solves BDF2 only, in the current folder."""
    sys.path.insert(0, "")
    from native import Lib, raw_of

    import knode_cosserat as kc

    raw, rows = raw_of(kc.load_robot("delrin-tendon-robot"), DT), {}
    libraries = {1: (Lib("./libsingle.so", 10), 0), 64: (Lib("./libdrive.so", 10), 8)}
    for label, (robots, steps) in SIZES.items():
        library, lanes = libraries[robots]
        controls = tensions(robots, steps).reshape(robots, steps, 4)
        out, info = np.empty((robots, steps, 10, 25)), np.empty((robots, steps, 3))
        run = functools.partial(library.run, raw, controls, lanes, 1, 1, out=out, info=info)
        for name in SCHEMES:
            rows[f"{label}, {name}"] = lambda run=run, n=robots * steps: cpu(run) * 1e6 / n
    return rows


def work(kind):
    rows = {"package": package, "prototype": prototype}[kind]()
    print("ready", flush=True)
    warm = set()
    for row in map(str.strip, sys.stdin):
        if row in rows and row not in warm:
            warm.add(row)
            rows[row]()
            for later in filter(None, (getattr(code, "_later", None) for code in Timed.made)):
                later.wait()  # final code from another process
            rows[row]()
        print(rows[row]() if row in rows else "nan", flush=True)


class Worker:
    """A process that measures one row at a time."""

    def __init__(self, kind, source=None, folder=None):
        environment = os.environ | ({"PYTHONPATH": str(source)} if source else {})
        command = [sys.executable, str(Path(__file__).resolve()), "--work", kind]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=folder
        )
        while self._line() != "ready":
            pass

    def _line(self):
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit("a measuring process has ended")
        return line.strip()

    def measure(self, row):
        self.process.stdin.write(f"{row}\n")
        self.process.stdin.flush()
        return float(self._line())


def built(folder):
    """Return a temporary copy of the prototype, compiled; the folder itself if it is compiled already."""
    if (folder / "libsingle.so").exists():
        return folder
    copy, given = Path(tempfile.mkdtemp()) / "prototype", []
    shutil.copytree(folder, copy)
    if "avx512f" not in Path("/proc/cpuinfo").read_text():
        (copy / "shuffles.hpp").write_text(SHUFFLES)
        given = ["-include", "shuffles.hpp"]
    for source, name in (("drive.cpp", "libdrive.so"), ("drive1.cpp", "libsingle.so")):
        subprocess.run([*COMPILER, *given, source, "-o", name], cwd=copy, check=True)
    return copy


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--against", type=Path, help="folder of another checkout")
    options.add_argument("--prototype", type=Path, help="folder of the prototype's sources")
    options.add_argument("--rounds", type=int, default=ROUNDS)
    options.add_argument("--rows", default="", help="only rows with this text")
    options.add_argument("--work", choices=["package", "prototype"], help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.work:
        return work(given.work)
    source = Path(__file__).resolve().parents[1] / "src"
    workers = {"now": Worker("package", source)}
    if given.against:
        workers["before"] = Worker("package", given.against.resolve() / "src")
    if given.prototype:
        workers["prototype"] = Worker("prototype", source, built(given.prototype))
    rows = [f"{label}, {name}" for label in SIZES for name in SCHEMES]
    rows = [row for row in [*rows, BATCH, "Stepper", ABOVE, ENVIRONMENTS] if given.rows in row]
    taken = {(name, row): [] for name in workers for row in rows}
    for _ in range(given.rounds):
        for row in rows:
            for name, worker in workers.items():
                taken[name, row].append(worker.measure(row))
    taken = {key: np.array(each) for key, each in taken.items()}
    others = [name for name in workers if name != "now"]
    titles = ["µs a robot-step", *workers, *(f"now / {name}" for name in others)]
    print("| " + " | ".join(titles) + " |\n|" + " --- |" * len(titles))
    for row in rows:
        figures = [f"{np.median(taken[name, row]):.1f}" for name in workers]
        figures += [f"{np.median(taken['now', row] / taken[name, row]):.2f}" for name in others]
        print("| " + " | ".join([row, *figures]) + " |")
    if {BATCH, ENVIRONMENTS} <= set(rows):
        shares = (
            f"{np.median(taken[n, BATCH] / taken[n, ENVIRONMENTS]):.2f} ({n})"
            for n in workers
            if n != "prototype"
        )
        print(f"\nSteps/s of environments over those of a batch of simulations: {', '.join(shares)}")


if __name__ == "__main__":
    main()
