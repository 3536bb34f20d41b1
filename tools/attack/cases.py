"""Extreme and undamped robots: no converged row whose independent residual or finer grid disagrees.

Drawn are E from 1 MPa to 200 GPa, radius 0.3 to 10 mm, length 0.1 to 2 m, time step 1 to 100 ms, gravity in
any direction and tensions up to strong bending; half of the robots have no damping, a third is pulled by up
to 1,000 N. The residual is computed by the NumPy transcription of the paper's equations (`benchmarks`), which
shares no code with the package; the finer grid has four times as many segments.
"""

from __future__ import annotations

import collections
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import knode_cosserat as kc
from benchmarks.paper_transcription import PaperRobot, SemiDiscreteRod
from tools.attack.table import Row, printed_row

STEPS, NODES = 20, (10, 19)
#: largest independent residual, without units, and largest difference to the finer grid (of the length):
#: a row with an estimated error above 2 % is COARSE, and estimates are good to a factor of about two
MOST_RESIDUAL, MOST_OFF = 1e-6, 0.05
#: γ of the default scheme in time
GAMMA = 1.0 - np.sqrt(0.5)
ANGLES = np.pi / 4 + np.arange(4) * np.pi / 2
_UNITS = ((0, 3), (3, 7), (7, 10), (10, 13), (13, 16), (16, 19))


class Case(NamedTuple):
    """A robot and its motion."""

    robot: kc.robots.TendonRobot
    tensions: np.ndarray
    dt: float


def drawn(seed: int) -> Case:
    """Return a random case."""
    generator = np.random.default_rng(seed)

    def log_uniform(low: float, high: float) -> float:
        return float(np.exp(generator.uniform(np.log(low), np.log(high))))

    modulus, radius = log_uniform(1e6, 200e9), log_uniform(0.3e-3, 10e-3)
    length, dt = log_uniform(0.1, 2.0), log_uniform(1e-3, 0.1)
    density = 1411.6751
    stiffness, mass = modulus * np.pi * radius**4 / 4, density * np.pi * radius**2
    gravity = min(9.81, 5.0 * generator.uniform() * stiffness / (mass * length**3))
    direction = generator.normal(size=3)
    robot = kc.robots.TendonRobot(
        length=length,
        radius=radius,
        density=density,
        youngs_modulus=modulus,
        bending_damping=0.0 if seed % 2 else 0.03,
        drag=1e-4,
        gravity=gravity * direction / np.linalg.norm(direction),
        nodes=int(generator.choice(NODES)),
    )
    return Case(robot, _tensions(generator, seed % 3 == 0, stiffness / length**3), dt)


def _tensions(generator: np.random.Generator, strong: bool, unit: float) -> np.ndarray:
    """Return tensions (N): a ramp up to 1,000 N, or a sine, step or noise that bends the rod."""
    if strong:
        top = 10.0 ** generator.uniform(0.5, 3.0)
        pulled = generator.uniform(0.0, top, (STEPS, 4)) * (generator.random(4) < 0.6)
        return np.asarray(5.0 + pulled * np.linspace(0.0, 1.0, STEPS)[:, None])
    kind, phase = generator.integers(3), np.arange(4) * np.pi / 2
    if kind == 0:
        turns = generator.uniform(1.0, 10.0) * np.arange(1, STEPS + 1) / STEPS
        tensions = 1.0 + np.sin(2 * np.pi * turns[:, None] + phase)
    elif kind == 1:
        tensions = np.where((np.arange(STEPS) > 5)[:, None], [2.0, 0.0, 0.0, 2.0], [0.5] * 4)
    else:
        tensions = generator.uniform(size=(STEPS, 4))
    transverse = np.hypot(tensions @ np.cos(ANGLES), tensions @ np.sin(ANGLES)).max()
    return np.asarray(tensions * 6.0 * generator.uniform() * unit / transverse)


def residuals(case: Case, moved: kc.Trajectory) -> np.ndarray:
    """Return the largest residual of each step's stages, without units: trapezoidal rule, tip and strains."""
    robot = case.robot
    names = ("length", "radius", "density", "youngs_modulus", "bending_damping", "drag", "nodes")
    values = {name: getattr(robot, name) for name in names}
    paper = PaperRobot(**values, gravity=tuple(np.asarray(robot.gravity).tolist()))
    # its c0 is 1.5 / dt, that of BDF2; here it is 1 / (γ dt)
    rod = SemiDiscreteRod(paper, 1.5 * GAMMA * case.dt)
    ny = moved.y.shape[-1]
    rows = np.concatenate([np.asarray(moved.y), np.asarray(moved.z)], axis=-1)
    stages = np.asarray(moved.stages)[:, 0, :, : rows.shape[-1]]
    scale = _scales(paper, rod.c0)

    def residual(x: np.ndarray, start: np.ndarray, tensions: np.ndarray) -> float:
        """Return that of a state whose rates are (x - start) c0."""
        force, (y, z), (yh, zh) = rod.phi @ tensions, _split(x, ny), _split(-rod.c0 * start, ny)
        both = [rod.equations(*node, force) for node in zip(y, yh, zh, strict=True)]
        rates, strains = np.array([each[0] for each in both]), np.array([each[1] for each in both])
        defect = np.diff(y, axis=0) - 0.5 * rod.ds * (rates[1:] + rates[:-1])
        strain = np.abs(strains - z) * np.repeat([1.0, paper.length], 3)
        ends = np.abs(y[-1, 7:13] / scale[7:13])
        return max(np.max(np.abs(defect / scale)), np.max(strain), np.max(ends))

    found = np.zeros(len(rows))
    for row in range(1, len(rows)):
        before, stage, tensions = rows[row - 1], stages[row], case.tensions[row - 1]
        # Alexander's scheme: y = before + (1 - γ) dt y_t(stage) + γ dt y_t
        reached = before + (1.0 - GAMMA) / GAMMA * (stage - before)
        found[row] = max(residual(stage, before, tensions), residual(rows[row], reached, tensions))
    return found


def _split(x: np.ndarray, ny: int) -> tuple[np.ndarray, np.ndarray]:
    return x[:, :ny], x[:, ny:]


def _scales(robot: PaperRobot, c0: float) -> np.ndarray:
    """Return the natural size of each part of y."""
    stiffness = robot.youngs_modulus * np.pi * robot.radius**4 / 4
    length = robot.length
    sizes = (length, 1.0, stiffness / length**2, stiffness / length, c0 * length, c0)
    return np.concatenate(
        [np.full(end - begin, size) for (begin, end), size in zip(_UNITS, sizes, strict=True)]
    )


class Checked(NamedTuple):
    """Largest residual and difference of a case's converged rows, and its result codes."""

    residual: float
    off: float
    results: collections.Counter[str]


def checked(case: Case) -> Checked:
    """Simulate a case on both grids and compare."""
    robot = case.robot
    options: Any = {"recovery_budget": 1.0, "on_failure": "return"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        moved = kc.simulate(robot, case.tensions, case.dt, **options)
        fine = kc.simulate(robot.replace(nodes=4 * (robot.nodes - 1) + 1), case.tensions, case.dt, **options)
    result, finer = np.asarray(moved.result), np.asarray(fine.result)
    coarse = int(kc.Result.COARSE)
    # a recovered step has another history, and may be on another branch from there on
    plain = ~np.cumsum((result > coarse) | (result < 0)).astype(bool)
    with np.errstate(all="ignore"):
        residual = np.where(plain, residuals(case, moved), 0.0)
    off = np.linalg.norm(moved.tip_position - fine.tip_position, axis=1) / robot.length
    claimed = plain & (result == int(kc.Result.CONVERGED))
    comparable = claimed & ~np.cumsum((finer > coarse) | (finer < 0)).astype(bool)
    return Checked(
        float(np.max(residual[claimed], initial=0.0)),
        float(np.max(off[comparable], initial=0.0)),
        collections.Counter(kc.Result(int(each)).name for each in result[1:]),
    )


def checked_cases(folder: Path, count: int, seed: int) -> list[Row]:
    """Check so many cases; cases that fail are named by their seed."""
    failures: list[str] = []
    results: collections.Counter[str] = collections.Counter()
    residual = off = 0.0
    for k in range(count):
        own = 1_000_000 * seed + k
        found = checked(drawn(own))
        results += found.results
        residual, off = max(residual, found.residual), max(off, found.off)
        # not a number counts as wrong
        if not found.residual <= MOST_RESIDUAL:
            failures.append(f"case {own}: converged with an independent residual of {found.residual:.1e}")
        if not found.off <= MOST_OFF:
            failures.append(f"case {own}: converged, and {found.off:.1%} off the finer grid")
    rows = {name: number for name, number in results.items() if number}
    remark = f"residual at most {residual:.1e}, off by at most {off:.1%}; rows {rows}"
    # one row of a case; those after it were not reached
    refused = results["NO_CONVERGENCE"] + results["NOT_FINITE"]
    row = Row("extreme and undamped robots", count, refused, failures, remark)
    printed_row(row)
    return [row]
