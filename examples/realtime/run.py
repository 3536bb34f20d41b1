"""A C++ controller at 500 Hz on the board's serial port, and predictive control in Python at 50 Hz.

    python -m examples.realtime.run [--seconds 20] [--fifo]

Exports the model, builds `controller.cpp`, and runs it on a pseudo-terminal. Behind it the real firmware, its
motors and the rod are emulated in real time. Prints one table of latencies. It needs a C++ compiler, and the
packages of the emulator (`knode_cosserat_hardware.emulation`).
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import knode_cosserat as kc
from benchmarks.control import HERE, measured_loops
from benchmarks.run import machine
from knode_cosserat_hardware import SerialBoard
from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.emulation import EmulatedPort, EmulatedRobot, PseudoTerminal
from studies.report import markdown_table

SOURCE = Path(__file__).with_name("controller.cpp")
ROBOT = "delrin-routed-tendon-robot"
#: period of the C++ controller (s), and periods of its linear-quadratic law's prediction
DT, HORIZON = 0.002, 8
#: the circle of controller.cpp: radius (m), time of a turn and until the radius is whole (s)
RADIUS, TURN, GROWTH = 0.03, 4.0, 2.0
#: the emulated robot is in real time above this part of it; below, errors of its tip say nothing
FAST_ENOUGH = 0.95
#: period (s) of the predictive controller in Python
SLOW = 0.02


class NoCompilerError(Exception):
    """There is no C++ compiler."""


def build(folder, *options):
    """Export the model to a folder, build the controller, and return its program."""
    compiler = os.environ.get("CXX") or next(filter(shutil.which, ("c++", "g++", "clang++")), None)
    if compiler is None:
        raise NoCompilerError("no C++ compiler; install one (apt-get install g++), or name it in CXX")
    folder = Path(folder)
    kc.export(kc.load_robot(ROBOT), folder, DT, name="arm", time="bdf2", horizon=HORIZON)
    program = folder / "controller"
    parts = [("-std=c++17", "c++", str(SOURCE), "controller.o"), ("-std=c11", "c", "arm.c", "model.o")]
    for standard, language, source, out in parts:
        command = [compiler, standard, "-O2", "-I.", *options, "-x", language, "-c", source, "-o", out]
        subprocess.run(command, cwd=folder, check=True)
    subprocess.run([compiler, "controller.o", "model.o", "arm.o", "-o", program], cwd=folder, check=True)
    return program


def prepare(robot):
    """Accept the settings of a new board, and take its load cells' zeros; in lock-step."""
    with SerialBoard(EmulatedPort(robot)) as board:
        board.reset()
        board.tare()


def control(program, law, seconds, fifo=False):
    """Let the controller move the emulated robot; return what it printed, and errors of the true tip (mm)."""
    robot = EmulatedRobot(ROBOT)
    prepare(robot)
    with PseudoTerminal(robot) as terminal:
        command = [*(["chrt", "-f", "50"] if fifo else []), program, terminal.path, law, str(seconds)]
        worker = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        rest, rows, emulated = robot.tip()[:2], [], []
        while worker.poll() is None:
            state = robot.true_state()
            rows.append([time.monotonic(), *np.asarray(state.tip_position)[0, :2]])
            emulated.append(robot.time)
            time.sleep(0.05)
        if terminal.error is not None:
            raise terminal.error
    if worker.returncode:
        # it has said why
        sys.exit(worker.returncode)
    said = dict(line.split(maxsplit=1) for line in worker.stdout.read().splitlines())
    moment, tip = np.split(np.array(rows), [1], axis=1)
    t = moment.ravel() - float(said["start"])
    angle = 2.0 * np.pi * t / TURN
    target = RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    whole = (t > GROWTH) & (t < seconds)
    said["tip_rms_mm"] = 1e3 * np.sqrt(np.mean(np.sum((tip - rest - target)[whole] ** 2, axis=1)))
    said["speed"] = np.ptp(np.array(emulated)[whole]) / np.ptp(t[whole])
    return said


def python_row():
    """Return the row of the predictive controller in Python, with a horizon chosen for its period."""
    found = measured_loops(SLOW, {"predictive": "predictive:realtime=0.6"}, {"this one": HERE})
    name = "predictive, Python, without a port"
    if not found:
        # the loop has printed why: no horizon fits into the period on this computer
        return [name, "50 Hz", *8 * ["–"]]
    ((_, cycle, _), rmse, _) = found["predictive", "this one"]
    times = 1e3 * np.percentile(cycle, (50, 99.9, 100))
    late = int(np.sum(np.array(cycle) > SLOW))
    return [name, "50 Hz", *times, "–", "–", "–", f"{late} of {len(cycle)}", f"{1e3 * rmse:.2f}"]


def row(said):
    """Return the row of a law of the C++ controller."""
    times = [1e-3 * float(part) for name in ("compute_us", "wake_us") for part in said[name].split()]
    late = f"{said['missed']} of {said['periods']}"
    error = f"{said['tip_rms_mm']:.2f}" if said["speed"] > FAST_ENOUGH else "robot too slow"
    return [f"{said['law']}, C++", "500 Hz", *times, late, error]


def main():
    """Build, run, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each law, from 4 on (default 20)")
    parser.add_argument(
        "--fifo", action="store_true", help="run the controller before other programs (chrt -f 50); as root"
    )
    given = parser.parse_args()
    if given.seconds < 4.0:
        parser.error(f"--seconds is {given.seconds:g}; allowed is 4 or more")
    try:
        with tempfile.TemporaryDirectory() as folder:
            program = build(folder)
            found = [control(program, law, given.seconds, given.fifo) for law in ("kinematic", "lq")]
    except (NoCompilerError, HardwareError) as error:
        sys.exit(f"examples.realtime.run: {error}")
    rows = [*map(row, found), python_row()]
    head = [
        "controller",
        "rate",
        "compute, ms: median",
        "99.9 %",
        "max",
        "wake-up, ms: median",
        "99.9 %",
        "max",
    ]
    cells = [[f"{each:.2f}" if isinstance(each, float) else each for each in one] for one in rows]
    print(f"\n{machine()}; load {os.getloadavg()[0]:.1f}\n")
    print(markdown_table([*head, "missed", "tip RMS, mm"], cells))
    for said in found:
        print(f"{said['law']}: the emulated robot ran at {said['speed']:.2f} of real time")


if __name__ == "__main__":
    main()
