"""First results of robots in new processes, with nothing cached and again: python -m benchmarks.compilation.

CPU seconds of the process itself after the import, and wall seconds; processes beside it are not counted.
`--against SRC` measures the sources of another checkout in turn.
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


def first_result(sources: Path, name: str, control: float, cache: str) -> tuple[float, float]:
    """Return CPU and wall seconds to the first result of a new process."""
    environment = {key: value for key, value in os.environ.items() if key != "KNODE_COSSERAT_CODE"}
    environment |= {"KNODE_COSSERAT_CACHE": cache, "PYTHONPATH": str(sources)}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps([name, control, STEPS, DT])],
        capture_output=True, text=True, check=True, env=environment,
    )  # fmt: skip
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
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS))
    given = parser.parse_args()
    sources = {"": Path(__file__).parents[1] / "src"}
    if given.against:
        sources = {" (other)": given.against.resolve(), **sources}
    for each in sources.values():
        # Python's own compiled files are no part of it
        subprocess.run([sys.executable, "-m", "compileall", "-q", str(each)], check=True)
    print(
        "| robot | nothing cached, CPU s | wall s | second process, CPU s | wall s |\n" + "| --- " * 5 + "|"
    )
    for label in given.robots:
        for suffix, each in sources.items():
            print(row_of(label + suffix, each, *ROBOTS[label], given.rounds), flush=True)


if __name__ == "__main__":
    main()
