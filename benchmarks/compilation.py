"""First results of robots in new processes, with nothing cached and again: python -m benchmarks.compilation.

CPU seconds of the process itself after the import, and wall seconds; processes beside it are not counted.
`--against SRC` measures the sources of another checkout in turn. `--stability` measures the command
`knode-cosserat equilibrium` of all robots of the catalog instead, with and without its test of stability.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

#: robots, and controls of all their actuators
ROBOTS = {
    "paper's robot": ("delrin-tendon-robot", 5.0),
    "routed, ribs": ("delrin-routed-tendon-robot", 5.0),
    "chambers": ("three-chamber-arm", 1e4),
    "tubes": ("three-tube-robot", 0.0),
    "gripper": ("three-finger-gripper", 1.0),
}
STEPS, DT = 20, 0.05
PROGRAM = """
import json, sys, time
import numpy as np
import knode_cosserat as kc
name, control, steps, dt = json.loads(sys.argv[1])
kc.simulate, kc.load_robot
cpu, wall = time.process_time(), time.perf_counter()
robot = kc.load_robot(name)
kc.simulate(robot, np.full((steps, robot.control_layout.size), control), dt)
print(json.dumps([time.process_time() - cpu, time.perf_counter() - wall]))
"""

#: controls of the command `equilibrium`; of robots that are not named, all are zeros
RESTS = {
    "delrin-routed-tendon-robot": "7,5,5,7",
    "delrin-tendon-robot": "7,5,5,7",
    "fed-catheter": "load0_Bx=0.01,insertion=0.01",
    "magnetic-catheter": "load0_Bx=0.01",
    "six-legged-robot": "displacement_1=0.01",
    "soft-slender-robot": "base_z=0.1,base_ry=0.2",
    "three-chamber-arm": "pressure_1=20000",
    "three-finger-gripper": "1,1,1,1,1,1",
    "three-tube-robot": "rotation_2=1.0,insertion_1=0.01",
    "variable-curvature-robot": "section0_input=0.3",
}
COMMAND = """
import functools, json, sys
import knode_cosserat as kc
from knode_cosserat.cli import main
name, control, tested = json.loads(sys.argv[1])
if not tested:
    kc.equilibrium = functools.partial(kc.equilibrium, with_stability=False)
control = control or ",".join("0" for _ in kc.load_robot(name).control_layout.labels)
sys.argv = ["knode-cosserat", "equilibrium", name, "--control", control]
main()
"""


def environment_of(sources: Path, cache: str) -> dict[str, str]:
    """Return the environment of a new process."""
    environment = {key: value for key, value in os.environ.items() if key != "KNODE_COSSERAT_CODE"}
    return environment | {"KNODE_COSSERAT_CACHE": cache, "PYTHONPATH": str(sources)}


def command(sources: Path, name: str, tested: bool, cache: str) -> tuple[float, str]:
    """Return CPU seconds of a whole process of the command `equilibrium`, and what it prints."""
    given = json.dumps([name, RESTS.get(name, ""), tested])
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, given],
        stdout=subprocess.PIPE,
        text=True,
        env=environment_of(sources, cache),
    )
    with process, process.stdout as printed:
        said = printed.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"equilibrium {name} failed")
    return used.ru_utime + used.ru_stime, said


def stability_row(sources: Path, name: str, rounds: int) -> str:
    """Return a row: first processes and medians of later ones, without and with the test; ratio, verdict."""
    first, later = dict[bool, float](), dict[bool, list[float]]()
    for tested in (False, True):
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as cache:
            first[tested], said = command(sources, name, tested, cache)
            later[tested] = [command(sources, name, tested, cache)[0] for _ in range(rounds)]
    without, with_it = (statistics.median(later[tested]) for tested in (False, True))
    verdict = next(line for line in said.splitlines() if "stable" in line.lower() or "stability" in line)
    numbers = (first[False], first[True], without, with_it, with_it / without)
    return f"| {name} | {' | '.join(f'{number:.2f}' for number in numbers)} | {verdict} |"


def first_result(sources: Path, name: str, control: float, cache: str) -> tuple[float, float]:
    """Return CPU and wall seconds to the first result of a new process."""
    environment = environment_of(sources, cache)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps([name, control, STEPS, DT])],
        capture_output=True,
        text=True,
        check=True,
        env=environment,
    )
    return tuple(json.loads(done.stdout))


def row_of(label: str, sources: Path, name: str, control: float, rounds: int) -> str:
    """Return a row of the table: medians of the first and the second process."""
    found = []
    for _ in range(rounds):
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as cache:
            found.append([first_result(sources, name, control, cache) for _ in range(2)])
    cells = (f"{statistics.median(r[k][part] for r in found):.2f}" for k in (0, 1) for part in (0, 1))
    return f"| {label} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", type=Path, help="sources of another checkout, such as ../other/src")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--robots", nargs="*", default=None)
    parser.add_argument("--stability", action="store_true", help="CPU time of the command `equilibrium`")
    given = parser.parse_args()
    sources = {"": Path(__file__).parents[1] / "src"}
    if given.against:
        sources = {" (other)": given.against.resolve(), **sources}
    for each in sources.values():
        # Python's own compiled files are no part of it
        subprocess.run([sys.executable, "-m", "compileall", "-q", str(each)], check=True)
    if given.stability:
        columns = [
            "robot",
            "first process without the test, CPU s",
            "with",
            "later processes without",
            "with",
        ]
        print(f"| {' | '.join([*columns, 'ratio', 'verdict'])} |\n" + "| --- " * 7 + "|")
        for label in given.robots or RESTS:
            print(stability_row(sources[""], label, given.rounds), flush=True)
        return
    print(
        "| robot | nothing cached, CPU s | wall s | second process, CPU s | wall s |\n" + "| --- " * 5 + "|"
    )
    for label in given.robots or ROBOTS:
        for suffix, each in sources.items():
            print(row_of(label + suffix, each, *ROBOTS[label], given.rounds), flush=True)


if __name__ == "__main__":
    main()
