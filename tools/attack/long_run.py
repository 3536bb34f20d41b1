"""Long runs: different simulations in one process, and a live session, with bounded memory and maps.

`python -m tools.attack.long_run --simulations 10000` or `--seconds 480`, and `--live 300` for a live session.
Every simulation is of another random robot. Each 100 of them have another shape (node count, scheme along
the rod, class of robot) and so need programs of their own; after all shapes it returns to the first ones.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import knode_cosserat as kc
from tools.attack.table import Row, printed_row

#: most memory maps, three quarters of Linux's limit, and most memory (MB) of a long run
MOST_MAPS, MOST_MEGABYTES = 49_000, 6_000
ROBOTS = ("delrin-tendon-robot", "delrin-routed-tendon-robot")
SPACES = ("lobatto2", "euler", "lobatto4")
#: node counts; with the robots and schemes these are 1,266 shapes
NODES = range(10, 221)
#: robots of each shape
ALIKE = 100
#: largest growth of a live session's memory (MB per hour), after its first minute
MOST_GROWTH = 100.0


class Sample(NamedTuple):
    """State of the process after so many simulations."""

    simulations: int
    seconds: float
    maps: int
    megabytes: float
    failed: int


def memory_maps() -> int:
    """Return the number of memory maps of this process, or 0 if the system does not report it."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return 0


def resident() -> float:
    """Return the resident memory of this process (MB); NaN if the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return float("nan")
    return pages * 4096 / 1e6


def shapes() -> list[tuple[str, str, int]]:
    """Return robots, schemes and node counts, in an order that mixes small and large grids."""
    found = list(itertools.product(ROBOTS, SPACES, NODES))
    order = np.random.default_rng(0).permutation(len(found))
    return [found[k] for k in order]


def simulations(most: int, seconds: float, every: int = 40) -> list[Sample]:
    """Run different simulations and return the state of the process every so many."""
    robots = {name: kc.load_robot(name) for name in ROBOTS}
    generator, samples, failed = np.random.default_rng(1), [], 0
    began, all_shapes = time.monotonic(), shapes()
    for k in range(most):
        name, space, nodes = all_shapes[k // ALIKE % len(all_shapes)]
        length, modulus = generator.uniform(0.3, 0.8), 10.0 ** generator.uniform(9.0, 10.0)
        robot = robots[name].replace(nodes=nodes, length=float(length), youngs_modulus=float(modulus))
        controls = generator.uniform(2.0, 7.0, (2, robot.control_layout.size))
        moved = kc.simulate(robot, controls, 0.05, space=space, on_failure="return", recovery_budget=2.0)
        failed += int(np.any(np.asarray(moved.result) < 0))
        spent = time.monotonic() - began
        over = spent > seconds or k == most - 1
        if over or (k + 1) % every == 0:
            samples.append(Sample(k + 1, spent, memory_maps(), resident(), failed))
            print(json.dumps(samples[-1]._asdict()), flush=True)
        if over:
            break
    return samples


class _Sliders:
    """A connection whose page moves its sliders all the time, and reads every frame."""

    def __init__(self, until: float, size: int, interval: float = 0.02):
        self._until, self._size, self._interval = until, size, interval
        self.frames = self.unsolved = self._sequence = 0

    def __aiter__(self) -> _Sliders:
        return self

    async def __anext__(self) -> str:
        await asyncio.sleep(self._interval)
        now = time.monotonic()
        if now > self._until:
            raise StopAsyncIteration
        self._sequence = (self._sequence + 1) % 2**24
        control = 5.0 + 1.5 * np.sin(now + np.arange(self._size))
        return json.dumps({"sequence": self._sequence, "control": control.tolist()})

    async def send(self, message: Any) -> None:
        self.frames += isinstance(message, bytes)
        self.unsolved += isinstance(message, str) and "unsolved" in message


async def _live(seconds: float, every: float) -> tuple[list[tuple[float, float, int]], int, int]:
    from knode_cosserat.viewer.live import Session

    robot = kc.load_robot(ROBOTS[0])
    began = time.monotonic()
    page = _Sliders(began + seconds, robot.control_layout.size)
    session = asyncio.create_task(Session(kc.solvers.Stepper(robot, 0.05), page).run())
    samples = []
    while not session.done():
        await asyncio.wait({session}, timeout=every)
        samples.append((time.monotonic() - began, resident(), memory_maps()))
        print(json.dumps({"live": samples[-1], "frames": page.frames}), flush=True)
    session.result()
    return samples, page.frames, page.unsolved


def live(seconds: float) -> tuple[float, int, int]:
    """Run a live session; return its growth (MB per hour, after a fifth of it), frames and failures."""
    samples, frames, unsolved = asyncio.run(_live(seconds, min(15.0, seconds / 10.0)))
    later = np.array([each[:2] for each in samples if each[0] >= min(60.0, 0.2 * seconds)])
    slope = float(np.polyfit(later[:, 0], later[:, 1], 1)[0]) if len(later) > 2 else float("nan")
    return 3600.0 * slope, frames, unsolved


def simulated(most: int, seconds: float = float("inf")) -> list[Row]:
    """Run different simulations, and return the row of the table."""
    samples = simulations(most, seconds)
    maps, memory = (max(getattr(each, name) for each in samples) for name in ("maps", "megabytes"))
    last, failures = samples[-1], []
    if maps > MOST_MAPS:
        failures.append(f"{maps} memory maps; allowed are {MOST_MAPS}")
    if memory > MOST_MEGABYTES:
        failures.append(f"{memory:.0f} MB; allowed are {MOST_MEGABYTES}")
    remark = f"{last.seconds:.0f} s, at most {maps} maps and {memory:.0f} MB"
    row = Row("different simulations in one process", last.simulations, last.failed, failures, remark)
    printed_row(row)
    return [row]


def lived(seconds: float) -> list[Row]:
    """Run a live session, and return the row of the table."""
    growth, frames, unsolved = live(seconds)
    failures = [] if growth < MOST_GROWTH and frames else [f"a live session grew by {growth:.1f} MB/h"]
    row = Row("live session", frames, unsolved, failures, f"{seconds:.0f} s, {growth:+.1f} MB/h")
    printed_row(row)
    return [row]


def main() -> None:
    """Run one of the long runs for a time; the exit status is 1 if memory or maps are not bounded."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--simulations", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--live", type=float, default=0.0)
    given = parser.parse_args()
    rows = lived(given.live) if given.live else simulated(given.simulations, given.seconds)
    sys.exit(1 if any(row.failures for row in rows) else 0)


if __name__ == "__main__":
    main()
