"""Whether rows that are solved are to be believed: finite, of a likely size, or alike on two grids."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.task import Start, Steps

#: in natural units: a state beyond this is checked for instability
SUSPICIOUS = 30.0
#: of its largest value: how far y of two grids may be apart if it is to be believed
GRIDS_APART = 0.2
#: the same of equilibria, by fields of y: a tension is large, and would hide where the rod is
SHAPES_APART = 0.02
#: |λ| ds beyond which an explicit scheme makes grow what decays along the rod (Euler 2, RK4 2.8)
GROWS = 2.0


def finite(steps: Steps, system: System) -> Any:
    """Whether each step's strains at the tip are: those at all other nodes have served to find y."""
    return np.isfinite(steps.records[..., -1, system.y_layout.size :]).all(axis=-1)


def refuse(steps: Steps, wrong: Any, why: Result) -> bool:
    """Take back the first solved step that is wrong, and all after it; whether there was one."""
    found = np.flatnonzero(wrong & (steps.result >= 0))
    if len(found):
        steps.result[found[0]] = int(why)
        steps.result[found[0] + 1 :] = int(Result.NOT_REACHED)
    return len(found) > 0


def trustworthy(steps: Steps, system: System, start: Start, still: bool, decay: Callable[[], float]) -> bool:
    """Solved, and not grown to a size that suggests an instability in space.

    What hangs like a cable carries forces far beyond its natural ones from the start. It is believed if its
    segments are short enough for what decays along it (`decay`: by how much in one of them).
    """
    if steps.result.min() < 0:
        return False
    largest = steps.size.max()
    # nearly always so; and what is natural of a system takes a millisecond to say, how waves decay a program
    if largest <= SUSPICIOUS:
        return True
    return bool((still or largest <= trusted_size(system, start)) and decay() <= GROWS)


def trusted_size(system: System, start: Start) -> float:
    """Numbers of y up to this, in natural units, are not suspicious: more if it starts with large ones."""
    y = np.asarray(start.past.y[0])
    return SUSPICIOUS * max(1.0, float(np.max(np.abs(y) / np.asarray(system.scales().y))))


def agree(finer: Steps, coarser: Steps, system: System, still: bool = False) -> bool:
    """Whether two grids are both solved and agree on y where it is largest: then it is as large as that.

    Equilibria have to agree in every field of y.
    """
    if min(finer.result.min(), coarser.result.min()) < 0:
        return False
    scale, layout = np.asarray(system.scales().y), system.y_layout
    apart = np.abs(finer.records - coarser.records)[..., : layout.size] / scale
    if not still:
        return bool(np.max(apart) <= GRIDS_APART * finer.size.max())
    sizes = np.abs(finer.records[..., : layout.size]) / scale
    return all(
        np.max(layout.get(apart, name)) <= SHAPES_APART * max(1.0, np.max(layout.get(sizes, name)))
        for name in layout.names
    )
