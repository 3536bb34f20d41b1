"""Schemes along the rod: time of a step and error of the tip, in one run.

`python -m benchmarks.schemes` prints a table of the paper's robot under the sine of 1.5 s, 100 steps of 50
ms. The implicit midpoint rule is here only: it was tried beside the trapezoidal rule, which is the default.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import numpy as np

import knode_cosserat as kc
from benchmarks.cases import DT, PAPER, STEPS, medians
from knode_cosserat.schemes.space import Euler, Formula, Lobatto2, Lobatto4, SpaceScheme, Stage

#: nodes of each scheme, and of the reference
NODES, FINEST = (10, 20, 40), 97


@dataclasses.dataclass(frozen=True)
class Midpoint(SpaceScheme):
    """The implicit midpoint rule (Gauss, order 2)."""

    order = 2
    formula = Formula((Stage(0.5, 0.5, (0.0, 0.0)),), (0.0, 0.0, 1.0))
    # Simpson's rule: its middle is the cubic's, not the mean of the ends
    check = Formula((*formula.stages, *Lobatto2.check.stages), (1 / 6, 1 / 6, 0.0, 2 / 3))


SCHEMES: dict[str, SpaceScheme] = {
    "Euler": Euler(),
    "midpoint": Midpoint(),
    "Lobatto2": Lobatto2(),
    "Lobatto4": Lobatto4(),
}


class Measured(NamedTuple):
    """One scheme on one grid."""

    scheme: str
    nodes: int
    #: median time of a step (µs), and largest error of the tip (m)
    microseconds: float
    error: float
    #: largest estimate of the error (m)
    estimate: float


def measured() -> list[Measured]:
    """Return times and errors of all schemes on all grids."""
    robot, tensions = kc.load_robot("delrin-tendon-robot"), kc.controls.sine(1.5, STEPS, DT, sampled="end")
    finest = kc.simulate(robot.replace(nodes=FINEST), tensions, DT, space=Lobatto4(), **PAPER).tip_position
    cases = {f"{name} {nodes}": (name, nodes) for name in SCHEMES for nodes in NODES}

    def run(name: str, nodes: int) -> kc.Trajectory:
        return kc.simulate(robot.replace(nodes=nodes), tensions, DT, space=SCHEMES[name], **PAPER)

    times = medians({key: functools.partial(run, *case) for key, case in cases.items()}, rounds=15)
    found = []
    for key, case in cases.items():
        moved = run(*case)
        error = float(np.linalg.norm(moved.tip_position - finest, axis=1).max())
        found.append(Measured(*case, times[key] / STEPS * 1e6, error, float(np.max(moved.position_error))))
    return found


def main() -> None:
    """Print the table."""
    print("| scheme | nodes | µs/step | tip error (mm) | estimate (mm) |\n| --- | --- | --- | --- | --- |")
    for row in measured():
        print(
            f"| {row.scheme} | {row.nodes} | {row.microseconds:.0f} | {1e3 * row.error:.2g} "
            f"| {1e3 * row.estimate:.2g} |"
        )


if __name__ == "__main__":
    main()
